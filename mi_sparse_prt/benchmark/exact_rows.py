"""Exact direct light of one mesh: what choices of rows, columns and neighbours are compared on."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.bits import Bits
from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.operators.visibility import Visibility
from mi_sparse_prt.scene.scene import Mesh, Scene
from mi_sparse_prt.solvers.direct_rays import DirectSolver


def mesh_named(scene: Scene, name: str) -> Mesh:
    """The mesh of this name, or an error that lists all names."""
    found = next((mesh for mesh in scene.meshes if mesh.name == name), None)
    if found is None:
        names = ", ".join(mesh.name for mesh in scene.meshes)
        raise PrtError(f"the scene has no mesh {name!r}: choose one of {names}")
    return found


def trace_visibility(direct: DirectSolver, ids: NDArray[np.integer]) -> Bits:
    """Visibility (n, words) of whole rows, every element traced."""
    blocks = np.split(ids, range(direct.block_size, len(ids), direct.block_size))
    return np.concatenate([direct.rows(block) for block in blocks]).astype(np.uint32, copy=False)


def unit_albedo_rows(
    bits: Bits, normals: NDArray[np.float32], lighting: CubemapLighting
) -> NDArray[np.float32]:
    """Unit-albedo direct transport (n, n_directions) of visibility bits, cosine and solid angle included."""
    return Visibility(bits, normals, lighting).rows(np.arange(len(bits)))[..., 0]


def values_at(rows: NDArray[np.float32], directions: NDArray[np.int32]) -> NDArray[np.float32]:
    """Values (n, s) of rows (n, n_directions) at their directions (n, s); 0 at -1, where there are fewer."""
    values = np.take_along_axis(rows, np.maximum(directions, 0), axis=1)
    return np.where(directions >= 0, values, np.float32(0))
