"""``mi-sparse-prt relight``: from a matrix file and an environment to an image."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from mi_sparse_prt.cli import options
from mi_sparse_prt.cli.matrix_file import with_scene
from mi_sparse_prt.cli.running import running
from mi_sparse_prt.cli.tables.written import relighting_table
from mi_sparse_prt.core.errors import PrtError

EnvironmentFile = Annotated[
    Path,
    options.file_option(
        "--environment", "-e", metavar="ENV", help="Equirectangular HDR image: .exr, .hdr or .pfm."
    ),
]
ImageFile = Annotated[
    Path | None, options.file_option("--output", "-o", help="Image to write: .png (sRGB) or .exr (linear).")
]
VerticesFile = Annotated[
    Path | None,
    options.file_option(help="Radiance of the vertices: .npy (n_v, 3), or .ply with linear colours."),
]
Rotate = Annotated[float, typer.Option(metavar="DEGREES", help="Turn the environment about +y, the up axis.")]
Exposure = Annotated[float, typer.Option(metavar="STOPS", help="Brighten a .png by this power of two.")]
Sensor = Annotated[int, typer.Option(help="Which of the scene's cameras.")]
Samples = Annotated[
    int, typer.Option(help="Samples per pixel, for edges and textures: the light has no noise.")
]
MatrixScene = Annotated[
    Path | None,
    typer.Option(
        metavar="SCENE", help="Mitsuba scene of the matrix.", show_default="the one it was computed for"
    ),
]


def relight(
    matrix: options.MatrixFile,
    environment: EnvironmentFile,
    output: ImageFile = None,
    vertices: VerticesFile = None,
    rotate: Rotate = 0.0,
    exposure: Exposure = 0.0,
    sensor: Sensor = 0,
    spp: Samples = 64,
    scene: MatrixScene = None,
    define: options.Define = None,
    variant: options.Variant = None,
    json_file: options.JsonFile = None,
    quiet: options.Quiet = False,
) -> None:
    """Light a scene with an environment through its matrix, and write the camera's image.

    Example: mi-sparse-prt relight bunny.prt -e scenes_xml/envmaps/city.exr --rotate 90 -o bunny.png
    """
    if output is None and vertices is None:
        raise typer.BadParameter("nothing to write: give -o IMAGE or --vertices FILE", param_hint="-o")
    _check_suffix(output, (".png", ".exr"), "-o")
    _check_suffix(vertices, (".npy", ".ply"), "--vertices")
    with running(json_file, quiet, outputs=[output, vertices]) as command:
        # before the clock starts
        from mi_sparse_prt import load_environment, load_transport, render
        from mi_sparse_prt.cli.files import image_bytes, vertices_bytes
        from mi_sparse_prt.core.profiling import Stopwatch

        clock = Stopwatch()
        report: dict[str, Any] = {"matrix": str(matrix), "rotation_degrees": rotate}
        files: dict[Path, bytes] = {}
        with command.prompt_interrupts():
            with clock.phase("load"):
                light = load_environment(environment).rotated(rotate)
                loaded, transport = with_scene(
                    load_transport(matrix), matrix, scene, options.definitions(define)
                )
            report["environment"] = light.report
            if vertices is not None and transport.terms:
                raise PrtError(
                    f"{matrix} has glossy surfaces, whose light depends on the view: give -o instead"
                )
            with clock.phase("relight"):
                radiance = transport.relight(light)  # [vertex, rgb]
            if vertices is not None:
                files[vertices] = vertices_bytes(loaded, radiance, vertices.suffix.lower())
                report["vertices"] = {"path": str(vertices), "mean": radiance.mean(axis=0).tolist()}
            if output is not None:
                with clock.phase("render"):
                    # [row, column, rgb]
                    image = render(loaded, transport, light, sensor, spp, progress=not quiet)
                files[output] = image_bytes(image, output.suffix.lower(), exposure)
                report["image"] = {"path": str(output), "mean": image.mean(axis=(0, 1)).tolist()}
        for path, content in files.items():
            command.write(path, content)
        command.report = report | {"seconds": clock.report()}
        title = f"{matrix} under {environment}, turned by {rotate:g} degrees"
        command.show(relighting_table(title, clock.seconds, files))


def _check_suffix(path: Path | None, suffixes: tuple[str, ...], option: str) -> None:
    if path is not None and path.suffix.lower() not in suffixes:
        raise typer.BadParameter(
            f"{path}: give a name that ends in {' or '.join(suffixes)}", param_hint=option
        )
