"""Sparse weights for many small systems at once: min_a ||A a - y||^2 + lambda ||a||_1 ([HR10] 5.1, [KKL*07]).

A problem comes as ``G = A^T A``, ``r = A^T y`` and ``s = ||y||^2``, which is all that the solvers need. Inside, columns
and right-hand side have unit length, so that units do not matter; there the objective is

    ``b^T G b - 2 b^T r + 1 + 2 sum_i l_i |b_i|``,    with ``q = r - G b`` as minus half its smooth gradient.

[KKL*07]: Kim, Koh, Lustig, Boyd, Gorinevsky, "An interior-point method for large-scale l1-regularized least squares",
IEEE J. Sel. Top. Signal Process. 1(4), 2007. Note that its squared norm has no factor 1/2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numba
import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from mi_sparse_prt.errors import PrtError

Array = NDArray[np.float64]
Solver = Literal["coordinate_descent", "interior_point"]

SWEEPS_PER_ROUND = 2  # of coordinate descent, before Newton steps
MAX_ROUNDS = 400  # a bound for hopeless systems; ordinary ones need two or three
NEVER = 1.001  # unit columns meet a unit residual in at most 1: with l_i above, weight i is 0 (0.001: rounded input)
SMALLEST_PIVOT = 1e-10  # of unit columns: below, a column counts as repeated
SETTLED = 1e-14  # the largest change in a sweep that is only rounding

BARRIER_GROWTH = 2.0  # mu of [KKL*07] 4.1, as are the three below
LONG_STEP = 0.5
SUFFICIENT_DECREASE = 0.01
BACKTRACKING = 0.5
MAX_NEWTON_STEPS = 400


@dataclass(frozen=True)
class Fit:
    """Solutions of m problems with up to k unknowns.

    Attributes
    ----------
    weights : (m, k) float64
        a; exactly 0 where the system has an empty column.
    objective : (m,) float64
        The function that was minimised, at ``weights``.
    gap : (m,) float64
        No weights have an objective below ``objective - gap``. Without a penalty (lambda = 0) no better bound than
        0 is at hand and the gap is the objective itself; a closed form has gap 0.
    iterations : (m,) int64
        Sweeps of coordinate descent, or Newton steps; 0 where 0 was already the answer, or for a closed form.
    """

    weights: Array
    objective: Array
    gap: Array
    iterations: NDArray[np.int64]


def l1_fit(
    gram: NDArray[np.floating],
    correlation: NDArray[np.floating],
    squared_norm: NDArray[np.floating],
    relative_lambda: float = 1e-2,
    solver: Solver = "coordinate_descent",
    tolerance: float = 1e-6,
    non_negative: bool = False,
) -> Fit:
    """Minimise ``||A a - y||^2 + lambda ||a||_1`` for every problem, with lambda relative to its own lambda_max.

    A problem's answer depends on nothing but the problem: not on its neighbours in the batch, nor on threads.

    Parameters
    ----------
    gram : (m, k, k) float32 or float64
        A^T A. Unknowns that a problem lacks are rows and columns of zeros.
    correlation : (m, k)
        A^T y.
    squared_norm : (m,)
        ||y||^2.
    relative_lambda : float
        lambda / lambda_max, where ``lambda_max = max |2 A^T y|`` is the smallest lambda with all weights 0.
        From 1 on all weights are 0; at 0 this is least squares, stopped once no residual correlation is above
        ``tolerance`` (an unpenalised system has no gap to stop by).
    solver : "coordinate_descent" or "interior_point"
        The first is fast, compiled and parallel; its zeros are exact. The second is [KKL*07] one problem at a time,
        a reference, and needs a positive lambda.
    tolerance : float
        Stop when the duality gap is at most ``tolerance * squared_norm``.
    non_negative : bool
        Only weights >= 0 (coordinate descent).

    Returns
    -------
    Fit
        A gap above the tolerance tells where iterations ran out, which takes a system singular to working precision.

    Raises
    ------
    PrtError
        If shapes do not fit, a parameter is out of range, or a problem (named) is not finite or no Gram matrix.
    """
    _check_parameter("relative_lambda", relative_lambda, relative_lambda >= 0, "at least 0")
    _check_parameter("tolerance", tolerance, tolerance > 0, "above 0")
    if solver not in ("coordinate_descent", "interior_point"):
        raise PrtError(f"solver is {solver!r}: choose 'coordinate_descent' or 'interior_point'")
    if solver == "interior_point" and (non_negative or relative_lambda == 0):
        what = "non_negative=True" if non_negative else "relative_lambda=0"
        raise PrtError(f"interior_point cannot solve with {what}: use solver='coordinate_descent'")
    G, r, s = _checked(gram, correlation, squared_norm)
    relative_lambda, tolerance = (
        float(relative_lambda),
        float(tolerance),
    )  # an int would be compiled for once more
    if solver == "interior_point":
        return _interior_point_each(G, r, s, relative_lambda, tolerance)
    return Fit(*_descend_each(G, r, s, relative_lambda, tolerance, bool(non_negative)))


def least_squares_fit(
    gram: NDArray[np.floating],
    correlation: NDArray[np.floating],
    squared_norm: NDArray[np.floating],
    relative_ridge: float = 0.0,
) -> Fit:
    """Minimise ``||A a - y||^2 + ridge ||a||^2``; of several answers, take the shortest a.

    Eigenvalues of G up to ``k * eps`` times the largest (eps of the type of ``gram``) are rounding and count as 0.

    Parameters
    ----------
    gram, correlation, squared_norm
        As in `l1_fit`.
    relative_ridge : float
        ridge / mean of the diagonal of G, empty columns left out.

    Returns
    -------
    Fit
        In closed form: gap and iterations are 0. The objective includes the ridge.

    Raises
    ------
    PrtError
        As in `l1_fit`.
    """
    _check_parameter("relative_ridge", relative_ridge, relative_ridge >= 0, "at least 0")
    G, r, s = _checked(gram, correlation, squared_norm)
    m, k = r.shape
    if m == 0 or k == 0:
        return Fit(np.zeros((m, k)), s.copy(), np.zeros(m), np.zeros(m, dtype=np.int64))
    diagonal = np.einsum("mii->mi", G).astype(np.float64)  # [problem, unknown]
    used = diagonal > 0
    unit = np.where(used.any(axis=1), diagonal.max(axis=1), 1.0)  # of G: no under- or overflow below
    ridge = relative_ridge * (diagonal / unit[:, None]).sum(axis=1) / np.maximum(used.sum(axis=1), 1)

    # [problem, value] and [problem, unknown, value]
    values, vectors = np.linalg.eigh(G / unit[:, None, None].astype(G.dtype))
    values, vectors = values.astype(np.float64), vectors.astype(np.float64)
    kept = values > k * np.finfo(G.dtype).eps * values[:, -1:]
    inverse = np.divide(1.0, values + ridge[:, None], out=np.zeros_like(values), where=kept)
    right = np.where(used, r / unit[:, None], 0.0)  # [problem, unknown]
    weights = np.einsum("mij,mj->mi", vectors, inverse * np.einsum("mij,mi->mj", vectors, right))
    weights = np.where(used, weights, 0.0)

    squared_error = _squared_error(G, r, s, weights)
    objective = squared_error + ridge * unit * (weights**2).sum(axis=1)
    return Fit(weights, objective, np.zeros(m), np.zeros(m, dtype=np.int64))


def _squared_error(gram: NDArray, correlation: Array, squared_norm: Array, weights: Array) -> Array:
    """||A a - y||^2 (m,), which rounding must not take below 0."""
    quadratic = (weights * np.matmul(gram, weights[..., None])[..., 0]).sum(axis=1)
    return np.maximum(quadratic - 2 * (weights * correlation).sum(axis=1) + squared_norm, 0.0)


# --- What both iterative solvers share -------------------------------------------------------------------------------


@numba.njit(cache=True)
def _normalise(
    gram: NDArray[np.floating], correlation: Array, squared_norm: float, relative_lambda: float
) -> tuple[NDArray[np.int64], Array, Array, Array, Array]:
    """One problem with unit columns and unit y, without the unknowns that must be 0.

    Returns ids (n,), G (n, n), r (n,), the penalties l (n,) and ``length`` (n,): a[ids] = b * length. Leaving columns
    out makes the answer independent of padding.
    """
    k = len(correlation)
    largest = 0.0  # of |A^T y|
    for i in range(k):
        if gram[i, i] > 0:
            largest = max(largest, abs(correlation[i]))
    y_norm = np.sqrt(squared_norm)
    ids = np.empty(k, dtype=np.int64)
    n = 0
    if y_norm > 0:
        for i in range(k):
            # A weight that stays 0 only costs time, and a huge penalty on it would cost digits too.
            if (
                gram[i, i] > 0
                and relative_lambda * largest <= NEVER * np.sqrt(np.float64(gram[i, i])) * y_norm
            ):
                ids[n] = i
                n += 1
    G, r, penalty, inverse = np.empty((n, n)), np.empty(n), np.empty(n), np.empty(n)
    for i in range(n):
        inverse[i] = 1.0 / np.sqrt(np.float64(gram[ids[i], ids[i]]))
    for i in range(n):
        r[i] = correlation[ids[i]] * inverse[i] / y_norm
        penalty[i] = (
            relative_lambda * largest * inverse[i] / y_norm
        )  # rounds as r does: r <= l if lambda >= lambda_max
        for j in range(n):
            G[i, j] = np.float64(gram[ids[i], ids[j]]) * inverse[i] * inverse[j]
    return ids[:n], G, r, penalty, inverse * y_norm


@numba.njit(cache=True)
def _primal_and_dual(r: Array, q: Array, b: Array, penalty: Array, non_negative: bool) -> tuple[float, float]:
    """The objective at b, and a lower bound of all objectives ([KKL*07] 3.2).

    The bound is the dual function at the residual ``nu = 2 theta (A b - y)``, where theta <= 1 makes nu feasible:
    ``-nu^T nu / 4 - nu^T y``. Weights that cannot be negative only bound correlations from above.
    """
    along_y, with_residual, l1, theta = 0.0, 0.0, 0.0, 1.0
    for i in range(len(b)):
        along_y += b[i] * r[i]
        with_residual += b[i] * q[i]
        l1 += 2.0 * penalty[i] * abs(b[i])
        excess = q[i] if non_negative else abs(q[i])
        if excess > penalty[i]:
            theta = min(theta, penalty[i] / excess)
    squared_error = max(1.0 - along_y - with_residual, 0.0)
    return squared_error + l1, 2.0 * theta * (1.0 - along_y) - theta * theta * squared_error


# --- Coordinate descent ----------------------------------------------------------------------------------------------


@numba.njit(
    parallel=True, cache=True
)  # no fastmath: sums keep their order, and what is not finite stays visible
def _descend_each(
    gram: NDArray[np.floating],
    correlation: Array,
    squared_norm: Array,
    relative_lambda: float,
    tolerance: float,
    non_negative: bool,
) -> tuple[Array, Array, Array, NDArray[np.int64]]:
    """Weights (m, k), objectives (m,), gaps (m,) and sweeps (m,) of all problems, one problem per thread at a time."""
    m, k = correlation.shape
    weights, objective, gap = np.zeros((m, k)), np.empty(m), np.empty(m)
    sweeps = np.zeros(m, dtype=np.int64)
    for p in numba.prange(m):
        s = squared_norm[p]
        ids, G, r, penalty, length = _normalise(gram[p], correlation[p], s, relative_lambda)
        b, primal, dual, sweeps[p] = _descend(G, r, penalty, tolerance, non_negative)
        objective[p], gap[p] = s * primal, s * max(primal - dual, 0.0)
        for i in range(len(ids)):
            weights[p, ids[i]] = b[i] * length[i]
    return weights, objective, gap, sweeps


@numba.njit(cache=True)
def _descend(
    G: Array, r: Array, penalty: Array, tolerance: float, non_negative: bool
) -> tuple[Array, float, float, int]:
    """One normalised problem: weights, objective, its lower bound, sweeps.

    Sweeps soon know which weights are 0 and the signs of the others, but crawl where columns are much alike (hundreds
    of sweeps at a correlation of 0.9). With signs known the rest is a linear system, which `_newton` solves. Neither
    ever increases the objective.
    """
    n = len(r)
    b, q = np.zeros(n), r.copy()
    unpenalised = n > 0 and penalty.max() == 0.0
    primal, dual = _primal_and_dual(r, q, b, penalty, non_negative)
    change = np.inf
    for done in range(MAX_ROUNDS):
        if unpenalised:
            finished = _steepest(q, b, non_negative) <= tolerance
        else:
            finished = primal - dual <= tolerance
        if finished or change <= SETTLED:
            return b, primal, dual, done * SWEEPS_PER_ROUND
        for _ in range(SWEEPS_PER_ROUND):
            change = _sweep(G, q, b, penalty, non_negative)
        while _newton(G, q, b, penalty):  # each time fewer weights are left
            pass
        _refresh(G, r, b, q)
        primal, bound = _primal_and_dual(r, q, b, penalty, non_negative)
        dual = max(dual, bound)
    return b, primal, dual, MAX_ROUNDS * SWEEPS_PER_ROUND


@numba.njit(cache=True)
def _sweep(G: Array, q: Array, b: Array, penalty: Array, non_negative: bool) -> float:
    """Minimise over each weight in turn, in place; the largest change."""
    largest = 0.0
    for i in range(len(b)):
        z = q[i] + b[i]
        size = max((z if non_negative else abs(z)) - penalty[i], 0.0)
        change = (size if z > 0 else -size) - b[i]
        if change != 0.0:
            b[i] += change
            if size == 0.0:
                b[i] = 0.0
            largest = max(largest, abs(change))
            row = G[i]
            for j in range(len(b)):
                q[j] -= change * row[j]
    return largest


@numba.njit(cache=True)
def _steepest(q: Array, b: Array, non_negative: bool) -> float:
    """The largest slope along which an unpenalised weight may still move."""
    largest = 0.0
    for i in range(len(b)):
        if non_negative and b[i] == 0.0:
            largest = max(largest, q[i])
        else:
            largest = max(largest, abs(q[i]))
    return largest


@numba.njit(cache=True)
def _refresh(G: Array, r: Array, b: Array, q: Array) -> None:
    """Compute q = r - G b anew, without the rounding that updates have piled up."""
    q[:] = r
    for i in range(len(b)):
        if b[i] != 0.0:
            row = G[i]
            for j in range(len(b)):
                q[j] -= b[i] * row[j]


@numba.njit(cache=True)
def _newton(G: Array, q: Array, b: Array, penalty: Array) -> bool:
    """Go towards the minimum over the weights that are not 0, signs held, in place; whether one became 0 on the way.

    Two ways are tried where some weight would change its sign: all along with such weights left at 0, which clears
    many at once, and straight on until the first is 0, which always gains.
    """
    ids = np.flatnonzero(b)
    n = len(ids)
    slope = np.empty(n)
    for i in range(n):
        slope[i] = q[ids[i]] - (penalty[ids[i]] if b[ids[i]] > 0 else -penalty[ids[i]])
    move = slope.copy()
    _solve(G, ids, move)
    curve, descent, curvature = _along(G, ids, slope, move)
    if not (descent > 0.0 and curvature > 0.0):  # rounding rules here: sweeps are safer
        return False

    full = descent / curvature  # 1, unless pivots were raised
    clipped = np.empty(n)
    step, hit = full, -1
    for i in range(n):
        now = b[ids[i]]
        clipped[i] = full * move[i]
        if now * move[i] < 0.0 and abs(now) <= abs(clipped[i]):
            clipped[i] = -now
            if now / -move[i] <= step:
                step, hit = now / -move[i], i
    if (
        hit < 0 and descent * full > 1.0
    ):  # no objective can fall below 0: G is singular, and rounding says otherwise
        return False
    if hit >= 0:
        clipped_curve, clipped_descent, clipped_curvature = _along(G, ids, slope, clipped)
        if 2 * clipped_descent - clipped_curvature > step * (2 * descent - step * curvature):
            move, curve, step = clipped, clipped_curve, 1.0
    for i in range(n):
        now = b[ids[i]]
        after = now + step * move[i]
        b[ids[i]] = 0.0 if i == hit or after * now <= 0.0 else after
    for j in range(len(b)):
        q[j] -= step * curve[j]
    return hit >= 0


@numba.njit(cache=True)
def _along(G: Array, ids: NDArray[np.int64], slope: Array, move: Array) -> tuple[Array, float, float]:
    """G move (all rows), slope . move and move . G move: the objective falls by twice the second less the third."""
    curve = np.zeros(len(G))
    for i in range(len(ids)):
        row = G[ids[i]]
        for j in range(len(G)):
            curve[j] += move[i] * row[j]
    descent, curvature = 0.0, 0.0
    for i in range(len(ids)):
        descent += slope[i] * move[i]
        curvature += move[i] * curve[ids[i]]
    return curve, descent, curvature


@numba.njit(cache=True)
def _solve(G: Array, ids: NDArray[np.int64], x: Array) -> None:
    """Solve ``G[ids, ids] x = x`` in place by Cholesky, with pivots of repeated columns raised.

    By rows, so that the innermost loops are contiguous and need no reordered sums to be vectorised.
    """
    n = len(ids)
    U = np.empty((n, n))  # upper triangle: first G, then its factor, U^T U = G
    for i in range(n):
        for j in range(i, n):
            U[i, j] = G[ids[i], ids[j]]
    for i in range(n):
        scale = 1.0 / np.sqrt(max(U[i, i], SMALLEST_PIVOT))
        for j in range(i, n):
            U[i, j] *= scale
        U[i, i] = scale  # the inverse: only divisions need it
        x[i] *= scale
        for below in range(i + 1, n):
            factor = U[i, below]
            x[below] -= factor * x[i]
            for j in range(below, n):
                U[below, j] -= factor * U[i, j]
    for i in range(n - 1, -1, -1):
        for j in range(i + 1, n):
            x[i] -= U[i, j] * x[j]
        x[i] *= U[i, i]


# --- The interior-point method of [KKL*07] ---------------------------------------------------------------------------


def _interior_point_each(
    gram: NDArray[np.floating],
    correlation: Array,
    squared_norm: Array,
    relative_lambda: float,
    tolerance: float,
) -> Fit:
    m, k = correlation.shape
    weights, objective, gap = np.zeros((m, k)), np.empty(m), np.empty(m)
    iterations = np.zeros(m, dtype=np.int64)
    for p in range(m):
        s = float(squared_norm[p])
        ids, G, r, penalty, length = _normalise(gram[p], correlation[p], s, relative_lambda)
        b, primal, dual, iterations[p] = _interior_point(G, r, penalty, tolerance)
        weights[p, ids] = b * length
        objective[p], gap[p] = s * primal, s * max(primal - dual, 0.0)
    return Fit(weights, objective, gap, iterations)


def _interior_point(G: Array, r: Array, penalty: Array, tolerance: float) -> tuple[Array, float, float, int]:
    """One normalised problem: weights, objective, its lower bound, Newton steps ([KKL*07] 4.1).

    Minimises ``t (||A b - y||^2 + 2 l^T u) - sum_i log(u_i^2 - b_i^2)`` over b and its bounds u, for growing t.
    """
    n = len(r)
    b, u = np.zeros(n), np.ones(n)
    t = 1.0 / max(2 * penalty.max(initial=0.0), 1e-8)
    dual = -np.inf
    for steps in range(MAX_NEWTON_STEPS):
        q = r - G @ b
        primal, bound = _primal_and_dual(r, q, b, penalty, False)
        dual = max(dual, bound)
        if primal - dual <= tolerance:
            return b, primal, dual, steps
        db, du, descent = _newton_direction(G, q, b, u, penalty, t)
        step = _backtrack(G, r, b, u, penalty, t, db, du, descent)
        if step == 0.0:  # descent is lost in rounding
            return b, primal, dual, steps
        b, u = b + step * db, u + step * du
        if step >= LONG_STEP:
            t = max(BARRIER_GROWTH * min(2 * n / (primal - dual), t), t)
    return b, primal, dual, MAX_NEWTON_STEPS


def _newton_direction(
    G: Array, q: Array, b: Array, u: Array, penalty: Array, t: float
) -> tuple[Array, Array, float]:
    """Steps of b and u, and the slope along them. The blocks of u are diagonal, which leaves a system for b alone."""
    square = (u - b) * (u + b)
    gradient_b = -2 * t * q + 2 * b / square
    gradient_u = 2 * t * penalty - 2 * u / square
    same, mixed = 2 * (u**2 + b**2) / square**2, -4 * u * b / square**2
    # same - mixed^2 / same, without its cancellation
    reduced = 2 * t * G + np.diag(2 / (u**2 + b**2))
    right = -gradient_b + mixed / same * gradient_u
    db = scipy.linalg.solve(reduced, right, assume_a="pos")
    du = -(gradient_u + mixed * db) / same
    return db, du, float(gradient_b @ db + gradient_u @ du)


def _backtrack(
    G: Array, r: Array, b: Array, u: Array, penalty: Array, t: float, db: Array, du: Array, descent: float
) -> float:
    """The longest tried step inside the barrier that decreases the function enough; 0 if there is none."""

    def value(step: float) -> float:
        x, bound = b + step * db, u + step * du
        if np.any(np.abs(x) >= bound):
            return np.inf
        smooth = x @ G @ x - 2 * x @ r + 1 + 2 * penalty @ bound
        return float(t * smooth - np.log((bound - x) * (bound + x)).sum())

    start, step = value(0.0), 1.0
    while step > 1e-12:
        if value(step) <= start + SUFFICIENT_DECREASE * step * descent:
            return step
        step *= BACKTRACKING
    return 0.0


# --- Checks ----------------------------------------------------------------------------------------------------------


def _check_parameter(name: str, value: float, valid: bool, wanted: str) -> None:
    if not (valid and np.isfinite(value)):
        raise PrtError(f"{name} is {value}: give a finite number, {wanted}")


def _checked(
    gram: NDArray[np.floating], correlation: NDArray[np.floating], squared_norm: NDArray[np.floating]
) -> tuple[NDArray[np.floating], Array, Array]:
    """The problems, once they are known to be usable, in the two layouts that kernels are compiled for."""
    if gram.dtype not in (np.float32, np.float64):
        raise PrtError(f"gram is {gram.dtype}: give float32 or float64")
    m, k = correlation.shape if correlation.ndim == 2 else (-1, -1)
    if (gram.shape, squared_norm.shape) != ((m, k, k), (m,)):
        shapes = f"{gram.shape}, {correlation.shape}, {squared_norm.shape}"
        raise PrtError(f"gram, correlation, squared_norm are {shapes}: give (m, k, k), (m, k), (m,)")
    G = np.ascontiguousarray(gram)  # the large one keeps its precision
    r = np.ascontiguousarray(correlation, dtype=np.float64)
    s = np.ascontiguousarray(squared_norm, dtype=np.float64)
    bad = _unusable(G, r, s)
    if bad.any():
        first, others = int(np.flatnonzero(bad)[0]), int(bad.sum()) - 1
        raise PrtError(
            f"problem {first} of {len(bad)} (and {others} more) has NaN, Inf or a negative square in gram, "
            "correlation or squared_norm: look for what is not finite in its rows of transport"
        )
    return G, r, s


@numba.njit(parallel=True, cache=True)
def _unusable(gram: NDArray[np.floating], correlation: Array, squared_norm: Array) -> NDArray[np.bool_]:
    """(m,): whether a problem is not finite, or no A and y can have led to it."""
    m, k = correlation.shape
    bad = np.zeros(m, dtype=np.bool_)
    for p in numba.prange(m):
        found = not (np.isfinite(squared_norm[p]) and squared_norm[p] >= 0)
        for i in range(k):
            found |= not (np.isfinite(correlation[p, i]) and gram[p, i, i] >= 0)
            for j in range(k):
                found |= not np.isfinite(gram[p, i, j])
        bad[p] = found
    return bad
