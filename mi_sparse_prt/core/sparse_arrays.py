"""Sparse matrices as three arrays, for files."""

from __future__ import annotations

from typing import Any

import scipy.sparse
from numpy.typing import NDArray


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
