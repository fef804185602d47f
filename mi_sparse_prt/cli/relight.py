"""``mi-sparse-prt relight``: from a matrix file and an environment to an image, or to a film."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mi_sparse_prt.cli import options
from mi_sparse_prt.cli.matrix_file import with_scene
from mi_sparse_prt.cli.running import Command, running
from mi_sparse_prt.cli.tables.written import relighting_table
from mi_sparse_prt.core.errors import PrtError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    import numpy as np
    from numpy.typing import NDArray

    from mi_sparse_prt import Environment, LightTransport, Scene
    from mi_sparse_prt.core.profiling import Stopwatch

EnvironmentFile = Annotated[
    Path | None,
    options.file_option(
        "--environment", "-e", metavar="ENV", help="Equirectangular HDR image: .exr, .hdr or .pfm."
    ),
]
ImageFile = Annotated[
    Path | None,
    options.file_option(
        "--output",
        "-o",
        help="Image to write: .png (sRGB) or .exr (linear). With --frames: a film (.mp4), or a folder for .png files. "
        "With --each: a folder.",
    ),
]
VerticesFile = Annotated[
    Path | None,
    options.file_option(help="Radiance of the vertices: .npy (n_v, 3), or .ply with linear colours."),
]
Rotate = Annotated[
    float,
    typer.Option(
        metavar="DEGREES",
        help="Turn the environment about +y, the up axis; with --frames, from 0 to this, at constant speed.",
    ),
]
Exposure = Annotated[
    float, typer.Option(metavar="STOPS", help="Brighten a .png, or all of a film, by this power of two.")
]
Each = Annotated[
    int | None,
    typer.Option(
        "--each",
        metavar="LIGHTS",
        help="In place of an environment, so many even lights around the scene: a picture (.exr) of each.",
        show_default=False,
    ),
]
LastEnvironment = Annotated[
    Path | None,
    options.file_option(
        "--to", metavar="ENV", help="Environment of the last frame: the light becomes this one step by step."
    ),
]
Sensor = Annotated[int, typer.Option(help="Which of the scene's cameras.")]
Samples = Annotated[
    int, typer.Option(help="Samples per pixel, for edges and textures: the light has no noise.")
]
MatrixScene = Annotated[
    Path | None,
    typer.Option(
        "--scene",  # by name: typer 0.27 makes it --SCENE after the metavar
        metavar="SCENE",
        help="Mitsuba scene of the matrix.",
        show_default="the one it was computed for",
    ),
]


@dataclass(frozen=True)
class _View:
    """What is lit, and how it is looked at."""

    scene: Scene
    transport: LightTransport
    sensor: int
    spp: int

    def image(self, light: Environment, progress: bool = False) -> NDArray[np.float32]:
        """Linear RGB, (row, column, rgb)."""
        from mi_sparse_prt import render

        return render(self.scene, self.transport, light, self.sensor, self.spp, progress=progress)

    def film(self, lights: Iterable[Environment]) -> Iterator[NDArray[np.float32]]:
        """An image for each light, by a camera that stands still."""
        from mi_sparse_prt.relighting.film import film_images

        return film_images(self.scene, self.transport, lights, self.sensor, self.spp)


def relight(
    matrix: options.MatrixFile,
    environment: EnvironmentFile = None,
    output: ImageFile = None,
    vertices: VerticesFile = None,
    rotate: Rotate = 0.0,
    exposure: Exposure = 0.0,
    frames: options.FrameCount = None,
    to: LastEnvironment = None,
    fps: options.FrameRate = 30.0,
    each: Each = None,
    sensor: Sensor = 0,
    spp: Samples = 64,
    scene: MatrixScene = None,
    define: options.Define = None,
    variant: options.Variant = None,
    json_file: options.JsonFile = None,
    quiet: options.Quiet = False,
) -> None:
    """Light a scene with an environment through its matrix, and write the camera's image, or a film.

    Example: mi-sparse-prt relight bunny.prt -e scenes_xml/envmaps/city.exr --rotate 90 -o bunny.png

    A film: mi-sparse-prt relight bunny.prt -e scenes_xml/envmaps/city.exr --rotate 360 --frames 120 -o bunny.mp4

    One light at a time: mi-sparse-prt relight bunny.prt --each 331 -o bunny_lights
    """
    given = matrix, scene, options.definitions(define)
    if each is not None:
        _check_each(environment, output, vertices, frames)
        assert output is not None
        with running(json_file, quiet) as command:
            _relight_each(command, given, each, output, (sensor, spp), quiet)
        return
    if environment is None:
        raise typer.BadParameter("no light: give -e ENVIRONMENT, or --each LIGHTS", param_hint="-e")
    _check_files(output, vertices, to, frames, fps)
    folder = frames is not None and output is not None and not options.is_film(output)
    with running(json_file, quiet, outputs=[None if folder else output, vertices]) as command:
        # before the clock starts
        from mi_sparse_prt import load_environment, load_transport
        from mi_sparse_prt.cli.film import check_frame_folder, make_film, new_frames
        from mi_sparse_prt.core.profiling import Stopwatch
        from mi_sparse_prt.relighting.film import film_lights

        if frames is not None and output is not None and folder:
            check_frame_folder(output, frames)
        clock = Stopwatch()
        with command.prompt_interrupts(), clock.phase("load"):
            light, last = load_environment(environment), None if to is None else load_environment(to)
            view = _View(*with_scene(load_transport(matrix), *given), sensor, spp)
        report: dict[str, Any] = {"matrix": str(matrix), "environment": light.report}
        report["rotation_degrees"] = rotate
        if frames is not None and output is not None:
            report |= {} if last is None else {"to": last.report}
            with clock.phase("render"):
                into = new_frames(command, output, frames, fps, exposure, folder)
                images = view.film(film_lights(light, last, rotate, frames))
                sizes = {output: make_film(command, into, images, frames, not quiet)}
            report["film"] = {"path": str(output), "frames": frames, "bytes": sizes[output]}
            report["film"] |= {} if folder else {"fps": fps}
        else:
            with command.prompt_interrupts():
                lit = light.rotated(rotate)
                files, about = _pictures(view, lit, output, vertices, exposure, not quiet, clock)
            report |= about
            sizes = command.write_all(files)
        command.report = report | {"seconds": clock.report()}
        what = f"{matrix} under {environment}, turned by {rotate:g} degrees"
        command.show(relighting_table(what, clock.seconds, sizes))


def _relight_each(
    command: Command,
    source: tuple[Path, Path | None, dict[str, str]],
    count: int,
    folder: Path,
    camera: tuple[int, int],
    quiet: bool,
) -> None:
    """Pictures of one light at a time; ``source`` is the matrix, its scene if it is given, and its parameters."""
    from mi_sparse_prt import load_transport
    from mi_sparse_prt.cli.each_light import SUFFIX, make_pictures_of_each
    from mi_sparse_prt.cli.film import check_frame_folder
    from mi_sparse_prt.core.profiling import Stopwatch

    matrix, scene, parameters = source
    check_frame_folder(folder, count, SUFFIX)
    clock = Stopwatch()
    with command.prompt_interrupts(), clock.phase("load"):
        loaded = with_scene(load_transport(matrix), matrix, scene, parameters)
    with clock.phase("render"):
        about = make_pictures_of_each(command, *loaded, count, folder, camera, not quiet)
    command.report = {"matrix": str(matrix), "each": about, "seconds": clock.report()}
    title = f"{matrix} by {count} lights, one at a time"
    command.show(relighting_table(title, clock.seconds, {folder: about["bytes"]}))


def _pictures(
    view: _View,
    light: Environment,
    output: Path | None,
    vertices: Path | None,
    exposure: float,
    progress: bool,
    clock: Stopwatch,
) -> tuple[dict[Path, bytes], dict[str, Any]]:
    """Contents of the files of one light, and what the report says of them."""
    from mi_sparse_prt.cli.files import image_bytes, vertices_bytes

    files, report = dict[Path, bytes](), dict[str, Any]()
    if vertices is not None and view.transport.terms:
        raise PrtError(
            "the matrix has glossy surfaces, whose light depends on the view: give -o, not --vertices"
        )
    with clock.phase("relight"):
        radiance = view.transport.relight(light)  # [vertex, rgb]
    if vertices is not None:
        files[vertices] = vertices_bytes(view.scene, radiance, vertices.suffix.lower())
        report["vertices"] = {"path": str(vertices), "mean": radiance.mean(axis=0).tolist()}
    if output is not None:
        with clock.phase("render"):
            image = view.image(light, progress)
        files[output] = image_bytes(image, output.suffix.lower(), exposure)
        report["image"] = {"path": str(output), "mean": image.mean(axis=(0, 1)).tolist()}
    return files, report


def _check_files(
    output: Path | None, vertices: Path | None, to: Path | None, frames: int | None, fps: float
) -> None:
    if frames is None:
        _check_pictures(output, vertices, to)
    else:
        _check_film(output, vertices, frames, fps)


def _check_pictures(output: Path | None, vertices: Path | None, to: Path | None) -> None:
    if output is None and vertices is None:
        raise typer.BadParameter("nothing to write: give -o IMAGE or --vertices FILE", param_hint="-o")
    if to is not None:
        raise typer.BadParameter(
            f"{to} would be the light at the end of a film: give --frames, too", param_hint="--to"
        )
    _check_suffix(output, (".png", ".exr"), "-o", "; a film or a folder needs --frames")
    _check_suffix(vertices, (".npy", ".ply"), "--vertices")


def _check_each(
    environment: Path | None, output: Path | None, vertices: Path | None, frames: int | None
) -> None:
    for given, name in ((environment, "-e"), (vertices, "--vertices"), (frames, "--frames")):
        if given is not None:
            raise typer.BadParameter(
                f"--each has lights and pictures of its own: leave out {name}", param_hint=name
            )
    if output is None or (output.suffix and not output.is_dir()):
        raise typer.BadParameter("pictures of each light need a folder: give -o FOLDER", param_hint="-o")


def _check_film(output: Path | None, vertices: Path | None, frames: int, fps: float) -> None:
    if vertices is not None:
        raise typer.BadParameter(
            f"{vertices}: vertices have no film: leave out --frames", param_hint="--vertices"
        )
    if output is None:
        raise typer.BadParameter(
            f"nothing to write: give -o FILM{options.FILM} or -o FOLDER", param_hint="-o"
        )
    options.check_film(output, frames, fps)


def _check_suffix(path: Path | None, suffixes: tuple[str, ...], option: str, more: str = "") -> None:
    if path is not None and path.suffix.lower() not in suffixes:
        raise typer.BadParameter(
            f"{path}: give a name that ends in {' or '.join(suffixes)}{more}", param_hint=option
        )
