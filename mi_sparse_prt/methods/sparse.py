"""``method="sparse"``: the idea of [HR10], with visibility and indirect light each reconstructed as suits it best.

Visibility is binary. Where all dense neighbours of a sparse vertex agree, it agrees with them; where they differ, a
ray is traced and its value kept. So the direct part is exact in cosine and solid angle, and one bit per element is all
that is stored: with 260 sampled values a vertex, weights and residual of T = A D + S would take more memory.

Indirect light is smooth. Dense rows are path traced on a quarter of the directions, freed of noise by their low rank,
and interpolated along the surface: T_indirect = A D.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mi_sparse_prt.cost import Stopwatch
from mi_sparse_prt.hashing import mix
from mi_sparse_prt.matrix import Indirect, Interpolated, Visibility
from mi_sparse_prt.methods.dense import Dense, DenseSampler, indirect_of
from mi_sparse_prt.methods.parts import Parts
from mi_sparse_prt.reconstruction.low_rank import denoised
from mi_sparse_prt.reconstruction.neighbours import Neighbours, linear_weights, surface_neighbours
from mi_sparse_prt.sampling.angular import AngularGrid
from mi_sparse_prt.sampling.bits import Bits, above_horizon, counts, listed, pack, scattered
from mi_sparse_prt.sampling.features import contested
from mi_sparse_prt.scene import Mesh, Scene
from mi_sparse_prt.transport.direct import DirectTransport
from mi_sparse_prt.transport.path import PathTransport

DENSE = 0.2  # of the vertices of a mesh
RADIUS = 0.05  # of a local matrix, in longest sides of the scene: [HR10] has 0.2 on a ground of 4
NEIGHBOURS = 12
LEAST_NEIGHBOURS = 3  # with fewer a vertex becomes dense
HELD_OUT = 16  # random directions per sparse vertex in a round of repair
POOL = 32  # vertices whose held-out directions are judged together
TOLERATED = 0.03  # relative L2 of a neighbourhood's direct light that is not repaired
ROUNDS = 2


def sparse_parts(
    scene: Scene,
    direct: DirectTransport,
    indirect: PathTransport | None,
    seed: int,
    clock: Stopwatch,
    progress: bool,
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
        Phases as in [HR10] Figure 12: ``dense_rays``, ``sparse_rays``, ``dense_paths``, ``spatial_sampling``,
        ``rank``, ``angular_sampling``, ``neighbours``, ``consensus``, ``repair``, ``solver``.
    progress : bool
    """
    grid = AngularGrid(direct.lighting)
    sampler = DenseSampler(scene, direct, grid, clock)
    for mesh in scene.meshes:
        sampler.choose(mesh, DENSE, RADIUS, seed)
    dense, groups = _neighbourhoods(scene, sampler, clock)

    state = _Visibility(direct, dense, clock)
    for group in groups:
        state.reconstruct(group)
    for number in range(ROUNDS):
        for group in groups:
            state.repair(scene, group, (seed << 4) + number)

    part = None
    if indirect is not None:
        density = _indirect_rows(scene, indirect, dense, grid, clock, progress)
        with clock.phase("solver"):
            weights = _weights(scene, groups, dense)
        part = Interpolated(Indirect(density, grid.upsampling, direct.lighting), weights)
    return _account(scene, direct, indirect, dense, grid, state, part)


@dataclass
class _Neighbourhood:
    """The sparse vertices (n_sparse,) of a mesh, and dense neighbours of all its vertices: indices into Dense."""

    mesh: Mesh
    sparse: NDArray[np.int64]
    near: Neighbours

    @property
    def near_sparse(self) -> NDArray[np.int32]:
        """Neighbours (n_sparse, k) of the sparse vertices."""
        return self.near.ids[self.sparse - self.mesh.vertices.start]


