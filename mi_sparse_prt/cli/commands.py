"""The commands and their options; each is a few lines around one function of the package."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

import mi_sparse_prt as prt
from mi_sparse_prt.cli.files import image_bytes, npy_bytes, ply_bytes
from mi_sparse_prt.cli.running import check_folder, running
from mi_sparse_prt.cli.tables import (
    benchmark_tables,
    choices_tables,
    cpca_tables,
    files_table,
    glossy_images_table,
    glossy_matrix_tables,
    glossy_tables,
    matrix_tables,
    methods_tables,
    plan_tables,
    plans_tables,
    relighting_table,
    scene_report,
    scene_tables,
    sizes_tables,
    time_error_tables,
    validation_table,
)
from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.core.profiling import Stopwatch
from mi_sparse_prt.core.variant import VARIANTS
from mi_sparse_prt.validation.glossy_images import GlossyValidation, validate_glossy
from mi_sparse_prt.validation.validate import Validation

AnyTransport = prt.LightTransport

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_show_locals=False,
    help="Precomputed light transport for Mitsuba 3 scenes: compute a matrix once, relight the scene at once.",
    epilog="Start with: mi-sparse-prt precompute SCENE.xml -o SCENE.prt",
)


class Basis(StrEnum):
    """How light arrives from a texel of the lighting."""

    direction = "direction"
    texel = "texel"


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


def _check_suffix(path: Path | None, suffixes: tuple[str, ...], option: str) -> None:
    if path is not None and path.suffix.lower() not in suffixes:
        raise typer.BadParameter(
            f"{path}: give a name that ends in {' or '.join(suffixes)}", param_hint=option
        )


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
Resolution = Annotated[
    int, typer.Option(help="Texels along an edge of the lighting's cubemap, a power of two.")
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


DEFAULT_RESOLUTION = 32  # texels along an edge of a face


class Method(StrEnum):
    """Which elements are evaluated."""

    auto = "auto"
    brute_force = "brute_force"
    sparse = "sparse"
    huang2010 = "huang2010"
    gather = "gather"


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
    resolution: Resolution = DEFAULT_RESOLUTION,
    method: Annotated[
        Method,
        typer.Option(
            help="What is quickest for the target error, by a pilot on a few hundred vertices (auto); or every "
            "element, few of them (sparse), few as in the paper (huang2010), or all direct light, and "
            "interreflections by finite elements (gather)."
        ),
    ] = Method.auto,
    basis: Annotated[
        Basis, typer.Option(help="Light from a texel's centre alone, or from its whole area.")
    ] = Basis.direction,
    max_depth: Annotated[
        int,
        typer.Option(
            help="As Mitsuba's path: 2 is direct light only, 5 three interreflections, -1 no limit."
        ),
    ] = 5,
    spp: Annotated[
        int | None,
        typer.Option(
            help="Paths per element of the indirect light, where there are any; auto then chooses no other number.",
            show_default="16, or what the target error needs",
        ),
    ] = None,
    indirect_resolution: Annotated[
        int | None,
        typer.Option(
            help="Texels along an edge of the indirect light's cubemap, where it is path traced: its cost grows "
            "with the square. The report says what a coarse one costs in error. auto then chooses no other one.",
            show_default="brute_force: 8, or the resolution",
        ),
    ] = None,
    target_error: Annotated[
        float | None,
        typer.Option(
            metavar="ERROR",
            help="Relative L2 error of the matrix to aim at, 0.02 for 2%. Elements held out say whether it was met; "
            "if not, auto, sparse and gather try again, finer. brute_force chooses --spp and "
            "--indirect-resolution for it.",
            show_default="auto: 0.02, and one try",
        ),
    ] = None,
    terms: Annotated[
        int | None,
        typer.Option(
            help="For glossy BSDFs: factors of each, 4 in [HR10]; images then depend on the view. Without, all "
            "surfaces count as diffuse.",
            show_default=False,
        ),
    ] = None,
    explain: Annotated[
        bool,
        typer.Option("--explain", help="Show all plans that auto compared, with predicted time and error."),
    ] = False,
    strata: Annotated[
        int, typer.Option(help="With --basis texel: shadow rays per element are the square of this.")
    ] = 2,
    edge_length: EdgeLength = None,
    seed: Annotated[int, typer.Option(help="The same seed gives the same matrix.")] = 0,
    checkpoint: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="Keep finished rows of the indirect light there: the same command after an interruption goes on.",
            show_default=False,
        ),
    ] = None,
    define: Define = None,
    variant: Variant = None,
    json_file: JsonFile = None,
    quiet: Quiet = False,
) -> None:
    """Compute the light transport matrix of a scene and write it to a file.

    Example: mi-sparse-prt precompute scenes_xml/bunny.xml -o bunny.prt

    A forecast of time and memory comes first; a table of what was done, skipped and how good it is comes last.
    Direct light only, in seconds: add --max-depth 2. Why it was done so: add --explain. Glossy surfaces: add --terms 4.
    """
    asked = {
        "--method": method is not Method.auto,
        "--basis": basis is not Basis.direction,
        "--spp": spp is not None,
        "--indirect-resolution": indirect_resolution is not None,
        "--target-error": target_error is not None,
        "--explain": explain,
        "--checkpoint": checkpoint is not None,
    }
    if terms is not None and any(asked.values()):
        names = ", ".join(name for name, given in asked.items() if given)
        raise typer.BadParameter(f"{names} has no meaning with it: leave one out", param_hint="--terms")
    with running(json_file, quiet, outputs=[output]) as command:
        parameters = _definitions(define)
        loaded = prt.load_scene(scene, edge_length, **parameters)
        if checkpoint is not None:
            check_folder(checkpoint)
            command.hint = f"; finished rows are in {checkpoint}, the same command goes on with them"
        coarse = indirect_resolution
        if coarse is None and method is Method.brute_force and target_error is None:
            coarse = min(8, resolution)
        transport: AnyTransport
        with command.prompt_interrupts():
            if terms is not None:
                transport = prt.precompute_glossy(
                    loaded,
                    prt.CubemapLighting(resolution),
                    terms,
                    max_depth=max_depth,
                    seed=seed,
                    progress=not quiet,
                )
            else:
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
                    indirect_resolution=coarse,
                    strata=strata,
                    checkpoint_folder=checkpoint,
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
        command.show(*_tables(transport, output, explain))


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
    with running(json_file, quiet, outputs=[output, vertices]) as command:
        clock = Stopwatch()
        report: dict[str, Any] = {"matrix": str(matrix), "rotation_degrees": rotate}
        files: dict[Path, bytes] = {}
        with command.prompt_interrupts():
            with clock.phase("load"):
                light = prt.load_environment(environment).rotated(rotate)
                transport = prt.load_transport(matrix)
                loaded, transport = _scene_of(transport, matrix, scene, _definitions(define))
            report["environment"] = light.report
            if vertices is not None and transport.terms:
                raise PrtError(
                    f"{matrix} has glossy surfaces, whose light depends on the view: give -o instead"
                )
            if isinstance(transport, prt.LightTransport):
                with clock.phase("relight"):
                    radiance = transport.relight(light)  # [vertex, rgb]
            if vertices is not None:
                npy = vertices.suffix.lower() == ".npy"
                files[vertices] = npy_bytes(radiance) if npy else ply_bytes(loaded, radiance)
                report["vertices"] = {"path": str(vertices), "mean": radiance.mean(axis=0).tolist()}
            if output is not None:
                with clock.phase("render"):
                    # [row, column, rgb]
                    image = prt.render(loaded, transport, light, sensor, spp, progress=not quiet)
                files[output] = image_bytes(image, output.suffix.lower(), exposure)
                report["image"] = {"path": str(output), "mean": image.mean(axis=(0, 1)).tolist()}
        for path, content in files.items():
            command.write(path, content)
        command.report = report | {"seconds": clock.report()}
        command.show(
            relighting_table(
                f"{matrix} under {environment}, turned by {rotate:g} degrees", clock.seconds, files
            )
        )


@app.command()
def validate(
    scene: SceneFile,
    matrix: MatrixFile,
    rows: Annotated[int, typer.Option(help="Vertices to compare at, drawn from every mesh.")] = 64,
    columns: Annotated[int, typer.Option(help="Texels to compare at: one render each.")] = 256,
    spp: Annotated[int, typer.Option(help="Samples per element of Mitsuba's render.")] = 1024,
    image_spp: Annotated[int, typer.Option(help="Samples per pixel of the image's reference.")] = 256,
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

    Errors are relative L2; the reference's own noise is measured, reported beside them and not counted. Of a matrix
    with glossy surfaces, images from three cameras are compared, and errors split into their causes.
    """
    with running(json_file, quiet) as command:
        if output is not None:
            check_folder(output)
        transport = prt.load_transport(matrix)
        loaded, transport = _scene_of(transport, matrix, scene, _definitions(define))
        result: Validation | GlossyValidation
        with command.prompt_interrupts():
            if transport.terms:
                result = validate_glossy(loaded, transport, spp=image_spp, seed=seed, progress=not quiet)
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
    with running(json_file, quiet=False) as command:
        if file.suffix.lower() == ".xml":
            scene = prt.load_scene(file, edge_length, **_definitions(define))
            command.report = scene_report(scene)
            command.show(*scene_tables(scene))
        else:
            transport = prt.load_transport(file)
            command.report = transport.report | {"file": {"path": str(file), "bytes": file.stat().st_size}}
            command.show(*_tables(transport, file))


