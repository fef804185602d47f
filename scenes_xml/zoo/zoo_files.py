"""The files that the scenes of the zoo refer to: a ball in three formats, curves, grids, textures and a sky."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

import mi_sparse_prt  # noqa: F401  (chooses Mitsuba's variant)

Floats = NDArray[np.float32]

SIZE = 32  # pixels of a texture


@dataclass(frozen=True)
class Grid:
    """A surface of triangles.

    Attributes
    ----------
    positions, normals : (n, 3) float32
    uv : (n, 2) float32
    triangles : (m, 3) uint32
    """

    positions: Floats
    normals: Floats
    uv: Floats
    triangles: NDArray[np.uint32]


def write_files(folder: Path) -> None:
    """All files, into a folder that exists."""
    write_meshes(folder)
    write_textures(folder)
    write_volumes(folder)
    (folder / "curls.txt").write_text(curls())
    (folder / "ellipsoids.ply").write_bytes(ellipsoids())
    mi.Bitmap(sky()).write(str(folder / "sky.exr"))


def ball(rings: int = 14, segments: int = 28, radius: float = 0.5) -> Grid:
    """A closed ball that all but touches the ground; seam and poles have a vertex for each texture coordinate."""
    v, u = (
        a.ravel() for a in np.meshgrid(*(np.linspace(0, 1, k + 1) for k in (rings, segments)), indexing="ij")
    )
    theta, phi = np.pi * v, 2 * np.pi * u
    normals = np.stack([np.sin(theta) * np.cos(phi), np.cos(theta), -np.sin(theta) * np.sin(phi)], axis=-1)
    index = np.arange((rings + 1) * (segments + 1)).reshape(rings + 1, segments + 1)
    a, b, c, d = (index[i : i + rings, j : j + segments].ravel() for i in (0, 1) for j in (0, 1))
    lower = np.stack([a, c, d], axis=-1)[:-segments]  # without those that shrink to a pole
    upper = np.stack([a, d, b], axis=-1)[segments:]
    used, triangles = np.unique(np.concatenate([upper, lower]), return_inverse=True)
    return Grid(
        (normals * radius + [0, radius + 0.02, 0])[used].astype(np.float32),
        normals[used].astype(np.float32),
        np.stack([u, 1 - v], axis=-1)[used].astype(np.float32),
        triangles.reshape(-1, 3).astype(np.uint32),
    )


def write_meshes(folder: Path) -> None:
    """The ball as ``.ply`` (with colours of vertices and faces), ``.obj`` and ``.serialized``."""
    grid = ball()
    mesh = mi.Mesh(
        "ball", len(grid.positions), len(grid.triangles), has_vertex_normals=True, has_vertex_texcoords=True
    )
    centres = grid.positions[grid.triangles].mean(axis=1)
    mesh.add_attribute("vertex_color", 3, rainbow(grid.positions).ravel())
    mesh.add_attribute("face_color", 3, rainbow(np.floor(centres * 5) / 5).ravel())
    parameters = mi.traverse(mesh)
    parameters["faces"] = mi.UInt32(grid.triangles.ravel())
    parameters["vertex_positions"] = mi.Float(grid.positions.ravel())
    parameters["vertex_normals"] = mi.Float(grid.normals.ravel())
    parameters["vertex_texcoords"] = mi.Float(grid.uv.ravel())
    parameters.update()
    mesh.write_ply(str(folder / "ball.ply"))
    (folder / "ball.obj").write_text(obj(grid))
    (folder / "ball.serialized").write_bytes(serialized(grid))


def rainbow(positions: Floats) -> Floats:
    """Colours (n, 3) in 0.1 to 0.9 that vary with places (n, 3)."""
    return (0.5 + 0.4 * np.sin(positions * [7, 9, 8] + [0, 2, 4])).astype(np.float32)


def obj(grid: Grid) -> str:
    """A surface as text of Wavefront's format."""
    lines = ["v {:.6g} {:.6g} {:.6g}".format(*p) for p in grid.positions]
    lines += ["vt {:.6g} {:.6g}".format(*uv) for uv in grid.uv]
    lines += ["vn {:.6g} {:.6g} {:.6g}".format(*n) for n in grid.normals]
    lines += ["f " + " ".join(f"{k}/{k}/{k}" for k in corners + 1) for corners in grid.triangles]
    return "\n".join(lines) + "\n"


def serialized(grid: Grid) -> bytes:
    """A surface in Mitsuba's own compressed format, version 4, single precision."""
    identifier, version, flags = 0x041C, 4, 0x0001 | 0x0002 | 0x1000  # normals, texture coordinates, floats
    content = struct.pack("<I", flags) + b"ball\0"
    content += struct.pack("<QQ", len(grid.positions), len(grid.triangles))
    content += b"".join(a.tobytes() for a in (grid.positions, grid.normals, grid.uv, grid.triangles))
    offset_of_mesh, meshes = 0, 1
    return (
        struct.pack("<HH", identifier, version)
        + zlib.compress(content, 9)
        + struct.pack("<QI", offset_of_mesh, meshes)
    )


