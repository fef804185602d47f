"""Files that appear whole or not at all."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from pathlib import Path


def write_atomically(path: Path, write: Callable[[Path], None]) -> None:
    """Let a function write a file under a temporary name beside the target, then rename it.

    Parameters
    ----------
    path : Path
        Replaced if it exists; its folder exists.
    write : callable
        Is given the temporary path of an empty file.

    Raises
    ------
    OSError
        If the file cannot be written; nothing is left behind then, and what had the name before still has it.
    """
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        write(temporary)
        temporary.chmod(0o666 & ~_umask())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
