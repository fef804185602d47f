"""Scenes from Mitsuba's XML files."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import mitsuba as mi

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.core.variant import check_variant
from mi_sparse_prt.scene.scene import Scene, SceneFile


def load_scene(path: str | Path, edge_length: float | None = None, **parameters: Any) -> Scene:
    """Load a Mitsuba XML scene.

    Parameters
    ----------
    path : str or Path
        The XML file; file names inside are relative to it.
    edge_length : float, optional
        World units; see `Scene.from_mitsuba`.
    **parameters
        Values for the XML's ``<default name=...>`` entries, as Mitsuba's ``-D`` gives them.

    Raises
    ------
    PrtError
        Another variant than rgb, missing file, XML or plugin error, and everything that `Scene.from_mitsuba` refuses.
    """
    loaded, path = load_mitsuba(path, **parameters), Path(path)
    try:
        scene = Scene._build(loaded, edge_length)
    except PrtError as error:
        raise PrtError(f"scene file {path}: {error}") from error
    scene.file = SceneFile(str(path), edge_length, parameters)
    scene._warn()
    return scene


def load_mitsuba(path: str | Path, **parameters: Any) -> mi.Scene:
    """Load an XML scene as Mitsuba has it, with shapes in the file's order.

    Parameters and errors are those of ``load_scene``, but for what the package makes of the scene.
    """
    check_variant()
    path = Path(path)
    if not path.is_file():
        raise PrtError(f"scene file {path} does not exist: check the path")
    try:
        # parallel loading numbers what it finds in another order each time, and kernels would be compiled again
        options = {"optimize": False, "parallel": False}
        loaded = mi.load_file(str(path), **options, **{k: str(v) for k, v in parameters.items()})
    except Exception as error:  # Mitsuba raises RuntimeError, ValueError and others, over many lines
        reason = _one_line(error).replace(f"{path} ", "")
        raise PrtError(f"scene file {path} cannot be loaded: {reason}") from error
    if not isinstance(loaded, mi.Scene):
        raise PrtError(f"scene file {path} holds a {type(loaded).__name__}: its root element must be <scene>")
    return loaded


def _one_line(error: Exception, limit: int = 400) -> str:
    """A Mitsuba error without its line breaks, colours and places in Mitsuba's own source."""
    text = re.sub(r"\x1b\[[0-9;]*m|\[\w+\.(cpp|h):\d+\] ", "", str(error))
    text = " ".join(text.split())
    return text if len(text) <= limit else text[: limit - 3] + "..."
