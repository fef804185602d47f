"""How far away the neighbours of a sparse vertex may be, and what fits their weights best ([HR10] Figure 6)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from tqdm.auto import tqdm

from mi_sparse_prt.benchmark.exact_rows import mesh_named, trace_visibility, unit_albedo_rows, values_at
from mi_sparse_prt.benchmark.least_squares import least_squares_fit
from mi_sparse_prt.core.bits import Bits
from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.core.metrics import relative_l2_from_squares
from mi_sparse_prt.core.run import Run
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.measurement.neighbours import radius_neighbours
from mi_sparse_prt.measurement.vertices import vertex_points
from mi_sparse_prt.methods.dense_sampling import DenseSampler
from mi_sparse_prt.methods.huang2010 import Huang2010Options
from mi_sparse_prt.reconstruction.l1 import l1_fit
from mi_sparse_prt.reconstruction.normal_equations import normal_equations
from mi_sparse_prt.sampling.angular import AngularGrid
from mi_sparse_prt.sampling.features import choose_features
from mi_sparse_prt.sampling.spatial import SpatialSampling, choose_weighted
from mi_sparse_prt.scene.scene import Mesh, Scene
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.problem import diffuse_problem
from mi_sparse_prt.validation.matrix_figures import panels

PAPER = Huang2010Options()
CURVES = {"least_squares": "least squares", "l1": "L1", "full": "full: least squares on all directions"}


@dataclass(frozen=True)
class _Samples:
    """Sparse vertices of a mesh with their exact rows, and its dense vertices with theirs.

    Attributes
    ----------
    positions, dense_positions : (n, 3), (n_dense, 3) float32
        Longest side of the scene = 1.
    exact, dense : (n, n_directions), (n_dense, n_directions) float32
        Unit-albedo direct transport.
    features : (n_dense, words) uint32 bits
    products : (n_dense, n_dense) float64
        Of dense rows, over all directions: every Gram matrix of a fit to all of them is a part of it.
    projections : (n, n_dense) float64
        Products of exact and dense rows.
    norms : (n,) float64
        Squared norms of exact rows.
    """

    positions: NDArray[np.float32]
    exact: NDArray[np.float32]
    dense_positions: NDArray[np.float32]
    dense: NDArray[np.float32]
    features: Bits
    products: NDArray[np.float64]
    projections: NDArray[np.float64]
    norms: NDArray[np.float64]

    def neighbours(self, vertex: int, radius: float) -> NDArray[np.int32]:
        """Dense vertices (k,) within the radius, nearest first."""
        ids = radius_neighbours(
            self.positions[[vertex]], self.dense_positions, radius, len(self.dense_positions)
        ).ids[0]
        return ids[ids >= 0]


def error_against_radius(
    scene: Scene,
    lighting: CubemapLighting,
    mesh_name: str,
    radii: list[float],
    n_vertices: int = 400,
    directions: int = 350,
    progress: bool = True,
) -> dict[str, Any]:
    """Error of reconstructed rows against the radius within which dense vertices are neighbours ([HR10] Figure 6).

    Direct light of one mesh, whose dense vertices (20.5%) are chosen once. At a random sample of the others, rows are
    reconstructed from all dense vertices within the radius, however many there are, and compared with exact ones.
    Sampled values serve the fit and are not kept.

    Parameters
    ----------
    scene : Scene
    lighting : CubemapLighting
    mesh_name : str
    radii : list of float
        In longest sides of the scene's box.
    n_vertices : int
        Size of the sample; all sparse vertices if there are fewer.
    directions : int
        Feature directions per vertex, at most: a small radius has fewer ([HR10] 5.3).
    progress : bool
        Show a bar.

    Returns
    -------
    dict
        JSON as it is. ``error`` has one list per curve, one number per radius: L2 norm of the difference of all rows
        over that of the exact rows. ``least_squares`` and ``l1`` are fitted to the best feature directions, ``full``
        is least squares on all directions. ``weights`` likewise: the mean number of weights that are not 0.
        ``neighbours``, ``directions``: means per radius. ``without_neighbours``: share of the vertices that have none
        in the radius; their rows count as 0.

    Raises
    ------
    PrtError
        If there is no such mesh, it has no sparse vertices, or a radius or a count makes no sense.

    Notes
    -----
    Gram matrices are float64, and eigenvalues below k eps of the largest carry no weight (``least_squares_fit``). In
    float32 that regularises so much that least squares does not overfit, and that ``full`` gets worse with the
    radius. The products of all dense rows are kept: O(n_dense^2) memory.
    """
    if not len(radii) or not all(np.isfinite(r) and r > 0 for r in radii):
        raise PrtError(f"radii are {list(radii)}: give positive numbers, in longest sides of the scene")
    for name, value in (("n_vertices", n_vertices), ("directions", directions)):
        if value < 1:
            raise PrtError(f"{name} is {value}: give 1 or more")
    samples = _draw_samples(scene, lighting, mesh_named(scene, mesh_name), n_vertices)
    found = [
        _at_radius(samples, radius, directions) for radius in tqdm(radii, desc="radii", disable=not progress)
    ]
    curves = {
        quantity: {curve: [at[quantity][k] for at in found] for k, curve in enumerate(CURVES)}
        for quantity in ("error", "weights")
    }
    means = ("neighbours", "without_neighbours", "directions")
    return {
        "scene": scene.path,
        "mesh": mesh_name,
        "resolution": lighting.resolution,
        "vertices": len(samples.exact),
        "dense_vertices": len(samples.dense),
        "directions_asked": directions,
        "relative_lambda": PAPER.relative_lambda,
        "radii": [float(radius) for radius in radii],
        **{name: [at[name] for at in found] for name in means},
        **curves,
    }


def plot_error_against_radius(report: dict[str, Any]) -> Figure:
    """The three curves of ``error_against_radius``, and how many neighbours and weights they have."""
    figure, (left, right) = panels(11, 4.2, 1, 2)
    for (curve, label), colour in zip(CURVES.items(), ("tab:blue", "tab:red", "tab:green"), strict=True):
        left.plot(report["radii"], 100 * np.array(report["error"][curve]), ".-", color=colour, label=label)
        right.plot(report["radii"], report["weights"][curve], ".-", color=colour, label=f"weights, {label}")
    right.plot(report["radii"], report["neighbours"], "k:", label="neighbours")
    right.plot(report["radii"], report["directions"], "--", color="grey", label="sampled directions")
    top = 1.4 * 100 * max(max(errors) for errors in report["error"].values())  # room for the legend
    left.set(ylabel="relative L2 of the rows (%)", ylim=(0, top), title=f"{report['mesh']}: error")
    right.set(ylabel="mean per vertex", yscale="symlog", title=f"{report['mesh']}: size of the systems")
    for axes in (left, right):
        axes.set_xlabel("radius / longest side of the scene")
    left.legend(loc="upper right")
    right.legend(fontsize="small")
    return figure


def _draw_samples(scene: Scene, lighting: CubemapLighting, mesh: Mesh, n_vertices: int) -> _Samples:
    """Dense rows as phase 1 of ``huang2010`` finds them, and exact rows of some other vertices."""
    points = vertex_points(scene)
    direct = DirectSolver(diffuse_problem(scene, lighting))
    sampler = DenseSampler(direct, AngularGrid(lighting), Run())
    sampler.choose(mesh, SpatialSampling(PAPER.ground, radius=PAPER.radius))
    dense = sampler.dense()
    others = np.setdiff1d(np.arange(mesh.vertices.start, mesh.vertices.stop), dense.ids)
    if not len(others):
        raise PrtError(f"all vertices of the mesh {mesh.name!r} are dense: it is too small for this")
    sparse = others[choose_weighted(np.ones(len(others)), points.keys[others], n_vertices, 0)]
    exact = unit_albedo_rows(trace_visibility(direct, sparse), scene.normals[sparse], lighting)
    rows = unit_albedo_rows(dense.rows.visible, scene.normals[dense.ids], lighting)
    precise, true = rows.astype(np.float64), exact.astype(np.float64)
    return _Samples(
        scene.normalised_positions[sparse],
        exact,
        scene.normalised_positions[dense.ids],
        rows,
        dense.rows.features,
        precise @ precise.T,
        true @ precise.T,
        (true**2).sum(axis=1),
    )


def _at_radius(samples: _Samples, radius: float, count: int) -> dict[str, Any]:
    """Means per vertex; ``error`` (relative L2) and ``weights`` (mean number) are lists, a number for each curve."""
    n = len(samples.exact)
    squares, used = np.zeros(len(CURVES)), np.zeros(len(CURVES))
    neighbours, alone, directions = 0, 0, 0
    for vertex in range(n):
        near = samples.neighbours(vertex, radius)
        if not len(near):
            squares += samples.norms[vertex]
            alone += 1
            continue
        weights, sampled = _fit_weights(samples, vertex, near, count)
        neighbours += len(near)
        directions += sampled
        used += (weights != 0).sum(axis=1)
        squares += ((weights @ samples.dense[near] - samples.exact[vertex]) ** 2).sum(axis=1)
    return {
        "neighbours": neighbours / n,
        "without_neighbours": alone / n,
        "directions": directions / n,
        "error": relative_l2_from_squares(squares, samples.norms.sum()).tolist(),
        "weights": (used / n).tolist(),
    }


def _fit_weights(
    samples: _Samples, vertex: int, near: NDArray[np.int32], count: int
) -> tuple[NDArray[np.float64], int]:
    """Weights (curve, k) of neighbours (k,), in the order of ``CURVES``, and how many directions two of them saw."""
    chosen = choose_features(near[None], samples.dense, samples.features, count)
    values = values_at(samples.exact[vertex][None], chosen)
    few = normal_equations(samples.dense, near[None], chosen, values)
    gram = samples.products[np.ix_(near, near)]
    full = gram[None], samples.projections[vertex, near][None], samples.norms[[vertex]]
    fits = least_squares_fit(*few), l1_fit(*few, PAPER.relative_lambda), least_squares_fit(*full)
    return np.concatenate([fit.weights for fit in fits]), int((chosen >= 0).sum())
