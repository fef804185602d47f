"""Vertices that lie on another surface: where a wall passes through a floor, or where a ball stands on it.

On which side of that surface such a vertex is, and so what it sees, is a matter of rounding. It is moved off to the
side on which there is more room, by a few ray offsets; the other side is none of its business (``hidden_corners``).
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.scene.ray_offsets import ray_offset, ray_offsets
from mi_sparse_prt.scene.scene import Scene

TRIANGLES = 1 << 20  # at a time
BEYOND = 2  # ray offsets behind a vertex: what is as near touches it
APART = 4  # ray offsets from what it touched
RAYS = 64  # that tell how much room there is

Vectors = NDArray[np.float32]  # (n, 3)


def move_off(scene: Scene, positions: Vectors, border: NDArray[np.integer]) -> Vectors:
    """Places of vertices, those that lie on another connected surface moved off it.

    Parameters
    ----------
    scene : Scene
    positions : (n_v, 3) float32, normalised frame
        Of vertices, those on the borders of meshes moved inwards.
    border : (m,) integers
        Vertices on borders, which stay.
    """
    if not scene.pieces[scene.front_of].any():
        return positions  # there is no other
    vertices, normals = _touched(scene, positions)
    inside = ~np.isin(vertices, border)
    vertices, normals = vertices[inside], normals[inside]
    if not len(vertices):
        return positions
    distance = APART * ray_offsets(positions[vertices])
    sides = [positions[vertices] + sign * distance * normals for sign in (1, -1)]
    room = [_room(scene, place.astype(np.float32), scene.normals[vertices]) for place in sides]
    moved = positions.copy()
    moved[vertices] = np.where((room[0] >= room[1])[:, None], *sides)
    return moved


def _touched(scene: Scene, positions: Vectors) -> tuple[NDArray[np.int64], Vectors]:
    """Vertices that touch other surfaces, ascending, and the normal of one that each touches.

    From the middle of each triangle, rays go to its corners and a little farther, just above it.
    """
    triangles = np.concatenate([mesh.triangles + mesh.vertices.start for mesh in scene.meshes])
    piece = scene.pieces[scene.front_of]
    pieces = mi.UInt32(np.concatenate([piece[m.triangles[:, 0] + m.vertices.start] for m in scene.fronts]))
    found = []
    for a in range(0, len(triangles), TRIANGLES):
        some = triangles[a : a + TRIANGLES]
        p = [mi.Point3f(positions[column].T) for column in some.T]
        normal = dr.normalize(dr.cross(p[1] - p[0], p[2] - p[0]))
        normal = dr.mulsign(normal, dr.dot(normal, mi.Vector3f(scene.normals[some].sum(axis=1).T)))
        middle, own = (p[0] + p[1] + p[2]) / 3, mi.UInt32(piece[some[:, 0]])
        for column, corner in zip(some.T, p, strict=True):
            start = dr.fma(normal, ray_offset(middle), middle)
            ray = mi.Ray3f(start, corner - middle)
            beyond = BEYOND * ray_offset(corner) / dr.norm(ray.d)
            ray.maxt = 1 + beyond
            hit = scene.normalised.ray_intersect_preliminary(ray)
            met = scene.normalised.triangle(hit, hit.is_valid())
            touches = hit.is_valid() & (dr.gather(mi.UInt32, pieces, met, hit.is_valid()) != own)
            touches &= hit.t > 1 - beyond
            which = touches.numpy()
            other = scene.normalised.interaction(hit, ray, touches).n
            found.append((column[which], other.numpy().T[which]))
    vertices, normals = (np.concatenate(part) for part in zip(*found, strict=True))
    order = np.lexsort((*normals.T, vertices))  # so that the order of triangles does not show
    vertices, chosen = np.unique(vertices[order], return_index=True)
    return vertices.astype(np.int64), normals[order][chosen]


def _room(scene: Scene, positions: Vectors, normals: Vectors) -> NDArray[np.float32]:
    """How far (n,) rays into the hemispheres of points get on average, at most the longest side of the scene."""
    lane = dr.arange(mi.UInt32, len(positions) * RAYS)
    point = lane // RAYS
    k = lane - point * RAYS
    u = mi.Point2f((mi.Float(k) + 0.5) / RAYS, mi.Float(dr.brev(k)) * 2**-32)  # Hammersley's points
    normal = dr.gather(mi.Vector3f, mi.Vector3f(normals.T), point)
    start = positions + ray_offsets(positions) * normals
    start = dr.gather(mi.Point3f, mi.Point3f(start.T), point)
    ray = mi.Ray3f(start, mi.Frame3f(normal).to_world(mi.warp.square_to_cosine_hemisphere(u)))
    way = dr.minimum(scene.normalised.ray_intersect_preliminary(ray).t, 1)
    return dr.block_reduce(dr.ReduceOp.Add, way, RAYS).numpy() / np.float32(RAYS)
