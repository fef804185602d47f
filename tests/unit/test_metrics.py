"""Error norms against the obvious formulas, and what they say of nothing."""

import numpy as np
import pytest

from mi_sparse_prt.core.metrics import (
    flip_map,
    relative_l2,
    relative_l2_by_name,
    relative_l2_from_squares,
    relative_l2_of_rows,
    relative_l2_of_sample,
    relative_l2_without_noise,
    relative_noise,
    worst_rows,
)


def test_relative_l2_is_the_ratio_of_norms():
    a, b = np.random.default_rng(0).normal(size=(2, 4, 5, 3)).astype(np.float32)
    assert relative_l2(a, b) == pytest.approx(np.linalg.norm(a - b) / np.linalg.norm(b))
    rows = [np.linalg.norm(a[k] - b[k]) / np.linalg.norm(b[k]) for k in range(4)]
    np.testing.assert_allclose(relative_l2(a, b, axis=(1, 2)), rows, rtol=1e-6)
    np.testing.assert_allclose(
        relative_l2(a[:, :, 0], b[:, :, 0], axis=1)[2], relative_l2(a[2, :, 0], b[2, :, 0])
    )


def test_squared_errors_below_zero_and_nothing():
    """Expected: noise about zero is no error; 0 / 0 is 0, anything else over 0 is 1, and nothing warns."""
    with np.errstate(all="raise"):
        found = relative_l2_from_squares([0.04, -0.1, 0.0, 2.0, -2.0], [1.0, 1.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(found, [0.2, 0, 0, 1, 0])
    zero = np.zeros((2, 3))
    assert relative_l2(zero, zero) == 0 and relative_l2(zero + 1, zero) == 1
    assert relative_l2_without_noise(zero, zero, zero) == (0, 0)
    assert relative_l2_without_noise(zero + 1, zero, zero) == (1, 0)
    assert relative_noise(zero, zero) == 0
    assert relative_l2_of_sample([0, 0], [0, 0]) == relative_l2_of_sample([0, 0], [1, 2]) == (0, 0)


def test_parts_by_name():
    assert relative_l2_by_name({"a": (1.0, 4.0), "b": (3.0, 12.0)}) == {"a": 0.5, "b": 0.5, "total": 0.5}
    assert relative_l2_by_name({"a": (0.0, 0.0), "b": (9.0, 1.0)})["total"] == 3


def test_rows_in_the_dark_have_no_huge_errors():
    errors = relative_l2_of_rows(np.array([1e-12, 0.04, 0.0]), np.array([0.0, 1.0, 1.0]))
    np.testing.assert_allclose(errors, [np.sqrt(1e-12 / (1e-3 * 2 / 3)), 0.2, 0])


def test_worst_rows():
    found = worst_rows(np.arange(101) / 100, np.arange(101) + 7, "vertex")
    assert found == {"95th_percentile": pytest.approx(0.95), "max": 1, "vertex": 107}


def test_standard_error_of_a_sample_is_the_spread_of_samples():
    """1000 samples of 300 rows: the mean standard error against the spread of the errors, within 10% (4 sigma: 9%)."""
    rng = np.random.default_rng(0)
    norms = rng.uniform(1, 3, (1000, 300))
    squares = norms * rng.gamma(2, 0.01, norms.shape) * (rng.random(norms.shape) > 0.25)
    found = np.array([relative_l2_of_sample(e, n) for e, n in zip(squares, norms, strict=True)])
    assert found[0, 0] == pytest.approx(np.sqrt(squares[0].sum() / norms[0].sum()))
    assert found[:, 1].mean() == pytest.approx(found[:, 0].std(), rel=0.1)


@pytest.mark.parametrize("channels", [1, 3])
def test_noise_of_the_halves_is_taken_out(channels):
    """Noise is the same in all of three channels, or independent.

    Expected: of equal images, an error below the uncertainty in 93 of 100 cases or more, and an uncertainty that is not
    far too large either; a true error of 10% comes out, whether the estimate is noisy as well or not.
    """
    rng = np.random.default_rng(0)
    truth = rng.random((60, 80, 3)) + 0.5

    def noisy() -> np.ndarray:
        return truth + 0.1 * rng.standard_normal((60, 80, channels))

    found = []
    for _ in range(100):
        a, b, x, y = (noisy() for _ in range(4))
        found.append(relative_l2_without_noise(a, x, y, b))
    error, uncertainty = np.transpose(found)
    assert (error < uncertainty).mean() > 0.93
    assert 2 * np.sqrt((error**2).mean()) > 0.5 * uncertainty.mean()
    assert uncertainty.max() < 0.04
    for estimates in ((1.1 * a, 1.1 * b), (1.1 * truth, None)):
        assert relative_l2_without_noise(estimates[0], x, y, estimates[1])[0] == pytest.approx(0.1, rel=0.1)
    assert relative_l2_without_noise(1.1 * truth, truth, truth) == (pytest.approx(0.1), 0)


def test_noise_of_the_mean_of_two_halves():
    """Expected: noise of 10% in each half leaves 7.1% in their mean, within 1% (15,000 values)."""
    rng = np.random.default_rng(0)
    truth = np.ones((50, 100, 3))
    x, y = truth + 0.1 * rng.standard_normal((2, 50, 100, 3))
    assert relative_noise(x, y) == pytest.approx(0.1 / np.sqrt(2), rel=0.02)


def test_flip_of_images():
    """Expected: 0 where images are equal, more where they differ; negative values are black; shapes of the image."""
    truth = np.random.default_rng(0).random((24, 32, 3)).astype(np.float32)
    wrong = truth.copy()
    wrong[:, 16:] = 1 - wrong[:, 16:]
    found = flip_map(truth, wrong)
    assert found.shape == (24, 32) and found.dtype == np.float32
    assert found[:, :8].max() < 0.02 < found[:, 24:].mean() <= 1
    black = np.zeros_like(truth)
    np.testing.assert_array_equal(flip_map(truth, black - 1), flip_map(truth, black))
