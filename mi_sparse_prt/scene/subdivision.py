"""Bisection of long edges, without T-junctions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.scene.triangle_mesh import TriangleMesh, is_flat, normalise_rows, triangle_normals

#: Edges longer by this share than asked for are still accepted, so that ties (a square's diagonal is a power
#: of two of its default edge) do not depend on how float32 rounds a scene that was scaled or moved.
TIE = 0.01

Doubles: TypeAlias = NDArray[np.float64]
#: Points of a surface, and its unit normals there, for points and normals next to it: (n, 3) each.
Project: TypeAlias = Callable[[Doubles, Doubles], tuple[Doubles, Doubles]]


class EdgeLength(Protocol):
    """How long edges may be, depending on where they are."""

    @property
    def shortest(self) -> float:
        """Anywhere."""

    def exceeded(self, points: Doubles, lengths: Doubles) -> NDArray[np.bool_]:
        """Which edges (n,) are longer, of so long ones with these midpoints (n, 3)."""


class TooManyVerticesError(PrtError):
    """A shape would have more vertices than allowed."""


def too_many_vertices(name: str, edge_length: float, limit: int) -> TooManyVerticesError:
    """The error of a shape that would have more vertices than allowed."""
    return TooManyVerticesError(
        f"shape '{name}': edges of {edge_length:.4g} need more than {limit} vertices: "
        "use a larger edge_length (inf leaves meshes as they are)"
    )


def as_it_is(points: Doubles, normals: Doubles) -> tuple[Doubles, Doubles]:
    """The projection of surfaces that are what their triangles are."""
    return points, normals


def subdivide(
    mesh: TriangleMesh,
    edge_length: float | EdgeLength,
    limit: int,
    project: Project = as_it_is,
) -> TriangleMesh:
    """Bisect every edge longer than `edge_length` until none is left.

    An edge's length and midpoint decide alone, so both of its sides split there and no T-junction appears, also
    between vertices that share a position but not a normal. Triangles with one, two or three long edges become
    two, three or four. Positions, texture coordinates and attributes are interpolated linearly; normals too, then
    normalised. The old vertices come first, in their order. What it was is kept (``unsplit``) where all triangles
    are flat.

    Parameters
    ----------
    edge_length : float or EdgeLength
        In the mesh's own units; `inf` changes nothing.
    limit : int
        The largest number of vertices allowed.
    project : callable
        Puts midpoints onto a surface that is curved.

    Raises
    ------
    TooManyVerticesError
        If more than `limit` vertices would be needed.
    """
    if isinstance(edge_length, float | int):
        shortest = float(edge_length)
        _check_area(mesh, shortest, limit)
    else:
        shortest = edge_length.shortest
    before = mesh
    while True:
        t = mesh.triangles
        edges = np.sort(
            np.stack([t, np.roll(t, -1, axis=1)], axis=2), axis=2
        )  # [triangle, edge, low and high]
        flat = edges.reshape(-1, 2).astype(np.int64)
        code, inverse = np.unique(flat[:, 0] * len(mesh.positions) + flat[:, 1], return_inverse=True)
        ends = np.stack(np.divmod(code, len(mesh.positions)), axis=1)  # [edge, low and high]
        a, b = (mesh.positions.astype(np.float64)[ends[:, k]] for k in (0, 1))
        length = np.linalg.norm(a - b, axis=1)
        long = length > shortest * (1 + TIE)
        if not isinstance(edge_length, float | int):
            long[long] = edge_length.exceeded((a[long] + b[long]) / 2, length[long])
        if not long.any():
            was_split = mesh is not before and is_flat(before)
            return replace(mesh, unsplit=before.unsplit or before) if was_split else mesh
        count = len(mesh.positions) + int(np.sum(long))
        if count > limit:
            raise too_many_vertices(mesh.name, shortest, limit)
        midpoint = np.full(len(ends), -1, np.int64)
        midpoint[long] = np.arange(len(mesh.positions), count)
        mesh = _split(_with_midpoints(mesh, ends[long], project), midpoint[inverse.reshape(-1, 3)])


def _check_area(mesh: TriangleMesh, edge_length: float, limit: int) -> None:
    """Refuse what is hopeless before it is built."""
    # No triangle with such edges is larger than the equilateral one, and a surface has half as many vertices as
    # triangles.
    area = float(np.linalg.norm(triangle_normals(mesh), axis=1).sum()) / 2
    if area / (np.sqrt(3) / 4 * (edge_length * (1 + TIE)) ** 2) / 2 > 1.1 * limit:
        raise too_many_vertices(mesh.name, edge_length, limit)


def _with_midpoints(mesh: TriangleMesh, ends: NDArray[np.int64], project: Project) -> TriangleMesh:
    """The mesh with the midpoints of the edges `ends` [edge, 2] appended to its vertices."""

    def means(values: NDArray[np.float32]) -> Doubles:
        mean: Doubles = values[ends].astype(np.float64).mean(axis=1)
        return mean

    def appended(values: NDArray[np.float32], more: Doubles) -> NDArray[np.float32]:
        return np.concatenate([values, more.astype(np.float32)])

    def middle(values: NDArray[np.float32]) -> NDArray[np.float32]:
        return appended(values, means(values))

    assert mesh.normals is not None
    n = mesh.normals[ends].astype(np.float64)  # [edge, end, xyz]
    total = n.sum(axis=1)
    opposed = np.linalg.norm(total, axis=1, keepdims=True) < 1e-6
    normals = normalise_rows(np.where(opposed, n[:, 0], total))
    points, normals = project(means(mesh.positions), normals)
    return replace(
        mesh,
        positions=appended(mesh.positions, points),
        normals=appended(mesh.normals, normals),
        texcoords=None if mesh.texcoords is None else middle(mesh.texcoords),
        vertex_attributes={k: middle(v) for k, v in mesh.vertex_attributes.items()},
    )


def _split(mesh: TriangleMesh, midpoint: NDArray[np.int64]) -> TriangleMesh:
    """Triangles split at `midpoint` [triangle, edge], -1 for edges that stay; edge k joins corners k, k + 1."""
    t = mesh.triangles.astype(np.int64)
    n_split = np.sum(midpoint >= 0, axis=1)
    # Rotate corners so that the one split edge is edge 0, and the one whole edge of two splits is edge 2.
    first = np.where(
        n_split == 1, np.argmax(midpoint >= 0, axis=1), (np.argmin(midpoint >= 0, axis=1) + 1) % 3
    )
    order = (first[:, None] + np.arange(3)) % 3
    a, b, c = np.take_along_axis(t, order, axis=1).T
    ab, bc, ca = np.take_along_axis(midpoint, order, axis=1).T

    p = mesh.positions.astype(np.float64)
    two = n_split == 2
    # After the corner b is cut off, a quad a, ab, bc, c is left: cut it along its shorter diagonal.
    ac_bc = np.linalg.norm(p[a] - p[bc], axis=1) <= np.linalg.norm(p[ab] - p[c], axis=1)
    pieces = [
        (n_split == 0, (a, b, c)),
        (n_split == 1, (a, ab, c)),
        (n_split == 1, (ab, b, c)),
        (two, (ab, b, bc)),
        (two & ac_bc, (a, ab, bc)),
        (two & ac_bc, (a, bc, c)),
        (two & ~ac_bc, (a, ab, c)),
        (two & ~ac_bc, (ab, bc, c)),
        (n_split == 3, (a, ab, ca)),
        (n_split == 3, (ab, b, bc)),
        (n_split == 3, (ca, bc, c)),
        (n_split == 3, (ab, bc, ca)),
    ]
    triangles = np.concatenate([np.column_stack([k[mask] for k in corners]) for mask, corners in pieces])
    parent = np.concatenate([np.flatnonzero(mask) for mask, _ in pieces])
    return replace(
        mesh,
        triangles=triangles.astype(np.int32),
        face_attributes={k: v[parent] for k, v in mesh.face_attributes.items()},
    )
