"""``method="sparse"``: the idea of [HR10], with visibility and indirect light each reconstructed as suits it best.

Visibility is binary. Where all dense neighbours of a sparse vertex agree, it agrees with them; where they differ, a
ray is traced and its value kept. So the direct part is exact in cosine and solid angle, and one bit per element is all
that is stored: with 260 sampled values a vertex, weights and residual of T = A D + S would take more memory.

Indirect light is smooth. Dense rows are path traced on a quarter of the directions, freed of noise by their low rank,
and interpolated along the surface: T_indirect = A D. See ``methods.sparse_indirect``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.bits import count_bits
from mi_sparse_prt.core.profiling import Stopwatch
from mi_sparse_prt.core.run import Run
from mi_sparse_prt.methods.dense_neighbourhoods import neighbourhoods
from mi_sparse_prt.methods.dense_sampling import Dense, DenseSampler
from mi_sparse_prt.methods.result import MethodResult
from mi_sparse_prt.methods.sparse_indirect import IndirectOptions, indirect_part
from mi_sparse_prt.operators.visibility import Visibility
from mi_sparse_prt.sampling.angular import AngularGrid
from mi_sparse_prt.sampling.consensus import Consensus
from mi_sparse_prt.sampling.spatial import SpatialSampling
from mi_sparse_prt.scene.scene import Mesh
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.paths import PathSolver


@dataclass(frozen=True)
class SparseOptions:
    """What the method may be tuned by.

    Attributes
    ----------
    spatial : SpatialSampling
        Dense vertices of a mesh. They are drawn by a higher power of their rank than in [HR10], as errors of indirect
        light gather where things meet; local matrices are as wide as there (0.2 on a ground of 4).
    repairs : int
        How often the visibility of all vertices is compared with that of the nearest ones.
    indirect : IndirectOptions
    """

    spatial: SpatialSampling = SpatialSampling(0.22, 0.22 / 4, 0.05, power=1.75)
    repairs: int = 2
    indirect: IndirectOptions = IndirectOptions()


def sparse_parts(
    direct: DirectSolver, indirect: PathSolver | None, run: Run, options: SparseOptions | None = None
) -> MethodResult:
    """Evaluate few elements of T and reconstruct the others.

    Parameters
    ----------
    direct : DirectSolver
        Direction basis, at the scene's vertices.
    indirect : PathSolver or None
        At the same vertices and the full resolution of the lighting.
    run : Run
        Phases as in [HR10] Figure 12: ``dense_rays``, ``sparse_rays``, ``dense_paths``, ``sparse_paths``,
        ``spatial_sampling``, ``rank``, ``angular_sampling``, ``neighbours``, ``consensus``, ``repair``, ``low_rank``,
        ``system``, ``solver``. Dense rows of the indirect light are kept in checkpoints.
    options : SparseOptions, optional
    """
    options, scene, clock = options or SparseOptions(), direct.problem.scene, run.clock
    grid = AngularGrid(direct.lighting)
    sampler = DenseSampler(direct, grid, run)
    for mesh in scene.meshes:
        sampler.choose(mesh, options.spatial)
    dense, groups = neighbourhoods(sampler)

    state = _known(direct, dense, grid, clock)
    for group in groups:
        with clock.phase("consensus"):
            state.agree(group.sparse, group.dense_around_sparse(dense))
        with clock.phase("repair"):
            # the nearest of all vertices are nearer than the dense ones, and know more by now; what dense rows have
            # borrowed in angle is compared as well
            near, inside = group.around(scene), group.mesh.vertices
            for _ in range(options.repairs):
                state.repair(np.arange(inside.start, inside.stop), near)

    part, paths = None, 0
    if indirect is not None:
        part, paths = indirect_part(indirect, dense, groups, state.evaluated, grid, run, options.indirect)
    rays = int(count_bits(state.evaluated).sum())
    either = _evaluated_rows(dense, grid, state, part is not None)
    return MethodResult(
        Visibility(state.visible, scene.normals, direct.lighting),
        part,
        int(either.sum()),
        {"direct": rays, "indirect": paths},
        {"direct": rays, "indirect_paths": paths * indirect.spp if indirect else 0},
        sampling={mesh.name: _rates(mesh, dense, either, grid) for mesh in scene.meshes},
        dense=np.sort(dense.ids),
    )


def _known(direct: DirectSolver, dense: Dense, grid: AngularGrid, clock: Stopwatch) -> Consensus:
    """Visibility with the rows of dense vertices in it."""

    def trace(vertices: NDArray[np.uint32], texels: NDArray[np.uint32]) -> NDArray[np.bool_]:
        with clock.phase("sparse_rays"):
            return direct.visible(vertices, texels)

    with clock.phase("consensus"):
        state = Consensus(direct.points.normals, grid, trace)
        state.visible[dense.ids], state.evaluated[dense.ids] = dense.rows.visible, dense.rows.evaluated
    return state


def _evaluated_rows(dense: Dense, grid: AngularGrid, state: Consensus, indirect: bool) -> NDArray[np.int64]:
    """Elements (n_v,) of each row at which direct or indirect light was evaluated."""
    either = count_bits(state.evaluated)
    if indirect:
        either[dense.ids] = count_bits(state.evaluated[dense.ids] | grid.bits)
    return either


def _rates(mesh: Mesh, dense: Dense, either: NDArray[np.int64], grid: AngularGrid) -> dict[str, float]:
    """Sampling rates of a mesh, as in [HR10] Figure 9."""
    own = dense.ids[dense.of_mesh(mesh)]
    sparse = np.setdiff1d(np.arange(mesh.vertices.start, mesh.vertices.stop), own)
    n, m = mesh.vertices.stop - mesh.vertices.start, grid.lighting.n_directions
    return {
        "dense_vertices": len(own) / n,
        "dense_directions": float(either[own].mean()) / m,
        "sparse_directions": float(either[sparse].mean()) / m if len(sparse) else 0.0,
        "elements": float(either[mesh.vertices].mean()) / m,
    }
