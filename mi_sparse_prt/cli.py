"""The command line: ``mi-sparse-prt precompute | relight | validate | info | benchmark``.

Every command is a few lines around one function of the package. What they share is here once: one-line errors and
warnings, an exit code, Ctrl-C, files that appear whole or not at all, tables for people and JSON for machines.
"""

from __future__ import annotations

import errno
import io
import json
import os
import sys
import tempfile
import time
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, redirect_stdout
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import mitsuba as mi
import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from tqdm.auto import tqdm

import mi_sparse_prt as prt
from mi_sparse_prt.errors import PrtError, PrtWarning
from mi_sparse_prt.variant import VARIANTS

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_show_locals=False,
    help="Precomputed light transport for Mitsuba 3 scenes: compute a matrix once, relight the scene in milliseconds.",
    epilog="Start with: mi-sparse-prt precompute SCENE.xml -o SCENE.prt",
)

FAILED, INTERRUPTED = 1, 130


class Basis(StrEnum):
    """How light arrives from a texel of the lighting."""

    direction = "direction"
    texel = "texel"


# ---------------------------------------------------------------------------------- options that commands share


def _switch_variant(name: str | None) -> str | None:
    """Start again in another Mitsuba variant: it has to be chosen before the package is imported."""
    if name is None or name == prt.variant():
        return name
    if name not in VARIANTS:
        raise typer.BadParameter(f"{name!r}; choose one of: {', '.join(VARIANTS)}")
    os.environ["MI_SPARSE_PRT_VARIANT"] = name
    os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])


def _definitions(pairs: list[str] | None) -> dict[str, str]:
    """NAME=VALUE pairs as ``load_scene`` takes them."""
    split = [pair.partition("=") for pair in pairs or []]
    for pair, (name, equals, _) in zip(pairs or [], split, strict=True):
        if not equals or not name.isidentifier() or name in ("path", "edge_length"):
            raise typer.BadParameter(
                f"{pair!r} is not NAME=VALUE with the NAME of a <default> in the scene", param_hint="-D"
            )
    return {name: value for name, _, value in split}


SceneFile = Annotated[
    Path, typer.Argument(metavar="SCENE", help="Mitsuba scene, an XML file.", show_default=False)
]
MatrixFile = Annotated[
    Path, typer.Argument(metavar="MATRIX", help="Matrix file that `precompute` wrote.", show_default=False)
]
Define = Annotated[
    list[str] | None,
    typer.Option(
        "-D", "--define", metavar="NAME=VALUE", help="Value for a <default> of the scene; may be repeated."
    ),
]
EdgeLength = Annotated[
    float | None,
    typer.Option(
        help="Longest edge of a triangle, world units; inf leaves meshes as they are.",
        show_default="diagonal of the scene / 64",
    ),
]
JsonFile = Annotated[
    str | None,
    typer.Option(
        "--json",
        metavar="FILE",
        help="Also write the report as JSON; - is standard output, and then alone there.",
    ),
]
Quiet = Annotated[
    bool, typer.Option("--quiet", "-q", help="No progress and no tables; warnings and errors stay.")
]
Variant = Annotated[
    str | None,
    typer.Option(
        envvar="MI_SPARSE_PRT_VARIANT",
        callback=_switch_variant,
        is_eager=True,
        metavar="NAME",
        help="Mitsuba variant, " + " or ".join(VARIANTS) + ".",
        show_default="cuda_ad_rgb where there is a GPU, else llvm_ad_rgb",
    ),
]


# ------------------------------------------------------------------------------------------------- the commands


