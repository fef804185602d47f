"""Brute force at the error of another method: what follows from a few measurements of its time and noise."""

import numpy as np
import pytest

from mi_sparse_prt.benchmark.brute_force import BruteForce

MEASURED = BruteForce(
    direct_seconds=2.0,
    spp=(1, 4, 16),
    path_seconds=(10.0, 22.0, 70.0),
    errors=(0.2, 0.1, 0.05),
    standard_errors=(0.02, 0.01, 0.005),
)


def test_noise_falls_with_the_root_of_the_paths():
    assert MEASURED.noise == pytest.approx(0.2)


def test_noise_is_the_mean_of_all_measurements_by_how_well_they_are_known():
    """Expected: at one path 0.2 +- 0.02 and 0.24 +- 0.01 make (0.2 / 4 + 0.24) / (1 / 4 + 1) = 0.232."""
    curve = BruteForce(0.0, (1, 4), (1.0, 4.0), (0.2, 0.12), (0.02, 0.005))
    assert curve.noise == pytest.approx(0.232)


def test_time_between_measurements_and_beyond():
    assert [MEASURED.seconds(spp) for spp in (1, 4, 16)] == [12, 24, 72]
    assert MEASURED.seconds(10) == pytest.approx(2 + 46)
    assert MEASURED.seconds(160) == pytest.approx(2 + 700)


@pytest.mark.parametrize(
    ("error", "spp", "seconds", "extrapolated"),
    [
        (0.1, 4, 24, False),
        (0.01, 400, 2 + 70 * 25, True),
        (0.5, 1, 12, False),  # less than one path there is not
    ],
)
def test_speed_up_at_equal_error(error, spp, seconds, extrapolated):
    found = MEASURED.compared(3.0, error)
    assert found["spp"] == pytest.approx(spp)
    assert found["seconds"] == pytest.approx(seconds)
    assert found["speed_up"] == pytest.approx(seconds / 3)
    assert found["extrapolated"] is extrapolated


def test_no_error_to_be_equal_to():
    """Expected: None, and no infinity, which JSON does not know."""
    assert set(MEASURED.compared(3.0, 0.0).values()) == {None}


def test_without_noise_one_path_is_enough():
    """Expected: a scene without interreflections, all errors 0 and known exactly: one path, and no warning."""
    curve = BruteForce(2.0, (1, 4), (1.0, 4.0), (0.0, 0.0), (0.0, 0.0))
    with np.errstate(all="raise"):
        assert curve.compared(1.0, 0.1)["spp"] == 1
