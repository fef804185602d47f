"""Rows of an interrupted run are right or not read: whatever happened to the file, and whoever wrote to it."""

from pathlib import Path

import numpy as np
import pytest

import mi_sparse_prt as prt
from mi_sparse_prt.io.checkpoint import Checkpoint

ROWS = np.random.default_rng(4).random((12, 3, 2), np.float32)


def resumed(path: Path) -> tuple[int, np.ndarray]:
    stored = np.full_like(ROWS, np.nan)
    return Checkpoint(path, stored).rows_done, stored


def written(path: Path, *records: slice) -> None:
    kept = Checkpoint(path, np.empty_like(ROWS))
    for some in records:
        kept.append(ROWS[some])


def test_rows_come_back_whatever_the_size_of_blocks(tmp_path):
    path = tmp_path / "new folder" / "rows"
    written(path, slice(0, 5), slice(5, 6))
    done, stored = resumed(path)
    assert done == 6
    assert np.array_equal(stored[:6], ROWS[:6])
    written(path, slice(6, 10), slice(10, 12))
    done, stored = resumed(path)
    assert done == 12
    assert np.array_equal(stored, ROWS)


def test_two_runs_with_one_file(tmp_path):
    """Rationale: two processes that compute the same append in turn. Rows are a function of the file's name, so what
    both have is read once; before, rows of the second were taken for the next ones.
    """
    path = tmp_path / "rows"
    first, second = (Checkpoint(path, np.empty_like(ROWS)) for _ in range(2))
    for a in range(0, 8, 2):
        first.append(ROWS[a : a + 2])
        if a % 4 == 0:
            second.append(ROWS[a // 2 : a // 2 + 2])
    done, stored = resumed(path)
    assert done == 8
    assert np.array_equal(stored[:8], ROWS[:8])


def test_one_run_removes_what_another_one_goes_on_with(tmp_path):
    """Expected: what is left begins in the middle, and is not read."""
    path = tmp_path / "rows"
    first, second = (Checkpoint(path, np.empty_like(ROWS)) for _ in range(2))
    first.append(ROWS[:4])
    second.append(ROWS[:4])
    first.remove()
    second.append(ROWS[4:8])
    assert resumed(path)[0] == 0
    written(path, slice(0, 3))
    assert resumed(path)[0] == 3


def test_damaged_files_give_no_wrong_row(tmp_path):
    """Expected: whichever byte is flipped, and wherever the file ends, rows that are read are right, and so are those
    that are appended then.
    """
    whole = tmp_path / "whole"
    written(whole, *(slice(a, a + 4) for a in (0, 4, 8)))
    intact, path = whole.read_bytes(), tmp_path / "rows"
    counts = set()
    for place in range(len(intact)):
        for damaged in (intact[:place], _flipped(intact, place)):
            path.write_bytes(damaged)
            done, stored = resumed(path)
            assert done == 4 * (3 * place // len(intact))
            assert np.array_equal(stored[:done], ROWS[:done])
            written(path, slice(done, 12))
            assert np.array_equal(resumed(path)[1], ROWS)
            counts.add(done)
    assert counts == {0, 4, 8}


def _flipped(data: bytes, place: int) -> bytes:
    return data[:place] + bytes([data[place] ^ 0x10]) + data[place + 1 :]


def test_rows_of_another_shape_are_not_read(tmp_path):
    written(tmp_path / "rows", slice(0, 4))
    assert Checkpoint(tmp_path / "rows", np.empty((12, 7), np.float32)).rows_done == 0
    assert (tmp_path / "rows").stat().st_size == 0


def test_a_folder_that_cannot_be_written_to_is_a_warning(tmp_path):
    (tmp_path / "file").write_text("not a folder")
    with pytest.warns(prt.PrtWarning, match="an interruption would start over"):
        kept = Checkpoint(tmp_path / "file" / "rows", np.empty_like(ROWS))
    kept.append(ROWS[:4])
    assert kept.rows_done == 0