def _neighbourhoods(
    scene: Scene, sampler: DenseSampler, clock: Stopwatch
) -> tuple[Dense, list[_Neighbourhood]]:
    """Dense neighbours of all sparse vertices; vertices with too few on their own surface become dense first."""
    dense = sampler.dense()
    with clock.phase("neighbours"):
        groups = [_neighbourhood(scene, dense, mesh) for mesh in scene.meshes]
        few = [g.sparse[(g.near_sparse >= 0).sum(axis=1) < LEAST_NEIGHBOURS] for g in groups]
    lonely = np.concatenate(few)
    if not len(lonely):
        return dense, groups
    sampler.add(lonely)
    dense = sampler.dense()
    with clock.phase("neighbours"):
        return dense, [_neighbourhood(scene, dense, mesh) for mesh in scene.meshes]


def _neighbourhood(scene: Scene, dense: Dense, mesh: Mesh) -> _Neighbourhood:
    chosen, inside = dense.of_mesh(mesh), mesh.vertices
    own = dense.ids[chosen]
    sparse = np.setdiff1d(np.arange(inside.start, inside.stop), own)
    p, n = scene.normalised_positions, scene.normals
    near = surface_neighbours(p[inside], n[inside], p[own], n[own], NEIGHBOURS)
    ids = np.where(near.ids >= 0, chosen[near.ids], -1).astype(np.int32)
    return _Neighbourhood(mesh, sparse, Neighbours(ids, near.distances))


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
            self.visible, self.evaluated = np.zeros_like(self.above), np.zeros_like(self.above)
            self.visible[dense.ids] = dense.rows.visible
            self.evaluated[dense.ids] = dense.rows.evaluated

    def reconstruct(self, group: _Neighbourhood) -> None:
        """Rows of sparse vertices: what their neighbours agree on, and traced rays elsewhere."""
        rows = self._dense.rows
        with self._clock.phase("consensus"):
            differ, agreed = contested(group.near_sparse, rows.visible, rows.above, self.above[group.sparse])
            self.visible[group.sparse] = agreed
            self._trace(group.sparse, differ)

    def repair(self, scene: Scene, group: _Neighbourhood, seed: int) -> int:
        """Look at random borrowed elements; where they are wrong too often, trace more. Returns repaired vertices.

        What is traced are the directions in which the nearest of all vertices differ: they are nearer than the dense
        ones, and know more by now.
        """
        if not len(group.sparse):
            return 0
        with self._clock.phase("repair"):
            poor = group.sparse[self._pooled_error(scene, group, seed) > TOLERATED**2]
            if not len(poor):
                return 0
            inside, p, n = group.mesh.vertices, scene.normalised_positions, scene.normals
            near = surface_neighbours(p[poor], n[poor], p[inside], n[inside], NEIGHBOURS + 1)
            # the first neighbour is the vertex itself
            differ, _ = contested(near.ids[:, 1:], self.visible[inside], self.above[inside], self.above[poor])
            self._trace(poor, differ & ~self.evaluated[poor])
        return len(poor)

    def _pooled_error(self, scene: Scene, group: _Neighbourhood, seed: int) -> NDArray[np.float64]:
        """Squared relative error of rows, (n,), from held-out elements of the nearest sparse vertices of each."""
        texels = _random_texels(
            self._direct.points.keys[group.sparse], seed, self._direct.lighting.n_directions
        )
        borrowed = self.above[group.sparse] & ~self.evaluated[group.sparse]
        asked = borrowed & _as_bits(texels, borrowed.shape[1])
        left = counts(borrowed)
        tried, wrong = counts(asked), counts(self._trace(group.sparse, asked))
        tree = cKDTree(scene.normalised_positions[group.sparse])
        _, pool = tree.query(tree.data, min(POOL, len(group.sparse)), workers=-1)
        pool = pool.reshape(len(group.sparse), -1)
        seen = counts(self.visible[group.sparse])
        rate = wrong[pool].sum(axis=1) / np.maximum(tried[pool].sum(axis=1), 1)
        return rate * left[pool].sum(axis=1) / np.maximum(seen[pool].sum(axis=1), 1)

    def _trace(self, vertices: NDArray[np.int64], asked: Bits) -> Bits:
        """Evaluate and keep elements; returns those that were not as borrowed before."""
        ids, texels = listed(asked)
        with self._clock.phase("sparse_rays"):
            values = self._direct.visible(vertices[ids], texels)
        seen = scattered(asked, values)
        before = self.visible[vertices]
        self.visible[vertices] = (before & ~asked) | seen
        self.evaluated[vertices] |= asked
        return (before ^ seen) & asked