@app.command()
def benchmark(
    scene: SceneFile,
    resolution: Resolution = DEFAULT_RESOLUTION,
    repeats: Annotated[
        int, typer.Option(help="Timed repeats of every part, 3 at least; medians are reported.")
    ] = 3,
    method: Annotated[
        list[Method] | None,
        typer.Option(
            help="Measure time and error of a method against brute force instead; may be repeated.",
            show_default=False,
        ),
    ] = None,
    choices: Annotated[
        bool,
        typer.Option(
            "--choices",
            help="Compare choices of rows and columns, and radii of neighbours, on every mesh instead.",
        ),
    ] = False,
    time_error: Annotated[
        bool,
        typer.Option("--time-error", help="Run every method instead, and compare time and error of all."),
    ] = False,
    plans: Annotated[
        bool,
        typer.Option(
            "--plans", help='Compare what method "auto" chooses with the other plans, carried out, instead.'
        ),
    ] = False,
    sizes: Annotated[
        bool,
        typer.Option(
            "--sizes", help="Measure cost at 10,000 to 500,000 vertices and resolutions of 8 to 64 instead."
        ),
    ] = False,
    cpca: Annotated[
        bool,
        typer.Option("--cpca", help="Compare clustered PCA in two passes with the standard one instead."),
    ] = False,
    glossy: Annotated[
        bool,
        typer.Option("--glossy", help="Measure view-dependent transport of glossy surfaces instead."),
    ] = False,
    figures: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="Draw what --method, --choices, --time-error, --sizes, --cpca or --glossy measures: PNG files there.",
            show_default=False,
        ),
    ] = None,
    edge_length: EdgeLength = None,
    define: Define = None,
    variant: Variant = None,
    json_file: JsonFile = None,
    quiet: Quiet = False,
) -> None:
    """Measure speed and memory on this machine: the direct matrix against bare rays, paths, relighting.

    Example: mi-sparse-prt benchmark scenes_xml/bunny.xml --json benchmark.json

    With --method sparse --method huang2010 --figures FOLDER: what the paper's tables and figures show, for a scene.
    With --choices --figures FOLDER: its Figures 5 and 6. With --time-error --figures FOLDER: all methods on one plot.
    With --plans: how well method "auto" chooses. With --sizes --figures FOLDER: how cost grows.
    With --cpca --figures FOLDER: compression, the paper's Figure 11. With --glossy --figures FOLDER: view-dependent
    images, its Figures 17 to 19.

    Ratios come from one run in which both sides alternate. Leave the machine alone meanwhile.
    """
    from mi_sparse_prt import benchmark as benchmarks

    asked = {
        "--method": bool(method),
        "--choices": choices,
        "--time-error": time_error,
        "--plans": plans,
        "--sizes": sizes,
        "--cpca": cpca,
        "--glossy": glossy,
    }
    which = [name for name, given in asked.items() if given]
    if len(which) > 1:
        raise typer.BadParameter("one at a time", param_hint=" / ".join(which))
    if figures is not None and which in ([], ["--plans"]):
        others = ", ".join(name for name in asked if name != "--plans")
        raise typer.BadParameter(f"there are figures of {others} only", param_hint="--figures")
    if sizes and (edge_length is not None or resolution != DEFAULT_RESOLUTION):
        raise typer.BadParameter("it varies --edge-length and --resolution itself", param_hint="--sizes")
    with running(json_file, quiet) as command:
        if figures is not None:
            check_folder(figures)
        parameters, progress = _definitions(define), not quiet
        with command.prompt_interrupts():
            if sizes:
                command.report = benchmarks.cost_against_size(scene, parameters, progress, figures)
                tables = sizes_tables(command.report)
            else:
                case = prt.load_scene(scene, edge_length, **parameters), prt.CubemapLighting(resolution)
                names = [m.value for m in method or ()]
                drawn = {} if figures is None else {"figures": figures}
                kinds: dict[str, tuple[Callable[..., dict[str, Any]], Callable[..., list[Any]]]] = {
                    "": (partial(benchmarks.run_benchmark, repeats=repeats), benchmark_tables),
                    "--method": (partial(benchmarks.measure_methods, methods=names), methods_tables),
                    "--choices": (benchmarks.measure_choices, choices_tables),
                    "--time-error": (benchmarks.time_against_error, time_error_tables),
                    "--plans": (benchmarks.measure_plans, plans_tables),
                    "--cpca": (benchmarks.measure_cpca, cpca_tables),
                    "--glossy": (benchmarks.measure_glossy, glossy_tables),
                }
                measure, show = kinds["".join(which)]
                command.report = measure(*case, progress=progress, **drawn)
                tables = show(command.report)
        if figures is not None:
            command.written.append(figures)
        command.show(*tables)


