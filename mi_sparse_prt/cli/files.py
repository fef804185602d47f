"""Contents of the files that commands write, as bytes: writing is the same for all of them."""

from __future__ import annotations

import io

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.scene.scene import Scene


def image_bytes(image: NDArray[np.float32], suffix: str, exposure: float, half: bool = False) -> bytes:
    """A linear RGB image (height, width, 3) as the content of a .png (sRGB, 8 bits) or .exr file.

    ``half``: the .exr file has 16 bits for a number, and takes a fifth of the time.
    """
    stream = mi.MemoryStream()
    if suffix == ".exr":
        bitmap = mi.Bitmap(np.ascontiguousarray(image))
        if half:
            bitmap = bitmap.convert(component_format=mi.Struct.Type.Float16)
        bitmap.write(stream, mi.Bitmap.FileFormat.OpenEXR)
    else:
        mi.Bitmap(srgb_pixels(image, exposure)).write(stream, mi.Bitmap.FileFormat.PNG)
    return bytes(stream.raw_buffer())


def srgb_pixels(image: NDArray[np.float32], exposure: float) -> NDArray[np.uint8]:
    """A linear RGB image (height, width, 3) in sRGB, brightened by ``exposure`` stops."""
    bitmap = mi.Bitmap(np.ascontiguousarray(image * np.float32(2.0**exposure)))
    return np.array(bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, srgb_gamma=True))


def vertices_bytes(scene: Scene, radiance: NDArray[np.float32], suffix: str) -> bytes:
    """Radiance of all vertices (n_v, 3) as the content of a .npy or .ply file."""
    return _npy_bytes(radiance) if suffix == ".npy" else _ply_bytes(scene, radiance)


def _npy_bytes(array: NDArray[np.float32]) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def _ply_bytes(scene: Scene, radiance: NDArray[np.float32]) -> bytes:
    """All meshes in world space as one PLY whose ``vertex_color`` is the radiance, as Mitsuba's ``ply`` reads it."""
    triangles = np.concatenate([mesh.triangles + mesh.vertices.start for mesh in scene.meshes])
    mesh = mi.Mesh("relit", len(radiance), len(triangles), has_vertex_normals=True)
    mesh.add_attribute("vertex_color", 3, radiance.ravel())
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = scene.positions.ravel()
    parameters["vertex_normals"] = scene.normals.ravel()
    parameters["faces"] = triangles.ravel().astype(np.uint32)
    parameters.update()
    stream = mi.MemoryStream()
    mesh.write_ply(stream)
    return bytes(stream.raw_buffer())
