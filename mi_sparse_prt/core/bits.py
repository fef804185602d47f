"""Rows of yes-or-no answers, one bit per direction: bit j % 32 of word j // 32, as ``DirectSolver`` packs them.

What compiled functions fill is made by NumPy: it asks the system for huge pages, and numba does not. Half the time of
``list_bits`` went into page faults.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba.extending import intrinsic
from numpy.typing import NDArray

from mi_sparse_prt.core.ragged import row_starts
from mi_sparse_prt.core.threads import run_in_parts

Bits = NDArray[np.uint32]
BITS = 32  # of a word


def above_horizon(normals: NDArray[np.float32], directions: NDArray[np.float32]) -> Bits:
    """Bits (n, ceil(n_directions / 32)) of directions (n_directions, 3) with a positive cosine to normals (n, 3)."""
    words = -(-len(directions) // BITS)
    padded = np.zeros((3, words * BITS), np.float32)  # a direction of zeros is above no horizon
    padded[:, : len(directions)] = np.asarray(directions).T
    bits = np.empty((len(normals), words), np.uint32)
    normals = np.ascontiguousarray(normals, np.float32)
    run_in_parts(_mark_above, len(bits), normals, padded.reshape(3, words, BITS), bits)
    return bits


@numba.njit(nogil=True, cache=True)
def _mark_above(
    first: int, last: int, normals: NDArray[np.float32], directions: NDArray[np.float32], bits: Bits
) -> None:
    """Of directions (3, words, 32); without branches, so that a word takes a few vector instructions."""
    x, y, z = directions[0], directions[1], directions[2]
    for i in range(first, last):
        nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
        for w in range(bits.shape[1]):
            word = np.uint32(0)
            for k in range(BITS):
                cosine = nx * x[w, k] + ny * y[w, k] + nz * z[w, k]
                word |= np.uint32(cosine > 0) << np.uint32(k)
            bits[i, w] = word


def pack(mask: NDArray[np.bool_]) -> Bits:
    """Bits (..., ceil(n / 32)) of a mask (..., n)."""
    padding = -mask.shape[-1] % 32
    padded = np.concatenate([mask, np.zeros((*mask.shape[:-1], padding), bool)], axis=-1)
    return np.packbits(padded, axis=-1, bitorder="little").view(np.uint32)


def bits_at(bits: Bits, rows: NDArray[np.integer], directions: NDArray[np.integer]) -> NDArray[np.uint32]:
    """One bit each, 0 or 1, (m,): direction of row."""
    return (bits[rows, directions // BITS] >> (directions % BITS).astype(np.uint32)) & 1


def unpack(bits: Bits, n: int) -> NDArray[np.bool_]:
    """Mask (..., n) of bits (..., ceil(n / 32))."""
    flat = np.unpackbits(np.ascontiguousarray(bits).view(np.uint8), axis=-1, bitorder="little")
    return flat[..., :n].astype(bool)


@intrinsic
def count_ones(typingctx: Any, word: Any) -> Any:
    """Bits set in a word: LLVM's own instruction, which vectorises."""
    return word(word), lambda context, builder, signature, arguments: builder.ctpop(arguments[0])