@app.command()
def precompute(
    scene: SceneFile,
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE",
            help="Matrix file to write, by convention *.prt.",
            show_default=False,
        ),
    ],
    resolution: Annotated[
        int, typer.Option(help="Texels along an edge of the lighting's cubemap, a power of two.")
    ] = 32,
    basis: Annotated[
        Basis, typer.Option(help="Light from a texel's centre alone, or from its whole area.")
    ] = Basis.direction,
    max_depth: Annotated[
        int,
        typer.Option(
            help="As Mitsuba's path: 2 is direct light only, 5 three interreflections, -1 no limit."
        ),
    ] = 5,
    spp: Annotated[int, typer.Option(help="Paths per element of the indirect light.")] = 16,
    indirect_resolution: Annotated[
        int | None,
        typer.Option(
            help="Texels along an edge of the indirect light's cubemap: its cost grows with the square. "
            "The report says what a coarse one costs in error.",
            show_default="8, or the resolution",
        ),
    ] = None,
    strata: Annotated[
        int, typer.Option(help="With --basis texel: shadow rays per element are the square of this.")
    ] = 2,
    edge_length: EdgeLength = None,
    seed: Annotated[int, typer.Option(help="The same seed gives the same matrix.")] = 0,
    define: Define = None,
    variant: Variant = None,
    json_file: JsonFile = None,
    quiet: Quiet = False,
) -> None:
    """Compute the light transport matrix of a scene and write it to a file.

    Example: mi-sparse-prt precompute scenes_xml/bunny.xml -o bunny.prt

    A forecast of time and memory comes first; a table of what was done, skipped and how good it is comes last.
    Direct light only, in seconds: add --max-depth 2.
    """
    with _command(json_file, quiet, outputs=[output]) as command:
        parameters = _definitions(define)
        loaded = prt.load_scene(scene, edge_length, **parameters)
        transport = prt.precompute(
            loaded,
            prt.CubemapLighting(resolution),
            basis=basis.value,
            max_depth=max_depth,
            spp=spp,
            seed=seed,
            progress=not quiet,
            indirect_resolution=min(8, resolution) if indirect_resolution is None else indirect_resolution,
            strata=strata,
        )
        # what `relight` needs to load the same scene again
        transport.report["scene"] |= {
            "path": str(scene.absolute()),
            "parameters": parameters,
            "edge_length": None if edge_length is None else str(edge_length),
        }
        transport.save(output)
        command.written.append(output)
        command.report = transport.report | {"file": {"path": str(output), "bytes": output.stat().st_size}}
        command.show(*_matrix_tables(transport, output))


@app.command()
def relight(
    matrix: MatrixFile,
    environment: Annotated[
        Path,
        typer.Option(
            "--environment",
            "-e",
            metavar="ENV",
            help="Equirectangular HDR image: .exr, .hdr or .pfm.",
            show_default=False,
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE",
            help="Image to write: .png (sRGB) or .exr (linear).",
            show_default=False,
        ),
    ] = None,
    vertices: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Radiance of the vertices: .npy (n_v, 3), or .ply with linear colours.",
            show_default=False,
        ),
    ] = None,
    rotate: Annotated[
        float, typer.Option(metavar="DEGREES", help="Turn the environment about +y, the up axis.")
    ] = 0.0,
    exposure: Annotated[
        float, typer.Option(metavar="STOPS", help="Brighten a .png by this power of two.")
    ] = 0.0,
    sensor: Annotated[int, typer.Option(help="Which of the scene's cameras.")] = 0,
    spp: Annotated[
        int, typer.Option(help="Samples per pixel, for edges and textures: the light has no noise.")
    ] = 64,
    scene: Annotated[
        Path | None,
        typer.Option(
            metavar="SCENE", help="Mitsuba scene of the matrix.", show_default="the one it was computed for"
        ),
    ] = None,
    define: Define = None,
    variant: Variant = None,
    json_file: JsonFile = None,
    quiet: Quiet = False,
) -> None:
    """Light a scene with an environment through its matrix, and write the camera's image.

    Example: mi-sparse-prt relight bunny.prt -e scenes_xml/envmaps/city.exr --rotate 90 -o bunny.png
    """
    if output is None and vertices is None:
        raise typer.BadParameter("nothing to write: give -o IMAGE or --vertices FILE", param_hint="-o")
    _check_suffix(output, (".png", ".exr"), "-o")
    _check_suffix(vertices, (".npy", ".ply"), "--vertices")
    with _command(json_file, quiet, outputs=[output, vertices]) as command:
        clock = Seconds()
        light = prt.load_environment(environment).rotated(rotate)
        transport = prt.load_transport(matrix)
        loaded, transport = _scene_of(transport, matrix, scene, _definitions(define))
        clock.lap("load")
        radiance = transport.relight(light)  # [vertex, rgb]
        clock.lap("relight")
        files: dict[Path, bytes] = {}
        report: dict[str, Any] = {
            "matrix": str(matrix),
            "environment": light.report,
            "rotation_degrees": rotate,
        }
        if vertices is not None:
            files[vertices] = (
                _npy_bytes(radiance) if vertices.suffix.lower() == ".npy" else _ply_bytes(loaded, radiance)
            )
            report["vertices"] = {
                "path": str(vertices),
                "count": len(radiance),
                "mean": radiance.mean(axis=0).tolist(),
            }
        if output is not None:
            image = prt.render(loaded, transport, light, sensor, spp)  # [row, column, rgb]
            clock.lap("render")
            files[output] = _image_bytes(image, output.suffix.lower(), exposure)
            height, width = image.shape[:2]
            report["image"] = {
                "path": str(output),
                "width": width,
                "height": height,
                "mean": float(image.mean()),
            }
        for path, content in files.items():
            command.write(path, content)
        command.report = report | {"seconds": clock.seconds}
        table = _table(f"{matrix} under {environment}, turned by {rotate:g} degrees", "", "")
        for phase, seconds in clock.seconds.items():
            table.add_row(phase, _duration(seconds))
        for path, content in files.items():
            table.add_row(str(path), _bytes(len(content)))
        command.show(table)


