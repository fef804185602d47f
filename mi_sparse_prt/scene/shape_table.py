"""Values of a scene's shapes on the device, by what a ray has hit."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike


class ShapeTable:
    """One number for each shape of scenes, found on the device from pointers to shapes.

    Parameters
    ----------
    scenes : list of mi.Scene
    values : (shapes,) uint32
        In the order of ``scene.shapes()``, scene after scene.

    Notes
    -----
    A pointer to a shape is a number on the device, by which Dr.Jit knows objects; shapes do not follow each other.
    """

    def __init__(self, scenes: list[mi.Scene], values: ArrayLike) -> None:
        pointers = np.concatenate(
            [dr.reinterpret_array(mi.UInt32, scene.shapes_dr()).numpy() for scene in scenes]
        )
        table = np.zeros(int(pointers.max()) + 1, np.uint32)
        table[pointers] = values
        self._table = mi.UInt32(table)

    def gather(self, shape: mi.ShapePtr, active: mi.Mask) -> mi.UInt32:
        """The shapes' numbers; 0 where not ``active``."""
        return dr.gather(mi.UInt32, self._table, dr.reinterpret_array(mi.UInt32, shape), active)
