"""Direct light of glossy vertices, one row for each term of their BRDF; visibility is that of the vertex.

``T_k(x, j) = f_k(w_j in the frame of x) V(x, w_j) d_omega_j`` ([HR10] eq. 3), f_k of either sign.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.bits import BITS
from mi_sparse_prt.core.block_products import rows_times
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.operators.visibility import Visibility

LANES = 4  # terms at a time

Rows = NDArray[np.integer]
Floats = NDArray[np.float32]


@dataclass(frozen=True)
class FactoredVisibility:
    """White direct transport of all vertices, followed by the terms of the glossy ones.

    Row i < n_v is that of ``Visibility``; row ``n_v + K * i + k`` is term k of the i-th glossy vertex.

    Attributes
    ----------
    bits : (n_v, n_directions / 32) uint32
    normals : (n_v, 3) float32, world
    lighting : CubemapLighting
    glossy : (n_g,) int64
        Numbers of the glossy vertices.
    frames : (n_g, 3, 3) float32
        From the world to their frames.
    materials : (n_g,) int64
        Which table.
    tables : (materials, size, size, K) float32
        f_k (``reflection.factor_tables``).
    """

    bits: NDArray[np.uint32]
    normals: Floats
    lighting: CubemapLighting
    glossy: NDArray[np.int64]
    frames: Floats
    materials: NDArray[np.int64]
    tables: Floats

    @property
    def terms(self) -> int:
        """K."""
        return self.tables.shape[3]

    @property
    def count(self) -> int:
        """Rows."""
        return len(self.bits) + len(self.glossy) * self.terms

    @property
    def nbytes(self) -> int:
        return self.bits.nbytes + self.frames.nbytes + self.tables.nbytes

    @cached_property
    def white(self) -> Visibility:
        """The rows of all vertices."""
        return Visibility(self.bits, self.normals, self.lighting)

    @cached_property
    def _padded(self) -> Floats:
        """Tables with as many terms as vector instructions take."""
        return np.pad(self.tables, ((0, 0), (0, 0), (0, 0), (0, -self.terms % LANES)))

    def with_rows(self, ids: Rows) -> tuple[FactoredVisibility, NDArray[np.int64]]:
        """A smaller part that has some rows, and where in it they are (len(ids),)."""
        ids, n = np.asarray(ids), len(self.bits)
        which, term = np.divmod(np.maximum(ids - n, 0), self.terms)
        is_term = ids >= n
        vertices = np.unique(np.where(is_term, self.glossy[which], ids))
        kept = np.flatnonzero(np.isin(self.glossy, vertices))
        part = replace(
            self,
            bits=self.bits[vertices],
            normals=self.normals[vertices],
            glossy=np.searchsorted(vertices, self.glossy[kept]),
            frames=self.frames[kept],
            materials=self.materials[kept],
        )
        as_term = len(vertices) + np.searchsorted(kept, which) * self.terms + term
        place = np.where(is_term, as_term, np.searchsorted(vertices, ids))
        return part, place

    def rows(self, ids: Rows) -> Floats:
        ids = np.asarray(ids)
        result = np.empty((len(ids), self.lighting.n_directions, 1), np.float32)
        dull = ids < len(self.bits)
        result[dull] = self.white.rows(ids[dull])
        which, term = np.divmod(ids[~dull] - len(self.bits), self.terms)
        distinct, place = np.unique(which, return_inverse=True)
        terms = self._term_values(distinct, np.arange(self.lighting.n_directions))
        result[~dull, :, 0] = terms[place, term]
        return result

    def columns(self, ids: Rows) -> Floats:
        return np.concatenate([self.white.columns(ids), self.term_columns(ids)[..., None]])

    def term_columns(self, ids: Rows) -> Floats:
        """Columns of the terms alone, (n_g * K, len(ids))."""
        return self._term_values(np.arange(len(self.glossy)), np.asarray(ids)).reshape(-1, len(ids))

    def relight(self, lighting: Floats) -> Floats:
        directions, power = np.ascontiguousarray(self.lighting.directions.T), self._power(lighting)
        own = self.glossy, self.frames, self.materials, self._padded
        return np.concatenate(
            [
                self.white.relight(lighting),
                _relit(self.bits, *own, directions, power, self.terms).reshape(-1, 3),
            ]
        )

    def reordered(self, source: Rows) -> FactoredVisibility:
        """The part of other vertices: ``source`` numbers those of this one, each at most once."""
        number = np.full(len(self.bits), -1)
        number[self.glossy] = np.arange(len(self.glossy))
        kept = number[source][number[source] >= 0]
        return replace(
            self,
            bits=self.bits[source],
            normals=self.normals[source],
            glossy=np.flatnonzero(number[source] >= 0),
            frames=self.frames[kept],
            materials=self.materials[kept],
        )

    def project(self, vectors: Floats) -> Floats:
        return rows_times(self.rows, self.count, vectors)

    def combined(self, words: NDArray[np.integer], signs: Floats) -> Floats:
        """Sums of the terms' columns at the same place in some words of bits, with signs: (n_g * K, bits of a word)."""
        texels = words[:, None] * signs.shape[1] + np.arange(signs.shape[1])
        directions = np.ascontiguousarray(np.moveaxis(self.lighting.directions[texels], 2, 1))
        power = signs * self.lighting.solid_angles[texels]
        own = self.glossy, self.frames, self.materials, self._padded
        places = np.asarray(words, np.int64)
        found = _combined(self.bits, *own, places, directions, power.astype(np.float32), self.terms)
        return found.reshape(-1, signs.shape[1])

    def _term_values(self, which: Rows, texels: Rows) -> Floats:
        """Terms (n, K, m) of some glossy vertices at some texels."""
        some = self.glossy[which], self.frames[which], self.materials[which], self._padded
        directions = np.ascontiguousarray(self.lighting.directions[texels].T)
        words, shifts = np.divmod(np.asarray(texels, np.int64), BITS)
        power = self.lighting.solid_angles[texels].astype(np.float32)
        return _expanded(self.bits, *some, words, shifts.astype(np.uint32), directions, power, self.terms)

    def _power(self, lighting: Floats) -> Floats:
        return (lighting * self.lighting.solid_angles[:, None]).astype(np.float32)


