"""``mi-sparse-prt benchmark``: speed, error and memory on this machine."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

import mi_sparse_prt as prt
from mi_sparse_prt.cli import options
from mi_sparse_prt.cli.running import check_folder, running

WITHOUT_FIGURES = ("", "--plans")
FROM_FILE = ("--sizes", "--many-lights")  # these load the scene themselves

Repeats = Annotated[int, typer.Option(help="Timed repeats of every part, 3 at least; medians are reported.")]
Methods = Annotated[
    list[options.Method] | None,
    typer.Option(
        help="Measure time and error of a method against brute force instead; may be repeated.",
        show_default=False,
    ),
]
Choices = Annotated[
    bool,
    typer.Option(
        "--choices",
        help="Compare choices of rows and columns, and radii of neighbours, on every mesh instead.",
    ),
]
TimeError = Annotated[
    bool, typer.Option("--time-error", help="Run every method instead, and compare time and error of all.")
]
Plans = Annotated[
    bool,
    typer.Option(
        "--plans", help='Compare what method "auto" chooses with the other plans, carried out, instead.'
    ),
]
Sizes = Annotated[
    bool,
    typer.Option(
        "--sizes", help="Measure cost at 10,000 to 500,000 vertices and resolutions of 8 to 64 instead."
    ),
]
Cpca = Annotated[
    bool, typer.Option("--cpca", help="Compare clustered PCA in two passes with the standard one instead.")
]
Glossy = Annotated[
    bool, typer.Option("--glossy", help="Measure view-dependent transport of glossy surfaces instead.")
]
Zoo = Annotated[
    bool,
    typer.Option(
        "--zoo",
        help="Render a small scene for each of Mitsuba's plugins instead, and say which come out right.",
    ),
]
Moving = Annotated[
    bool,
    typer.Option("--relight", help="Measure errors and times of frames under a light that moves instead."),
]
Pages = Annotated[
    bool,
    typer.Option("--pages", help="Measure sizes of pages for a browser against their errors instead."),
]
ManyLights = Annotated[
    bool,
    typer.Option(
        "--many-lights",
        help="Measure time and error of matrix row-column sampling and its baselines instead.",
    ),
]
Figures = Annotated[
    Path | None,
    options.file_option(
        metavar="FOLDER",
        help="Draw what --method, --choices, --time-error, --sizes, --cpca, --glossy, --zoo, --relight, --pages or "
        "--many-lights measures: PNG files there.",
    ),
]
Place = Annotated[
    Path | None,
    options.file_argument(
        "[SCENE]", "Mitsuba scene, an XML file; --zoo takes a folder of them, or none for its own."
    ),
]


def benchmark(
    scene: Place = None,
    resolution: options.Resolution = options.DEFAULT_RESOLUTION,
    repeats: Repeats = 3,
    method: Methods = None,
    choices: Choices = False,
    time_error: TimeError = False,
    plans: Plans = False,
    sizes: Sizes = False,
    cpca: Cpca = False,
    glossy: Glossy = False,
    zoo: Zoo = False,
    moving: Moving = False,
    pages: Pages = False,
    many_lights: ManyLights = False,
    figures: Figures = None,
    edge_length: options.EdgeLength = None,
    define: options.Define = None,
    variant: options.Variant = None,
    json_file: options.JsonFile = None,
    quiet: options.Quiet = False,
) -> None:
    """Measure speed and memory on this machine: the direct matrix against bare rays, paths, relighting.

    Example: mi-sparse-prt benchmark scenes_xml/bunny.xml --json benchmark.json

    With --method sparse --method huang2010 --figures FOLDER: what the paper's tables and figures show, for a scene.
    With --choices --figures FOLDER: its Figures 5 and 6. With --time-error --figures FOLDER: all methods on one plot.
    With --plans: how well method "auto" chooses. With --sizes --figures FOLDER: how cost grows.
    With --cpca --figures FOLDER: compression, the paper's Figure 11. With --glossy --figures FOLDER: view-dependent
    images, its Figures 17 to 19. With --zoo --figures FOLDER: what is compatible, beside Mitsuba's path. With --relight
    --figures FOLDER: light that moves, Figures 2 to 9 of the paper on temporal coherence. With --pages
    --figures FOLDER: what truncation costs in a browser. With --many-lights --figures FOLDER: Figures 3 to 6 and Table
    2 of the paper on row-column sampling; all lights are rendered first, which -D width=100 -D height=75 makes short.

    Ratios come from one run in which both sides alternate. Leave the machine alone meanwhile.
    """
    asked = {
        "--method": bool(method),
        "--choices": choices,
        "--time-error": time_error,
        "--plans": plans,
        "--sizes": sizes,
        "--cpca": cpca,
        "--glossy": glossy,
        "--zoo": zoo,
        "--relight": moving,
        "--pages": pages,
        "--many-lights": many_lights,
    }
    which = _only_one(asked)
    varied = edge_length is not None or resolution != options.DEFAULT_RESOLUTION or (zoo and bool(define))
    _check(which, scene, varied, figures is not None)
    with running(json_file, quiet) as command:
        if figures is not None:
            check_folder(figures)
        parameters, progress = options.definitions(define), not quiet
        with command.prompt_interrupts():
            measure, show = _measurement(which, repeats, method or [])
            if scene is None or zoo:
                command.report = measure(scene, progress, figures)
            elif which in FROM_FILE:
                command.report = measure(scene, parameters, progress, figures)
            else:
                case = prt.load_scene(scene, edge_length, **parameters), prt.CubemapLighting(resolution)
                command.report = measure(
                    *case, progress=progress, **({"figures": figures} if figures else {})
                )
        if figures is not None:
            command.written.append(figures)
        command.show(*show(command.report))


def _check(which: str, scene: Path | None, varied: bool, drawn: bool) -> None:
    """Refuse arguments that do not go with what is to be measured (typer.BadParameter).

    ``varied``: vertices, texels or values for the scene are asked for; ``drawn``: figures are.
    """
    if scene is None and which != "--zoo":
        raise typer.BadParameter("only --zoo can do without one", param_hint="SCENE")
    if drawn and which in WITHOUT_FIGURES:
        raise typer.BadParameter(f"there are none of {which or 'speed alone'}", param_hint="--figures")
    if varied and which in (*FROM_FILE, "--zoo"):
        own = "it chooses --edge-length and --resolution itself"
        raise typer.BadParameter(f"{own}, and takes no -D" if which == "--zoo" else own, param_hint=which)


def _only_one(asked: dict[str, bool]) -> str:
    """The option that says what to measure, "" if none does."""
    which = [name for name, given in asked.items() if given]
    if len(which) > 1:
        raise typer.BadParameter("one at a time", param_hint=" / ".join(which))
    return "".join(which)


def _measurement(
    which: str, repeats: int, methods: list[options.Method]
) -> tuple[Callable[..., dict[str, Any]], Callable[[dict[str, Any]], list[Table]]]:
    """What an option asks for: the function that measures it, and the tables of its report."""
    from mi_sparse_prt import benchmark as benchmarks
    from mi_sparse_prt.cli.tables import benchmark as tables
    from mi_sparse_prt.cli.tables.choices import choices_tables
    from mi_sparse_prt.cli.tables.many_lights import many_lights_tables
    from mi_sparse_prt.cli.tables.methods import methods_tables
    from mi_sparse_prt.cli.tables.moving_light import moving_light_tables
    from mi_sparse_prt.cli.tables.zoo import zoo_tables

    kinds: dict[str, tuple[Callable[..., dict[str, Any]], Callable[[dict[str, Any]], list[Table]]]] = {
        "": (partial(benchmarks.run_benchmark, repeats=repeats), tables.benchmark_tables),
        "--method": (
            partial(benchmarks.measure_methods, methods=[method.value for method in methods]),
            methods_tables,
        ),
        "--choices": (benchmarks.measure_choices, choices_tables),
        "--time-error": (benchmarks.time_against_error, tables.time_error_tables),
        "--plans": (benchmarks.measure_plans, tables.plans_tables),
        "--sizes": (benchmarks.cost_against_size, tables.sizes_tables),
        "--cpca": (benchmarks.measure_cpca, tables.cpca_tables),
        "--glossy": (benchmarks.measure_glossy, tables.glossy_tables),
        "--zoo": (benchmarks.measure_zoo, zoo_tables),
        "--relight": (benchmarks.measure_moving_light, moving_light_tables),
        "--pages": (benchmarks.measure_pages, tables.pages_tables),
        "--many-lights": (benchmarks.measure_many_lights, many_lights_tables),
    }
    return kinds[which]
