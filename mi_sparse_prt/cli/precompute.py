"""``mi-sparse-prt precompute``: from a scene to a matrix file."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

import mi_sparse_prt as prt
from mi_sparse_prt.cli import options
from mi_sparse_prt.cli.matrix_file import matrix_report
from mi_sparse_prt.cli.running import check_folder, running
from mi_sparse_prt.cli.tables.matrix import matrix_tables


class Basis(StrEnum):
    """How light arrives from a texel of the lighting."""

    direction = "direction"
    texel = "texel"


Output = Annotated[
    Path, options.file_option("--output", "-o", help="Matrix file to write, by convention *.prt.")
]
MethodOption = Annotated[
    options.Method,
    typer.Option(
        help="What is quickest for the target error, by a pilot on a few hundred vertices (auto); or every "
        "element, few of them (sparse), few as in the paper (huang2010), or all direct light, and "
        "interreflections by finite elements (gather)."
    ),
]
BasisOption = Annotated[
    Basis, typer.Option(help="Light from a texel's centre alone, or from its whole area.")
]
MaxDepth = Annotated[
    int,
    typer.Option(help="As Mitsuba's path: 2 is direct light only, 5 three interreflections, -1 no limit."),
]
Samples = Annotated[
    int | None,
    typer.Option(
        help="Paths per element of the indirect light, where there are any; auto then chooses no other number.",
        show_default="16, or what the target error needs",
    ),
]
IndirectResolution = Annotated[
    int | None,
    typer.Option(
        help="Texels along an edge of the indirect light's cubemap, where it is path traced: its cost grows "
        "with the square. The report says what a coarse one costs in error. auto then chooses no other one.",
        show_default="brute_force: 8, or the resolution",
    ),
]
TargetError = Annotated[
    float | None,
    typer.Option(
        metavar="ERROR",
        help="Relative L2 error of the matrix to aim at, 0.02 for 2%. Elements held out say whether it was met; "
        "if not, auto, sparse and gather try again, finer. brute_force chooses --spp and "
        "--indirect-resolution for it.",
        show_default="auto: 0.02, and one try",
    ),
]
SpecularError = Annotated[
    float | None,
    typer.Option(
        metavar="ERROR",
        help="Noise of light by way of mirrors and glass that is small enough, of that light alone; --target-error is "
        "then for all other light.",
        show_default="part of --target-error",
    ),
]
MaxSeconds = Annotated[
    float,
    typer.Option(metavar="SECONDS", help="auto begins nothing that is predicted to take longer in all."),
]
Terms = Annotated[
    str | None,
    typer.Option(
        metavar="NUMBER|auto",
        help="For glossy BSDFs: factors of each, 4 in [HR10], or auto, as many as the target error asks for; images "
        "then depend on the view. Without, all surfaces count as diffuse.",
        show_default=False,
    ),
]
Explain = Annotated[
    bool,
    typer.Option("--explain", help="Show all plans that auto compared, with predicted time and error."),
]
Strata = Annotated[
    int, typer.Option(help="With --basis texel: shadow rays per element are the square of this.")
]
Seed = Annotated[int, typer.Option(help="The same seed gives the same matrix.")]
Checkpoint = Annotated[
    Path | None,
    options.file_option(
        metavar="FOLDER",
        help="Keep finished rows of the indirect light there: the same command after an interruption goes on.",
    ),
]


def precompute(
    scene: options.SceneFile,
    output: Output,
    resolution: options.Resolution = options.DEFAULT_RESOLUTION,
    method: MethodOption = options.Method.auto,
    basis: BasisOption = Basis.direction,
    max_depth: MaxDepth = 5,
    spp: Samples = None,
    indirect_resolution: IndirectResolution = None,
    target_error: TargetError = None,
    specular_error: SpecularError = None,
    max_seconds: MaxSeconds = 300.0,
    terms: Terms = None,
    explain: Explain = False,
    strata: Strata = 2,
    edge_length: options.EdgeLength = None,
    seed: Seed = 0,
    checkpoint: Checkpoint = None,
    define: options.Define = None,
    variant: options.Variant = None,
    json_file: options.JsonFile = None,
    quiet: options.Quiet = False,
) -> None:
    """Compute the light transport matrix of a scene and write it to a file.

    Example: mi-sparse-prt precompute scenes_xml/bunny.xml -o bunny.prt

    A forecast of time and memory comes first; a table of what was done, skipped and how good it is comes last.
    Direct light only, in seconds: add --max-depth 2. Why it was done so: add --explain. Glossy surfaces: --terms auto.
    """
    if indirect_resolution is None and method is options.Method.brute_force and target_error is None:
        indirect_resolution = min(8, resolution)
    with running(json_file, quiet, outputs=[output]) as command:
        parameters = options.definitions(define)
        loaded = prt.load_scene(scene, edge_length, **parameters)
        if checkpoint is not None:
            check_folder(checkpoint)
            command.hint = f"; finished rows are in {checkpoint}, the same command goes on with them"
        with command.prompt_interrupts():
            transport = prt.precompute(
                loaded,
                prt.CubemapLighting(resolution),
                method=method.value,
                basis=basis.value,
                max_depth=max_depth,
                spp=spp,
                target_error=target_error,
                seed=seed,
                progress=not quiet,
                indirect_resolution=indirect_resolution,
                strata=strata,
                checkpoint_folder=checkpoint,
                terms=_number_or_word(terms or "0"),
                max_seconds=max_seconds,
                specular_error=specular_error,
            )
        # what `relight` needs to load the same scene again
        transport.report["scene"] |= {
            "path": str(scene.absolute()),
            "parameters": parameters,
            "edge_length": None if edge_length is None else str(edge_length),
        }
        transport.save(output)
        command.written.append(output)
        command.report = matrix_report(transport, output)
        command.show(*matrix_tables(transport, output, explain))


def _number_or_word(text: str) -> int | str:
    """As ``precompute`` takes it, which says what else it is to be."""
    return int(text) if text.lstrip("-").isdigit() else text
