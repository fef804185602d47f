"""Methods that others would build: all of ``huang2010`` but its columns, which a region's vertices have in common.

[HR10] 5.2 compares its choice of directions with those of [HPB07] and [WDT09]; so do these, for direct and indirect
light together. Dense rows, neighbours and the L1 fit are those of ``huang2010``; a sparse vertex is sampled at 6% of
the directions, chosen once for a region of about 1000 vertices from the rows of its dense ones.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.benchmark.columns import (
    SHARE,
    Columns,
    clustered_columns,
    columns_of_regions,
    k_means_columns,
    regions,
)
from mi_sparse_prt.core.profiling import Stopwatch
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.measurement.vertices import vertex_points
from mi_sparse_prt.methods.dense_sampling import Dense
from mi_sparse_prt.methods.execution import matrix_of
from mi_sparse_prt.methods.huang2010 import huang2010_parts
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.paths import PathSolver
from mi_sparse_prt.solvers.problem import diffuse_problem
from mi_sparse_prt.transport import LightTransport

CHOICES: dict[str, Columns] = {"clustered_columns": clustered_columns, "k_means_columns": k_means_columns}


def precompute_with_columns(
    scene: Scene,
    lighting: CubemapLighting,
    choice: str,
    max_depth: int,
    spp: int,
    seed: int = 0,
    progress: bool = True,
) -> LightTransport:
    """The light transport matrix of a scene by regional columns.

    Parameters
    ----------
    scene : Scene
    lighting : CubemapLighting
    choice : {"clustered_columns", "k_means_columns"}
        [HPB07] or [WDT09]; see ``benchmark.columns``.
    max_depth, spp, seed, progress
        As for ``precompute``.

    Returns
    -------
    LightTransport
        In the direction basis. ``report`` has ``seconds``, ``elements_total`` and ``elements_evaluated``.
    """
    clock = Stopwatch()
    with clock.phase("setup"):
        points = vertex_points(scene)
        direct = DirectSolver(scene.normalised, lighting, points)
        channels = 1 if scene.grey else 3
        paths = PathSolver(scene.normalised, lighting, points, "direction", max_depth, spp, channels, seed)

    def columns(dense: Dense, mean: NDArray[np.float32]) -> Callable[[NDArray[np.int32]], NDArray[np.int32]]:
        return _of_nearest(scene, dense, mean, CHOICES[choice], seed)

    parts = huang2010_parts(scene, direct, paths, seed, clock, progress, columns=columns)
    transport = matrix_of(diffuse_problem(scene, lighting, max_depth), parts)
    transport.report.update(
        seconds=clock.report(),
        elements_total=len(points) * lighting.n_directions,
        elements_evaluated=parts.elements_evaluated,
    )
    return transport


def _of_nearest(
    scene: Scene, dense: Dense, mean: NDArray[np.float32], choose: Columns, seed: int
) -> Callable[[NDArray[np.int32]], NDArray[np.int32]]:
    """Columns of all regions; a sparse vertex belongs to that of its nearest dense one."""
    count = max(1, round(SHARE * mean.shape[1]))
    tables: list[NDArray[np.int32]] = []
    region = np.empty(len(dense.ids), np.int64)
    for mesh in scene.meshes:
        own, before = dense.of_mesh(mesh), sum(len(table) for table in tables)
        positions = scene.normalised_positions[dense.ids[own]]
        labels = regions(positions, mesh.vertices.stop - mesh.vertices.start, seed)
        tables.append(columns_of_regions(mean[own], labels, choose, count, seed))
        region[own] = before + labels
    table = np.concatenate(tables)
    return lambda near: table[region[near[:, 0]]]
