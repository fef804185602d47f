"""Weights by l1 and by least squares against each other, other libraries, and plain formulas in A and y."""

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from interior_point import interior_point_fit
from sklearn.linear_model import Lasso

from mi_sparse_prt.benchmark.least_squares import least_squares_fit
from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.reconstruction.l1 import Fit, l1_fit


def products(A: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of A (m, n, k) and y (m, n), in double precision."""
    A, y = np.float64(A), np.float64(y)
    return np.matmul(A.transpose(0, 2, 1), A), np.einsum("mnk,mn->mk", A, y), (y * y).sum(axis=1)


def visibility(m: int, k: int = 30, n: int = 350, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """What neighbouring vertices see: one pattern of which each flips a few entries. (m, n, k) and (m, n)."""
    rng = np.random.default_rng(seed)
    pattern = rng.random((m, n, 1)) < 0.5
    seen = pattern ^ (rng.random((m, n, k + 1)) < 0.12 * rng.random((m, 1, k + 1)))
    return seen[..., :k].astype(np.float64), seen[..., k].astype(np.float64)


def by_definition(A: np.ndarray, y: np.ndarray, a: np.ndarray, relative_lambda: float) -> tuple[float, float]:
    """Objective and duality gap of one problem, from A and y alone ([KKL07] III)."""
    lam = relative_lambda * np.abs(2 * A.T @ y).max()
    z = A @ a - y
    slope = np.abs(2 * A.T @ z).max()
    nu = 2 * z * (min(1.0, lam / slope) if slope > 0 else 1.0)
    objective = z @ z + lam * np.abs(a).sum()
    return objective, objective - (-nu @ nu / 4 - nu @ y)


def awkward(kind: str, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """One problem, A (n, k) and y (n,)."""
    n, k = (int(x) for x in rng.integers(1, 13, 2))
    A, y = rng.normal(size=(n, k)), rng.normal(size=n)
    if kind == "duplicates":
        A = A[:, rng.integers(0, k, k)]
    elif kind == "near duplicates":
        A = A[:, :1] + rng.choice([1e-12, 1e-7, 1e-3]) * A
    elif kind == "zeros":
        A[:, rng.random(k) < 0.5] = 0
        y *= rng.random() < 0.5
    elif kind == "scales":
        A *= 10.0 ** rng.uniform(-6, 6, k)
        y *= 10.0 ** rng.uniform(-6, 6)
    elif kind == "constant":
        A[:, 0] = 1
    elif kind == "binary":
        A, y = np.round(rng.random((n, k))), np.round(rng.random(n))
    elif kind == "explained":
        y = A @ rng.normal(size=k)
    return A, y


KINDS = ("plain", "duplicates", "near duplicates", "zeros", "scales", "constant", "binary", "explained")
problems = st.builds(
    lambda kind, seed: awkward(kind, np.random.default_rng(seed)),
    st.sampled_from(KINDS),
    st.integers(0, 2**32 - 1),
)


def fit_one(A: np.ndarray, y: np.ndarray, *options: object, **named: object) -> Fit:
    return l1_fit(*products(A[None], y[None]), *options, **named)


@settings(max_examples=300, deadline=None)
@given(problems, st.sampled_from([1e-4, 1e-2, 0.3, 1.0, 2.0]))
def test_any_problem_is_solved(problem, relative_lambda):
    A, y = problem
    s, lam = y @ y, relative_lambda * np.abs(2 * A.T @ y).max()
    fit = fit_one(A, y, relative_lambda)
    a = fit.weights[0]
    assert np.isfinite(a).all()
    assert (a[(A == 0).all(axis=0)] == 0).all()
    assert lam * np.abs(a).sum() <= s * (1 + 1e-9)
    assert fit.gap[0] <= 1e-6 * s
    if relative_lambda >= 1 or s == 0:
        assert (a == 0).all()
    objective, gap = by_definition(A, y, a, relative_lambda)
    assert fit.objective[0] == pytest.approx(objective, abs=1e-7 * s)
    assert gap <= 2e-6 * s


@settings(max_examples=60, deadline=None)
@given(problems, st.sampled_from([1e-3, 1e-2, 0.3]))
def test_the_two_solvers_agree(problem, relative_lambda):
    A, y = problem
    one = fit_one(A, y, relative_lambda)
    other = interior_point_fit(*products(A[None], y[None]), relative_lambda)
    assert np.isfinite(other.weights).all()
    assert other.gap[0] <= 1e-6 * (y @ y)
    assert abs(one.objective[0] - other.objective[0]) <= 2e-6 * (y @ y)


@settings(max_examples=150, deadline=None)
@given(problems)
def test_without_penalty_it_is_least_squares(problem):
    """Expected: unit columns correlate with the residual by 1e-6 ||y|| at most. In a direction of singular value sigma,
    k of these may leave out k (1e-6 / sigma)^2 of ||y||^2; singular values below 1e-5 are lost in a Gram matrix.
    """
    A, y = problem
    fit = fit_one(A, y, 0.0)
    assert np.isfinite(fit.weights).all()
    assert (fit.weights[:, (A == 0).all(axis=0)] == 0).all()
    unit = A / np.where((A == 0).all(axis=0), 1, np.linalg.norm(A, axis=0))  # the fit does not depend on it
    left, sigma, _ = np.linalg.svd(unit, full_matrices=False)
    known = sigma > 1e-5 * sigma.max()
    least = y @ y - np.square(left[:, known].T @ y).sum()
    slack = 1e-6 + unit.shape[1] * (1e-6 / sigma[known].min(initial=np.inf)) ** 2
    assert fit.objective[0] <= least + slack * (y @ y)


@settings(max_examples=100, deadline=None)
@given(problems, st.integers(0, 2**32 - 1))
def test_order_of_unknowns_and_units_do_not_matter(problem, seed):
    A, y = problem
    s = y @ y
    fit = fit_one(A, y)
    order = np.random.default_rng(seed).permutation(A.shape[1])
    assert fit_one(A[:, order], y).objective[0] == pytest.approx(fit.objective[0], abs=2e-6 * s)
    larger = fit_one(A * 2.0**10, y * 2.0**10)
    assert np.array_equal(larger.weights, fit.weights)
    odd = fit_one(A * 3e-7, y * 3e-7)
    assert odd.objective[0] / 9e-14 == pytest.approx(fit.objective[0], abs=2e-6 * s)


def test_rescaling_leaves_the_weights():
    A, y = visibility(20)
    plain = l1_fit(*products(A, y)).weights
    for c in (1e-6, 7.3, 1e6):
        np.testing.assert_allclose(l1_fit(*products(c * A, c * y)).weights, plain, rtol=1e-6, atol=1e-9)


def test_batch_position_padding_and_threads_change_no_bit():
    """60 problems, alone, backwards, padded by 5 unknowns in front and behind, and on one thread."""
    A, y = visibility(60, k=12, n=50)
    G, r, s = products(A, y)
    fit = l1_fit(G, r, s)
    alone = np.concatenate([l1_fit(G[i : i + 1], r[i : i + 1], s[i : i + 1]).weights for i in range(len(s))])
    assert np.array_equal(alone, fit.weights)
    assert np.array_equal(l1_fit(G[::-1], r[::-1], s[::-1]).weights[::-1], fit.weights)
    padded = l1_fit(np.pad(G, ((0, 0), (5, 5), (5, 5))), np.pad(r, ((0, 0), (5, 5))), s).weights
    assert np.array_equal(padded[:, 5:-5], fit.weights)
    assert not padded[:, :5].any() and not padded[:, -5:].any()
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        assert np.array_equal(l1_fit(G, r, s).weights, fit.weights)
    finally:
        numba.set_num_threads(threads)


@pytest.mark.parametrize("relative_lambda", [1e-1, 1e-2, 1e-3])
def test_neighbouring_visibility(relative_lambda):
    """The problems that the package has: solved, sparse, in fewer steps than twice the unknowns."""
    A, y = visibility(200)
    fit = l1_fit(*products(A, y), relative_lambda)
    assert (fit.gap <= 1e-6 * (y * y).sum(axis=1)).all()
    assert fit.iterations.max() <= 60
    gaps = [by_definition(*problem, relative_lambda)[1] for problem in zip(A, y, fit.weights, strict=True)]
    assert max(gaps) <= 1.1e-6 * (y * y).sum(axis=1).max()


def test_single_precision():
    """Counts are exact in float32; a matrix that is rounded, and so may be indefinite, gives nearly the same."""
    A, y = visibility(50)
    for scale in (1.0, 0.3):
        G, r, s = products(scale * A, scale * y)
        exact, rounded = l1_fit(G, r, s), l1_fit(np.float32(G), np.float32(r), np.float32(s))
        assert rounded.weights.dtype == np.float64
        np.testing.assert_allclose(rounded.objective, exact.objective, atol=1e-5 * s.max())
    twins = np.repeat(np.random.default_rng(1).normal(size=(300, 20, 5)), 6, axis=2)
    G, r, s = products(twins, np.random.default_rng(2).normal(size=(300, 20)))
    fit = l1_fit(np.float32(G), np.float32(r), np.float32(s), 1e-6)
    assert (fit.gap <= 1e-5 * s).all()


def test_sklearn_agrees():
    rng = np.random.default_rng(0)
    A, y = rng.normal(size=(20, 40, 15)), rng.normal(size=(20, 40))
    fit = l1_fit(*products(A, y), 0.05, tolerance=1e-12)
    for i in range(len(A)):
        alpha = 0.05 * np.abs(2 * A[i].T @ y[i]).max() / (2 * A.shape[1])
        theirs = Lasso(alpha, fit_intercept=False, tol=1e-12, max_iter=100_000).fit(A[i], y[i])
        np.testing.assert_allclose(fit.weights[i], theirs.coef_, atol=1e-5)


@pytest.mark.parametrize("k", [1, 2, 5])
def test_orthogonal_columns_are_shrunk(k):
    """The closed form: each weight by lambda / 2 towards 0."""
    A = np.linalg.qr(np.random.default_rng(k).normal(size=(8, k)))[0]
    y = np.random.default_rng(k + 9).normal(size=8)
    r = A.T @ y
    half = 0.3 * np.abs(r).max()
    expected = np.sign(r) * np.maximum(np.abs(r) - half, 0)
    np.testing.assert_allclose(fit_one(A, y, 0.3, tolerance=1e-14).weights[0], expected, atol=1e-12)
    found = interior_point_fit(*products(A[None], y[None]), 0.3, tolerance=1e-10).weights[0]
    np.testing.assert_allclose(found, expected, atol=1e-4)


@pytest.mark.parametrize("relative_lambda", [0.0, 1e-2])
def test_what_is_no_gram_matrix_stays_bounded(relative_lambda):
    """Indefinite matrices, correlations that no y has."""
    rng = np.random.default_rng(3)
    G = rng.normal(size=(500, 6, 6)) * 10.0 ** rng.uniform(-6, 6, (500, 1, 1))
    r, s = rng.normal(size=(500, 6)) * 10.0 ** rng.uniform(-6, 6, (500, 1)), rng.random(500)
    fit = l1_fit(G + G.transpose(0, 2, 1), r, s, relative_lambda)
    assert all(np.isfinite(x).all() for x in vars(fit).values())
    assert np.isfinite(least_squares_fit(G + G.transpose(0, 2, 1), r, s).weights).all()


@settings(max_examples=150, deadline=None)
@given(problems)
def test_least_squares(problem):
    A, y = problem
    s, used = y @ y, (A != 0).any(axis=0)
    fit = least_squares_fit(*products(A[None], y[None]))
    a = fit.weights[0]
    assert np.isfinite(a).all() and (a[~used] == 0).all()
    z = A @ a - y
    values = np.linalg.svd(A, compute_uv=False)
    resolved = (
        values.min() > 1e-5 * values.max()
    )  # else rounding of the Gram matrix shows, times large weights
    if resolved:
        assert fit.objective[0] == pytest.approx(z @ z, abs=1e-4 * s)
        np.testing.assert_allclose(a, np.linalg.pinv(A) @ y, rtol=1e-3, atol=1e-3 * np.abs(a).max(initial=0))


def test_of_equal_columns_least_squares_takes_equal_shares():
    A = np.array([[[1.0, 1.0], [2.0, 2.0]]])
    np.testing.assert_allclose(least_squares_fit(*products(A, np.array([[1.0, 2.0]]))).weights, [[0.5, 0.5]])


@pytest.mark.parametrize(("m", "k"), [(0, 5), (3, 0), (0, 0)])
def test_nothing_to_solve(m, k):
    empty = np.zeros((m, k, k)), np.zeros((m, k)), np.ones(m)
    for fit in (l1_fit(*empty), interior_point_fit(*empty), least_squares_fit(*empty)):
        assert fit.weights.shape == (m, k)
        assert np.array_equal(fit.objective, np.ones(m))


@pytest.mark.parametrize("which", [0, 1, 2])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("solve", [l1_fit, least_squares_fit])
def test_what_is_not_finite_is_named(solve, which, value):
    arrays = [np.array(x) for x in products(*visibility(4, k=3, n=10))]
    arrays[which][(2,) + (1,) * (arrays[which].ndim - 1)] = value
    with pytest.raises(PrtError, match="problem 2") as error:
        solve(*arrays)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("named", "message"),
    [
        ({"relative_lambda": -1.0}, "relative_lambda"),
        ({"relative_lambda": np.nan}, "relative_lambda"),
        ({"tolerance": 0.0}, "tolerance"),
        ({"most_steps": 0}, "most_steps"),
        ({"squared_norm": np.ones(3)}, "do not match"),
        ({"correlation": np.ones(2)}, "do not match"),
        ({"squared_norm": -np.ones(2)}, "problem 0"),
    ],
)
def test_options_that_cannot_be(named, message):
    arrays = dict(zip(("gram", "correlation", "squared_norm"), products(*visibility(2, k=3)), strict=True))
    with pytest.raises(PrtError, match=message):
        l1_fit(**(arrays | named))
