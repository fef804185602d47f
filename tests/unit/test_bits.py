"""Rows of bits against NumPy's masks of bools."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import mi_sparse_prt as prt
from mi_sparse_prt.core.bits import (
    above_horizon,
    count_bits,
    list_bits,
    overwrite_bits,
    pack,
    scatter_bits,
    unpack,
)

MASKS = st.tuples(st.integers(0, 5), st.integers(0, 100)).flatmap(lambda shape: arrays(bool, shape))


def unit(n: int, seed: int = 0) -> np.ndarray:
    x = np.random.default_rng(seed).normal(size=(n, 3))
    return (x / np.linalg.norm(x, axis=1, keepdims=True)).astype(np.float32)


@given(MASKS)
@settings(deadline=None)
def test_pack_puts_direction_j_into_bit_j_mod_32_of_word_j_div_32(mask):
    bits = pack(mask)
    n, m = mask.shape
    assert bits.dtype == np.uint32
    assert bits.shape == (n, -(-m // 32))
    for i in range(n):
        for j in range(32 * bits.shape[1]):
            bit = (int(bits[i, j // 32]) >> (j % 32)) & 1
            assert bit == (j < m and mask[i, j])  # the padding is zero


@given(MASKS)
@settings(deadline=None)
def test_unpack_undoes_pack(mask):
    back = unpack(pack(mask), mask.shape[1])
    assert back.dtype == bool
    assert np.array_equal(back, mask)


@pytest.mark.parametrize("shape", [(40,), (2, 3, 70)])
def test_any_leading_axes(shape):
    mask = np.random.default_rng(0).random(shape) < 0.5
    assert np.array_equal(unpack(pack(mask), shape[-1]), mask)


def test_unpack_reads_strided_rows():
    bits = np.random.default_rng(1).integers(0, 1 << 32, (6, 4), dtype=np.uint32)
    whole = unpack(bits, 128)
    assert np.array_equal(unpack(bits[::2], 128), whole[::2])
    assert np.array_equal(unpack(bits[:, 1:3], 64), whole[:, 32:96])


@given(arrays(np.uint32, st.tuples(st.integers(0, 4), st.integers(0, 4))))
@settings(deadline=None)
def test_counts(bits):
    expected = [sum(bin(word).count("1") for word in row) for row in bits.tolist()]
    assert count_bits(bits).tolist() == expected


def test_counts_of_every_kind_of_word():
    """Each bit alone, all but each bit, none, all: a wrong mask of the field sums would show."""
    single = np.uint32(1) << np.arange(32, dtype=np.uint32)
    words = np.concatenate([single, ~single, np.uint32([0, 0xFFFFFFFF])])[:, None]
    assert count_bits(words).tolist() == [1] * 32 + [31] * 32 + [0, 32]


@given(MASKS)
@settings(deadline=None)
def test_listed_is_nonzero(mask):
    rows, directions = list_bits(pack(mask))
    expected = np.nonzero(mask)
    assert np.array_equal(rows, expected[0])
    assert np.array_equal(directions, expected[1])


@given(MASKS, st.integers(0, 1000))
@settings(deadline=None)
def test_scattered_is_the_inverse_of_listed(mask, seed):
    """Any values of the listed bits come back at their places, and nothing elsewhere."""
    values = np.random.default_rng(seed).random(mask.sum()) < 0.5
    expected = np.zeros_like(mask)
    expected[mask] = values
    assert np.array_equal(unpack(scatter_bits(pack(mask), values), mask.shape[1]), expected)


def test_scattered_keeps_to_the_mask():
    bits = np.random.default_rng(2).integers(0, 1 << 32, (50, 7), dtype=np.uint32)
    m = count_bits(bits).sum()
    assert np.array_equal(scatter_bits(bits, np.ones(m, bool)), bits)
    assert not scatter_bits(bits, np.zeros(m, bool)).any()


@pytest.mark.parametrize("n", [1, 2, 4, 8])
def test_above_horizon(n):
    """6, 24, 96 and 384 directions: the first two leave part of a word unused. Normals meet no direction at 90 degrees
    but for rounding, where either answer will do.
    """
    directions = prt.CubemapLighting(n).directions
    normals = unit(200)
    bits = above_horizon(normals, directions)
    assert bits.shape == (200, -(-len(directions) // 32))
    cosine = normals.astype(np.float64) @ directions.T.astype(np.float64)
    sure = np.abs(cosine) > 1e-6
    assert sure.mean() > 0.99
    above = unpack(bits, len(directions))
    assert np.array_equal(above[sure], (cosine > 0)[sure])
    assert np.array_equal(pack(above), bits)  # nothing in the padding


def test_a_direction_in_the_horizon_is_not_above():
    up = np.float32([[0, 1, 0]])
    around = np.float32([[1, 0, 0], [0, 0, 1], [0, 1, 0], [0, -1, 0], [0, 1e-20, 1]])
    assert unpack(above_horizon(up, around), 5)[0].tolist() == [False, False, True, False, True]


def test_no_rows():
    empty = np.zeros((0, 3), np.uint32)
    assert count_bits(empty).shape == (0,)
    assert [len(x) for x in list_bits(empty)] == [0, 0]
    assert scatter_bits(empty, np.zeros(0, bool)).shape == (0, 3)
    assert above_horizon(np.zeros((0, 3), np.float32), unit(40)).shape == (0, 2)


@pytest.mark.parametrize("n", [1, 31, 32, 100])
def test_overwrite(n):
    """Masked bits of some rows take the listed values and are known; nothing else changes; changes are counted."""
    rng = np.random.default_rng(n)
    bits, known, rows = rng.random((7, n)) < 0.5, rng.random((7, n)) < 0.5, np.array([5, 0, 3])
    mask = rng.random((3, n)) < 0.4
    values = rng.random(int(mask.sum())) < 0.5
    expected, after, expected_known = bits.copy(), np.zeros((3, n), bool), known.copy()
    after[mask] = values
    expected[rows] = np.where(mask, after, bits[rows])
    expected_known[rows] |= mask
    packed, packed_known = pack(bits), pack(known)
    changed = overwrite_bits(packed, packed_known, rows, pack(mask), values)
    assert np.array_equal(unpack(packed, n), expected)
    assert np.array_equal(unpack(packed_known, n), expected_known)
    assert changed.tolist() == ((after != bits[rows]) & mask).sum(axis=1).tolist()
