"""The largest of many numbers, by a heap of those found so far: for compiled functions, in which NumPy's takes seconds
to compile.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

Numbers = NDArray[np.floating]
Ints = NDArray[np.int64]


@numba.njit(cache=True)
def keep_largest(values: Numbers, count: int, sizes: Numbers, places: Ints) -> int:
    """Write up to so many of the largest values that are not 0, descending, and their places; how many."""
    length = 0
    if count == 0:
        return 0
    for j in range(len(values)):
        value = values[j]
        if value <= 0 or (length == count and value <= sizes[0]):
            continue
        if length < count:  # a heap: the least is at its root
            k, length = length, length + 1
            while k > 0 and sizes[(k - 1) // 2] > value:
                sizes[k], places[k] = sizes[(k - 1) // 2], places[(k - 1) // 2]
                k = (k - 1) // 2
        else:
            k = _sink(sizes, places, value, length)
        sizes[k], places[k] = value, j
    for end in range(length - 1, 0, -1):  # the least goes to the end, and so on
        value, place = sizes[end], places[end]
        sizes[end], places[end] = sizes[0], places[0]
        k = _sink(sizes, places, value, end)
        sizes[k], places[k] = value, place
    return length


@numba.njit(cache=True)
def _sink(sizes: Numbers, places: Ints, value: np.floating, length: int) -> int:
    """Where a value goes in a heap whose root is free."""
    k = 0
    while True:
        child = 2 * k + 1
        if child >= length:
            return k
        if child + 1 < length and sizes[child + 1] < sizes[child]:
            child += 1
        if sizes[child] >= value:
            return k
        sizes[k], places[k] = sizes[child], places[child]
        k = child
