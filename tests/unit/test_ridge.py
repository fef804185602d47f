"""Ridge regression towards known weights: against the formula on the samples themselves, and what it must never do."""

import numpy as np
import pytest

from mi_sparse_prt.reconstruction.ridge import (
    RidgeOptions,
    System,
    choose_deviation,
    fit_correction,
    shift_to_prior,
)

N, K, S = 400, 5, 60
DEVIATIONS = RidgeOptions().deviations


def samples(
    scatter: float, noise: float, seed: int = 0
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Columns A (n, s, k), prior and true weights (n, k), and samples y (n, s) of the true ones."""
    rng = np.random.default_rng(seed)
    A = 1 + 0.5 * rng.normal(size=(N, S, K))
    prior = np.full((N, K), 1 / K)
    true = prior + scatter * rng.normal(size=(N, K))
    y = np.einsum("nsk,nk->ns", A, true) + noise * rng.normal(size=(N, S))
    return A, prior, true, y


def system(A: np.ndarray, prior: np.ndarray, y: np.ndarray) -> System:
    gram, slope = np.einsum("nsi,nsj->nij", A, A), np.einsum("nsk,ns->nk", A, y)
    return shift_to_prior(prior, gram, slope, (y**2).sum(axis=1), np.full(len(y), y.shape[1]))


def halves(A: np.ndarray, prior: np.ndarray, y: np.ndarray) -> tuple[System, System]:
    return system(A[:, ::2], prior, y[:, ::2]), system(A[:, 1::2], prior, y[:, 1::2])


def test_it_solves_the_augmented_least_squares_problem():
    """min ||A a - y||^2 / noise + ||a - prior||^2 / tau^2, by NumPy on stacked equations."""
    A, prior, _, y = samples(0.1, 0.3)
    one, other = halves(A, prior, y)
    ours = prior + fit_correction(one + other, np.full(N, 0.09), 0.1)
    for i in range(20):
        stacked = np.concatenate([A[i] / 0.3, np.eye(K) / 0.1])
        expected = np.linalg.lstsq(stacked, np.concatenate([y[i] / 0.3, prior[i] / 0.1]))[0]
        assert np.allclose(ours[i], expected, rtol=1e-8)


def test_halves_add_up():
    A, prior, _, y = samples(0.1, 0.3)
    one, other = halves(A, prior, y)
    whole, both = system(A, prior, y), one + other
    assert np.allclose(both.gram, whole.gram) and np.allclose(both.slope, whole.slope)
    assert np.allclose(both.square, whole.square) and (both.count == S).all()
    assert np.allclose(both.square, ((y - np.einsum("nsk,nk->ns", A, prior)) ** 2).sum(axis=1))


@pytest.mark.parametrize("scatter", DEVIATIONS)
def test_the_deviation_is_found(scatter):
    """The weights scatter by one of the candidates: it is found, or one beside it, and the weights get better."""
    noise = 5 * scatter
    A, prior, true, y = samples(scatter, noise)
    found = choose_deviation(halves(A, prior, y), np.full(N, noise**2))
    assert abs(DEVIATIONS.index(found) - DEVIATIONS.index(scatter)) <= 1
    corrected = prior + fit_correction(system(A, prior, y), np.full(N, noise**2), found)
    assert np.linalg.norm(corrected - true) < 0.8 * np.linalg.norm(prior - true)


@pytest.mark.parametrize("noise", [0.01, 1.0])
def test_right_weights_are_left_alone(noise):
    """Samples that only repeat what is known are not worth it, however many."""
    for seed in range(20):
        A, prior, _, y = samples(0.0, noise, seed)
        assert choose_deviation(halves(A, prior, y), np.full(N, noise**2)) == 0


def test_weights_stay_near_the_prior_where_samples_say_nothing():
    """Expected: no correction without samples, in the dark, and for noise without bounds; no NaN."""
    A, prior, _, y = samples(0.1, 0.3)
    assert np.abs(fit_correction(system(A, prior, y), np.full(N, 1e30), 0.04)).max() < 1e-20
    dark = system(0 * A, prior, 0 * y)
    for noise in (0.0, 1.0):
        assert (fit_correction(dark, np.full(N, noise), 0.04) == 0).all()
    assert choose_deviation((dark, dark), np.zeros(N)) == 0
    none = system(A[:0], prior[:0], y[:0])
    assert choose_deviation((none, none), np.zeros(0)) == 0


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_units_do_not_matter(scale):
    A, prior, _, y = samples(0.02, 0.1)
    noise = np.full(N, 0.01)
    ours = fit_correction(system(A, prior, y), noise, 0.02)
    scaled = fit_correction(system(A * scale, prior, y * scale), noise * scale**2, 0.02)
    assert np.allclose(ours, scaled, rtol=1e-6)


@pytest.mark.parametrize("noise", [0.0, 1e-12, 1.0])
def test_equal_columns_share_the_correction(noise):
    """Neighbours whose rows are the same (condition 1e16): bounded weights, and what samples ask for is met."""
    A, prior, _, _ = samples(0.0, 0.0)
    A[:] = A[:, :, :1]
    y = 1.3 * A[:, :, 0]
    delta = fit_correction(system(A, prior, y), np.full(N, noise), 0.04)
    assert np.isfinite(delta).all() and np.abs(delta).max() < 0.1
    if noise < 1:
        assert np.allclose(delta, 0.3 / K, rtol=1e-2)
