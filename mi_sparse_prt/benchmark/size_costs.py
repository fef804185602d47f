"""Cost against size: seconds and memory while the same surface gets more vertices, and the lighting more texels.

Each matrix has a process of its own: memory that others have used in a process before would count as this matrix's own,
or be found ready and count as none.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import warnings
from collections.abc import Callable
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullLocator
from tqdm.auto import tqdm

from mi_sparse_prt.benchmark.measuring import report_header
from mi_sparse_prt.core.errors import PrtError, PrtWarning
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.precompute import precompute
from mi_sparse_prt.scene.loading import load_scene
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.validation.matrix_figures import panels
from mi_sparse_prt.validation.validate import save_figures

COUNTS = (10_000, 32_000, 64_000, 128_000, 256_000, 500_000)  # vertices
RESOLUTIONS = (8, 16, 32, 64)
RESOLUTION = 32  # while the vertices change
NEAR = 1.2  # a count within this factor of the one asked for will do; where all edges are alike, it may only double
TRIANGLE = 2.5  # bisection leaves triangles of about a fifth of their longest edge squared, two to a vertex
TRIES = 4  # scenes loaded in search of it
PLAIN = FuncFormatter(lambda value, _: f"{value:g}")
PARTS = {"direct": 2, "whole": 5}  # max_depth
LABELS = {"direct": "direct light alone", "whole": "whole matrix"}


def measure_costs(
    path: str, parameters: dict[str, str], edge_length: float | None, resolution: int, method: str
) -> dict[str, Any]:
    """Precompute a scene file's matrix, its direct light alone first.

    Parameters
    ----------
    path : str
    parameters : dict
        Values for the scene's ``<default>`` entries.
    edge_length : float or None
        As for ``load_scene``.
    resolution : int
        Of the lighting.
    method : str
        As for ``precompute``.

    Returns
    -------
    dict
        ``vertices``, ``resolution``, ``directions``, ``edge_length``; and for ``direct`` (no interreflections) and
        ``whole`` (three): ``seconds``, ``seconds_without_held_out``, ``peak_memory_bytes`` of the process,
        ``stored_bytes``, ``estimated_error``, and the ``plan`` that was carried out.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PrtWarning)
        scene, lighting = load_scene(path, edge_length, **parameters), CubemapLighting(resolution)
        found: dict[str, Any] = {
            "vertices": scene.n_vertices,
            "resolution": resolution,
            "directions": lighting.n_directions,
            "edge_length": edge_length,
        }
        for part, max_depth in PARTS.items():
            transport = precompute(scene, lighting, method, max_depth=max_depth, progress=False)
            report, seconds = transport.report, transport.report["seconds"]
            del transport
            found[part] = {
                "seconds": seconds["total"],
                "seconds_without_held_out": seconds["total"] - seconds["held_out"],
                "estimated_error": report["estimated_error"]["total"],
                **{name: report[name] for name in ("peak_memory_bytes", "stored_bytes", "plan")},
            }
    return found


def measure_in_own_process(**arguments: Any) -> dict[str, Any]:
    """``measure_costs`` in a new process, in this one's Mitsuba variant.

    Raises
    ------
    PrtError
        What ``measure_costs`` raises there, or if the process ends otherwise (killed because memory ran out).
    """
    done = subprocess.run(
        [sys.executable, "-c", f"from {__name__} import main; main()", json.dumps(arguments)],
        env=os.environ | {"MI_SPARSE_PRT_VARIANT": mi.variant()},
        stdout=subprocess.PIPE,
        text=True,
        check=False,
    )
    if done.returncode:
        raise PrtError(
            f"the process that measured {arguments} ended with code {done.returncode}: "
            "ask for a smaller size if memory ran out"
        )
    found: dict[str, Any] = json.loads(done.stdout)
    if "refused" in found:
        raise PrtError(found["refused"])
    return found


def main() -> None:
    """Measure what the first argument says, and print it, both in JSON."""
    with redirect_stdout(sys.stderr):
        try:
            found = measure_costs(**json.loads(sys.argv[1]))
        except PrtError as error:
            found = {"refused": str(error)}
    json.dump(found, sys.stdout)


def cost_against_size(
    path: Path | str,
    parameters: dict[str, str] | None = None,
    progress: bool = True,
    figures: Path | None = None,
    counts: tuple[int, ...] = COUNTS,
    measure: Callable[..., dict[str, Any]] = measure_in_own_process,
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
    counts : tuple of int
        Vertices, ascending.
    measure : callable
        Of one size, with the arguments of ``measure_in_own_process``.

    Returns
    -------
    dict
        JSON as it is. ``by_vertices`` at n = 32, about 10,000 to 500,000 of them, and ``by_resolution`` at the scene's
        usual size, n = 8 to 64: lists of what ``measure_costs`` returns. ``skipped``: sentences about sizes that
        were refused, for want of memory.
    """
    given = parameters or {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PrtWarning)
        header = report_header(load_scene(path, None, **given), CubemapLighting(RESOLUTION))
        edges = edge_lengths(path, given, counts)
    cases: list[tuple[str, float | None, int]] = [
        *(("by_vertices", edge, RESOLUTION) for edge in edges),
        *(("by_resolution", None, resolution) for resolution in RESOLUTIONS),
    ]
    report: dict[str, Any] = {**header, "by_vertices": [], "by_resolution": [], "skipped": []}
    for series, edge, resolution in tqdm(cases, desc="sizes", disable=not progress):
        case = {"edge_length": edge, "resolution": resolution, "method": "auto"}
        try:
            report[series].append(measure(path=str(path), parameters=given, **case))
        except PrtError as error:  # the larger ones may not fit into memory
            report["skipped"].append(f"edge length {edge}, n = {resolution}: {error}")
    if figures is not None:
        save_figures(figures, {"cost_against_size": size_figure(report)})
    return report


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
    triangles = np.concatenate([scene.positions[mesh.vertices][mesh.triangles] for mesh in scene.meshes])
    a, b, c = np.moveaxis(triangles.astype(np.float64), 1, 0)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()) / 2


def size_figure(report: dict[str, Any]) -> Figure:
    """Seconds and peak memory of ``cost_against_size``: against vertices on the left, against n on the right."""
    figure, (left, right) = panels(12, 4.6, 1, 2)
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
