"""``method="sparse"``: the idea of [HR10], with visibility and indirect light each reconstructed as suits it best.

Visibility is binary. Where all dense neighbours of a sparse vertex agree, it agrees with them; where they differ, a
ray is traced and its value kept. So the direct part is exact in cosine and solid angle, and one bit per element is all
that is stored: with 260 sampled values a vertex, weights and residual of T = A D + S would take more memory.

Indirect light is smooth. Dense rows are path traced on a quarter of the directions, freed of noise by their low rank,
and interpolated along the surface: T_indirect = A D. See ``methods.indirect``.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.cost import Stopwatch
from mi_sparse_prt.matrix import Interpolated, Visibility
from mi_sparse_prt.methods.dense import Dense, DenseSampler
from mi_sparse_prt.methods.indirect import indirect_part
from mi_sparse_prt.methods.neighbourhoods import Neighbourhood, neighbourhoods
from mi_sparse_prt.methods.parts import Parts
from mi_sparse_prt.sampling.angular import AngularGrid
from mi_sparse_prt.sampling.bits import Bits, above_horizon, counts, listed, overwrite, pack
from mi_sparse_prt.sampling.features import contested, copy_agreed
from mi_sparse_prt.scene import Mesh, Scene
from mi_sparse_prt.transport.direct import DirectTransport
from mi_sparse_prt.transport.path import PathTransport

DENSE = 0.22  # of the vertices of a mesh
STEP = DENSE / 4  # of them in an iteration
POWER = 1.5  # of the rank, by which they are drawn: errors of indirect light gather where things meet
RADIUS = 0.05  # of a local matrix, in longest sides of the scene: [HR10] has 0.2 on a ground of 4
ROUNDS = 2  # of repair
BLOCK = 1 << 14  # sparse vertices at a time, some hundred rays each


def sparse_parts(
    scene: Scene,
    direct: DirectTransport,
    indirect: PathTransport | None,
    seed: int,
    clock: Stopwatch,
    progress: bool,
    checkpoint: Path | None = None,
    dense_fraction: float | None = None,
) -> Parts:
    """Evaluate few elements of T and reconstruct the others.

    Parameters
    ----------
    scene : Scene
    direct : DirectTransport
        Direction basis, at the scene's vertices.
    indirect : PathTransport or None
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

    state = _Visibility(direct, dense, clock)
    for group in groups:
        state.agree(group)
        with clock.phase("repair"):
            near = group.around_sparse(scene)
        for _ in range(ROUNDS):
            state.repair(group, near)

    part, paths = None, 0
    if indirect is not None:
        part, paths = indirect_part(
            scene, indirect, dense, groups, state.evaluated, grid, clock, progress, checkpoint
        )
    return _account(scene, direct, indirect, dense, grid, state, part, paths)


class _Visibility:
    """Visibility of all vertices as it becomes known.

    Attributes
    ----------
    visible, evaluated, above : (n_v, words) uint32 bits
        As in ``DenseRows``.
    """

    def __init__(self, direct: DirectTransport, dense: Dense, clock: Stopwatch) -> None:
        self._direct, self._dense, self._clock = direct, dense, clock
        with clock.phase("consensus"):
            self.above = above_horizon(direct.points.normals, direct.lighting.directions)
            self.visible, self.evaluated = np.empty_like(self.above), np.zeros_like(self.above)
            self.visible[dense.ids] = dense.rows.visible
            self.evaluated[dense.ids] = dense.rows.evaluated

    def agree(self, group: Neighbourhood) -> None:
        """Rows of sparse vertices: what their dense neighbours agree on, and traced rays elsewhere."""
        near, rows, sparse = group.near_sparse, self._dense.rows, group.sparse
        with self._clock.phase("consensus"):
            copy_agreed(near, rows.visible, rows.above, sparse, self.above, self.visible)
            self._trace(sparse, contested(near, rows.visible, rows.above, sparse, self.above, self.evaluated))

    def repair(self, group: Neighbourhood, near: NDArray[np.int32]) -> None:
        """Trace where the nearest of all vertices differ: they are nearer than the dense ones, and know more by now.

        Parameters
        ----------
        group : Neighbourhood
        near : (n_sparse, k) int32
            Vertices of the mesh, counted from its first.
        """
        visible, above = (bits[group.mesh.vertices] for bits in (self.visible, self.above))
        with self._clock.phase("repair"):
            self._trace(
                group.sparse, contested(near, visible, above, group.sparse, self.above, self.evaluated)
            )

    def _trace(self, vertices: NDArray[np.int64], asked: Bits) -> None:
        """Evaluate and keep elements (n, words), some vertices at a time: lists are long."""
        for a in range(0, len(vertices), BLOCK):
            some, bits = vertices[a : a + BLOCK], asked[a : a + BLOCK]
            rows, texels = listed(bits)
            with self._clock.phase("sparse_rays"):
                values = self._direct.visible(some.astype(np.uint32)[rows], texels)
            overwrite(self.visible, self.evaluated, some, bits, values)


def _account(
    scene: Scene,
    direct: DirectTransport,
    indirect: PathTransport | None,
    dense: Dense,
    grid: AngularGrid,
    state: _Visibility,
    part: Interpolated | None,
    paths: int,
) -> Parts:
    """The parts, and how many elements of each were evaluated."""
    quarter = np.zeros(direct.lighting.n_directions, bool)
    quarter[grid.texels] = True
    either = counts(state.evaluated)
    if part is not None:
        either[dense.ids] = counts(state.evaluated[dense.ids] | pack(quarter))
    rays = int(counts(state.evaluated).sum())
    parts = Parts(
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
