"""Direct light in the direction basis: one bit per element, cosine and solid angle analytic ([HR10] eq. 1)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numba
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.bits import BITS, Bits, bits_at
from mi_sparse_prt.core.read_only import read_only
from mi_sparse_prt.core.threads import run_in_parts
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.operators.operator import Floats, Ids, Operator

#: Bits of texels; where those that are seen in part begin in two lists; these texels, and their shares.
SeenTexels = tuple[Bits, NDArray[np.int64], NDArray[np.unsignedinteger], NDArray[np.uint8]]


@dataclass(frozen=True)
class Visibility(Operator):
    """Unit-albedo direct transport ``V max(0, n . w) d_omega / pi``.

    Attributes
    ----------
    bits : (n, ceil(n_directions / 32)) uint32
        Bit j % 32 of word j // 32: whether texel j's centre is seen (never below the horizon).
    normals : (n, 3) float32, world
    lighting : CubemapLighting
    """

    kind: ClassVar[str] = "visibility"
    stored: ClassVar[tuple[str, ...]] = ("bits", "normals")
    file_names: ClassVar[dict[str, str]] = {"bits": "visibility"}
    by_row: ClassVar[tuple[str, ...]] = stored
    dark_below_horizon: ClassVar[bool] = True
    bits: NDArray[np.uint32]
    normals: NDArray[np.float32]
    lighting: CubemapLighting

    @property
    def shape(self) -> tuple[int, int, int]:
        return len(self.bits), self.lighting.n_directions, 1

    @property
    def nbytes(self) -> int:
        return self.bits.nbytes

    @property
    def seen(self) -> SeenTexels:
        """Bits, and no texels that are seen in part (``FractionalVisibility.seen``)."""
        starts = read_only(np.zeros(len(self.bits) + 1, np.int64))
        return self.bits, starts, read_only(np.zeros(0, np.uint16)), read_only(np.zeros(0, np.uint8))

    @property
    def falloffs(self) -> Floats:
        """As of ``FractionalVisibility``; next to nothing, as light comes from the centres of texels."""
        return np.full(self.lighting.n_directions, 1e-6, np.float32)

    @property
    def edges(self) -> Bits | None:
        return self.bits

    def rows(self, ids: Ids) -> Floats:
        ids, weighted = np.asarray(ids, np.int64), self._weighted
        result = np.zeros((len(ids), weighted.shape[1]), np.float32)
        run_in_parts(_expand_rows, len(ids), self.bits, self.normals, ids, weighted, result)
        return result[..., None]

    def columns(self, ids: Ids) -> Floats:
        return self.dense_columns(ids, np.empty((len(self.bits), len(ids)), np.float32))[..., None]

    def dense_columns(self, texels: Ids, out: Floats) -> Floats:
        texels = np.asarray(texels)
        words, shifts = (np.asarray(f(texels, BITS), np.uint32) for f in (np.floor_divide, np.mod))
        weighted = np.ascontiguousarray((self.lighting.directions[texels] * self._weights()[texels, None]).T)
        _expand_columns(self.bits, self.normals, words, shifts, weighted, out)
        return out

    def elements(self, ids: Ids, texels: Ids) -> Floats:
        seen = bits_at(self.bits, ids, texels)
        cosine = np.einsum("md,md->m", self.normals[ids], self.lighting.directions[texels])
        weights = self.lighting.solid_angles[texels] / np.float32(np.pi)
        return (np.maximum(cosine, 0) * seen * weights).astype(np.float32)[:, None]

    def relight(self, lighting: Floats) -> Floats:
        n_padded = self.bits.shape[1] * BITS
        directions = np.zeros((3, n_padded), dtype=np.float32)
        power = np.zeros((3, n_padded), dtype=np.float32)
        directions[:, : len(lighting)] = self.lighting.directions.T
        power[:, : len(lighting)] = (lighting * self._weights()[:, None]).T
        radiance = np.zeros((len(self.bits), 3), np.float32)
        run_in_parts(_relight_bits, len(radiance), self.bits, self.normals, directions, power, radiance)
        return radiance

    def masked(self, points: NDArray[np.int64], open: Bits) -> Visibility:
        bits = self.bits.copy()
        bits[points] &= open
        return replace(self, bits=bits)

    def combined(self, words: NDArray[np.integer], signs: Floats) -> Floats:
        texels = words[:, None] * signs.shape[1] + np.arange(signs.shape[1])
        power = self._weights()[texels]
        weighted = np.moveaxis(self.lighting.directions[texels], 2, 1) * power[:, None]  # [word, xyz, bit]
        arrays = np.asarray(words, np.int64), np.ascontiguousarray(weighted), signs
        result = np.zeros((len(self.bits), signs.shape[1]), np.float32)
        run_in_parts(_combine, len(result), self.bits, self.normals, *arrays, result)
        return result

    def check(self) -> None:
        check_bits(self.bits, self.normals, self.lighting)

    @cached_property
    def _weighted(self) -> Floats:
        """Directions (3, n_directions) times their weights; kept, as rows are expanded few at a time."""
        return np.ascontiguousarray((self.lighting.directions * self._weights()[:, None]).T)

    def _weights(self) -> Floats:
        return self.lighting.solid_angles / np.float32(np.pi)


def check_bits(bits: Bits, normals: Floats, lighting: CubemapLighting) -> None:
    """Raise ValueError unless bits and normals are of the same points, and bits of this lighting."""
    words = -(-lighting.n_directions // BITS)
    if bits.shape[1:] != (words,) or normals.shape != (len(bits), 3):
        raise ValueError(f"visibility {bits.shape} and normals {normals.shape} do not fit together")


@numba.njit(nogil=True, cache=True)
def _expand_rows(
    first: int,
    last: int,
    bits: NDArray[np.uint32],
    normals: Floats,
    ids: NDArray[np.int64],
    weighted: Floats,
    result: Floats,
) -> None:
    """Elements (n, m) of rows ``ids``; weighted (3, m) are directions times power."""
    for i in range(first, last):
        nx, ny, nz = normals[ids[i], 0], normals[ids[i], 1], normals[ids[i], 2]
        for word in range(bits.shape[1]):
            mask = bits[ids[i], word]
            if mask == 0:
                continue
            for j in range(word * 32, min(word * 32 + 32, weighted.shape[1])):
                cosine = nx * weighted[0, j] + ny * weighted[1, j] + nz * weighted[2, j]
                seen = np.float32((mask >> np.uint32(j % 32)) & np.uint32(1))
                result[i, j] = max(cosine, np.float32(0)) * seen


@numba.njit(nogil=True, fastmath=True, cache=True)
def _relight_bits(
    first: int,
    last: int,
    bits: NDArray[np.uint32],
    normals: Floats,
    directions: Floats,
    power: Floats,
    radiance: Floats,
) -> None:
    """Sum of power[:, j] * max(0, n_i . w_j) over the set bits j of row i; the inner loop is one word of bits."""
    for i in range(first, last):
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


@numba.njit(parallel=True, cache=True)
def _expand_columns(
    bits: NDArray[np.uint32],
    normals: Floats,
    words: NDArray[np.uint32],
    shifts: NDArray[np.uint32],
    weighted: Floats,
    result: Floats,
) -> None:
    """Elements (n, m) at bits ``shifts`` of ``words``; weighted (3, m) are directions times power."""
    for i in numba.prange(len(bits)):
        nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
        for j in range(len(words)):
            light = nx * weighted[0, j] + ny * weighted[1, j] + nz * weighted[2, j]
            seen = (bits[i, words[j]] >> shifts[j]) & np.uint32(1)
            result[i, j] = max(light, np.float32(0)) * np.float32(seen)


@numba.njit(nogil=True, fastmath={"contract"}, cache=True)
def _combine(
    first: int,
    last: int,
    bits: NDArray[np.uint32],
    normals: Floats,
    words: NDArray[np.int64],
    weighted: Floats,
    signs: Floats,
    result: Floats,
) -> None:
    """Sums (n, k) over words of the elements at their bits, with signs (words, k); weighted (words, 3, k)."""
    for i in range(first, last):
        nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
        for g in range(len(words)):
            mask = bits[i, words[g]]
            if mask == 0:
                continue
            for k in range(signs.shape[1]):
                light = nx * weighted[g, 0, k] + ny * weighted[g, 1, k] + nz * weighted[g, 2, k]
                seen = signs[g, k] * np.float32((mask >> np.uint32(k)) & np.uint32(1))
                result[i, k] += max(light, np.float32(0)) * seen
