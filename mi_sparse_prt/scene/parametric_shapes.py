"""Spheres, disks and cylinders as grids of triangles in their own parametrisation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.scene.subdivision import TIE, Doubles, Project, as_it_is, too_many_vertices
from mi_sparse_prt.scene.triangle_mesh import TriangleMesh, normalise_rows, triangle_normals, unique_rows

FEWEST = 32  # segments around a shape, whatever the edge length

#: (u, v) of shape (n,) each -> local positions and local normals, (n, 3) each.
Parametrisation = Callable[
    [NDArray[np.float64], NDArray[np.float64]], tuple[NDArray[np.float64], NDArray[np.float64]]
]


def _sphere(u: NDArray, v: NDArray) -> tuple[NDArray, NDArray]:
    phi, theta = 2 * np.pi * u, np.pi * v
    p = np.column_stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])
    return p, p


def _disk(u: NDArray, v: NDArray) -> tuple[NDArray, NDArray]:
    # Mitsuba's disk: u is the radius, v the angle.
    phi = 2 * np.pi * v
    return np.column_stack([u * np.cos(phi), u * np.sin(phi), 0 * u]), np.tile([0.0, 0.0, 1.0], (len(u), 1))


def _cylinder(u: NDArray, v: NDArray) -> tuple[NDArray, NDArray]:
    phi = 2 * np.pi * u
    return np.column_stack([np.cos(phi), np.sin(phi), v]), np.column_stack([np.cos(phi), np.sin(phi), 0 * v])


def parametric_mesh(
    shape: str,
    to_world: NDArray[np.float64],
    edge_length: float,
    name: str,
    *,
    limit: int,
    fewest: int = FEWEST,
    weld: bool = False,
) -> TriangleMesh:
    """A Mitsuba `sphere`, `disk` or `cylinder` as a grid in its own (u, v) parametrisation.

    Parameters
    ----------
    shape : {"sphere", "disk", "cylinder"}
    to_world : (4, 4) float64
        Local to world; local are the unit sphere; the unit disk in z = 0; the unit cylinder from z = 0 to 1.
    edge_length : float
        World units; grid lines are at most this far apart. `inf` gives the coarsest grid.
    limit : int
        The largest number of vertices allowed.
    fewest : int
        Segments around, whatever the edge length: a multiple of 4.
    weld : bool
        Merge vertices of equal position and normal (the seam and the poles) and leave texture coordinates
        out: for materials that do not vary over the surface.

    Returns
    -------
    TriangleMesh
        World space, normals exact, no triangle without area at the poles.

    Raises
    ------
    PrtError
        A `to_world` of size zero; more than `limit` vertices.
    """
    linear = to_world[:3, :3]
    scale = np.linalg.norm(linear, axis=0)  # of the local axes x, y, z
    if not np.all(scale > 0):
        raise PrtError(f"shape '{name}': its to_world leaves no size: the scale must not be zero")
    radius = max(scale[0], scale[1])
    around = 4 * max(fewest // 4, _segments(np.pi / 2 * radius, edge_length))
    # `angle` is the axis of (u, v) that runs around, `across` counts along the other one, `poles` are its ends
    # where circles shrink to points.
    surface: Parametrisation
    poles: tuple[int, ...]
    if shape == "sphere":
        surface, angle, poles = _sphere, 0, (0, 1)
        across = 2 * max(fewest // 4, _segments(np.pi / 2 * radius, edge_length))
    elif shape == "disk":
        surface, angle, poles, across = _disk, 1, (0,), _segments(radius, edge_length)
    else:
        surface, angle, poles, across = _cylinder, 0, (), _segments(scale[2], edge_length)
    if (around + 1) * (across + 1) > limit:
        raise too_many_vertices(name, edge_length, limit)
    uv, triangles = _grid(around, across, angle, poles)
    wrapped = uv.copy()
    wrapped[uv[:, angle] == 1, angle] = 0.0  # the seam's two sides have the same bits
    local, normal = surface(wrapped[:, 0], wrapped[:, 1])
    local = np.where(np.abs(local) < 1e-15, 0.0, local)  # sin(pi) is not zero: poles meet in one point

    positions = (local @ linear.T + to_world[:3, 3]).astype(np.float32)
    normals = normalise_rows(normal @ np.linalg.inv(linear)).astype(np.float32)
    mesh = TriangleMesh(name, positions, normals, triangles, uv.astype(np.float32))
    against = np.sum(triangle_normals(mesh) * normals[triangles].sum(axis=1), axis=1) < 0
    triangles[against] = triangles[against][:, [0, 2, 1]]
    if weld:
        keys = np.column_stack([positions, normals]) + np.float32(0)  # -0 and 0 are one
        first, index = unique_rows(keys)
        mesh = replace(mesh.take_vertices(first, index[triangles]), texcoords=None)
    return mesh


def projection(shape: str, to_world: NDArray[np.float64]) -> Project:
    """How points and normals next to a shape come to lie on it; arguments as those of ``parametric_mesh``."""
    if shape == "disk":
        return as_it_is
    to_local, axes = np.linalg.inv(to_world), 3 if shape == "sphere" else 2

    def project(points: Doubles, normals: Doubles) -> tuple[Doubles, Doubles]:
        local = points @ to_local[:3, :3].T + to_local[:3, 3]
        radial = np.zeros_like(local)
        radial[:, :axes] = normalise_rows(local[:, :axes])
        local[:, :axes] = radial[:, :axes]
        outwards = normalise_rows(radial @ to_local[:3, :3])
        side = np.sign(np.sum(outwards * normals, axis=1, keepdims=True))
        return local @ to_world[:3, :3].T + to_world[:3, 3], side * outwards

    return project


def _segments(length: float, edge_length: float) -> int:
    return max(1, int(np.ceil(length / edge_length / (1 + TIE))))


def _grid(
    around: int, across: int, angle: int, poles: tuple[int, ...]
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """(u, v) of the vertices and triangles of a grid of `around` x `across` cells.

    At a pole (the first or last line) each cell is one triangle with its own pole vertex, half a cell along.
    """
    i = np.arange(around + 1) / around
    lines = np.arange(across + 1) / across
    a, b = np.meshgrid(i, lines)  # [across + 1, around + 1]
    for pole in poles:
        row = 0 if pole == 0 else across
        a[row, :-1] += 0.5 / around
    uv = np.stack([a, b] if angle == 0 else [b, a], axis=-1).reshape(-1, 2)
    index = np.arange((across + 1) * (around + 1)).reshape(across + 1, around + 1)
    triangles = []
    for row, (low, high) in enumerate(pairwise(index)):
        if row == 0 and 0 in poles:
            triangles.append(np.column_stack([low[:-1], high[1:], high[:-1]]))
            continue
        triangles.append(np.column_stack([low[:-1], low[1:], high[:-1]]))
        if not (row == across - 1 and 1 in poles):
            triangles.append(np.column_stack([low[1:], high[1:], high[:-1]]))
    faces = np.concatenate(triangles).astype(np.int32)
    used = np.unique(faces)
    renumbered = np.zeros(len(uv), np.int32)
    renumbered[used] = np.arange(len(used))
    return uv[used], renumbered[faces]