@app.command()
def validate(
    scene: SceneFile,
    matrix: MatrixFile,
    rows: Annotated[int, typer.Option(help="Vertices to compare at, drawn from every mesh.")] = 64,
    columns: Annotated[int, typer.Option(help="Texels to compare at: one render each.")] = 256,
    spp: Annotated[int, typer.Option(help="Samples per element of Mitsuba's render.")] = 1024,
    seed: Annotated[int, typer.Option(help="Of the choice of elements and of the render.")] = 0,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="FOLDER",
            help="Write pictures and report.json there.",
            show_default=False,
        ),
    ] = None,
    define: Define = None,
    variant: Variant = None,
    json_file: JsonFile = None,
    quiet: Quiet = False,
) -> None:
    """Compare a matrix with Mitsuba's own render of it, and a relit image with Mitsuba's path.

    Example: mi-sparse-prt validate scenes_xml/bunny.xml bunny.prt -o bunny_validation

    Errors are relative L2; the reference's own noise is measured, reported beside them and not counted.
    """
    with _command(json_file, quiet) as command:
        if output is not None:
            _make_folder(output)
        transport = prt.load_transport(matrix)
        loaded, transport = _scene_of(transport, matrix, scene, _definitions(define))
        result = prt.validate(
            loaded, transport, n_rows=rows, n_columns=columns, spp=spp, seed=seed, progress=not quiet
        )
        command.report = result.report
        if output is not None:
            result.save(output)
            command.written.append(output)
        command.show(_validation_table(result.report, f"{matrix} against Mitsuba"))


@app.command()
def info(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="Matrix file, or scene (.xml).", show_default=False)
    ],
    edge_length: EdgeLength = None,
    define: Define = None,
    json_file: JsonFile = None,
) -> None:
    """Say what a matrix holds, how it was made and how good it is, or what a scene would give.

    Example: mi-sparse-prt info bunny.prt

    A matrix file is read whole, so this also finds a damaged one.
    """
    with _command(json_file, quiet=False) as command:
        if file.suffix.lower() == ".xml":
            scene = prt.load_scene(file, edge_length, **_definitions(define))
            command.report = _scene_report(scene)
            command.show(*_scene_tables(scene))
        else:
            transport = prt.load_transport(file)
            command.report = transport.report | {"file": {"path": str(file), "bytes": file.stat().st_size}}
            command.show(*_matrix_tables(transport, file))


