"""``mi-sparse-prt pictures``: what a scene looks like, relit, compressed, and taken apart."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import mi_sparse_prt as prt
from mi_sparse_prt.cli.options import (
    DEFAULT_RESOLUTION,
    Define,
    EdgeLength,
    JsonFile,
    Quiet,
    Resolution,
    Variant,
    definitions,
)
from mi_sparse_prt.cli.running import check_folder, running
from mi_sparse_prt.cli.tables.written import files_table

SceneFiles = Annotated[
    list[Path], typer.Argument(metavar="SCENE...", help="Mitsuba scenes, XML files.", show_default=False)
]
OutputFolder = Annotated[
    Path, typer.Option("--output", "-o", metavar="FOLDER", help="PNG files go there.", show_default=False)
]


def pictures(
    scenes: SceneFiles,
    output: OutputFolder,
    resolution: Resolution = DEFAULT_RESOLUTION,
    edge_length: EdgeLength = None,
    define: Define = None,
    variant: Variant = None,
    json_file: JsonFile = None,
    quiet: Quiet = False,
) -> None:
    """Draw scenes relit beside Mitsuba's path, whole and compressed, with clusters and factors of BRDFs.

    Example: mi-sparse-prt pictures scenes_xml/spot.xml scenes_xml/glossy_bunny.xml -o pictures

    Glossy surfaces are shaded for the view, as in Figures 17 to 19 of [HR10].
    """
    with running(json_file, quiet) as command:
        from mi_sparse_prt import benchmark as benchmarks

        check_folder(output)
        for path in scenes:
            scene = prt.load_scene(path, edge_length, **definitions(define))
            with command.prompt_interrupts():
                figures = benchmarks.draw_gallery(scene, prt.CubemapLighting(resolution), progress=not quiet)
            command.written += benchmarks.save_gallery(figures, output, path.stem)
        command.report = {"files": [str(path) for path in command.written]}
        command.show(files_table(command.written))
