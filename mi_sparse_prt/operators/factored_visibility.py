"""Direct light of glossy points, one row for each term of their BRDF; visibility is that of the point.

``T_k(x, j) = f_k(w_j in the frame of x) V(x, w_j) d_omega_j`` ([HR10] eq. 3), f_k of either sign. In the texel basis V
is the visible share of the texel, and tables have means of f_k over discs as large as texels, or over what of these is
above the horizon. Of a texel that the horizon cuts, only the part above it counts: many lobes are brightest near the
horizon, where irradiance is next to nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numba
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.bits import Bits, bit_of
from mi_sparse_prt.core.threads import run_in_parts
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.operators.fractional_visibility import FULL, FractionalVisibility
from mi_sparse_prt.operators.operator import Floats, Ids, Operator
from mi_sparse_prt.operators.visibility import SeenTexels, Visibility
from mi_sparse_prt.reflection.frames import frames

LANES = 4  # terms at a time

#: Numbers of glossy points, their frames, the numbers of their tables, these, and how many terms each has.
GlossyPoints = tuple[NDArray[np.int64], Floats, NDArray[np.int64], Floats, NDArray[np.int64]]


@dataclass(frozen=True)
class FactoredVisibility(Operator):
    """Unit-albedo direct transport of all points, followed by the terms of the glossy ones.

    Row i < n is that of ``visibility``; row ``n + K * i + k`` is term k of the i-th glossy point.

    Attributes
    ----------
    visibility : Visibility or FractionalVisibility
        Of all n points.
    tangents : (n, 3) float32, world
    material : (n,) int64
        Which table, -1 at points that are not glossy.
    tables : (materials, size, size, K) float32
        f_k (``reflection.factor_tables``).
    """

    kind: ClassVar[str] = "factored_visibility"
    stored: ClassVar[tuple[str, ...]] = ("visibility", "tangents", "material", "tables")
    visibility: Visibility | FractionalVisibility
    tangents: Floats
    material: NDArray[np.int64]
    tables: Floats

    @property
    def lighting(self) -> CubemapLighting:
        return self.visibility.lighting

    @property
    def shape(self) -> tuple[int, int, int]:
        n, m, _ = self.visibility.shape
        return n + len(self.glossy) * self.terms, m, 1

    @property
    def terms(self) -> int:
        """K."""
        return self.tables.shape[3]

    @cached_property
    def glossy(self) -> NDArray[np.int64]:
        """Numbers of the glossy points, (n_g,)."""
        return np.flatnonzero(self.material >= 0)

    @cached_property
    def frames(self) -> Floats:
        """(n_g, 3, 3), from the world to the frames of the glossy points."""
        return frames(self.tangents[self.glossy], self.visibility.normals[self.glossy])

    @cached_property
    def _texels(self) -> Floats:
        """Directions of texels and how far heights within them are from theirs, at most, (m, 4)."""
        return np.column_stack([self.lighting.directions, self.visibility.falloffs]).astype(np.float32)

    @cached_property
    def own_terms(self) -> NDArray[np.int64]:
        """Terms (materials,) of each table: those after them are 0."""
        some = np.any(self.tables != 0, axis=(1, 2))
        return np.where(some.any(axis=1), self.terms - np.argmax(some[:, ::-1], axis=1), 0)

    @cached_property
    def _padded(self) -> Floats:
        """Tables with as many terms as vector instructions take."""
        return np.pad(self.tables, ((0, 0), (0, 0), (0, 0), (0, -self.terms % LANES)))

    def _points(self, which: Ids | slice = slice(None)) -> GlossyPoints:
        vertices = self.glossy[which]
        return vertices, self.frames[which], self.material[vertices], self._padded, self.own_terms

    def rows(self, ids: Ids) -> Floats:
        ids = np.asarray(ids)
        result = np.empty((len(ids), self.lighting.n_directions, 1), np.float32)
        diffuse = ids < len(self.material)
        result[diffuse] = self.visibility.rows(ids[diffuse])
        which, term = np.divmod(ids[~diffuse] - len(self.material), self.terms)
        distinct, place = np.unique(which, return_inverse=True)
        terms = self._term_values(distinct, np.arange(self.lighting.n_directions))
        result[~diffuse, :, 0] = terms[place, term]
        return result

    def columns(self, ids: Ids) -> Floats:
        return np.concatenate([self.visibility.columns(ids), self._term_columns(ids)[..., None]])

    def elements(self, ids: Ids, texels: Ids) -> Floats:
        ids, texels = np.asarray(ids), np.asarray(texels)
        result = np.empty((len(ids), 1), np.float32)
        diffuse = ids < len(self.material)
        result[diffuse] = self.visibility.elements(ids[diffuse], texels[diffuse])
        which, term = np.divmod(ids[~diffuse] - len(self.material), self.terms)
        asked = texels[~diffuse].astype(np.int64)
        directions, power = self._texels[asked], self.lighting.solid_angles[asked]
        places = asked, directions, power.astype(np.float32), term
        found = np.empty(len(which), np.float32)
        run_in_parts(_single, len(which), self.visibility.seen, self._points(which), *places, found)
        result[~diffuse, 0] = found
        return result

    def dense_columns(self, texels: Ids, out: Floats) -> Floats:
        n = len(self.material)
        diffuse = self.visibility.dense_columns(texels, out[:n])
        if diffuse.base is not out:
            out[:n] = diffuse
        out[n:] = self._term_columns(texels)
        return out

    def _term_columns(self, texels: Ids) -> Floats:
        """Columns of the terms alone, (n_g * K, len(texels))."""
        values = self._term_values(np.arange(len(self.glossy)), np.asarray(texels))
        return values.reshape(len(self.glossy) * self.terms, len(texels))

    def relight(self, lighting: Floats) -> Floats:
        directions = np.ascontiguousarray(self._texels.T)
        power = (lighting * self.lighting.solid_angles[:, None]).astype(np.float32)
        terms = np.empty((len(self.glossy), self.terms, 3), np.float32)
        run_in_parts(_relit, len(terms), self.visibility.seen, self._points(), directions, power, terms)
        return np.concatenate([self.visibility.relight(lighting), terms.reshape(-1, 3)])

    def combined(self, words: NDArray[np.integer], signs: Floats) -> Floats:
        texels = words[:, None] * signs.shape[1] + np.arange(signs.shape[1])
        directions = np.ascontiguousarray(np.moveaxis(self._texels[texels], 2, 1))
        power = (signs * self.lighting.solid_angles[texels]).astype(np.float32)
        place = np.full(-(-self.lighting.n_directions // signs.shape[1]), -1)
        place[words] = np.arange(len(words))
        chosen = np.asarray(words, np.int64), place, directions, power
        found = np.empty((len(self.glossy), self.terms, signs.shape[1]), np.float32)
        run_in_parts(_combined, len(found), self.visibility.seen, self._points(), *chosen, found)
        return np.concatenate([self.visibility.combined(words, signs), found.reshape(-1, signs.shape[1])])

    def masked(self, points: NDArray[np.int64], open: Bits) -> FactoredVisibility:
        """Without what points, and so all of their rows, lose; ``points`` are no terms."""
        return replace(self, visibility=self.visibility.masked(points, open))

    def take(self, ids: Ids) -> Operator:
        """Any rows; those of whole points, all unit-albedo rows first and then all terms, stay this kind."""
        ids, n = np.asarray(ids), len(self.material)
        which, term = np.divmod(np.maximum(ids - n, 0), self.terms)
        is_term = ids >= n
        points = ids[~is_term]
        part = self._of_points(points)
        if np.array_equal(ids, self._rows_of(points)):
            return part
        vertices = np.unique(np.where(is_term, self.glossy[which], ids))
        part = self._of_points(vertices)
        own = np.searchsorted(vertices[part.glossy], self.glossy[which[is_term]])
        place = np.searchsorted(vertices, ids)
        place[is_term] = len(vertices) + own * self.terms + term[is_term]
        return RowSelection(part, place)

    def _of_points(self, points: Ids) -> FactoredVisibility:
        visibility: Any = self.visibility.take(points)  # of the same kind
        return replace(
            self,
            visibility=visibility,
            tangents=self.tangents[points],
            material=self.material[points],
        )

    def _rows_of(self, points: Ids) -> NDArray[np.int64]:
        """All rows of some points: unit-albedo rows, then terms."""
        own = np.searchsorted(self.glossy, points[self.material[points] >= 0])
        terms = len(self.material) + own[:, None] * self.terms + np.arange(self.terms)
        return np.concatenate([points, terms.ravel()])

    def check(self) -> None:
        n = self.visibility.shape[0]
        if self.tangents.shape != (n, 3) or self.material.shape != (n,):
            raise ValueError("vertices and their tangents do not fit together")
        # a wrong number would read beyond the tables
        if n and not -1 <= self.material.min() <= self.material.max() < len(self.tables):
            raise ValueError("tables of incident factors and their vertices do not fit together")
        if self.tables.ndim != 4 or self.tables.shape[1] != self.tables.shape[2]:
            raise ValueError("tables of incident factors are not square")

    def _term_values(self, which: Ids, texels: Ids) -> Floats:
        """Terms (n, K, m) of some glossy points at some texels."""
        directions = np.ascontiguousarray(self._texels[texels].T)
        power = self.lighting.solid_angles[texels].astype(np.float32)
        asked = np.asarray(texels, np.int64)
        points = self._points(which)
        result = np.empty((len(points[0]), self.terms, len(asked)), np.float32)
        run_in_parts(_expanded, len(result), self.visibility.seen, points, asked, directions, power, result)
        return result


@dataclass(frozen=True)
class RowSelection(Operator):
    """Some rows of an operator, repeated or in any order; kept in memory only.

    Attributes
    ----------
    operator : Operator
    place : (n,) int64
        Which of its rows.
    """

    kind: ClassVar[str] = "row_selection"
    stored: ClassVar[tuple[str, ...]] = ("operator", "place")
    by_row: ClassVar[tuple[str, ...]] = ("place",)
    operator: Operator
    place: NDArray[np.int64]

    @property
    def shape(self) -> tuple[int, int, int]:
        return len(self.place), *self.operator.shape[1:]

    def rows(self, ids: Ids) -> Floats:
        return self.operator.rows(self.place[ids])

    def columns(self, ids: Ids) -> Floats:
        return self.operator.columns(ids)[self.place]

    def relight(self, lighting: Floats) -> Floats:
        return self.operator.relight(lighting)[self.place]

    def check(self) -> None:
        if len(self.place) and not 0 <= self.place.min() <= self.place.max() < self.operator.shape[0]:
            raise ValueError("rows are selected that are not there")


@numba.njit(fastmath=True, inline="always")
def _add(
    total: Floats,
    place: int,
    table: Floats,
    terms: int,
    frame: Floats,
    u: Any,
    v: Any,
    w: Any,
    spread: Any,
    weight: Any,
) -> None:
    """Add weight times the first values of a table (size, size, K) in direction (u, v, w), turned by a frame.

    What it stands for has heights evenly around its own, as far as ``spread``: those above the horizon count.

    To total[place], whose length K is a multiple of LANES: loops of known length become vector instructions.
    """
    one, size = np.float32(1), table.shape[0]
    z = frame[2, 0] * u + frame[2, 1] * v + frame[2, 2] * w
    weight = weight * min(max(np.float32(0.5) * (one + z / spread), np.float32(0)), one)
    half = np.float32(0.5 * (size - 1))
    scale = half / (one + max(z, np.float32(0)))
    a = (frame[0, 0] * u + frame[0, 1] * v + frame[0, 2] * w) * scale + half
    b = (frame[1, 0] * u + frame[1, 1] * v + frame[1, 2] * w) * scale + half
    column, row = min(max(int(a), 0), size - 2), min(max(int(b), 0), size - 2)
    a, b = a - np.float32(column), b - np.float32(row)
    p, q = weight * (one - a) * (one - b), weight * a * (one - b)
    r, s = weight * (one - a) * b, weight * a * b
    for first in range(0, terms, LANES):
        for lane in range(LANES):
            k = first + lane
            total[place, k] += (
                p * table[row, column, k]
                + q * table[row, column + 1, k]
                + r * table[row + 1, column, k]
                + s * table[row + 1, column + 1, k]
            )


@numba.njit(nogil=True, fastmath=True, cache=True)
def _expanded(
    start: int,
    end: int,
    seen: SeenTexels,
    points: GlossyPoints,
    texels: NDArray[np.int64],
    directions: Floats,
    power: Floats,
    result: Floats,
) -> None:
    """Terms (n, terms, m) at texels (m,), whose directions and spreads are (4, m)."""
    (bits, starts, listed, shares), (vertices, frames, materials, tables, counts) = seen, points
    value, most = np.empty((1, tables.shape[3]), np.float32), result.shape[1]
    for i in range(start, end):
        table, terms = tables[materials[i]], counts[materials[i]]
        first, last = starts[vertices[i]], starts[vertices[i] + 1]
        own = listed[first:last]
        for j in range(len(texels)):
            weight = power[j] * np.float32(bit_of(bits[vertices[i]], texels[j]))
            if len(own):
                e = np.searchsorted(own, texels[j])
                if e < len(own) and own[e] == texels[j]:
                    weight = power[j] * (np.float32(shares[first + e]) / np.float32(FULL))
            if weight == 0:
                for k in range(most):
                    result[i, k, j] = 0
                continue
            u, v, w, h = directions[0, j], directions[1, j], directions[2, j], directions[3, j]
            value[:] = 0
            _add(value, 0, table, terms, frames[i], u, v, w, h, weight)
            for k in range(most):
                result[i, k, j] = value[0, k]


@numba.njit(nogil=True, fastmath=True, cache=True)
def _single(
    start: int,
    end: int,
    seen: SeenTexels,
    points: GlossyPoints,
    texels: NDArray[np.int64],
    directions: Floats,
    power: Floats,
    term: NDArray[np.int64],
    result: Floats,
) -> None:
    """One term (m,) at one texel each, whose directions and spreads are (m, 4)."""
    (bits, starts, listed, shares), (vertices, frames, materials, tables, counts) = seen, points
    value = np.empty((1, tables.shape[3]), np.float32)
    for i in range(start, end):
        table, terms = tables[materials[i]], counts[materials[i]]
        weight = power[i] * np.float32(bit_of(bits[vertices[i]], texels[i]))
        first, last = starts[vertices[i]], starts[vertices[i] + 1]
        e = first + np.searchsorted(listed[first:last], texels[i])
        if e < last and listed[e] == texels[i]:
            weight = power[i] * (np.float32(shares[e]) / np.float32(FULL))
        result[i] = 0
        if weight == 0:
            continue
        value[:] = 0
        u, v, w, h = directions[i, 0], directions[i, 1], directions[i, 2], directions[i, 3]
        _add(value, 0, table, terms, frames[i], u, v, w, h, weight)
        result[i] = value[0, term[i]]


@numba.njit(nogil=True, fastmath=True, cache=True)
def _relit(
    start: int,
    end: int,
    seen: SeenTexels,
    points: GlossyPoints,
    directions: Floats,
    power: Floats,
    result: Floats,
) -> None:
    """Coefficients (n, terms, 3) under lights power (n_directions, 3), solid angles included."""
    (bits, starts, listed, shares), (vertices, frames, materials, tables, counts) = seen, points
    total = np.empty((3, tables.shape[3]), np.float32)
    value = np.empty((1, tables.shape[3]), np.float32)
    for i in range(start, end):
        table, terms = tables[materials[i]], counts[materials[i]]
        total[:] = 0
        for j in range(directions.shape[1]):
            if (bits[vertices[i], j // 32] >> np.uint32(j % 32)) & np.uint32(1) == 0:
                continue
            u, v, w, h = directions[0, j], directions[1, j], directions[2, j], directions[3, j]
            value[:] = 0
            _add(value, 0, table, terms, frames[i], u, v, w, h, np.float32(1))
            for c in range(3):
                for k in range(terms):
                    total[c, k] += value[0, k] * power[j, c]
        for e in range(starts[vertices[i]], starts[vertices[i] + 1]):
            j = listed[e]
            more = np.float32(shares[e]) / np.float32(FULL) - np.float32(bit_of(bits[vertices[i]], j))
            u, v, w, h = directions[0, j], directions[1, j], directions[2, j], directions[3, j]
            value[:] = 0
            _add(value, 0, table, terms, frames[i], u, v, w, h, more)
            for c in range(3):
                for k in range(terms):
                    total[c, k] += value[0, k] * power[j, c]
        for k in range(result.shape[1]):  # not a slice: its error message alone compiles for seconds
            for c in range(len(total)):
                result[i, k, c] = total[c, k]


@numba.njit(nogil=True, fastmath=True, cache=True)
def _combined(
    start: int,
    end: int,
    seen: SeenTexels,
    points: GlossyPoints,
    words: NDArray[np.int64],
    place: NDArray[np.int64],
    directions: Floats,
    power: Floats,
    result: Floats,
) -> None:
    """Sums (n, terms, b) over words of the terms at their bits; directions and spreads (words, 4, b), power
    (words, b).

    ``place`` says where among ``words`` a word is, or -1.
    """
    (bits, starts, listed, shares), (vertices, frames, materials, tables, counts) = seen, points
    width = power.shape[1]
    total = np.empty((width, tables.shape[3]), np.float32)
    for i in range(start, end):
        table, terms = tables[materials[i]], counts[materials[i]]
        total[:] = 0
        for g in range(len(words)):
            mask = bits[vertices[i], words[g]]
            if mask == 0:
                continue
            for b in range(width):
                if (mask >> np.uint32(b)) & np.uint32(1) == 0:
                    continue
                u, v, w, h = (
                    directions[g, 0, b],
                    directions[g, 1, b],
                    directions[g, 2, b],
                    directions[g, 3, b],
                )
                _add(total, b, table, terms, frames[i], u, v, w, h, power[g, b])
        for e in range(starts[vertices[i]], starts[vertices[i] + 1]):
            j = int(listed[e])
            g, b = place[j // width], j % width
            if g < 0:
                continue
            more = np.float32(shares[e]) / np.float32(FULL) - np.float32(bit_of(bits[vertices[i]], j))
            u, v, w, h = directions[g, 0, b], directions[g, 1, b], directions[g, 2, b], directions[g, 3, b]
            _add(total, b, table, terms, frames[i], u, v, w, h, power[g, b] * more)
        for k in range(result.shape[1]):  # not a slice: its error message alone compiles for seconds
            for c in range(len(total)):
                result[i, k, c] = total[c, k]
