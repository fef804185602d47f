"""What one lane of a wavefront needs: its point, its texel, its random numbers and its first ray."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_sparse_prt.emission.cubemap import FACE_FRAMES, CubemapLighting
from mi_sparse_prt.measurement.vertices import Points


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


class TexelArrays:
    """Texels of a cubemap on the device; gathered by texel index."""

    def __init__(self, lighting: CubemapLighting) -> None:
        n = lighting.resolution
        self._resolution = n
        self._directions = mi.Vector3f(lighting.directions.T)
        self._s_axes, self._t_axes, self._majors = (  # [face, xyz] each
            mi.Vector3f(np.ascontiguousarray(FACE_FRAMES[:, axis].T, dtype=np.float32)) for axis in range(3)
        )
        self._solid_angles = mi.Float(lighting.solid_angles)
        dr.eval(self._directions, self._majors, self._s_axes, self._t_axes, self._solid_angles)

    def centre(self, texel: mi.UInt32) -> mi.Vector3f:
        return dr.gather(mi.Vector3f, self._directions, texel)

    def solid_angle(self, texel: mi.UInt32) -> mi.Float:
        return dr.gather(mi.Float, self._solid_angles, texel)

    def contains(self, texel: mi.UInt32, direction: mi.Vector3f) -> mi.Mask:
        """Whether a direction lies in a texel."""
        centre, s, t, face_point = self._on_cube(texel)
        scale = 1 / dr.dot(direction, face_point)
        offset = direction * scale - centre
        half = 1 / self._resolution
        return (scale > 0) & (dr.abs(dr.dot(offset, s)) <= half) & (dr.abs(dr.dot(offset, t)) <= half)

    def _on_cube(self, texel: mi.UInt32) -> tuple[mi.Vector3f, mi.Vector3f, mi.Vector3f, mi.Vector3f]:
        """Centre of a texel on the cube [-1, 1]^3, its two axes, and its face's own axis."""
        centre = self.centre(texel)
        centre /= dr.max(dr.abs(centre))
        face = texel // (self._resolution * self._resolution)
        gathered = [dr.gather(mi.Vector3f, axis, face) for axis in (self._s_axes, self._t_axes, self._majors)]
        return centre, *gathered

    def inside(self, texel: mi.UInt32, u: mi.Float, v: mi.Float) -> tuple[mi.Vector3f, mi.Float]:
        """Direction at (u, v) in [0, 1]^2 of a texel's square, and the solid angle per unit of (u, v) there."""
        n = self._resolution
        centre, s, t, _ = self._on_cube(texel)
        point = centre + s * ((2 * u - 1) / n) + t * ((2 * v - 1) / n)
        squared = dr.squared_norm(point)
        return point * dr.rsqrt(squared), (2 / n) ** 2 * dr.rsqrt(squared) / squared


def start_ray(points: PointArrays, point: mi.UInt32, direction: mi.Vector3f) -> mi.Ray3f:
    """A ray that leaves a measurement point as Mitsuba's ``Interaction.spawn_ray`` does (same offset, same side)."""
    p, n = points.position(point), points.offset_normal(point)
    offset = (1 + dr.max(dr.abs(p))) * mi.math.RayEpsilon
    return mi.Ray3f(dr.fma(n, dr.mulsign(offset, dr.dot(n, direction)), p), direction)


def random_generator(key: mi.UInt64, texel: mi.UInt32, sample: mi.UInt32, seed: int) -> mi.PCG32:
    """Independent random numbers for one sample of one element, whatever its lane, block or vertex order."""
    salt = dr.opaque(mi.UInt64, seed * 0x9E3779B97F4A7C15 % (1 << 64))
    state = _mix(_mix(key + salt) + ((mi.UInt64(texel) << 32) | mi.UInt64(sample)))
    return mi.PCG32(initstate=state, initseq=mi.UInt64(texel))


def _mix(x: mi.UInt64) -> mi.UInt64:
    """Scramble 64 bits (the finaliser of SplitMix64, Steele et al. 2014)."""
    x = (x ^ (x >> 30)) * 0xBF58476D1CE4E5B9
    x = (x ^ (x >> 27)) * 0x94D049BB133111EB
    return x ^ (x >> 31)
