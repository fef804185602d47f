"""Weights of a vertex's dense neighbours that interpolate: linear in position and normal, or by distance."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.threads import run_in_parts
from mi_sparse_prt.measurement.neighbours import Neighbours


def linear_weights(
    neighbours: Neighbours,
    positions: NDArray[np.floating],
    normals: NDArray[np.floating],
    dense_positions: NDArray[np.floating],
    dense_normals: NDArray[np.floating],
) -> NDArray[np.float32]:
    """Weights (n, k) of neighbours that reproduce what is linear in position and normal; rows sum to 1.

    Moving least squares: the value at the point of the linear function that fits the neighbours best, each counting
    with a Gaussian of its distance. A ridge on the slopes keeps weights bounded where neighbours do not span them
    (on a line, on a plane, all in one place), and turns to the plain mean there.

    Parameters
    ----------
    neighbours : Neighbours
        Of ``surface_neighbours``.
    positions, normals : (n, 3) float
    dense_positions, dense_normals : (n_dense, 3) float

    Returns
    -------
    (n, k) float32
        0 where there is no neighbour.
    """
    weights = np.zeros(neighbours.ids.shape, np.float32)
    run_in_parts(
        _weigh_all,
        len(weights),
        np.ascontiguousarray(neighbours.ids),  # one layout: compiled once
        np.ascontiguousarray(neighbours.distances),
        np.hstack([positions, normals]),
        np.hstack([dense_positions, dense_normals]),
        weights,
    )
    return weights


@numba.njit(nogil=True, cache=True)
def _weigh_all(
    start: int,
    end: int,
    ids: NDArray[np.int32],
    distances: NDArray[np.float32],
    points: NDArray[np.floating],
    dense: NDArray[np.floating],
    weights: NDArray[np.float32],
) -> None:
    """Of points (n, 6) and dense vertices (m, 6), each a position and a normal."""
    for i in range(start, end):
        _weigh(ids[i], distances[i], points[i], dense, weights[i])


@numba.njit(cache=True)
def _weigh(
    ids: NDArray[np.int32],
    distances: NDArray[np.float32],
    point: NDArray[np.floating],
    dense: NDArray[np.floating],
    weights: NDArray[np.float32],
) -> None:
    """The weights of one point."""
    gaussians = 1.5  # standard deviations (times sqrt 2) at which the farthest neighbour is
    normal_unit = 2.0  # slopes in normals count from differences of half a unit on
    ridge = 0.3  # of slopes, in squared steps between dense vertices
    count = 0
    while count < len(ids) and ids[count] >= 0:
        count += 1
    if count == 0:
        return
    reach = max(np.float64(distances[count - 1]) / gaussians, 1e-30)
    near, whole = np.empty(count), 0.0
    for k in range(count):
        near[k] = np.exp(-((distances[k] / reach) ** 2))
        whole += near[k]
    terms = np.empty((count, 6))  # [neighbour, slope]
    for k in range(count):
        near[k] /= whole
        for c in range(6):
            unit = max(reach / gaussians, 1e-30) if c < 3 else 1 / normal_unit
            terms[k, c] = (dense[ids[k], c] - point[c]) / unit
    mean, system = np.zeros(6), np.zeros((6, 6))
    for k in range(count):
        for c in range(6):
            mean[c] += near[k] * terms[k, c]
    for a in range(6):
        system[a, a] = ridge
        for k in range(count):
            terms[k, a] -= mean[a]
        for b in range(a + 1):
            for k in range(count):
                system[a, b] += near[k] * terms[k, a] * terms[k, b]
            system[b, a] = system[a, b]
    _solve_positive(system, mean)
    for k in range(count):
        away = 0.0
        for c in range(6):
            away += terms[k, c] * mean[c]
        weights[k] = near[k] * (1 - away)


@numba.njit(cache=True)
def _solve_positive(system: NDArray[np.float64], x: NDArray[np.float64]) -> None:
    """Solution, in place of the right side, of a positive definite system, which is eliminated: no pivots are needed.

    NumPy's takes seconds to compile.
    """
    n = len(x)
    for a in range(n):
        for b in range(a + 1, n):
            factor = system[b, a] / system[a, a]
            for c in range(a, n):
                system[b, c] -= factor * system[a, c]
            x[b] -= factor * x[a]
    for a in range(n - 1, -1, -1):
        for c in range(a + 1, n):
            x[a] -= system[a, c] * x[c]
        x[a] /= system[a, a]


def inverse_distance_weights(neighbours: Neighbours) -> NDArray[np.float32]:
    """Weights (n, k) of neighbours by the inverse of their distance; rows sum to 1, or are 0 where there are none.

    At a point that coincides with dense vertices they alone count.
    """
    near = neighbours.distances.astype(np.float64)  # [point, neighbour]
    present = neighbours.ids >= 0
    nearest = np.min(near, axis=1, keepdims=True, initial=np.inf, where=present)
    # relative to the nearest: 1 for it, and no division by 0 where it coincides
    weights = np.where(present & (near <= nearest), 1.0, 0.0)
    np.divide(nearest, near, out=weights, where=present & (near > nearest))
    total = weights.sum(axis=1, keepdims=True)
    np.divide(weights, total, out=weights, where=total > 0)
    return weights.astype(np.float32)
