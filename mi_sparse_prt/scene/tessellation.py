"""Triangles from shapes: parametric surfaces as grids, clean meshes, and bisection of long edges.

Everything here is plain NumPy in, plain NumPy out; Mitsuba is only met in ``scene.py``. A surface is a
`TriangleMesh`; each step (clean, tessellate, subdivide) takes one and returns a new one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.errors import PrtError

#: Edges longer by this share than asked for are still accepted, so that ties (a square's diagonal is a power
#: of two of its default edge) do not depend on how float32 rounds a scene that was scaled or moved.
TIE = 0.01


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
    """

    name: str
    positions: NDArray[np.float32]
    normals: NDArray[np.float32] | None
    triangles: NDArray[np.int32]
    texcoords: NDArray[np.float32] | None = None
    vertex_attributes: dict[str, NDArray[np.float32]] = field(default_factory=dict)
    face_attributes: dict[str, NDArray[np.float32]] = field(default_factory=dict)

    def take_vertices(self, index: NDArray[np.integer], triangles: NDArray[np.integer]) -> TriangleMesh:
        """The mesh whose vertex k is this one's vertex ``index[k]``; ``triangles`` has the new numbers."""
        return replace(
            self,
            positions=self.positions[index],
            normals=None if self.normals is None else self.normals[index],
            texcoords=None if self.texcoords is None else self.texcoords[index],
            vertex_attributes={k: v[index] for k, v in self.vertex_attributes.items()},
            triangles=np.ascontiguousarray(triangles, np.int32),
        )

    def take_triangles(self, index: NDArray[np.integer] | NDArray[np.bool_]) -> TriangleMesh:
        """The mesh with only the triangles of ``index`` (indices or a mask), all vertices kept."""
        return replace(
            self,
            triangles=np.ascontiguousarray(self.triangles[index]),
            face_attributes={k: v[index] for k, v in self.face_attributes.items()},
        )


# ---------------------------------------------------------------------------------------------- clean


def check_geometry(mesh: TriangleMesh) -> None:
    """Refuse what no renderer can use, naming the shape and the first bad vertex or triangle.

    Raises
    ------
    PrtError
        Positions that are not finite; triangles that refer to vertices that do not exist.
    """
    bad = np.flatnonzero(~np.isfinite(mesh.positions).all(axis=1))
    if bad.size:
        raise PrtError(
            f"shape '{mesh.name}': vertex {bad[0]} has a position that is not finite "
            f"({bad.size} such vertices): repair the mesh file"
        )
    n = len(mesh.positions)
    bad = np.flatnonzero(((mesh.triangles < 0) | (mesh.triangles >= n)).any(axis=1))
    if bad.size:
        raise PrtError(
            f"shape '{mesh.name}': triangle {bad[0]} refers to a vertex outside 0..{n - 1}: "
            "repair the mesh file"
        )


def triangle_normals(mesh: TriangleMesh) -> NDArray[np.float64]:
    """(t, 3) cross products of the triangles' edges: along the face normal, twice the area long."""
    p = mesh.positions.astype(np.float64)[mesh.triangles]  # [triangle, corner, xyz]
    return np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])


def drop_degenerate(mesh: TriangleMesh) -> tuple[TriangleMesh, int]:
    """Without the triangles of no area; and how many there were."""
    p = mesh.positions.astype(np.float64)[mesh.triangles]
    longest = np.max(np.sum((p - np.roll(p, 1, axis=1)) ** 2, axis=2), axis=1, initial=0.0)
    twice_area = np.linalg.norm(triangle_normals(mesh), axis=1)
    keep = twice_area > 1e-9 * longest  # smaller ones are lines to float32
    return (mesh, 0) if keep.all() else (mesh.take_triangles(keep), int(np.sum(~keep)))


def drop_unreferenced(mesh: TriangleMesh) -> tuple[TriangleMesh, int]:
    """Without the vertices that no triangle uses; and how many there were. The order of the rest is kept."""
    used = np.zeros(len(mesh.positions), bool)
    used[mesh.triangles] = True
    if used.all():
        return mesh, 0
    renumbered = np.cumsum(used) - 1
    return mesh.take_vertices(np.flatnonzero(used), renumbered[mesh.triangles]), int(np.sum(~used))


