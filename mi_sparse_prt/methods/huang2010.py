"""``method="huang2010"``: sparse precomputation as published ([HR10] sections 4 and 5), nothing added or left out.

Dense vertices: a quarter of the directions, and the features; indirect light on the quarter grid. Sparse vertices: the
350 best directions, direct and indirect light together; weights of all dense vertices within a radius by L1
minimization; T(x) = sum of weights times their rows. Sampled values serve the fit and are not kept.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import psutil
import scipy.sparse
from numpy.typing import NDArray

from mi_sparse_prt.core.bits import count_bits
from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.core.profiling import Stopwatch
from mi_sparse_prt.core.run import Run
from mi_sparse_prt.measurement.neighbours import radius_neighbours
from mi_sparse_prt.methods.dense_sampling import Dense, DenseSampler, indirect_of
from mi_sparse_prt.methods.half_floats import halved
from mi_sparse_prt.methods.result import MethodResult
from mi_sparse_prt.operators.interpolated import Interpolated
from mi_sparse_prt.operators.upsampled import Upsampled
from mi_sparse_prt.operators.visibility import Visibility
from mi_sparse_prt.reconstruction.l1 import l1_fit
from mi_sparse_prt.reconstruction.normal_equations import normal_equations
from mi_sparse_prt.sampling.angular import AngularGrid
from mi_sparse_prt.sampling.features import choose_features
from mi_sparse_prt.sampling.spatial import SpatialSampling
from mi_sparse_prt.scene.scene import Mesh, Scene
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.paths import PathSolver

BLOCK = 4096  # sparse vertices at a time
ROWS = 256  # whole rows of dense vertices at a time

# The dense vertices and their rows (n_dense, n_directions), means over channels -> a function from dense neighbours
# (n, k) of sparse vertices to the directions (n, s) in which these are sampled; -1 where there are fewer
Columns = Callable[[Dense, NDArray[np.float32]], Callable[[NDArray[np.int32]], NDArray[np.int32]]]


@dataclass(frozen=True)
class Huang2010Options:
    """The paper's constants.

    Attributes
    ----------
    model, ground : float
        Share of a mesh's vertices that is dense; a ground is a plane (Figure 9).
    radius : float
        Of neighbourhoods, in longest sides of the scene: 0.2 on a ground from -2 to 2 (Figure 8).
    least_neighbours, most_neighbours : int
        Section 5.1; the nearest ones where the radius holds fewer.
    directions : int
        At which a sparse vertex is sampled (Figure 8).
    relative_lambda : float
        Weight of the L1 norm, relative to the one beyond which all weights are 0 (the paper gives none).
    columns : callable, optional
        Chooses the directions of sparse vertices by another rule than the paper's (section 5.2), which takes the
        features of each one's own neighbours.
    """

    model: float = 0.25
    ground: float = 0.205
    radius: float = 0.05
    least_neighbours: int = 10
    most_neighbours: int = 40
    directions: int = 350
    relative_lambda: float = 1e-2
    columns: Columns | None = None

    def directions_of(
        self, dense: Dense, mean: NDArray[np.float32]
    ) -> Callable[[NDArray[np.int32]], NDArray[np.int32]]:
        """See ``Columns``."""
        if self.columns is not None:
            return self.columns(dense, mean)
        return lambda near: choose_features(near, mean, dense.rows.features, self.directions)


def huang2010_parts(
    direct: DirectSolver, indirect: PathSolver | None, run: Run, options: Huang2010Options | None = None
) -> MethodResult:
    """Evaluate and reconstruct T as the paper does; parameters as for ``sparse_parts``.

    Raises
    ------
    PrtError
        If the whole rows of the dense vertices, of which L1 minimization makes its equations, do not fit into memory.
    """
    options, scene, grid = options or Huang2010Options(), direct.problem.scene, AngularGrid(direct.lighting)
    fractions = {m.name: options.ground if _flat(scene, m) else options.model for m in scene.meshes}
    _refuse_what_does_not_fit(scene, fractions, direct, indirect)
    sampler = DenseSampler(direct, grid, run)
    for mesh in scene.meshes:
        sampler.choose(mesh, SpatialSampling(fractions[mesh.name], radius=options.radius))
    dense = sampler.dense()
    visibility = Visibility(dense.rows.visible, scene.normals[dense.ids], direct.lighting)
    interreflected, kept = None, None
    if indirect is not None:
        with run.clock.phase("dense_paths"):
            rows, kept = indirect_of(indirect, dense.ids, grid.texels, run)
            interreflected = Upsampled(halved(rows.mean), grid.upsampling, direct.lighting)
    with run.clock.phase("system"):
        stacked, mean = whole_rows(visibility, interreflected)
    weights, evaluated, sparse = _fitted(direct, indirect, dense, stacked, mean, run, options)
    if kept:
        kept.remove()
    # the paper counts the whole grid, below the horizon too
    per_dense = count_bits(dense.rows.evaluated | grid.bits)
    elements = int(per_dense.sum()) + int(evaluated.sum())
    rays = int(count_bits(dense.rows.evaluated).sum()) + int(evaluated.sum())
    traced = len(dense.ids) * len(grid.texels) + int(evaluated.sum()) if indirect else 0
    return MethodResult(
        Interpolated(visibility, weights),
        Interpolated(interreflected, weights) if interreflected else None,
        elements,
        {"direct": elements, "indirect": traced},
        {"direct": rays, "indirect_paths": traced * indirect.spp if indirect else 0},
        sampling={
            mesh.name: _rates(mesh, dense, per_dense, sparse, evaluated, direct.lighting.n_directions)
            for mesh in scene.meshes
        },
        dense=np.sort(dense.ids),
    )


def _refuse_what_does_not_fit(
    scene: Scene, fractions: dict[str, float], direct: DirectSolver, indirect: PathSolver | None
) -> None:
    """Before anything is traced: whole rows of all dense vertices and channels, and their means, in float32."""
    n_dense = sum(fractions[mesh.name] * (mesh.vertices.stop - mesh.vertices.start) for mesh in scene.meshes)
    channels = indirect.channels if indirect else 1
    needed = n_dense * direct.lighting.n_directions * 4 * (channels + (channels > 1))
    available = psutil.virtual_memory().available
    if needed > available:
        raise PrtError(
            f'method "huang2010" needs {needed / 1e9:.1f} GB for rows of {n_dense:.0f} dense vertices but '
            f'{available / 1e9:.1f} GB are free; lower the resolution of the lighting, or set method="sparse"'
        )


def _flat(scene: Scene, mesh: Mesh) -> bool:
    """Whether a mesh is a plane: the paper's ground."""
    normals = scene.normals[mesh.vertices]
    return bool((normals @ normals[0] > 0.999).all())