@app.command()
def pictures(
    scenes: Annotated[
        list[Path], typer.Argument(metavar="SCENE...", help="Mitsuba scenes, XML files.", show_default=False)
    ],
    output: Annotated[
        Path,
        typer.Option("--output", "-o", metavar="FOLDER", help="PNG files go there.", show_default=False),
    ],
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
    from mi_sparse_prt import benchmark as benchmarks

    with running(json_file, quiet) as command:
        check_folder(output)
        for path in scenes:
            scene = prt.load_scene(path, edge_length, **_definitions(define))
            with command.prompt_interrupts():
                figures = benchmarks.draw_gallery(scene, prt.CubemapLighting(resolution), progress=not quiet)
            command.written += benchmarks.save_gallery(figures, output, path.stem)
        command.report = {"files": [str(path) for path in command.written]}
        command.show(files_table(command.written))


def _tables(transport: AnyTransport, file: Path, explain: bool = False) -> list[Table]:
    if transport.terms:
        return glossy_matrix_tables(transport, file)
    return [*(plan_tables(transport) if explain else []), *matrix_tables(transport, file)]


def _scene_of(
    transport: AnyTransport, matrix: Path, path: Path | None, parameters: dict[str, str]
) -> tuple[prt.Scene, AnyTransport]:
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