def angle_weighted_normals(mesh: TriangleMesh) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Vertex normals: face normals weighted by the angle at the vertex (Thuermer and Wuethrich 1998).

    Returns
    -------
    normals : (n, 3) float32
        Unit length. Where the faces cancel out, the normal of one of them; zero at vertices without faces.
    cancellation : (n,) float64
        Sum of weights over length of the sum: 1 where the faces agree, large where they cancel.
    """
    p = mesh.positions.astype(np.float64)[mesh.triangles]
    face = _normalised(triangle_normals(mesh))
    total, weight = np.zeros((len(mesh.positions), 3)), np.zeros(len(mesh.positions))
    fallback = np.zeros_like(total)
    for corner in range(3):
        vertex = mesh.triangles[:, corner]
        a = _normalised(p[:, (corner + 1) % 3] - p[:, corner])
        b = _normalised(p[:, (corner + 2) % 3] - p[:, corner])
        angle = np.arccos(np.clip(np.sum(a * b, axis=1), -1.0, 1.0))
        weight += np.bincount(vertex, angle, minlength=len(total))
        for axis in range(3):
            total[:, axis] += np.bincount(vertex, angle * face[:, axis], minlength=len(total))
        fallback[vertex] = face
    length = np.linalg.norm(total, axis=1)
    cancelled = length <= 1e-6 * weight
    # rounded, so that components that cancel to zero are zero in whatever order they were summed
    normals = np.round(_normalised(np.where(cancelled[:, None], fallback, total)), 12) + 0.0
    return normals.astype(np.float32), np.where(cancelled, np.inf, weight / np.where(cancelled, 1.0, length))


def stabilise_normals(mesh: TriangleMesh, recomputed: NDArray[np.float32]) -> TriangleMesh:
    """Normals with the same bits at every load, and none that only the loader's arithmetic spoilt.

    Mitsuba computes normals for files that have none, with parallel sums whose order changes from load to
    load, and gives NaN to the corners of triangles without area. What agrees with its computation is computed
    again here, in float64 and in order; what the file gave is kept.

    Parameters
    ----------
    recomputed : (n, 3) float32
        What Mitsuba's own computation gives for this mesh now.

    Raises
    ------
    PrtError
        Normals that are not finite, although Mitsuba would have computed finite ones.
    """
    assert mesh.normals is not None
    own, cancellation = angle_weighted_normals(mesh)
    # Normals that agree to this (times the cancellation in their sum) with those that Mitsuba computes were computed by
    # it: its parallel sums differ by 2e-7 from load to load.
    agreement = 1e-5
    lost = ~np.isfinite(mesh.normals).all(axis=1)
    with np.errstate(invalid="ignore"):
        near = np.max(np.abs(mesh.normals - recomputed), axis=1) <= agreement * cancellation
    computed = np.where(lost, ~np.isfinite(recomputed).all(axis=1) | np.isinf(cancellation), near)
    bad = np.flatnonzero(lost & ~computed)
    if bad.size:
        raise PrtError(
            f"shape '{mesh.name}': vertex {bad[0]} has a normal that is zero or not finite "
            f"({bad.size} such vertices): repair the mesh file, or leave its normals out"
        )
    return replace(mesh, normals=np.where(computed[:, None], own, mesh.normals))


def split_by_face(mesh: TriangleMesh) -> TriangleMesh:
    """Facets: each vertex is split by the normals of its faces, so that it has ONE normal, its face's.

    Faces of the same normal (to 1e-4) go on sharing their vertices: a flat quad keeps four.
    """
    face = _normalised(triangle_normals(mesh))  # [triangle, xyz]
    corner_vertex = mesh.triangles.ravel()
    rounded = np.repeat(np.round(face * 1e4).astype(np.int64), 3, axis=0)
    keys = np.column_stack([corner_vertex, rounded])  # [3 t, vertex and normal]
    first, index = _unique_rows(keys)
    split = mesh.take_vertices(corner_vertex[first], index.reshape(-1, 3))
    return replace(split, normals=face[first // 3].astype(np.float32))


def make_unit_normals(mesh: TriangleMesh) -> tuple[TriangleMesh, int]:
    """Normals of unit length, zero ones computed from the faces; and how many were zero.

    Normals that are unit within float32 rounding keep their bits.
    """
    assert mesh.normals is not None
    length = np.linalg.norm(mesh.normals.astype(np.float64), axis=1)
    off, zero = np.abs(length - 1) >= 1e-6, length < 1e-12
    if not off.any():
        return mesh, 0
    normals = mesh.normals.copy()
    normals[off] = _normalised(mesh.normals[off].astype(np.float64))
    if zero.any():
        normals[zero] = angle_weighted_normals(mesh)[0][zero]
    return replace(mesh, normals=normals), int(np.sum(zero))


def flip_sides(mesh: TriangleMesh) -> TriangleMesh:
    """The same surface seen from its other side: normals negated, corners of triangles in the other order."""
    normals = None if mesh.normals is None else -mesh.normals
    return replace(mesh, normals=normals, triangles=np.ascontiguousarray(mesh.triangles[:, [0, 2, 1]]))


def faces_inwards(mesh: TriangleMesh) -> bool:
    """Does a closed part of the mesh point into itself (negative signed volume)?

    Vertices are welded by position first. A part is closed if each of its edges belongs to two triangles.
    Which way a triangle faces is what its shading normals say, since that is what a one-sided BSDF looks at.
    """
    t = _unique_rows(mesh.positions)[1][mesh.triangles]
    edges = np.sort(np.stack([t, np.roll(t, -1, axis=1)], axis=2), axis=2).reshape(-1, 2)
    edge = _unique_rows(edges)[1]
    part = _connected_parts(t)  # [triangle]
    is_open = np.zeros(part.max(initial=-1) + 1, bool)
    is_open[np.repeat(part, 3)[np.bincount(edge)[edge] != 2]] = True

    p = mesh.positions.astype(np.float64)
    corners = (p - p.mean(axis=0))[mesh.triangles]
    volume = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    if mesh.normals is not None:
        shading = mesh.normals[mesh.triangles].sum(axis=1)
        volume = np.where(np.sum(shading * triangle_normals(mesh), axis=1) < 0, -volume, volume)
    volumes = np.bincount(part, volume, minlength=len(is_open))
    return bool(np.any((volumes < 0) & ~is_open))


def _connected_parts(triangles: NDArray[np.integer]) -> NDArray[np.integer]:
    """[triangle] number of the connected part that it belongs to."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    a, b = triangles[:, [0, 1]].ravel(), triangles[:, [1, 2]].ravel()
    n = int(triangles.max(initial=-1)) + 1
    _, label = connected_components(coo_array((np.ones(len(a), bool), (a, b)), shape=(n, n)), directed=False)
    _, part = np.unique(label[triangles[:, 0]], return_inverse=True)
    return part.reshape(-1)


