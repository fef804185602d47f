"""Light that met 0, 1, 2, ... surfaces, one below the other, and the form factors between its rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mi_sparse_prt.core.sparse_product import Sparse, add_scaled, multiply_scaled
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
        result = np.empty((self.shape[0], signs.shape[1]), np.float32)
        self.combine(words, signs, result)
        return result

    def combine(self, words: NDArray[np.integer], signs: Floats, out: Floats) -> None:
        end = 0
        for part in self.parts:
            start, end = end, end + part.shape[0]
            part.combine(words, signs, out[start:end])

    def take(self, ids: Ids) -> Stacked:
        """Some rows, by ascending numbers: those of each part stay together."""
        starts = np.cumsum([0, *(part.shape[0] for part in self.parts)])
        cuts = np.searchsorted(ids, starts)
        return Stacked(
            tuple(part.take(ids[cuts[i] : cuts[i + 1]] - starts[i]) for i, part in enumerate(self.parts))
        )


class StackedFormFactors:
    """G for light of several depths: rows of depth s gather G_(s-t) of the light of depth t; never put together.

    Parameters
    ----------
    matrices : sequence of (n, n_v) sparse float32
        G_0, G_1, ...
    depths : sequence of int
        Those of the light there is, one below the other, ascending.
    count : int
        How many depths the rows are of.

    Attributes
    ----------
    shape : (int, int)
        All rows and columns.
    """

    def __init__(self, matrices: Sequence[Sparse], depths: Sequence[int] = (0,), count: int = 1) -> None:
        self._blocks = [
            [(i, matrices[s - t]) for i, t in enumerate(depths) if t <= s and matrices[s - t].nnz]
            for s in range(count)
        ]
        self._size: tuple[int, int] = matrices[0].shape
        self.shape = count * self._size[0], len(depths) * self._size[1]

    def reflect(self, albedo: Floats, light: Floats) -> Floats:
        """G rho x (channels, n, k) of light x (n_v, k), for the rows rho of ``albedo`` (channels, n_v)."""
        if len(self._blocks) == 1 and len(self._blocks[0]) == 1:
            return multiply_scaled(self._blocks[0][0][1], albedo, light)
        n, columns = self._size
        result = np.zeros((len(albedo), self.shape[0], light.shape[1]), np.float32)
        for s, blocks in enumerate(self._blocks):
            for i, matrix in blocks:
                part = slice(i * columns, (i + 1) * columns)
                add_scaled(matrix, np.ascontiguousarray(albedo[:, part]), light[part], result, s * n)
        return result

    def rows(self, ids: NDArray[np.integer]) -> scipy.sparse.csr_array:
        """Some rows (len(ids), n_v), by ascending numbers."""
        n, columns = self._size
        cuts, found = np.searchsorted(ids, np.arange(len(self._blocks) + 1) * n), []
        for s, blocks in enumerate(self._blocks):
            own = ids[cuts[s] : cuts[s + 1]] - s * n
            row: list[scipy.sparse.csr_array] = [
                scipy.sparse.csr_array((len(own), columns), dtype=np.float32)
            ]
            row *= self.shape[1] // columns
            for i, matrix in blocks:
                row[i] = matrix[own]
            found.append(scipy.sparse.hstack(row, format="csr"))
        return scipy.sparse.vstack(found, format="csr")
