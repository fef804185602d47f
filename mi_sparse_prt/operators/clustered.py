"""Rows as points of affine spaces, one per cluster: clustered PCA of unit-albedo transport ([SHHS03], [HR10] 6).

Rows are kept as functions on the sphere, t_j / sqrt(d_omega_j), whose L2 norm is that of the sphere.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numba
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.halves import as_floats
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.operators.operator import Floats, Ids, Operator, multiply_converted


@dataclass(frozen=True)
class Clustered(Operator):
    """Direct and indirect light together, compressed.

    Attributes
    ----------
    labels : (n_v,) uint16 or uint32
        Clusters of the vertices.
    coefficients : (n_v, channels, b) float16
    means : (k, n_directions) float16
        A point of each space.
    bases : (k, b, n_directions) float16
        Orthonormal.
    lighting : CubemapLighting
    """

    kind: ClassVar[str] = "clustered"
    stored: ClassVar[tuple[str, ...]] = ("labels", "coefficients", "means", "bases")
    by_row: ClassVar[tuple[str, ...]] = ("labels", "coefficients")
    labels: NDArray[np.unsignedinteger]
    coefficients: NDArray[np.float16]
    means: NDArray[np.float16]
    bases: NDArray[np.float16]
    lighting: CubemapLighting

    @property
    def shape(self) -> tuple[int, int, int]:
        return len(self.labels), self.lighting.n_directions, self.coefficients.shape[1]

    def rows(self, ids: Ids) -> Floats:
        ids = np.asarray(ids)
        n, channels, m = len(ids), self.coefficients.shape[1], self.means.shape[1]
        result = np.empty((n, channels, m), np.float32)
        labels = self.labels[ids]
        for c in np.unique(labels):
            here = np.flatnonzero(labels == c)
            along = self.coefficients[ids[here]].astype(np.float32)  # [vertex, channel, vector]
            result[here] = along @ self.bases[c].astype(np.float32) + self.means[c]
        return np.ascontiguousarray(np.moveaxis(result * self._scale(), 1, 2))

    def columns(self, ids: Ids) -> Floats:
        scale = self._scale()[ids]
        means, bases = (x[..., ids].astype(np.float32) * scale for x in (self.means, self.bases))
        return np.ascontiguousarray(np.moveaxis(self._combined(means, bases), 1, 2))

    def relight(self, lighting: Floats) -> Floats:
        means, products = self._products(lighting)
        return _relit(self.labels, as_floats(self.coefficients), means, products)

    def apply(self, x: Floats) -> Floats:
        if np.ndim(x) == 2:  # means and basis vectors meet the vectors once, not once for each channel
            return self._combined(*self._products(np.asarray(x, np.float32)))
        return super().apply(x)

    def _apply(self, x: Floats) -> Floats:
        result = np.empty((len(self.labels), *x.shape[1:]), np.float32)
        for c in range(x.shape[1]):
            self._combine(*self._products(x[:, c]), slice(c, c + 1), result[:, c : c + 1])
        return result

    def _adjoint(self, y: Floats) -> Floats:
        """By clusters, not by rows: ``y`` is gathered in coefficients of means and of basis vectors."""
        result = np.zeros((self.shape[1], *y.shape[1:]), np.float32)
        for c in range(len(self.means)):
            here = np.flatnonzero(self.labels == c)
            along = self.coefficients[here].astype(np.float32)  # [vertex, channel, vector]
            weights = np.einsum("ncb,nck->cbk", along, y[here])
            base, mean = self.bases[c].astype(np.float32), self.means[c].astype(np.float32)
            result += np.einsum("bm,cbk->mck", base, weights, optimize=True)
            result += mean[:, None, None] * y[here].sum(axis=0)
        return result * self._scale()[:, None, None]

    def check(self) -> None:
        _, channels, b = self.coefficients.shape
        # a wrong label would read beyond the clusters
        if channels not in (1, 3) or (len(self.labels) and self.labels.max() >= len(self.means)):
            raise ValueError("clusters and their vertices do not fit together")
        if self.bases.shape[:2] != (len(self.means), b) or len(self.labels) != len(self.coefficients):
            raise ValueError("basis vectors and coefficients do not fit together")
        if not self.means.shape[1] == self.bases.shape[2] == self.lighting.n_directions:
            raise ValueError("clusters do not fit the lighting")

    def _products(self, vectors: Floats) -> tuple[Floats, Floats]:
        """Of means (k, any) and of basis vectors (k, b, any) with vectors (n_directions, any)."""
        scaled = vectors * self._scale()[:, None]
        k, b, m = self.bases.shape
        return multiply_converted(self.means, scaled), multiply_converted(
            self.bases.reshape(k * b, m), scaled
        ).reshape(k, b, vectors.shape[1])

    def _combined(self, means: Floats, products: Floats) -> Floats:
        """What rows have where means have (k, any) and basis vectors (k, b, any): (n, channels, any)."""
        result = np.empty((*self.coefficients.shape[:2], means.shape[1]), np.float32)
        self._combine(means, products, slice(None), result)
        return result

    def _combine(self, means: Floats, products: Floats, channels: slice, result: Floats) -> None:
        """The same of some channels, into (n, channels, any)."""
        for c in range(len(means)):
            here = np.flatnonzero(self.labels == c)
            along = self.coefficients[here, channels].astype(np.float32)  # [vertex, channel, vector]
            result[here] = along @ products[c] + means[c]

    def _scale(self) -> Floats:
        return np.sqrt(self.lighting.solid_angles, dtype=np.float32)


@numba.njit(parallel=True, fastmath=True, cache=True)
def _relit(
    labels: NDArray[np.unsignedinteger], coefficients: Floats, means: Floats, products: Floats
) -> Floats:
    """Radiance (n, 3); coefficients (n_v, 1 or 3, b), means (k, 3), products (k, b, 3)."""
    n, channels, b = coefficients.shape
    radiance = np.empty((n, 3), np.float32)
    for i in numba.prange(n):
        c = labels[i]
        for colour in range(3):
            along = coefficients[i, colour % channels]
            total = means[c, colour]
            for q in range(b):
                total += along[q] * products[c, q, colour]
            radiance[i, colour] = total
    return radiance
