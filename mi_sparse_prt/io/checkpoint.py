"""Finished rows of a long computation, kept in a file so that an interrupted run goes on where it stopped."""

from __future__ import annotations

import os
import struct
import warnings
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.errors import PrtWarning

PLACE, CHECKSUM = struct.Struct("<QQ"), struct.Struct("<I")  # of a record: first row and bytes; CRC-32 of all


class Checkpoint:
    """Rows of an array, appended to a file in order, a record at a time.

    Parameters
    ----------
    path : Path
        Its name stands for everything that the rows depend on; an existing file is gone on with. The folder is made.
    stored : (n, ...) array
        Rows that the file has are read into it.

    Notes
    -----
    A file that cannot be read or written is no reason to stop: a warning says that an interruption will cost all.

    Records say which rows they are, and a checksum: two processes that append to one file lose some of it at worst. A
    row is the same whoever computes it, so that what both wrote is read once.
    """

    def __init__(self, path: Path, stored: NDArray[Any]) -> None:
        self._path: Path | None = path
        self.rows_done = 0
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            if path.exists():
                self._read(path, stored)
        except OSError as error:
            self._give_up(error)

    def append(self, rows: NDArray[Any]) -> None:
        """Add the next finished rows."""
        if self._path is None:
            return
        try:
            with self._path.open("ab") as file:
                values = np.ascontiguousarray(rows).tobytes()
                record = PLACE.pack(self.rows_done, len(values)) + values
                file.write(CHECKSUM.pack(zlib.crc32(record)) + record)
            self.rows_done += len(rows)
        except OSError as error:
            self._give_up(error)

    def remove(self) -> None:
        """Forget the rows: the computation they belong to is complete."""
        if self._path is not None:
            self._path.unlink(missing_ok=True)

    def _read(self, path: Path, stored: NDArray[Any]) -> None:
        """Read rows up to the first record that is cut off, damaged or none of the next rows; cut off what follows."""
        row_bytes = stored[:1].nbytes
        with path.open("r+b") as file:
            end = 0
            for first, values in _records(file):
                count, rest = divmod(len(values), max(row_bytes, 1))
                if rest or first > self.rows_done or first + count > len(stored):
                    break
                rows = np.frombuffer(values, stored.dtype).reshape(count, *stored.shape[1:])
                stored[first : first + count] = rows
                self.rows_done = max(self.rows_done, first + count)
                end = file.tell()
            file.truncate(end)

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


def _records(file: BinaryIO) -> Iterator[tuple[int, bytes]]:
    """First rows and bytes of the records of a file, as long as these are whole."""
    length = os.fstat(file.fileno()).st_size
    while file.tell() + CHECKSUM.size + PLACE.size <= length:
        checksum, place = file.read(CHECKSUM.size), file.read(PLACE.size)
        first, size = PLACE.unpack(place)
        values = file.read(min(size, length))
        if zlib.crc32(place + values) != CHECKSUM.unpack(checksum)[0]:
            return
        yield first, values
