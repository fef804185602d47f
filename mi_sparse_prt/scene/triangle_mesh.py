"""Triangles with one normal per vertex, in plain NumPy, and what every step on them needs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import scipy.sparse
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from mi_sparse_prt.core.random_keys import hash_rows, mix


@dataclass
class TriangleMesh:
    """Triangles with one normal per vertex.

    Attributes
    ----------
    name : str
        What messages call it.
    positions : (n, 3) float32
    normals : (n, 3) float32 or None
        Unit shading normals; None until computed.
    triangles : (t, 3) int32
    texcoords : (n, 2) float32 or None
    vertex_attributes, face_attributes : dict of name -> (n, k) or (t, k) float32
        Mesh attributes under Mitsuba's names (``vertex_color``, ``face_id``, ...).
    unsplit : TriangleMesh or None
        The same surface in fewer triangles, of one normal each: as it was before edges were bisected.
    """

    name: str
    positions: NDArray[np.float32]
    normals: NDArray[np.float32] | None
    triangles: NDArray[np.int32]
    texcoords: NDArray[np.float32] | None = None
    vertex_attributes: dict[str, NDArray[np.float32]] = field(default_factory=dict)
    face_attributes: dict[str, NDArray[np.float32]] = field(default_factory=dict)
    unsplit: TriangleMesh | None = None

    def take_vertices(self, index: NDArray[np.integer], triangles: NDArray[np.integer]) -> TriangleMesh:
        """The mesh whose vertex k is this one's vertex ``index[k]``; ``triangles`` has the new numbers."""
        return replace(
            self,
            positions=self.positions[index],
            normals=None if self.normals is None else self.normals[index],
            texcoords=None if self.texcoords is None else self.texcoords[index],
            vertex_attributes={k: v[index] for k, v in self.vertex_attributes.items()},
            triangles=np.ascontiguousarray(triangles, np.int32),
            unsplit=None,
        )

    def take_triangles(self, index: NDArray[np.integer] | NDArray[np.bool_]) -> TriangleMesh:
        """The mesh with only the triangles of ``index`` (indices or a mask), all vertices kept."""
        return replace(
            self,
            triangles=np.ascontiguousarray(self.triangles[index]),
            face_attributes={k: v[index] for k, v in self.face_attributes.items()},
            unsplit=None,
        )


def concatenated(meshes: Sequence[TriangleMesh]) -> TriangleMesh:
    """Meshes with normals as one, named as the first, with the texture coordinates and attributes that all have."""
    first = meshes[0]
    if len(meshes) == 1:
        return first
    offsets = np.cumsum([0, *(len(m.positions) for m in meshes[:-1])])
    textured = all(m.texcoords is not None for m in meshes)

    def joined(attributes: list[dict[str, NDArray[np.float32]]]) -> dict[str, NDArray[np.float32]]:
        shared = [
            k
            for k, v in attributes[0].items()
            if all(k in a and a[k].shape[1] == v.shape[1] for a in attributes)
        ]
        return {k: np.concatenate([a[k] for a in attributes]) for k in shared}

    split = any(m.unsplit is not None for m in meshes)
    return TriangleMesh(
        first.name,
        np.concatenate([m.positions for m in meshes]),
        np.concatenate([m.normals for m in meshes if m.normals is not None]),
        np.concatenate([m.triangles + k for m, k in zip(meshes, offsets, strict=True)]).astype(np.int32),
        np.concatenate([m.texcoords for m in meshes if m.texcoords is not None]) if textured else None,
        joined([m.vertex_attributes for m in meshes]),
        joined([m.face_attributes for m in meshes]),
        concatenated([m.unsplit or m for m in meshes]) if split else None,
    )


def triangle_normals(mesh: TriangleMesh) -> NDArray[np.float64]:
    """(t, 3) cross products of the triangles' edges: along the face normal, twice the area long."""
    p = mesh.positions.astype(np.float64)[mesh.triangles]  # [triangle, corner, xyz]
    return np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])


