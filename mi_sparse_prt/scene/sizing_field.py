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
from mi_sparse_prt.scene.triangle_mesh import TriangleMesh, as_one, find_pieces, unique_rows

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

    def exceeded(self, points: Doubles, lengths: Doubles) -> NDArray[np.bool_]:
        """Which edges (n,) are longer than they may be, of so long ones with these midpoints (n, 3), world units."""
        long = lengths > self.longest * (1 + TIE)
        octaves = np.floor(np.log2(np.maximum(lengths, 1e-300)))
        for shortest, tree in reversed(self.pieces):
            some = np.flatnonzero(~long & (lengths > shortest * (1 + TIE)))
            for octave in np.unique(octaves[some]):
                # what is farther from pieces may be as long: a search that ends there takes far less time
                own, reach = some[octaves[some] == octave], 2 ** (octave + 1) / GRADE
                distances, _ = tree.query(points[own], distance_upper_bound=reach, workers=-1)
                long[own] = lengths[own] > GRADE * distances * (1 + TIE)
        return long


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
    whole, of = as_one(meshes)
    halvings = _halvings(whole, of, edge_length)
    moves = np.array([project is not None for project in projections], np.bool_)
    found, details = list(meshes), None
    count = len(whole.positions)
    more = min(limit - count, max(LEAST, int(SHARE * count)))
    deepest = min(MOST, int(halvings.max(initial=0)))
    if not deepest:
        return found, details
    for most in (deepest, *range(1, deepest)):  # mostly, all can be had; if not, as much as can be
        try:
            wanted = np.minimum(halvings, most)
            field = SizingField(edge_length, _small_pieces(whole, moves[of], wanted, edge_length, more))
            long = np.unique(of[_ends_of_long_edges(whole, field)])
            found, details = _subdivided(meshes, projections, long, field, more), field.details
        except TooManyVerticesError:
            if most < deepest:
                break
        else:
            if most == deepest:
                break
    return found, details


def _halvings(mesh: TriangleMesh, mesh_of: NDArray[np.int64], edge_length: float) -> NDArray[np.int64]:
    """(t,) how often an edge is halved that is to fit the connected piece that a triangle belongs to."""
    if not len(mesh.triangles):
        return np.zeros(0, np.int64)
    pieces = find_pieces(mesh, mesh_of)
    order = np.argsort(pieces.of, kind="stable")
    starts = np.flatnonzero(np.diff(pieces.of[order], prepend=-1))
    points = mesh.positions.astype(np.float64)[mesh.triangles[order]]  # [triangle, corner, xyz]
    high = np.maximum.reduceat(points.max(axis=1), starts)
    box = high - np.minimum.reduceat(points.min(axis=1), starts)
    fitting = np.linalg.norm(box, axis=1) / ACROSS
    halved = np.log2(edge_length / np.maximum(fitting * (1 + TIE), edge_length / 2**MOST))
    return np.maximum(np.rint(halved), 0).astype(np.int64)[pieces.of]


def _small_pieces(
    mesh: TriangleMesh,
    moves: NDArray[np.bool_],
    halvings: NDArray[np.int64],
    edge_length: float,
    more: int,
) -> list[tuple[float, KDTree]]:
    """Pieces by how often an edge is halved that is to fit them.

    Those whose vertices (``moves``) may become more have so many more at most, or TooManyVerticesError; what stays as
    it is has the vertices that it has.
    """
    found, of_moving = [], moves[mesh.triangles[:, 0]]
    for k in range(1, int(halvings.max()) + 1):
        length, points = edge_length / 2**k, []
        for part in (of_moving, ~of_moving):
            piece, _ = drop_unreferenced(mesh.take_triangles((halvings == k) & part))
            if part is of_moving and len(piece.triangles):
                piece = subdivide(piece, length, len(piece.positions) + more)
            points.append(piece.positions.astype(np.float64))
        every = np.concatenate(points)
        if len(every):
            first, _ = unique_rows(np.floor(every / (length / 2)))
            found.append((length, KDTree(every[first])))
    return found


def _ends_of_long_edges(mesh: TriangleMesh, field: SizingField) -> NDArray[np.int32]:
    """Vertices at which an edge starts that is to be split."""
    start, end = mesh.triangles.ravel(), np.roll(mesh.triangles, -1, axis=1).ravel()
    a, b = (mesh.positions[ends].astype(np.float64) for ends in (start, end))
    length = np.linalg.norm(b - a, axis=1)
    some = np.flatnonzero(length > field.shortest * (1 + TIE))
    ends: NDArray[np.int32] = start[some[field.exceeded((a[some] + b[some]) / 2, length[some])]]
    return ends


def _subdivided(
    meshes: Sequence[TriangleMesh],
    projections: Sequence[Project | None],
    which: NDArray[np.integer],
    field: SizingField,
    more: int,
) -> list[TriangleMesh]:
    """Meshes of which some have edges to be split; at most so many vertices ``more``, or TooManyVerticesError."""
    found = list(meshes)
    for k in which:
        project = projections[k]
        if project is not None:
            count = len(meshes[k].positions)
            found[k] = subdivide(meshes[k], field, count + more, project)
            more -= len(found[k].positions) - count
    return found
