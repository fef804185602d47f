"""Rows of all vertices as combinations of a few dense rows: A D ([HR10] eq. 4)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mi_sparse_prt.operators.operator import Rows
from mi_sparse_prt.operators.upsampled import Upsampled
from mi_sparse_prt.operators.visibility import Visibility


@dataclass(frozen=True)
class Interpolated:
    """Rows of all vertices as combinations of a few dense rows: A D ([HR10] eq. 4).

    Attributes
    ----------
    dense : Visibility or Upsampled
        D, the rows of the densely sampled vertices.
    weights : (n_v, n_dense) sparse float32
        A: a row has the weights of a vertex's dense neighbours. That of a dense vertex is 1 at itself (``huang2010``)
        or smooths its row by its neighbours' (``sparse``).
    """

    dense: Visibility | Upsampled
    weights: scipy.sparse.csr_array

    @property
    def nbytes(self) -> int:
        weights = self.weights
        return self.dense.nbytes + weights.data.nbytes + weights.indices.nbytes + weights.indptr.nbytes

    def rows(self, ids: Rows) -> NDArray[np.float32]:
        weights = self.weights[np.asarray(ids)]
        needed = np.unique(weights.indices)
        dense = self.dense.rows(needed)  # [needed dense row, direction, channel]
        flat = weights[:, needed] @ dense.reshape(len(needed), dense.shape[1] * dense.shape[2])
        return flat.reshape(len(ids), *dense.shape[1:])

    def columns(self, ids: Rows) -> NDArray[np.float32]:
        dense = self.dense.columns(ids)  # [dense row, column, channel]
        flat = self.weights @ dense.reshape(len(dense), -1)
        return flat.reshape(len(flat), *dense.shape[1:])

    def relight(self, lighting: NDArray[np.float32]) -> NDArray[np.float32]:
        return self.weights @ self.dense.relight(lighting)

    def project(self, vectors: NDArray[np.float32]) -> NDArray[np.float32]:
        dense = self.dense.project(vectors)  # [dense row, vector, channel]
        return (self.weights @ dense.reshape(len(dense), -1)).reshape(-1, *dense.shape[1:])

    def reordered(self, source: Rows) -> Interpolated:
        return replace(self, weights=self.weights[source])
