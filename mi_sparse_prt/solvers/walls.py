"""What stands between neighbours: a floor may be one mesh on both sides of a wall, and light is not."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.device_arrays import on_device
from mi_sparse_prt.measurement.neighbours import Neighbours
from mi_sparse_prt.measurement.point_arrays import PointArrays
from mi_sparse_prt.measurement.vertices import Points
from mi_sparse_prt.scene.ray_offsets import ray_offset
from mi_sparse_prt.scene.scene import Scene

PAIRS = 1 << 22  # at a time

Ids = NDArray[np.integer]


class Walls:
    """Surfaces of a scene that stand between some of its points.

    Parameters
    ----------
    scene : Scene
    points : Points
    gaps : bool
        Whether a straight way is one as well: points in a gap behind a door are then on one side.

    Notes
    -----
    A way between two neighbours leads over a place above the middle, half as high as they are apart: straight lines
    would pass below a surface that is bent outwards. It clears such a surface as far as normals are at a right angle.
    What is lower than that is no wall: light comes over it.
    """

    def __init__(self, scene: Scene, points: Points, gaps: bool = False) -> None:
        self._scene, self._points, self._gaps = scene.unsplit, PointArrays(points), gaps

    def between(self, first: Ids, second: Ids) -> NDArray[np.bool_]:
        """Whether something stands between points (m,) and points (m,) that face the same way, (m,) bool."""
        found = np.zeros(len(first), bool)
        for a in range(0, len(first), PAIRS):
            part = slice(a, a + PAIRS)
            p, n = self._above(on_device(mi.UInt32, first[part].astype(np.uint32)))
            q, m = self._above(on_device(mi.UInt32, second[part].astype(np.uint32)))
            middle = 0.5 * (p + q) + 0.5 * dr.norm(p - q) * dr.normalize(n + m)
            blocked = self._blocked(p, middle) | self._blocked(q, middle)
            found[part] = (blocked & self._blocked(p, q) if self._gaps else blocked).numpy()
        return found

    def leave_fewer(self, least: int, ids: Ids, near: NDArray[np.int32]) -> NDArray[np.bool_]:
        """Whether points (n,) have fewer than so many neighbours (n, k) on their side; the nearest come first, -1 last.

        The nearest ones mostly tell, and others are not asked then.
        """
        counts, short = np.zeros(len(ids), np.int64), np.arange(len(ids))
        for columns in (slice(least), slice(least, None)):
            row, place = np.nonzero(near[short, columns] >= 0)
            seen = ~self.between(ids[short][row], near[short, columns][row, place])
            counts[short] += np.bincount(row[seen], minlength=len(short))
            short = short[counts[short] < least]
        return counts < least

    def without_hidden(self, ids: Ids, neighbours: Neighbours, candidates: Ids) -> Neighbours:
        """Without those behind a wall.

        Parameters
        ----------
        ids : (n,) integers
            The points whose neighbours these are.
        neighbours : Neighbours
        candidates : (m,) integers
            The points among which these were found.
        """
        row, place = np.nonzero(neighbours.ids >= 0)
        seen = ~self.between(ids[row], candidates[neighbours.ids[row, place]])
        if seen.all():
            return neighbours
        row, place = row[seen], place[seen]
        near, distances = np.full_like(neighbours.ids, -1), np.full_like(neighbours.distances, np.inf)
        counts = np.bincount(row, minlength=len(ids))
        to = np.arange(len(row)) - np.repeat(np.cumsum(counts) - counts, counts)  # the first ones of each row
        near[row, to], distances[row, to] = neighbours.ids[row, place], neighbours.distances[row, place]
        return Neighbours(near, distances)

    def _above(self, ids: mi.UInt32) -> tuple[mi.Point3f, mi.Vector3f]:
        """Points where rays start, and normals."""
        p, n = self._points.position(ids), mi.Vector3f(self._points.normal(ids))
        return p + ray_offset(p) * n, n

    def _blocked(self, start: mi.Point3f, end: mi.Point3f) -> mi.Mask:
        ray = mi.Ray3f(start, end - start)
        ray.maxt = mi.Float(1)
        return self._scene.ray_test(ray)
