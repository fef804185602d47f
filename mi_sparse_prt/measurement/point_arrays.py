"""What one lane of a wavefront needs: its point, its texel, its random numbers and its first ray."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mi_sparse_prt.measurement.vertices import Points
from mi_sparse_prt.scene.ray_offsets import ray_offset


class PointArrays:
    """Measurement points on the device; gathered by point index."""

    def __init__(self, points: Points) -> None:
        self._positions = mi.Point3f(points.positions.T)
        self._normals = mi.Normal3f(points.normals.T)
        same = points.offset_normals is points.normals
        self._offset_normals = self._normals if same else mi.Normal3f(points.offset_normals.T)
        self._keys = mi.UInt64(points.keys)
        dr.eval(self._positions, self._normals, self._offset_normals, self._keys)

    def position(self, point: mi.UInt32) -> mi.Point3f:
        return dr.gather(mi.Point3f, self._positions, point)

    def normal(self, point: mi.UInt32) -> mi.Normal3f:
        return dr.gather(mi.Normal3f, self._normals, point)

    def offset_normal(self, point: mi.UInt32) -> mi.Normal3f:
        return dr.gather(mi.Normal3f, self._offset_normals, point)

    def key(self, point: mi.UInt32) -> mi.UInt64:
        return dr.gather(mi.UInt64, self._keys, point)


def start_ray(points: PointArrays, point: mi.UInt32, direction: mi.Vector3f) -> mi.Ray3f:
    """A ray that leaves a measurement point as Mitsuba's ``Interaction.spawn_ray`` does (same offset, same side)."""
    p, n = points.position(point), points.offset_normal(point)
    return mi.Ray3f(dr.fma(n, dr.mulsign(ray_offset(p), dr.dot(n, direction)), p), direction)
