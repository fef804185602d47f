"""The linear systems of sparse vertices ([HR10] eq. 5): sampled values against those of dense neighbours."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.threads import run_in_parts


def normal_equations(
    rows: NDArray[np.float32],
    neighbours: NDArray[np.int32],
    directions: NDArray[np.int32],
    values: NDArray[np.float32],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Gram form of ``A a = y`` for n vertices, A having the neighbours' rows at the sampled directions as columns.

    Parameters
    ----------
    rows : (n_dense, n_directions) float32
        Transport of the dense vertices.
    neighbours : (n, k) int32
        Rows of ``rows``; -1 where there are fewer.
    directions : (n, s) int32
        Sampled directions; -1 where there are fewer.
    values : (n, s) float32
        Sampled transport y.

    Returns
    -------
    gram (n, k, k), correlation (n, k), squared_norm (n,)
        float64: A^T A, A^T y and y^T y; zeros for unknowns that a vertex lacks.
    """
    n, k = neighbours.shape
    # float64: neighbouring rows are nearly equal, and least squares sees the difference
    gram = np.zeros((n, k, k))
    correlation = np.zeros((n, k))
    squared_norm = np.zeros(n)
    run_in_parts(_multiply_all, n, rows, neighbours, directions, values, gram, correlation, squared_norm)
    return gram, correlation, squared_norm


@numba.njit(nogil=True, cache=True)
def _multiply_all(
    start: int,
    end: int,
    rows: NDArray[np.float32],
    neighbours: NDArray[np.int32],
    directions: NDArray[np.int32],
    values: NDArray[np.float32],
    gram: NDArray[np.float64],
    correlation: NDArray[np.float64],
    squared_norm: NDArray[np.float64],
) -> None:
    for i in range(start, end):
        system, y = _gather(rows, neighbours[i], directions[i], values[i])
        np.dot(system.T, system, gram[i])  # not into a slice: its error message alone compiles for seconds
        np.dot(system.T, y, correlation[i])
        squared_norm[i] = y @ y


@numba.njit(cache=True)
def _gather(
    rows: NDArray[np.float32],
    neighbours: NDArray[np.int32],
    directions: NDArray[np.int32],
    values: NDArray[np.float32],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A (m, k) and y (m,) of the m directions that one vertex has; zeros where it has fewer neighbours."""
    taken = np.flatnonzero(directions >= 0)
    system = np.zeros((len(taken), len(neighbours)))
    y = np.empty(len(taken))
    for q in range(len(taken)):
        y[q] = values[taken[q]]
    for k in range(len(neighbours)):
        if neighbours[k] >= 0:
            row = rows[neighbours[k]]
            for q in range(len(taken)):
                system[q, k] = row[directions[taken[q]]]
    return system, y
