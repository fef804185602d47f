"""Which directions of a sparse vertex are evaluated ([HR10] 5.2): those in which its dense neighbours differ."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.sampling.bits import Bits


def contested(neighbours: NDArray[np.int32], visible: Bits, known: Bits, asked: Bits) -> tuple[Bits, Bits]:
    """Directions in which a vertex's neighbours differ or know nothing, and what they agree on elsewhere.

    The limit of [HR10] 5.2 for binary visibility: the variance among the neighbours is not zero. All such directions
    are taken, be they more or fewer than the paper's 350.

    Parameters
    ----------
    neighbours : (n, k) int32
        Rows of ``visible`` and ``known``; -1 where there are fewer.
    visible, known : (m, words) uint32 bits
        Visibility of the neighbours, and the directions in which it is known (above their horizon).
    asked : (n, words) uint32 bits
        Directions that matter: above the vertices' own horizon.

    Returns
    -------
    differ, agreed : (n, words) uint32 bits
        Of those asked for, directions to sample; and those in which all that know see the sky.
    """
    differ, agreed = np.empty_like(asked), np.empty_like(asked)
    _contested(neighbours, visible, known, asked, differ, agreed)
    return differ, agreed


@numba.njit(parallel=True, cache=True)
def _contested(
    neighbours: NDArray[np.int32], visible: Bits, known: Bits, asked: Bits, differ: Bits, agreed: Bits
) -> None:
    words = asked.shape[1]
    for i in numba.prange(len(asked)):
        lit, dark = np.zeros(words, np.uint32), np.zeros(words, np.uint32)
        for k in range(neighbours.shape[1]):
            row = neighbours[i, k]
            if row < 0:
                break
            seen, knows = visible[row], known[row]
            for w in range(words):
                lit[w] |= seen[w]
                dark[w] |= knows[w] & ~seen[w]
        for w in range(words):
            differ[i, w] = asked[i, w] & ~(lit[w] ^ dark[w])
            agreed[i, w] = asked[i, w] & lit[w] & ~dark[w]


@numba.njit(parallel=True, cache=True)
def best_features(
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
        near = neighbours[i][neighbours[i] >= 0]
        weight = _weights(rows, features, near)
        least = np.partition(weight, len(weight) - count)[len(weight) - count] if count < len(weight) else 0.0
        place = 0
        for ties in (False, True):
            for j in range(len(weight)):
                if weight[j] <= 0 or place == count:
                    continue
                if (weight[j] == least) if ties else (weight[j] > least):
                    chosen[i, place] = j
                    place += 1
        chosen[i, :place].sort()
    return chosen


@numba.njit(cache=True)
def _weights(rows: NDArray[np.float32], features: Bits, near: NDArray[np.int32]) -> NDArray[np.float64]:
    """Variance x number of features for every direction, over the neighbours ``near``."""
    n_directions = rows.shape[1]
    total, squares = np.zeros(n_directions), np.zeros(n_directions)
    times = np.zeros(n_directions, np.int64)
    for row in near:
        for j in range(n_directions):
            total[j] += rows[row, j]
            squares[j] += np.float64(rows[row, j]) * rows[row, j]
            times[j] += (features[row, j >> 5] >> np.uint32(j & 31)) & np.uint32(1)
    known = max(len(near), 1)
    return np.maximum(squares / known - (total / known) ** 2, 0.0) * times
