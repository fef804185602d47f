"""The reference of ``l1_fit``: [KKL07] with direct Newton steps, hundreds of times slower, nothing exactly 0.

Kim, Koh, Lustig, Boyd, Gorinevsky: An Interior-Point Method for Large-Scale l1-Regularized Least Squares, 2007.
"""

from __future__ import annotations

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from mi_sparse_prt.reconstruction.l1 import Fit, check_products, normalise, objective_and_gap

Floats = NDArray[np.float64]
MAX_NEWTON_STEPS, MAX_BACKTRACKS = 400, 100  # as in the authors' l1_ls.m


def interior_point_fit(
    gram: NDArray,
    correlation: NDArray,
    squared_norm: NDArray,
    relative_lambda: float = 1e-2,
    tolerance: float = 1e-6,
) -> Fit:
    """As ``l1_fit``, with lambda above 0; ``iterations`` are Newton steps."""
    G, r, s, eps = check_products(gram, correlation, squared_norm)
    m, k = r.shape
    weights, objective, gap = np.zeros((m, k)), np.zeros(m), np.zeros(m)
    iterations = np.zeros(m, dtype=np.int64)
    for p in range(m):
        used, g, c, half, unit = normalise(G[p], r[p], s[p], eps, relative_lambda)
        b, iterations[p] = _interior_point(g, c, half, tolerance)
        least, above = objective_and_gap(b, c, c - g @ b, half)
        objective[p], gap[p] = least * s[p], above * s[p]
        weights[p, used] = b * unit
    return Fit(weights, objective, gap, iterations)


def _interior_point(g: Floats, c: Floats, half: Floats, tolerance: float) -> tuple[Floats, int]:
    """Log barrier of -u <= b <= u with Newton steps in (b, u) and t from the duality gap: [KKL07] IV.

    Newton's method does not see the scale of unknowns; the start is b = 0 with its u on the central path.
    """
    b, n = np.zeros(len(c)), len(c)
    gap = objective_and_gap(b, c, c, half)[1]
    if gap <= tolerance:
        return b, 0
    t = 2 * n / gap
    u = 1 / (t * half)
    for iteration in range(1, MAX_NEWTON_STEPS + 1):
        step = _newton_step(g, c, half, b, u, t)
        if step is None:
            return b, iteration
        b, u, length = step
        gap = objective_and_gap(b, c, c - g @ b, half)[1]
        if gap <= tolerance:
            return b, iteration
        if length >= 0.5:
            t = max(2 * min(2 * n / gap, t), t)
    return b, MAX_NEWTON_STEPS


def _newton_step(
    g: Floats, c: Floats, half: Floats, b: Floats, u: Floats, t: float
) -> tuple[Floats, Floats, float] | None:
    """Next b, u and the length of the step to them; None where rounding lets the barrier fall no further."""
    inside, squares = (u - b) * (u + b), u * u + b * b
    slope_b, slope_u = 2 * t * (g @ b - c) + 2 * b / inside, 2 * t * half - 2 * u / inside
    try:  # u is eliminated: of its block only 2 / (u^2 + b^2) is left on the diagonal
        factor = scipy.linalg.cho_factor(2 * t * g + np.diag(2 / squares))
    except scipy.linalg.LinAlgError:
        return None
    step_b = scipy.linalg.cho_solve(factor, -slope_b - 2 * u * b / squares * slope_u)
    step_u = 2 * u * b / squares * step_b - slope_u * inside**2 / (2 * squares)

    start = _barrier(g, c, half, b, u, t)
    fall = slope_b @ step_b + slope_u @ step_u
    length = 1.0
    for _ in range(MAX_BACKTRACKS):
        new_b, new_u = b + length * step_b, u + length * step_u
        inner = bool((np.abs(new_b) < new_u).all())
        if inner and _barrier(g, c, half, new_b, new_u, t) <= start + 0.01 * length * fall:
            return new_b, new_u, length
        length /= 2
    return None


def _barrier(g: Floats, c: Floats, half: Floats, b: Floats, u: Floats, t: float) -> float:
    """The objective times t (less the constant 1, with u for |b|), and the logarithms."""
    return float(t * (b @ (g @ b) - 2 * (b @ c) + 2 * (half @ u)) - np.log((u - b) * (u + b)).sum())
