"""Sparse matrices of three arrays, and as three arrays for files."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse
from numpy.typing import NDArray


def sparse_of_rows(
    values: NDArray[Any], columns: NDArray[np.integer], starts: NDArray[np.integer], width: int
) -> scipy.sparse.csr_array:
    """A matrix of as many columns, row i at ``starts[i]`` to ``starts[i + 1]`` of its entries.

    In 32 bits where these are enough: starts of 64 bits would copy all columns into as many, and products with such
    are compiled once more.
    """
    if max(int(starts[-1]), width) < 1 << 31:
        columns, starts = (ids.astype(np.int32, copy=False) for ids in (columns, starts))
    return scipy.sparse.csr_array((values, columns, starts), shape=(len(starts) - 1, width))


def sparse_to_arrays(name: str, matrix: scipy.sparse.csr_array) -> dict[str, NDArray[Any]]:
    """``name_data``, ``name_indices`` and ``name_indptr``; the number of columns is known from elsewhere."""
    return {f"{name}_{part}": getattr(matrix, part) for part in ("data", "indices", "indptr")}


def sparse_from_arrays(name: str, arrays: dict[str, Any], columns: int) -> scipy.sparse.csr_array:
    """The matrix; products do not look whether an index is out of range, so this does (ValueError)."""
    data, indices, indptr = (arrays[f"{name}_{part}"] for part in ("data", "indices", "indptr"))
    matrix = scipy.sparse.csr_array((data, indices, indptr), shape=(len(indptr) - 1, columns))
    matrix.check_format(full_check=True)
    return matrix


def sparse_nbytes(matrix: scipy.sparse.csr_array) -> int:
    """Bytes of the three arrays."""
    return int(matrix.data.nbytes + matrix.indices.nbytes + matrix.indptr.nbytes)
