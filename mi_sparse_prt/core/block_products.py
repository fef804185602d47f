"""Products with matrices that are converted or expanded a block of rows at a time."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.threads import run_overlapped

Floats = NDArray[np.float32]


def multiply_converted(matrix: NDArray[Any], vectors: Floats) -> Floats:
    """``matrix @ vectors``; the matrix (n, m) holds small numbers, converted to float32 on the way."""
    product = np.empty((len(matrix), vectors.shape[1]), dtype=np.float32)
    block = 2048  # rows at a time
    for a in range(0, len(matrix), block):
        product[a : a + block] = matrix[a : a + block].astype(np.float32) @ vectors
    return product


def multiply_rows(
    rows: Callable[[NDArray[np.int64]], Floats], count: int, vectors: Floats, block: int = 256
) -> Floats:
    """Products (count, k, 1) of rows (n, m, 1), made from their numbers (n,), with vectors (m, k).

    As many rows as a ``block`` has are made at a time, of which some stay in the cache.
    """
    product = np.empty((count, vectors.shape[1], 1), np.float32)

    def multiply(some: slice, made: Floats) -> None:
        product[some, :, 0] = made[..., 0] @ vectors

    blocks = [slice(a, min(a + block, count)) for a in range(0, count, block)]
    for _ in run_overlapped(
        partial(multiply, some, rows(np.arange(some.start, some.stop))) for some in blocks
    ):
        pass
    return product
