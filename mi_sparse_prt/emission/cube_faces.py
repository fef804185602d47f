"""Six faces of n x n texels: the one layout of cubemaps, in emitters, wavelets, images and files.

Faces in the order +X, -X, +Y, -Y, +Z, -Z, world frame, oriented as OpenGL's cube maps. Texel (row, col) of face f has
index j = f n^2 + row n + col and covers the square of face coordinates [2 col / n - 1, 2 (col + 1) / n - 1] (s) x
[2 row / n - 1, 2 (row + 1) / n - 1] (t); the point (s, t) of a face lies in the direction `centre + s * s_axis +
t * t_axis` with the axes of `FACE_FRAMES`.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike, NDArray

# [face, (s_axis, t_axis, centre), xyz]
FACE_FRAMES = np.array(
    [
        [[0, 0, -1], [0, -1, 0], [1, 0, 0]],  # +X
        [[0, 0, 1], [0, -1, 0], [-1, 0, 0]],  # -X
        [[1, 0, 0], [0, 0, 1], [0, 1, 0]],  # +Y
        [[1, 0, 0], [0, 0, -1], [0, -1, 0]],  # -Y
        [[1, 0, 0], [0, -1, 0], [0, 0, 1]],  # +Z
        [[-1, 0, 0], [0, -1, 0], [0, 0, -1]],  # -Z
    ],
    dtype=np.float64,
)


# --- Dr.Jit


def face_coordinates(d: mi.Vector3f) -> tuple[mi.UInt32, mi.Float, mi.Float]:
    """Face of each direction (any length) and its coordinates s, t in [-1, 1].

    On edges shared by faces the first face of the order wins.
    """
    largest = dr.max(dr.abs(d))
    face, s, t = mi.UInt32(0), mi.Float(0), mi.Float(0)
    for f in reversed(range(6)):
        s_axis, t_axis, centre = (mi.ScalarVector3f(axis) for axis in FACE_FRAMES[f])
        here = dr.dot(centre, d) == largest
        face = dr.select(here, f, face)
        s = dr.select(here, dr.dot(s_axis, d), s)
        t = dr.select(here, dr.dot(t_axis, d), t)
    return face, s / largest, t / largest


def face_direction(face: mi.UInt32, s: mi.Float, t: mi.Float) -> mi.Vector3f:
    """Unit direction of the point (s, t) of a face; the inverse of `face_coordinates`."""
    d = mi.Vector3f(0)
    for f in range(6):
        s_axis, t_axis, centre = (mi.ScalarVector3f(axis) for axis in FACE_FRAMES[f])
        d = dr.select(face == f, centre + s * s_axis + t * t_axis, d)
    return dr.normalize(d)


def texel_at(face: mi.UInt32, s: mi.Float, t: mi.Float, n: int) -> mi.UInt32:
    """Index j of the texel that the point (s, t) of a face of n x n texels lies in."""
    row, col = (dr.clip(mi.Int32(dr.floor((x + 1) * (n / 2))), 0, n - 1) for x in (t, s))
    return (face * n + mi.UInt32(row)) * n + mi.UInt32(col)


# --- NumPy


def subtexels(texels: NDArray[np.int_], n: int, s: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Directions (m, s^2, 3) and solid angles (m, s^2) of the s x s squares of m texels."""
    face, row, col = np.unravel_index(texels, (6, n, n))  # [m] each
    edges = 2 * np.arange(s + 1) / (n * s)
    s_edge, t_edge = 2 * col[:, None] / n - 1 + edges, 2 * row[:, None] / n - 1 + edges  # [m, s + 1]

    # Solid angle of [0, x] x [0, y] on a face; a rectangle's is the second difference over its corners
    x, y = s_edge[:, None, :], t_edge[:, :, None]
    corner = np.arctan2(x * y, np.sqrt(x * x + y * y + 1))  # [m, s + 1 (t), s + 1 (s)]
    solid_angles = np.diff(np.diff(corner, axis=1), axis=2)

    x, y = ((e[:, 1:] + e[:, :-1]) / 2 for e in (s_edge, t_edge))  # [m, s]
    s_axis, t_axis, centre = (FACE_FRAMES[face, i][:, None, None] for i in range(3))  # [m, 1, 1, xyz]
    d = centre + x[:, None, :, None] * s_axis + y[:, :, None, None] * t_axis  # [m, s (t), s (s), xyz]
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    return d.reshape(len(texels), s * s, 3), solid_angles.reshape(len(texels), s * s)


def texels_towards(directions: ArrayLike, n: int) -> NDArray[np.int32]:
    """Index (m,) of the texel that each of the (m, 3) directions (any length but 0) points at."""
    d = mi.Vector3f(np.ascontiguousarray(np.asarray(directions, np.float32).T))
    return texel_at(*face_coordinates(d), n).numpy().astype(np.int32)


def face_places(n: int) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Face and face coordinates (s, t) of each texel's centre, (6 n^2,) each."""
    face, row, column = np.unravel_index(np.arange(6 * n * n), (6, n, n))
    return face, (2 * column + 1) / n - 1, (2 * row + 1) / n - 1


def cube_points(
    face: NDArray[np.int64], s: NDArray[np.float64], t: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Points (m, 3) at face coordinates, on the planes of their faces, which go on beyond [-1, 1]."""
    s_axis, t_axis, centre = (FACE_FRAMES[face, axis] for axis in range(3))
    return centre + s[:, None] * s_axis + t[:, None] * t_axis


def texels_beside(n: int, dx: int, dy: int) -> NDArray[np.int32]:
    """The texel (dx, dy) columns and rows from each, (6 n^2,); -1 beyond a corner of the cube.

    Beyond an edge it is the one that the continued plane of the texel's own face points at.
    """
    face, s, t = face_places(n)
    s, t = s + 2 * dx / n, t + 2 * dy / n
    found = texels_towards(cube_points(face, s, t), n)
    return np.where((np.abs(s) > 1) & (np.abs(t) > 1), -1, found).astype(np.int32)