@app.command()
def benchmark(
    scene: SceneFile,
    resolution: Annotated[
        int, typer.Option(help="Texels along an edge of the lighting's cubemap, a power of two.")
    ] = 32,
    repeats: Annotated[
        int, typer.Option(help="Timed repeats of every part, 3 at least; medians are reported.")
    ] = 3,
    edge_length: EdgeLength = None,
    define: Define = None,
    variant: Variant = None,
    json_file: JsonFile = None,
    quiet: Quiet = False,
) -> None:
    """Measure speed and memory on this machine: the direct matrix against bare rays, paths, relighting.

    Example: mi-sparse-prt benchmark scenes_xml/bunny.xml --json benchmark.json

    Ratios come from one run in which both sides alternate. Leave the machine alone meanwhile.
    """
    from mi_sparse_prt.benchmark import run_benchmark

    with _command(json_file, quiet) as command:
        loaded = prt.load_scene(scene, edge_length, **_definitions(define))
        command.report = run_benchmark(loaded, prt.CubemapLighting(resolution), repeats, progress=not quiet)
        command.show(*_benchmark_tables(command.report))


# ------------------------------------------------------------------------------------------- around every command


class Command:
    """What a running command has to say and has written."""

    def __init__(self, quiet: bool) -> None:
        self.report: dict[str, Any] = {}
        self.written: list[Path] = []
        self._console = Console(quiet=quiet, highlight=False)

    def show(self, *parts: Table | str) -> None:
        for part in parts:
            self._console.print(part, markup=False)

    def write(self, path: Path, content: bytes) -> None:
        """Write a file under a temporary name beside it, and rename it when it is complete.

        Raises
        ------
        PrtError
            If that fails (full disk, permissions); nothing is left behind.
        """
        temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
        try:
            temporary.write_bytes(content)
            os.replace(temporary, path)
        except OSError as error:
            raise PrtError(
                f"cannot write {path}: {_reason(error)}; free some space or choose another folder"
            ) from None
        finally:
            temporary.unlink(missing_ok=True)
        self.written.append(path)


@contextmanager
def _command(json_file: str | None, quiet: bool, outputs: Iterable[Path | None] = ()) -> Iterator[Command]:
    """Run a command's body: check its outputs first, turn trouble into one line and an exit code, write the JSON."""
    command = Command(quiet)
    to_stdout = json_file == "-"
    try:
        for path in [*outputs, None if to_stdout or json_file is None else Path(json_file)]:
            if path is not None:
                _check_writable(path)
        with _one_line_warnings(), _stdout_is_stderr() if to_stdout else _stdout_as_it_is():
            yield command
        if json_file is not None:
            text = json.dumps(command.report, indent=1)
            if to_stdout:
                print(text)
            else:
                command.write(Path(json_file), text.encode())
    except KeyboardInterrupt:
        done = ", ".join(map(str, command.written))
        _complain(f"interrupted; {done + ' was written' if done else 'nothing was written'}")
        raise typer.Exit(INTERRUPTED) from None
    except PrtError as error:
        _complain(str(error))
        raise typer.Exit(FAILED) from None
    except OSError as error:
        if error.errno == errno.EPIPE:  # a reader such as `head` has enough
            raise
        _complain(f"{error.filename}: {_reason(error)}" if error.filename else _reason(error))
        raise typer.Exit(FAILED) from None
    except MemoryError as error:
        _complain(f"out of memory ({error}); lower --resolution or --indirect-resolution")
        raise typer.Exit(FAILED) from None


@contextmanager
def _one_line_warnings() -> Iterator[None]:
    """Show the package's warnings as 'warning: ...' between progress bars."""
    with warnings.catch_warnings():
        warnings.simplefilter("always", PrtWarning)
        usual = warnings.showwarning

        def show(message: Warning | str, category: type[Warning], *rest: Any, **more: Any) -> None:
            if issubclass(category, PrtWarning):
                tqdm.write(f"warning: {message}", file=sys.stderr)
            else:
                usual(message, category, *rest, **more)

        warnings.showwarning = show
        yield


@contextmanager
def _stdout_as_it_is() -> Iterator[None]:
    yield


@contextmanager
def _stdout_is_stderr() -> Iterator[None]:
    """Send what is printed, by Mitsuba's C++ side too, to standard error."""
    sys.stdout.flush()
    kept = os.dup(1)
    os.dup2(2, 1)
    try:
        with redirect_stdout(sys.stderr):
            yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)


def _complain(message: str) -> None:
    print(f"mi-sparse-prt: {' '.join(message.split())}", file=sys.stderr)


def _reason(error: OSError) -> str:
    return error.strerror or str(error) or type(error).__name__


