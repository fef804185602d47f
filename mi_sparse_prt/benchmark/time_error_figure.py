"""Error against time in logarithmic scales, a point for every method, a line of slope -1/2 for brute force."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

MARKERS, COLOURS = "sDv^<>Ph", ("C0", "C1", "C2", "C4", "C5", "C6", "C8", "C9")  # red is for "auto"
DEVIATIONS = 2  # standard errors that bars show
FARTHER = 1.5  # lines go on until they are this factor below the best method


def save_figures(folder: Path, report: dict[str, Any]) -> None:
    """Write ``time_against_error.png``, and one for each mesh where there are several."""
    folder.mkdir(parents=True, exist_ok=True)
    meshes = list(report["reference_noise"]["meshes"])
    for mesh in (None, *(meshes if len(meshes) > 1 else ())):
        name = "time_against_error" + (f"_{mesh}" if mesh else "")
        figure = time_error_figure(report, mesh)
        figure.savefig(folder / f"{name}.png", dpi=110, bbox_inches="tight")


def time_error_figure(report: dict[str, Any], mesh: str | None = None) -> Figure:
    """Relative L2 of the matrix against seconds.

    Parameters
    ----------
    report : dict
        Of ``time_against_error``.
    mesh : str, optional
        One mesh's error; all meshes together if not given. The time is that of the whole matrix.

    Returns
    -------
    Figure
        Solid lines were measured, dashed ones are extrapolated: error as 1 / sqrt(spp), time in proportion to it. A
        thin line to the right of a method's point ends where its own estimate of its error is done too.
    """
    figure = Figure(figsize=(12, 6), layout="constrained")
    axes = figure.subplots()
    axes.set(xscale="log", yscale="log")
    methods, noise, bare = report["methods"], report["reference_noise"], report["bare_rays"]
    errors = [_error(point, mesh)[0] for point in methods.values()]
    least = min((error for error in errors if error > 0), default=np.inf) / FARTHER
    shown = [
        *_noisy(
            axes, report["brute_force"], mesh, bare["direct_seconds"], least, "black", "brute force", "paths"
        ),
        *_noisy(
            axes, report["adjoint"], mesh, bare["direct_seconds"], least, "0.5", "adjoint rows", "samples"
        ),
        *_methods(axes, methods, mesh),
        *_targets(axes, methods, mesh),
        *_floor(axes, noise["total"] if mesh is None else noise["meshes"][mesh]),
        axes.axvline(
            bare["seconds"],
            color="tab:cyan",
            linestyle=":",
            label=f"bare occlusion rays of the matrix: {bare['seconds']:.3g} s",
        ),
    ]
    size = report["scene"]
    axes.set(
        xlabel="seconds for the whole matrix",
        ylabel="relative L2 of the matrix (%), two standard errors",
        title=f"{Path(size['path'] or 'scene').stem}, {mesh or 'all meshes'}: {size['vertices']:,} vertices, "
        f"{size['directions']} directions, {report['parameters']['max_depth'] - 2} interreflections",
    )
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(FuncFormatter(_two_or_five))
    axes.grid(which="both", alpha=0.25)
    axes.legend(handles=shown, loc="upper left", bbox_to_anchor=(1, 1), fontsize="small")
    return figure


def _two_or_five(value: float, _: int | None) -> str:
    """Numbers beside a few of the lines between powers of ten: the axis may have a single one of these."""
    return f"{value:g}" if f"{value:.0e}"[0] in "25" else ""


def _error(point: dict[str, Any], mesh: str | None) -> tuple[float, float]:
    """Relative L2 of a point, and its standard error."""
    found = point["relative_l2"]
    if mesh is None:
        return found["total"], found["standard_error"]["total"]
    return found["meshes"][mesh], found["standard_error"]["meshes"][mesh]


def _noisy(
    axes: Axes,
    points: list[dict[str, Any]],
    mesh: str | None,
    direct_seconds: float,
    least: float,
    colour: str,
    label: str,
    effort: str,
) -> list[Artist | ErrorbarContainer]:
    """The line of a solver whose error is noise: as far as it was measured, and beyond until ``least``."""
    seconds = np.array([point["seconds"] for point in points])
    errors, deviations = np.array([_error(point, mesh) for point in points]).T
    efforts = ", ".join(str(point["spp"]) for point in points)
    shown: list[Artist | ErrorbarContainer] = [
        axes.errorbar(
            seconds,
            100 * errors,
            100 * DEVIATIONS * deviations,
            fmt="o-",
            color=colour,
            capsize=3,
            label=f"{label}, {efforts} {effort} per element",
        )
    ]
    if errors[-1] > least:
        factor = np.geomspace(1, (errors[-1] / least) ** 2, 50)
        shown += axes.plot(
            direct_seconds + (seconds[-1] - direct_seconds) * factor,
            100 * errors[-1] / np.sqrt(factor),
            "--",
            color=colour,
            label=f"  extrapolated as 1 / sqrt({effort})",
        )
    return shown


def _methods(axes: Axes, methods: dict[str, Any], mesh: str | None) -> list[ErrorbarContainer]:
    """A point for every method that has no target."""
    shown = []
    for k, point in enumerate(p for p in methods.values() if "target_error" not in p):
        marker, colour = MARKERS[k % len(MARKERS)], COLOURS[k % len(COLOURS)]
        shown += _point(axes, point, mesh, point["label"], marker, colour)
    return shown


def _targets(axes: Axes, methods: dict[str, Any], mesh: str | None) -> list[ErrorbarContainer]:
    """The line of ``"auto"``, a star for every target."""
    points = [point for point in methods.values() if "target_error" in point]
    seconds = [point["without_held_out"]["seconds"] for point in points]
    axes.plot(seconds, [100 * _error(point, mesh)[0] for point in points], color="tab:red", linewidth=1)
    shown = []
    for point in points:
        label = f"auto, target {point['target_error']:.1%}"
        shown += _point(axes, point, mesh, label, "*", "tab:red")
    return shown


def _point(
    axes: Axes, point: dict[str, Any], mesh: str | None, label: str, marker: str, colour: str
) -> list[ErrorbarContainer]:
    """A method's time and error, and its ratios in the legend; nothing if a logarithm cannot show the error."""
    error, deviation = _error(point, mesh)
    if error <= 0:  # too small for the reference to tell
        return []
    own = point["without_held_out"]
    text = f"{label}\n  {own['over_bare_rays']:.1f} x the time of bare rays"
    if mesh is None and own["speed_up"] is not None:  # which is known for all meshes together
        text += f", {own['speed_up']:.3g} x the speed of brute force"
    spread = [[100 * min(DEVIATIONS * deviation, 0.9 * error)], [100 * DEVIATIONS * deviation]]
    axes.plot([own["seconds"], point["seconds"]], 2 * [100 * error], color=colour, linewidth=0.8)
    return [
        axes.errorbar(
            own["seconds"],
            100 * error,
            spread,
            fmt=marker,
            color=colour,
            markersize=8,
            capsize=3,
            label=text,
        )
    ]


def _floor(axes: Axes, noise: float) -> list[Artist]:
    """Where the reference's own noise is as large as what is measured: its mean is taken out, its spread is not."""
    bottom, top = axes.get_ylim()
    if noise <= 0:
        return []
    bottom = min(bottom, 50 * noise)
    axes.set_ylim(bottom, top)
    label = f"noise of the reference: {noise:.2%}"
    return [axes.axhspan(bottom, 100 * noise, color="0.88", zorder=0, label=label)]
