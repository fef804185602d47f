"""Operators with the same columns, one below the other."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.operators.operator import Floats, Ids, Operator


@dataclass(frozen=True)
class Stacked(Operator):
    """The rows of several operators, those of the first before those of the second; kept in memory only.

    Attributes
    ----------
    parts : tuple of Operator
        Of one channel each.
    """

    kind: ClassVar[str] = "stacked"
    parts: tuple[Operator, ...]

    @property
    def shape(self) -> tuple[int, int, int]:
        return sum(part.shape[0] for part in self.parts), self.parts[0].shape[1], 1

    @property
    def nbytes(self) -> int:
        return sum(part.nbytes for part in self.parts)

    def rows(self, ids: Ids) -> Floats:
        result, end = np.empty((len(ids), *self.shape[1:]), np.float32), 0
        for part in self.parts:
            start, end = end, end + part.shape[0]
            own = (ids >= start) & (ids < end)
            result[own] = part.rows(ids[own] - start)
        return result

    def columns(self, ids: Ids) -> Floats:
        return np.concatenate([part.columns(ids) for part in self.parts])

    def combined(self, words: NDArray[np.integer], signs: Floats) -> Floats:
        return np.concatenate([part.combined(words, signs) for part in self.parts])

    def take(self, ids: Ids) -> Stacked:
        """Some rows, by ascending numbers: those of each part stay together."""
        starts = np.cumsum([0, *(part.shape[0] for part in self.parts)])
        cuts = np.searchsorted(ids, starts)
        return Stacked(
            tuple(part.take(ids[cuts[i] : cuts[i + 1]] - starts[i]) for i, part in enumerate(self.parts))
        )
