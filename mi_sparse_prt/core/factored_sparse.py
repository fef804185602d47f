"""A sparse matrix whose rows are sums of what other rows share: kept as a product, never multiplied out."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numba
import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mi_sparse_prt.core.ragged import row_starts
from mi_sparse_prt.core.sparse_arrays import sparse_of_rows
from mi_sparse_prt.core.threads import run_in_parts

Floats = NDArray[np.float32]

SLAB = 512  # columns of light at a time, as in ``sparse_product``
ABREAST = 4  # inner rows that are added up together, so that sums are stored less often


@dataclass(frozen=True)
class FactoredSparse:
    """``left @ right + rest`` (n, m), where the rows of ``left`` come in groups that have their columns in common.

    A ray that leaves a glossy vertex counts in all of its terms, and meets all terms of what it meets: s times as many
    numbers, multiplied out.

    Attributes
    ----------
    rows : (groups, s) int64
        Those of each group, all of them different; -1 where there is none.
    inner : (groups + 1,) int64
        The columns of ``left``, rows of ``right``, of each group.
    weights : (inner rows, s) float32
        The numbers of ``left``.
    right : (inner rows, m) sparse float32
    rest : (n, m) sparse float32
    """

    rows: NDArray[np.int64]
    inner: NDArray[np.int64]
    weights: Floats
    right: scipy.sparse.csr_array
    rest: scipy.sparse.csr_array

    @property
    def shape(self) -> tuple[int, int]:
        found: tuple[int, int] = self.rest.shape
        return found

    @property
    def nnz(self) -> int:
        """Numbers that are kept."""
        return int(self.weights.size + self.right.nnz + self.rest.nnz)

    def __add__(self, other: scipy.sparse.csr_array) -> FactoredSparse:
        return FactoredSparse(self.rows, self.inner, self.weights, self.right, self.rest + other)

    def __getitem__(self, ids: NDArray[np.integer]) -> scipy.sparse.csr_array:
        """Some rows, multiplied out."""
        group, place = self._places[:, ids]
        counts = np.where(group >= 0, np.diff(self.inner, append=0)[group], 0)
        starts = row_starts(counts)
        columns = np.arange(starts[-1]) - np.repeat(starts[:-1] - self.inner[group], counts)
        weights = self.weights[columns, np.repeat(place, counts)]
        left = sparse_of_rows(weights, columns, starts, self.right.shape[0])
        return scipy.sparse.csr_array(self.rest[ids] + left @ self.right)

    def tocsr(self) -> scipy.sparse.csr_array:
        """All of it, multiplied out."""
        return self[np.arange(self.shape[0])]

    @cached_property
    def _places(self) -> NDArray[np.int64]:
        """The group of each row, -1 if it has none, and its place there: (2, n)."""
        found = np.full((2, self.shape[0]), -1)
        group, place = np.nonzero(self.rows >= 0)
        found[:, self.rows[group, place]] = group, place
        return found

    def add_scaled(self, albedo: Floats, light: Floats, result: Floats, row: int) -> None:
        """Add ``left @ right rho x``, without ``rest``, to n rows of a result from ``row`` on: see ``add_scaled``."""
        if not len(self.rows):
            return
        weights = np.diff(self.inner) * np.count_nonzero(self.rows >= 0, axis=1)
        work = row_starts(weights) + self.right.indptr[self.inner]  # of all groups before each
        shares = np.linspace(0, work[-1], numba.get_num_threads() + 1)
        bounds = np.searchsorted(work, shares)
        bounds[0], bounds[-1] = 0, len(self.rows)
        right = self.right.indptr, self.right.indices, self.right.data
        for a in range(0, light.shape[1], SLAB):
            some = np.ascontiguousarray(light[:, a : a + SLAB], np.float32)
            own = bounds, self.rows, self.inner, self.weights
            run_in_parts(_add_products, len(shares) - 1, own, right, albedo, some, result, row, a)


@numba.njit(nogil=True, fastmath={"contract"}, cache=True)
def _add_products(
    first: int,
    last: int,
    left: tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], Floats],
    right: tuple[NDArray[np.int32], NDArray[np.int32], Floats],
    albedo: Floats,
    light: Floats,
    result: Floats,
    row: int,
    column: int,
) -> None:
    """Groups bounds[t] to bounds[t + 1] as the t-th part."""
    bounds, rows, inner, weights = left
    width, most = light.shape[1], rows.shape[1]
    found, total = np.empty((ABREAST, width), np.float32), np.empty((most, width), np.float32)
    for t in range(first, last):
        for h in range(len(albedo)):
            for g in range(bounds[t], bounds[t + 1]):
                size = most
                while size and rows[g, size - 1] < 0:
                    size -= 1
                total[:size] = 0
                for ray in range(inner[g], inner[g + 1], ABREAST):
                    count = min(ABREAST, inner[g + 1] - ray)
                    _add_up(ray, count, right, albedo[h], light, found)
                    for s in range(size):
                        if count == ABREAST:
                            p, q, u, v = (
                                weights[ray, s],
                                weights[ray + 1, s],
                                weights[ray + 2, s],
                                weights[ray + 3, s],
                            )
                            for k in range(width):
                                total[s, k] += (
                                    p * found[0, k] + q * found[1, k] + u * found[2, k] + v * found[3, k]
                                )
                        else:
                            for i in range(count):
                                p = weights[ray + i, s]
                                for k in range(width):
                                    total[s, k] += p * found[i, k]
                for s in range(size):
                    if rows[g, s] >= 0:
                        for k in range(width):
                            result[h, row + rows[g, s], column + k] += total[s, k]


@numba.njit(nogil=True, fastmath={"contract"}, cache=True)
def _add_up(
    first: int,
    count: int,
    right: tuple[NDArray[np.int32], NDArray[np.int32], Floats],
    albedo: Floats,
    light: Floats,
    found: Floats,
) -> None:
    """Some rows of ``right``, one after the other, times rho x; four entries at a time, as ``sparse_product`` does."""
    starts, columns, values = right
    width = light.shape[1]
    for i in range(count):
        found[i] = 0
        e, end = np.int64(starts[first + i]), starts[first + i + 1]
        while e + 4 <= end:
            a, b, c, d = columns[e], columns[e + 1], columns[e + 2], columns[e + 3]
            p, q = values[e] * albedo[a], values[e + 1] * albedo[b]
            u, v = values[e + 2] * albedo[c], values[e + 3] * albedo[d]
            for k in range(width):
                found[i, k] += p * light[a, k] + q * light[b, k] + u * light[c, k] + v * light[d, k]
            e += 4
        while e < end:
            a = columns[e]
            p = values[e] * albedo[a]
            for k in range(width):
                found[i, k] += p * light[a, k]
            e += 1
