"""Sparse weights: two solvers and outside ones agree, hostile systems stay finite, and a batch is only a batch."""

import numba
import numpy as np
import pytest
import scipy.optimize
from hypothesis import given, settings
from hypothesis import strategies as st

from mi_sparse_prt.errors import PrtError
from mi_sparse_prt.reconstruction.l1 import Fit, l1_fit, least_squares_fit

FEW = settings(max_examples=40, deadline=None)


def gram(A: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """G, r, s of problems A (m, n, k), y (m, n)."""
    transposed = A.swapaxes(1, 2)
    return transposed @ A, (transposed @ y[..., None])[..., 0], (y**2).sum(axis=1)


def visibility(m: int, k: int = 30, n: int = 350, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Rows of neighbouring vertices: bits on one side of nearly the same edges, correlated by about 0.9."""
    rng = np.random.default_rng(seed)
    place = rng.random((m, n, 2))
    across = rng.normal(size=(m, 1, k + 1, 2)) * 0.1 + np.array([1, 0.3])
    edge = rng.normal(size=(m, 1, k + 1)) * 0.05 + 0.65
    seen = (np.einsum("mnd,mokd->mnk", place, across) < edge).astype(np.float64)
    return seen[..., :k], seen[..., k]


def objective(A, y, weights, relative_lambda):
    penalty = relative_lambda * 2 * np.abs(np.einsum("mnk,mn->mk", A, y)).max(axis=1)
    error = ((np.einsum("mnk,mk->mn", A, weights) - y) ** 2).sum(axis=1)
    return error + penalty * np.abs(weights).sum(axis=1)


def assert_sound(fit: Fit, problems: tuple, relative_lambda: float) -> None:
    G, r, s = (np.asarray(x, dtype=np.float64) for x in problems)
    for array in (fit.weights, fit.objective, fit.gap):
        assert array.dtype == np.float64 and np.isfinite(array).all()
    assert (fit.objective >= 0).all() and (fit.gap >= 0).all()
    assert (fit.objective <= s * (1 + 1e-6)).all()  # no worse than nothing
    assert (fit.weights[np.einsum("mii->mi", G) == 0] == 0).all()
    penalty = relative_lambda * 2 * np.abs(r).max(axis=1)
    assert (penalty * np.abs(fit.weights).sum(axis=1) <= s * (1 + 1e-6)).all()


@st.composite
def hostile(draw):
    """Two problems of odd shapes: repeated, nearly repeated, empty, constant columns, lengths from 1e-6 to 1e6."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    n, k = draw(st.integers(1, 12)), draw(st.integers(1, 8))
    A, y = rng.normal(size=(2, n, k)), rng.normal(size=(2, n))
    for column in range(k):
        kind = draw(
            st.sampled_from(["random", "random", "repeated", "nearly", "empty", "constant", "bits", "target"])
        )
        if kind in ("repeated", "nearly"):
            A[..., column] = A[..., 0]
            A[..., column] += (kind == "nearly") * 1e-12 * rng.normal(size=(2, n))
        elif kind in ("empty", "constant"):
            A[..., column] = float(kind == "constant")
        elif kind == "bits":
            A[..., column] = rng.random((2, n)) < 0.5
        elif kind == "target":
            A[..., column] = y
    if draw(st.booleans()):  # units that differ between columns
        A *= 10 ** rng.uniform(-6, 6, size=(1, 1, k))
    if draw(st.booleans()):  # and between problems
        A *= 10 ** rng.uniform(-6, 6, size=(2, 1, 1))
        y *= 10 ** rng.uniform(-6, 6, size=(2, 1))
    if draw(st.integers(0, 5)) == 0:
        y[0] = 0
    return A, y


@FEW
@given(hostile(), st.sampled_from([0.0, 1e-6, 1e-3, 1e-2, 0.3]), st.booleans(), st.booleans())
def test_hostile_systems_stay_finite_and_bounded(system, relative_lambda, non_negative, single):
    dtype = np.float32 if single else np.float64
    problems = tuple(x.astype(dtype) for x in gram(*system))
    fit = l1_fit(*problems, relative_lambda, non_negative=non_negative)
    assert_sound(fit, problems, relative_lambda)
    if non_negative:
        assert (fit.weights >= 0).all()
    if not single and relative_lambda >= 1e-3:
        assert (fit.gap <= 1e-6 * problems[2]).all()


@FEW
@given(hostile(), st.sampled_from([1e-3, 1e-2, 0.3]))
def test_the_two_solvers_agree_on_hostile_systems(system, relative_lambda):
    problems = gram(*system)
    fast = l1_fit(*problems, relative_lambda)
    reference = l1_fit(*problems, relative_lambda, solver="interior_point")
    assert_sound(reference, problems, relative_lambda)
    assert (np.abs(fast.objective - reference.objective) <= 1e-4 * problems[2]).all()


@FEW
@given(hostile(), st.sampled_from([1e-2, 0.3]), st.floats(-4, 4))
def test_units_do_not_matter(system, relative_lambda, exponent):
    A, y = system
    c = 10**exponent
    here = l1_fit(*gram(A, y), relative_lambda)
    scaled = l1_fit(*gram(c * A, c * y), relative_lambda)
    np.testing.assert_allclose(scaled.objective / c**2, here.objective, rtol=0, atol=3e-6 * (y**2).sum())
    doubled = l1_fit(*gram(4 * A, 4 * y), relative_lambda)  # without rounding: exactly
    np.testing.assert_array_equal(doubled.weights, here.weights)


@FEW
@given(hostile(), st.sampled_from([1e-2, 0.3]), st.randoms(use_true_random=False))
def test_the_order_of_unknowns_does_not_matter(system, relative_lambda, random):
    A, y = system
    order = random.sample(range(A.shape[2]), A.shape[2])
    here, there = (l1_fit(*gram(B, y), relative_lambda) for B in (A, A[..., order]))
    assert (np.abs(here.objective - there.objective) <= 3e-6 * (y**2).sum(axis=1)).all()


@FEW
@given(hostile(), st.sampled_from([0.0, 1e-3]), st.booleans())
def test_least_squares_is_finite_for_any_system(system, ridge, single):
    dtype = np.float32 if single else np.float64
    G, r, s = (x.astype(dtype) for x in gram(*system))
    fit = least_squares_fit(G, r, s, ridge)
    assert np.isfinite(fit.weights).all() and np.isfinite(fit.objective).all()
    assert (fit.weights[np.einsum("mii->mi", G) == 0] == 0).all()


@pytest.mark.parametrize("solver", ["coordinate_descent", "interior_point"])
def test_objective_and_gap_are_what_they_say(solver):
    A, y = visibility(20)
    fit = l1_fit(*gram(A, y), 1e-2, solver)
    s = (y**2).sum(axis=1)
    np.testing.assert_allclose(fit.objective, objective(A, y, fit.weights, 1e-2), atol=1e-9 * s.max())
    assert (fit.gap <= 1e-6 * s).all()
    best = l1_fit(*gram(A, y), 1e-2, tolerance=1e-13).objective
    assert (fit.objective - fit.gap <= best + 1e-11 * s).all() and (best <= fit.objective + 1e-11 * s).all()


def test_visibility_gives_few_weights():
    A, y = visibility(50)
    nonzero = (l1_fit(*gram(A, y), 1e-2).weights != 0).sum(axis=1)
    assert 1 <= nonzero.min() and nonzero.mean() < 10


def test_against_scikit_learn():
    linear_model = pytest.importorskip("sklearn.linear_model")
    rng = np.random.default_rng(1)
    for non_negative in (False, True):
        A, y = rng.normal(size=(5, 40, 8)), rng.normal(size=(5, 40))
        fit = l1_fit(*gram(A, y), 0.1, tolerance=1e-12, non_negative=non_negative)
        for p in range(5):
            penalty = 0.1 * 2 * np.abs(A[p].T @ y[p]).max()
            alpha = penalty / (2 * len(y[p]))
            lasso = linear_model.Lasso(
                alpha, fit_intercept=False, tol=1e-12, max_iter=100000, positive=non_negative
            )
            np.testing.assert_allclose(fit.weights[p], lasso.fit(A[p], y[p]).coef_, atol=1e-6)


def test_non_negative_least_squares_against_scipy():
    rng = np.random.default_rng(2)
    A, y = rng.normal(size=(10, 20, 6)), rng.normal(size=(10, 20))
    fit = l1_fit(*gram(A, y), 0, tolerance=1e-10, non_negative=True)
    for p in range(10):
        np.testing.assert_allclose(fit.weights[p], scipy.optimize.nnls(A[p], y[p])[0], atol=1e-7)


@pytest.mark.parametrize(("n", "k"), [(20, 6), (4, 9), (5, 5), (7, 1)])
def test_least_squares_against_the_pseudoinverse(n, k):
    rng = np.random.default_rng(3)
    A, y = rng.normal(size=(6, n, k)), rng.normal(size=(6, n))
    fit = least_squares_fit(*gram(A, y))
    expected = np.stack([np.linalg.pinv(A[p]) @ y[p] for p in range(6)])
    np.testing.assert_allclose(fit.weights, expected, rtol=1e-6, atol=1e-6)
    ridge = 0.1 * (A**2).sum(axis=(1, 2)) / k
    expected = np.linalg.solve(
        A.swapaxes(1, 2) @ A + ridge[:, None, None] * np.eye(k), gram(A, y)[1][..., None]
    )
    np.testing.assert_allclose(
        least_squares_fit(*gram(A, y), 0.1).weights, expected[..., 0], rtol=1e-9, atol=1e-12
    )


def test_without_a_penalty_it_is_least_squares():
    rng = np.random.default_rng(4)
    A, y = rng.normal(size=(6, 20, 6)), rng.normal(size=(6, 20))
    descended = l1_fit(*gram(A, y), 0, tolerance=1e-10)
    np.testing.assert_allclose(descended.weights, least_squares_fit(*gram(A, y)).weights, atol=1e-8)


@pytest.mark.parametrize("relative_lambda", [1.0, 1.0 + 1e-12, 7.0])
@pytest.mark.parametrize("solver", ["coordinate_descent", "interior_point"])
def test_from_lambda_max_on_all_weights_are_zero(solver, relative_lambda):
    problems = gram(*visibility(20))
    fit = l1_fit(*problems, relative_lambda, solver)
    assert (fit.weights == 0).all()
    np.testing.assert_array_equal(fit.objective, problems[2])
    just_below = l1_fit(*problems, 0.99, tolerance=1e-9)
    assert (just_below.weights != 0).any(axis=1).all()


def test_one_column_has_a_closed_form():
    A, y = np.array([[[3.0], [4.0]]]), np.array([[1.0, 2.0]])
    assert l1_fit(*gram(A, y), 0.1, tolerance=1e-14).weights[0, 0] == pytest.approx(0.9 * 11 / 25, rel=1e-12)


@pytest.mark.parametrize("solver", ["coordinate_descent", "interior_point"])
def test_padding_and_neighbours_leave_no_trace(solver):
    G, r, s = gram(*visibility(6, k=7))
    alone = l1_fit(G, r, s, solver=solver)
    wide, long = np.zeros((6, 12, 12)), np.zeros((6, 12))
    at = np.array([0, 2, 3, 5, 8, 10, 11])
    wide[:, at[:, None], at], long[:, at] = G, r
    padded = l1_fit(wide, long, s, solver=solver)
    np.testing.assert_array_equal(padded.weights[:, at], alone.weights)
    assert (np.delete(padded.weights, at, axis=1) == 0).all()
    for p in (5, 0):
        one = l1_fit(G[p : p + 1], r[p : p + 1], s[p : p + 1], solver=solver)
        np.testing.assert_array_equal(one.weights[0], alone.weights[p])
        np.testing.assert_array_equal(one.gap[0], alone.gap[p])


def test_the_number_of_threads_leaves_no_trace():
    problems = gram(*visibility(40))
    threads = numba.get_num_threads()
    many = l1_fit(*problems)
    try:
        numba.set_num_threads(1)
        one = l1_fit(*problems)
    finally:
        numba.set_num_threads(threads)
    for a, b in zip(vars(many).values(), vars(one).values(), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("solve", [l1_fit, least_squares_fit])
def test_nothing_to_solve(solve):
    assert solve(np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros(0)).weights.shape == (0, 3)
    fit = solve(np.zeros((2, 0, 0)), np.zeros((2, 0)), np.array([1.0, 0.0]))
    assert fit.weights.shape == (2, 0) and fit.objective.tolist() == [1, 0]
    fit = solve(np.zeros((1, 3, 3), np.float32), np.zeros((1, 3), np.float32), np.ones(1, np.float32))
    assert (fit.weights == 0).all() and fit.objective[0] == 1


@pytest.mark.parametrize("solve", [l1_fit, least_squares_fit])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("where", [0, 1, 2])
def test_what_is_not_finite_is_named(solve, value, where):
    problems = gram(*visibility(4, k=3))
    problems[where][2] = value
    with pytest.raises(PrtError, match="problem 2 of 4"):
        solve(*problems)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"relative_lambda": -0.1}, "relative_lambda is -0.1"),
        ({"relative_lambda": np.nan}, "relative_lambda is nan"),
        ({"tolerance": 0.0}, "tolerance is 0.0"),
        ({"solver": "simplex"}, "solver is 'simplex'"),
        ({"solver": "interior_point", "non_negative": True}, "use solver='coordinate_descent'"),
        ({"solver": "interior_point", "relative_lambda": 0.0}, "use solver='coordinate_descent'"),
        ({"squared_norm": np.ones(3)}, "give \\(m, k, k\\)"),
        ({"gram": np.ones((2, 3, 3), dtype=int)}, "gram is int64"),
    ],
)
def test_wrong_use_is_told_in_one_line(change, message):
    arguments = {"gram": np.ones((2, 3, 3)), "correlation": np.ones((2, 3)), "squared_norm": np.ones(2)}
    with pytest.raises(PrtError, match=message) as raised:
        l1_fit(**(arguments | change))
    assert "\n" not in str(raised.value)
