"""Finished rows of a long computation, kept in a file so that an interrupted run goes on where it stopped."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.errors import PrtWarning


class Checkpoint:
    """Rows of an array, appended to a file in order.

    Parameters
    ----------
    path : Path
        Its name stands for everything that the rows depend on; an existing file is gone on with. The folder is made.
    stored : (n, ...) array
        Rows that the file has are read into it.

    Notes
    -----
    A file that cannot be read or written is no reason to stop: a warning says that an interruption will cost all.
    """

    def __init__(self, path: Path, stored: NDArray[Any]) -> None:
        self._path: Path | None = path
        self.rows_done = 0
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            if path.exists():
                row = np.empty((1, *stored.shape[1:]), stored.dtype)
                self.rows_done = min(path.stat().st_size // max(row.nbytes, 1), len(stored))
                values = np.fromfile(path, stored.dtype, self.rows_done * row.size)
                stored[: self.rows_done] = values.reshape(self.rows_done, *stored.shape[1:])
                with path.open("r+b") as file:  # a row that was cut off is written again
                    file.truncate(self.rows_done * row.nbytes)
        except OSError as error:
            self._give_up(error)

    def append(self, rows: NDArray[Any]) -> None:
        """Add the next finished rows."""
        if self._path is None:
            return
        try:
            with self._path.open("ab") as file:
                file.write(np.ascontiguousarray(rows).tobytes())
        except OSError as error:
            self._give_up(error)

    def remove(self) -> None:
        """Forget the rows: the computation they belong to is complete."""
        if self._path is not None:
            self._path.unlink(missing_ok=True)

    def _give_up(self, error: OSError) -> None:
        assert self._path is not None
        warnings.warn(
            f"checkpoint {self._path}: {error.strerror or error}; an interruption would start over",
            PrtWarning,
            stacklevel=4,
        )
        self.remove_quietly(self._path)
        self._path, self.rows_done = None, 0

    @staticmethod
    def remove_quietly(path: Path) -> None:
        """Delete a file if that is possible."""
        try:
            path.unlink(missing_ok=True)
        except OSError:
            pass
