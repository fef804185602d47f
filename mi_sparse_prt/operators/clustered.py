"""Compressed white transport, direct and indirect light together: parts of a matrix like any other.

Rows are kept as functions on the sphere, t_j / sqrt(d_omega_j), whose L2 norm is that of the sphere.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numba
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.block_products import multiply_converted
from mi_sparse_prt.emission.cubemap import CubemapLighting

Rows = NDArray[np.integer]
Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Clustered:
    """Rows as points of affine spaces, one per cluster of vertices ([SHHS03], [HR10] 6).

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

    labels: NDArray[np.unsignedinteger]
    coefficients: NDArray[np.float16]
    means: NDArray[np.float16]
    bases: NDArray[np.float16]
    lighting: CubemapLighting

    @property
    def nbytes(self) -> int:
        return self.labels.nbytes + self.coefficients.nbytes + self.means.nbytes + self.bases.nbytes

    def rows(self, ids: Rows) -> Floats:
        ids = np.asarray(ids)
        n, channels, m = len(ids), self.coefficients.shape[1], self.means.shape[1]
        result = np.empty((n, channels, m), np.float32)
        labels = self.labels[ids]
        for c in np.unique(labels):
            here = np.flatnonzero(labels == c)
            along = self.coefficients[ids[here]].astype(np.float32)  # [vertex, channel, vector]
            result[here] = along @ self.bases[c].astype(np.float32) + self.means[c]
        return np.ascontiguousarray(np.moveaxis(result * self._scale(), 1, 2))

    def columns(self, ids: Rows) -> Floats:
        scale = self._scale()[ids]
        return self._combined(
            self.means[:, ids].astype(np.float32) * scale, self.bases[:, :, ids].astype(np.float32) * scale
        )

    def relight(self, lighting: Floats) -> Floats:
        means, products = self._products(lighting)
        return _relit(self.labels, self.coefficients.astype(np.float32), means, products)

    def project(self, vectors: Floats) -> Floats:
        return self._combined(*self._products(vectors))

    def reordered(self, source: Rows) -> Clustered:
        return replace(self, labels=self.labels[source], coefficients=self.coefficients[source])

    def _products(self, vectors: Floats) -> tuple[Floats, Floats]:
        """Of means (k, any) and of basis vectors (k, b, any) with vectors (n_directions, any)."""
        scaled = vectors * self._scale()[:, None]
        k, b, m = self.bases.shape
        return multiply_converted(self.means, scaled), multiply_converted(
            self.bases.reshape(k * b, m), scaled
        ).reshape(k, b, -1)

    def _combined(self, means: Floats, products: Floats) -> Floats:
        """What vertices have where means have (k, any) and basis vectors (k, b, any): (n_v, any, channels)."""
        n, channels, _ = self.coefficients.shape
        result = np.empty((n, means.shape[1], channels), np.float32)
        for c in range(len(means)):
            here = np.flatnonzero(self.labels == c)
            along = self.coefficients[here].astype(np.float32)  # [vertex, channel, vector]
            result[here] = np.moveaxis(along @ products[c] + means[c], 1, 2)
        return result

    def _scale(self) -> Floats:
        return np.sqrt(self.lighting.solid_angles, dtype=np.float32)


@numba.njit(parallel=True, fastmath=True, cache=True)
def _relit(
    labels: NDArray[np.unsignedinteger], coefficients: Floats, means: Floats, products: Floats
) -> Floats:
    """White radiance (n_v, 3); coefficients (n_v, 1 or 3, b), means (k, 3), products (k, b, 3)."""
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
