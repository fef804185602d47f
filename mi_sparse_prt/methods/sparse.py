"""``method="sparse"``: the idea of [HR10], with visibility and indirect light each reconstructed as suits it best.

Visibility is binary. Where all dense neighbours of a sparse vertex agree, it agrees with them; where they differ, a
ray is traced and its value kept. So the direct part is exact in cosine and solid angle, and one bit per element is all
that is stored: with 260 sampled values a vertex, weights and residual of T = A D + S would take more memory.

Indirect light is smooth. Dense rows are path traced on a quarter of the directions, freed of noise by their low rank,
and interpolated along the surface: T_indirect = A D. See ``methods.sparse_indirect``.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.bits import count_bits, pack
from mi_sparse_prt.core.profiling import Stopwatch
from mi_sparse_prt.methods.dense_neighbourhoods import neighbourhoods
from mi_sparse_prt.methods.dense_sampling import Dense, DenseSampler
from mi_sparse_prt.methods.result import MethodResult
from mi_sparse_prt.methods.sparse_indirect import indirect_part
from mi_sparse_prt.operators.interpolated import Interpolated
from mi_sparse_prt.operators.visibility import Visibility
from mi_sparse_prt.sampling.angular import AngularGrid
from mi_sparse_prt.sampling.consensus import Consensus
from mi_sparse_prt.scene.scene import Mesh, Scene
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.paths import PathSolver

DENSE = 0.22  # of the vertices of a mesh
STEP = DENSE / 4  # of them in an iteration
POWER = 1.75  # of the rank, by which they are drawn: errors of indirect light gather where things meet
RADIUS = 0.05  # of a local matrix, in longest sides of the scene: [HR10] has 0.2 on a ground of 4
ROUNDS = 2  # of repair


def sparse_parts(
    scene: Scene,
    direct: DirectSolver,
    indirect: PathSolver | None,
    seed: int,
    clock: Stopwatch,
    progress: bool,
    checkpoint: Path | None = None,
    dense_fraction: float | None = None,
) -> MethodResult:
    """Evaluate few elements of T and reconstruct the others.

    Parameters
    ----------
    scene : Scene
    direct : DirectSolver
        Direction basis, at the scene's vertices.
    indirect : PathSolver or None
        At the same vertices and the full resolution of the lighting.
    seed : int
    clock : Stopwatch
        Phases as in [HR10] Figure 12: ``dense_rays``, ``sparse_rays``, ``dense_paths``, ``sparse_paths``,
        ``spatial_sampling``, ``rank``, ``angular_sampling``, ``neighbours``, ``consensus``, ``repair``, ``low_rank``,
        ``system``, ``solver``.
    progress : bool
    checkpoint : Path, optional
        Finished dense rows of the indirect light are kept in files that begin with this name, until all is done.
    dense_fraction : float, optional
        Of the vertices of each mesh; about a fifth if not given.
    """
    grid = AngularGrid(direct.lighting)
    sampler = DenseSampler(scene, direct, grid, clock)
    for mesh in scene.meshes:
        sampler.choose(mesh, dense_fraction or DENSE, RADIUS, seed, POWER, STEP)
    dense, groups = neighbourhoods(scene, sampler, clock)

    state = _known(direct, dense, grid, clock)
    for group in groups:
        with clock.phase("consensus"):
            state.agree(group.sparse, group.dense_around_sparse(dense))
        with clock.phase("repair"):
            # the nearest of all vertices are nearer than the dense ones, and know more by now; what dense rows have
            # borrowed in angle is compared as well
            near, inside = group.around(scene), group.mesh.vertices
            for _ in range(ROUNDS):
                state.repair(np.arange(inside.start, inside.stop), near)

    part, paths = None, 0
    if indirect is not None:
        part, paths = indirect_part(
            scene, indirect, dense, groups, state.evaluated, grid, clock, progress, checkpoint
        )
    return _account(scene, direct, indirect, dense, grid, state, part, paths)


def _known(direct: DirectSolver, dense: Dense, grid: AngularGrid, clock: Stopwatch) -> Consensus:
    """Visibility with the rows of dense vertices in it."""

    def trace(vertices: NDArray[np.uint32], texels: NDArray[np.uint32]) -> NDArray[np.bool_]:
        with clock.phase("sparse_rays"):
            return direct.visible(vertices, texels)

    with clock.phase("consensus"):
        state = Consensus(direct.points.normals, grid, trace)
        state.visible[dense.ids], state.evaluated[dense.ids] = dense.rows.visible, dense.rows.evaluated
    return state


def _account(
    scene: Scene,
    direct: DirectSolver,
    indirect: PathSolver | None,
    dense: Dense,
    grid: AngularGrid,
    state: Consensus,
    part: Interpolated | None,
    paths: int,
) -> MethodResult:
    """The parts, and how many elements of each were evaluated."""
    quarter = np.zeros(direct.lighting.n_directions, bool)
    quarter[grid.texels] = True
    either = count_bits(state.evaluated)
    if part is not None:
        either[dense.ids] = count_bits(state.evaluated[dense.ids] | pack(quarter))
    rays = int(count_bits(state.evaluated).sum())
    parts = MethodResult(
        Visibility(state.visible, scene.normals, direct.lighting),
        part,
        int(either.sum()),
        {"direct": rays, "indirect": paths},
        {"direct": rays, "indirect_paths": paths * indirect.spp if indirect else 0},
    )
    n_directions = direct.lighting.n_directions
    parts.sampling = {
        mesh.name: {
            "dense_vertices": len(dense.ids[dense.of_mesh(mesh)])
            / (mesh.vertices.stop - mesh.vertices.start),
            "dense_directions": float(either[dense.ids[dense.of_mesh(mesh)]].mean()) / n_directions,
            "sparse_directions": _mean_outside(either, dense.ids, mesh) / n_directions,
            "elements": float(either[mesh.vertices].mean()) / n_directions,
        }
        for mesh in scene.meshes
    }
    return parts


def _mean_outside(values: NDArray[np.int64], dense: NDArray[np.int64], mesh: Mesh) -> float:
    """Mean over the sparse vertices of a mesh, 0 if there are none."""
    outside = np.setdiff1d(np.arange(mesh.vertices.start, mesh.vertices.stop), dense)
    return float(values[outside].mean()) if len(outside) else 0.0