def _check_writable(path: Path) -> None:
    """Find out before an hour of work whether its result can be written."""
    if path.is_dir():
        raise PrtError(f"cannot write {path}: it is a folder; give a file name")
    try:
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise PrtError(
            f"cannot write {path}: {path.parent}: {_reason(error)}; choose another folder"
        ) from None


def _make_folder(path: Path) -> None:
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise PrtError(f"cannot make the folder {path}: {_reason(error)}; choose another one") from None
    _check_writable(path / "report.json")


def _check_suffix(path: Path | None, suffixes: tuple[str, ...], option: str) -> None:
    if path is not None and path.suffix.lower() not in suffixes:
        raise typer.BadParameter(
            f"{path}: give a name that ends in {' or '.join(suffixes)}", param_hint=option
        )


class Seconds:
    """Seconds between laps."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.seconds[name], self._last = now - self._last, now


# ----------------------------------------------------------------------------------------------- scenes and files


def _scene_of(
    transport: prt.LightTransport, matrix: Path, path: Path | None, parameters: dict[str, str]
) -> tuple[prt.Scene, prt.LightTransport]:
    """The scene of a matrix, loaded as ``precompute`` loaded it, and the matrix in this scene's vertex order."""
    recorded = transport.report.get("scene", {})
    if path is None:
        if not recorded.get("path"):
            raise PrtError(f"{matrix} does not say which scene it was computed for: give --scene SCENE.xml")
        path = Path(recorded["path"])
        if not path.is_file():
            raise PrtError(
                f"{matrix} was computed for {path}, which is not there any more: give --scene SCENE.xml"
            )
    edge_length = recorded.get("edge_length")
    scene = prt.load_scene(
        path,
        None if edge_length is None else float(edge_length),
        **recorded.get("parameters", {}) | parameters,
    )
    return scene, transport.for_scene(scene)


def _image_bytes(image: NDArray[np.float32], suffix: str, exposure: float) -> bytes:
    """A linear RGB image (height, width, 3) as the content of a .png (sRGB, 8 bits) or .exr file."""
    stream = mi.MemoryStream()
    if suffix == ".exr":
        mi.Bitmap(np.ascontiguousarray(image)).write(stream, mi.Bitmap.FileFormat.OpenEXR)
    else:
        bitmap = mi.Bitmap(np.ascontiguousarray(image * np.float32(2.0**exposure)))
        bitmap = bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, srgb_gamma=True)
        bitmap.write(stream, mi.Bitmap.FileFormat.PNG)
    return bytes(stream.raw_buffer())


def _npy_bytes(array: NDArray[np.float32]) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def _ply_bytes(scene: prt.Scene, radiance: NDArray[np.float32]) -> bytes:
    """All meshes in world space as one PLY whose ``vertex_color`` is the radiance, as Mitsuba's ``ply`` reads it."""
    triangles = np.concatenate([mesh.triangles + mesh.vertices.start for mesh in scene.meshes])
    mesh = mi.Mesh("relit", len(radiance), len(triangles), has_vertex_normals=True)
    mesh.add_attribute("vertex_color", 3, radiance.ravel())
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = scene.positions.ravel()
    parameters["vertex_normals"] = scene.normals.ravel()
    parameters["faces"] = triangles.ravel().astype(np.uint32)
    parameters.update()
    stream = mi.MemoryStream()
    mesh.write_ply(stream)
    return bytes(stream.raw_buffer())


def _scene_report(scene: prt.Scene) -> dict[str, Any]:
    return {
        "path": scene.path,
        "hash": scene.hash,
        "vertices": len(scene.positions),
        "meshes": {
            mesh.name: {
                "vertices": mesh.vertices.stop - mesh.vertices.start,
                "triangles": len(mesh.triangles),
            }
            for mesh in scene.meshes
        },
        "box": [scene.positions.min(axis=0).tolist(), scene.positions.max(axis=0).tolist()],
        "grey": scene.grey,
        "diffuse": scene.diffuse,
        "warnings": scene.warnings,
    }


# --------------------------------------------------------------------------------------------------------- tables


def _table(title: str, *columns: str) -> Table:
    """A table whose first column is text, the others numbers."""
    table = Table(title=title, title_justify="left", show_header=any(columns))
    for k, column in enumerate(columns):
        table.add_column(column, justify="left" if k == 0 else "right", overflow="fold")
    return table


