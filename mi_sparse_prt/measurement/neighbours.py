"""Neighbours among measurement points: the nearest of some candidates, in space or along a surface ([HR10] 5.3).

Candidates are brought into an order of their own (by position, then normal) before a tree is built over them, so that
the neighbours of a point depend on where things are, and not on the order in which they are listed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mi_sparse_prt.core.errors import PrtError

FEW = 1024  # points whose neighbours one thread looks for


@dataclass(frozen=True)
class Neighbours:
    """Nearest candidates of n points, up to k each.

    Attributes
    ----------
    ids : (n, k) int32
        Rows of the candidates, nearest first; -1 where there are fewer.
    distances : (n, k) float32
        In the frame of the positions; inf where there are fewer.
    """

    ids: NDArray[np.int32]
    distances: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.ids)


def radius_neighbours(
    positions: NDArray[np.floating], candidates: NDArray[np.floating], radius: float, most: int = 40
) -> Neighbours:
    """The nearest candidates within a radius, as [HR10] 5.3 chooses dense vertices.

    Parameters
    ----------
    positions : (n, 3) float, any frame
    candidates : (m, 3) float, same frame
    radius : float
        A neighbour is at most so far away; may be inf.
    most : int
        The k of the result.

    Returns
    -------
    Neighbours
        Which of equally distant ones comes first is decided by their positions; of those at one position, by
        their order among the candidates.

    Raises
    ------
    PrtError
        If a position is not finite, the radius is negative or not a number, or ``most`` is less than 1.
    """
    points = check_finite_rows(positions, "vertex", "position")
    others = check_finite_rows(candidates, "candidate", "position")
    if not radius >= 0:
        raise PrtError(f"radius is {radius}: give a distance of 0 or more")
    _check_count("most", most)
    return _nearest(points, others, most, radius)


def surface_neighbours(
    positions: NDArray[np.floating],
    normals: NDArray[np.floating],
    candidate_positions: NDArray[np.floating],
    candidate_normals: NDArray[np.floating],
    count: int,
    least_cosine: float = 0.2,
    looked_through: int = 4,
) -> Neighbours:
    """The nearest candidates along a surface: near in position, and facing the same way.

    A radius alone ([HR10] 5.3) also finds the other side of a thin part and what lies around an edge. Here the
    distance is ``sqrt(|dp|^2 + (s |dn|)^2)``: normals at a right angle are as far apart as 1.4 steps s between
    candidates. Those whose normals disagree are left out.

    Parameters
    ----------
    positions, normals : (n, 3) float
        Of one mesh; unit normals, same frame.
    candidate_positions, candidate_normals : (m, 3) float
        Of the same mesh.
    count : int
        The k of the result. A point may get fewer.
    least_cosine : float
        Between normals; below it, points see different halves of the scene.
    looked_through : int
        Times ``count`` candidates, the nearest, are looked through at most.

    Returns
    -------
    Neighbours
        ``distances`` are those above.

    Raises
    ------
    PrtError
        If a position or a normal is not finite, or ``count`` is less than 1.
    """
    _check_count("count", count)
    p, n = check_finite_rows(positions, "vertex", "position"), check_finite_rows(normals, "vertex", "normal")
    candidate_p = check_finite_rows(candidate_positions, "candidate", "position")
    candidate_n = check_finite_rows(candidate_normals, "candidate", "normal")
    s = _spacing(candidate_p)
    points, others = (
        np.hstack([p, s * n]),
        np.hstack([candidate_p, s * candidate_n]),
    )  # [vertex, xyz and scaled normal]
    ids, distances = _empty(len(p), count)
    reach, short = count, np.arange(len(p))
    while len(short):
        found = _nearest(points[short], others, reach, np.inf)
        complete = _take_agreeing(
            found.ids, found.distances, short, n, candidate_n, least_cosine, ids, distances
        )
        if reach >= min(len(others), looked_through * count):
            break
        reach, short = 2 * reach, short[~complete]
    return Neighbours(ids, distances)


@numba.njit(parallel=True, cache=True)
def _take_agreeing(
    found: NDArray[np.int32],
    found_distances: NDArray[np.float32],
    rows: NDArray[np.int64],
    normals: NDArray[np.float64],
    candidate_normals: NDArray[np.float64],
    least_cosine: float,
    ids: NDArray[np.int32],
    distances: NDArray[np.float32],
) -> NDArray[np.bool_]:
    """Put the first of those found whose normals agree into `rows` of ids and distances, and say which are full.

    What the rows held before is overwritten.
    """
    complete = np.empty(len(rows), np.bool_)
    for i in numba.prange(len(rows)):
        row, taken = rows[i], 0
        n = normals[row]
        for k in range(found.shape[1]):
            near = found[i, k]
            if near < 0 or taken == ids.shape[1]:
                break
            m = candidate_normals[near]
            if n[0] * m[0] + n[1] * m[1] + n[2] * m[2] > least_cosine:
                ids[row, taken] = near
                distances[row, taken] = found_distances[i, k]
                taken += 1
        complete[i] = taken == ids.shape[1]
    return complete


def renumber(ids: NDArray[np.integer], numbers: NDArray[np.integer]) -> NDArray[np.int32]:
    """Neighbours by other numbers: ``numbers[ids]``, and -1 where there are none."""
    return np.append(numbers, -1).astype(np.int32)[ids]


def check_finite_rows(values: NDArray[np.floating], vertex: str, what: str) -> NDArray[np.float64]:
    """As (n, 3) float64, or an error that names the first row that is not finite."""
    rows = np.asarray(values, np.float64).reshape(-1, 3)
    bad = np.flatnonzero(~np.isfinite(rows).all(axis=1))
    if len(bad):
        raise PrtError(f"{vertex} {bad[0]} has the {what} {rows[bad[0]].tolist()}: repair the mesh")
    return rows


def _nearest(
    points: NDArray[np.float64], candidates: NDArray[np.float64], k: int, radius: float
) -> Neighbours:
    """Up to k nearest candidates (in any dimension) at distances of at most `radius`."""
    ids, distances = _empty(len(points), k)
    if not len(points) or not len(candidates):
        return Neighbours(ids, distances)
    order = np.lexsort(candidates.T[::-1])  # by x, then y, then z, ...
    tree = cKDTree(candidates[order])
    asked = min(k, len(candidates))
    # the tree's bound is exclusive, and it squares it: 0 must not become 0 again
    bound = math.nextafter(radius, math.inf) + 1e-150
    near, rows = tree.query(
        points, k=np.arange(1, asked + 1), distance_upper_bound=bound, workers=_workers(len(points))
    )
    distances[:, :asked] = near
    ids[:, :asked] = np.append(order, -1).astype(np.int32)[
        rows
    ]  # the tree's word for nothing is one row past its last
    return Neighbours(ids, distances)


def _workers(asked: int) -> int:
    """Threads for a search: to start all takes longer than it takes one to find neighbours of few points."""
    return -1 if asked > FEW else 1


def _empty(n: int, k: int) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """No neighbours: ids (n, k) and distances (n, k)."""
    return np.full((n, k), -1, np.int32), np.full((n, k), np.inf, np.float32)


def _spacing(candidates: NDArray[np.float64]) -> float:
    """Spacing of candidates: the median distance from a position to the nearest other one; 0 if there is none.

    Those that share a position (seams) count once.
    """
    ordered = candidates[np.lexsort(candidates.T)]
    first = np.ones(len(ordered), bool)
    first[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    places = ordered[first]
    if len(places) < 2:
        return 0.0
    some = places[:: -(-len(places) // 4096)]  # enough for a median
    return float(np.median(cKDTree(places).query(some, k=[2], workers=_workers(len(some)))[0]))


def _check_count(name: str, value: int) -> None:
    if value < 1:
        raise PrtError(f"{name} is {value}: ask for 1 neighbour or more")
