"""How many paths per second indirect elements get, in whole rows and scattered."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from mi_sparse_prt.benchmark.kernels import kernels_of
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.measurement.vertices import vertex_points
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.solvers.paths import LANES, PathSolver

MAX_DEPTH = 5
SPP = 16
_WAVEFRONTS = 1.5  # so that there is a smaller last block


def measure_paths(scene: Scene, lighting: CubemapLighting, repeats: int) -> dict[str, Any]:
    """Time path-traced elements: random whole rows, and as many elements at random vertices and texels.

    Parameters
    ----------
    scene : Scene
    lighting : CubemapLighting
    repeats : int

    Returns
    -------
    dict
        ``max_depth``, ``spp``, ``channels``, ``paths`` and ``blocks`` (of one repeat), and for each of ``rows`` and
        ``scattered``: ``paths_per_second`` (median), ``seconds`` per repeat, ``first_run_seconds`` (compilation
        included; scattered elements find the kernel of the rows) and ``kernels`` of that run.
        ``whole_matrix_seconds`` is what all rows would take.
    """
    points = vertex_points(scene)
    channels = 1 if scene.grey else 3
    solver = PathSolver(scene.normalised, lighting, points, "direction", MAX_DEPTH, SPP, channels)

    rng = np.random.default_rng(0)
    n_rows = min(len(points), max(1, round(_WAVEFRONTS * LANES / (SPP * lighting.n_directions))))
    rows = np.sort(rng.choice(len(points), n_rows, replace=False)).astype(np.uint32)
    n_elements = n_rows * lighting.n_directions
    vertices = rng.integers(len(points), size=n_elements, dtype=np.uint32)
    texels = rng.integers(lighting.n_directions, size=n_elements, dtype=np.uint32)

    ways: dict[str, Callable[[], Any]] = {
        "rows": lambda: solver.rows(rows),
        "scattered": lambda: solver.elements(vertices, texels),
    }
    report: dict[str, Any] = {
        "max_depth": MAX_DEPTH,
        "spp": SPP,
        "channels": channels,
        "paths": n_elements * SPP,
    }
    report["blocks"] = -(-n_elements * SPP // LANES)
    for name, way in ways.items():
        start = time.perf_counter()
        kernels = kernels_of(way)
        report[name] = {
            "first_run_seconds": time.perf_counter() - start,
            "kernels": kernels.report(),
            "seconds": [],
        }
    for _ in range(repeats):
        for name, way in ways.items():
            start = time.perf_counter()
            way()
            report[name]["seconds"].append(time.perf_counter() - start)
    for name in ways:
        report[name]["paths_per_second"] = n_elements * SPP / float(np.median(report[name]["seconds"]))
    whole = len(points) * lighting.n_directions * SPP
    report["whole_matrix_seconds"] = whole / report["rows"]["paths_per_second"]
    return report