def _matrix_tables(transport: prt.LightTransport, path: Path) -> list[Table]:
    """What was done, how long it took, how good it is, and what was skipped."""
    report = transport.report
    vertices, directions, _ = transport.shape
    done = _table(f"{path}: {vertices} vertices x {directions} directions, {transport.basis} basis", "", "")
    for name, key in (("elements", "elements_total"), ("elements evaluated", "elements_evaluated")):
        done.add_row(name, f"{report[key]:,}")
    for name, count in report["rays"].items():
        done.add_row(
            {"direct": "shadow rays", "indirect_paths": "indirect paths"}.get(name, name), f"{count:,}"
        )
    done.add_row("matrix in memory", _bytes(transport.nbytes))
    done.add_row("file", _bytes(path.stat().st_size))
    done.add_row("peak memory", _bytes(report["peak_memory_bytes"]))
    for name in ("max_depth", "spp", "indirect_resolution", "strata", "seed"):
        done.add_row(name, str(report["parameters"][name]))
    for name in ("path", "hash"):
        done.add_row(f"scene {name}", str(report["scene"][name]))
    done.add_row("versions", ", ".join(f"{name} {number}" for name, number in report["versions"].items()))

    phases = _table("Time", "phase", "time", "share")
    total = report["seconds"]["total"]
    for name, seconds in report["seconds"].items():
        if name not in ("total", "compile"):
            phases.add_row(name, _duration(seconds), f"{seconds / total:.0%}")
    phases.add_section()
    phases.add_row("total", _duration(total), "")
    phases.add_row("compile, apart", _duration(report["seconds"]["compile"]), "")
    phases.add_row("forecast", _duration(report["forecast"]["seconds"]), "")

    error = report["estimated_error"]
    quality = _table(
        "Estimated error (relative L2, from held-out elements)", "mesh", "vertices", "error", "+-"
    )
    for mesh in transport.meshes:
        estimate, deviation = error["meshes"][mesh.name], error["standard_error"]["meshes"][mesh.name]
        count = mesh.vertices.stop - mesh.vertices.start
        quality.add_row(mesh.name, f"{count:,}", _share(estimate), _share(deviation))
    quality.add_section()
    quality.add_row(
        "total", f"{vertices:,}", _share(error["total"]), _share(error["standard_error"]["total"])
    )
    tables = [done, phases, quality]
    for title, sentences in (("Skipped", report["skipped"]), ("Warnings", report["scene"]["warnings"])):
        if sentences:
            tables.append(_sentences(title, sentences))
    return tables


def _sentences(title: str, sentences: list[str]) -> Table:
    table = _table(title, "")
    for sentence in sentences:
        table.add_row(sentence)
    return table


