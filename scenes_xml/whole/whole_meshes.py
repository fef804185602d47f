"""Meshes in the making, as arrays: quads, surfaces of revolution, tubes; and how they become PLY files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Points = NDArray[np.float64]
UP = np.array([0.0, 1.0, 0.0])
DECIMALS = 5  # of a coordinate: what mathematical libraries disagree on is below


class Mesh(NamedTuple):
    """Vertices (n, 3); triangles (m, 3), counterclockwise where they face the viewer; texture coordinates (n, 2)."""

    vertices: Points
    triangles: NDArray[np.int64]
    uv: Points | None = None


def write(mesh: Mesh, path: Path) -> None:
    """Write a mesh as a PLY file, from which Mitsuba computes smooth normals where triangles share vertices."""
    columns = mesh.vertices if mesh.uv is None else np.hstack([mesh.vertices, mesh.uv])
    columns = columns.round(DECIMALS) + 0.0  # no negative zeros
    faces = np.empty(len(mesh.triangles), [("count", "u1"), ("vertices", "<i4", 3)])
    faces["count"], faces["vertices"] = 3, mesh.triangles
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(columns)}",
        *(f"property float {axis}" for axis in "xyzuv"[: columns.shape[1]]),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header\n",
    ]
    path.write_bytes("\n".join(header).encode() + columns.astype("<f4").tobytes() + faces.tobytes())


def joined(parts: Sequence[Mesh]) -> Mesh:
    """All parts in one mesh; they share no vertices. All have texture coordinates, or none."""
    starts = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    triangles = [part.triangles + start for part, start in zip(parts, starts, strict=True)]
    uv = [part.uv for part in parts if part.uv is not None]
    vertices = np.concatenate([part.vertices for part in parts])
    return Mesh(vertices, np.concatenate(triangles), np.concatenate(uv) if uv else None)


def quad(corners: ArrayLike) -> Mesh:
    """Two triangles between four corners (4, 3), counterclockwise from the one with texture coordinates (0, 0)."""
    uv = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    return Mesh(np.asarray(corners, np.float64), np.array([[0, 1, 2], [0, 2, 3]]), uv)


def box(low: Points, high: Points) -> Mesh:
    """A closed box of six quads with vertices of their own."""
    sides = []
    for axis in range(3):
        for side in (0, 1):
            flat = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])[:: 1 if side else -1]
            corners = np.insert(flat, 0, side, axis=1)  # faces along the first axis
            sides.append(quad(low + np.roll(corners, axis, axis=1) * (high - low)))
    return joined(sides)


def grid(points: Points) -> Mesh:
    """The surface through points [row, column, xyz]; it faces the viewer who sees columns go right and rows go up."""
    rows, columns = points.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    triangles = np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    return Mesh(points.reshape(-1, 3).astype(np.float64), triangles)


def rings(circles: Points, first: ArrayLike | None = None, last: ArrayLike | None = None) -> Mesh:
    """Circles of points [ring, side, xyz], joined to each other, and to a point before and after them, if any.

    It faces outwards where sides go counterclockwise, seen from where the rings go to.
    """
    count, sides = circles.shape[:2]
    index = np.arange(count * sides).reshape(count, sides)
    right = np.roll(index, -1, axis=1)
    corners = [(index[:-1], right[:-1], right[1:]), (index[:-1], right[1:], index[1:])]
    vertices = [circles.reshape(-1, 3)]
    for end, ring in ((first, (right[0], index[0])), (last, (index[-1], right[-1]))):
        if end is not None:
            corners.append((*ring, np.full(sides, sum(map(len, vertices)))))
            vertices.append(np.asarray(end, np.float64)[None])
    triangles = [np.stack(three, axis=-1).reshape(-1, 3) for three in corners]
    return Mesh(np.concatenate(vertices), np.concatenate(triangles))


def revolved(profile: Sequence[tuple[float, float]], sides: int = 24) -> Mesh:
    """A closed surface around the vertical axis.

    Parameters
    ----------
    profile : sequence of (radius, height)
        From the axis at the bottom around the outside to the axis again; radius 0 at both ends.
    sides : int
        Of the polygon that stands for a circle.
    """
    angles = -2 * np.pi * np.arange(sides) / sides  # x to -z: counterclockwise from above
    circle = np.stack([np.cos(angles), 0 * angles, np.sin(angles)], axis=-1)
    circles = np.array([r * circle + y * UP for r, y in profile[1:-1]])
    (_, bottom), (_, top) = profile[0], profile[-1]
    return rings(circles, bottom * UP, top * UP)


def tube(axis: Points, radii: Points, sides: int, pointed: bool = True) -> Mesh:
    """A surface around a line of points (k, 3), open at its start; it ends in the last point, or is open there."""
    turn = 2 * np.pi * np.arange(sides) / sides
    ahead = np.vstack([axis[1:], axis[-1:]])
    behind = np.vstack([axis[:1], axis[:-1]])
    circles = [
        place + radius * np.array([around(unit(after - before), angle) for angle in turn])
        for place, radius, before, after in zip(axis, radii, behind, ahead, strict=True)
    ]
    return rings(np.array(circles[:-1] if pointed else circles), last=axis[-1] if pointed else None)


def unit(v: Points) -> Points:
    """A direction, of length 1."""
    return v / np.linalg.norm(v)


def around(axis: Points, angle: float) -> Points:
    """The unit vector at a right angle to an axis, turned about it."""
    first = unit(np.cross(axis, [0.31, 0.12, 0.94]))
    return np.cos(angle) * first + np.sin(angle) * np.cross(axis, first)
