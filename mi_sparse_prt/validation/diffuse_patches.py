"""Specks of diffuse paint on vertices that are not diffuse: Mitsuba's radiance there is what their rows stand for."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.measurement.vertices import VertexRays, sensor_points
from mi_sparse_prt.scene.mitsuba_meshes import build_mitsuba_mesh
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.scene.triangle_mesh import TriangleMesh

LIFT = 0.1  # of the way from the surface to the origin of the vertex's ray; below Mitsuba's ray offset
CORNERS = np.exp(2j * np.pi * np.arange(3) / 3)  # of a triangle, in units of the lift


def diffuse_patches(scene: Scene, rays: VertexRays, rows: NDArray[np.integer]) -> mi.Mesh | None:
    """A triangle just above every chosen vertex whose material is not diffuse, with the reflectance of its row.

    A row of T takes its vertex for diffuse, and all other surfaces as they are. With the vertex's own BSDF, ``path``
    along its ray would see the lobe, too. Each triangle is 2e-5 of the scene wide: it hides no light from others.

    Parameters
    ----------
    scene : Scene
    rays : VertexRays
        Of all vertices of ``scene.normalised``.
    rows : (k,) integers

    Returns
    -------
    mi.Mesh or None
        In the normalised frame; None if all these materials are diffuse.
    """
    diffuse = np.repeat(
        [material.diffuse for material in scene.materials],
        [mesh.vertices.stop - mesh.vertices.start for mesh in scene.meshes],
    )
    painted = rows[~diffuse[rows]]
    if not len(painted):
        return None
    hits = sensor_points(scene, rays)
    p, up = (a[painted].astype(np.float64) for a in (hits.positions, hits.offset_normals))
    lift = LIFT * np.linalg.norm(rays.origins[painted] - p, axis=1, keepdims=True)
    across = np.cross(up, np.eye(3)[np.abs(up).argmin(axis=1)])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    along = np.cross(up, across)
    corners = [p + lift * (up + c.real * across + c.imag * along) for c in CORNERS]
    mesh = TriangleMesh(
        "diffuse_patches",
        np.stack(corners, axis=1).reshape(-1, 3).astype(np.float32),
        np.repeat(hits.normals[painted], 3, axis=0),
        np.arange(3 * len(painted), dtype=np.int32).reshape(-1, 3),
        vertex_attributes={"vertex_color": np.repeat(scene.albedo[painted], 3, axis=0)},
    )
    paint = {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_color"}}
    return build_mitsuba_mesh(mesh, mi.load_dict(paint))