def _scene_tables(scene: prt.Scene) -> list[Table]:
    report = _scene_report(scene)
    meshes = _table(
        f"{scene.path}: {report['vertices']:,} vertices", "mesh", "vertices", "triangles", "mean albedo"
    )
    for mesh in scene.meshes:
        sizes = report["meshes"][mesh.name]
        albedo = " ".join(f"{value:.3f}" for value in scene.albedo[mesh.vertices].mean(axis=0))
        meshes.add_row(mesh.name, f"{sizes['vertices']:,}", f"{sizes['triangles']:,}", albedo)
    facts = _table("Scene", "", "")
    low, high = report["box"]
    facts.add_row(
        "box", " to ".join("(" + ", ".join(f"{x:.4g}" for x in corner) + ")" for corner in (low, high))
    )
    facts.add_row("grey, so one channel of indirect light", "yes" if scene.grey else "no")
    facts.add_row("diffuse only", "yes" if scene.diffuse else "no")
    facts.add_row("direct matrix, 6 x 32 x 32 directions", _bytes(report["vertices"] * 6144 // 8))
    facts.add_row("hash", scene.hash)
    return [meshes, facts, *([_sentences("Warnings", scene.warnings)] if scene.warnings else [])]


def _validation_table(report: dict[str, Any], title: str) -> Table:
    table = _table(title, "relative L2 unless said otherwise", "")
    for mesh, error in report["relative_l2"]["meshes"].items():
        table.add_row(f"mesh {mesh}", _share(error))
    table.add_row("total", _share(report["relative_l2"]["total"]))
    table.add_row("Mitsuba's own noise, not counted above", _share(report["reference_noise"]))
    table.add_section()
    table.add_row("95th percentile of rows", _share(report["row_95th_percentile"]))
    row, column = report["row_worst"], report["column_worst"]
    table.add_row(f"worst row, vertex {row['vertex']}", _share(row["relative_l2"]))
    table.add_row(f"worst column, texel {column['texel']}", _share(column["relative_l2"]))
    table.add_row("direct elements that differ by over 1e-4, share", _share(report["direct_at_hits"]))
    table.add_row("Mitsuba's hit against the vertex itself", _share(report["hit_against_vertex"]))
    if "image" in report:
        table.add_section()
        image = report["image"]
        table.add_row("relit image", _share(image["relative_l2"]))
        table.add_row("its reference's noise, not counted above", _share(image["reference_noise"]))
        table.add_row("FLIP, mean", f"{image['flip']:.4f}")
    return table


def _benchmark_tables(report: dict[str, Any]) -> list[Table]:
    machine, direct, paths, relit = (report[part] for part in ("machine", "direct", "paths", "relight"))
    rays = _table(
        f"Direct matrix, {report['scene']['vertices']:,} vertices x {report['scene']['directions']} directions",
        "",
        "",
    )
    rays.add_row("matrix, bits on the host", _duration(direct["seconds"]))
    rays.add_row("the same rays and a count", _duration(direct["bare_seconds"]))
    rays.add_row("ratio", f"{direct['ratio']:.3f}")
    rays.add_row("rays above the horizon", f"{direct['rays_per_second'] / 1e6:.1f} M/s")
    rays.add_row("peak memory", _bytes(direct["peak_memory_bytes"]))
    rays.add_row(*_kernel_row(direct["kernels"], direct["blocks"]))
    rays.add_row("first run, compilation included", _duration(direct["first_run_seconds"]))

    walks = _table(
        f"Indirect light, max_depth {paths['max_depth']}, {paths['spp']} paths per element", "", ""
    )
    for name, label in (("rows", "whole rows"), ("scattered", "scattered elements")):
        walks.add_row(label, f"{paths[name]['paths_per_second'] / 1e6:.2f} M paths/s")
        walks.add_row(*_kernel_row(paths[name]["kernels"], paths["blocks"]))
        walks.add_row("first run, compilation included", _duration(paths[name]["first_run_seconds"]))
    walks.add_row("whole matrix by this", _duration(paths["whole_matrix_seconds"]))

    frames = _table("Relighting all vertices", "", "")
    frames.add_row("direct light", _duration(relit["direct"]["seconds"]))
    label = f"with indirect light, 6 x {relit['indirect_resolution']}^2, {relit['channels']} channel(s)"
    frames.add_row(label, _duration(relit["with_indirect"]["seconds"]))

    host = _table("Machine", "", "")
    host.add_row(
        "processor", f"{machine['cpu']}, {machine['cores']} cores, {machine['drjit_threads']} Dr.Jit threads"
    )
    host.add_row("load average (over the cores: disturbed)", f"{machine['load_average']:.1f}")
    host.add_row("versions", ", ".join(f"{name} {number}" for name, number in machine["versions"].items()))
    return [rays, walks, frames, host]


def _kernel_row(kernels: dict[str, Any], blocks: int) -> tuple[str, str]:
    found = ", ".join(
        f"{kernels[k]} {label}" for k, label in (("compiled", "compiled"), ("on_disk", "from disk"))
    )
    return f"kernels in {blocks} blocks", f"{kernels['distinct']} ({found})"


def _share(value: float) -> str:
    return f"{value:.2%}" if value >= 1e-3 or value == 0 else f"{value:.1e}"


def _duration(seconds: float) -> str:
    if seconds < 0.1:
        return f"{seconds * 1e3:.1f} ms"
    return f"{seconds:.2f} s" if seconds < 600 else f"{seconds / 60:.0f} min"


def _bytes(count: float) -> str:
    for unit, size in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= size:
            return f"{count / size:.1f} {unit}"
    return f"{count:.0f} B"
