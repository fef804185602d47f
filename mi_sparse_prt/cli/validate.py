"""``mi-sparse-prt validate``: a matrix against Mitsuba's own render of it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import mi_sparse_prt as prt
from mi_sparse_prt.cli import options
from mi_sparse_prt.cli.matrix_file import with_scene
from mi_sparse_prt.cli.running import check_folder, running

Rows = Annotated[int, typer.Option(help="Vertices to compare at, drawn from every mesh.")]
Columns = Annotated[int, typer.Option(help="Texels to compare at: one render each.")]
Samples = Annotated[int, typer.Option(help="Samples per element of Mitsuba's render.")]
ImageSamples = Annotated[int, typer.Option(help="Samples per pixel of the image's reference.")]
Seed = Annotated[int, typer.Option(help="Of the choice of elements and of the render.")]
OutputFolder = Annotated[
    Path | None,
    options.file_option("--output", "-o", metavar="FOLDER", help="Write pictures and report.json there."),
]


def validate(
    scene: options.SceneFile,
    matrix: options.MatrixFile,
    rows: Rows = 64,
    columns: Columns = 256,
    spp: Samples = 1024,
    image_spp: ImageSamples = 256,
    seed: Seed = 0,
    output: OutputFolder = None,
    define: options.Define = None,
    variant: options.Variant = None,
    json_file: options.JsonFile = None,
    quiet: options.Quiet = False,
) -> None:
    """Compare a matrix with Mitsuba's own render of it, and a relit image with Mitsuba's path.

    Example: mi-sparse-prt validate scenes_xml/bunny.xml bunny.prt -o bunny_validation

    Errors are relative L2; the reference's own noise is measured, reported beside them and not counted. Of a matrix
    with glossy surfaces, images from three cameras are compared, and errors split into their causes.
    """
    with running(json_file, quiet) as command:
        from mi_sparse_prt.cli.tables.validation import glossy_images_table, validation_table
        from mi_sparse_prt.core.run import Run
        from mi_sparse_prt.validation.glossy_images import GlossyValidation, validate_glossy

        if output is not None:
            check_folder(output)
        loaded, transport = with_scene(prt.load_transport(matrix), matrix, scene, options.definitions(define))
        result: prt.Validation | GlossyValidation
        with command.prompt_interrupts():
            if transport.terms:
                result = validate_glossy(loaded, transport, spp=image_spp, run=Run(seed, progress=not quiet))
            else:
                result = prt.validate(
                    loaded,
                    transport,
                    n_rows=rows,
                    n_columns=columns,
                    spp=spp,
                    seed=seed,
                    progress=not quiet,
                    image_spp=image_spp,
                )
        command.report = result.report
        if output is not None:
            result.save(output)
            command.written.append(output)
        table = glossy_images_table if transport.terms else validation_table
        command.show(table(result.report, f"{matrix} against Mitsuba"))