def _unique_rows(rows: NDArray) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First index of each distinct row, and for each row which it is; far faster than `np.unique` by rows."""
    code = np.zeros(len(rows), np.int64)
    for column in rows.T:
        _, value = np.unique(column, return_inverse=True)
        _, code = np.unique(code * (value.max(initial=0) + 1) + value, return_inverse=True)
    _, first = np.unique(code, return_index=True)
    return first, code


def _normalised(v: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rows scaled to unit length; zero rows stay zero."""
    length = np.linalg.norm(v, axis=1, keepdims=True)
    return v / np.where(length > 0, length, 1.0)


# --------------------------------------------------------------------------------- parametric surfaces

#: (u, v) of shape (n,) each -> local positions and local normals, (n, 3) each.
Parametrisation = Callable[
    [NDArray[np.float64], NDArray[np.float64]], tuple[NDArray[np.float64], NDArray[np.float64]]
]


def _sphere(u: NDArray, v: NDArray) -> tuple[NDArray, NDArray]:
    phi, theta = 2 * np.pi * u, np.pi * v
    p = np.column_stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])
    return p, p


def _disk(u: NDArray, v: NDArray) -> tuple[NDArray, NDArray]:
    # Mitsuba's disk: u is the radius, v the angle.
    phi = 2 * np.pi * v
    return np.column_stack([u * np.cos(phi), u * np.sin(phi), 0 * u]), np.tile([0.0, 0.0, 1.0], (len(u), 1))


def _cylinder(u: NDArray, v: NDArray) -> tuple[NDArray, NDArray]:
    phi = 2 * np.pi * u
    return np.column_stack([np.cos(phi), np.sin(phi), v]), np.column_stack([np.cos(phi), np.sin(phi), 0 * v])