def write_textures(folder: Path) -> None:
    """Colours, and what is not a colour: opacity, roughness, heights, normals."""
    y, x = np.mgrid[0.5:SIZE, 0.5:SIZE] / SIZE * 2 * np.pi
    heights = 0.5 + 0.25 * (np.sin(4 * x) + np.sin(4 * y))
    slope_x, slope_y = -0.5 * np.cos(4 * x), -0.5 * np.cos(4 * y)
    normals = np.stack([slope_x, slope_y, np.ones_like(x)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    stripes = np.where(np.sin(2 * x) > 0, 1.0, 0.2)
    textures = {
        "pattern": np.stack([stripes, 0.5 + 0.4 * np.sin(y), 0.5 + 0.4 * np.cos(x + 2 * y)], axis=-1) * 0.8,
        "opacity": np.sin(2 * x) * np.sin(2 * y) > -0.3,
        "roughness": 0.3 + 0.2 * np.sin(2 * y),
        "bumps": heights,
        "normals": 0.5 + 0.5 * normals,
    }
    for name, values in textures.items():
        grey = values.ndim == 2
        pixels = np.round(255 * values.astype(np.float64)).astype(np.uint8)
        bitmap = mi.Bitmap(pixels[..., None] if grey else pixels)
        bitmap.write(str(folder / f"{name}.png"))


def write_volumes(folder: Path) -> None:
    """A signed distance of two balls that melt into each other, and colours in space."""
    z, y, x = np.mgrid[0:16, 0:16, 0:16].astype(np.float32) / 15
    places = np.stack([x, y, z], axis=-1)
    balls = [
        np.linalg.norm(places - c, axis=-1) - r
        for c, r in (((0.4, 0.35, 0.5), 0.3), ((0.65, 0.65, 0.5), 0.22))
    ]
    blob = -np.log(sum(np.exp(-12 * b) for b in balls)) / 12
    mi.VolumeGrid(np.ascontiguousarray(blob[..., None], np.float32)).write(str(folder / "blob.vol"))
    coarse = np.ascontiguousarray(rainbow(places[::2, ::2, ::2] * 2))
    mi.VolumeGrid(coarse).write(str(folder / "colours.vol"))


def curls() -> str:
    """Nine curling curves: a line ``x y z radius`` for each control point, an empty line after each curve."""
    curves = []
    for k in range(9):
        t = np.linspace(0, 1, 12)
        angle = 4 * t + 2.4 * k
        far = 0.15 + 0.035 * k
        points = np.stack([far * np.cos(angle), 0.06 + 0.9 * t, far * np.sin(angle)], axis=-1)
        curves.append("".join("{:.4f} {:.4f} {:.4f} {:.4f}\n".format(*p, 0.045) for p in points))
    return "\n".join(curves)


def ellipsoids() -> bytes:
    """Four ellipsoids as the ``ply`` of a cloud of Gaussians: half axes as logarithms, a third of the extent's."""
    names = ["x", "y", "z", "nx", "ny", "nz", "vertex_color_0", "vertex_color_1", "vertex_color_2"]
    names += [f"scale_{k}" for k in range(3)] + [f"rot_{k}" for k in range(4)]
    rows = []
    for k, centre in enumerate([(0, 0.45, 0), (-0.5, 0.3, 0.3), (0.5, 0.35, 0.1), (0, 0.25, 0.6)]):
        axes = np.array([(0.25, 0.4, 0.25), (0.2, 0.25, 0.15), (0.2, 0.3, 0.2), (0.3, 0.2, 0.15)][k]) / 3
        turn = 0.4 * k
        rows.append([*centre, 0, 0, 1, 0.5, 0.5, 0.5, *np.log(axes), np.cos(turn), 0, np.sin(turn), 0])
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    header += [f"property float {name}" for name in names] + ["end_header\n"]
    return "\n".join(header).encode() + np.array(rows, "<f4").tobytes()


def sky(height: int = 32) -> Floats:
    """A soft sky (height, 2 height, 3) over a dark ground; its warm bright side is wide enough for coarse texels."""
    y, x = np.mgrid[0.5:height, 0.5 : 2 * height] / height * np.pi
    directions = np.stack([np.sin(y) * np.sin(x), np.cos(y), -np.sin(y) * np.cos(x)], axis=-1)  # +Y is up
    sun = np.array([0.55, 0.7, 0.45]) / np.linalg.norm([0.55, 0.7, 0.45])
    up = directions[..., 1:2]
    colours = np.where(up > 0, [0.35, 0.45, 0.6] + 0.3 * up * [0.3, 0.5, 1], [0.15, 0.14, 0.13])
    bright = np.exp((directions @ sun - 1) * 18)[..., None] * [7.0, 6.2, 5.0]
    return (colours + bright).astype(np.float32)
