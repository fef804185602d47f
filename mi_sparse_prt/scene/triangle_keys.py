"""Keys of triangles that do not depend on the order in which they come."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.random_keys import hash_rows, mix
from mi_sparse_prt.scene.triangle_mesh import TriangleMesh


def triangle_keys(mesh: TriangleMesh, vertex_keys: NDArray[np.uint64], seed: np.uint64) -> NDArray[np.uint64]:
    """(t,) hash of each triangle: its corners, from the one of smallest key on, and its material (`seed`)."""
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
