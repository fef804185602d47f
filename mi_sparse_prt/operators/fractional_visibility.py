"""Direct light in the texel basis, as the visible share of each texel: nearly always all of it or nothing.

``T = share * mean of max(0, n . w) over the texel * solid angle / pi``. The mean is analytic.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import ClassVar

import numba
import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mi_sparse_prt.core.bits import BITS, Bits, bit_of, bits_at
from mi_sparse_prt.core.ragged import select_rows
from mi_sparse_prt.core.threads import run_in_parts
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.operators.operator import Floats, Ids, Operator
from mi_sparse_prt.operators.visibility import SeenTexels, check_bits

FULL = 255  # a share of 1
_PARTS = 256  # of a face per axis, over which directions are averaged


@dataclass(frozen=True)
class FractionalVisibility(Operator):
    """One bit per element, and 8 more where an edge of visibility cuts the texel.

    Attributes
    ----------
    bits : (n_v, ceil(n_directions / 32)) uint32
        Whether texels are seen: bit j % 32 of word j // 32.
    starts : (n_v + 1,) int64
        Where the texels of each vertex that are seen in part begin in the next two arrays.
    texels : (m,) uint16 or uint32
        Ascending for each vertex.
    shares : (m,) uint8
        What is seen of these texels, whatever their bits are; 255 is all.
    normals : (n_v, 3) float32, world
    lighting : CubemapLighting
    """

    kind: ClassVar[str] = "fractional_visibility"
    stored: ClassVar[tuple[str, ...]] = ("bits", "normals", "starts", "texels", "shares")
    file_names: ClassVar[dict[str, str]] = {"bits": "visibility"}
    bits: NDArray[np.uint32]
    starts: NDArray[np.int64]
    texels: NDArray[np.unsignedinteger]
    shares: NDArray[np.uint8]
    normals: Floats
    lighting: CubemapLighting

    @property
    def shape(self) -> tuple[int, int, int]:
        return len(self.bits), self.lighting.n_directions, 1

    @property
    def seen(self) -> SeenTexels:
        """``bits``, ``starts``, ``texels`` and ``shares``."""
        return self.bits, self.starts, self.texels, self.shares

    @property
    def falloffs(self) -> Floats:
        """(n_directions,), how far n . w within a texel is from its mean, about, for normals at right angles to it."""
        return _means(self.lighting.resolution)[1][: self.lighting.n_directions]

    @property
    def edges(self) -> Bits | None:
        return self.bits

    @property
    def nbytes(self) -> int:
        return self.bits.nbytes + self.starts.nbytes + self.texels.nbytes + self.shares.nbytes

    def rows(self, ids: Ids) -> Floats:
        return self.take(ids)._expanded(np.arange(self.lighting.n_directions))

    def columns(self, ids: Ids) -> Floats:
        distinct, place = np.unique(np.asarray(ids, np.int64), return_inverse=True)
        columns = self._expanded(distinct)
        return columns if np.array_equal(distinct, ids) else columns[:, place]

    def relight(self, lighting: Floats) -> Floats:
        directions, falloffs = _means(self.lighting.resolution)
        power = np.zeros((3, len(falloffs)), np.float32)
        power[:, : len(lighting)] = (lighting * self._weights()[:, None]).T
        return _relight(self.seen, self.normals, directions, falloffs, power)

    def combined(self, words: NDArray[np.integer], signs: Floats) -> Floats:
        directions, falloffs = _means(self.lighting.resolution)
        texels = words[:, None] * signs.shape[1] + np.arange(signs.shape[1])
        place = np.full(-(-self.lighting.n_directions // signs.shape[1]), -1)
        place[words] = np.arange(len(words))
        arrays = (
            place,
            np.moveaxis(directions[:, texels], 0, 1),
            falloffs[texels],
            signs * self._weights()[texels],
        )
        result = np.zeros((len(self.bits), signs.shape[1]), np.float32)
        words = np.asarray(words, np.int64)
        run_in_parts(
            _combine, len(result), self.seen, self.normals, words, *map(np.ascontiguousarray, arrays), result
        )
        return result

    def masked(self, points: NDArray[np.int64], open: Bits) -> FractionalVisibility:
        bits, shares = self.bits.copy(), self.shares.copy()
        bits[points] &= open
        _, row, entries = select_rows(self.starts, points)
        shares[entries] *= bits_at(open, row, self.texels[entries]).astype(np.uint8)
        return replace(self, bits=bits, shares=shares)

    def take(self, source: Ids) -> FractionalVisibility:
        source = np.asarray(source)
        starts, _, entries = select_rows(self.starts, source)
        return replace(
            self,
            bits=self.bits[source],
            starts=starts,
            texels=self.texels[entries],
            shares=self.shares[entries],
            normals=self.normals[source],
        )

    def elements(self, ids: Ids, texels: Ids) -> Floats:
        weighted = *_means(self.lighting.resolution), self._weights()
        asked = np.asarray(ids, np.int64), np.asarray(texels, np.int64)
        result = np.empty(len(ids), np.float32)
        run_in_parts(_single, len(result), self.seen, self.normals, *weighted, *asked, result)
        return result[:, None]

    def check(self) -> None:
        check_bits(self.bits, self.normals, self.lighting)
        # nothing that uses the lists looks whether they make sense
        lists = (self.shares, self.texels, self.starts)
        matrix = scipy.sparse.csr_array(lists, shape=(len(self.bits), self.lighting.n_directions))
        matrix.check_format(full_check=True)
        if not matrix.has_canonical_format:
            raise ValueError("texels that are seen in part are not in order")

    def _expanded(self, ids: Ids) -> Floats:
        """Elements (n_v, k, 1) of texels (k,), no texel twice."""
        directions, falloffs = _means(self.lighting.resolution)
        place = np.full(self.lighting.n_directions, -1)
        place[ids] = np.arange(len(ids))
        weighted = np.ascontiguousarray(directions[:, ids]), falloffs[ids], self._weights()[ids]
        result = np.empty((len(self.bits), len(ids)), np.float32)
        _expand(self.seen, self.normals, np.asarray(ids, np.int64), *weighted, place, result)
        return result[..., None]

    def _weights(self) -> Floats:
        return self.lighting.solid_angles / np.float32(np.pi)


@cache
def _means(resolution: int) -> tuple[Floats, Floats]:
    """Mean directions (3, padded to whole words) and falloffs (padded,) of a cubemap's texels.

    Over a texel n . w is between its mean m and m +- the falloff, evenly: near enough for the few texels that the
    horizon cuts, exact for all others. The falloff has the variance of w along a random normal at right angles to it.
    """
    lighting = CubemapLighting(resolution)
    parts, areas = lighting.subdirections(max(4, _PARTS // resolution))
    weights = (areas / areas.sum(axis=1, keepdims=True)).astype(np.float64)
    mean = np.einsum("jk,jkd->jd", weights, parts)
    variance = np.einsum("jk,jkd->j", weights, (parts - mean[:, None]) ** 2) / 2
    padded = -(-lighting.n_directions // BITS) * BITS
    directions, falloffs = np.zeros((3, padded), np.float32), np.ones(padded, np.float32)
    directions[:, : len(mean)] = mean.T
    falloffs[: len(mean)] = np.sqrt(3 * variance)
    return directions, falloffs


@numba.njit(fastmath=True, inline="always")
def _mean_cosine(cosine: np.float32, falloff: np.float32) -> np.float32:
    """Mean of max(0, x) for x evenly between cosine - falloff and cosine + falloff; without a branch."""
    above = min(max(cosine + falloff, np.float32(0)), np.float32(2) * falloff)
    return above * above / (np.float32(4) * falloff) + max(cosine - falloff, np.float32(0))


@numba.njit(parallel=True, fastmath=True, cache=True)
def _relight(
    seen_texels: SeenTexels,
    normals: Floats,
    directions: Floats,
    falloffs: Floats,
    power: Floats,
) -> Floats:
    """Sum of power[:, j] times the share and the mean cosine of texel j; the inner loop is one word of bits."""
    bits, starts, texels, shares = seen_texels
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
                bit = np.float32((mask >> np.uint32(k)) & np.uint32(1))
                seen = _mean_cosine(cosine, falloffs[j]) * bit
                red += seen * power[0, j]
                green += seen * power[1, j]
                blue += seen * power[2, j]
        for e in range(starts[i], starts[i + 1]):
            j = texels[e]
            cosine = nx * directions[0, j] + ny * directions[1, j] + nz * directions[2, j]
            more = np.float32(shares[e]) / np.float32(FULL) - np.float32(bit_of(bits[i], j))
            seen = _mean_cosine(cosine, falloffs[j]) * more
            red += seen * power[0, j]
            green += seen * power[1, j]
            blue += seen * power[2, j]
        radiance[i, 0], radiance[i, 1], radiance[i, 2] = red, green, blue
    return radiance


@numba.njit(parallel=True, cache=True)
def _expand(
    seen_texels: SeenTexels,
    normals: Floats,
    ids: NDArray[np.int64],
    directions: Floats,
    falloffs: Floats,
    weights: Floats,
    place: NDArray[np.int64],
    result: Floats,
) -> None:
    """Elements of texels ``ids``, in ascending order of columns; ``place`` says which column a texel has, or -1.

    Directions, falloffs and weights are those of ``ids``.
    """
    bits, starts, texels, shares = seen_texels
    for i in numba.prange(len(bits)):
        nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
        for c in range(len(ids)):
            cosine = nx * directions[0, c] + ny * directions[1, c] + nz * directions[2, c]
            seen = np.float32(bit_of(bits[i], ids[c]))
            result[i, c] = seen * _mean_cosine(cosine, falloffs[c]) * weights[c]
        if len(ids) == 0:
            continue
        own = texels[starts[i] : starts[i + 1]]
        for e in range(starts[i] + np.searchsorted(own, ids[0]), starts[i + 1]):
            if texels[e] > ids[-1]:
                break
            c = place[texels[e]]
            if c >= 0:
                cosine = nx * directions[0, c] + ny * directions[1, c] + nz * directions[2, c]
                share = np.float32(shares[e]) / np.float32(FULL)
                result[i, c] = share * _mean_cosine(cosine, falloffs[c]) * weights[c]


@numba.njit(nogil=True, fastmath=True, cache=True)
def _combine(
    first: int,
    last: int,
    seen_texels: SeenTexels,
    normals: Floats,
    words: NDArray[np.int64],
    place: NDArray[np.int64],
    directions: Floats,
    falloffs: Floats,
    power: Floats,
    result: Floats,
) -> None:
    """Sums (n, k) over words of the elements at their bits, times powers (words, k).

    Directions (words, 3, k) and falloffs are of the same texels; ``place`` says which of the words one is, or -1.
    """
    bits, starts, texels, shares = seen_texels
    width = power.shape[1]
    for i in range(first, last):
        nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
        for g in range(len(words)):
            mask = bits[i, words[g]]
            if mask == 0:
                continue
            for k in range(width):
                cosine = nx * directions[g, 0, k] + ny * directions[g, 1, k] + nz * directions[g, 2, k]
                seen = power[g, k] * np.float32((mask >> np.uint32(k)) & np.uint32(1))
                result[i, k] += _mean_cosine(cosine, falloffs[g, k]) * seen
        for e in range(starts[i], starts[i + 1]):
            word = texels[e] // width
            g, k = place[word], texels[e] - word * width
            if g < 0:
                continue
            cosine = nx * directions[g, 0, k] + ny * directions[g, 1, k] + nz * directions[g, 2, k]
            more = np.float32(shares[e]) / np.float32(FULL) - np.float32(bit_of(bits[i], texels[e]))
            result[i, k] += _mean_cosine(cosine, falloffs[g, k]) * power[g, k] * more


@numba.njit(nogil=True, cache=True)
def _single(
    first: int,
    last: int,
    seen_texels: SeenTexels,
    normals: Floats,
    directions: Floats,
    falloffs: Floats,
    weights: Floats,
    ids: NDArray[np.int64],
    asked: NDArray[np.int64],
    result: Floats,
) -> None:
    """Elements of vertices ``ids`` and texels ``asked``."""
    bits, starts, texels, shares = seen_texels
    for m in range(first, last):
        i, j = ids[m], asked[m]
        cosine = np.float32(0)
        for d in range(3):
            cosine += normals[i, d] * directions[d, j]
        own = texels[starts[i] : starts[i + 1]]
        e = np.searchsorted(own, j)
        if e < len(own) and own[e] == j:
            share = np.float32(shares[starts[i] + e]) / np.float32(FULL)
        else:
            share = np.float32(bit_of(bits[i], j))
        result[m] = share * _mean_cosine(cosine, falloffs[j]) * weights[j]
