"""Corners of triangles that are covered: what lies on a surface, or just before it, leaves them dark, not all around.

Light is known at vertices, and interpolated between them. Where slats are nailed to a post, its vertices below them are
dark; between the slats the post is as bright as elsewhere.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mi_sparse_prt.scene.ray_offsets import ray_offset
from mi_sparse_prt.scene.traced_scene import TracedScene

TRIANGLES = 1 << 20  # at a time
NARROW = 1 / 16  # of the size of a triangle, its area's root: in narrower gaps light changes too fast for it
ASIDE = 1 / 8  # of the way from a corner to the middle, where it is asked whether that is in a gap
RAYS = 32  # into the hemisphere of a corner: whether it is inside of something
AROUND = 2  # longest edges of a triangle: the mean of these rays, at most. A room is larger
NEAREST = 16  # triangles, of which one stands in for another
ALIKE = 0.5  # cosine between the normals of these two, at least
ALL = 0b111  # corners, as bits

Corners = NDArray[np.float32]  # (triangles, 3, 3), the places of corners


class CoveredCorners:
    """Which corners of triangles are covered, on either side.

    Parameters
    ----------
    scene : TracedScene
    corners : (n_t, 3, 3) float32
        Places of the corners of triangles, in the frame of the scene, of size 1.
    ends : (meshes + 1,) integers
        Where the triangles of each mesh begin, and where the last ones end.
    two_sided : (n_t,) bool
        Which of them can be seen from behind: all others are asked about from the front alone.

    Attributes
    ----------
    some : bool
        Whether any corner is.

    Notes
    -----
    A corner is covered in one of two ways. In a narrow gap, there is little room above the place at an eighth of the
    way from it to the middle (at the foot of a wall there is room). Inside of a solid, all its rays meet surfaces from
    behind, and the mean of their lengths is no more than a few edges (from within a room, walls are farther away).
    """

    def __init__(
        self,
        scene: TracedScene,
        corners: Corners,
        ends: NDArray[np.integer],
        two_sided: NDArray[np.bool_],
    ) -> None:
        self._scene = scene
        self._places = mi.Point3f(corners.reshape(-1, 3).T)
        found = np.zeros((2, len(corners)), np.uint8)  # [way, triangle]
        for side, asked in enumerate((np.arange(len(corners)), np.flatnonzero(two_sided))):
            for a in range(0, len(asked), TRIANGLES):
                some = asked[a : a + TRIANGLES]
                found[:, some] |= self._found(corners[some], 1 - 2 * side) << 3 * side
        self.some = bool(found.any())
        self._narrow, self._inside = (mi.UInt8(bits) for bits in found)
        self._beside = mi.UInt32(_stand_ins(found[0] | found[1], corners, ends).ravel())

    def corners(self, triangle: mi.UInt32, front: mi.Mask, active: mi.Mask) -> tuple[mi.UInt32, mi.UInt32]:
        """Those of triangles that are in narrow gaps on a side, and those inside of solids: three bits each."""
        both = [
            mi.UInt32(dr.gather(mi.UInt8, bits, triangle, active)) for bits in (self._narrow, self._inside)
        ]
        narrow, inside = (dr.select(front, bits & ALL, bits >> 3) for bits in both)
        return narrow, inside

    def beside(self, triangle: mi.UInt32, front: mi.Mask, active: mi.Mask) -> mi.UInt32:
        """Triangles that stand in for those all of whose corners are covered on a side; themselves if none does."""
        place = 2 * triangle + dr.select(front, mi.UInt32(0), 1)
        return dr.select(active, dr.gather(mi.UInt32, self._beside, place, active), triangle)

    def _found(self, corners: Corners, side: int) -> NDArray[np.uint8]:
        """(2, n_t): three bits for triangles, on the side of their normals or, if that is -1, the other."""
        p = [mi.Point3f(np.ascontiguousarray(corners[:, k].T)) for k in range(3)]
        normal = side * dr.normalize(dr.cross(p[1] - p[0], p[2] - p[0]))
        middle, every = (p[0] + p[1] + p[2]) / 3, mi.Mask(True)
        height, around = narrow_height(p), around_of(p)
        found = np.zeros((2, len(corners)), np.uint8)
        for bit, corner in enumerate(p):
            narrow = self._room(dr.lerp(corner, middle, ASIDE), normal, height, every)[0] < height
            behind = self._room(corner, normal, around, every)[1]
            dr.eval(narrow, behind)
            inside = behind.numpy()
            some = np.flatnonzero(inside)
            if len(some):
                at, of = (values.numpy().T[some] for values in (corner, normal))
                inside[some] = self._mean_length(at, of) < around.numpy()[some]
            found |= np.stack([narrow.numpy(), inside]).astype(np.uint8) << bit
        return found

    def _room(
        self, point: mi.Point3f, normal: mi.Vector3f, most: mi.Float, active: mi.Mask
    ) -> tuple[mi.Float, mi.Mask]:
        return room(self._scene, self._places, point, normal, most, 1.0, active)

    def _mean_length(self, places: NDArray[np.float32], normals: NDArray[np.float32]) -> NDArray[np.float32]:
        """Of the rays of points (n, 3), which meet surfaces from behind; infinite if any does not."""
        lane = dr.arange(mi.UInt32, len(places) * RAYS)
        point, k = lane // RAYS, lane % RAYS
        p, n = (dr.gather(mi.Vector3f, mi.Vector3f(values.T), point) for values in (places, normals))
        u = mi.Point2f((mi.Float(k) + 0.5) / RAYS, mi.Float(dr.brev(k)) * 2**-32)  # Hammersley's points
        way = mi.Frame3f(n).to_world(mi.warp.square_to_cosine_hemisphere(u))
        start = mi.Point3f(dr.fma(n, ray_offset(mi.Point3f(p)), p))
        length, behind = _met(self._scene, self._places, start, way, mi.Float(dr.inf), mi.Mask(True))
        length = dr.select(behind, length, dr.inf)
        mean: NDArray[np.float32] = dr.block_reduce(dr.ReduceOp.Add, length, RAYS).numpy() / np.float32(RAYS)
        return mean


def room(
    scene: TracedScene,
    corners: mi.Point3f,
    point: mi.Point3f,
    normal: mi.Vector3f,
    most: mi.Float,
    unit: float,
    active: mi.Mask,
) -> tuple[mi.Float, mi.Mask]:
    """How much there is above points, up to ``most``; and whether what ends it is met from behind.

    ``corners`` are those of all triangles, one after the other; the frame is one in which the scene has the size
    ``unit``.
    """
    start = dr.fma(normal, ray_offset(point, unit), point)
    return _met(scene, corners, start, normal, most, active)


def _met(
    scene: TracedScene,
    corners: mi.Point3f,
    start: mi.Point3f,
    way: mi.Vector3f,
    most: mi.Float,
    active: mi.Mask,
) -> tuple[mi.Float, mi.Mask]:
    """How far rays get, and whether they then meet a surface from behind."""
    ray = mi.Ray3f(start, way)
    ray.maxt = most
    hit = scene.ray_intersect_preliminary(ray, active)
    met = active & hit.is_valid()
    triangle = scene.triangle(hit, met)
    p = [dr.gather(mi.Point3f, corners, 3 * triangle + k, met) for k in range(3)]
    behind = met & (dr.dot(dr.cross(p[1] - p[0], p[2] - p[0]), way) > 0)
    return dr.select(met, hit.t, dr.inf), behind


def narrow_height(corners: Sequence[mi.Point3f]) -> mi.Float:
    """Of gaps that are narrow for triangles."""
    return NARROW * dr.sqrt(dr.norm(dr.cross(corners[1] - corners[0], corners[2] - corners[0])))


def around_of(corners: Sequence[mi.Point3f]) -> mi.Float:
    """How far surfaces around corners of triangles are at most if these are inside of them."""
    a, b, c = corners
    return AROUND * dr.maximum(dr.maximum(dr.norm(b - a), dr.norm(c - b)), dr.norm(a - c))


def _stand_ins(covered: NDArray[np.uint8], corners: Corners, ends: NDArray[np.integer]) -> NDArray[np.uint32]:
    """(n_t, 2): which triangle stands in for each, in front and behind: itself, unless all its corners are covered."""
    found = np.repeat(np.arange(len(covered), dtype=np.uint32)[:, None], 2, axis=1)
    for (start, end), side in itertools.product(itertools.pairwise(ends), (0, 1)):
        within = (covered[start:end] >> 3 * side) & ALL == ALL
        if within.any() and not within.all():
            inside, others = start + np.flatnonzero(within), start + np.flatnonzero(~within)
            found[inside, side] = _nearest_alike(corners, inside, others)
    return found


def _nearest_alike(
    corners: Corners, inside: NDArray[np.int64], others: NDArray[np.int64]
) -> NDArray[np.int64]:
    """For triangles the nearest others that are turned alike; themselves if none of the nearest is."""
    normals, of_others = (_normals(corners[some]) for some in (inside, others))
    tree = cKDTree(corners[others].mean(axis=1))
    near = tree.query(corners[inside].mean(axis=1), min(NEAREST, len(others)))[1].reshape(len(inside), -1)
    alike = (of_others[near] * normals[:, None]).sum(axis=2) > ALIKE  # [triangle, near], nearest first
    first = near[np.arange(len(near)), alike.argmax(axis=1)]
    return np.where(alike.any(axis=1), others[first], inside)


def _normals(corners: Corners) -> NDArray[np.float64]:
    """Of triangles, of length 1."""
    p = corners.astype(np.float64)
    normals = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
