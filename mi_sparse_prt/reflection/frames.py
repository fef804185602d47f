"""Tangents at vertices: the frames in which BRDFs are evaluated there."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.measurement.vertices import vertex_rays
from mi_sparse_prt.scene.scene import Mesh, Scene

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]


def beside_vertices(scene: Scene) -> mi.SurfaceInteraction3f:
    """The surface next to each vertex, in one of the triangles around it, as Mitsuba sees it (normalised frame)."""
    rays = vertex_rays(scene.normalised, scene)
    return scene.normalised.ray_intersect(
        mi.Ray3f(mi.Point3f(rays.origins.T), mi.Vector3f(rays.directions.T))
    )


def vertex_tangents(scene: Scene) -> Floats:
    """Tangents at vertices: the mean direction of those of the triangles around each.

    Parameters
    ----------
    scene : Scene

    Returns
    -------
    (n_v, 3) float32
        World space, of length 1, at right angles to the vertex's normal. The second tangent is normal x tangent.

    Notes
    -----
    The axis that is nearest to the tangents of all triangles around a vertex in the mean square, by their angles there:
    where texture coordinates are mirrored, and tangents opposed, they do not cancel. Mitsuba shades each triangle with
    its own tangent; where those around a vertex disagree (no texture coordinates), an anisotropic BRDF that is looked
    up by vertices cannot follow.
    """
    found = [
        _mean_axes(shape, mesh, scene.normals[mesh.vertices].astype(np.float64))
        for shape, mesh in zip(scene.mitsuba.shapes(), scene.fronts, strict=True)
    ]
    return orthogonalise(np.concatenate(found).astype(np.float32)[scene.front_of], scene.normals)


def triangle_tangents(shape: mi.Mesh, triangles: NDArray[np.integer]) -> Doubles:
    """Directions (n_t, 3) of dp/du of triangles, of length 1, as Mitsuba has them, in the mesh's space.

    Along increasing u, or any way where a triangle's coordinates are degenerate; along the first edges of triangles
    where a mesh has no texture coordinates.
    """
    p = _edges(_rows(shape.vertex_positions_buffer(), 3), triangles)
    along = p[:, 0]
    if shape.has_vertex_texcoords():
        q = _edges(_rows(shape.vertex_texcoords_buffer(), 2), triangles)
        area = np.linalg.det(q)
        slope = (q[:, 1, 1, None] * p[:, 0] - q[:, 0, 1, None] * p[:, 1]) * np.sign(area)[:, None]
        normals = np.cross(p[:, 0], p[:, 1])
        some, _ = mi.coordinate_system(mi.Vector3f(_unit(normals).astype(np.float32).T))
        along = np.where(area[:, None] != 0, slope, np.array(some, np.float64).T)
    return _unit(along)


def _mean_axes(shape: mi.Mesh, mesh: Mesh, normals: Doubles) -> Doubles:
    """The axis (n, 3) at each vertex, of either length 1 or none."""
    tangents, corners = triangle_tangents(shape, mesh.triangles), mesh.triangles
    positions = _rows(shape.vertex_positions_buffer(), 3)[corners]  # [triangle, corner, xyz]
    squares, total = np.zeros((len(normals), 3, 3)), np.zeros((len(normals), 3))
    for k in range(3):
        to = [_unit(positions[:, (k + step) % 3] - positions[:, k]) for step in (1, 2)]
        angle = np.arccos(np.clip(np.einsum("td,td->t", *to), -1, 1))
        normal = normals[corners[:, k]]
        flat = _unit(tangents - normal * np.einsum("td,td->t", tangents, normal)[:, None])
        np.add.at(squares, corners[:, k], (angle[:, None] * flat)[:, :, None] * flat[:, None, :])
        np.add.at(total, corners[:, k], angle[:, None] * flat)
    axis = np.linalg.eigh(squares)[1][:, :, 2]
    return axis * np.where(np.einsum("nd,nd->n", axis, total) < 0, -1, 1)[:, None]


def _edges(points: Doubles, triangles: NDArray[np.integer]) -> Doubles:
    """From the first corner of each triangle to the second and the third: (n_t, 2, dimensions)."""
    corners = points[triangles]
    return corners[:, 1:] - corners[:, :1]


def _rows(buffer: mi.Float, width: int) -> Doubles:
    return np.array(buffer, np.float64).reshape(-1, width)


def _unit(vectors: Doubles) -> Doubles:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-30)


def orthogonalise(along: Floats, normals: Floats) -> Floats:
    """Vectors (n, 3) turned into the planes of normals (n, 3), of length 1; any tangent where they cannot be."""
    flat = along - normals * np.einsum("nd,nd->n", along, normals)[:, None]
    length = np.linalg.norm(flat, axis=1, keepdims=True)
    axes = np.eye(3, dtype=np.float32)[np.abs(normals).argmin(axis=1)]  # the least like the normal
    spare = np.cross(normals, axes)
    spare /= np.linalg.norm(spare, axis=1, keepdims=True)
    return np.where(length > 1e-3, flat / np.maximum(length, 1e-3), spare).astype(np.float32)


def frames(tangents: Floats, normals: Floats) -> Floats:
    """Rotations (..., 3, 3) from the world to frames: their rows are tangent, normal x tangent and normal."""
    return np.stack([tangents, np.cross(normals, tangents), normals], axis=-2).astype(np.float32)
