"""Rows of all points as combinations of a few dense rows: A D ([HR10] eq. 4)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mi_sparse_prt.core.ragged import select_rows
from mi_sparse_prt.core.sparse_arrays import sparse_from_arrays, sparse_nbytes, sparse_to_arrays
from mi_sparse_prt.emission.space import EmissionSpace
from mi_sparse_prt.operators.operator import Floats, Ids, Operator


@dataclass(frozen=True)
class Interpolated(Operator):
    """A D.

    Attributes
    ----------
    dense : Operator
        D, the rows of the densely sampled points.
    weights : (n, n_dense) sparse float32
        A: a row has the weights of a point's dense neighbours. That of a dense point is 1 at itself (``huang2010``)
        or smooths its row by its neighbours' (``sparse``).
    """

    kind: ClassVar[str] = "interpolated"
    by_row: ClassVar[tuple[str, ...]] = ("weights",)
    element_block: ClassVar[int] = 1 << 15  # each has up to 40 dense ones
    dense: Operator
    weights: scipy.sparse.csr_array

    @property
    def shape(self) -> tuple[int, int, int]:
        return self.weights.shape[0], *self.dense.shape[1:]

    @property
    def nbytes(self) -> int:
        return self.dense.nbytes + sparse_nbytes(self.weights)

    def rows(self, ids: Ids) -> Floats:
        weights = self.weights[np.asarray(ids)]
        needed = np.unique(weights.indices)
        dense = self.dense.rows(needed)  # [needed dense row, direction, channel]
        flat = weights[:, needed] @ dense.reshape(len(needed), dense.shape[1] * dense.shape[2])
        return flat.reshape(len(ids), *dense.shape[1:])

    def columns(self, ids: Ids) -> Floats:
        return self._interpolate(self.dense.columns(ids))

    def _elements(self, ids: Ids, texels: Ids) -> Floats:
        element, dense, weights = row_entries(self.weights, ids)
        return summed_entries(element, weights, self.dense.elements(dense, texels[element]), len(ids))

    def relight(self, lighting: Floats) -> Floats:
        return self.weights @ self.dense.relight(lighting)

    def apply(self, x: Floats) -> Floats:
        return self._interpolate(self.dense.apply(x))

    def adjoint(self, y: Floats) -> Floats:
        flat = self.weights.T @ np.asarray(y, np.float32).reshape(len(y), math.prod(y.shape[1:]))
        return self.dense.adjoint(flat.reshape(len(flat), *y.shape[1:]))

    def _interpolate(self, dense: Floats) -> Floats:
        """Values (n_dense, ...) at all points."""
        flat = self.weights @ dense.reshape(len(dense), math.prod(dense.shape[1:]))
        return flat.reshape(len(flat), *dense.shape[1:])

    def arrays(self) -> dict[str, NDArray[Any] | Operator]:
        return {"dense": self.dense, **sparse_to_arrays("weights", self.weights)}

    @classmethod
    def from_arrays(cls, arrays: dict[str, Any], lighting: EmissionSpace) -> Self:
        dense = arrays["dense"]
        return cls(dense, sparse_from_arrays("weights", arrays, dense.shape[0]))


def row_entries(
    matrix: scipy.sparse.csr_array, rows: Ids
) -> tuple[NDArray[np.int64], NDArray[np.integer], NDArray[np.floating]]:
    """Position in ``rows``, column and value of all entries of these rows of a matrix."""
    _, position, entry = select_rows(matrix.indptr, rows)
    return position, matrix.indices[entry], matrix.data[entry]


def summed_entries(
    element: NDArray[np.int64], weights: NDArray[np.floating], values: Floats, n: int
) -> Floats:
    """Sums of weighted entries (entries, channels) over their elements, (n, channels)."""
    channels = [np.bincount(element, weights * v, minlength=n) for v in values.T]
    return np.stack(channels, axis=1).astype(np.float32)
