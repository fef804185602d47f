"""The brute-force direct matrix against a loop that traces the same rays and does nothing else."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.benchmark.kernels import launched_kernels
from mi_sparse_prt.benchmark.measuring import timed
from mi_sparse_prt.core.profiling import peak_memory, reset_peak_memory
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.measurement.vertices import Points, vertex_points
from mi_sparse_prt.scene.ray_offsets import ray_offsets
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.scene.traced_scene import TracedScene
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.problem import diffuse_problem


class BareOcclusion:
    """The least that a direct matrix can cost: one occlusion ray per element above the horizon, and a count.

    Ray origins are prepared once per point, nothing is packed, and a block leaves one number on the host.
    """

    def __init__(self, scene: TracedScene, lighting: CubemapLighting, points: Points) -> None:
        self.scene, self.n_directions = scene, lighting.n_directions
        offset = ray_offsets(points.positions)
        origins = points.positions + offset * points.offset_normals  # [point, xyz]
        self._origins = mi.Point3f(np.ascontiguousarray(origins.T))
        self._normals = mi.Normal3f(np.ascontiguousarray(points.normals.T))
        self._directions = mi.Vector3f(np.ascontiguousarray(lighting.directions.T))
        dr.eval(self._origins, self._normals, self._directions)

    def count_visible(self, start: int, stop: int) -> int:
        """Elements of the rows [start, stop) that see the sky."""
        point, direction, above = self._lanes(start, stop)
        ray = mi.Ray3f(dr.gather(mi.Point3f, self._origins, point), direction)
        return int(dr.count(above & ~self.scene.ray_test(ray, active=above))[0])

    def count_rays(self, start: int, stop: int) -> int:
        """Elements of the rows [start, stop) that are above the horizon."""
        return int(dr.count(self._lanes(start, stop)[2])[0])

    def _lanes(self, start: int, stop: int) -> tuple[mi.UInt32, mi.Vector3f, mi.Mask]:
        """Point, direction, and whether that is above the horizon, of every element of a block."""
        lane = dr.arange(mi.UInt32, (stop - start) * self.n_directions)
        row = lane // self.n_directions
        point = row + dr.opaque(mi.UInt32, start)
        direction = dr.gather(mi.Vector3f, self._directions, lane - row * self.n_directions)
        return point, direction, dr.dot(dr.gather(mi.Normal3f, self._normals, point), direction) > 0


def measure_direct(
    scene: Scene, lighting: CubemapLighting, repeats: int
) -> tuple[dict[str, Any], NDArray[np.uint32]]:
    """Time the direct matrix in bits on the host, and the bare loop, block by block in turn.

    Both meet the same disturbances, because they alternate on every block; which one is first alternates too.

    Parameters
    ----------
    scene : Scene
    lighting : CubemapLighting
    repeats : int

    Returns
    -------
    dict
        ``seconds`` and ``bare_seconds`` (medians), ``ratio`` (median over repeats), all three per repeat under
        ``runs``; ``rays`` and ``rays_per_second`` (above the horizon), ``elements_per_second``;
        ``first_run_seconds`` (the untimed pass, compilation included) and ``kernels`` of that pass;
        ``peak_memory_bytes`` (of the process, while this ran); ``visible`` and ``bare_visible`` (equal, or nearly:
        they were the same rays).
    (n_v, ceil(n_directions / 32)) uint32
        The matrix's bits.
    """
    points = vertex_points(scene)
    solver = DirectSolver(diffuse_problem(scene, lighting))
    bare = BareOcclusion(scene.unsplit, lighting, points)
    blocks = [(a, min(a + solver.block_size, len(points))) for a in range(0, len(points), solver.block_size)]
    bits = solver.row_storage(len(points)).astype(np.uint32, copy=False)  # a fact, told to mypy

    def fill(start: int, stop: int) -> None:
        bits[start:stop] = solver.rows(np.arange(start, stop, dtype=np.uint32))

    reset_peak_memory()

    def fill_all() -> None:
        for block in blocks:
            fill(*block)

    first_run, kernels = timed(launched_kernels, fill_all)
    bare_visible = sum(bare.count_visible(*block) for block in blocks)
    rays = sum(bare.count_rays(*block) for block in blocks)
    runs = [_alternating(fill, bare.count_visible, blocks, repeat) for repeat in range(repeats)]
    ours, least = (float(np.median([run[k] for run in runs])) for k in range(2))
    return {
        "seconds": ours,
        "bare_seconds": least,
        "ratio": float(np.median([a / b for a, b in runs])),
        "runs": [{"seconds": a, "bare_seconds": b, "ratio": a / b} for a, b in runs],
        "rays": rays,
        "rays_per_second": rays / ours,
        "elements_per_second": len(points) * lighting.n_directions / ours,
        "blocks": len(blocks),
        "block_rows": [blocks[0][1] - blocks[0][0], blocks[-1][1] - blocks[-1][0]],
        "first_run_seconds": first_run,
        "kernels": kernels.report(),
        "matrix_bytes": bits.nbytes,
        "peak_memory_bytes": peak_memory(),
        "visible": int(np.bitwise_count(bits).sum(dtype=np.int64)),
        "bare_visible": bare_visible,
    }, bits


def _alternating(
    ours: Callable[[int, int], Any],
    bare: Callable[[int, int], Any],
    blocks: list[tuple[int, int]],
    repeat: int,
) -> tuple[float, float]:
    """Seconds of two ways to do the same blocks, in turn."""
    seconds = [0.0, 0.0]
    for k, block in enumerate(blocks):
        for way in (0, 1) if (k + repeat) % 2 == 0 else (1, 0):
            seconds[way] += timed((ours, bare)[way], *block)[0]
    return seconds[0], seconds[1]
