"""Half floats as floats, by a table and all cores: NumPy takes seven times as long."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.read_only import read_only

with np.errstate(invalid="ignore"):  # some are no numbers, of the kind that signals
    FLOATS = np.arange(1 << 16, dtype=np.uint16).view(np.float16).astype(np.float32)  # by their 16 bits
FEW = 1 << 16  # numbers that NumPy has done before threads are awake


def as_floats(values: NDArray[Any]) -> NDArray[np.float32]:
    """Numbers of any kind and shape as float32."""
    if values.dtype != np.float16 or values.size < FEW or not values.flags.c_contiguous:
        return values.astype(np.float32)
    result = np.empty(values.shape, np.float32)
    _look_up(read_only(values.reshape(-1).view(np.uint16)), FLOATS, result.reshape(-1))
    return result


@numba.njit(parallel=True, cache=True)
def _look_up(bits: NDArray[np.uint16], floats: NDArray[np.float32], result: NDArray[np.float32]) -> None:
    for k in numba.prange(len(bits)):
        result[k] = floats[bits[k]]
