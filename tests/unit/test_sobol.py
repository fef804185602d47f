"""Sobol's points against those of SciPy, bit by bit."""

import numpy as np
import pytest
from scipy.stats import qmc

from mi_sparse_prt.core.sobol import sobol_points


@pytest.mark.parametrize("n", [1, 2, 3, 64, 1000, 1 << 16])
def test_the_points_are_scipys(n):
    expected = qmc.Sobol(3, scramble=False, bits=32).random(1 << 16)[:n] * 2.0**32
    points = sobol_points(n)
    assert points.dtype == np.uint32 and points.shape == (n, 3)
    np.testing.assert_array_equal(points, expected.astype(np.uint64))


def test_high_bits_are_scipys():
    """Points far along the sequence, whose index has bits that the first ones lack."""
    expected = qmc.Sobol(3, scramble=False, bits=32).fast_forward(3 << 18).random(8) * 2.0**32
    np.testing.assert_array_equal(sobol_points((3 << 18) + 8)[-8:], expected.astype(np.uint64))