def _fitted(
    direct: DirectSolver,
    indirect: PathSolver | None,
    dense: Dense,
    stacked: NDArray[np.float32],
    mean: NDArray[np.float32],
    run: Run,
    options: Huang2010Options,
) -> tuple[scipy.sparse.csr_array, NDArray[np.int64], NDArray[np.int64]]:
    """Weights A (n_v, n_dense) of all vertices, and how many elements each sparse vertex (given last) cost."""
    n, clock = len(direct.points), run.clock
    sparse = np.setdiff1d(np.arange(n), dense.ids)
    with clock.phase("features"):
        directions_of = options.directions_of(dense, mean)
    owners, used_rows, values = [dense.ids], [np.arange(len(dense.ids))], [np.ones(len(dense.ids))]
    cost = np.zeros(len(sparse), np.int64)
    with run.bar(len(sparse), "sparse", " vertices") as bar:
        for a in range(0, len(sparse), BLOCK):
            ids = sparse[a : a + BLOCK]
            with clock.phase("neighbours"):
                near = _near(direct.problem.scene, ids, dense, options)
            with clock.phase("features"):
                directions = directions_of(near)
            cost[a : a + len(ids)] = (directions >= 0).sum(axis=1)
            sampled = _sampled(direct, indirect, ids, directions, clock)
            with clock.phase("solver"):
                fit = _weights(stacked, near, directions, sampled, options.relative_lambda)
                # no features, no equations: the neighbours do not differ there, and their mean stands for them
                alone = (directions < 0).all(axis=1)
                fit[alone] = (near[alone] >= 0) / np.maximum((near[alone] >= 0).sum(axis=1, keepdims=True), 1)
                used = fit != 0
                owners.append(np.repeat(ids, used.sum(axis=1)))
                used_rows.append(near[used])
                values.append(fit[used])
            bar.update(len(ids))
    entries = (
        np.concatenate(values).astype(np.float32),
        (np.concatenate(owners), np.concatenate(used_rows)),
    )
    return scipy.sparse.coo_array(entries, shape=(n, len(dense.ids))).tocsr(), cost, sparse


