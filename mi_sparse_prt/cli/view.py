"""``mi-sparse-prt view``: a matrix, or the lamps of a picture, in the browser or as a page in a file."""

from __future__ import annotations

import webbrowser
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mi_sparse_prt.cli import options
from mi_sparse_prt.cli.matrix_file import with_scene
from mi_sparse_prt.cli.relight import MatrixScene, Sensor
from mi_sparse_prt.cli.running import Command, running
from mi_sparse_prt.cli.tables.written import relighting_table

if TYPE_CHECKING:
    from mi_sparse_prt import Environment, Scene
    from mi_sparse_prt.core.profiling import Stopwatch
    from mi_sparse_prt.relighting.viewer.server import Reply

Environments = Annotated[
    list[Path] | None,
    typer.Option(
        "--environment",
        "-e",
        metavar="ENV",
        help="Equirectangular HDR image to choose: .exr, .hdr or .pfm; may be repeated.",
        show_default="those in the folder envmaps beside the scene; else its own, a sky and a sun",
    ),
]
Export = Annotated[
    Path | None, options.file_option("--export", help="Write the page (.html), and do not show it.")
]
Kept = Annotated[
    float,
    typer.Option(help="Share of the wavelet coefficients that the page keeps: its size against its error."),
]
Port = Annotated[int, typer.Option(help="Of the page on this machine; 0 for any that is free.")]
Browser = Annotated[bool, typer.Option("--browser/--no-browser", help="Open the page in a browser.")]
Shown = Annotated[
    Path,
    options.file_argument(
        "FILE", "Matrix that `precompute` wrote, or picture (.exr) that `many-lights --groups` wrote."
    ),
]


def view(
    file: Shown,
    environment: Environments = None,
    export: Export = None,
    kept: Kept = 0.05,
    port: Port = 0,
    browser: Browser = True,
    sensor: Sensor = 0,
    scene: MatrixScene = None,
    define: options.Define = None,
    variant: options.Variant = None,
    json_file: options.JsonFile = None,
    quiet: options.Quiet = False,
) -> None:
    """Turn the light of a scene with the mouse: in the browser, or in one HTML file that works without a network.

    Example: mi-sparse-prt view bunny.prt

    To send by mail: mi-sparse-prt view bunny.prt --export bunny.html

    To mix the lamps of a picture: mi-sparse-prt view room.exr
    """
    if export is not None and export.suffix.lower() not in (".html", ".htm"):
        raise typer.BadParameter(f"{export}: give a name that ends in .html", param_hint="--export")
    is_picture = file.suffix.lower() == ".exr"
    if is_picture and (environment or scene or define):
        raise typer.BadParameter("a picture has its light inside: give a matrix with -e, --scene or -D")
    with running(json_file, quiet, outputs=[export]) as command:
        if is_picture:
            return _mix(command, file, export, port, browser)
        from mi_sparse_prt import compress, load_transport
        from mi_sparse_prt.core.profiling import Stopwatch
        from mi_sparse_prt.relighting.viewer import LivePage, make_live_page, make_page

        clock = Stopwatch()
        with command.prompt_interrupts():
            with clock.phase("load"):
                loaded, transport = with_scene(load_transport(file), file, scene, options.definitions(define))
                lights = {} if transport.lights else _lights(loaded, environment)
            diffuse = not transport.terms and not transport.lights
            if diffuse and "compressed" not in transport.operators:
                with clock.phase("compress"):
                    transport = compress(transport, progress=not quiet)
            with clock.phase("page"):
                make = make_live_page if export is None else make_page
                made = make(
                    loaded, transport, lights, kept=kept, sensor=_camera(loaded, sensor), title=file.stem
                )
        command.report = {"matrix": str(file), "notes": made.notes, "environments": list(lights)}
        command.report |= {"kept": kept}
        if _written(command, file, made.text, export, clock):
            return
        assert isinstance(made, LivePage)
        with closing(made.answers):
            _serve(command, made.text, port, browser, made.answers.reply)


def _mix(command: Command, file: Path, export: Path | None, port: int, browser: bool) -> None:
    """A light mixer of a picture with layers."""
    from mi_sparse_prt.core.profiling import Stopwatch
    from mi_sparse_prt.io.exr_layers import read_layers
    from mi_sparse_prt.relighting.viewer import make_mixer

    clock = Stopwatch()
    with command.prompt_interrupts():
        with clock.phase("load"):
            layers = read_layers(file)
        with clock.phase("page"):
            made = make_mixer(layers, file.stem)
    command.report = {"picture": str(file), "lamps": list(layers)}
    if not _written(command, file, made.text, export, clock):
        _serve(command, made.text, port, browser)


def _written(command: Command, file: Path, text: str, export: Path | None, clock: Stopwatch) -> bool:
    """Report on a page, and write it if it is to be a file; whether it was."""
    page = text.encode()
    command.report |= {"bytes": len(page), "seconds": clock.report()}
    if export is not None:
        command.write(export, page)
        command.show(relighting_table(f"{file} as a page", clock.seconds, {export: len(page)}))
    return export is not None


def _lights(scene: Scene, files: list[Path] | None) -> dict[str, Environment]:
    """Lights by name: what is asked for, else those beside the scene, else its own, a sky and a sun."""
    from mi_sparse_prt import load_environment
    from mi_sparse_prt.benchmark.relit_reference import FALLBACK, environments_of
    from mi_sparse_prt.emission.environment import environment_of

    if files:
        return {file.stem: load_environment(file) for file in files}
    found, emitter = environments_of(scene), scene.mitsuba.environment()
    if found.keys() != FALLBACK or emitter is None:
        return found
    return {"scene": environment_of(emitter)} | found


def _camera(scene: Scene, sensor: int) -> int | None:
    """The camera that was asked for; None for the first one of a scene that has none."""
    return None if sensor == 0 and not scene.mitsuba.sensors() else sensor


def _serve(command: Command, text: str, port: int, browser: bool, answer: Reply | None = None) -> None:
    """Show a page, and answer it, until Ctrl-C."""
    from mi_sparse_prt.relighting.viewer.server import PageServer

    with PageServer(text.encode(), port, answer) as server:
        typer.echo(f"{server.url}  (Ctrl-C ends it)", err=True)
        command.hint = ": the page is closed"
        if browser:
            webbrowser.open(server.url)
        server.serve_forever()
