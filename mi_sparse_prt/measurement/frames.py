"""Tangents at vertices: the frames in which BRDFs are evaluated there."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.measurement.vertices import vertex_rays
from mi_sparse_prt.scene import Scene

Floats = NDArray[np.float32]


def beside_vertices(scene: Scene) -> mi.SurfaceInteraction3f:
    """The surface next to each vertex, in one of the triangles around it, as Mitsuba sees it (normalised frame)."""
    rays = vertex_rays(scene.normalised)
    return scene.normalised.ray_intersect(
        mi.Ray3f(mi.Point3f(rays.origins.T), mi.Vector3f(rays.directions.T))
    )


def vertex_tangents(scene: Scene) -> Floats:
    """The first tangent of Mitsuba's shading frame at each vertex, in one of the triangles around it.

    Parameters
    ----------
    scene : Scene

    Returns
    -------
    (n_v, 3) float32
        World space, of length 1, at right angles to the vertex's normal. Along increasing u where a mesh has texture
        coordinates, else what Mitsuba makes up from the normal of the triangle. The second tangent is normal x
        tangent. Where triangles around a vertex disagree (seams of a texture), it is that of one of them: who shades a
        triangle takes the frame of each corner for what it is.
    """
    si = beside_vertices(scene)
    along = np.where(si.is_valid().numpy()[:, None], si.sh_frame.s.numpy().T, np.float32(0))
    return orthogonal(along, scene.normals)


def orthogonal(along: Floats, normals: Floats) -> Floats:
    """Vectors (n, 3) turned into the planes of normals (n, 3), of length 1; any tangent where they cannot be."""
    flat = along - normals * np.einsum("nd,nd->n", along, normals)[:, None]
    length = np.linalg.norm(flat, axis=1, keepdims=True)
    axes = np.eye(3, dtype=np.float32)[np.abs(normals).argmin(axis=1)]  # the least like the normal
    spare = np.cross(normals, axes)
    spare /= np.linalg.norm(spare, axis=1, keepdims=True)
    return np.where(length > 1e-3, flat / np.maximum(length, 1e-3), spare).astype(np.float32)


def frames(tangents: Floats, normals: Floats) -> Floats:
    """Rotations (n, 3, 3) from the world to frames: their rows are tangent, normal x tangent and normal."""
    return np.stack([tangents, np.cross(normals, tangents), normals], axis=1).astype(np.float32)
