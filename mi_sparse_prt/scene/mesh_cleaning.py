"""Clean triangle meshes: nothing degenerate or unused, one unit normal per vertex, the same at every load."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.scene.triangle_mesh import (
    TriangleMesh,
    as_one,
    find_pieces,
    normalise_rows,
    triangle_normals,
    unique_rows,
)


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
    face = normalise_rows(triangle_normals(mesh))
    total, weight = np.zeros((len(mesh.positions), 3)), np.zeros(len(mesh.positions))
    fallback = np.zeros_like(total)
    for corner in range(3):
        vertex = mesh.triangles[:, corner]
        a = normalise_rows(p[:, (corner + 1) % 3] - p[:, corner])
        b = normalise_rows(p[:, (corner + 2) % 3] - p[:, corner])
        angle = np.arccos(np.clip(np.sum(a * b, axis=1), -1.0, 1.0))
        weight += np.bincount(vertex, angle, minlength=len(total))
        for axis in range(3):
            total[:, axis] += np.bincount(vertex, angle * face[:, axis], minlength=len(total))
        fallback[vertex] = face
    length = np.linalg.norm(total, axis=1)
    cancelled = length <= 1e-6 * weight
    # rounded, so that components that cancel to zero are zero in whatever order they were summed
    normals = np.round(normalise_rows(np.where(cancelled[:, None], fallback, total)), 12) + 0.0
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
    face = normalise_rows(triangle_normals(mesh))  # [triangle, xyz]
    corner_vertex = mesh.triangles.ravel()
    rounded = np.repeat(np.round(face * 1e4).astype(np.int64), 3, axis=0)
    keys = np.column_stack([corner_vertex, rounded])  # [3 t, vertex and normal]
    first, index = unique_rows(keys)
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
    normals[off] = normalise_rows(mesh.normals[off].astype(np.float64))
    if zero.any():
        normals[zero] = angle_weighted_normals(mesh)[0][zero]
    return replace(mesh, normals=normals), int(np.sum(zero))


def flip_sides(mesh: TriangleMesh) -> TriangleMesh:
    """The same surface seen from its other side: normals negated, corners of triangles in the other order."""
    normals = None if mesh.normals is None else -mesh.normals
    return replace(mesh, normals=normals, triangles=np.ascontiguousarray(mesh.triangles[:, [0, 2, 1]]))


def face_inwards(meshes: Sequence[TriangleMesh]) -> NDArray[np.bool_]:
    """Which meshes have a closed part that points into itself (negative signed volume), (meshes,).

    Vertices are welded by position first. A part is closed if each of its edges belongs to two triangles.
    Which way a triangle faces is what its shading normals say, since that is what a one-sided BSDF looks at.
    """
    mesh, of = as_one(meshes)
    result = np.zeros(len(meshes), np.bool_)
    if not len(mesh.triangles):
        return result
    pieces = find_pieces(mesh, of)
    edges = np.stack([pieces.corners, np.roll(pieces.corners, -1, axis=1)], axis=2)
    edge = unique_rows(np.sort(edges, axis=2).reshape(-1, 2))[1]
    is_open = np.zeros(len(pieces.first), np.bool_)
    is_open[np.repeat(pieces.of, 3)[np.bincount(edge)[edge] != 2]] = True

    corners = mesh.positions.astype(np.float64)[mesh.triangles]
    corners -= corners[pieces.first, :1][pieces.of]  # what is small and far away has a volume, too
    volume = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    assert mesh.normals is not None
    shading = mesh.normals[mesh.triangles].sum(axis=1)
    volume = np.where(np.sum(shading * triangle_normals(mesh), axis=1) < 0, -volume, volume)
    inwards = (np.bincount(pieces.of, volume, minlength=len(pieces.first)) < 0) & ~is_open
    result[of[mesh.triangles[pieces.first[inwards], 0]]] = True
    return result
