"""Which directions of a sparse vertex are evaluated ([HR10] 5.2): those in which its dense neighbours differ."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.bits import Bits
from mi_sparse_prt.core.heap import keep_largest


def find_contested(
    neighbours: NDArray[np.int32],
    visible: Bits,
    known: Bits,
    vertices: NDArray[np.int64],
    above: Bits,
    evaluated: Bits,
) -> Bits:
    """Directions in which a vertex's neighbours differ or know nothing: those to sample.

    The limit of [HR10] 5.2 for binary visibility: the variance among the neighbours is not zero. All such directions
    are taken, be they more or fewer than the paper's 350.

    Parameters
    ----------
    neighbours : (n, k) int32
        Rows of ``visible`` and ``known``; -1 where there are fewer.
    visible, known : (m, words) uint32 bits
        Visibility of the neighbours, and the directions in which it is known (above their horizon).
    vertices : (n,) int
        Rows of ``above`` and ``evaluated``: whose neighbours these are.
    above, evaluated : (n_v, words) uint32 bits
        Directions above the horizon, and those that were sampled before.

    Returns
    -------
    (n, words) uint32 bits
        Above the vertex's own horizon, and not sampled before.
    """
    differ = np.empty((len(vertices), above.shape[1]), np.uint32)
    _find_contested(neighbours, visible, known, vertices, above, evaluated, differ)
    return differ


@numba.njit(parallel=True, cache=True)
def _find_contested(
    neighbours: NDArray[np.int32],
    visible: Bits,
    known: Bits,
    vertices: NDArray[np.int64],
    above: Bits,
    evaluated: Bits,
    differ: Bits,
) -> None:
    for i in numba.prange(len(vertices)):
        lit, dark = _kinds(neighbours[i], visible, known)
        row = vertices[i]
        for w in range(above.shape[1]):
            differ[i, w] = above[row, w] & ~evaluated[row, w] & ~(lit[w] ^ dark[w])


@numba.njit(parallel=True, cache=True)
def copy_agreed(
    neighbours: NDArray[np.int32],
    visible: Bits,
    known: Bits,
    vertices: NDArray[np.int64],
    above: Bits,
    result: Bits,
) -> None:
    """Give vertices the visibility on which their neighbours agree; parameters as for ``find_contested``.

    ``result`` (n_v, words): rows of the vertices are overwritten, with 0 where neighbours differ or know nothing.
    """
    for i in numba.prange(len(vertices)):
        lit, dark = _kinds(neighbours[i], visible, known)
        row = vertices[i]
        for w in range(above.shape[1]):
            result[row, w] = above[row, w] & lit[w] & ~dark[w]


@numba.njit(cache=True)
def _kinds(neighbours: NDArray[np.int32], visible: Bits, known: Bits) -> tuple[Bits, Bits]:
    """Directions in which any of the neighbours sees the sky, and in which any does not, (words,) each."""
    words = visible.shape[1]
    lit, dark = np.zeros(words, np.uint32), np.zeros(words, np.uint32)
    for row in neighbours:
        if row < 0:
            break
        seen, knows = visible[row], known[row]
        for w in range(words):
            lit[w] |= seen[w]
            dark[w] |= knows[w] & ~seen[w]
    return lit, dark


@numba.njit(parallel=True, cache=True)
def choose_features(
    neighbours: NDArray[np.int32], rows: NDArray[np.float32], features: Bits, count: int
) -> NDArray[np.int32]:
    """The paper's choice: variance among the dense neighbours x number of them in which a direction was a feature.

    Parameters
    ----------
    neighbours : (n, k) int32
        Rows of ``rows`` and ``features``; -1 where there are fewer.
    rows : (m, n_directions) float32
        Transport of the dense vertices.
    features : (m, words) uint32 bits
        Directions that the second angular pass added at each dense vertex.
    count : int
        Directions per vertex at most; fewer where fewer have weight.

    Returns
    -------
    (n, count) int32
        Ascending, -1 where there are fewer.
    """
    chosen = np.full((len(neighbours), count), -1, np.int32)
    for i in numba.prange(len(neighbours)):
        _choose(neighbours[i], rows, features, chosen[i])
    return chosen


@numba.njit(cache=True)
def _choose(
    neighbours: NDArray[np.int32], rows: NDArray[np.float32], features: Bits, chosen: NDArray[np.int32]
) -> None:
    """For one vertex; apart from the parallel loop, into which it would be compiled twice."""
    count = len(chosen)
    if count == 0:
        return
    weight = _weights(rows, features, neighbours)
    largest = np.empty(count)
    found = keep_largest(weight, count, largest, np.empty(count, np.int64))
    least = largest[count - 1] if found == count else 0.0
    ties, place = count, 0  # how many of the least are taken
    for j in range(len(weight)):
        ties -= weight[j] > least
    for j in range(len(weight)):
        if weight[j] > least or (weight[j] == least and ties > 0 and least > 0):
            ties -= weight[j] == least
            chosen[place] = j
            place += 1


@numba.njit(cache=True)
def _weights(rows: NDArray[np.float32], features: Bits, near: NDArray[np.int32]) -> NDArray[np.float64]:
    """Variance x number of features for every direction, over neighbours ``near`` (-1 where there are fewer)."""
    n_directions = rows.shape[1]
    total, squares = np.zeros(n_directions), np.zeros(n_directions)
    times, known = np.zeros(n_directions, np.int64), 0
    for row in near:
        if row < 0:
            continue
        known += 1
        for j in range(n_directions):
            total[j] += rows[row, j]
            squares[j] += np.float64(rows[row, j]) * rows[row, j]
            times[j] += (features[row, j >> 5] >> np.uint32(j & 31)) & np.uint32(1)
    for j in range(n_directions):  # the weights take the place of the squares
        mean = total[j] / max(known, 1)
        squares[j] = max(squares[j] / max(known, 1) - mean * mean, 0.0) * times[j]
    return squares
