"""How far away the neighbours of a sparse vertex may be, and what fits their weights best ([HR10] Figure 6)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from tqdm.auto import tqdm

from mi_sparse_prt.benchmark.exact_rows import mesh_named, traced_rows, white_rows
from mi_sparse_prt.benchmark.least_squares import least_squares_fit
from mi_sparse_prt.core.bits import Bits
from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.core.profiling import Stopwatch
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.measurement.neighbours import radius_neighbours
from mi_sparse_prt.measurement.vertices import vertex_points
from mi_sparse_prt.methods.dense_sampling import DenseSampler
from mi_sparse_prt.methods.huang2010 import DENSE_GROUND, RADIUS
from mi_sparse_prt.reconstruction.l1 import l1_fit
from mi_sparse_prt.reconstruction.normal_equations import normal_equations
from mi_sparse_prt.sampling.angular import AngularGrid
from mi_sparse_prt.sampling.features import choose_features
from mi_sparse_prt.sampling.spatial import choose_weighted
from mi_sparse_prt.scene.scene import Mesh, Scene
from mi_sparse_prt.solvers.direct_rays import DirectSolver

CURVES = {"least_squares": "least squares", "l1": "L1", "full": "full: least squares on all directions"}
GRAM_ELEMENTS = 1 << 22  # of the Gram matrices that are solved together: 32 MB
MOST_TOGETHER = 64  # vertices


@dataclass(frozen=True)
class _Samples:
    """Sparse vertices of a mesh with their exact rows, and its dense vertices with theirs.

    Attributes
    ----------
    positions, dense_positions : (n, 3), (n_dense, 3) float32
        Longest side of the scene = 1.
    exact, dense : (n, n_directions), (n_dense, n_directions) float32
        White direct transport.
    features : (n_dense, words) uint32 bits
    products : (n_dense, n_dense) float64
        Of dense rows, over all directions: every Gram matrix of a fit to all of them is a part of it.
    projections : (n, n_dense) float64
        Products of exact and dense rows.
    """

    positions: NDArray[np.float32]
    exact: NDArray[np.float32]
    dense_positions: NDArray[np.float32]
    dense: NDArray[np.float32]
    features: Bits
    products: NDArray[np.float64]
    projections: NDArray[np.float64]


def error_against_radius(
    scene: Scene,
    lighting: CubemapLighting,
    mesh_name: str,
    radii: list[float],
    n_vertices: int = 400,
    directions: int = 350,
    relative_lambda: float = 1e-2,
    seed: int = 0,
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
    relative_lambda : float
        Of the L1 fit; see ``l1_fit``.
    seed : int
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
    _check(radii, n_vertices, directions)
    mesh = mesh_named(scene, mesh_name)
    samples = _sampled(scene, lighting, mesh, n_vertices, seed)
    report: dict[str, Any] = {
        "scene": scene.path,
        "mesh": mesh.name,
        "resolution": lighting.resolution,
        "vertices": len(samples.exact),
        "dense_vertices": len(samples.dense),
        "directions_asked": directions,
        "relative_lambda": relative_lambda,
        "seed": seed,
        "radii": [float(radius) for radius in radii],
        "neighbours": [],
        "without_neighbours": [],
        "directions": [],
        "error": {curve: [] for curve in CURVES},
        "weights": {curve: [] for curve in CURVES},
    }
    for radius in tqdm(radii, desc="radii", disable=not progress):
        means, error, weights = _at_radius(samples, radius, directions, relative_lambda)
        for name, value in means.items():
            report[name].append(value)
        for k, curve in enumerate(CURVES):
            report["error"][curve].append(float(error[k]))
            report["weights"][curve].append(float(weights[k]))
    return report


def plot_error_against_radius(report: dict[str, Any]) -> Figure:
    """The three curves of ``error_against_radius``, and how many neighbours and weights they have."""
    figure = Figure(figsize=(11, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    for (curve, label), colour in zip(CURVES.items(), ("tab:blue", "tab:red", "tab:green"), strict=True):
        left.plot(report["radii"], 100 * np.array(report["error"][curve]), ".-", color=colour, label=label)
        right.plot(report["radii"], report["weights"][curve], ".-", color=colour, label=f"weights, {label}")
    right.plot(report["radii"], report["neighbours"], "k:", label="neighbours")
    right.plot(report["radii"], report["directions"], "--", color="grey", label="sampled directions")
    top = 1.4 * 100 * max(max(errors) for errors in report["error"].values())  # room for the legend
    left.set(
        xlabel="radius / longest side of the scene",
        ylabel="relative L2 of the rows (%)",
        ylim=(0, top),
        title=f"{report['mesh']}: error",
    )
    right.set(
        xlabel="radius / longest side of the scene",
        ylabel="mean per vertex",
        yscale="symlog",
        title=f"{report['mesh']}: size of the systems",
    )
    left.legend(loc="upper right")
    right.legend(fontsize="small")
    return figure


def _check(radii: list[float], n_vertices: int, directions: int) -> None:
    if not len(radii) or not all(np.isfinite(r) and r > 0 for r in radii):
        raise PrtError(f"radii are {list(radii)}: give positive numbers, in longest sides of the scene")
    for name, value in (("n_vertices", n_vertices), ("directions", directions)):
        if value < 1:
            raise PrtError(f"{name} is {value}: give 1 or more")


def _sampled(scene: Scene, lighting: CubemapLighting, mesh: Mesh, n_vertices: int, seed: int) -> _Samples:
    """Dense rows as phase 1 of ``huang2010`` finds them, and exact rows of some other vertices."""
    points = vertex_points(scene)
    direct = DirectSolver(scene.normalised, lighting, points)
    sampler = DenseSampler(scene, direct, AngularGrid(lighting), Stopwatch())
    sampler.choose(mesh, DENSE_GROUND, RADIUS, seed)
    dense = sampler.dense()
    others = np.setdiff1d(np.arange(mesh.vertices.start, mesh.vertices.stop), dense.ids)
    if not len(others):
        raise PrtError(f"all vertices of the mesh {mesh.name!r} are dense: it is too small for this")
    sparse = others[choose_weighted(np.ones(len(others)), points.keys[others], n_vertices, seed)]
    exact = white_rows(traced_rows(direct, sparse), scene.normals[sparse], lighting)
    rows = white_rows(dense.rows.visible, scene.normals[dense.ids], lighting)
    precise = rows.astype(np.float64)
    return _Samples(
        scene.normalised_positions[sparse],
        exact,
        scene.normalised_positions[dense.ids],
        rows,
        dense.rows.features,
        precise @ precise.T,
        exact.astype(np.float64) @ precise.T,
    )


def _at_radius(
    samples: _Samples, radius: float, count: int, relative_lambda: float
) -> tuple[dict[str, float], NDArray[np.float64], NDArray[np.float64]]:
    """Means per vertex, and for each curve the relative L2 error and the mean number of weights."""
    near = _neighbours(samples, radius)
    known = (near >= 0).sum(axis=1)
    squared, used, directions = np.zeros(len(CURVES)), np.zeros(len(CURVES)), 0
    for ids in _blocks(known):
        some = near[ids, : max(1, known[ids].max())]
        chosen = choose_features(some, samples.dense, samples.features, count)
        directions += int((chosen >= 0).sum())
        weights = _fits(samples, ids, some, chosen, relative_lambda)
        used += (weights != 0).sum(axis=(0, 2))
        for k, vertex in enumerate(ids):
            present = some[k] >= 0
            rows = weights[k][:, present] @ samples.dense[some[k][present]]  # [curve, direction]
            squared += ((rows - samples.exact[vertex]) ** 2).sum(axis=1)
    n = len(known)
    means = {
        "neighbours": float(known.mean()),
        "without_neighbours": float((known == 0).mean()),
        "directions": directions / n,
    }
    return (
        means,
        np.sqrt(squared / max(float((samples.exact.astype(np.float64) ** 2).sum()), 1e-30)),
        used / n,
    )


def _neighbours(samples: _Samples, radius: float) -> NDArray[np.int32]:
    """All dense vertices (n, k) in the radius, nearest first, -1 where there are fewer."""
    parts = []
    for a in range(0, len(samples.positions), MOST_TOGETHER):
        p = samples.positions[a : a + MOST_TOGETHER]
        ids = radius_neighbours(p, samples.dense_positions, radius, len(samples.dense)).ids
        parts.append(ids[:, : max(1, int((ids >= 0).sum(axis=1).max()))])
    widest = max(part.shape[1] for part in parts)
    return np.concatenate(
        [np.pad(part, ((0, 0), (0, widest - part.shape[1])), constant_values=-1) for part in parts]
    )


def _blocks(known: NDArray[np.integer]) -> list[NDArray[np.int64]]:
    """Vertices in blocks of about as many neighbours, each with Gram matrices of bounded size."""
    order, blocks = np.argsort(-known, kind="stable"), []
    while len(order):
        size = int(np.clip(GRAM_ELEMENTS // max(1, int(known[order[0]])) ** 2, 1, MOST_TOGETHER))
        blocks.append(order[:size])
        order = order[size:]
    return blocks


def _fits(
    samples: _Samples,
    ids: NDArray[np.int64],
    near: NDArray[np.int32],
    chosen: NDArray[np.int32],
    relative_lambda: float,
) -> NDArray[np.float64]:
    """Weights (n, curve, k) of neighbours (n, k), in the order of ``CURVES``."""
    exact = samples.exact[ids]
    sampled = np.where(chosen >= 0, np.take_along_axis(exact, np.maximum(chosen, 0), axis=1), np.float32(0))
    few = normal_equations(samples.dense, near, chosen, sampled)
    full = _all_directions(samples, ids, near)
    fits = (least_squares_fit(*few), l1_fit(*few, relative_lambda), least_squares_fit(*full))
    return np.stack([fit.weights for fit in fits], axis=1)


def _all_directions(
    samples: _Samples, ids: NDArray[np.int64], near: NDArray[np.int32]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """As ``normal_equations`` of vertices ``ids`` (n,) and neighbours (n, k), with all directions."""
    present, columns = near >= 0, np.maximum(near, 0)
    gram = samples.products[columns[:, :, None], columns[:, None, :]]
    gram *= present[:, :, None] & present[:, None, :]
    correlation = np.take_along_axis(samples.projections[ids], columns, axis=1) * present
    return gram, correlation, (samples.exact[ids].astype(np.float64) ** 2).sum(axis=1)
