"""How far off a surface rays start, so as not to meet it: as Mitsuba's ``Interaction.spawn_ray`` has it."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray


def ray_offset(p: mi.Point3f, unit: float = 1.0) -> mi.Float:
    """Along the normal at points on the device, in a frame in which the scene has the size ``unit``."""
    return (unit + dr.max(dr.abs(p))) * mi.math.RayEpsilon


def ray_offsets(positions: NDArray[np.float32]) -> NDArray[np.float32]:
    """Along the normal at positions (n, 3) of the normalised frame; (n, 1)."""
    return (1 + np.abs(positions).max(axis=1, keepdims=True)) * np.float32(mi.math.RayEpsilon)