def is_flat(mesh: TriangleMesh) -> bool:
    """Whether the corners of each triangle have the same normal, within what rotations leave of it in float32."""
    assert mesh.normals is not None
    of_corners = mesh.normals[mesh.triangles]  # [triangle, corner, xyz]
    return bool(np.abs(of_corners - of_corners[:, :1]).max(initial=0.0) < 1e-6)


def normalise_rows(v: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rows scaled to unit length; zero rows stay zero."""
    length = np.linalg.norm(v, axis=1, keepdims=True)
    return v / np.where(length > 0, length, 1.0)


def unique_rows(rows: NDArray) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First index of each distinct row, and for each row which it is; far faster than `np.unique` by rows."""
    code = np.zeros(len(rows), np.int64)
    for column in rows.T:
        _, value = np.unique(column, return_inverse=True)
        _, code = np.unique(code * (value.max(initial=0) + 1) + value, return_inverse=True)
    _, first = np.unique(code, return_index=True)
    return first, code


def connected_pieces(triangles: NDArray[np.integer], n: int) -> tuple[int, NDArray[np.int32]]:
    """How many connected pieces triangles (t, 3) form, and which one each of n vertices belongs to, (n,).

    Vertices are welded by position first (``unique_rows``): seams do not part a surface. A vertex of no triangle is a
    piece as well.
    """
    edges = triangles[:, [0, 1]].ravel(), triangles[:, [1, 2]].ravel()
    graph = scipy.sparse.coo_array((np.ones(2 * len(triangles), np.int8), edges), shape=(n, n))
    return connected_components(graph, directed=False)


def as_one(meshes: Sequence[TriangleMesh]) -> tuple[TriangleMesh, NDArray[np.int64]]:
    """Positions, normals and triangles of meshes with normals as those of one; which one each vertex is of, (n,)."""
    if not meshes:
        nothing = np.zeros((0, 3), np.float32)
        return TriangleMesh("", nothing, nothing, np.zeros((0, 3), np.int32)), np.zeros(0, np.int64)
    bare = [TriangleMesh(mesh.name, mesh.positions, mesh.normals, mesh.triangles) for mesh in meshes]
    return concatenated(bare), np.repeat(np.arange(len(meshes)), [len(mesh.positions) for mesh in meshes])


class Pieces(NamedTuple):
    """Connected pieces of triangles, those of the first mesh first.

    Attributes
    ----------
    of : (t,) int64
        The piece that each triangle belongs to.
    first : (pieces,) int64
        A triangle of each.
    corners : (t, 3) int64
        Vertices of the triangles, welded by position: seams do not part a surface.
    """

    of: NDArray[np.int64]
    first: NDArray[np.int64]
    corners: NDArray[np.int64]


def find_pieces(mesh: TriangleMesh, mesh_of: NDArray[np.integer] | None = None) -> Pieces:
    """Connected pieces of a mesh, or of meshes that are one, where no piece is of two (``as_one``)."""
    rows = mesh.positions.astype(np.float64)
    first, same = unique_rows(rows if mesh_of is None else np.column_stack([mesh_of, rows]))
    corners = same[mesh.triangles]
    _, label = connected_pieces(corners, len(first))
    _, found, of = np.unique(label[corners[:, 0]], return_index=True, return_inverse=True)
    return Pieces(of, found, corners)


def triangle_keys(mesh: TriangleMesh, vertex_keys: NDArray[np.uint64], seed: np.uint64) -> NDArray[np.uint64]:
    """(t,) hash of each triangle, whatever their order: its corners, the smallest key first, and material (`seed`)."""
    corners = vertex_keys
    if mesh.texcoords is not None:
        corners = hash_rows(mesh.texcoords, corners)
    for _, values in sorted(mesh.vertex_attributes.items()):
        corners = hash_rows(values, corners)
    keys = corners[mesh.triangles]  # [triangle, corner]
    order = (np.argmin(keys, axis=1)[:, None] + np.arange(3)) % 3
    state = np.full(len(keys), seed)
    for corner in np.take_along_axis(keys, order, axis=1).T:
        state = mix(state ^ corner)
    for _, values in sorted(mesh.face_attributes.items()):
        state = hash_rows(values, state)
    return state
