"""A question of a page: a header with numbers, checked, and the camera that some of them are."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.errors import PrtError

MOST_PIXELS = 1 << 22

Question = Mapping[str, Any]


def number(question: Question, name: str) -> float:
    """A finite number (PrtError)."""
    value = question.get(name)
    if not isinstance(value, int | float) or not math.isfinite(value):
        raise PrtError(f"{name}={value!r}: a number is asked for")
    return float(value)


def whole(question: Question, name: str, least: int, stop: int) -> int:
    """A whole number from ``least`` to ``stop - 1`` (PrtError)."""
    value = question.get(name)
    if not isinstance(value, int) or not least <= value < stop:
        raise PrtError(f"{name}={value!r}: a whole number from {least} to {stop - 1} is asked for")
    return value


def vector(question: Question, name: str) -> NDArray[np.float32]:
    """Three finite numbers (PrtError)."""
    value = question.get(name)
    if not isinstance(value, list) or len(value) != 3:
        raise PrtError(f"{name}={value!r}: three numbers are asked for")
    return np.array([number({name: x}, name) for x in value], np.float32)


def page_sensor(question: Question) -> mi.Sensor:
    """The page's camera: eye, target, up (world), height at distance 1, and columns and rows of pixels."""
    across, down = (whole(question, name, 1, 1 << 14) for name in ("columns", "rows"))
    if across * down > MOST_PIXELS:
        raise PrtError(f"{across} x {down} pixels: make the window smaller")
    eye, target, up = (vector(question, name).tolist() for name in ("eye", "target", "up"))
    height = number(question, "height")
    if eye == target or height <= 0:
        raise PrtError("a camera looks at another place than its own, and its picture has a height")
    return mi.load_dict(
        {
            "type": "perspective",
            "fov_axis": "y",
            "fov": math.degrees(2 * math.atan(height / 2)),
            "to_world": mi.ScalarTransform4f().look_at(eye, target, up),
            "film": {
                "type": "hdrfilm",
                "width": across,
                "height": down,
                "rfilter": {"type": "box"},
            },
        }
    )
