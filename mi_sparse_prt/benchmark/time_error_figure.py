"""Error against time in logarithmic scales, a point for every method, a line of slope -1/2 for brute force."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from mi_sparse_prt.validation.matrix_figures import panels

MARKERS, COLOURS = "sDv^<>Ph", ("C0", "C1", "C2", "C4", "C5", "C6", "C8", "C9")  # red is for "auto"
DEVIATIONS = 2  # standard errors that bars show
FARTHER = 1.5  # lines go on until they are this factor below the best method


Shown = list[Artist | ErrorbarContainer]  # what the legend names


class _Solver(NamedTuple):
    """How a solver is drawn whose error is noise: its entry of the report, colour, label, and what it has more of."""

    key: str
    colour: str
    label: str
    effort: str


SOLVERS = (
    _Solver("brute_force", "black", "brute force", "paths"),
    _Solver("adjoint", "0.5", "adjoint rows", "samples"),
)


def time_error_figures(report: dict[str, Any]) -> dict[str, Figure]:
    """``time_against_error``, and one for each mesh where there are several."""
    meshes = list(report["reference_noise"]["meshes"])
    each = {f"time_against_error_{mesh}": time_error_figure(report, mesh) for mesh in meshes}
    return {"time_against_error": time_error_figure(report)} | (each if len(meshes) > 1 else {})


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
    figure, axes = panels(12, 6)
    axes.set(xscale="log", yscale="log")
    methods, noise, bare = report["methods"], report["reference_noise"], report["bare_rays"]
    errors = [_error(point, mesh)[0] for point in methods.values()]
    least = min((error for error in errors if error > 0), default=np.inf) / FARTHER
    shown: Shown = []
    for solver in SOLVERS:
        shown += _noisy(axes, solver, report, mesh, least)
    rays = f"bare occlusion rays of the matrix: {bare['seconds']:.3g} s"
    shown += [
        *_methods(axes, methods, mesh),
        *_targets(axes, methods, mesh),
        *_floor(axes, noise["total"] if mesh is None else noise["meshes"][mesh]),
        axes.axvline(bare["seconds"], color="tab:cyan", linestyle=":", label=rays),
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


def _noisy(axes: Axes, solver: _Solver, report: dict[str, Any], mesh: str | None, least: float) -> Shown:
    """The line of a solver whose error is noise: as far as it was measured, and beyond until ``least``."""
    points, direct_seconds = report[solver.key], report["bare_rays"]["direct_seconds"]
    seconds = np.array([point["seconds"] for point in points])
    errors, deviations = np.array([_error(point, mesh) for point in points]).T
    efforts = ", ".join(str(point["spp"]) for point in points)
    style: dict[str, Any] = {"fmt": "o-", "color": solver.colour, "capsize": 3}
    label = f"{solver.label}, {efforts} {solver.effort} per element"
    shown: Shown = [axes.errorbar(seconds, 100 * errors, 100 * DEVIATIONS * deviations, **style, label=label)]
    if errors[-1] > least:
        factor = np.geomspace(1, (errors[-1] / least) ** 2, 50)
        beyond = direct_seconds + (seconds[-1] - direct_seconds) * factor, 100 * errors[-1] / np.sqrt(factor)
        label = f"  extrapolated as 1 / sqrt({solver.effort})"
        shown += axes.plot(*beyond, "--", color=solver.colour, label=label)
    return shown


def _methods(axes: Axes, methods: dict[str, Any], mesh: str | None) -> Shown:
    """A point for every method that has no target."""
    shown: Shown = []
    for k, point in enumerate(p for p in methods.values() if "target_error" not in p):
        marker, colour = MARKERS[k % len(MARKERS)], COLOURS[k % len(COLOURS)]
        shown += _point(axes, point, mesh, point["label"], marker, colour)
    return shown


def _targets(axes: Axes, methods: dict[str, Any], mesh: str | None) -> Shown:
    """The line of ``"auto"``, a star for every target."""
    points = [point for point in methods.values() if "target_error" in point]
    seconds = [point["without_held_out"]["seconds"] for point in points]
    axes.plot(seconds, [100 * _error(point, mesh)[0] for point in points], color="tab:red", linewidth=1)
    shown: Shown = []
    for point in points:
        shown += _point(axes, point, mesh, f"auto, target {point['target_error']:.1%}", "*", "tab:red")
    return shown


def _point(
    axes: Axes, point: dict[str, Any], mesh: str | None, label: str, marker: str, colour: str
) -> Shown:
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
    style: dict[str, Any] = {"fmt": marker, "color": colour, "markersize": 8, "capsize": 3}
    return [axes.errorbar(own["seconds"], 100 * error, spread, **style, label=text)]


def _floor(axes: Axes, noise: float) -> Shown:
    """Where the reference's own noise is as large as what is measured: its mean is taken out, its spread is not."""
    bottom, top = axes.get_ylim()
    if noise <= 0:
        return []
    bottom = min(bottom, 50 * noise)
    axes.set_ylim(bottom, top)
    label = f"noise of the reference: {noise:.2%}"
    return [axes.axhspan(bottom, 100 * noise, color="0.88", zorder=0, label=label)]
