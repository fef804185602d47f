"""Sparse vertices and the dense vertices beside them on their own surface ([HR10] 5.3)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.measurement.neighbours import Neighbours, renumber, surface_neighbours
from mi_sparse_prt.methods.dense_sampling import Dense, DenseSampler
from mi_sparse_prt.scene.scene import Mesh, Scene
from mi_sparse_prt.solvers.walls import Walls

NEIGHBOURS = 12  # dense ones
AROUND = 12  # of all vertices
LEAST_NEIGHBOURS = 3  # with fewer a vertex becomes dense


@dataclass
class Neighbourhood:
    """The sparse vertices (n_sparse,) of a mesh, and dense neighbours of all its vertices: indices into Dense."""

    mesh: Mesh
    sparse: NDArray[np.int64]
    near: Neighbours

    @property
    def near_sparse(self) -> NDArray[np.int32]:
        """Neighbours (n_sparse, k) of the sparse vertices."""
        return self.near.ids[self.sparse - self.mesh.vertices.start]

    def dense_around_sparse(self, dense: Dense) -> NDArray[np.int32]:
        """Neighbours (n_sparse, k) of the sparse vertices, by their names in the scene; -1 where there are fewer."""
        return renumber(self.near_sparse, dense.ids)

    def around(self, scene: Scene) -> NDArray[np.int32]:
        """The nearest of all vertices (n, k) around each vertex, by their names in the scene."""
        inside = self.mesh.vertices
        p, n = scene.normalised_positions[inside], scene.normals[inside]
        around = surface_neighbours(p, n, p, n, AROUND + 1)
        # the first is the vertex itself
        return renumber(around.ids[:, 1:], np.arange(inside.start, inside.stop))


def neighbourhoods(sampler: DenseSampler) -> tuple[Dense, list[Neighbourhood]]:
    """Dense neighbours of all sparse vertices; vertices with too few within reach become dense first."""
    scene, clock, dense = sampler.scene, sampler.run.clock, sampler.dense()
    with clock.phase("neighbours"):
        groups = [_neighbourhood(scene, dense, mesh) for mesh in scene.meshes]
        walls = Walls(scene, sampler.direct.points)
        few = [group.sparse[_lonely(walls, group, dense)] for group in groups]
    lonely = np.concatenate(few)
    if not len(lonely):
        return dense, groups
    sampler.add(lonely)
    more = sampler.dense()
    with clock.phase("neighbours"):
        for number, (group, found) in enumerate(zip(groups, few, strict=True)):
            if len(found):
                groups[number] = _neighbourhood(scene, more, group.mesh)
            else:
                shift = more.of_mesh(group.mesh).start - dense.of_mesh(group.mesh).start
                ids = np.where(group.near.ids >= 0, group.near.ids + np.int32(shift), -1)
                groups[number] = replace(group, near=replace(group.near, ids=ids))
    return more, groups


def _lonely(walls: Walls, group: Neighbourhood, dense: Dense) -> NDArray[np.bool_]:
    """Sparse vertices (n_sparse,) with too few neighbours, or none on their side of walls."""
    near = group.dense_around_sparse(dense)
    return ((near >= 0).sum(axis=1) < LEAST_NEIGHBOURS) | walls.leave_fewer(1, group.sparse, near)


def _neighbourhood(scene: Scene, dense: Dense, mesh: Mesh) -> Neighbourhood:
    chosen, inside = dense.of_mesh(mesh), mesh.vertices
    own = dense.ids[chosen]
    sparse = np.setdiff1d(np.arange(inside.start, inside.stop), own)
    p, n = scene.normalised_positions, scene.normals
    near = surface_neighbours(p[inside], n[inside], p[own], n[own], NEIGHBOURS)
    ids = np.where(near.ids >= 0, near.ids + np.int32(chosen.start), -1)
    return Neighbourhood(mesh, sparse, Neighbours(ids, near.distances))
