"""A sparse matrix times a dense one on all threads: what moves light between vertices."""

from __future__ import annotations

from typing import TypeAlias

import numba
import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mi_sparse_prt.core.factored_sparse import FactoredSparse
from mi_sparse_prt.core.threads import run_in_parts

Floats = NDArray[np.float32]
Sparse: TypeAlias = "scipy.sparse.csr_array | FactoredSparse"

SLAB = 512  # columns of light at a time: more of it stays in the cache


def multiply_sparse(matrix: Sparse, dense: Floats) -> Floats:
    """A sparse matrix (n, m) times a dense one (m, k), float32; the same for any number of threads."""
    return multiply_scaled(matrix, np.ones((1, matrix.shape[1]), np.float32), dense)[0]


def multiply_scaled(matrix: Sparse, albedo: Floats, light: Floats) -> Floats:
    """G rho x for several albedos rho and one light x, of which each row is read once for all of them.

    Parameters
    ----------
    matrix : (n, m) sparse float32, or kept as a product
        G.
    albedo : (channels, m) float32
        The diagonals of rho.
    light : (m, k) float32
        x.

    Returns
    -------
    (channels, n, k) float32
        The same for any number of threads.
    """
    result = np.empty((len(albedo), matrix.shape[0], light.shape[1]), np.float32)
    _multiply_into(matrix, albedo, light, result, 0, False)
    return result


def add_scaled(matrix: Sparse, albedo: Floats, light: Floats, result: Floats, row: int) -> None:
    """Add what ``multiply_scaled`` returns to n rows of a result (channels, ..., at least k), from ``row`` on."""
    _multiply_into(matrix, albedo, light, result, row, True)


def _multiply_into(
    matrix: Sparse, albedo: Floats, light: Floats, result: Floats, row: int, add: bool
) -> None:
    if isinstance(matrix, FactoredSparse):
        _multiply_into(matrix.rest, albedo, light, result, row, add)
        matrix.add_scaled(albedo, light, result, row)
        return
    if light.shape[1] < 8:  # columns that are not worth a second thread
        part = result[:, row : row + matrix.shape[0], : light.shape[1]]
        found = np.stack([matrix @ (rho[:, None] * light) for rho in albedo])
        part[:] = part + found if add else found
        return
    shares = np.linspace(0, matrix.nnz, numba.get_num_threads() + 1)
    bounds = np.searchsorted(matrix.indptr, shares)  # equal numbers of entries, not of rows
    bounds[0], bounds[-1] = 0, matrix.shape[0]
    for a in range(0, light.shape[1], SLAB):
        some = np.ascontiguousarray(light[:, a : a + SLAB], np.float32)
        arrays = bounds, matrix.indptr, matrix.indices, matrix.data, albedo, some, result
        run_in_parts(_multiply, len(shares) - 1, *arrays, row, a, add)


@numba.njit(nogil=True, fastmath={"contract"}, cache=True)
def _multiply(
    first: int,
    last: int,
    bounds: NDArray[np.int64],
    starts: NDArray[np.int32],
    columns: NDArray[np.int32],
    values: Floats,
    albedo: Floats,
    light: Floats,
    result: Floats,
    row: int,
    column: int,
    add: bool,
) -> None:
    """Rows bounds[t] to bounds[t + 1] as the t-th part; four entries at a time, so that sums are stored less often.

    Into rows and columns of the result from ``row`` and ``column`` on, which is whole: slices are contiguous or not,
    and compiled twice.
    """
    width = light.shape[1]
    total = np.empty((len(albedo), width), np.float32)
    for t in range(first, last):
        for i in range(bounds[t], bounds[t + 1]):
            total[:] = 0
            end = starts[i + 1]
            e = np.int64(starts[i])
            while e + 4 <= end:
                a, b, c, d = columns[e], columns[e + 1], columns[e + 2], columns[e + 3]
                for h in range(len(albedo)):
                    p, q = values[e] * albedo[h, a], values[e + 1] * albedo[h, b]
                    r, s = values[e + 2] * albedo[h, c], values[e + 3] * albedo[h, d]
                    for k in range(width):
                        total[h, k] += p * light[a, k] + q * light[b, k] + r * light[c, k] + s * light[d, k]
                e += 4
            while e < end:
                a = columns[e]
                for h in range(len(albedo)):
                    p = values[e] * albedo[h, a]
                    for k in range(width):
                        total[h, k] += p * light[a, k]
                e += 1
            for h in range(len(albedo)):  # not a slice: its error message alone compiles for seconds
                for k in range(width):
                    before = result[h, row + i, column + k] if add else np.float32(0)
                    result[h, row + i, column + k] = before + total[h, k]
