"""Nodes for indirect light, where there are more vertices than it needs, and its interpolation between them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mi_sparse_prt.core.morton import morton_order
from mi_sparse_prt.measurement.neighbours import Neighbours, surface_neighbours
from mi_sparse_prt.measurement.vertices import Points
from mi_sparse_prt.reconstruction.interpolation_weights import linear_weights
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.solvers.surface_nodes import Nodes
from mi_sparse_prt.solvers.walls import Walls

NODES = 1 << 16  # of a scene, if nothing else is asked for
# Vertices of a piece, of which none is left out; a larger piece has as many nodes at least. Of four rooms of 160 to 330
# thousand vertices 1024 of them left 0.85 to 1.2 times the error, with up to 1.7 times the nodes; 64 up to 1.8 times.
SMALL = 1 << 8
FEW = 1 << 6  # the same, where nodes stand for light that others see from afar

Ids = NDArray[np.int64]


class _Weights(NamedTuple):
    """Entries of weights: vertices (m,), their nodes (m,), both among the scene's vertices, and numbers (m,)."""

    vertices: Ids
    nodes: Ids
    values: NDArray[np.float32]


def node_count(scene: Scene, most: int = NODES, small: int = SMALL) -> int:
    """How many nodes ``choose_nodes`` chooses, about."""
    if scene.n_vertices <= most:
        return scene.n_vertices
    return int(_wanted(_sizes(scene), most, small).sum())


def choose_nodes(
    scene: Scene, points: Points, most: int = NODES, small: int = SMALL, neighbours: int = 8
) -> Nodes:
    """About ``most`` vertices, evenly spread among those of each connected piece of a mesh; all of small pieces.

    Light is interpolated within pieces: leaves of a tree are near each other and look elsewhere. Those that send
    nothing on, such as glass, have no nodes and no light. Which vertices are chosen depends on where these are and on
    their keys, not on their order, nor on how pieces are shared out among meshes.

    Parameters
    ----------
    scene : Scene
    points : Points
        Of all vertices.
    most : int
        Nodes of the scene; more where small pieces have more vertices.
    small : int
        Vertices of a piece, of which none is left out; a larger piece has as many nodes at least.
    neighbours : int
        Nodes from which a vertex takes its light.

    Returns
    -------
    Nodes
    """
    n = scene.n_vertices
    if n <= most:
        return Nodes(np.arange(n), None)
    sizes = _sizes(scene)
    wanted = _wanted(sizes, most, small)
    every = np.flatnonzero(((wanted == sizes) & (sizes > 0))[scene.pieces])
    found, walls = [_Weights(every, every, np.ones(len(every), np.float32))], Walls(scene, points)
    for piece in np.flatnonzero(wanted < sizes):
        members = np.flatnonzero(scene.pieces == piece)
        found.append(_between_nodes(scene, points, walls, members, int(wanted[piece]), neighbours))
    vertices, nodes, values = (np.concatenate(column) for column in zip(*found, strict=True))
    ids, number = np.unique(nodes, return_inverse=True)
    return Nodes(ids, scipy.sparse.csr_array((values, (vertices, number)), shape=(n, len(ids))))


class Near(NamedTuple):
    """Nodes near each of some vertices, the nearest first, (n, k), -1 for none, and their weights."""

    nodes: Ids
    weights: NDArray[np.float32]


def nodes_among(
    scene: Scene, points: Points, members: Ids, most: int, neighbours: int, small: int = FEW
) -> Near:
    """Some vertices of each piece as nodes of others, as ``choose_nodes``; all are their own if there are not so many.

    Parameters
    ----------
    scene, points
        As for ``choose_nodes``.
    members : (n,) int64
        Ascending.
    most, neighbours, small : int
        As for ``choose_nodes``.
    """
    found = Near(np.full((len(members), neighbours), -1), np.zeros((len(members), neighbours), np.float32))
    found.nodes[:, 0], found.weights[:, 0] = members, 1
    if len(members) <= most:
        return found
    piece, walls = scene.pieces[members], Walls(scene, points, gaps=True)
    wanted = _wanted(np.bincount(piece), most, small)
    for one in np.unique(piece):
        own = np.flatnonzero(piece == one)
        if wanted[one] < len(own):
            near = _near_nodes(scene, points, walls, members[own], int(wanted[one]), neighbours)
            some = own[near.nodes[:, 0] >= 0]  # others see no node, and are their own
            found.nodes[some], found.weights[some] = (part[near.nodes[:, 0] >= 0] for part in near)
    return found


def _sizes(scene: Scene) -> Ids:
    """Vertices of each piece; 0 of those that send nothing on, if others do: nobody asks what they receive."""
    sizes, sent = np.bincount(scene.pieces), np.bincount(scene.pieces, scene.sent_albedo.max(axis=1))
    return np.where((sent > 0) | (not sent.any()), sizes, 0)


def _wanted(sizes: Ids, most: int, small: int) -> Ids:
    """Nodes of pieces of so many vertices."""
    kept = sizes <= small
    share = max(most - sizes[kept].sum(), 0) / max(sizes[~kept].sum(), 1)
    return np.where(kept, sizes, np.clip(np.round(share * sizes), small, sizes)).astype(np.int64)


def _between_nodes(
    scene: Scene, points: Points, walls: Walls, members: Ids, wanted: int, neighbours: int
) -> _Weights:
    """Weights of nodes for the vertices of a piece."""
    near = _near_nodes(scene, points, walls, members, wanted, neighbours)
    vertex, place = np.nonzero(near.nodes >= 0)
    return _Weights(members[vertex], near.nodes[vertex, place], near.weights[vertex, place])


def _near_nodes(
    scene: Scene, points: Points, walls: Walls, members: Ids, wanted: int, neighbours: int
) -> Near:
    p, n = scene.normalised_positions[members], scene.normals[members]
    order = morton_order(p, points.keys[members])
    # the middle one of each of so many stretches along the curve
    nodes = order[(2 * np.arange(wanted) + 1) * len(p) // (2 * wanted)]

    def nearest(nodes: Ids) -> Neighbours:
        near = surface_neighbours(p, n, p[nodes], n[nodes], neighbours)
        return walls.without_hidden(members, near, members[nodes])

    near = nearest(nodes)
    alone = np.flatnonzero(near.ids[:, 0] < 0)  # no node faces the same way, on this side of walls
    if len(alone):
        nodes = np.concatenate([nodes, alone])
        near = nearest(nodes)
    weights = linear_weights(near, p, n, p[nodes], n[nodes])
    return Near(np.where(near.ids >= 0, members[nodes][near.ids], -1), weights)
