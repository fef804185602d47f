"""How well "auto" chooses, against plans that are all carried out."""

import json

import pytest
from conftest import GREY, build, few_held_out, still_life
from rich.console import Console

import mi_sparse_prt as prt
from mi_sparse_prt.benchmark.plan_choice import SLOWER, _against_best, measure_plans
from mi_sparse_prt.cli.tables.benchmark import plans_tables
from mi_sparse_prt.methods.plan import Plan


def carried_out(plan: Plan, seconds: float, error: float) -> dict:
    return {**plan.report(), "seconds": seconds, "seconds_in_all": seconds + 2, "estimated_error": error}


def auto(plan: Plan, seconds: float, error: float) -> dict:
    return {
        "plan": plan.report(),
        "plans": [plan.report() | {"chosen": True}, Plan("exact").report() | {"chosen": False}],
        "seconds": {"total": seconds, "held_out": 0.5},
        "estimated_error": {"total": error, "standard_error": {"total": 0.001}},
    }


def test_the_best_is_the_quickest_that_is_good_enough():
    """
    Rationale: a quick plan that misses the target is no match for one that meets it.
    Expected: of three plans (1 s at 3%, 2 s at 1.9%, 5 s at 0.5%) the second is the best for 2%, the last one for 1%;
        "auto", which takes the last one and 8 s, took 2.5 times too long for 2%, and twice with 2 s that it takes in
        any case; where no plan meets the target there is no best one, and 2.1% +- 0.1% counts as 2%.
    """
    plans = [Plan("consensus", "gather", rays) for rays in (64, 256, 1024)]
    done = [carried_out(*p) for p in zip(plans, (1.0, 2.0, 5.0), (0.03, 0.019, 0.005), strict=True)]
    loose = _against_best(0.02, auto(plans[2], 8.0, 0.005), done)
    assert loose["best"] == done[1]
    assert (loose["choice"], loose["whole"], loose["met"], loose["attempts"]) == (2.5, 2.0, True, 1)
    assert _against_best(0.01, auto(plans[2], 8.0, 0.005), done)["choice"] == 1.0
    tight = _against_best(0.001, auto(plans[2], 8.0, 0.005), done)
    assert (tight["best"], tight["choice"], tight["whole"], tight["met"]) == (None, None, None, False)
    assert _against_best(0.02, auto(plans[1], 8.0, 0.021), done)["met"]
    assert not _against_best(0.02, auto(plans[1], 8.0, 0.0221), done)["met"]


@pytest.mark.slow
def test_every_plan_is_carried_out_that_may_be_as_quick(monkeypatch):
    """
    Expected: JSON and tables; each target's own plan is among those carried out, with what was predicted of it; what
        was left out is slower by prediction; all that ``"auto"`` does takes longer than the plan alone.
    """
    few_held_out(
        monkeypatch, spp=16, paths=1024, few_paths=128, fewest_rays=1 << 14
    )  # for each of dozens of plans
    report = measure_plans(
        build(0.4, **still_life(GREY)), prt.CubemapLighting(4), progress=False, targets=(0.1, 0.04)
    )
    assert json.loads(json.dumps(report)) == report
    names = [(p["direct"], p["indirect"], tuple(p["parameters"].items())) for p in report["plans"]]
    assert len(set(names)) == len(names)
    assert [p["seconds"] for p in report["plans"]] == sorted(p["seconds"] for p in report["plans"])
    chosen = []
    for found, target in zip(report["targets"], (0.1, 0.04), strict=True):
        assert found["target_error"] == target
        own = next(p for p in report["plans"] if all(p[key] == value for key, value in found["plan"].items()))
        chosen.append(own["predicted_seconds"])
        assert 0 < own["seconds"] < own["seconds_in_all"]
        assert found["seconds"] > own["seconds"]
        if found["best"] is not None:
            assert found["best"]["estimated_error"] <= target
            assert found["choice"] == pytest.approx(own["seconds"] / found["best"]["seconds"])
    assert max(p["predicted_seconds"] for p in report["plans"]) <= SLOWER * max(chosen)
    console = Console(width=200, record=True)
    for table in plans_tables(report):
        console.print(table)
    assert "choice / best" in console.export_text()