def parametric_mesh(
    shape: str,
    to_world: NDArray[np.float64],
    edge_length: float,
    name: str,
    *,
    limit: int,
    flip: bool = False,
    weld: bool = False,
) -> TriangleMesh:
    """A Mitsuba `sphere`, `disk` or `cylinder` as a grid in its own (u, v) parametrisation.

    Parameters
    ----------
    shape : {"sphere", "disk", "cylinder"}
    to_world : (4, 4) float64
        Local to world; local are the unit sphere; the unit disk in z = 0; the unit cylinder from z = 0 to 1.
    edge_length : float
        World units; grid lines are at most this far apart. `inf` gives the coarsest grid.
    limit : int
        The largest number of vertices allowed.
    flip : bool
        Normals point inwards, or, on a disk, along its local -z.
    weld : bool
        Merge vertices of equal position and normal (the seam and the poles) and leave texture coordinates
        out: for materials that do not vary over the surface.

    Returns
    -------
    TriangleMesh
        World space, normals exact, no triangle without area at the poles.

    Raises
    ------
    PrtError
        A `to_world` of size zero, or under which the shape is no sphere or cylinder any more; more than `limit`
        vertices.
    """
    linear = to_world[:3, :3]
    scale = np.linalg.norm(linear, axis=0)  # of the local axes x, y, z
    if not np.all(scale > 0):
        raise PrtError(f"shape '{name}': its to_world leaves no size: the scale must not be zero")
    skew = np.abs(linear.T @ linear / np.outer(scale, scale) - np.eye(3)).max()
    round_axes = {"sphere": scale, "cylinder": scale[:2], "disk": scale[:1]}[shape]
    if shape != "disk" and (skew > 1e-3 or np.ptp(round_axes) > 1e-3 * scale[0]):
        raise PrtError(
            f"shape '{name}': the to_world of a {shape} must not shear it or scale it unevenly: "
            "use a mesh instead"
        )
    radius, fewest = max(scale[0], scale[1]), 32  # segments around, whatever the edge length
    around = 4 * max(fewest // 4, _segments(np.pi / 2 * radius, edge_length))
    # `angle` is the axis of (u, v) that runs around, `across` counts along the other one, `poles` are its ends
    # where circles shrink to points.
    surface: Parametrisation
    poles: tuple[int, ...]
    if shape == "sphere":
        surface, angle, poles = _sphere, 0, (0, 1)
        across = 2 * max(fewest // 4, _segments(np.pi / 2 * radius, edge_length))
    elif shape == "disk":
        surface, angle, poles, across = _disk, 1, (0,), _segments(radius, edge_length)
    else:
        surface, angle, poles, across = _cylinder, 0, (), _segments(scale[2], edge_length)
    if (around + 1) * (across + 1) > limit:
        raise _too_many(name, edge_length, limit)
    uv, triangles = _grid(around, across, angle, poles)
    wrapped = uv.copy()
    wrapped[uv[:, angle] == 1, angle] = 0.0  # the seam's two sides have the same bits
    local, normal = surface(wrapped[:, 0], wrapped[:, 1])
    local = np.where(np.abs(local) < 1e-15, 0.0, local)  # sin(pi) is not zero: poles meet in one point

    positions = (local @ linear.T + to_world[:3, 3]).astype(np.float32)
    normals = _normalised(normal @ np.linalg.inv(linear)).astype(np.float32)
    mesh = TriangleMesh(name, positions, normals, triangles, uv.astype(np.float32))
    against = np.sum(triangle_normals(mesh) * normals[triangles].sum(axis=1), axis=1) < 0
    triangles[against] = triangles[against][:, [0, 2, 1]]
    if weld:
        keys = np.column_stack([positions, normals]) + np.float32(0)  # -0 and 0 are one
        first, index = _unique_rows(keys)
        mesh = replace(mesh.take_vertices(first, index[triangles]), texcoords=None)
    return flip_sides(mesh) if flip else mesh


def _too_many(name: str, edge_length: float, limit: int) -> PrtError:
    return PrtError(
        f"shape '{name}': edges of {edge_length:.4g} need more than {limit} vertices: "
        "use a larger edge_length (inf leaves meshes as they are)"
    )


def _segments(length: float, edge_length: float) -> int:
    return max(1, int(np.ceil(length / edge_length / (1 + TIE))))


def _grid(
    around: int, across: int, angle: int, poles: tuple[int, ...]
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """(u, v) of the vertices and triangles of a grid of `around` x `across` cells.

    At a pole (the first or last line) each cell is one triangle with its own pole vertex, half a cell along.
    """
    i = np.arange(around + 1) / around
    lines = np.arange(across + 1) / across
    a, b = np.meshgrid(i, lines)  # [across + 1, around + 1]
    for pole in poles:
        row = 0 if pole == 0 else across
        a[row, :-1] += 0.5 / around
    uv = np.stack([a, b] if angle == 0 else [b, a], axis=-1).reshape(-1, 2)
    index = np.arange((across + 1) * (around + 1)).reshape(across + 1, around + 1)
    triangles = []
    for row, (low, high) in enumerate(pairwise(index)):
        if row == 0 and 0 in poles:
            triangles.append(np.column_stack([low[:-1], high[1:], high[:-1]]))
            continue
        triangles.append(np.column_stack([low[:-1], low[1:], high[:-1]]))
        if not (row == across - 1 and 1 in poles):
            triangles.append(np.column_stack([low[1:], high[1:], high[:-1]]))
    faces = np.concatenate(triangles).astype(np.int32)
    used = np.unique(faces)
    renumbered = np.zeros(len(uv), np.int32)
    renumbered[used] = np.arange(len(used))
    return uv[used], renumbered[faces]


# ------------------------------------------------------------------------------------------ subdivision


def subdivide(mesh: TriangleMesh, edge_length: float, limit: int) -> TriangleMesh:
    """Bisect every edge longer than `edge_length` until none is left.

    An edge's length decides alone, so both of its sides split at the same midpoint and no T-junction appears,
    also between vertices that share a position but not a normal. Triangles with one, two or three long edges
    become two, three or four. Positions, texture coordinates and attributes are interpolated linearly; normals
    too, then normalised. The old vertices come first, in their order.

    Parameters
    ----------
    edge_length : float
        In the mesh's own units; `inf` changes nothing.
    limit : int
        The largest number of vertices allowed.

    Raises
    ------
    PrtError
        If more than `limit` vertices would be needed.
    """
    # No triangle with such edges is larger than the equilateral one, and a surface has half as many vertices as
    # triangles: refuse what is hopeless before it is built.
    area = float(np.linalg.norm(triangle_normals(mesh), axis=1).sum()) / 2
    if area / (np.sqrt(3) / 4 * (edge_length * (1 + TIE)) ** 2) / 2 > 1.1 * limit:
        raise _too_many(mesh.name, edge_length, limit)
    while True:
        t = mesh.triangles
        edges = np.sort(
            np.stack([t, np.roll(t, -1, axis=1)], axis=2), axis=2
        )  # [triangle, edge, low and high]
        flat = edges.reshape(-1, 2).astype(np.int64)
        code, inverse = np.unique(flat[:, 0] * len(mesh.positions) + flat[:, 1], return_inverse=True)
        ends = np.stack(np.divmod(code, len(mesh.positions)), axis=1)  # [edge, low and high]
        p = mesh.positions.astype(np.float64)
        long = np.linalg.norm(p[ends[:, 0]] - p[ends[:, 1]], axis=1) > edge_length * (1 + TIE)
        if not long.any():
            return mesh
        count = len(mesh.positions) + int(np.sum(long))
        if count > limit:
            raise _too_many(mesh.name, edge_length, limit)
        midpoint = np.full(len(ends), -1, np.int64)
        midpoint[long] = np.arange(len(mesh.positions), count)
        mesh = _split(_with_midpoints(mesh, ends[long]), midpoint[inverse.reshape(-1, 3)])


def _with_midpoints(mesh: TriangleMesh, ends: NDArray[np.int64]) -> TriangleMesh:
    """The mesh with the midpoints of the edges `ends` [edge, 2] appended to its vertices."""

    def middle(values: NDArray[np.float32]) -> NDArray[np.float32]:
        mean = values[ends].astype(np.float64).mean(axis=1)
        return np.concatenate([values, mean.astype(np.float32)])

    assert mesh.normals is not None
    n = mesh.normals[ends].astype(np.float64)  # [edge, end, xyz]
    total = n.sum(axis=1)
    opposed = np.linalg.norm(total, axis=1, keepdims=True) < 1e-6
    normals = _normalised(np.where(opposed, n[:, 0], total))
    return replace(
        mesh,
        positions=middle(mesh.positions),
        normals=np.concatenate([mesh.normals, normals.astype(np.float32)]),
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
