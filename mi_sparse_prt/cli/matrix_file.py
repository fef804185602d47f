"""A matrix file: what a report says of it, and the scene that it was computed for."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mi_sparse_prt as prt
from mi_sparse_prt.core.errors import PrtError


def matrix_report(transport: prt.LightTransport, path: Path) -> dict[str, Any]:
    """The report of a matrix, with its file."""
    return transport.report | {"file": {"path": str(path), "bytes": path.stat().st_size}}


def with_scene(
    transport: prt.LightTransport,
    matrix: Path,
    scene: Path | None,
    parameters: dict[str, str],
) -> tuple[prt.Scene, prt.LightTransport]:
    """The scene of a matrix, loaded as ``precompute`` loaded it, and the matrix in this scene's vertex order.

    Parameters
    ----------
    transport
        The matrix.
    matrix
        The file that it comes from.
    scene
        Scene file; None: the one that the matrix was computed for.
    parameters
        Values for its <default> elements, in the place of those that ``precompute`` had.

    Raises
    ------
    PrtError
        If there is no such scene, or the matrix is another scene's.
    """
    recorded = transport.report.get("scene", {})
    if scene is None:
        if not recorded.get("path"):
            raise PrtError(f"{matrix} does not say which scene it was computed for: give --scene SCENE.xml")
        scene = Path(recorded["path"])
        if not scene.is_file():
            raise PrtError(
                f"{matrix} was computed for {scene}, which is not there any more: give --scene SCENE.xml"
            )
    edge_length = recorded.get("edge_length")
    loaded = prt.load_scene(
        scene,
        None if edge_length is None else float(edge_length),
        **recorded.get("parameters", {}) | parameters,
    )
    return loaded, transport.for_scene(loaded)
