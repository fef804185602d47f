"""Random numbers of a sample on the device, whatever its lane, block or order."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def random_generator(key: mi.UInt64, texel: mi.UInt32, sample: mi.UInt32, seed: int) -> mi.PCG32:
    """Independent random numbers for one sample of one element, whatever its lane, block or vertex order."""
    salt = dr.opaque(mi.UInt64, seed * 0x9E3779B97F4A7C15 % (1 << 64))
    state = _mix(_mix(key + salt) + ((mi.UInt64(texel) << 32) | mi.UInt64(sample)))
    return mi.PCG32(initstate=state, initseq=mi.UInt64(texel))


def _mix(x: mi.UInt64) -> mi.UInt64:
    """Scramble 64 bits (the finaliser of SplitMix64, Steele et al. 2014)."""
    x = (x ^ (x >> 30)) * 0xBF58476D1CE4E5B9
    x = (x ^ (x >> 27)) * 0x94D049BB133111EB
    return x ^ (x >> 31)
