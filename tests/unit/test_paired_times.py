"""docs/paired_times.py: what it makes of seconds; the measurement itself takes minutes."""

import importlib.util
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "docs" / "paired_times.py"


@pytest.fixture(scope="module")
def paired_times():
    spec = importlib.util.spec_from_file_location("paired_times", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_ratio_is_the_median_of_each_pairs_own(paired_times):
    """A minute in which everything takes ten times as long is in both of a pair; the ratio of the medians is 0.75."""
    found = paired_times.summarised([(1.0, 2.0), (30.0, 20.0), (3.0, 2.0), (1.0, 4.0), (5.0, 10.0)])
    assert found == (0.5, 0.25, 1.5, 3.0, 4.0)


def test_runs_alternate_and_stay_with_their_checkout(paired_times):
    order = []
    pairs = paired_times.timed_pairs(
        lambda: order.append("A") or "a", lambda: order.append("B") or "b", pairs=3
    )
    assert list(pairs) == [("a", "b")] * 3
    assert order == ["A", "B", "B", "A", "A", "B"]
