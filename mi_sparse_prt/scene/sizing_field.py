"""Shorter edges near small things: what is large is as fine as these where they touch it, and coarser further away.

A thing as small as a cup in a room, or a chair on a plain, changes the light around it over its own size. Edges that
fit the whole scene would miss that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from mi_sparse_prt.scene.mesh_cleaning import drop_unreferenced
from mi_sparse_prt.scene.subdivision import TIE, Doubles, Project, TooManyVerticesError, subdivide
from mi_sparse_prt.scene.triangle_mesh import TriangleMesh, connected_pieces, unique_rows

ACROSS = 8  # edges along the diagonal of a piece, within a factor of sqrt(2): they are halved
GRADE = 0.5  # by which edges grow with their distance from a piece
SHARE = 0.25  # of the vertices there are, that may be added
LEAST = 8192  # vertices that may be added to any scene
MOST = 12  # halvings of the longest edge: a hair's breadth of a mile


class Details(NamedTuple):
    """Where a scene is finer than all of it would be.

    Attributes
    ----------
    centre : (3,) float64
        World space: in the middle of its smallest pieces.
    size : float
        Of the shortest edges there, beside the longest anywhere.
    """

    centre: Doubles
    size: float


@dataclass(frozen=True)
class SizingField:
    """How long edges may be.

    Attributes
    ----------
    longest : float
        Anywhere, world units.
    pieces : list of (float, KDTree)
        Lengths, and points of pieces of surfaces near which edges are to have these; the shortest last.
    """

    longest: float
    pieces: list[tuple[float, KDTree]]

    @property
    def shortest(self) -> float:
        """Anywhere, world units."""
        return self.pieces[-1][0]

    @property
    def details(self) -> Details:
        """Its smallest pieces."""
        _, tree = self.pieces[-1]
        return Details(np.median(tree.data, axis=0), self.shortest / self.longest)

    def __call__(self, points: Doubles) -> Doubles:
        """Of edges whose midpoints are these, (n, 3), world units: (n,)."""
        length = np.full(len(points), self.longest)
        for shortest, tree in self.pieces:
            distance, _ = tree.query(points, distance_upper_bound=self.longest / GRADE)
            length = np.minimum(length, np.maximum(shortest, GRADE * distance))
        return length


def refine_near_details(
    meshes: Sequence[TriangleMesh],
    projections: Sequence[Project | None],
    edge_length: float,
    limit: int,
) -> tuple[list[TriangleMesh], Details | None]:
    """Bisect edges of meshes near pieces that are small beside ``edge_length``, and edges of these pieces.

    Near a connected piece of a mesh, edges are about an eighth of its diagonal long at most, further away half of their
    distance. Where that takes too many vertices, the shortest edges are longer. Where all pieces are large, nothing
    changes, and there are no details.

    Parameters
    ----------
    meshes : sequence of TriangleMesh
        World space, with edges that are ``edge_length`` long at most; some may have no triangles.
    projections : sequence of Project or None
        Of each mesh, how its midpoints come to lie on it (see ``subdivide``); curved ones without are left as they are.
    edge_length : float
        World units.
    limit : int
        The largest number of vertices allowed.
    """
    halvings = [_halvings(mesh, edge_length) for mesh in meshes]
    found, details = list(meshes), None
    count = sum(len(mesh.positions) for mesh in meshes)
    more = min(limit - count, max(LEAST, int(SHARE * count)))
    deepest = min(MOST, max((int(h.max(initial=0)) for h in halvings), default=0))
    if not deepest:
        return found, details
    for most in (deepest, *range(1, deepest)):  # mostly, all can be had; if not, as much as can be
        try:
            field = SizingField(edge_length, _small_pieces(meshes, halvings, edge_length, most, more))
            found, details = _subdivided(meshes, projections, field, more), field.details
        except TooManyVerticesError:
            if most < deepest:
                break
        else:
            if most == deepest:
                break
    return found, details


def _halvings(mesh: TriangleMesh, edge_length: float) -> NDArray[np.int64]:
    """(t,) how often an edge is halved that is to fit the connected piece that a triangle belongs to."""
    if not len(mesh.triangles):
        return np.zeros(0, np.int64)
    first, same = unique_rows(mesh.positions)
    of = connected_pieces(same[mesh.triangles], len(first))[1][same].astype(np.int64)
    order = np.argsort(of, kind="stable")
    starts = np.flatnonzero(np.diff(of[order], prepend=-1))
    points = mesh.positions[order].astype(np.float64)
    box = np.maximum.reduceat(points, starts) - np.minimum.reduceat(points, starts)
    fitting = np.linalg.norm(box, axis=1) / ACROSS
    halved = np.log2(edge_length / np.maximum(fitting * (1 + TIE), edge_length / 2**MOST))
    return np.maximum(np.rint(halved), 0).astype(np.int64)[of[mesh.triangles[:, 0]]]


def _small_pieces(
    meshes: Sequence[TriangleMesh],
    halvings: Sequence[NDArray[np.int64]],
    edge_length: float,
    most: int,
    more: int,
) -> list[tuple[float, KDTree]]:
    """Of all meshes, by how often an edge is halved that is to fit them, ``most`` times at most.

    They have so many vertices ``more`` at most, or TooManyVerticesError.
    """
    found = []
    for k in range(1, most + 1):
        length, points = edge_length / 2**k, []
        for mesh, own in zip(meshes, halvings, strict=True):
            belongs = own == k if k < most else own >= k
            if belongs.any():
                piece, _ = drop_unreferenced(mesh.take_triangles(belongs))
                piece = subdivide(piece, length, len(piece.positions) + more)
                points.append(piece.positions.astype(np.float64))
        if points:
            every = np.concatenate(points)
            first, _ = unique_rows(np.floor(every / (length / 2)))
            found.append((length, KDTree(every[first])))
    return found


def _subdivided(
    meshes: Sequence[TriangleMesh],
    projections: Sequence[Project | None],
    field: SizingField,
    more: int,
) -> list[TriangleMesh]:
    """Meshes with edges as a field has them; at most so many vertices ``more``, or TooManyVerticesError."""
    found = []
    for mesh, project in zip(meshes, projections, strict=True):
        count = len(mesh.positions)
        fine = mesh if project is None else subdivide(mesh, field, count + more, project)
        more -= len(fine.positions) - count
        found.append(fine)
    return found