def whole_rows(
    visibility: Visibility, interreflected: Upsampled | None
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Whole rows of unit-albedo transport: dense vertices, from which L1 minimization has its equations.

    Parameters
    ----------
    visibility : Visibility
        Of the dense vertices, n_dense rows.
    interreflected : Indirect or None
        Of the same vertices.

    Returns
    -------
    stacked : (n_dense, channels * n_directions) float32
        Channel after channel. This is the greatest array of the method, so it is filled block by block.
    mean : (n_dense, n_directions) float32
        Over the channels; ``stacked`` itself if there is one.
    """
    n, n_directions = len(visibility.bits), visibility.lighting.n_directions
    channels = interreflected.density.shape[2] if interreflected else 1
    stacked = np.empty((n, channels * n_directions), np.float32)
    mean = stacked if channels == 1 else np.empty((n, n_directions), np.float32)
    for a in range(0, n, ROWS):
        ids = np.arange(a, min(a + ROWS, n))
        rows = visibility.rows(ids)  # [dense vertex, direction, channel]
        if interreflected is not None:
            rows = rows + interreflected.rows(ids)
        stacked[ids] = np.moveaxis(rows, 2, 1).reshape(len(ids), -1)
        if channels > 1:
            mean[ids] = rows.mean(axis=2)
    return stacked, mean


def _near(scene: Scene, ids: NDArray[np.int64], dense: Dense, options: Huang2010Options) -> NDArray[np.int32]:
    """Dense neighbours (n, most) by radius alone, and the nearest ones where the radius holds too few."""
    p, least = scene.normalised_positions, options.least_neighbours
    near = radius_neighbours(p[ids], p[dense.ids], options.radius, options.most_neighbours).ids
    few = (near >= 0).sum(axis=1) < least
    if few.any():
        near[few, :least] = radius_neighbours(p[ids[few]], p[dense.ids], np.inf, least).ids
    return near


def _sampled(
    direct: DirectSolver,
    indirect: PathSolver | None,
    ids: NDArray[np.int64],
    directions: NDArray[np.int32],
    clock: Stopwatch,
) -> NDArray[np.float32]:
    """Unit-albedo transport (n, s, channels) of vertices at their directions; 0 where there are fewer."""
    present = directions >= 0
    vertices, texels = np.repeat(ids, present.sum(axis=1)), directions[present]
    with clock.phase("sparse_rays"):
        unit_albedo = direct.elements(vertices, texels)[:, None]
    if indirect is not None:
        with clock.phase("sparse_paths"):
            mean = indirect.elements(vertices, texels).mean
        unit_albedo = unit_albedo + mean * direct.lighting.solid_angles[texels][:, None]
    sampled = np.zeros((*directions.shape, unit_albedo.shape[1]), np.float32)
    sampled[present] = unit_albedo
    return sampled


def _weights(
    stacked: NDArray[np.float32],
    near: NDArray[np.int32],
    directions: NDArray[np.int32],
    sampled: NDArray[np.float32],
    relative_lambda: float,
) -> NDArray[np.float64]:
    """L1 weights (n, k); the channels of a direction are equations of their own."""
    channels = sampled.shape[2]
    n_directions = stacked.shape[1] // channels
    rows_of = [np.where(directions >= 0, directions + c * n_directions, -1) for c in range(channels)]
    wide = np.concatenate(rows_of, axis=1).astype(np.int32)
    values = np.concatenate([sampled[..., c] for c in range(channels)], axis=1)
    return l1_fit(*normal_equations(stacked, near, wide, values), relative_lambda).weights


def _rates(
    mesh: Mesh,
    dense: Dense,
    per_dense: NDArray[np.int64],
    sparse: NDArray[np.int64],
    evaluated: NDArray[np.int64],
    n_directions: int,
) -> dict[str, float]:
    """Sampling rates of a mesh, as in Figure 9."""
    own = per_dense[dense.of_mesh(mesh)]
    others = (sparse >= mesh.vertices.start) & (sparse < mesh.vertices.stop)
    n = len(own) + int(others.sum())
    total = own.sum() + evaluated[others].sum()
    return {
        "dense_vertices": len(own) / n,
        "dense_directions": float(own.mean()) / n_directions,
        "sparse_directions": float(evaluated[others].mean()) / n_directions if others.any() else 0.0,
        "elements": float(total) / (n * n_directions),
    }
