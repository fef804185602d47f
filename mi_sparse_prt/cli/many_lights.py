"""``mi-sparse-prt many-lights``: a scene lit by many lights, without precomputation."""

from __future__ import annotations

import time
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import mi_sparse_prt as prt
from mi_sparse_prt.cli import options
from mi_sparse_prt.cli.running import Command, running

if TYPE_CHECKING:
    from collections.abc import Iterator

    import mitsuba as mi
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
        help="Image to write: .exr (linear) or .png (sRGB). With --frames: a film (.mp4), or a folder for .png files.",
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
Exposure = Annotated[float, typer.Option(help="Stops by which .png files, or all of a film, are brightened.")]
Animate = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME=FROM:TO",
        help="What moves in a film: a <default> of the scene, from one number to another, evenly. Repeatable.",
        show_default=False,
    ),
]


@dataclass(frozen=True)
class _Film:
    """A film that is asked for: frames of a scene whose parameters change."""

    output: Path
    frames: int
    fps: float
    ranges: dict[str, tuple[float, float]]

    @property
    def is_folder(self) -> bool:
        return not options.is_film(self.output)

    def parameters(self, frame: int) -> dict[str, str]:
        """Of a frame, as ``load_scene`` takes them."""
        share = frame / max(self.frames - 1, 1)
        return {name: repr(first + share * (last - first)) for name, (first, last) in self.ranges.items()}


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
    frames: options.FrameCount = None,
    animate: Animate = None,
    fps: options.FrameRate = 30.0,
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

    A film: mi-sparse-prt many-lights scenes_xml/many_lights/room.xml -o room.mp4 --frames 48 --animate slide=0:1
    """
    settings = {
        "method": method.value,
        "lights": lights,
        "spp": spp,
        "max_depth": max_depth,
        "clamp": clamp,
        "seed": seed,
        "groups": groups,
        "compensate": compensate,
    }
    given, parameters = (scene, rows, columns, camera), options.definitions(define)
    if frames is not None or animate:
        film = _asked_film(output, frames, animate, fps)
        if groups or preview or seconds is not None or error is not None:
            raise typer.BadParameter(
                "a film has --rows and --columns, and no --groups, --preview, --seconds or --error"
            )
        with running(json_file, quiet, outputs=[None if film.is_folder else output]) as command:
            _render_film(command, film, given, parameters, settings, (exposure, quiet))
        return
    _check_output(output, groups)
    with running(json_file, quiet, outputs=[output]) as command:
        budget = {"seconds": seconds, "error": error}
        _render(command, output, given, parameters, settings | budget, (exposure, preview, quiet))


def _render(
    command: Command,
    output: Path,
    given: tuple[Path, int, int, int],
    parameters: dict[str, str],
    settings: dict[str, Any],
    how: tuple[float, bool, bool],
) -> None:
    """One picture. ``given`` are the scene, rows, columns and camera, ``how`` exposure, preview and quiet."""
    from mi_sparse_prt.cli.files import image_bytes
    from mi_sparse_prt.cli.tables.many_lights import many_lights_table
    from mi_sparse_prt.io.exr_layers import layers_bytes
    from mi_sparse_prt.scene.loading import load_mitsuba
    from mi_sparse_prt.scene.unfolding import unfold_instances

    (scene, rows, columns, camera), (exposure, preview, quiet) = given, how

    def write(image: NDArray[np.float32]) -> None:
        command.write(output, image_bytes(image, output.suffix.lower(), exposure))

    loaded = unfold_instances(load_mitsuba(scene, **parameters))
    # an early picture is written while the work goes on, and must not be cut off
    with command.patient_interrupts() if preview else command.prompt_interrupts():
        found = prt.render_many_lights(
            loaded,
            rows,
            columns,
            sensor=camera,
            progress=not quiet,
            preview=write if preview else None,
            **settings,
        )
    if settings["groups"]:
        command.write(output, layers_bytes(found.image, found.layers))
    else:
        write(found.image)
    command.report = {"scene": str(scene), "image": str(output), **found.report}
    command.show(many_lights_table(str(scene), found.report))


def _render_film(
    command: Command,
    film: _Film,
    given: tuple[Path, int, int, int],
    parameters: dict[str, str],
    settings: dict[str, Any],
    how: tuple[float, bool],
) -> None:
    """All frames, see ``_render``; ``how`` is exposure and quiet."""
    from mi_sparse_prt.cli.film import check_frame_folder, make_film, new_frames
    from mi_sparse_prt.cli.tables.many_lights import film_table
    from mi_sparse_prt.scene.loading import load_mitsuba
    from mi_sparse_prt.scene.unfolding import unfold_instances

    (scene, rows, columns, camera), (exposure, quiet) = given, how
    if film.is_folder:
        check_frame_folder(film.output, film.frames)

    def at(frame: int) -> mi.Scene:
        return unfold_instances(load_mitsuba(scene, **parameters | film.parameters(frame)))

    start, reports = time.perf_counter(), list[dict[str, Any]]()
    found = prt.render_many_lights_frames(at, [camera] * film.frames, rows, columns, **settings)

    def images() -> Iterator[NDArray[np.float32]]:
        for frame in found:
            reports.append(frame.report)
            yield frame.image

    into = new_frames(command, film.output, film.frames, film.fps, exposure, film.is_folder)
    size = make_film(command, into, images(), film.frames, not quiet)
    command.report = {
        "scene": str(scene),
        "film": {"path": str(film.output), "frames": film.frames, "bytes": size, "fps": film.fps},
        "animate": film.ranges,
        "seconds": time.perf_counter() - start,
        "frames": reports,
    }
    command.show(film_table(command.report))


def _asked_film(output: Path, frames: int | None, animate: list[str] | None, fps: float) -> _Film:
    """What --frames and --animate say (typer.BadParameter)."""
    if frames is None:
        raise typer.BadParameter("give how many frames the film has", param_hint="--frames")
    if not animate:
        raise typer.BadParameter("nothing moves: give --animate NAME=FROM:TO", param_hint="--frames")
    options.check_film(output, frames, fps)
    ranges = {}
    for name, value in options.definitions(animate, "--animate", "NAME=FROM:TO").items():
        try:
            first, last = map(float, value.split(":"))
        except ValueError:
            raise typer.BadParameter(
                f"'{name}={value}' is not NAME=FROM:TO with two numbers", param_hint="--animate"
            ) from None
        ranges[name] = first, last
    return _Film(output, frames, fps, ranges)


def _check_output(output: Path, groups: bool) -> None:
    """Refuse a name of a file that no image can be written to, or not all of its layers (typer.BadParameter)."""
    if output.suffix.lower() not in (".exr", ".png"):
        raise typer.BadParameter(f"{output}: give a name that ends in .exr or .png", param_hint="-o")
    if groups and output.suffix.lower() == ".png":
        raise typer.BadParameter("layers need an .exr file: give -o FILE.exr", param_hint="--groups")
