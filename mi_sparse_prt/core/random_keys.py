"""Names for vertices and triangles that do not depend on the order they come in: 64-bit hashes of what they are."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def mix(x: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """SplitMix64's finaliser (Steele, Lea and Flood 2014): a bijection of 64-bit words, all bits scattered."""
    with np.errstate(over="ignore"):
        x = x + np.uint64(0x9E3779B97F4A7C15)
        x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        return x ^ (x >> np.uint64(31))


def hash_rows(values: NDArray[np.float32], seed: NDArray[np.uint64] | int = 0) -> NDArray[np.uint64]:
    """(n,) hash of the bits of each row of (n, k) float32; -0 counts as 0."""
    bits = (np.ascontiguousarray(values, np.float32) + np.float32(0)).view(np.uint32)  # [row, column]
    state = np.zeros(len(bits), np.uint64) + np.asarray(seed, np.uint64)
    for column in bits.T:
        state = mix(state ^ column)
    return state
