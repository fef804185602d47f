"""Speed of the parts: the direct matrix against bare rays, indirect paths, and the product with a lighting."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm.auto import tqdm

from mi_sparse_prt.benchmark.direct_speed import measure_direct
from mi_sparse_prt.benchmark.kernels import launched_kernels
from mi_sparse_prt.benchmark.measuring import report_header, timed
from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.methods.execution import matrix_of
from mi_sparse_prt.methods.result import MethodResult
from mi_sparse_prt.operators.upsampled import Upsampled
from mi_sparse_prt.operators.visibility import Visibility
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.solvers.paths import LANES, PathSolver
from mi_sparse_prt.solvers.problem import diffuse_problem

FEWEST_REPEATS = 3
MAX_DEPTH, SPP = 5, 16  # of paths
WAVEFRONTS = 1.5  # so that there is a smaller last block
INDIRECT_RESOLUTION = 8  # of the matrix that is relit


def run_benchmark(
    scene: Scene, lighting: CubemapLighting, repeats: int = 3, progress: bool = True
) -> dict[str, Any]:
    """Measure the direct matrix, indirect paths and relighting of a scene.

    Parameters
    ----------
    scene : Scene
    lighting : CubemapLighting
    repeats : int
        Timed repeats of each part, after an untimed one that compiles; at least 3. Medians are reported.
    progress : bool
        Show a bar.

    Returns
    -------
    dict
        ``machine``, ``scene``, ``repeats``, and one entry per part: ``direct`` (see ``measure_direct``), ``paths``
        (``measure_paths``), ``relight`` (``measure_relighting``). JSON as it is.

    Raises
    ------
    PrtError
        If there are fewer repeats than a median needs.
    """
    if repeats < FEWEST_REPEATS:
        raise PrtError(f"{repeats} repeats are too few for a median; use at least {FEWEST_REPEATS}")
    with tqdm(total=3, desc="benchmark", unit=" parts", disable=not progress) as bar:
        direct, bits = measure_direct(scene, lighting, repeats)
        bar.update()
        paths = measure_paths(scene, lighting, repeats)
        bar.update()
        relight = measure_relighting(scene, lighting, bits, repeats)
        bar.update()
    parts = {"direct": direct, "paths": paths, "relight": relight}
    return {**report_header(scene, lighting), "repeats": repeats, **parts}


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
    problem = diffuse_problem(scene, lighting, MAX_DEPTH)
    points, solver = problem.points, PathSolver(problem, SPP)
    rng = np.random.default_rng(0)
    n_rows = min(len(points), max(1, round(WAVEFRONTS * LANES / (SPP * lighting.n_directions))))
    rows = np.sort(rng.choice(len(points), n_rows, replace=False)).astype(np.uint32)
    n_elements = n_rows * lighting.n_directions
    vertices = rng.integers(len(points), size=n_elements, dtype=np.uint32)
    texels = rng.integers(lighting.n_directions, size=n_elements, dtype=np.uint32)
    ways: dict[str, Callable[[], Any]] = {
        "rows": lambda: solver.rows(rows),
        "scattered": lambda: solver.elements(vertices, texels),
    }
    paths = n_elements * SPP
    report: dict[str, Any] = {"max_depth": MAX_DEPTH, "spp": SPP, "channels": solver.channels, "paths": paths}
    report["blocks"] = -(-paths // LANES)
    for name, way in ways.items():
        first, kernels = timed(launched_kernels, way)
        report[name] = {"first_run_seconds": first, "kernels": kernels.report(), "seconds": []}
    for _ in range(repeats):
        for name, way in ways.items():
            report[name]["seconds"].append(timed(way)[0])
    for name in ways:
        report[name]["paths_per_second"] = paths / float(np.median(report[name]["seconds"]))
    whole = len(points) * lighting.n_directions * SPP
    report["whole_matrix_seconds"] = whole / report["rows"]["paths_per_second"]
    return report


def measure_relighting(
    scene: Scene, lighting: CubemapLighting, bits: NDArray[np.uint32], repeats: int
) -> dict[str, Any]:
    """Time the product B = T L with a lighting that was projected already, without and with an indirect part.

    The time of a product does not depend on the numbers in it, so the indirect part is random.

    Parameters
    ----------
    scene : Scene
    lighting : CubemapLighting
    bits : (n_v, ceil(n_directions / 32)) uint32
        The direct matrix.
    repeats : int

    Returns
    -------
    dict
        For ``direct`` and ``with_indirect``: ``seconds`` (median), ``first_run_seconds`` (compilation by numba
        included, where its cache is empty), ``matrix_bytes``. ``indirect_resolution`` and ``channels``.
    """
    rng = np.random.default_rng(0)
    coarse = CubemapLighting(min(INDIRECT_RESOLUTION, lighting.resolution))
    channels = 1 if scene.grey else 3
    density = np.empty((len(bits), coarse.n_directions, channels), dtype=np.float16)
    for row in density:
        row[:] = rng.random(row.shape, dtype=np.float32)
    radiance = rng.random((lighting.n_directions, 3), dtype=np.float32)
    problem, seen = diffuse_problem(scene, lighting), Visibility(bits, scene.normals, lighting)
    interreflected = Upsampled(density, lighting.upsampling(coarse), lighting)
    direct, both = (
        matrix_of(problem, MethodResult(seen, more, 0, {}, {})) for more in (None, interreflected)
    )
    report: dict[str, Any] = {"indirect_resolution": coarse.resolution, "channels": channels}
    for name, transport in (("direct", direct), ("with_indirect", both)):
        seconds = [timed(transport.relight, radiance)[0] for _ in range(1 + repeats)]
        report[name] = {
            "seconds": float(np.median(seconds[1:])),
            "first_run_seconds": seconds[0],
            "matrix_bytes": transport.nbytes,
        }
    return report
