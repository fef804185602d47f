"""Weights of a vertex's neighbours from a few samples: many small l1-regularised least-squares problems ([HR10] 5.1).

Each problem is ``min_a ||A a - y||^2 + lambda ||a||_1`` as in [KKL07] (no 1/2 before the square), known by its Gram
matrix. Inside, every problem is one of columns and y of unit length, so that neither the units of A and y nor a
column much longer than the others matter; the penalty then differs from unknown to unknown.

[HR10] Huang, Ramamoorthi: Sparsely Precomputing the Light Transport Matrix for Real-Time Rendering, 2010.
[KKL07] Kim, Koh, Lustig, Boyd, Gorinevsky: An Interior-Point Method for Large-Scale l1-Regularized Least Squares, 2007.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.core.threads import run_in_parts

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Fit:
    """Solutions of m problems of k unknowns.

    Attributes
    ----------
    weights : (m, k) float64
        Exactly 0 where the column of A is 0.
    objective : (m,) float64
        What was minimised, at the weights.
    gap : (m,) float64
        Duality gap: the objective is at most so much above its minimum. Without a penalty no better bound than the
        objective itself is at hand.
    iterations : (m,) int64
        Coordinates visited.
    """

    weights: Floats
    objective: Floats
    gap: Floats
    iterations: NDArray[np.int64]


def l1_fit(
    gram: ArrayLike,
    correlation: ArrayLike,
    squared_norm: ArrayLike,
    relative_lambda: float = 1e-2,
    tolerance: float = 1e-6,
    most_steps: int = 1000,
) -> Fit:
    """Minimise ``||A a - y||^2 + lambda ||a||_1`` for many small problems ([HR10] 5.1, [KKL07]).

    Coordinate descent that moves the steepest coordinate, then all that are not 0 to their common minimum; exactly
    sparse. A problem's result depends neither on the others, nor on the number of threads.

    Parameters
    ----------
    gram : (m, k, k) float32 or float64
        ``A^T A``. Problems of fewer unknowns are padded with rows and columns of zeros, whose weights are 0. A float32
        matrix counts as known to its precision: its diagonal is raised by k roundings, so that it is definite.
    correlation : (m, k)
        ``A^T y``.
    squared_norm : (m,)
        ``||y||^2``.
    relative_lambda : float
        lambda in units of ``||2 A^T y||_inf``, from which on all weights are 0. At 0 it is plain least squares, by the
        steps that the penalised problem takes, ended when no unit column correlates with the residual by more than
        ``tolerance ||y||``.
    tolerance : float
        A problem is solved when its duality gap is at most ``tolerance ||y||^2``. Where rounding stops the descent
        before (columns all but equal, tiny lambda) or ``most_steps`` do, `Fit.gap` says what was reached.
    most_steps : int
        About one per unknown is usual.

    Returns
    -------
    Fit

    Raises
    ------
    PrtError
        For shapes that do not match, values that are not finite (naming the problem), or options out of range.
    """
    products = check_products(gram, correlation, squared_norm)
    check_option("relative_lambda", relative_lambda, relative_lambda >= 0, "0 or more")
    check_option("tolerance", tolerance, tolerance > 0, "more than 0")
    check_option("most_steps", most_steps, most_steps > 0, "1 or more")
    m, k = products[1].shape
    fit = Fit(np.zeros((m, k)), np.empty(m), np.empty(m), np.empty(m, np.int64))
    options = float(relative_lambda), float(tolerance), int(most_steps)
    run_in_parts(_descend_all, m, *products, *options, fit.weights, fit.objective, fit.gap, fit.iterations)
    return fit


def check_option(name: str, value: float, valid: bool, wanted: str) -> None:
    """Refuse an option that is not finite or not ``wanted``."""
    if not (valid and np.isfinite(value)):
        raise PrtError(f"{name} is {value}; pass a finite number, {wanted}")


def check_products(
    gram: ArrayLike, correlation: ArrayLike, squared_norm: ArrayLike
) -> tuple[NDArray, Floats, Floats, float]:
    """The products as arrays that compiled code takes, and the rounding of the Gram matrix.

    Raises
    ------
    PrtError
        For shapes that do not match, or values that are not finite (naming the problem).
    """
    G = np.asarray(gram)
    eps = float(np.finfo(np.float32 if G.dtype == np.float32 else np.float64).eps)
    G = np.ascontiguousarray(G, dtype=np.float64)  # one type: the solver is compiled once
    r = np.array(correlation, dtype=np.float64, order="C", ndmin=1)
    s = np.array(squared_norm, dtype=np.float64, order="C", ndmin=1)
    if r.ndim != 2 or G.shape != (*r.shape, r.shape[1]) or s.shape != r.shape[:1]:
        raise PrtError(
            f"gram {G.shape}, correlation {r.shape}, squared_norm {s.shape} do not match; pass (m, k, k), (m, k), (m,)"
        )
    fine = np.isfinite(G).all(axis=(1, 2)) & np.isfinite(r).all(axis=1) & np.isfinite(s) & (s >= 0)
    if not fine.all():
        raise PrtError(
            f"problem {np.argmin(fine)} of {len(fine)} is not finite, or has a squared_norm < 0; check its samples"
        )
    return G, r, s, eps


# -- the problem in units of its own ----------------------------------------------------------------------------------


@numba.njit(cache=True)
def normalise(
    G: NDArray, r: Floats, s: float, eps: float, relative_lambda: float
) -> tuple[NDArray[np.int64], Floats, Floats, Floats, Floats]:
    """Ids (n,) of the unknowns that have a column (none where y is 0), Gram matrix (n, n) and correlations (n,) of unit
    columns and y, half the penalties (n,), and which weight (n,) a unit of each unknown is.
    """
    smallest = 2.2250738585072014e-308  # of normal numbers
    used = np.empty(len(r), dtype=np.int64)
    n = 0
    for i in range(len(r)):
        if s >= smallest and G[i, i] >= smallest:
            used[n] = i
            n += 1
    used = used[:n]
    g, c, half, unit = np.empty((n, n)), np.empty(n), np.empty(n), np.empty(n)
    root, largest = np.sqrt(s), 0.0
    for a in range(n):
        unit[a] = 1 / np.sqrt(np.float64(G[used[a], used[a]]))
        largest = max(largest, abs(r[used[a]]))
    for a in range(n):
        c[a] = r[used[a]] * unit[a] / root
        half[a] = relative_lambda * largest * unit[a] / root
        for b in range(n):
            g[a, b] = G[used[a], used[b]] * unit[a] * unit[b]
        g[a, a] = 1 + n * eps  # correlations that were rounded may be indefinite by as much
    return used, g, c, half, unit * root


@numba.njit(cache=True)
def objective_and_gap(b: Floats, c: Floats, q: Floats, half: Floats) -> tuple[float, float]:
    """Of weights b, where q = c - g b correlates columns and residual: [KKL07] III, nu = 2 theta (A b - y)."""
    bc, bq, penalty, theta = 0.0, 0.0, 0.0, 1.0
    for i in range(len(b)):
        if b[i] != 0:
            bc += b[i] * c[i]
            bq += b[i] * q[i]
            penalty += 2 * half[i] * abs(b[i])
        steep = abs(q[i])
        if steep > half[i]:
            theta = min(theta, half[i] / steep)
    residual = max(1 - bc - bq, 0.0)  # rounding may take it below 0
    dual = 2 * theta * (1 - bc) - theta * theta * residual
    return residual + penalty, max(residual + penalty - dual, 0.0)


# -- coordinate descent -----------------------------------------------------------------------------------------------


@numba.njit(nogil=True, cache=True)  # no fastmath: sums keep their order, on any number of threads
def _descend_all(
    start: int,
    end: int,
    G: NDArray,
    r: Floats,
    s: Floats,
    eps: float,
    relative_lambda: float,
    tolerance: float,
    most_steps: int,
    weights: Floats,
    objective: Floats,
    gap: Floats,
    iterations: NDArray[np.int64],
) -> None:
    for p in range(start, end):
        used, g, c, half, unit = normalise(G[p], r[p], s[p], eps, relative_lambda)
        b = np.zeros(len(used))
        least, above, iterations[p] = _descend(g, c, half, b, relative_lambda > 0, tolerance, most_steps)
        objective[p], gap[p] = least * s[p], above * s[p]
        for a in range(len(used)):
            weights[p, used[a]] = b[a] * unit[a]


@numba.njit(cache=True)
def _descend(
    g: Floats, c: Floats, half: Floats, b: Floats, penalised: bool, tolerance: float, most_steps: int
) -> tuple[float, float, int]:
    """Move b from 0 to the minimum; objective, gap, steps.

    Cyclic descent needs hundreds of sweeps for columns as alike as neighbours' visibility. One coordinate at a time,
    each followed by the exact minimum over all that are not 0, takes about as many steps as weights remain.
    """
    q = c.copy()  # correlation of columns and residual: minus half the gradient of the square
    order = np.empty(len(b), dtype=np.int64)  # unknowns that are not 0, as they came
    factor, target = np.empty_like(g), np.empty_like(b)
    active, factored, least = 0, 0, np.inf
    for step in range(most_steps):
        objective, gap = objective_and_gap(b, c, q, half)
        steepest, slope = _steepest(b, q, half)
        if gap <= tolerance or objective >= least or (not penalised and slope <= tolerance):
            return objective, gap, step
        least = objective

        if steepest >= 0:
            b[steepest] = np.copysign(abs(q[steepest]) - half[steepest], q[steepest])
            order[active] = steepest
            active += 1

        arrived = False
        while active > 0 and not arrived:
            _factor(g, order, factored, active, factor)
            _face_minimum(c, half, b, order, active, factor, target)
            active, factored, arrived = _move(b, target, order, active, penalised)
        _keep_bounded(b, half)

        for i in range(len(q)):
            q[i] = c[i]
        for a in range(active):
            for i in range(len(q)):
                q[i] -= b[order[a]] * g[order[a], i]
    objective, gap = objective_and_gap(b, c, q, half)
    return objective, gap, most_steps


@numba.njit(cache=True)
def _steepest(b: Floats, q: Floats, half: Floats) -> tuple[int, float]:
    """The zero weight (or -1) along which the objective falls fastest, and half the largest slope of all weights."""
    steepest, fall, slope = -1, 0.0, 0.0
    for i in range(len(b)):
        if b[i] != 0:
            slope = max(slope, abs(q[i] - np.copysign(half[i], b[i])))
        else:
            here = abs(q[i]) - half[i]
            if here > fall:
                steepest, fall = i, here
    return steepest, max(slope, fall)


@numba.njit(cache=True)
def _factor(g: Floats, order: NDArray[np.int64], first: int, last: int, factor: Floats) -> None:
    """Rows first to last of the Cholesky factor of g[order, order]; its diagonal is inverted."""
    damping = 1e-14  # of a unit diagonal: columns equal but for rounding move together instead of far apart
    for a in range(first, last):
        for d in range(a):
            x = g[order[a], order[d]]
            for e in range(d):
                x -= factor[a, e] * factor[d, e]
            factor[a, d] = x * factor[d, d]
        x = g[order[a], order[a]] + damping
        for e in range(a):
            x -= factor[a, e] * factor[a, e]
        factor[a, a] = 1 / np.sqrt(max(x, damping))  # a pivot raised by rounding still makes a descent


@numba.njit(cache=True)
def _face_minimum(
    c: Floats, half: Floats, b: Floats, order: NDArray[np.int64], active: int, factor: Floats, target: Floats
) -> None:
    """Minimum over the active weights as if their signs could not change: g b = c - half sign(b)."""
    for a in range(active):
        x = c[order[a]] - np.copysign(half[order[a]], b[order[a]])
        for e in range(a):
            x -= factor[a, e] * target[e]
        target[a] = x * factor[a, a]
    for a in range(active - 1, -1, -1):
        x = target[a]
        for e in range(a + 1, active):
            x -= factor[e, a] * target[e]
        target[a] = x * factor[a, a]


@numba.njit(cache=True)
def _move(
    b: Floats, target: Floats, order: NDArray[np.int64], active: int, signs_hold: bool
) -> tuple[int, int, bool]:
    """Move active weights towards the target until the first becomes 0 and leaves.

    Returns how many are left, how many of them keep their row of the factor, and whether the target was reached.
    """
    step = 1.0
    for a in range(active):
        old = b[order[a]]
        if signs_hold and old * target[a] <= 0:
            step = min(step, old / (old - target[a]))
    kept, factored = 0, active
    for a in range(active):
        i = order[a]
        old = b[i]
        leaves = signs_hold and old * target[a] <= 0 and old / (old - target[a]) <= step
        b[i] = 0.0 if leaves else target[a] if step == 1 else old + step * (target[a] - old)
        if b[i] == 0:
            factored = min(factored, a)
        else:
            order[kept] = i
            kept += 1
    return kept, factored, step == 1


@numba.njit(cache=True)
def _keep_bounded(b: Floats, half: Floats) -> None:
    """The penalty of a minimum is at most ||y||^2 = 1; only an indefinite matrix, no Gram matrix, leads beyond."""
    longest = 2.0**26  # eps^(-1/2): smaller singular values than sqrt(eps) are lost in a Gram matrix
    penalty, length = 0.0, 0.0
    for i in range(len(b)):
        if b[i] != 0:
            penalty += 2 * half[i] * abs(b[i])
            length += abs(b[i])
    excess = max(penalty, length / longest)
    if excess > 1:
        b /= excess
