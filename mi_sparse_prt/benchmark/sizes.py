"""Cost against size: seconds and memory while the same surface gets more vertices, and the lighting more texels."""

from __future__ import annotations

import math
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullLocator
from tqdm.auto import tqdm

from mi_sparse_prt.benchmark.machine import report_header
from mi_sparse_prt.benchmark.one_size import PARTS, measured_apart
from mi_sparse_prt.core.errors import PrtError, PrtWarning
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.scene.loading import load_scene
from mi_sparse_prt.scene.scene import Scene

COUNTS = (10_000, 32_000, 64_000, 128_000, 256_000, 500_000)  # vertices
RESOLUTIONS = (8, 16, 32, 64)
RESOLUTION = 32  # while the vertices change
NEAR = 1.2  # a count within this factor of the one asked for will do; where all edges are alike, it may only double
TRIANGLE = 2.5  # bisection leaves triangles of about a fifth of their longest edge squared, two to a vertex
TRIES = 4  # scenes loaded in search of it
PLAIN = FuncFormatter(lambda value, _: f"{value:g}")
LABELS = {"direct": "direct light alone", "whole": "whole matrix"}


def cost_against_size(
    path: Path | str,
    parameters: dict[str, str] | None = None,
    progress: bool = True,
    figures: Path | None = None,
) -> dict[str, Any]:
    """Measure ``method="auto"`` on a scene file at several sizes, each in a process of its own.

    Parameters
    ----------
    path : path
        Scene file. Its meshes are subdivided for more vertices; they are never simplified, so that the smallest size is
        the file's own if that is above 10,000.
    parameters : dict, optional
        Values for the scene's ``<default>`` entries.
    progress : bool
    figures : path, optional
        Folder for ``cost_against_size.png``, made if needed.

    Returns
    -------
    dict
        JSON as it is. ``by_vertices`` at n = 32, about 10,000 to 500,000 of them, and ``by_resolution`` at the scene's
        usual size, n = 8 to 64: lists of what ``one_size.measure`` returns. ``skipped``: sentences about sizes that
        were refused, for want of memory.
    """
    given = parameters or {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PrtWarning)
        header = report_header(load_scene(path, None, **given), CubemapLighting(RESOLUTION))
        edges = edge_lengths(path, given, COUNTS)
    cases: list[tuple[str, float | None, int]] = [
        *(("by_vertices", edge, RESOLUTION) for edge in edges),
        *(("by_resolution", None, resolution) for resolution in RESOLUTIONS),
    ]
    report: dict[str, Any] = {**header, "by_vertices": [], "by_resolution": [], "skipped": []}
    for series, edge, resolution in tqdm(cases, desc="sizes", disable=not progress):
        _measure(report, series, path, given, edge, resolution)
    if figures is not None:
        figures.mkdir(parents=True, exist_ok=True)
        size_figure(report).savefig(figures / "cost_against_size.png", dpi=110, bbox_inches="tight")
    return report


def _measure(
    report: dict[str, Any],
    series: str,
    path: Path | str,
    parameters: dict[str, str],
    edge: float | None,
    resolution: int,
) -> None:
    """Add one size to a series of the report, or why it was refused."""
    try:
        found = measured_apart(
            path=str(path),
            parameters=parameters,
            edge_length=edge,
            resolution=resolution,
            method="auto",
        )
    except PrtError as error:  # the larger ones may not fit into memory
        report["skipped"].append(f"edge length {edge}, n = {resolution}: {error}")
        return
    report[series].append(found)


def edge_lengths(path: Path | str, parameters: dict[str, str], counts: tuple[int, ...]) -> list[float]:
    """Edge lengths at which a scene has about so many vertices.

    Parameters
    ----------
    path, parameters
        As for ``cost_against_size``.
    counts : tuple of int
        Ascending. Those below what the file itself has are left out, and the file's own size takes their place.

    Returns
    -------
    list of float
        World units; inf for the file as it is. Of a few that were tried, those whose count is nearest.
    """
    own = load_scene(path, math.inf, **parameters)
    found = [math.inf] if own.n_vertices > counts[0] else []
    for count in counts:
        if count > NEAR * own.n_vertices:
            found.append(_edge_length(path, parameters, count, math.sqrt(TRIANGLE * _area(own) / count)))
    return found


def _edge_length(path: Path | str, parameters: dict[str, str], count: int, edge: float) -> float:
    """The best of a few edge lengths, from a first one."""
    tried: list[tuple[float, float]] = []  # how far away in logarithms, edge length
    while len(tried) < TRIES:
        n = load_scene(path, edge, **parameters).n_vertices
        tried.append((abs(math.log(n / count)), edge))
        if tried[-1][0] <= math.log(NEAR):
            break
        edge *= math.sqrt(n / count)
    return min(tried)[1]


def _area(scene: Scene) -> float:
    """Of all triangles, world units."""
    total = 0.0
    for mesh in scene.meshes:
        a, b, c = np.moveaxis(scene.positions[mesh.vertices][mesh.triangles].astype(np.float64), 1, 0)
        total += float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()) / 2
    return total


def size_figure(report: dict[str, Any]) -> Figure:
    """Seconds and peak memory of ``cost_against_size``: against vertices on the left, against n on the right."""
    figure = Figure(figsize=(12, 4.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    _panel(left, report["by_vertices"], "vertices", "vertices")
    _panel(right, report["by_resolution"], "resolution", "n, of 6 n x n directions")
    figure.suptitle(f"{Path(report['scene']['path']).stem}: cost of the matrix against its size")
    return figure


def _panel(axes: Axes, points: list[dict[str, Any]], size: str, label: str) -> None:
    """Time with solid lines on the left axis, memory with dashed ones on the right."""
    memory = axes.twinx()
    x = [point[size] for point in points]
    for k, part in enumerate(PARTS):
        seconds = [point[part]["seconds"] for point in points]
        gigabytes = [point[part]["peak_memory_bytes"] / 1e9 for point in points]
        axes.plot(x, seconds, "o-", color=f"C{k}", label=f"{LABELS[part]}: seconds")
        memory.plot(x, gigabytes, "s--", color=f"C{k}", markersize=4)
        axes.plot([], [], "s--", color=f"C{k}", markersize=4, label=f"{LABELS[part]}: peak memory")
    axes.set(xscale="log", yscale="log", xlabel=label, ylabel="seconds (solid)")
    memory.set(yscale="log", ylabel="GB (dashed)")
    axes.set_xticks(x, [f"{value:,}" for value in x], rotation=30)
    axes.xaxis.set_minor_locator(NullLocator())
    for axis in (axes.yaxis, memory.yaxis):
        axis.set_major_formatter(PLAIN)
        axis.set_minor_formatter(PLAIN)
        axis.set_tick_params(which="minor", labelsize="x-small")
    axes.grid(which="both", alpha=0.25)
    axes.legend(fontsize="small")
