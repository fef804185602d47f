"""What Mitsuba objects are made of."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray


def places_of_lamps(scene: mi.Scene) -> NDArray[np.float32]:
    """Where lamps are (n, 3) that shine from single points (world): ``point``, ``spot``, ``projector``."""
    places = [np.zeros((0, 3))]
    for emitter in scene.emitters():
        if mi.has_flag(emitter.flags(), mi.EmitterFlags.DeltaPosition):
            at = mi.traverse(emitter)
            place = at["position"] if "position" in at else at["to_world"].translation()
            places.append(np.ravel(place)[None])
    return np.concatenate(places).astype(np.float32)


def places_of_cameras(scene: mi.Scene) -> NDArray[np.float32]:
    """From where sensors look (n, 3), world."""
    every = [mi.traverse(sensor) for sensor in scene.sensors()]
    places = [np.ravel(at["to_world"].translation())[None] for at in every if "to_world" in at]
    return np.concatenate([np.zeros((0, 3)), *places]).astype(np.float32)


def children(thing: mi.Object) -> list[tuple[str, Any]]:
    """Names and values of the objects and parameters that a Mitsuba object holds itself; names may come twice."""
    callback = _Children()
    thing.traverse(callback)
    return callback.found


class _Children(mi.TraversalCallback):
    def __init__(self) -> None:
        super().__init__()
        self.found: list[tuple[str, Any]] = []

    def put(self, name: str, value: Any, *_: Any) -> None:
        self.found.append((name, value))
