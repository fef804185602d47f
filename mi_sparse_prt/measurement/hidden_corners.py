"""Corners of triangles behind a wall: one that passes through a triangle has light on one side, and other on the other.

Light is known at vertices, and interpolated between them. Of a floor that goes on below a wall, a triangle under the
wall has corners on both sides of it; what lies on one side is lit by the corners on that side. Behind a board that is
just before a wall it is dark: corners there light no point beside the board.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from functools import cached_property
from weakref import WeakKeyDictionary

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_sparse_prt.measurement.covered_corners import ALL, CoveredCorners, around_of, narrow_height, room
from mi_sparse_prt.measurement.vertices import vertex_points
from mi_sparse_prt.scene.ray_offsets import ray_offset
from mi_sparse_prt.scene.scene import Scene

TRIANGLES = 1 << 20  # at a time
SHORT = 0.99  # of the way to a corner: what is met beyond hides nothing

_KNOWN: WeakKeyDictionary[Scene, HiddenCorners] = WeakKeyDictionary()


def hidden_corners(scene: Scene) -> HiddenCorners:
    """Those of a scene; the same ones each time."""
    if scene not in _KNOWN:
        _KNOWN[scene] = HiddenCorners(scene)
    return _KNOWN[scene]


class HiddenCorners:
    """Which corners of its triangle a wall hides from a point on it.

    Triangles are those of all shapes, shape after shape; points and normals are in the normalised frame, or as
    ``in_world`` says.

    Parameters
    ----------
    scene : Scene

    Attributes
    ----------
    some : bool
        Whether there is any wall.

    Notes
    -----
    A wall passes through two edges of a triangle, and leaves one corner alone. What passes through one edge ends within
    the triangle, and hides nothing.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene, self._unit = scene.normalised, 1.0
        triangles = np.concatenate([mesh.triangles + mesh.vertices.start for mesh in scene.fronts])
        self._places = vertex_points(scene).positions[triangles]  # [triangle, corner, xyz]
        self._ends = np.cumsum([0, *(len(mesh.triangles) for mesh in scene.fronts)])
        self._two_sided = scene.backs[triangles[:, 0]] >= 0
        self._corners = mi.Point3f(self._places.reshape(-1, 3).T)
        cut = np.zeros(len(triangles), bool)
        for a in range(0, len(triangles), TRIANGLES):
            part = slice(a, min(a + TRIANGLES, len(triangles)))
            index = dr.arange(mi.UInt32, part.start, part.stop)
            cut[part] = self._crossed(index).numpy()
        self.some = bool(cut.any())
        self._cut = mi.Bool(cut)

    def in_world(self, scene: Scene) -> HiddenCorners:
        """The same for points in world space, for rays that are traced there: a kernel on a GPU has one scene only.

        Parameters
        ----------
        scene : Scene
        """
        some = self._covered.some  # found now, and not while a loop is traced
        found = copy(self)
        found._scene, found._corners = scene.world, scene.to_world(self._corners)
        found._unit = 1 / scene.scale
        found.some = self.some or some
        return found

    @cached_property
    def _covered(self) -> CoveredCorners:
        return CoveredCorners(self._scene, self._places, self._ends, self._two_sided)

    def corners(
        self,
        triangle: mi.UInt32,
        point: mi.Point3f,
        way: mi.Vector3f,
        weights: Sequence[mi.Float],
        active: mi.Mask,
    ) -> tuple[mi.UInt32, list[mi.Float]]:
        """The triangle whose corners light points, and their weights: 0 where one that is seen hides others.

        Covered corners are hidden from points that are not, and the others from those that are: what stands a
        millimetre before a wall leaves the wall dark up to its edge, not beyond. Where all corners are covered and the
        point is not, a triangle beside stands in, if any is alike.

        Parameters
        ----------
        triangle : UInt32
        point : Point3f
        way : Vector3f
            Of the ray that met it there: on which side of the triangle it is.
        weights : three Float
            Barycentric; those that are returned add to 1, too.
        active : Mask
        """
        cut = active & dr.gather(mi.Bool, self._cut, triangle, active)
        p, normal = self._placed(triangle, active)
        front = dr.dot(normal, way) < 0
        normal = dr.select(front, normal, -normal)
        seen = [~self._hides(3 * triangle + k, point, normal, cut) for k in range(3)]
        narrow, inside = self._covered.corners(triangle, front, active)
        changed = cut | (narrow != 0) | (inside != 0)
        covered = self._is_covered(p, point, normal, narrow != 0, inside != 0)
        covers = narrow | inside
        other = self._covered.beside(triangle, front, changed & ~covered & (covers == ALL))
        replaced = changed & ~covered & (other != triangle)
        narrow, inside = self._covered.corners(other, front, replaced)
        covers = dr.select(replaced, narrow | inside, covers)
        weights = [dr.select(replaced, 1 / 3, w) for w in weights]
        seen = [(s | replaced) & (((covers & (1 << k)) != 0) == covered) for k, s in enumerate(seen)]
        none = ~(seen[0] | seen[1] | seen[2])
        kept = [dr.select(k | none, dr.maximum(w, 1e-6), 0) for k, w in zip(seen, weights, strict=True)]
        total = kept[0] + kept[1] + kept[2]
        found = [dr.select(changed, some / total, w) for some, w in zip(kept, weights, strict=True)]
        return dr.select(replaced, other, triangle), found

    def _is_covered(
        self,
        corners: list[mi.Point3f],
        point: mi.Point3f,
        normal: mi.Vector3f,
        narrow: mi.Mask,
        inside: mi.Mask,
    ) -> mi.Mask:
        """Whether points are in a narrow gap, or inside of a solid, as some corner of their triangle is."""
        height, around = narrow_height(corners), around_of(corners)
        way, behind = room(self._scene, self._corners, point, normal, around, self._unit, narrow | inside)
        return (narrow & (way < height)) | (inside & behind)

    def choose(
        self,
        triangle: mi.UInt32,
        point: mi.Point3f,
        way: mi.Vector3f,
        weights: Sequence[mi.Float],
        u: mi.Float,
        active: mi.Mask,
    ) -> mi.UInt32:
        """A corner, 0 to 2, that u in [0, 1) chooses by ``weights``, see there."""
        first, rest = _chosen(weights, u)
        return dr.if_stmt(  # few are cut, and ask for more rays
            (triangle, mi.Point3f(point), mi.Vector3f(way), list(weights), first, rest),
            active & dr.gather(mi.Bool, self._cut, triangle, active),
            self._first_seen,
            lambda triangle, point, way, weights, first, rest: first,
        )

    def _first_seen(
        self,
        triangle: mi.UInt32,
        point: mi.Point3f,
        way: mi.Vector3f,
        weights: list[mi.Float],
        first: mi.UInt32,
        rest: mi.Float,
    ) -> mi.UInt32:
        """The first corner if it is seen; else one of the others, by what is left of a random number."""
        every = mi.Mask(True)
        normal = self._side(triangle, way, every)
        second, third = (first + 1) % 3, (first + 2) % 3
        a, b = _weight(weights, second), _weight(weights, third)
        swapped = rest * (a + b) >= a
        second, third = dr.select(swapped, third, second), dr.select(swapped, second, third)
        hidden = self._hides(3 * triangle + first, point, normal, every)
        twice = hidden & self._hides(3 * triangle + second, point, normal, hidden)
        none = twice & self._hides(3 * triangle + third, point, normal, twice)
        return dr.select(none | ~hidden, first, dr.select(twice, third, second))

    def _side(self, triangle: mi.UInt32, way: mi.Vector3f, active: mi.Mask) -> mi.Vector3f:
        """Normals of triangles on the side that rays meet."""
        _, normal = self._placed(triangle, active)
        return dr.mulsign(normal, -dr.dot(normal, way))

    def _hides(self, corner: mi.UInt32, point: mi.Point3f, normal: mi.Vector3f, active: mi.Mask) -> mi.Mask:
        """Whether something hides corners of triangles from points on these."""
        return active & self._blocked(
            point, dr.gather(mi.Point3f, self._corners, corner, active), normal, active
        )

    def _crossed(self, triangle: mi.UInt32) -> mi.Mask:
        """Whether walls pass through at least two edges, on one side of triangles."""
        p, normal = self._placed(triangle, mi.Mask(True))
        crossed = dr.zeros(mi.Mask, dr.width(triangle))
        for side in (normal, -normal):
            starts = [dr.lerp(p[k - 1], p[k], 1 - SHORT) for k in range(3)]
            a, b, c = (self._blocked(starts[k], p[k], side, mi.Mask(True)) for k in range(3))
            crossed |= (a & b) | (b & c) | (c & a)
        return crossed

    def _placed(self, triangle: mi.UInt32, active: mi.Mask) -> tuple[list[mi.Point3f], mi.Vector3f]:
        """The corners of triangles, and their normals."""
        p = [dr.gather(mi.Point3f, self._corners, 3 * triangle + k, active) for k in range(3)]
        return p, dr.normalize(dr.cross(p[1] - p[0], p[2] - p[0]))

    def _blocked(self, start: mi.Point3f, end: mi.Point3f, normal: mi.Vector3f, active: mi.Mask) -> mi.Mask:
        """Whether something is in the way from a point to a corner, just above the triangle that both are on."""
        lifted = dr.fma(normal, ray_offset(start, self._unit), start)
        ray = mi.Ray3f(lifted, end - start)
        ray.maxt = mi.Float(SHORT)
        return self._scene.ray_test(ray, active)


def _chosen(weights: Sequence[mi.Float], u: mi.Float) -> tuple[mi.UInt32, mi.Float]:
    """The corner that u chooses, and what is left of u: again a number in [0, 1)."""
    ends = weights[1], weights[1] + weights[2]
    corner = dr.select(u < ends[0], 1, dr.select(u < ends[1], mi.UInt32(2), 0))
    start = dr.select(corner == 1, 0, dr.select(corner == 2, ends[0], ends[1]))
    return corner, (u - start) / dr.maximum(_weight(weights, corner), 1e-9)


def _weight(weights: Sequence[mi.Float], corner: mi.UInt32) -> mi.Float:
    return dr.select(corner == 0, weights[0], dr.select(corner == 1, weights[1], weights[2]))
