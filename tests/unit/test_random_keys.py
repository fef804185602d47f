"""SplitMix64 in its three forms, against each other and against published numbers; keyed streams are unrelated."""

import drjit as dr
import mitsuba as mi
import numba
import numpy as np

from mi_sparse_prt.core.random_keys import (
    GOLDEN_RATIO,
    finalise,
    finalise_compiled,
    hash_rows,
    mix,
    random_generator,
)

WORDS = np.random.default_rng(1).integers(0, 1 << 64, 1000, np.uint64)


def test_published_numbers():
    """The first numbers of the seed 1234567, as in rosettacode.org/wiki/Pseudo-random_numbers/Splitmix64."""
    states = np.uint64(1234567) + np.arange(5, dtype=np.uint64) * np.uint64(GOLDEN_RATIO)
    expected = [
        6457827717110365317,
        3203168211198807973,
        9817491932198370423,
        4593380528125082431,
        16408922859458223821,
    ]
    assert mix(states).tolist() == expected


@numba.njit
def _finalise_all(words):
    result = np.empty_like(words)
    for i in range(len(words)):
        result[i] = finalise_compiled(words[i])
    return result


def test_numpy_numba_and_drjit_agree():
    expected = mix(WORDS - np.uint64(GOLDEN_RATIO))
    assert expected.dtype == np.uint64
    np.testing.assert_array_equal(_finalise_all(WORDS), expected)
    np.testing.assert_array_equal(finalise(mi.UInt64(WORDS)).numpy(), expected)


def test_hashes_of_rows():
    """Equal rows have equal hashes, -0 counts as 0, and order, place and seed of values matter."""
    rows = np.array([[1, 2], [1, 2], [2, 1], [0, 2], [-0.0, 2]], np.float32)
    keys = hash_rows(rows)
    assert keys[0] == keys[1] and keys[3] == keys[4]
    assert len({int(key) for key in (*keys, *hash_rows(rows, 1))}) == 6


def test_random_numbers_of_neighbouring_elements_are_unrelated():
    """First numbers over consecutive keys, texels, samples and seeds: uniform, and without correlation."""
    n = 1 << 14
    zero, count = dr.zeros(mi.UInt32, n), dr.arange(mi.UInt32, n)

    def first(key: mi.UInt64, texel: mi.UInt32, sample: mi.UInt32, seed: int) -> np.ndarray:
        return random_generator(key, texel, sample, seed).next_float32().numpy()

    streams = [
        first(mi.UInt64(count), zero, zero, 0),
        first(dr.zeros(mi.UInt64, n), count, zero, 0),
        first(dr.zeros(mi.UInt64, n), zero, count, 0),
        first(mi.UInt64(count), zero, zero, 1),
        first(mi.UInt64(count), zero + 1, zero, 0),
        first(mi.UInt64(count), zero, zero + 1, 0),
    ]
    for numbers in streams:
        histogram = np.histogram(numbers, 64, (0, 1))[0]
        chi_square = ((histogram - n / 64) ** 2).sum() / (n / 64)  # 63 degrees of freedom
        assert chi_square < 63 + 4 * np.sqrt(2 * 63)
        assert abs(np.corrcoef(numbers[1:], numbers[:-1])[0, 1]) < 4 / np.sqrt(n)
    correlation = np.corrcoef(streams) - np.eye(len(streams))
    assert np.abs(correlation).max() < 4 / np.sqrt(n)