def _random_texels(keys: NDArray[np.uint64], seed: int, n_directions: int) -> NDArray[np.int64]:
    """Texels (n, HELD_OUT) at random, made of the keys of vertices: the same in whatever order these come."""
    salt = mix(np.arange(HELD_OUT, dtype=np.uint64) + np.uint64((seed * HELD_OUT) % (1 << 63)))
    return (mix(mix(keys)[:, None] ^ salt) % np.uint64(n_directions)).astype(np.int64)


def _as_bits(texels: NDArray[np.int64], words: int) -> Bits:
    """Bits (n, words) with the listed texels (n, k) set."""
    bits = np.zeros((len(texels), words), np.uint32)
    for column in texels.T:
        bits[np.arange(len(texels)), column >> 5] |= np.uint32(1) << (column & 31).astype(np.uint32)
    return bits


def _indirect_rows(
    scene: Scene,
    indirect: PathTransport,
    dense: Dense,
    grid: AngularGrid,
    clock: Stopwatch,
    progress: bool,
) -> NDArray[np.float16]:
    """Indirect light (n_dense, n_grid, channels) of the dense vertices on the quarter grid, freed of noise by mesh."""
    density = np.empty((len(dense.ids), len(grid.texels), indirect.channels), np.float16)
    for mesh in scene.meshes:
        chosen = dense.of_mesh(mesh)
        # by key: sums over rows then round alike in whatever order vertices come
        chosen = chosen[np.argsort(indirect.points.keys[dense.ids[chosen]], kind="stable")]
        with clock.phase("dense_paths"):
            rows = indirect_of(indirect, dense.ids[chosen], grid.texels, f"indirect {mesh.name}", progress)
        with clock.phase("low_rank"):
            for channel in range(indirect.channels):
                density[chosen, :, channel] = denoised(rows.mean[..., channel], rows.variance[..., channel])[
                    0
                ]
    return density


def _weights(scene: Scene, groups: list[_Neighbourhood], dense: Dense) -> scipy.sparse.csr_array:
    """A (n_v, n_dense): dense rows take part in their own smoothing, with their neighbours'."""
    p, n = scene.normalised_positions, scene.normals
    rows, columns, values = [], [], []
    for group in groups:
        inside, ids = group.mesh.vertices, group.near.ids
        weights = linear_weights(group.near, p[inside], n[inside], p[dense.ids], n[dense.ids])
        present = ids >= 0
        rows.append(np.repeat(np.arange(inside.start, inside.stop), present.sum(axis=1)))
        columns.append(ids[present].astype(np.int64))
        values.append(weights[present])
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return scipy.sparse.coo_array(entries, shape=(len(p), len(dense.ids))).tocsr()


def _account(
    scene: Scene,
    direct: DirectTransport,
    indirect: PathTransport | None,
    dense: Dense,
    grid: AngularGrid,
    state: _Visibility,
    part: Interpolated | None,
) -> Parts:
    """The parts, and how many elements of each were evaluated."""
    quarter = np.zeros(direct.lighting.n_directions, bool)
    quarter[grid.texels] = True
    either = counts(state.evaluated)
    if part is not None:
        either[dense.ids] = counts(state.evaluated[dense.ids] | pack(quarter))
    paths = len(dense.ids) * len(grid.texels) if part is not None else 0
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
            "dense_vertices": len(dense.of_mesh(mesh)) / (mesh.vertices.stop - mesh.vertices.start),
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
