"""``mi-sparse-prt many-lights``: a scene lit by many lights, without precomputation."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import mi_sparse_prt as prt
from mi_sparse_prt.cli import options
from mi_sparse_prt.cli.running import running

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


class ManyLightsMethod(StrEnum):
    """Which form of the algorithm."""

    adaptive = "adaptive"
    hasan2007 = "hasan2007"


Output = Annotated[
    Path,
    typer.Option(
        "--output",
        "-o",
        metavar="FILE",
        help="Image to write: .exr (linear) or .png (sRGB).",
        show_default=False,
    ),
]
Rows = Annotated[
    int, typer.Option(help="Samples that are lit by all lights: they tell which lights are alike.")
]
Columns = Annotated[int, typer.Option(help="Lights that light all samples, one for each cluster of lights.")]
Seconds = Annotated[
    float | None,
    typer.Option(
        "--seconds",  # by name: typer 0.27 makes it --SECONDS after the metavar
        metavar="SECONDS",
        help="Choose --rows and --columns so that it takes so long.",
        show_default=False,
    ),
]
ErrorOption = Annotated[
    float | None,
    typer.Option(
        metavar="SHARE",
        help="Raise --rows and --columns until the estimated error is so small, 0.02 is 2%, or --seconds are over.",
        show_default=False,
    ),
]
MethodOption = Annotated[
    ManyLightsMethod, typer.Option(help="hasan2007 is the paper on matrix row-column sampling as published.")
]
Lights = Annotated[int, typer.Option(help="Lights in all, about.")]
Samples = Annotated[int, typer.Option(help="Samples per pixel.")]
MaxDepth = Annotated[
    int, typer.Option(help="As for Mitsuba's path: 2 is direct light only, -1 has no limit.")
]
Clamp = Annotated[
    float | None,
    typer.Option(
        help="Largest geometry term of indirect lights, 1 / (unit of the scene)^2.",
        show_default="that of surfaces at 1/10 of the scene's radius",
    ),
]
Compensate = Annotated[
    bool,
    typer.Option(
        "--compensate",
        help="Add what the clamp cuts off, and light by way of mirrors and glass: the image of path, with some grain.",
    ),
]
Camera = Annotated[int, typer.Option(help="Which of the scene's sensors.")]
Seed = Annotated[int, typer.Option(help="The same seed gives the same image.")]
Groups = Annotated[
    bool,
    typer.Option(
        "--groups", help="Light of each emitter apart: the .exr file has a layer for each, named after it."
    ),
]
Preview = Annotated[
    bool,
    typer.Option(
        "--preview", help="Write the image early, from a ninth of the columns, and again in the end."
    ),
]
Exposure = Annotated[float, typer.Option(help="Stops by which .png files are brightened.")]


def many_lights(
    scene: options.SceneFile,
    output: Output,
    rows: Rows = 300,
    columns: Columns = 900,
    seconds: Seconds = None,
    error: ErrorOption = None,
    method: MethodOption = ManyLightsMethod.adaptive,
    lights: Lights = 100_000,
    spp: Samples = 4,
    max_depth: MaxDepth = 5,
    clamp: Clamp = None,
    compensate: Compensate = False,
    camera: Camera = 0,
    seed: Seed = 0,
    groups: Groups = False,
    preview: Preview = False,
    exposure: Exposure = 0.0,
    define: options.Define = None,
    variant: options.Variant = None,
    json_file: options.JsonFile = None,
    quiet: options.Quiet = False,
) -> None:
    """Render a scene under all its light as many point lights: a preview in seconds, nothing is precomputed.

    Example: mi-sparse-prt many-lights scenes_xml/cornell.xml -o cornell.exr --rows 300 --columns 900

    A forecast comes first, its own estimate of its error last. In place of --rows and --columns:
    --seconds 10 for all that fits into them, --error 0.02 for as much as it takes.
    """
    _check_output(output, groups)
    with running(json_file, quiet, outputs=[output]) as command:
        from mi_sparse_prt.cli.files import image_bytes
        from mi_sparse_prt.cli.tables.many_lights import many_lights_table
        from mi_sparse_prt.io.exr_layers import layers_bytes
        from mi_sparse_prt.scene.loading import load_mitsuba
        from mi_sparse_prt.scene.unfolding import unfold_instances

        def write(image: NDArray[np.float32]) -> None:
            command.write(output, image_bytes(image, output.suffix.lower(), exposure))

        loaded = unfold_instances(load_mitsuba(scene, **options.definitions(define)))
        # an early picture is written while the work goes on, and must not be cut off
        with command.patient_interrupts() if preview else command.prompt_interrupts():
            found = prt.render_many_lights(
                loaded,
                rows,
                columns,
                seconds,
                sensor=camera,
                progress=not quiet,
                preview=write if preview else None,
                method=method.value,
                lights=lights,
                spp=spp,
                max_depth=max_depth,
                clamp=clamp,
                seed=seed,
                groups=groups,
                compensate=compensate,
                error=error,
            )
        if groups:
            command.write(output, layers_bytes(found.image, found.layers))
        else:
            write(found.image)
        command.report = {"scene": str(scene), "image": str(output), **found.report}
        command.show(many_lights_table(str(scene), found.report))


def _check_output(output: Path, groups: bool) -> None:
    """Refuse a name of a file that no image can be written to, or not all of its layers (typer.BadParameter)."""
    if output.suffix.lower() not in (".exr", ".png"):
        raise typer.BadParameter(f"{output}: give a name that ends in .exr or .png", param_hint="-o")
    if groups and output.suffix.lower() == ".png":
        raise typer.BadParameter("layers need an .exr file: give -o FILE.exr", param_hint="--groups")
