"""Arrays and attributes in one file: a Zarr v3 hierarchy in a zip, chunked by blocks of rows.

Every chunk carries a checksum (the zip's CRC-32), so a truncated or altered file is refused. Files are written under
a temporary name beside the target and renamed when complete. Arrays that are the same are kept once.
"""

from __future__ import annotations

import asyncio
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.io.atomic import write_atomically

Arrays = dict[str, NDArray[Any]]

_ROWS = 4096  # of a chunk
_NUMBERS = 1 << 20  # of a chunk of a plain list
# what Zarr, zip and our own assembly raise when a file is not what it should be
DAMAGE = (
    OSError,
    EOFError,
    zipfile.BadZipFile,
    zlib.error,
    LookupError,
    TypeError,
    ValueError,
    RuntimeError,
)


def write_store(path: str | Path, attributes: dict[str, Any], arrays: Arrays) -> None:
    """Write a file; an interrupted or failed write leaves nothing under the name.

    Parameters
    ----------
    path : path
    attributes : dict
        JSON as it is.
    arrays : dict

    Raises
    ------
    PrtError
        If the folder does not exist or the file cannot be written (full disk, permissions).
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise PrtError(f"cannot write {path}: the folder {path.parent} does not exist; create it first")
    if path.exists() and not path.is_file():
        raise PrtError(f"cannot write {path}: it is a folder or a device; give a file name such as scene.prt")
    try:
        write_atomically(path, lambda temporary: _write(temporary, attributes, arrays))
    except OSError as error:
        raise PrtError(
            f"cannot write {path}: {error.strerror or error}; nothing was left behind, "
            "free some space or choose another folder"
        ) from None


def read_store(path: Path) -> tuple[dict[str, Any], Arrays]:
    """Attributes and arrays of a file; one of ``DAMAGE`` if it is not what it should be."""
    import zarr

    store = zarr.storage.ZipStore(path, mode="r")
    group = zarr.open_group(store, mode="r")  # a store that could not be opened cannot be closed
    try:
        attributes: dict[str, Any] = dict(group.attrs)
        arrays = {name: _read(array) for name, array in group.arrays()}
    except DAMAGE:
        zarr.core.sync.sync(_let_others_end())
        raise
    finally:
        store.close()
    same: dict[str, str] = attributes.pop("same", {})
    return attributes, arrays | {name: arrays[other] for name, other in same.items()}


async def _let_others_end() -> None:
    """Wait for chunks that Zarr still reads when one is damaged; else Python complains of them when it exits."""
    others = asyncio.all_tasks() - {asyncio.current_task()}
    await asyncio.gather(*others, return_exceptions=True)


def _write(path: Path, attributes: dict[str, Any], arrays: Arrays) -> None:
    import zarr  # here: it takes a fifth of a second, and who computes a matrix may not keep it

    kept, same = _without_repeats(arrays)
    store = zarr.storage.ZipStore(path, mode="w")
    try:
        group = zarr.create_group(store, attributes=attributes | ({"same": same} if same else {}))
        for name, array in kept.items():
            length = _ROWS if array.ndim > 1 else _NUMBERS
            chunks = (min(length, max(1, len(array))), *array.shape[1:])
            group.create_array(name, data=array, chunks=chunks, config={"write_empty_chunks": True})
    finally:
        store.close()


def _without_repeats(arrays: Arrays) -> tuple[Arrays, dict[str, str]]:
    """Arrays that differ, and the names of the others with those that they are the same as."""
    kept, same = Arrays(), dict[str, str]()
    for name, array in arrays.items():
        for other, known in kept.items():
            if known.shape == array.shape and known.dtype == array.dtype and np.array_equal(known, array):
                same[name] = other
                break
        else:
            kept[name] = array
    return kept, same


def _read(array: Any) -> NDArray[Any]:
    if array.nchunks_initialized != array.nchunks:
        raise ValueError(f"{array.nchunks - array.nchunks_initialized} chunks are missing")
    return np.asarray(array[...])
