"""What Mitsuba objects are made of."""

from __future__ import annotations

from typing import Any

import mitsuba as mi


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
