"""Rows of unequal lengths against lists of lists."""

import numpy as np
import pytest

from mi_sparse_prt.core.ragged import concatenate_ranges, row_starts, select_rows

LENGTHS = [3, 0, 1, 0, 0, 4]


def test_starts():
    assert row_starts(np.array(LENGTHS)).tolist() == [0, 3, 3, 4, 4, 4, 8]
    assert row_starts(np.zeros(0, np.int64)).tolist() == [0]


@pytest.mark.parametrize("ids", [[], [1], [5, 0, 1, 0], [0, 1, 2, 3, 4, 5]])
@pytest.mark.parametrize("kind", [np.int32, np.int64, np.uint32])
def test_selected_rows_are_those_of_lists(ids, kind):
    starts = row_starts(np.array(LENGTHS)).astype(np.int32)
    rows = [list(range(a, b)) for a, b in zip(starts, starts[1:], strict=False)]
    found, owner, entries = select_rows(starts, np.array(ids, kind))
    assert entries.tolist() == [entry for i in ids for entry in rows[i]]
    assert owner.tolist() == [place for place, i in enumerate(ids) for _ in rows[i]]
    assert found.tolist() == row_starts(np.array([len(rows[i]) for i in ids], np.int64)).tolist()


def test_ranges():
    owner, member = concatenate_ranges(np.array([7, -2, 5]), np.array([2, 3, 0]))
    assert owner.tolist() == [0, 0, 1, 1, 1]
    assert member.tolist() == [7, 8, -2, -1, 0]
