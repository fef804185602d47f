"""Columns of a local transport matrix chosen once for all rows of a region, as others than [HR10] do.

All choices take the region's dense rows, whose columns (one value per dense vertex) they compare, and a random
generator. Columns of zeros are left out: they say nothing about weights, and [HPB07] ignores them as well.
``precompute_with_columns`` makes methods of them that others would build, as [HR10] 5.2 compares: all of ``huang2010``
but its columns, for direct and indirect light together. Dense rows, neighbours and the L1 fit are the same; a sparse
vertex is sampled at 6% of the directions, chosen once for a region of about 1000 vertices from its dense rows.

[HPB07] Hasan, Pellacini, Bala: Matrix Row-Column Sampling for the Many-Light Problem, 2007.
[WDT09] Wang, Dong, Tong, Lin, Guo: Kernel Nystroem Method for Light Transport, 2009.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable

import numpy as np
import scipy.sparse
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2

from mi_sparse_prt.core.run import Run
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.methods.dense_sampling import Dense
from mi_sparse_prt.methods.execution import matrix_of
from mi_sparse_prt.methods.huang2010 import Huang2010Options, huang2010_parts
from mi_sparse_prt.sampling.row_column import cluster_columns
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.paths import PathSolver
from mi_sparse_prt.solvers.problem import diffuse_problem
from mi_sparse_prt.transport import LightTransport

Ids = NDArray[np.int64]
Singles = NDArray[np.float32]

Columns = Callable[[Singles, int, np.random.Generator], Ids]

SHARE = 0.06  # of the columns are sampled ([HR10] Figure 5)
LLOYD_STEPS = 10


def regions(dense_positions: NDArray[np.floating], n: int, seed: int, size: int = 1000) -> Ids:
    """Compact regions of the dense vertices of a mesh, with about so many of all its vertices to a region.

    Parameters
    ----------
    dense_positions : (n_dense, 3) float, any frame
    n : int
        Vertices of the mesh.
    seed : int
    size : int
        Vertices of the mesh in a region that shares its columns, on average.

    Returns
    -------
    (n_dense,) int64
        Region of each dense vertex, numbered without gaps.
    """
    count = min(max(1, round(n / size)), len(dense_positions))
    p = dense_positions.astype(np.float64)
    rng = np.random.default_rng(seed)
    start = p[rng.choice(len(p), count, replace=False)]
    with warnings.catch_warnings():  # an empty region is left out
        warnings.simplefilter("ignore", UserWarning)
        _, labels = kmeans2(p, start, minit="matrix")
    return np.unique(labels, return_inverse=True)[1].astype(np.int64)


def columns_of_regions(
    rows: Singles, region: Ids, choose: Columns, count: int, seed: int
) -> NDArray[np.int32]:
    """Columns that each region samples.

    Parameters
    ----------
    rows : (n_dense, n_directions) float32
    region : (n_dense,) int64
        Region of each row.
    choose : callable
        One of the choices below.
    count : int
        Columns of a region.
    seed : int

    Returns
    -------
    (regions, count) int32
        -1 where there are fewer.
    """
    table = np.full((int(region.max()) + 1, count), -1, np.int32)
    for k, columns in enumerate(table):
        chosen = choose(rows[region == k], count, np.random.default_rng([seed, k]))
        columns[: len(chosen)] = chosen
    return table


def random_columns(rows: NDArray[np.float32], count: int, rng: np.random.Generator) -> Ids:
    """Columns at random.

    Parameters
    ----------
    rows : (r, n_directions) float32
    count : int
    rng : np.random.Generator

    Returns
    -------
    (min(count, columns that are not zero),) int64
        Ascending.
    """
    ids = _lit_columns(rows)[0]
    return np.sort(rng.choice(ids, min(count, len(ids)), replace=False))


def clustered_columns(rows: NDArray[np.float32], count: int, rng: np.random.Generator) -> Ids:
    """One column of each cluster of columns of like direction, by the norms in it ([HPB07] 3.3 to 3.5).

    The cost of a cluster is the sum of ``|x| |y| (1 - cos(x, y))`` over its pairs. Two thirds of the clusters have
    centres drawn by what a column costs beside all others; then the dearest one is split until there are enough.

    Parameters
    ----------
    rows : (r, n_directions) float32
        The paper's reduced columns are its columns.
    count : int
        Clusters.
    rng : np.random.Generator

    Returns
    -------
    (min(count, columns that are not zero),) int64
        Ascending.
    """
    ids, single = _lit_columns(rows)
    x = single.astype(np.float64)
    norms = np.linalg.norm(x, axis=1)
    clusters = cluster_columns(x, norms, count, rng)
    chosen = [rng.choice(members, p=norms[members] / norms[members].sum()) for members in clusters]
    return np.sort(ids[np.array(chosen, np.int64)])


def k_means_columns(rows: NDArray[np.float32], count: int, rng: np.random.Generator) -> Ids:
    """The column nearest to each centre of a k-means clustering, as [HR10] 5.2 describes the choice of [WDT09].

    Parameters
    ----------
    rows : (r, n_directions) float32
    count : int
        Centres: k-means++, then 10 steps of Lloyd. Clusters that stay empty (equal columns) give their place to the
        columns that are farthest from their own centre.
    rng : np.random.Generator

    Returns
    -------
    (min(count, columns that are not zero),) int64
        Ascending.
    """
    ids, x = _lit_columns(rows)
    count = min(count, len(ids))
    if not count:
        return ids
    centres = x[_k_means_start(x, count, rng)]
    for _ in range(LLOYD_STEPS):
        owner = np.argmin(_squared_distances(x, centres), axis=1)
        members = scipy.sparse.csr_array((np.ones(len(x), np.float32), (owner, np.arange(len(x)))))
        sums, size = members @ x, members.sum(axis=1)  # up to the last cluster that is not empty
        centres[: len(size)][size > 0] = sums[size > 0] / size[size > 0, None]
    squared = _squared_distances(x, centres)
    owner, distance = np.argmin(squared, axis=1), np.min(squared, axis=1)
    order = np.lexsort((distance, owner))
    nearest = order[np.unique(owner[order], return_index=True)[1]]
    distance[nearest] = -1
    farthest = np.argsort(-distance, kind="stable")
    return np.sort(ids[np.concatenate([nearest, farthest[: count - len(nearest)]])])


CHOICES: dict[str, Columns] = {
    "clustered_columns": clustered_columns,
    "k_means_columns": k_means_columns,
    "random_columns": random_columns,
}


def _lit_columns(rows: NDArray[np.float32]) -> tuple[Ids, Singles]:
    """Columns that are not zero: their ids (n,) and values (n, r)."""
    ids = np.flatnonzero(rows.any(axis=0))
    return ids, np.ascontiguousarray(rows[:, ids].T, dtype=np.float32)


# -- k-means -----------------------------------------------------------------------------------------------------------


def _k_means_start(x: Singles, count: int, rng: np.random.Generator) -> list[int]:
    """k-means++: each centre is drawn by the squared distance to those before it (Arthur and Vassilvitskii 2007)."""
    chosen = [int(rng.integers(len(x)))]
    nearest, squares = np.full(len(x), np.inf, np.float32), (x**2).sum(axis=1)
    while len(chosen) < count:
        last = chosen[-1]
        nearest = np.minimum(nearest, np.maximum(squares - 2 * (x @ x[last]) + squares[last], 0))
        nearest[last] = 0
        total = nearest.sum(dtype=np.float64)
        chosen.append(int(rng.choice(len(x), p=nearest / total) if total > 0 else rng.integers(len(x))))
    return chosen


def _squared_distances(x: Singles, centres: Singles) -> Singles:
    """Squared distances (n, k) of points (n, r) and centres (k, r)."""
    squares = x @ (-2 * centres.T)  # a large array: everything else happens in its place
    squares += (x**2).sum(axis=1)[:, None]
    squares += (centres**2).sum(axis=1)
    return np.maximum(squares, 0, out=squares)


# -- huang2010 with these columns --------------------------------------------------------------------------------------


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
        [HPB07] or [WDT09].
    max_depth, spp, seed, progress
        As for ``precompute``.

    Returns
    -------
    LightTransport
        In the direction basis. ``report`` has ``seconds``, ``elements_total`` and ``elements_evaluated``.
    """
    run = Run(seed, progress=progress)
    with run.clock.phase("setup"):
        problem = diffuse_problem(scene, lighting, max_depth)
        direct, paths = DirectSolver(problem), PathSolver(problem, spp, seed)

    def columns(dense: Dense, mean: NDArray[np.float32]) -> Callable[[NDArray[np.int32]], NDArray[np.int32]]:
        return columns_of_nearest(scene, dense, mean, CHOICES[choice], seed)

    parts = huang2010_parts(direct, paths, run, Huang2010Options(columns=columns))
    transport = matrix_of(problem, parts)
    transport.report.update(
        seconds=run.clock.report(),
        elements_total=len(problem.points) * lighting.n_directions,
        elements_evaluated=parts.elements_evaluated,
    )
    return transport


def columns_of_nearest(
    scene: Scene, dense: Dense, mean: NDArray[np.float32], choose: Columns, seed: int, size: int = 1000
) -> Callable[[NDArray[np.int32]], NDArray[np.int32]]:
    """Columns of all regions of about ``size`` vertices; a sparse vertex belongs to that of its nearest dense one."""
    count = max(1, round(SHARE * mean.shape[1]))
    tables: list[NDArray[np.int32]] = []
    region = np.empty(len(dense.ids), np.int64)
    for mesh in scene.meshes:
        own, before = dense.of_mesh(mesh), sum(len(table) for table in tables)
        positions = scene.normalised_positions[dense.ids[own]]
        labels = regions(positions, mesh.vertices.stop - mesh.vertices.start, seed, size)
        tables.append(columns_of_regions(mean[own], labels, choose, count, seed))
        region[own] = before + labels
    table = np.concatenate(tables)
    return lambda near: table[region[near[:, 0]]]
