"""How a page turns its light: it is tipped first, then turned about an axis that most scenes call up."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mi_sparse_prt.core.errors import PrtError

AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


def axis_up(up: Sequence[float]) -> str:
    """The axis of the world that a camera calls up: y, unless its picture's upwards (3,) is rather +z."""
    return "z" if up[2] > abs(up[1]) else "y"


def turn_matrix(
    degrees: float, axis: str = "y", tip: Sequence[float] = (0.0, 0.0, 0.0)
) -> NDArray[np.float64]:
    """The rotation of a light, for ``Environment.rotated``.

    Parameters
    ----------
    degrees : float
        About ``axis``, counter-clockwise seen from its end.
    axis : {"x", "y", "z"}
        Of the world.
    tip : 3 floats
        A turn before that one: about this direction of the world, by as many degrees as it is long.

    Returns
    -------
    (3, 3) float64
        World from what is turned.

    Raises
    ------
    PrtError
        If the axis is none of these, or a number is not finite.
    """
    if axis not in AXES:
        raise PrtError(f"axis={axis!r}: light turns about x, y or z")
    if len(tip) != 3 or not np.isfinite([degrees, *tip]).all():
        raise PrtError(f"degrees={degrees}, tip={list(tip)}: an angle and three numbers are asked for")
    tipped = Rotation.from_rotvec(tip, degrees=True)
    return (Rotation.from_rotvec(degrees * np.array(AXES[axis]), degrees=True) * tipped).as_matrix()
