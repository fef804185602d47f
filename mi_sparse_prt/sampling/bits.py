"""Rows of yes-or-no answers, one bit per direction: bit j % 32 of word j // 32, as ``DirectTransport`` packs them."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

Bits = NDArray[np.uint32]


@numba.njit(parallel=True, cache=True)
def above_horizon(normals: NDArray[np.float32], directions: NDArray[np.float32]) -> Bits:
    """Bits (n, ceil(n_directions / 32)) of directions (n_directions, 3) with a positive cosine to normals (n, 3)."""
    words = -(-len(directions) // 32)
    bits = np.zeros((len(normals), words), np.uint32)
    for i in numba.prange(len(normals)):
        for j in range(len(directions)):
            cosine = np.float32(0)
            for axis in range(3):
                cosine += normals[i, axis] * directions[j, axis]
            if cosine > 0:
                bits[i, j >> 5] |= np.uint32(1) << np.uint32(j & 31)
    return bits


def pack(mask: NDArray[np.bool_]) -> Bits:
    """Bits (..., ceil(n / 32)) of a mask (..., n)."""
    padding = -mask.shape[-1] % 32
    padded = np.concatenate([mask, np.zeros((*mask.shape[:-1], padding), bool)], axis=-1)
    return np.packbits(padded, axis=-1, bitorder="little").view(np.uint32)


def unpack(bits: Bits, n: int) -> NDArray[np.bool_]:
    """Mask (..., n) of bits (..., ceil(n / 32))."""
    flat = np.unpackbits(np.ascontiguousarray(bits).view(np.uint8), axis=-1, bitorder="little")
    return flat[..., :n].astype(bool)


@numba.njit(parallel=True, cache=True)
def counts(bits: Bits) -> NDArray[np.int64]:
    """Number of set bits in each row, (n,)."""
    result = np.zeros(len(bits), np.int64)
    for i in numba.prange(len(bits)):
        for w in range(bits.shape[1]):
            result[i] += _population(bits[i, w])
    return result


@numba.njit(cache=True)
def _population(word: np.uint32) -> np.int64:
    """Set bits of a word (a sum over ever wider fields, Warren 2002)."""
    x = np.uint64(word)
    x = x - ((x >> np.uint64(1)) & np.uint64(0x55555555))
    x = (x & np.uint64(0x33333333)) + ((x >> np.uint64(2)) & np.uint64(0x33333333))
    x = (x + (x >> np.uint64(4))) & np.uint64(0x0F0F0F0F)
    return np.int64(((x * np.uint64(0x01010101)) & np.uint64(0xFFFFFFFF)) >> np.uint64(24))


def listed(bits: Bits) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
    """Row and direction of every set bit, row after row: two (m,) arrays."""
    starts = np.concatenate([[0], np.cumsum(counts(bits))])
    return _fill(bits, starts)


@numba.njit(parallel=True, cache=True)
def _fill(bits: Bits, starts: NDArray[np.int64]) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
    rows = np.empty(starts[-1], np.uint32)
    directions = np.empty(starts[-1], np.uint32)
    for i in numba.prange(len(bits)):
        at = starts[i]
        for w in range(bits.shape[1]):
            word = bits[i, w]
            for k in range(32):
                if (word >> np.uint32(k)) & np.uint32(1):
                    rows[at] = i
                    directions[at] = w * 32 + k
                    at += 1
    return rows, directions


def scattered(mask: Bits, values: NDArray[np.bool_]) -> Bits:
    """The inverse of ``listed``: those bits of ``mask`` whose listed value is true, (n, words)."""
    starts = np.concatenate([[0], np.cumsum(counts(mask))])
    return _scatter(mask, starts, values)


@numba.njit(parallel=True, cache=True)
def _scatter(mask: Bits, starts: NDArray[np.int64], values: NDArray[np.bool_]) -> Bits:
    result = np.zeros(mask.shape, np.uint32)
    for i in numba.prange(len(mask)):
        at = starts[i]
        for w in range(mask.shape[1]):
            word = mask[i, w]
            for k in range(32):
                if (word >> np.uint32(k)) & np.uint32(1):
                    if values[at]:
                        result[i, w] |= np.uint32(1) << np.uint32(k)
                    at += 1
    return result
