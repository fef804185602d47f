"""Texels of a cubemap on the device: directions, and places inside of a texel."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_sparse_prt.emission.cube_faces import FACE_FRAMES
from mi_sparse_prt.emission.cubemap import CubemapLighting


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
