"""Mitsuba's `ellipsoids` as triangles."""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.scene.instances import copied
from mi_sparse_prt.scene.parametric_shapes import parametric_mesh
from mi_sparse_prt.scene.triangle_mesh import TriangleMesh, concatenated


def ellipsoids_mesh(shape: mi.Shape, edge_length: float, name: str, limit: int) -> TriangleMesh:
    """Ellipsoids as grids of triangles, in world space, with the attributes that textures can ask for.

    Parameters
    ----------
    edge_length : float
        World units; vertices are at most this far apart.
    limit : int
        The largest number of vertices allowed.

    Raises
    ------
    PrtError
        More than `limit` vertices.
    """
    parameters = mi.traverse(shape)
    data = np.array(parameters["data"], np.float64).reshape(
        -1, 10
    )  # centre, scale, quaternion (i, j, k, real)
    scales = data[:, 3:6] * parameters["extent"]
    attributes = {
        key: np.array(parameters[key], np.float32).reshape(len(data), -1)
        for key in parameters.keys()
        if key.startswith(("vertex_", "face_"))
    }
    meshes, left = [], limit
    for k, scale in enumerate(scales):
        ball = parametric_mesh("sphere", np.eye(4), edge_length / scale.max(), name, limit=left, weld=True)
        to_world = np.eye(4)
        to_world[:3, :3], to_world[:3, 3] = _rotation(data[k, 6:]) * scale, data[k, :3]
        mesh = copied(ball, to_world[None], left)
        left -= len(mesh.positions)
        each = {"vertex": len(mesh.positions), "face": len(mesh.triangles)}
        own = {key: np.tile(v[k], (each[key.split("_")[0]], 1)) for key, v in attributes.items()}
        meshes.append(
            replace(
                mesh,
                texcoords=np.zeros((len(mesh.positions), 2), np.float32),  # as Mitsuba has it
                vertex_attributes={key: v for key, v in own.items() if key.startswith("vertex_")},
                face_attributes={key: v for key, v in own.items() if key.startswith("face_")},
            )
        )
    return concatenated(meshes)


def _rotation(quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, 3) of a quaternion (i, j, k, real)."""
    x, y, z, w = quaternion / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
