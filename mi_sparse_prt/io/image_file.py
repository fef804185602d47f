"""Images in files, as Mitsuba reads them."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi

from mi_sparse_prt.core.errors import PrtError


def read_bitmap(path: Path, advice: str) -> mi.Bitmap:
    """An image file as it is.

    Raises
    ------
    PrtError
        There is no such file, or it cannot be read: why, and the ``advice``.
    """
    if not path.is_file():
        raise PrtError(f"{path}: no such file")
    try:
        return mi.Bitmap(str(path))
    except (RuntimeError, MemoryError) as error:
        reason = " ".join(str(error).split())
        raise PrtError(f"{path}: cannot be read as an image, {advice} ({reason})") from error
