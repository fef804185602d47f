"""Rays that end at the same texel are added up, row by row, against SciPy's sums of duplicates."""

import numpy as np
import scipy.sparse

from mi_sparse_prt.solvers.specular_chains import _summed


def test_entries_of_equal_columns_are_added_up() -> None:
    """Expected: SciPy's sums within rounding, columns ascending, none twice; of empty rows, and of none, nothing."""
    rng, shape = np.random.default_rng(3), (50, 37)
    counts = rng.integers(0, 200, shape[0]) * rng.integers(0, 2, shape[0])
    starts = np.concatenate([[0], np.cumsum(counts)])
    columns = rng.integers(0, shape[1], starts[-1]).astype(np.uint32)
    values = rng.exponential(size=(3, starts[-1])).astype(np.float32)
    rows = np.repeat(np.arange(shape[0]), counts)
    for found, own in zip(_summed(starts, columns, values, shape), values, strict=True):
        expected = scipy.sparse.coo_array((own.astype(np.float64), (rows, columns)), shape=shape).toarray()
        np.testing.assert_allclose(found.toarray(), expected, rtol=1e-6)
        assert found.has_canonical_format and found.nnz == np.count_nonzero(expected)
    none = np.zeros(0, np.uint32), np.zeros((3, 0), np.float32)
    assert all(found.nnz == 0 for found in _summed(np.zeros(5, np.int64), *none, (4, 3)))
