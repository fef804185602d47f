"""``mi-sparse-prt info``: what a file holds."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import mi_sparse_prt as prt
from mi_sparse_prt.cli.matrix_file import matrix_report
from mi_sparse_prt.cli.options import Define, EdgeLength, JsonFile, definitions
from mi_sparse_prt.cli.running import running
from mi_sparse_prt.cli.tables.matrix import matrix_tables
from mi_sparse_prt.cli.tables.scene import scene_report, scene_tables

MatrixOrScene = Annotated[
    Path, typer.Argument(metavar="FILE", help="Matrix file, or scene (.xml).", show_default=False)
]


def info(
    file: MatrixOrScene,
    edge_length: EdgeLength = None,
    define: Define = None,
    json_file: JsonFile = None,
) -> None:
    """Say what a matrix holds, how it was made and how good it is, or what a scene would give.

    Example: mi-sparse-prt info bunny.prt

    A matrix file is read whole, so this also finds a damaged one.
    """
    with running(json_file, quiet=False) as command:
        if file.suffix.lower() == ".xml":
            scene = prt.load_scene(file, edge_length, **definitions(define))
            command.report = scene_report(scene)
            command.show(*scene_tables(scene))
        else:
            transport = prt.load_transport(file)
            command.report = matrix_report(transport, file)
            command.show(*matrix_tables(transport, file))
