"""Noise taken out of low-rank matrices whose truth is known."""

import numpy as np
import pytest
import scipy.sparse
from numpy.typing import NDArray

from mi_sparse_prt.reconstruction.denoising import DenoisingOptions, denoise_rows, smooth_rows

R = 4
LONG = 600  # the longer side of matrices whose error is predicted


def truth(n: int, m: int, strength: float = 3.0, seed: int = 0) -> NDArray[np.float64]:
    """A matrix of rank 4 whose singular values are ``strength`` times 1, 2, 3, 4, in units of sqrt(max(n, m))."""
    rng = np.random.default_rng(seed)
    u, v = (np.linalg.qr(rng.normal(size=(k, R)))[0] for k in (n, m))
    return np.sqrt(max(n, m)) * strength * (u * np.arange(1, R + 1)) @ v.T


def noisy(
    clean: NDArray[np.float64], deviation: NDArray[np.float64] | float, seed: int = 1
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Estimates and the variance of each, noise being normal with a deviation that broadcasts to all elements."""
    deviation = np.broadcast_to(deviation, clean.shape)
    noise = np.random.default_rng(seed).normal(size=clean.shape) * deviation
    return (clean + noise).astype(np.float32), (deviation**2).astype(np.float32)


def denoised(rows: NDArray[np.float32], variance: NDArray[np.float32]) -> tuple[NDArray[np.float32], int]:
    """The matrix and its rank."""
    found = denoise_rows(rows, variance)
    return found.matrix(), found.rank


def error(a: NDArray, b: NDArray) -> float:
    return float(np.linalg.norm(a.astype(np.float64) - b))


def predicted(strength: float, beta: float) -> float:
    """Squared error after over before, as Gavish and Donoho (2017) have it for large matrices.

    A singular value x appears as y = sqrt((x + 1/x)(x + beta/x)) and is shrunk to eta; x^2 - eta^2 is left. What
    noise there was had beta LONG in these units.
    """
    x = strength * np.arange(1, R + 1)
    y2 = (x + 1 / x) * (x + beta / x)
    eta2 = ((y2 - beta - 1) ** 2 - 4 * beta) / y2
    return float((x**2 - eta2).sum() / (beta * LONG))


@pytest.mark.parametrize("strength", [1.5, 3, 30])
@pytest.mark.parametrize(("n", "m"), [(600, 300), (300, 600), (600, 600), (600, 40)])
def test_the_error_falls_as_predicted(n, m, strength):
    """Noise of deviation 1 on rank 4: the squared error falls to about 4 (1 + beta) / 600 beta of what it was."""
    clean = truth(n, m, strength)
    rows, variance = noisy(clean, 1.0)
    ours, rank = denoised(rows, variance)
    assert ours.dtype == np.float32
    assert ours.shape == rows.shape
    assert R <= rank <= R + 1
    beta = min(n, m) / max(n, m)
    assert (error(ours, clean) / error(rows, clean)) ** 2 == pytest.approx(
        predicted(strength, beta), rel=0.15
    )


def test_it_is_shrinkage_and_not_a_cut():
    """Close to the threshold, keeping the four largest singular values as they are is worse."""
    clean = truth(400, 400, 1.2)
    rows, variance = noisy(clean, 1.0)
    ours, _ = denoised(rows, variance)
    u, s, vt = np.linalg.svd(rows.astype(np.float64), full_matrices=False)
    assert error(ours, clean) < 0.9 * error((u[:, :R] * s[:R]) @ vt[:R], clean)


def test_against_the_singular_values_of_numpy():
    """Formula (7) of the paper on the singular value decomposition itself, in float64."""
    for n, m in ((120, 70), (70, 120), (50, 50)):
        rows, variance = noisy(truth(n, m, 2), 0.5)
        u, s, vt = np.linalg.svd(rows.astype(np.float64) / 0.5, full_matrices=False)
        long, beta = max(n, m), min(n, m) / max(n, m)
        y2 = s**2 / long
        eta = np.sqrt(np.maximum((y2 - beta - 1) ** 2 - 4 * beta, 0) / y2)
        eta[y2 <= (1 + np.sqrt(beta)) ** 2] = 0
        expected = 0.5 * (u * eta * np.sqrt(long)) @ vt
        ours, rank = denoised(rows, variance)
        assert rank == (eta > 0).sum()
        assert error(ours, expected) < 1e-4 * np.linalg.norm(expected)


def test_wide_and_tall_are_transposes():
    rows, variance = noisy(truth(200, 90), 1.0)
    tall, tall_rank = denoised(rows, variance)
    wide, wide_rank = denoised(np.ascontiguousarray(rows.T), np.ascontiguousarray(variance.T))
    assert tall_rank == wide_rank
    assert error(wide.T, tall) < 1e-5 * np.linalg.norm(tall)


def test_without_noise_nothing_changes():
    """One path per element: its variance is not known, and the estimates are all there is."""
    rows = np.random.default_rng(0).random((20, 30)).astype(np.float32)
    ours, _ = denoised(rows, np.zeros_like(rows))
    assert np.array_equal(ours, rows)


def test_noise_that_is_too_small_to_matter_changes_nothing():
    clean = truth(80, 50)
    rows, variance = noisy(clean, 1e-6)
    ours, _ = denoised(rows, variance)
    assert error(ours, rows) < 1e-5 * np.linalg.norm(rows)


@pytest.mark.parametrize(("n", "m"), [(300, 200), (200, 300), (300, 20)])
def test_pure_noise_is_dropped(n, m):
    for seed in range(5):
        rows, variance = noisy(np.zeros((n, m)), 1.0, seed)
        ours, rank = denoised(rows, variance)
        assert rank <= 2  # the largest one may rise above its limit for large matrices
        assert np.linalg.norm(ours) < 0.1 * np.linalg.norm(rows)


def test_rows_of_different_noise():
    """Deviations from 0.03 to 30: rows count by what they know. Better than taking all for equally noisy, in every
    row that is not the noisiest, and good rows are not spoilt.
    """
    deviation = np.geomspace(0.03, 30, 300)[:, None]
    clean = truth(300, 200, 3)
    rows, variance = noisy(clean, deviation)
    ours, rank = denoised(rows, variance)
    blind, _ = denoised(rows, np.full_like(variance, variance.mean()))
    assert R <= rank <= R + 2
    assert error(ours, clean) < 0.2 * error(rows, clean)
    assert error(ours, clean) < 0.8 * error(blind, clean)
    best, worst = slice(0, 100), slice(200, 300)
    assert error(ours[best], clean[best]) < error(rows[best], clean[best])
    assert error(ours[worst], clean[worst]) < 0.2 * error(rows[worst], clean[worst])


def test_a_row_without_noise_is_kept():
    """Dense vertices in the open, which meet nothing but the sky or one even wall, have no variance at all."""
    clean = truth(100, 60)
    deviation = np.ones((100, 1))
    deviation[[3, 50]] = 0
    rows, variance = noisy(clean, deviation)
    ours, _ = denoised(rows, variance)
    assert np.isfinite(ours).all()
    assert error(ours[[3, 50]], clean[[3, 50]]) < 0.01 * np.linalg.norm(clean[[3, 50]])
    assert error(ours, clean) < 0.5 * error(rows, clean)


def test_dark_rows_stay_dark():
    clean = truth(100, 60)
    clean[10:40] = 0
    deviation = np.ones((100, 1))
    deviation[10:40] = 0
    ours, _ = denoised(*noisy(clean, deviation))
    assert np.abs(ours[10:40]).max() < 1e-3 * np.abs(clean).max()


def test_all_zero():
    zero = np.zeros((30, 20), np.float32)
    for variance in (zero, zero + 1):
        ours, _ = denoised(zero, variance)
        assert np.array_equal(ours, zero)


@pytest.mark.parametrize("shape", [(0, 5), (5, 0), (0, 0), (1, 1), (1, 50), (50, 1), (2, 2)])
def test_small_shapes(shape):
    rows = np.random.default_rng(0).random(shape).astype(np.float32)
    for variance in (np.zeros_like(rows), np.full_like(rows, 1e-6)):
        ours, _ = denoised(rows, variance)
        assert ours.shape == shape
        assert np.isfinite(ours).all()
        assert error(ours, rows) <= 0.02 * np.linalg.norm(rows)


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1e3, 1e6])
def test_units_do_not_matter(scale):
    clean = truth(120, 80)
    one, rank = denoised(*noisy(clean, 1.0))
    other, other_rank = denoised(*noisy(clean * scale, scale))
    assert rank == other_rank
    assert error(other / scale, one) < 1e-4 * np.linalg.norm(one)


@pytest.mark.filterwarnings("error")
def test_never_nan():
    """Signals and noises of all sizes, zeros among them, in all shapes."""
    rng = np.random.default_rng(5)
    for _ in range(60):
        n, m = rng.integers(1, 30, 2)
        deviation = 10.0 ** rng.integers(-8, 8, (n, 1)) * (rng.random((n, 1)) < 0.7)
        clean = 10.0 ** rng.integers(-8, 8, (n, 1)) * rng.random((n, m)) * (rng.random((n, 1)) < 0.7)
        ours, rank = denoised(*noisy(clean, deviation, int(rng.integers(1000))))
        assert np.isfinite(ours).all()
        assert 0 <= rank <= min(n, m)


def test_arguments_stay_as_they_are():
    rows, variance = noisy(truth(40, 30), 1.0)
    copies = rows.copy(), variance.copy()
    denoised(rows, variance)
    assert np.array_equal(rows, copies[0])
    assert np.array_equal(variance, copies[1])


def smoothing(n: int) -> scipy.sparse.csr_array:
    """The mean of each row and its two neighbours on a ring."""
    ring = sum(np.roll(np.eye(n), k, axis=1) for k in (-1, 0, 1)) / 3
    return scipy.sparse.csr_array(ring.astype(np.float32))


def on_a_ring(n: int, m: int, steps: int) -> NDArray[np.float64]:
    """Rows that turn smoothly around a ring, and jump at some places."""
    angle = 2 * np.pi * np.arange(n)[:, None] / n
    clean = 3 + np.sin(angle + np.linspace(0, 3, m)) + np.cos(2 * angle) * np.linspace(-1, 1, m)
    for k in range(steps):
        clean[n * k // steps : n * k // steps + 2] *= 1.5 + k
    return clean


def test_smooth_rows_are_smoothed():
    """A mean of three has 0.58 of the noise; not knowing that rows are smooth costs some of that."""
    clean = on_a_ring(300, 80, 0)
    found = denoise_rows(*noisy(clean, 1.0))
    better = smooth_rows(found, smoothing(300))
    before, after = (error(x.matrix(), clean) for x in (found, better))
    assert after < 0.8 * before
    assert better.rank == found.rank


def test_what_is_local_survives_smoothing():
    """Rows that differ from their neighbours by more than noise: smoothing alone would ruin them."""
    clean = on_a_ring(300, 80, 6)
    found = denoise_rows(*noisy(clean, 0.1))
    plain = (smoothing(300) @ found.left) @ found.right
    ours = smooth_rows(found, smoothing(300)).matrix()
    assert error(ours, clean) < 1.02 * error(found.matrix(), clean)
    assert error(ours, clean) < 0.1 * error(plain, clean)


def test_the_noise_of_rows_is_known():
    """What ``smooth_rows`` compares with: noise in rows of ``left``, that is within the true span of rows."""
    clean = truth(400, 300, 4)
    span = np.linalg.svd(clean)[2][:R].T
    deviation = np.geomspace(0.5, 2, 400)[:, None]
    found, expected = np.zeros(400), np.zeros(400)
    for seed in range(8):
        run = denoise_rows(*noisy(clean, deviation, seed))
        found += (((run.matrix() - clean) @ span) ** 2).sum(axis=1)
        expected += run.noise * (run.right**2).sum(axis=1).mean()
    for half in (slice(0, 200), slice(200, 400)):
        # 8 runs of 200 rows of 4 values: a standard error of sqrt(2 / 6400), 1.8%; shrinking adds a bias of its own
        assert found[half].sum() / expected[half].sum() == pytest.approx(1, abs=0.1)


def test_without_noise_nothing_is_smoothed():
    rows = np.random.default_rng(0).random((30, 20)).astype(np.float32)
    found = smooth_rows(denoise_rows(rows, np.zeros_like(rows)), smoothing(30))
    assert np.array_equal(found.matrix(), rows)


def test_smoothing_rows_some_of_which_have_no_noise():
    """Dark vertices beside others: nothing to compare with, and nothing to divide by."""
    clean = on_a_ring(120, 40, 0)
    clean[40:80] = 0
    deviation = np.ones((120, 1))
    deviation[40:80] = 0
    found = smooth_rows(denoise_rows(*noisy(clean, deviation)), smoothing(120))
    assert np.isfinite(found.matrix()).all()
    assert np.abs(found.matrix()[45:75]).max() < 1e-2 * np.abs(clean).max()


def test_many_values_above_the_noise_are_found_exactly():
    """The sketch gives up when it is full."""
    rows, variance = noisy(truth(600, 300, 3), 1.0)
    sketched = denoise_rows(rows, variance)
    exact = denoise_rows(rows, variance, DenoisingOptions(sketch=R))
    assert sketched.rank >= R
    assert exact.rank >= sketched.rank
    assert error(sketched.matrix(), exact.matrix()) < 1e-2 * np.linalg.norm(exact.matrix())
