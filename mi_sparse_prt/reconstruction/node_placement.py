"""Nodes for indirect light, where there are more vertices than it needs, and its interpolation between them."""

from __future__ import annotations

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mi_sparse_prt.core.morton import morton_order
from mi_sparse_prt.core.ragged import row_starts
from mi_sparse_prt.measurement.neighbours import Neighbours, surface_neighbours
from mi_sparse_prt.measurement.vertices import Points
from mi_sparse_prt.reconstruction.interpolation_weights import linear_weights
from mi_sparse_prt.scene.scene import Mesh, Scene
from mi_sparse_prt.solvers.surface_nodes import Nodes
from mi_sparse_prt.solvers.walls import Walls

NODES = 1 << 16  # of a scene, if nothing else is asked for


def choose_nodes(
    scene: Scene, points: Points, most: int = NODES, small: int = 4096, neighbours: int = 8
) -> Nodes:
    """About ``most`` vertices, evenly spread among those of each mesh; all of small meshes.

    Which ones depends on where vertices are and on their keys, not on their order.

    Parameters
    ----------
    scene : Scene
    points : Points
        Of all vertices.
    most : int
        Nodes of the scene.
    small : int
        Vertices of a mesh, of which none is left out; a larger mesh has as many nodes at least.
    neighbours : int
        Nodes from which a vertex takes its light.

    Returns
    -------
    Nodes
    """
    n = scene.n_vertices
    if n <= most:
        return Nodes(np.arange(n), None)
    sizes = np.array([mesh.vertices.stop - mesh.vertices.start for mesh in scene.meshes])
    kept = sizes <= small
    share = max(most - sizes[kept].sum(), 0) / max(sizes[~kept].sum(), 1)
    chosen, weights, walls = [], [], Walls(scene, points)
    for mesh, size in zip(scene.meshes, sizes, strict=True):
        wanted = min(size, max(small, round(share * size)))
        ids, block = _nodes_of_mesh(scene, points, walls, mesh, wanted, neighbours)
        chosen.append(ids)
        weights.append(block)
    return Nodes(np.concatenate(chosen), scipy.sparse.block_diag(weights, format="csr"))


def _nodes_of_mesh(
    scene: Scene, points: Points, walls: Walls, mesh: Mesh, wanted: int, neighbours: int
) -> tuple[NDArray[np.int64], scipy.sparse.csr_array]:
    """Nodes of a mesh, and weights (vertices, nodes) of these."""
    inside = mesh.vertices
    p, n = scene.normalised_positions[inside], scene.normals[inside]
    if wanted == len(p):
        return np.arange(inside.start, inside.stop), scipy.sparse.eye_array(
            wanted, dtype=np.float32, format="csr"
        )
    order = morton_order(p, points.keys[inside])
    # the middle one of each of so many stretches along the curve
    nodes = order[(2 * np.arange(wanted) + 1) * len(p) // (2 * wanted)]

    def nearest(nodes: NDArray[np.int64]) -> Neighbours:
        near = surface_neighbours(p, n, p[nodes], n[nodes], neighbours)
        return walls.without_hidden(np.arange(inside.start, inside.stop), near, inside.start + nodes)

    near = nearest(nodes)
    alone = np.flatnonzero(near.ids[:, 0] < 0)  # no node faces the same way, on this side of walls
    if len(alone):
        nodes = np.concatenate([nodes, alone])
        near = nearest(nodes)
    weights = linear_weights(near, p, n, p[nodes], n[nodes])
    rank = np.argsort(np.argsort(nodes))  # of each node among all of the mesh
    present = near.ids >= 0
    starts = row_starts(present.sum(axis=1))
    entries = weights[present], rank[near.ids[present]], starts
    block = scipy.sparse.csr_array(entries, shape=(len(p), len(nodes)))
    return inside.start + np.sort(nodes), block
