"""Corners of triangles behind a wall: one that passes through a triangle has light on one side, and other on the other.

Light is known at vertices, and interpolated between them. Of a floor that goes on below a wall, a triangle under the
wall has corners on both sides of it; what lies on one side is lit by the corners on that side. Behind a board that is
just before a wall it is dark: corners there light no point beside the board.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from copy import copy
from functools import cached_property
from weakref import WeakKeyDictionary

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_sparse_prt.measurement.vertices import vertex_points
from mi_sparse_prt.scene.ray_offsets import ray_offset
from mi_sparse_prt.scene.scene import Scene

TRIANGLES = 1 << 20  # at a time
NARROW = 1 / 16  # of the size of a triangle, its area's root: in narrower gaps light changes too fast for it
ASIDE = 1 / 8  # of the way from a corner to the middle, where it is asked whether that is in a gap
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
        self._corners = mi.Point3f(vertex_points(scene).positions[triangles.ravel()].T)
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
        found = copy(self)
        found._scene, found._corners = scene.world, scene.to_world(self._corners)
        found._unit = 1 / scene.scale
        vars(found).pop("_gaps", None)  # those of the other frame
        in_gaps = bool(dr.any(found._gaps != 0))  # found now, and not while a loop is traced
        found.some = self.some or in_gaps
        return found

    def weights(
        self,
        triangle: mi.UInt32,
        point: mi.Point3f,
        way: mi.Vector3f,
        weights: Sequence[mi.Float],
        active: mi.Mask,
    ) -> list[mi.Float]:
        """Barycentric weights of points, those of hidden corners 0 where another one is seen; they add to 1.

        Corners in a narrow gap are hidden from points that are in none, and the others from those that are in one:
        what stands a millimetre before a wall leaves the wall dark up to its edge, not beyond.

        Parameters
        ----------
        triangle : UInt32
        point : Point3f
        way : Vector3f
            Of the ray that met it there: on which side of the triangle it is.
        weights : three Float
        active : Mask
        """
        cut = active & dr.gather(mi.Bool, self._cut, triangle, active)
        gaps = dr.gather(mi.UInt8, self._gaps, triangle, active)
        p, normal = self._placed(triangle, active)
        front = dr.dot(normal, way) < 0
        normal = dr.select(front, normal, -normal)
        seen = [~self._hides(3 * triangle + k, point, normal, cut) for k in range(3)]
        cut |= gaps != 0
        inside = cut & self._is_narrow(point, normal, _height(p), cut)
        for k in range(3):
            corner_inside = (gaps & dr.select(front, mi.UInt8(1 << k), mi.UInt8(8 << k))) != 0
            seen[k] &= corner_inside == inside
        none = ~(seen[0] | seen[1] | seen[2])
        kept = [dr.select(k | none, dr.maximum(w, 1e-6), 0) for k, w in zip(seen, weights, strict=True)]
        total = kept[0] + kept[1] + kept[2]
        return [dr.select(cut, some / total, w) for some, w in zip(kept, weights, strict=True)]

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

    @cached_property
    def _gaps(self) -> mi.UInt8:
        """Which corners of each triangle are in a gap that is narrow for it: three bits for the front, three behind."""
        gaps = np.zeros(dr.width(self._corners) // 3, np.uint8)
        for a in range(0, len(gaps), TRIANGLES):
            p, normal = self._placed(dr.arange(mi.UInt32, a, min(a + TRIANGLES, len(gaps))), mi.Mask(True))
            middle, height, found = (p[0] + p[1] + p[2]) / 3, _height(p), mi.UInt32(0)
            for bit, (side, corner) in enumerate(itertools.product((normal, -normal), p)):
                narrow = self._is_narrow(dr.lerp(corner, middle, ASIDE), side, height, mi.Mask(True))
                found |= dr.select(narrow, mi.UInt32(1 << bit), 0)
            gaps[a : a + TRIANGLES] = found.numpy()
        return mi.UInt8(gaps)

    def _is_narrow(
        self, point: mi.Point3f, normal: mi.Vector3f, height: mi.Float, active: mi.Mask
    ) -> mi.Mask:
        """Whether there is less room than so much above points."""
        ray = mi.Ray3f(dr.fma(normal, ray_offset(point, self._unit), point), normal)
        ray.maxt = height
        return self._scene.ray_test(ray, active)

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


def _height(p: Sequence[mi.Point3f]) -> mi.Float:
    """Of gaps that are narrow for triangles, by their corners."""
    return NARROW * dr.sqrt(dr.norm(dr.cross(p[1] - p[0], p[2] - p[0])))


def _chosen(weights: Sequence[mi.Float], u: mi.Float) -> tuple[mi.UInt32, mi.Float]:
    """The corner that u chooses, and what is left of u: again a number in [0, 1)."""
    ends = weights[1], weights[1] + weights[2]
    corner = dr.select(u < ends[0], 1, dr.select(u < ends[1], mi.UInt32(2), 0))
    start = dr.select(corner == 1, 0, dr.select(corner == 2, ends[0], ends[1]))
    return corner, (u - start) / dr.maximum(_weight(weights, corner), 1e-9)


def _weight(weights: Sequence[mi.Float], corner: mi.UInt32) -> mi.Float:
    return dr.select(corner == 0, weights[0], dr.select(corner == 1, weights[1], weights[2]))
