"""Dense vertices near a vertex, from which its row of T is interpolated ([HR10] 5.3).

Dense vertices are brought into an order of their own (by position, then normal) before a tree is built over them, so
that the neighbours of a point depend on where things are, and not on the order in which they are listed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mi_sparse_prt.core.errors import PrtError

LEAST_COSINE = (
    0.2  # between the normals of neighbours on a surface; below, they see different halves of the scene
)
SPACINGS = 4096  # between vertices, of which the median is taken
WIDEST_SEARCH = 4  # times the wanted count, where normals rule candidates out


@dataclass(frozen=True)
class Neighbours:
    """Nearest dense vertices of n points, up to k each.

    Attributes
    ----------
    ids : (n, k) int32
        Rows of the dense set, nearest first; -1 where there are fewer.
    distances : (n, k) float32
        In the frame of the positions; inf where there are fewer.
    """

    ids: NDArray[np.int32]
    distances: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.ids)


def radius_neighbours(
    positions: NDArray[np.floating], dense_positions: NDArray[np.floating], radius: float, most: int = 40
) -> Neighbours:
    """The nearest dense vertices within a radius, as [HR10] 5.3 chooses them.

    Parameters
    ----------
    positions : (n, 3) float, any frame
    dense_positions : (n_dense, 3) float, same frame
    radius : float
        A neighbour is at most so far away; may be inf.
    most : int
        The k of the result.

    Returns
    -------
    Neighbours
        Which of equally distant ones comes first is decided by their positions; of vertices at one position, by
        their order in the dense set.

    Raises
    ------
    PrtError
        If a position is not finite, the radius is negative or not a number, or ``most`` is less than 1.
    """
    points = check_finite_rows(positions, "vertex", "position")
    dense = check_finite_rows(dense_positions, "dense vertex", "position")
    if not radius >= 0:
        raise PrtError(f"radius is {radius}: give a distance of 0 or more")
    _check_count("most", most)
    return _nearest(points, dense, most, radius)


def surface_neighbours(
    positions: NDArray[np.floating],
    normals: NDArray[np.floating],
    dense_positions: NDArray[np.floating],
    dense_normals: NDArray[np.floating],
    count: int,
) -> Neighbours:
    """The nearest dense vertices along a surface: near in position, and facing the same way.

    A radius alone ([HR10] 5.3) also finds the other side of a thin part and what lies around an edge. Here the
    distance is ``sqrt(|dp|^2 + (s |dn|)^2)``: normals at a right angle are as far apart as 1.4 steps s between dense
    vertices. Those whose normals disagree (cosine <= 0.2) are left out.

    Parameters
    ----------
    positions, normals : (n, 3) float
        Of one mesh; unit normals, same frame.
    dense_positions, dense_normals : (n_dense, 3) float
        Of the same mesh.
    count : int
        The k of the result. A point may get fewer: the nearest ``4 count`` dense vertices are looked through.

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
    dense_p = check_finite_rows(dense_positions, "dense vertex", "position")
    dense_n = check_finite_rows(dense_normals, "dense vertex", "normal")
    s = _spacing(dense_p)
    points, dense = (
        np.hstack([p, s * n]),
        np.hstack([dense_p, s * dense_n]),
    )  # [vertex, xyz and scaled normal]
    ids, distances = _empty(len(p), count)
    reach, short = count, np.arange(len(p))
    while len(short):
        found = _nearest(points[short], dense, reach, np.inf)
        complete = _take_agreeing(found.ids, found.distances, short, n, dense_n, ids, distances)
        if reach >= min(len(dense), WIDEST_SEARCH * count):
            break
        reach, short = 2 * reach, short[~complete]
    return Neighbours(ids, distances)


@numba.njit(parallel=True, cache=True)
def _take_agreeing(
    found: NDArray[np.int32],
    found_distances: NDArray[np.float32],
    rows: NDArray[np.int64],
    normals: NDArray[np.float64],
    dense_normals: NDArray[np.float64],
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
            m = dense_normals[near]
            if n[0] * m[0] + n[1] * m[1] + n[2] * m[2] > LEAST_COSINE:
                ids[row, taken] = near
                distances[row, taken] = found_distances[i, k]
                taken += 1
        complete[i] = taken == ids.shape[1]
    return complete


def renumber(ids: NDArray[np.integer], names: NDArray[np.integer]) -> NDArray[np.int32]:
    """Neighbours by other names: ``names[ids]``, and -1 where there are none."""
    return np.append(names, -1).astype(np.int32)[ids]


def check_finite_rows(values: NDArray[np.floating], vertex: str, what: str) -> NDArray[np.float64]:
    """As (n, 3) float64, or an error that names the first row that is not finite."""
    rows = np.asarray(values, np.float64).reshape(-1, 3)
    bad = np.flatnonzero(~np.isfinite(rows).all(axis=1))
    if len(bad):
        raise PrtError(f"{vertex} {bad[0]} has the {what} {rows[bad[0]].tolist()}: repair the mesh")
    return rows


def _nearest(points: NDArray[np.float64], dense: NDArray[np.float64], k: int, radius: float) -> Neighbours:
    """Up to k nearest dense points (in any dimension) at distances of at most `radius`."""
    ids, distances = _empty(len(points), k)
    if not len(points) or not len(dense):
        return Neighbours(ids, distances)
    order = np.lexsort(dense.T[::-1])  # by x, then y, then z, ...
    tree = cKDTree(dense[order])
    asked = min(k, len(dense))
    # the tree's bound is exclusive, and it squares it: 0 must not become 0 again
    bound = math.nextafter(radius, math.inf) + 1e-150
    near, rows = tree.query(points, k=np.arange(1, asked + 1), distance_upper_bound=bound, workers=-1)
    distances[:, :asked] = near
    ids[:, :asked] = np.append(order, -1).astype(np.int32)[
        rows
    ]  # the tree's word for nothing is one row past its last
    return Neighbours(ids, distances)


def _empty(n: int, k: int) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """No neighbours: ids (n, k) and distances (n, k)."""
    return np.full((n, k), -1, np.int32), np.full((n, k), np.inf, np.float32)


def _spacing(dense_positions: NDArray[np.float64]) -> float:
    """Mean spacing of dense vertices: the median distance from a position to the nearest other one; 0 if there is none.

    Vertices that share a position (seams) count once.
    """
    ordered = dense_positions[np.lexsort(dense_positions.T)]
    first = np.ones(len(ordered), bool)
    first[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    places = ordered[first]
    if len(places) < 2:
        return 0.0
    some = places[:: -(-len(places) // SPACINGS)]
    return float(np.median(cKDTree(places).query(some, k=[2], workers=-1)[0]))


def _check_count(name: str, value: int) -> None:
    if value < 1:
        raise PrtError(f"{name} is {value}: ask for 1 neighbour or more")
