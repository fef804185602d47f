"""Clustered PCA as moving light reads it: basis vectors by wavelets, weights of rows by cluster ([OBRG06] 6.3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.emission.haar import haar_columns
from mi_sparse_prt.operators.clustered import Clustered

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class ClusterColumns:
    """Coefficients of clusters from wavelets, and rows from these.

    Attributes
    ----------
    columns : (m, clusters * (b + 1)) float32
        What each wavelet adds to the coefficients of clusters: of their means, then of their basis vectors.
    weights : (channels, b, n) float32
        Of rows, sorted by cluster: those of a vector are read as runs.
    order : (n,) int64
        The rows in this order.
    starts : (clusters + 1,) int64
        Where clusters begin in it.
    sizes : (clusters, b) float64
        Norms of the weights of each vector.
    """

    columns: Floats
    weights: Floats
    order: Ints
    starts: Ints
    sizes: Doubles

    @property
    def nbytes(self) -> int:
        return sum(a.nbytes for a in (self.columns, self.weights, self.order, self.starts, self.sizes))

    @property
    def quarter(self) -> int:
        """A quarter of the basis vectors of a cluster, rounded up: what a frame applies ([OBRG06] 6.3)."""
        return -(-self.sizes.shape[1] // 4)

    def norms(self) -> Floats:
        """(m,) norms of what wavelets do to all rows, from the Gram matrices of the clusters' weights."""
        squares, count = np.zeros(len(self.columns)), self.sizes.shape[1] + 1
        for c, (a, b) in enumerate(zip(self.starts[:-1], self.starts[1:], strict=True)):
            own = self.columns[:, c * count : (c + 1) * count]
            for weights in self.weights[:, :, a:b]:
                affine = np.concatenate([np.ones((1, b - a), np.float32), weights])
                squares += np.einsum("mp,mp->m", own @ (affine @ affine.T), own)
        return np.sqrt(np.maximum(squares, 0)).astype(np.float32)


def cluster_columns(operator: Clustered) -> ClusterColumns:
    """Float32 copies of all that a compressed matrix keeps, in the order in which frames read them."""
    clusters, b, m = operator.bases.shape
    columns = np.empty((m, clusters * (b + 1)), np.float32)
    for c in range(clusters):
        affine = np.concatenate([operator.means[c][None], operator.bases[c]]).astype(np.float32)
        columns[:, c * (b + 1) : (c + 1) * (b + 1)] = haar_columns(affine.T)
    order = np.argsort(operator.labels, kind="stable").astype(np.int64)
    starts = np.searchsorted(operator.labels[order], np.arange(clusters + 1))
    weights = np.ascontiguousarray(np.moveaxis(operator.coefficients[order], 0, 2).astype(np.float32))
    squares = [
        np.square(weights[:, :, a:b]).sum(axis=(0, 2)) for a, b in zip(starts[:-1], starts[1:], strict=True)
    ]
    return ClusterColumns(columns, weights, order, starts, np.sqrt(np.array(squares, np.float64)))