@numba.njit(fastmath=True, inline="always")
def _add(
    total: Floats, place: int, table: Floats, frame: Floats, u: Any, v: Any, w: Any, weight: Any
) -> None:
    """Add weight times the values of a table (size, size, K) in direction (u, v, w), turned by a frame.

    To total[place], whose length K is a multiple of LANES: loops of known length become vector instructions.
    """
    one, size = np.float32(1), table.shape[0]
    z = frame[2, 0] * u + frame[2, 1] * v + frame[2, 2] * w
    half = np.float32(0.5 * (size - 1))
    scale = half / (one + max(z, np.float32(0)))
    a = (frame[0, 0] * u + frame[0, 1] * v + frame[0, 2] * w) * scale + half
    b = (frame[1, 0] * u + frame[1, 1] * v + frame[1, 2] * w) * scale + half
    column, row = min(max(int(a), 0), size - 2), min(max(int(b), 0), size - 2)
    a, b = a - np.float32(column), b - np.float32(row)
    p, q = weight * (one - a) * (one - b), weight * a * (one - b)
    r, s = weight * (one - a) * b, weight * a * b
    for first in range(0, table.shape[2], LANES):
        for lane in range(LANES):
            k = first + lane
            total[place, k] += (
                p * table[row, column, k]
                + q * table[row, column + 1, k]
                + r * table[row + 1, column, k]
                + s * table[row + 1, column + 1, k]
            )


@numba.njit(parallel=True, fastmath=True, cache=True)
def _expanded(
    bits: NDArray[np.uint32],
    vertices: NDArray[np.int64],
    frames: Floats,
    materials: NDArray[np.int64],
    tables: Floats,
    words: NDArray[np.int64],
    shifts: NDArray[np.uint32],
    directions: Floats,
    power: Floats,
    terms: int,
) -> Floats:
    """Terms (n, terms, m) at directions (3, m)."""
    result = np.zeros((len(vertices), terms, len(words)), np.float32)
    for i in numba.prange(len(vertices)):
        value = np.empty((1, tables.shape[3]), np.float32)
        for j in range(len(words)):
            if (bits[vertices[i], words[j]] >> shifts[j]) & np.uint32(1) == 0:
                continue
            u, v, w = directions[0, j], directions[1, j], directions[2, j]
            value[:] = 0
            _add(value, 0, tables[materials[i]], frames[i], u, v, w, power[j])
            for k in range(terms):
                result[i, k, j] = value[0, k]
    return result


@numba.njit(parallel=True, fastmath=True, cache=True)
def _relit(
    bits: NDArray[np.uint32],
    vertices: NDArray[np.int64],
    frames: Floats,
    materials: NDArray[np.int64],
    tables: Floats,
    directions: Floats,
    power: Floats,
    terms: int,
) -> Floats:
    """Coefficients (n, terms, 3) under lights power (n_directions, 3), solid angles included."""
    result = np.empty((len(vertices), terms, 3), np.float32)
    for i in numba.prange(len(vertices)):
        total = np.zeros((3, tables.shape[3]), np.float32)
        value = np.empty((1, tables.shape[3]), np.float32)
        for j in range(directions.shape[1]):
            if (bits[vertices[i], j // 32] >> np.uint32(j % 32)) & np.uint32(1) == 0:
                continue
            u, v, w = directions[0, j], directions[1, j], directions[2, j]
            value[:] = 0
            _add(value, 0, tables[materials[i]], frames[i], u, v, w, np.float32(1))
            for c in range(3):
                for k in range(tables.shape[3]):
                    total[c, k] += value[0, k] * power[j, c]
        for k in range(terms):  # not a slice: its error message alone compiles for seconds
            for c in range(len(total)):
                result[i, k, c] = total[c, k]
    return result


@numba.njit(parallel=True, fastmath=True, cache=True)
def _combined(
    bits: NDArray[np.uint32],
    vertices: NDArray[np.int64],
    frames: Floats,
    materials: NDArray[np.int64],
    tables: Floats,
    words: NDArray[np.int64],
    directions: Floats,
    power: Floats,
    terms: int,
) -> Floats:
    """Sums (n, terms, b) over words of the terms at their bits; directions (words, 3, b), power (words, b)."""
    width = power.shape[1]
    result = np.empty((len(vertices), terms, width), np.float32)
    for i in numba.prange(len(vertices)):
        total = np.zeros((width, tables.shape[3]), np.float32)
        for g in range(len(words)):
            mask = bits[vertices[i], words[g]]
            if mask == 0:
                continue
            for b in range(width):
                if (mask >> np.uint32(b)) & np.uint32(1) == 0:
                    continue
                u, v, w = directions[g, 0, b], directions[g, 1, b], directions[g, 2, b]
                _add(total, b, tables[materials[i]], frames[i], u, v, w, power[g, b])
        for k in range(terms):  # not a slice: its error message alone compiles for seconds
            for c in range(len(total)):
                result[i, k, c] = total[c, k]
    return result
