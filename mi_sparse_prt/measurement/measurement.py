"""M, what is asked for: a set of surface points, and what makes outputs of them ([Leh07] eq. 12)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class MeshRange:
    """Name of a mesh, or of another group of points, and the slice of its points among all."""

    name: str
    vertices: slice


@dataclass(frozen=True)
class Measurement:
    """Points for which rows of T hold.

    Attributes
    ----------
    keys : (n,) uint64
        Identify points whatever their order (``Points.keys``).
    areas : (n,) float32
        Of the surface around each point, world units.
    groups : tuple of MeshRange
        They follow each other.
    """

    keys: NDArray[np.uint64]
    areas: NDArray[np.float32]
    groups: tuple[MeshRange, ...]

    def __len__(self) -> int:
        return len(self.keys)

    def take(self, points: NDArray[np.integer], groups: tuple[MeshRange, ...]) -> Measurement:
        """Some points, in this order, which are in these groups."""
        return replace(self, keys=self.keys[points], areas=self.areas[points], groups=groups)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """What files keep, beside ``attributes``."""
        return {"keys": self.keys, "areas": self.areas}

    def attributes(self) -> dict[str, Any]:
        """JSON as it is."""
        return {"groups": [[group.name, group.vertices.start, group.vertices.stop] for group in self.groups]}

    @classmethod
    def from_arrays(cls, attributes: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> Measurement:
        """From what ``attributes`` and ``arrays`` gave; ValueError or KeyError if these do not fit together."""
        groups = tuple(MeshRange(name, slice(a, b)) for name, a, b in attributes["groups"])
        keys, areas = arrays["keys"], arrays["areas"]
        if areas.shape != keys.shape or (groups and groups[-1].vertices.stop != len(keys)):
            raise ValueError("points and their areas do not fit together")
        return cls(keys, areas, groups)
