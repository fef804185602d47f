"""``mi-sparse-prt pictures``: what a scene looks like, relit, compressed, and taken apart."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import mi_sparse_prt as prt
from mi_sparse_prt.cli import options
from mi_sparse_prt.cli.running import check_folder, running
from mi_sparse_prt.cli.tables.layout import sentences_tables

SceneFiles = Annotated[list[Path], options.file_argument("SCENE...", "Mitsuba scenes, XML files.")]
OutputFolder = Annotated[
    Path, options.file_option("--output", "-o", metavar="FOLDER", help="PNG files go there.")
]


def pictures(
    scenes: SceneFiles,
    output: OutputFolder,
    resolution: options.Resolution = options.DEFAULT_RESOLUTION,
    edge_length: options.EdgeLength = None,
    variant: options.Variant = None,
    json_file: options.JsonFile = None,
    quiet: options.Quiet = False,
) -> None:
    """Draw scenes relit beside Mitsuba's path, whole and compressed, with clusters and factors of BRDFs.

    Example: mi-sparse-prt pictures scenes_xml/spot.xml scenes_xml/glossy_bunny.xml -o pictures

    Glossy surfaces are shaded for the view, as in Figures 17 to 19 of [HR10].
    """
    with running(json_file, quiet) as command:
        from mi_sparse_prt import benchmark as benchmarks

        check_folder(output)
        for path in scenes:
            scene = prt.load_scene(path, edge_length)
            with command.prompt_interrupts():
                figures = benchmarks.draw_gallery(scene, prt.CubemapLighting(resolution), progress=not quiet)
            command.written += benchmarks.save_gallery(figures, output, path.stem)
        files = [str(path) for path in command.written]
        command.report = {"files": files}
        command.show(*sentences_tables("Written", files))
