"""``mi-sparse-prt info``: what a file holds."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import mi_sparse_prt as prt
from mi_sparse_prt.cli import options
from mi_sparse_prt.cli.matrix_file import matrix_report
from mi_sparse_prt.cli.running import running
from mi_sparse_prt.cli.tables.matrix import matrix_tables
from mi_sparse_prt.cli.tables.scene import scene_report, scene_tables

MatrixOrScene = Annotated[Path, options.file_argument("FILE", "Matrix file, or scene (.xml).")]


def info(
    file: MatrixOrScene,
    edge_length: options.EdgeLength = None,
    define: options.Define = None,
    json_file: options.JsonFile = None,
) -> None:
    """Say what a matrix holds, how it was made and how good it is, or what a scene would give.

    Example: mi-sparse-prt info bunny.prt

    A matrix file is read whole, so this also finds a damaged one.
    """
    with running(json_file, quiet=False) as command:
        if file.suffix.lower() == ".xml":
            scene = prt.load_scene(file, edge_length, **options.definitions(define))
            command.report = scene_report(scene)
            command.show(*scene_tables(scene))
        else:
            transport = prt.load_transport(file)
            command.report = matrix_report(transport, file)
            command.show(*matrix_tables(transport, file))
