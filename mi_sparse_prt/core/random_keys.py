"""Random numbers keyed by what they are for, not by when they are drawn: SplitMix64 (Steele, Lea and Flood 2014).

Vertices and triangles have 64-bit keys, hashes of what they are, and the random numbers of an element of the matrix
follow from its vertex's key, its texel and a seed. Neither the order nor the blocks in which elements are evaluated
matter. One text of the generator's finaliser serves NumPy, numba and Dr.Jit.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numba
import numpy as np
from numpy.typing import NDArray

GOLDEN_RATIO = 0x9E3779B97F4A7C15  # 2^64 / golden ratio, odd: the step from state to state


def random_stream(seed: int | np.random.SeedSequence, *key: int) -> np.random.SeedSequence:
    """Random numbers of one phase of a run, of whichever other phases there are and in whatever order.

    Parameters
    ----------
    seed : int or SeedSequence
        Of the run, or of a phase that has phases of its own.
    key : integers
        The spawn key of the phase.
    """
    if isinstance(seed, np.random.SeedSequence):
        return np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, *key))
    return np.random.SeedSequence(seed, spawn_key=key)


def element_seeds(stream: np.random.SeedSequence, count: int) -> list[int]:
    """Seeds of ``random_generator``: independent estimates of the same elements."""
    return [int(seed) for seed in random_stream(stream, 0).generate_state(count, np.uint64)]


def finalise(x: Any) -> Any:
    """SplitMix64's finaliser: a bijection of 64-bit words, NumPy's or Dr.Jit's, all bits scattered."""
    x = (x ^ (x >> 30)) * 0xBF58476D1CE4E5B9
    x = (x ^ (x >> 27)) * 0x94D049BB133111EB
    return x ^ (x >> 31)


#: `finalise` for functions that numba compiles, of a ``numpy.uint64``.
finalise_compiled = numba.njit(finalise)


def mix(x: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """SplitMix64's number for each state: a bijection of 64-bit words, all bits scattered."""
    with np.errstate(over="ignore"):
        mixed: NDArray[np.uint64] = finalise(x + np.uint64(GOLDEN_RATIO))
    return mixed


def hash_rows(values: NDArray[np.float32], seed: NDArray[np.uint64] | int = 0) -> NDArray[np.uint64]:
    """(n,) hash of the bits of each row of (n, k) float32; -0 counts as 0."""
    bits = (np.ascontiguousarray(values, np.float32) + np.float32(0)).view(np.uint32)  # [row, column]
    state = np.zeros(len(bits), np.uint64) + np.asarray(seed, np.uint64)
    for column in bits.T:
        state = mix(state ^ column)
    return state


def random_generator(key: mi.UInt64, texel: mi.UInt32, sample: mi.UInt32, seed: int) -> mi.PCG32:
    """Independent random numbers on the device for one sample of one element, whatever its lane or block."""
    salt = dr.opaque(mi.UInt64, seed * GOLDEN_RATIO % (1 << 64))
    state = finalise(finalise(key + salt) + ((mi.UInt64(texel) << 32) | mi.UInt64(sample)))
    return mi.PCG32(initstate=state, initseq=mi.UInt64(texel))
