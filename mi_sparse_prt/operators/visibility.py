"""Direct light in the direction basis: one bit per element, cosine and solid angle analytic ([HR10] eq. 1)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numba
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.bits import BITS
from mi_sparse_prt.core.block_products import multiply_rows
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.operators.operator import Rows


@dataclass(frozen=True)
class Visibility:
    """Direct light in the direction basis: one bit per element, cosine and solid angle analytic.

    Attributes
    ----------
    bits : (n_v, n_directions / 32) uint32
        Bit j % 32 of word j // 32: whether texel j's centre is seen (never below the horizon).
    normals : (n_v, 3) float32, world
    lighting : CubemapLighting
    """

    bits: NDArray[np.uint32]
    normals: NDArray[np.float32]
    lighting: CubemapLighting

    @property
    def nbytes(self) -> int:
        return self.bits.nbytes

    def rows(self, ids: Rows) -> NDArray[np.float32]:
        beams = np.ascontiguousarray((self.lighting.directions * self._weights()[:, None]).T)
        return _expanded_bits(self.bits, self.normals, np.asarray(ids, np.int64), beams)[..., None]

    def columns(self, ids: Rows) -> NDArray[np.float32]:
        ids = np.asarray(ids)
        words = self.bits[:, ids // BITS]  # [vertex, column]
        seen = (words >> (ids % BITS).astype(np.uint32)) & 1
        cosine = np.maximum(self.normals @ self.lighting.directions[ids].T, 0)
        return (cosine * seen * self._weights()[ids])[..., None].astype(np.float32)

    def relight(self, lighting: NDArray[np.float32]) -> NDArray[np.float32]:
        n_padded = self.bits.shape[1] * BITS
        directions = np.zeros((3, n_padded), dtype=np.float32)
        power = np.zeros((3, n_padded), dtype=np.float32)
        directions[:, : len(lighting)] = self.lighting.directions.T
        power[:, : len(lighting)] = (lighting * self._weights()[:, None]).T
        return _relight_bits(self.bits, self.normals, directions, power)

    def project(self, vectors: NDArray[np.float32]) -> NDArray[np.float32]:
        return multiply_rows(self.rows, len(self.bits), vectors)

    def reordered(self, source: Rows) -> Visibility:
        return replace(self, bits=self.bits[source], normals=self.normals[source])

    def _weights(self) -> NDArray[np.float32]:
        return self.lighting.solid_angles / np.float32(np.pi)


@numba.njit(parallel=True, cache=True)
def _expanded_bits(
    bits: NDArray[np.uint32], normals: NDArray[np.float32], ids: NDArray[np.int64], beams: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Elements (n, m) of rows ``ids``; beams (3, m) are directions times power."""
    result = np.zeros((len(ids), beams.shape[1]), np.float32)
    for i in numba.prange(len(ids)):
        nx, ny, nz = normals[ids[i], 0], normals[ids[i], 1], normals[ids[i], 2]
        for word in range(bits.shape[1]):
            mask = bits[ids[i], word]
            if mask == 0:
                continue
            for j in range(word * 32, min(word * 32 + 32, beams.shape[1])):
                cosine = nx * beams[0, j] + ny * beams[1, j] + nz * beams[2, j]
                seen = np.float32((mask >> np.uint32(j % 32)) & np.uint32(1))
                result[i, j] = max(cosine, np.float32(0)) * seen
    return result


@numba.njit(parallel=True, fastmath=True, cache=True)
def _relight_bits(
    bits: NDArray[np.uint32],
    normals: NDArray[np.float32],
    directions: NDArray[np.float32],
    power: NDArray[np.float32],
) -> NDArray[np.float32]:
    """Sum of power[:, j] * max(0, n_i . w_j) over the set bits j of row i; the inner loop is one word of bits."""
    radiance = np.zeros((bits.shape[0], 3), dtype=np.float32)
    for i in numba.prange(bits.shape[0]):
        nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
        red, green, blue = np.float32(0), np.float32(0), np.float32(0)
        for word in range(bits.shape[1]):
            mask = bits[i, word]
            if mask == 0:
                continue
            for k in range(32):
                j = word * 32 + k
                cosine = nx * directions[0, j] + ny * directions[1, j] + nz * directions[2, j]
                seen = max(cosine, np.float32(0)) * np.float32((mask >> np.uint32(k)) & np.uint32(1))
                red += seen * power[0, j]
                green += seen * power[1, j]
                blue += seen * power[2, j]
        radiance[i, 0], radiance[i, 1], radiance[i, 2] = red, green, blue
    return radiance
