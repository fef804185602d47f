"""Where indirect light is known: at all vertices, or at nodes, among which others interpolate it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mi_sparse_prt.core.sparse_product import multiply_sparse


@dataclass(frozen=True)
class Nodes:
    """Vertices with light of their own, and weights of these for all vertices.

    Attributes
    ----------
    ids : (n,) int64
        Sorted.
    weights : (n_v, n) sparse float32, or None
        Rows sum to 1. None where all vertices are nodes.
    """

    ids: NDArray[np.int64]
    weights: scipy.sparse.csr_array | None

    def __len__(self) -> int:
        return len(self.ids)

    def interpolate(self, light: NDArray[np.float32]) -> NDArray[np.float32]:
        """Light (n, k) of the nodes, interpolated at all vertices (n_v, k)."""
        return light if self.weights is None else multiply_sparse(self.weights, light)

    def interpolate_adjoint(self, weights: NDArray[np.float32]) -> NDArray[np.float32]:
        """The transpose of ``interpolate``: weights of all vertices (n_v, k) as weights of nodes (n, k)."""
        return weights if self.weights is None else multiply_sparse(self._transposed, weights)

    @cached_property
    def _transposed(self) -> scipy.sparse.csr_array:
        assert self.weights is not None
        return self.weights.T.tocsr()
