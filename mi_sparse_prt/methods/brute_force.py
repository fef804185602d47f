"""Every element: a ray each for direct light, paths for indirect light."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm.auto import tqdm

from mi_sparse_prt.core.run import Run
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.io.checkpoint import Checkpoint
from mi_sparse_prt.measurement.vertices import Points
from mi_sparse_prt.methods.half_floats import overflows
from mi_sparse_prt.methods.result import MethodResult
from mi_sparse_prt.operators.mean_cosine import MeanCosine
from mi_sparse_prt.operators.upsampled import Upsampled
from mi_sparse_prt.operators.visibility import Visibility
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.paths import PathSolver


def exact_direct(solver: DirectSolver, run: Run) -> MethodResult:
    """All direct light, phase ``direct``: bits, or in the texel basis the mean cosines of the solver's strata."""
    with run.clock.phase("direct"):
        stored = solver.row_storage(len(solver.points))
        _trace(solver, stored, solver.rows, run.bar(len(stored), "direct"))
    if solver.basis == "direction":
        part: Visibility | MeanCosine = Visibility(
            stored.astype(np.uint32, copy=False), solver.points.normals, solver.lighting
        )
    else:
        part = MeanCosine(stored.astype(np.uint16, copy=False), solver.lighting)
    elements = len(solver.points) * solver.lighting.n_directions
    rays = int(share_above_horizon(solver.points, solver.lighting) * elements) * solver.rays_per_element
    return MethodResult(part, None, elements, {"direct": elements, "indirect": 0}, {"direct": rays})


def path_traced(solver: PathSolver, lighting: CubemapLighting, run: Run) -> Upsampled:
    """All indirect light, phase ``indirect``, at the resolution of the solver.

    Parameters
    ----------
    solver : PathSolver
    lighting : CubemapLighting
        To which it is interpolated.
    run : Run
    """
    with run.clock.phase("indirect"):
        shape = (len(solver.points), solver.lighting.n_directions, solver.channels)
        density, checkpoint = np.zeros(shape, dtype=np.float16), run.checkpoint()
        kept = Checkpoint(checkpoint, density) if checkpoint else None
        bar = run.bar(len(density), "indirect", done=kept.rows_done if kept else 0)
        density = _trace(solver, density, lambda ids: solver.rows(ids).mean, bar, kept)
    return Upsampled(density, lighting.upsampling(solver.lighting), lighting)


def share_above_horizon(points: Points, lighting: CubemapLighting) -> float:
    """Share of elements above the horizon, from a thousand vertices."""
    some = points.normals[:: max(1, len(points) // 1000)]
    return float((some @ lighting.directions.T > 0).mean())


def _trace(
    solver: DirectSolver | PathSolver,
    stored: NDArray[Any],
    rows: Callable[[NDArray[np.uint32]], NDArray[Any]],
    bar: tqdm,
    kept: Checkpoint | None = None,
) -> NDArray[Any]:
    """Fill an array with all rows of a solver, one wavefront at a time; half floats become wider if they overflow."""
    with bar:
        for a in range(kept.rows_done if kept else 0, len(stored), solver.block_size):
            ids = np.arange(a, min(a + solver.block_size, len(stored)), dtype=np.uint32)
            found = rows(ids)
            if stored.dtype == np.float16 and overflows(found):
                stored = stored.astype(np.float32)
                if kept:  # its rows are half floats; the rest is not kept
                    kept.remove()
                    kept = None
            stored[a : a + len(ids)] = found
            if kept:
                kept.append(stored[a : a + len(ids)])
            bar.update(len(ids))
    if kept:
        kept.remove()
    return stored
