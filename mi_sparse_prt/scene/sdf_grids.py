"""Mitsuba's `sdfgrid` as triangles."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import zoom

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.scene.mesh_cleaning import drop_degenerate, drop_unreferenced
from mi_sparse_prt.scene.mitsuba_meshes import scene_of
from mi_sparse_prt.scene.subdivision import too_many_vertices
from mi_sparse_prt.scene.triangle_mesh import TriangleMesh, normalise_rows, triangle_normals


def sdf_mesh(
    shape: mi.Shape, to_world: NDArray[np.float64], edge_length: float, name: str, *, limit: int, fewest: int
) -> TriangleMesh:
    """Where the distance is zero, by marching cubes.

    Distances are trilinear in a cell of the grid, and linear along an edge of any finer one: vertices lie on the
    surface that Mitsuba's rays meet, and have the normals that it shades with.

    Parameters
    ----------
    to_world : (4, 4) float64
        Local to world; local is the unit cube.
    edge_length : float
        World units; cells are at most this long. Those of the grid are never merged.
    limit : int
        The largest number of vertices allowed.
    fewest : int
        Cells along the longest side of the grid, at least.

    Raises
    ------
    PrtError
        A grid that is not as long in all directions; more than `limit` vertices.
    """
    from skimage.measure import marching_cubes  # 0.5 s to import

    distances = np.array(mi.traverse(shape)["grid"], np.float32)[..., 0].T  # [x, y, z]
    cells = np.array(distances.shape) - 1
    if np.ptp(cells):
        raise PrtError(
            f"shape '{name}': its grid is not as long in all directions, and such ones are met by few of the rays that "
            "Mitsuba sends into them: give it as many distances along x, y and z"
        )
    sizes = np.linalg.norm(to_world[:3, :3], axis=0)
    finer = np.ceil(np.maximum(sizes / edge_length, fewest * sizes / sizes.max()) / cells).clip(1)
    if np.sum(finer * cells) ** 2 > limit:  # more than six sides of the grid have
        raise too_many_vertices(name, edge_length, limit)
    fine = zoom(distances, (finer * cells + 1) / (cells + 1), order=1)
    local, triangles, downhill, _ = marching_cubes(fine, 0.0, gradient_direction="ascent")
    local = local / (finer * cells)
    positions = (local @ to_world[:3, :3].T + to_world[:3, 3]).astype(np.float32)
    outwards = normalise_rows(-downhill * finer * cells @ np.linalg.inv(to_world[:3, :3]))
    normals = _shading_normals(shape, positions, outwards, float(np.max(sizes / (finer * cells))))
    texcoords = np.zeros((len(positions), 2), np.float32)  # as Mitsuba has it
    mesh = TriangleMesh(name, positions, normals, triangles.astype(np.int32), texcoords)
    against = np.sum(triangle_normals(mesh) * normals[mesh.triangles].sum(axis=1), axis=1) < 0
    mesh.triangles[against] = mesh.triangles[against][:, [0, 2, 1]]
    return drop_unreferenced(drop_degenerate(mesh)[0])[0]


def _shading_normals(
    shape: mi.Shape, positions: NDArray[np.float32], outwards: NDArray, cell: float
) -> NDArray[np.float32]:
    """(n, 3) Mitsuba's own at the surface, asked for by rays from half a cell outside; ``outwards`` where these miss.

    A thousandth of a cell beside the vertices, which lie on the sides of cells, where rays can slip through.
    """
    scene = scene_of({"shape": shape})
    beside = mi.Point3f(positions.T) + 1e-3 * cell * mi.Vector3f(0.8, 0.5, 0.3)
    direction = mi.Vector3f(-outwards.T.astype(np.float32))
    si = scene.ray_intersect(mi.Ray3f(beside - 0.5 * cell * direction, direction))
    near = si.is_valid() & (dr.norm(si.p - beside) < 0.5 * cell)
    return np.where(near.numpy()[:, None], si.sh_frame.n.numpy().T, outwards).astype(np.float32)
