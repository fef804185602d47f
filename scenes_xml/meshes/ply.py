"""Triangle meshes in the making: parts are joined, and written as binary PLY files without normals."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray


class Mesh(NamedTuple):
    """Vertices (n, 3), and triangles (m, 3) that are counterclockwise where they face the viewer."""

    vertices: NDArray[np.float64]
    triangles: NDArray[np.int64]


def joined(parts: list[Mesh]) -> Mesh:
    """All parts in one mesh; they share no vertices."""
    starts = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    triangles = [part.triangles + start for part, start in zip(parts, starts, strict=True)]
    return Mesh(np.concatenate([part.vertices for part in parts]), np.concatenate(triangles))


def quad(corners: ArrayLike) -> Mesh:
    """Two triangles between four corners (4, 3), counterclockwise."""
    return Mesh(np.asarray(corners, np.float64), np.array([[0, 1, 2], [0, 2, 3]]))


def grid(points: NDArray[np.float64]) -> Mesh:
    """The surface through points [row, column, xyz]; it faces the viewer who sees columns go right and rows go up."""
    rows, columns = points.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    triangles = np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    return Mesh(points.reshape(-1, 3).astype(np.float64), triangles)


def write(mesh: Mesh, path: Path) -> None:
    """Write a mesh as a PLY file, from which Mitsuba computes smooth normals where triangles share vertices."""
    faces = np.empty(len(mesh.triangles), [("count", "u1"), ("vertices", "<i4", 3)])
    faces["count"], faces["vertices"] = 3, mesh.triangles
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(mesh.vertices)}",
        *(f"property float {axis}" for axis in "xyz"),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header\n",
    ]
    path.write_bytes("\n".join(header).encode() + mesh.vertices.astype("<f4").tobytes() + faces.tobytes())
