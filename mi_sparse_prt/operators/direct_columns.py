"""D, white direct transport, expanded to numbers a few columns at a time."""

from __future__ import annotations

from collections.abc import Iterator

import numba
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.bits import BITS
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.operators.factored_visibility import FactoredVisibility
from mi_sparse_prt.operators.mean_cosine import FIXED_POINT, MeanCosine
from mi_sparse_prt.operators.operator import Part
from mi_sparse_prt.operators.visibility import Visibility

BLOCK = 1 << 22  # elements at a time; 16 MB stay in the cache until they are used

Floats = NDArray[np.float32]


class DirectColumns:
    """Columns of D at some vertices.

    Parameters
    ----------
    direct : Part
        One row per vertex. Bits and fixed-point numbers are expanded on all threads, other parts by their ``columns``.
    lighting : CubemapLighting
    vertices : (n,) integers, optional
        All if not given.
    """

    def __init__(
        self, direct: Part, lighting: CubemapLighting, vertices: NDArray[np.integer] | None = None
    ) -> None:
        self._direct, self._lighting, self._vertices = direct, lighting, vertices
        if vertices is not None and isinstance(direct, Visibility | MeanCosine):
            self._direct, self._vertices = direct.reordered(vertices), None
        elif vertices is not None and isinstance(direct, FactoredVisibility):
            self._direct, self._vertices = direct.with_rows(vertices)
        self._buffer: Floats = np.empty(0, np.float32)
        self.n_texels = lighting.n_directions

    def at(self, texels: NDArray[np.integer]) -> Floats:
        """(n, k) float32, which the next call overwrites: new pages cost more than the numbers in them."""
        direct, power = self._direct, self._lighting.solid_angles[texels] / np.float32(np.pi)
        if isinstance(direct, Visibility):
            words, shifts = (np.asarray(f(texels, BITS), np.uint32) for f in (np.floor_divide, np.mod))
            beams = np.ascontiguousarray((self._lighting.directions[texels] * power[:, None]).T)
            result = self._room(len(direct.bits), len(texels))
            _expand(direct.bits, direct.normals, words, shifts, beams, result)
            return result
        if isinstance(direct, MeanCosine):
            result = self._room(len(direct.fixed), len(texels))
            _convert(direct.fixed, np.asarray(texels, np.int64), power / np.float32(FIXED_POINT), result)
            return result
        if isinstance(direct, FactoredVisibility):
            dull = DirectColumns(direct.white, self._lighting).at(texels)
            columns = np.concatenate([dull, direct.term_columns(texels)])
        else:
            columns = direct.columns(texels)[..., 0]
        return columns if self._vertices is None else columns[self._vertices]

    def combined(self, few: int, rng: np.random.Generator) -> Floats:
        """Sums of few random columns each, with random signs: (n, k), at most a word's bits of them.

        The columns of a sum are at the same place in random words of bits, so that words are read as a whole.
        """
        width = min(BITS, self.n_texels)
        words = rng.permutation(self.n_texels // width)[:few]
        signs = rng.choice(np.array([-1, 1], np.float32), (len(words), width))
        if isinstance(self._direct, FactoredVisibility):
            dull = DirectColumns(self._direct.white, self._lighting)._added(words, signs)
            return np.concatenate([dull, self._direct.combined(words, signs)])
        return self._added(words, signs)

    def _added(self, words: NDArray[np.int64], signs: Floats) -> Floats:
        """Sums of columns at the same place in some words, with signs (words, bits)."""
        texels = words[:, None] * signs.shape[1] + np.arange(signs.shape[1])
        if isinstance(self._direct, Visibility):
            power = self._lighting.solid_angles[texels] / np.float32(np.pi)
            beams = np.moveaxis(self._lighting.directions[texels], 2, 1) * power[:, None]  # [word, xyz, bit]
            return _combine(
                self._direct.bits, self._direct.normals, words, np.ascontiguousarray(beams), signs
            )
        total = self.at(texels[0]) * signs[0]
        for some, sign in zip(texels[1:], signs[1:], strict=True):
            total += self.at(some) * sign
        return total

    def blocks(self, n_vertices: int) -> Iterator[tuple[slice, Floats]]:
        """All texels of the lighting in turn: which ones, and their columns (``at``)."""
        n, size = self.n_texels, max(1, BLOCK // max(n_vertices, 1))
        for a in range(0, n, size):
            part = slice(a, min(a + size, n))
            yield part, self.at(np.arange(part.start, part.stop))

    def _room(self, rows: int, columns: int) -> Floats:
        if self._buffer.size < rows * columns:
            self._buffer = np.empty(rows * columns, np.float32)
        return self._buffer[: rows * columns].reshape(rows, columns)


@numba.njit(parallel=True, cache=True)
def _expand(
    bits: NDArray[np.uint32],
    normals: Floats,
    words: NDArray[np.uint32],
    shifts: NDArray[np.uint32],
    beams: Floats,
    result: Floats,
) -> None:
    """Elements of ``Visibility`` (n, m) at bits ``shifts`` of ``words``; beams (3, m) are directions times power."""
    for i in numba.prange(len(bits)):
        nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
        for j in range(len(words)):
            light = nx * beams[0, j] + ny * beams[1, j] + nz * beams[2, j]
            seen = (bits[i, words[j]] >> shifts[j]) & np.uint32(1)
            result[i, j] = max(light, np.float32(0)) * np.float32(seen)


@numba.njit(parallel=True, fastmath={"contract"}, cache=True)
def _combine(
    bits: NDArray[np.uint32], normals: Floats, words: NDArray[np.int64], beams: Floats, signs: Floats
) -> Floats:
    """Sums (n, k) over words of the elements at their bits, with signs (words, k); beams (words, 3, k)."""
    result = np.zeros((len(bits), signs.shape[1]), np.float32)
    for i in numba.prange(len(bits)):
        nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
        for g in range(len(words)):
            mask = bits[i, words[g]]
            if mask == 0:
                continue
            for k in range(signs.shape[1]):
                light = nx * beams[g, 0, k] + ny * beams[g, 1, k] + nz * beams[g, 2, k]
                seen = signs[g, k] * np.float32((mask >> np.uint32(k)) & np.uint32(1))
                result[i, k] += max(light, np.float32(0)) * seen
    return result


@numba.njit(parallel=True, cache=True)
def _convert(fixed: NDArray[np.uint16], texels: NDArray[np.int64], units: Floats, result: Floats) -> None:
    """Elements of ``MeanCosine`` (n, m): multiples of the units (m,)."""
    for i in numba.prange(len(fixed)):
        for j in range(len(texels)):
            result[i, j] = np.float32(fixed[i, texels[j]]) * units[j]
