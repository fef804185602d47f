"""Which rows and columns to evaluate: the choices of [HR10] against others at the same budget (Figure 5)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from tqdm.auto import tqdm

from mi_sparse_prt.benchmark.column_sampling import CHOICES, SHARE, Columns, columns_of_regions, regions
from mi_sparse_prt.benchmark.exact_rows import mesh_named, trace_visibility, unit_albedo_rows, values_at
from mi_sparse_prt.benchmark.measuring import timed
from mi_sparse_prt.core.bits import Bits, bits_at
from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.core.metrics import relative_l2_of_sample
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.measurement.neighbours import radius_neighbours, surface_neighbours
from mi_sparse_prt.measurement.vertices import vertex_points
from mi_sparse_prt.methods.huang2010 import Huang2010Options
from mi_sparse_prt.reconstruction.interpolation_weights import inverse_distance_weights, linear_weights
from mi_sparse_prt.reconstruction.l1 import l1_fit
from mi_sparse_prt.reconstruction.normal_equations import normal_equations
from mi_sparse_prt.sampling.angular import AngularGrid
from mi_sparse_prt.sampling.features import choose_features
from mi_sparse_prt.sampling.spatial import SpatialSampling, choose_dense, choose_weighted
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.problem import diffuse_problem
from mi_sparse_prt.validation.matrix_figures import panels

PAPER = Huang2010Options()
ROWS = 0.25  # Figure 5
INTERPOLATED_FROM = 12  # neighbours, as many as method="sparse" has

FITTED = {
    "features": "rows by rank, columns by features [HR10]",
    "clustered_columns": "clustered columns [HPB07]",
    "k_means_columns": "k-means columns [WDT09]",
    "random_columns": "random columns",
    "random_rows": "random rows, columns by features",
}
INTERPOLATED = {
    "nearest": "nearest dense vertex",
    "inverse_distance": "inverse distance",
    "linear": "linear (moving least squares)",
}


@dataclass(frozen=True)
class _Surface:
    """Exact direct light of a mesh; vertices are numbered from 0.

    Attributes
    ----------
    positions, normals : (n, 3) float32, longest side of the scene = 1
    keys : (n,) uint64
    bits : (n, words) uint32
    lighting : CubemapLighting
    """

    positions: NDArray[np.float32]
    normals: NDArray[np.float32]
    keys: NDArray[np.uint64]
    bits: Bits
    lighting: CubemapLighting

    def rows(self, ids: NDArray[np.integer]) -> NDArray[np.float32]:
        """Unit-albedo rows (len(ids), n_directions)."""
        return unit_albedo_rows(self.bits[ids], self.normals[ids], self.lighting)

    def features(self, ids: NDArray[np.integer]) -> Bits:
        """Directions that the second angular pass would add at these vertices."""

        def visible(rows: NDArray[np.uint32], texels: NDArray[np.uint32]) -> NDArray[np.bool_]:
            return bits_at(self.bits, ids[rows], texels).astype(bool)

        return AngularGrid(self.lighting).sample(self.normals[ids], visible).features


@dataclass(frozen=True)
class _Local:
    """Sparse vertices of the sample, and the dense ones that they are reconstructed from.

    Attributes
    ----------
    exact : (n, n_directions) float32
    sparse, dense : (n,), (n_dense,) int64
        Vertices of the mesh.
    rows : (n_dense, n_directions) float32
    features : (n_dense, words) uint32 bits
    near : (n, k) int32
        Rows of ``rows``, -1 where there are fewer.
    """

    exact: NDArray[np.float32]
    sparse: NDArray[np.int64]
    dense: NDArray[np.int64]
    rows: NDArray[np.float32]
    features: Bits
    near: NDArray[np.int32]


@dataclass(frozen=True)
class _Result:
    """What a choice led to.

    Attributes
    ----------
    squared : (n,) float64
        Squared L2 norms of the error of the sparse rows of the sample.
    directions : float
        Evaluated per sparse vertex, mean.
    seconds : float
        Of choosing columns, for the whole mesh.
    """

    squared: NDArray[np.float64]
    directions: float
    seconds: float


def compare_choices(
    scene: Scene,
    lighting: CubemapLighting,
    mesh: str,
    n_vertices: int = 1000,
    seed: int = 0,
    progress: bool = True,
) -> dict[str, Any]:
    """Error of the direct matrix of a mesh for other rows and columns, the fit being the same ([HR10] Figure 5).

    A quarter of the vertices is dense, their rows are exact. All others are reconstructed from dense vertices within
    the radius of ``huang2010`` by L1 weights, fitted to at most 6% of the directions: columns chosen for each vertex
    (``features``), or once for a region of about 1000 vertices from the rows of its dense ones. Sampled values are not
    kept. Beside these, interpolation that evaluates nothing but the dense rows.

    Parameters
    ----------
    scene : Scene
    lighting : CubemapLighting
    mesh : str
        Name of the mesh.
    n_vertices : int
        Vertices at which the error is measured, drawn from all, dense or not; all if there are fewer.
    seed : int
    progress : bool
        Show a bar.

    Returns
    -------
    dict
        JSON as it is. ``rows``, ``columns``: dense vertices and directions of the budget, ``row_share`` and
        ``column_share`` the same as shares; ``regions``. By choice: ``error``, the L2 norm of the difference of the
        rows over that of the exact ones, and its ``standard_error`` (the vertices are a sample); ``directions``, the
        share that a sparse vertex really used; ``seconds``, of choosing the columns of the whole mesh (those chosen per
        vertex are extrapolated).

    Raises
    ------
    PrtError
        If there is no such mesh, all of the sample is dense, or none of it is lit.
    """
    if n_vertices < 1:
        raise PrtError(f"n_vertices is {n_vertices}: give 1 or more")
    surface = _surface(scene, lighting, mesh)
    n, count = len(surface.positions), max(1, round(SHARE * lighting.n_directions))
    sampling = SpatialSampling(ROWS, radius=PAPER.radius)
    by_rank = choose_dense(surface.positions, surface.keys, lambda ids: surface.bits[ids], sampling, seed).ids
    at_random = choose_weighted(np.ones(n), surface.keys, len(by_rank), seed + 1)
    sample = choose_weighted(np.ones(n), surface.keys, n_vertices, seed + 2)
    norms = (surface.rows(sample).astype(np.float64) ** 2).sum(axis=1)
    if not norms.any():
        raise PrtError(f"the mesh {mesh!r} sees no light at {len(sample)} vertices: choose another mesh")

    local, region = _local(surface, sample, by_rank), regions(surface.positions[by_rank], n, seed)
    results = {"features": _by_vertex(local, count, n - len(by_rank)), **_interpolations(surface, local)}
    for name in tqdm(CHOICES, desc="columns", disable=not progress):
        results[name] = _by_region(local, region, CHOICES[name], count, seed)
    results["random_rows"] = _by_vertex(_local(surface, sample, at_random), count, n - len(at_random))
    errors = {}
    for name in (*FITTED, *INTERPOLATED):
        squares = np.zeros(len(sample))  # dense rows are exact
        sparse = ~np.isin(sample, at_random if name == "random_rows" else by_rank)
        squares[sparse] = results[name].squared
        errors[name] = relative_l2_of_sample(squares, norms)
    return {
        "scene": scene.path,
        "mesh": mesh,
        "resolution": lighting.resolution,
        "vertices": len(sample),
        "seed": seed,
        "rows": len(by_rank),
        "row_share": len(by_rank) / n,
        "columns": count,
        "column_share": count / lighting.n_directions,
        "regions": int(region.max()) + 1,
        "error": {name: error for name, (error, _) in errors.items()},
        "standard_error": {name: spread for name, (_, spread) in errors.items()},
        "directions": {name: results[name].directions / lighting.n_directions for name in FITTED},
        "seconds": {name: results[name].seconds for name in FITTED},
    }


def plot_choices(report: dict[str, Any]) -> Figure:
    """Errors of ``compare_choices`` as bars, standard errors on them, and the share of directions that was used."""
    figure, axes = panels(8.5, 4)
    labels = FITTED | INTERPOLATED
    errors = [100 * report["error"][name] for name in labels]
    colours = ["tab:red", *["tab:blue"] * (len(FITTED) - 1), *["0.6"] * len(INTERPOLATED)]
    spread = [100 * report["standard_error"][name] for name in labels]
    bars = axes.barh(list(labels.values()), errors, xerr=spread, color=colours)
    used = [f"; {100 * report['directions'][name]:.1f}% of directions" for name in FITTED]
    used += ["; no samples"] * len(INTERPOLATED)
    axes.bar_label(bars, [f"{e:.2f}%{text}" for e, text in zip(errors, used, strict=True)], padding=3)
    axes.invert_yaxis()
    axes.set(xlabel="relative L2 of the direct matrix (%)", xlim=(0, 1.6 * max(errors)))
    figure.suptitle(
        f"{report['mesh']}: {100 * report['row_share']:.0f}% of the rows are dense, "
        f"at most {100 * report['column_share']:.0f}% of the columns are sampled elsewhere"
    )
    return figure


def _surface(scene: Scene, lighting: CubemapLighting, name: str) -> _Surface:
    inside, points = mesh_named(scene, name).vertices, vertex_points(scene)
    direct = DirectSolver(diffuse_problem(scene, lighting))
    bits = trace_visibility(direct, np.arange(inside.start, inside.stop, dtype=np.uint32))
    return _Surface(
        scene.normalised_positions[inside], scene.normals[inside], points.keys[inside], bits, lighting
    )


def _local(surface: _Surface, sample: NDArray[np.int64], dense: NDArray[np.int64]) -> _Local:
    sparse, p = np.setdiff1d(sample, dense), surface.positions
    if not len(sparse):
        raise PrtError(
            f"all {len(sample)} vertices of the sample are dense: draw more, or take a larger mesh"
        )
    found = radius_neighbours(p[sparse], p[dense], np.inf, PAPER.most_neighbours)
    beyond = found.distances > PAPER.radius
    beyond[:, : PAPER.least_neighbours] = False
    near = np.where(beyond, -1, found.ids).astype(np.int32)
    return _Local(surface.rows(sparse), sparse, dense, surface.rows(dense), surface.features(dense), near)


def _by_vertex(local: _Local, count: int, n_sparse: int) -> _Result:
    """Columns chosen for each sparse vertex; of such the whole mesh has `n_sparse`."""
    choose_features(local.near[:1], local.rows, local.features, count)  # compiles
    seconds, directions = timed(choose_features, local.near, local.rows, local.features, count)
    return _fitted(local, directions, seconds * n_sparse / len(local.sparse))


def _by_region(local: _Local, region: NDArray[np.int64], choose: Columns, count: int, seed: int) -> _Result:
    """Columns chosen for each region; a sparse vertex belongs to that of the nearest dense one."""
    seconds, table = timed(columns_of_regions, local.rows, region, choose, count, seed)
    return _fitted(local, table[region[local.near[:, 0]]], seconds)


def _fitted(local: _Local, directions: NDArray[np.int32], seconds: float) -> _Result:
    """L1 weights of the neighbours from the exact values at directions (n, s), -1 where there are fewer."""
    known = directions >= 0
    equations = normal_equations(local.rows, local.near, directions, values_at(local.exact, directions))
    weights = l1_fit(*equations, PAPER.relative_lambda).weights
    # no directions, no equations: the neighbours' mean, as in huang2010
    alone = ~known.any(axis=1)
    present = local.near[alone] >= 0
    weights[alone] = present / present.sum(axis=1, keepdims=True)
    return _Result(_squared(local, local.near, weights), float(known.sum(axis=1).mean()), seconds)


def _interpolations(surface: _Surface, local: _Local) -> dict[str, _Result]:
    """Rows from the dense ones alone."""
    p, normals = surface.positions, surface.normals
    places = p[local.sparse], normals[local.sparse], p[local.dense], normals[local.dense]
    near = surface_neighbours(*places, INTERPOLATED_FROM)
    nearest = np.zeros(near.ids.shape, np.float32)
    nearest[:, 0] = near.ids[:, 0] >= 0
    weights = {
        "nearest": nearest,
        "inverse_distance": inverse_distance_weights(near),
        "linear": linear_weights(near, *places),
    }
    return {name: _Result(_squared(local, near.ids, w), 0.0, 0.0) for name, w in weights.items()}


def _squared(local: _Local, near: NDArray[np.int32], weights: NDArray[np.floating]) -> NDArray[np.float64]:
    """Squared L2 norms (n,) of the errors of rows that are weighted sums, weights (n, k), of neighbours (n, k)."""
    squared = np.empty(len(near))
    for v, (ids, w) in enumerate(zip(near, weights, strict=True)):
        error = w[ids >= 0] @ local.rows[ids[ids >= 0]] - local.exact[v]
        squared[v] = (error**2).sum(dtype=np.float64)
    return squared