@intrinsic
def lowest_bit(typingctx: Any, word: Any) -> Any:
    """Place of the lowest bit set in a word that is not 0."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.cttz(arguments[0], ir.Constant(ir.IntType(1), 1))

    return word(word), generate


@numba.njit
def bit_of(words: Bits, direction: int) -> np.uint32:
    """One bit of a row, 0 or 1."""
    return (words[direction // BITS] >> np.uint32(direction % BITS)) & np.uint32(1)


def count_bits(bits: Bits) -> NDArray[np.int64]:
    """Number of set bits in each row, (n,)."""
    result = np.empty(len(bits), np.int64)
    run_in_parts(_count, len(bits), bits, result)
    return result


@numba.njit(nogil=True, cache=True)
def _count(first: int, last: int, bits: Bits, result: NDArray[np.int64]) -> None:
    for i in range(first, last):
        total = np.uint32(0)
        for w in range(bits.shape[1]):
            total += count_ones(bits[i, w])  # type: ignore[call-arg]  # numba gives the context
        result[i] = total


def list_bits(bits: Bits) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
    """Row and direction of every set bit, row after row: two (m,) arrays."""
    starts = _starts(bits)
    rows, directions = np.empty(starts[-1], np.uint32), np.empty(starts[-1], np.uint32)
    run_in_parts(_fill, len(bits), bits, starts, rows, directions)
    return rows, directions


def scatter_bits(mask: Bits, values: NDArray[np.bool_]) -> Bits:
    """The inverse of ``list_bits``: those bits of ``mask`` whose listed value is true, (n, words)."""
    result = np.empty_like(mask)
    run_in_parts(_scatter, len(mask), mask, _starts(mask), values, result)
    return result


def _starts(bits: Bits) -> NDArray[np.int64]:
    """Where the set bits of each row start in a list of all, and its length, (n + 1,)."""
    return row_starts(count_bits(bits))


@numba.njit(nogil=True, cache=True)
def _fill(
    first: int,
    last: int,
    bits: Bits,
    starts: NDArray[np.int64],
    rows: NDArray[np.uint32],
    directions: NDArray[np.uint32],
) -> None:
    for i in range(first, last):
        at = starts[i]
        for k in range(at, starts[i + 1]):  # not a slice, which compiles for seconds
            rows[k] = i
        for w in range(bits.shape[1]):
            left = bits[i, w]
            while left:
                directions[at] = np.uint32(w * BITS) + lowest_bit(left)  # type: ignore[call-arg]
                at += 1
                left &= left - np.uint32(1)


@numba.njit(nogil=True, cache=True)
def _scatter(
    first: int,
    last: int,
    mask: Bits,
    starts: NDArray[np.int64],
    values: NDArray[np.bool_],
    result: Bits,
) -> None:
    for i in range(first, last):
        at = starts[i]
        for w in range(mask.shape[1]):
            left, word = mask[i, w], np.uint32(0)
            while left:
                word |= np.uint32(values[at]) << lowest_bit(left)  # type: ignore[call-arg]
                at += 1
                left &= left - np.uint32(1)
            result[i, w] = word


def overwrite_bits(
    bits: Bits, known: Bits, rows: NDArray[np.int64], mask: Bits, values: NDArray[np.bool_]
) -> NDArray[np.int64]:
    """Put listed values into some rows, in place.

    Parameters
    ----------
    bits, known : (m, words) uint32 bits
        Changed at ``rows``: they take the values, and know them from now on.
    rows : (n,) int
    mask : (n, words) uint32 bits
        Which bits of these rows.
    values : (k,) bool
        In the order of ``list_bits(mask)``.

    Returns
    -------
    (n,) int64
        How many bits of each row were otherwise before.
    """
    changed = np.zeros(len(rows), np.int64)
    run_in_parts(_overwrite, len(rows), bits, known, rows, mask, _starts(mask), values, changed)
    return changed


@numba.njit(nogil=True, cache=True)
def _overwrite(
    first: int,
    last: int,
    bits: Bits,
    known: Bits,
    rows: NDArray[np.int64],
    mask: Bits,
    starts: NDArray[np.int64],
    values: NDArray[np.bool_],
    changed: NDArray[np.int64],
) -> None:
    for i in range(first, last):
        at, row = starts[i], rows[i]
        for w in range(mask.shape[1]):
            left, word = mask[i, w], np.uint32(0)
            if not left:
                continue
            while left:
                word |= np.uint32(values[at]) << lowest_bit(left)  # type: ignore[call-arg]
                at += 1
                left &= left - np.uint32(1)
            before = bits[row, w] & mask[i, w]
            changed[i] += count_ones(before ^ word)  # type: ignore[call-arg]
            bits[row, w] ^= before ^ word
            known[row, w] |= mask[i, w]
