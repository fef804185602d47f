"""Half floats by a table are those of NumPy, all of them."""

import numpy as np
from numpy.testing import assert_array_equal

from mi_sparse_prt.core.halves import FEW, as_floats


def test_every_half_float():
    halves = np.arange(1 << 16, dtype=np.uint16).view(np.float16)
    many = np.tile(halves, 2 * FEW // len(halves)).reshape(2, -1)
    with np.errstate(invalid="ignore"):  # NaN is among them
        expected = many.astype(np.float32)
    assert_array_equal(as_floats(many), expected)


def test_other_numbers_are_converted_as_well():
    many = np.linspace(-3, 3, 4 * FEW).astype(np.float16).reshape(2, -1)
    for other in (many.T, many[:, ::2], many[0, :7], many.astype(np.float64), np.arange(5, dtype=np.uint16)):
        found = as_floats(other)
        assert found.dtype == np.float32
        assert_array_equal(found, other.astype(np.float32))
