"""What a page draws: triangles, albedos, cameras and environments, as small arrays."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.morton import morton_order
from mi_sparse_prt.emission.environment import Environment
from mi_sparse_prt.emission.equirectangular import resampled
from mi_sparse_prt.scene.scene import Mesh, Scene

HEIGHT = 128  # of environments in a page, which are twice as wide: two pixels in a texel of n = 32
SHARPEST = 512  # rows of a background, at most
QUALITY = 99  # of its JPEG
TEXTURE = 512  # pixels along an edge of an albedo texture
PERSPECTIVE = "PerspectiveCamera", "ThinLensCamera"  # sensors that a page can stand for

Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class DrawOrder:
    """Triangles in an order in which each has vertices of those before it, and vertices in the order of their use.

    Graphics cards keep the last few vertices; and numbers that differ little from those before them are stored in less.

    Attributes
    ----------
    triangles : (n_t, 3) int32
        Of all sheets, one mesh after the other.
    order : (n_v,) int64
        Which of the scene's vertices each vertex of these is.
    """

    triangles: NDArray[np.int32]
    order: NDArray[np.int64]


def draw_order(scene: Scene) -> DrawOrder:
    """Triangles along a space-filling curve."""
    parts = [_along_curve(scene, mesh.triangles + mesh.vertices.start) for mesh in scene.meshes]
    triangles = np.concatenate(parts)
    used, first = np.unique(triangles, return_index=True)
    order = np.concatenate([used[np.argsort(first)], np.setdiff1d(np.arange(scene.n_vertices), used)])
    numbers = np.empty(len(order), np.int32)
    numbers[order] = np.arange(len(order), dtype=np.int32)
    return DrawOrder(numbers[triangles], order)


def _along_curve(scene: Scene, triangles: NDArray[np.integer]) -> NDArray[np.integer]:
    centres = scene.normalised_positions[triangles].mean(axis=1)
    return triangles[morton_order(centres, np.arange(len(triangles), dtype=np.uint64))]


def geometry(scene: Scene, own: DrawOrder) -> tuple[Arrays, dict[str, Any]]:
    """Vertices and triangles of all sheets, and what to know of them."""
    low = scene.positions.min(axis=0)
    extent = np.maximum(np.ptp(scene.positions, axis=0), 1e-30)
    places = np.rint((scene.positions - low) / extent * 65535).astype(np.uint16)
    counts = np.array([mesh.triangles.size for mesh in scene.meshes])
    firsts = np.cumsum(counts) - counts
    textures, numbers = _textures(scene)
    meshes = [
        {"name": m.name, "first": int(a), "count": int(b), "back": k >= len(scene.fronts), "texture": t}
        for k, (m, a, b, t) in enumerate(zip(scene.meshes, firsts, counts, numbers, strict=True))
    ]
    arrays: Arrays = {
        "positions": places[own.order],
        "normals": np.rint(scene.normals * 127).astype(np.int8)[own.order],
        "albedo": np.rint(np.clip(scene.albedo, 0, 1) * 65535).astype(np.uint16)[own.order],
        "triangles": own.triangles,
    }
    if textures:
        arrays["texcoords"] = np.concatenate([_texcoords(scene, mesh) for mesh in scene.meshes])[own.order]
    about = {
        "vertices": len(places),
        "low": low.tolist(),
        "extent": extent.tolist(),
        "meshes": meshes,
        "textures": textures,
    }
    return arrays, about


def camera(scene: Scene, sensor: int | mi.Sensor | None) -> dict[str, Any]:
    """Where a picture is taken from: eye, target, up, and its height at distance 1.

    The sensor's own where it is a perspective one; else all of the scene, from the front.
    """
    size = float(np.linalg.norm(np.ptp(scene.positions, axis=0)))
    found = None if sensor is None else scene.sensor(sensor)
    if found is None or found.class_name() not in PERSPECTIVE:
        eye = scene.centre + np.array([0, 0.3, 1.2]) * size
        return {"eye": eye.tolist(), "target": scene.centre.tolist(), "up": [0, 1, 0], "height": 0.8}
    ray, _ = found.sample_ray(0, 0.5, mi.Point2f([0.5, 0.5, 0.5], [0.5, 0, 1]), mi.Point2f(0.5))
    middle, top, bottom = np.array(ray.d).T.astype(np.float64)
    eye = np.array(ray.o).T.reshape(-1, 3)[0].astype(np.float64)
    forwards = middle / np.linalg.norm(middle)
    distance = max(float((scene.centre - eye) @ forwards), 0.1 * size)
    edges = [d / (d @ forwards) for d in (top, bottom)]
    height = edges[0] - edges[1]
    return {
        "eye": eye.tolist(),
        "target": (eye + distance * forwards).tolist(),
        "up": (height / np.linalg.norm(height)).tolist(),
        "height": float(np.linalg.norm(height)),
    }


def environment_words(environment: Environment, height: int = HEIGHT) -> NDArray[np.uint32]:
    """Mean radiance of (height, 2 height) pixels, in the world's frame, as RGB9_E5 words of OpenGL."""
    pixels = _turned_upright(environment, height)
    scaled = np.clip(pixels, 0, 65408).astype(np.float64)  # the largest of the format
    exponent = (
        np.maximum(-16, np.floor(np.log2(np.maximum(scaled.max(axis=-1), 1e-30)))).astype(np.int64) + 16
    )
    exponent += np.rint(scaled.max(axis=-1) * 2.0 ** (24 - exponent)) > 511
    parts = np.rint(scaled * 2.0 ** (24 - exponent)[..., None]).astype(np.uint32)
    return parts[..., 0] | parts[..., 1] << 9 | parts[..., 2] << 18 | exponent.astype(np.uint32) << 27


def lights(environments: Mapping[str, Environment]) -> tuple[Arrays, list[dict[str, Any]]]:
    """Radiance of environments, and what to know of them."""
    arrays = {f"environment{k}": environment_words(light) for k, light in enumerate(environments.values())}
    about = [
        {"name": name, "width": 2 * HEIGHT, "height": HEIGHT, "background": background(light)}
        for name, light in environments.items()
    ]
    return arrays, about


def background(environment: Environment) -> str:
    """What the camera sees of an environment, sharper than its light: a JPEG (data:) of radiance up to 1."""
    height = min(environment.pixels.shape[0], SHARPEST)
    pixels = np.clip(_turned_upright(environment, height), 0, 1)
    return _image_url(pixels, "jpeg", quality=QUALITY, subsampling=0)  # colours as sharp as brightness


def _image_url(pixels: NDArray[np.floating], kind: str, **options: Any) -> str:
    """A linear RGB image as one of 8 bits (data:)."""
    from PIL import Image

    bitmap, stream = mi.Bitmap(np.ascontiguousarray(pixels, np.float32)), io.BytesIO()
    srgb = bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, srgb_gamma=True)
    Image.fromarray(np.array(srgb)).save(stream, kind, **options)
    return f"data:image/{kind};base64," + base64.b64encode(stream.getvalue()).decode()


def _turned_upright(environment: Environment, height: int) -> NDArray[np.floating]:
    """Radiance (height, 2 height, 3) of an environment in the world's frame: means over pixels."""
    source = environment.pixels
    if np.allclose(environment.rotation, np.eye(3), atol=1e-6):
        return resampled(source, height, 2 * height)
    squares = 4  # places along the edge of a pixel
    theta = np.pi * (np.arange(squares * height) + 0.5) / (squares * height)
    phi = np.pi * (np.arange(2 * squares * height) + 0.5) / (squares * height)
    x, y, z = np.broadcast_arrays(
        np.sin(theta)[:, None] * np.sin(phi), np.cos(theta)[:, None], -np.sin(theta)[:, None] * np.cos(phi)
    )
    own = np.stack([x, y, z], axis=-1) @ environment.rotation
    u = np.arctan2(own[..., 0], -own[..., 2]) / (2 * np.pi) % 1
    v = np.arccos(np.clip(own[..., 1], -1, 1)) / np.pi
    found = source[
        np.minimum((v * source.shape[0]).astype(int), source.shape[0] - 1),
        (u * source.shape[1]).astype(int) % source.shape[1],
    ]
    return found.reshape(height, squares, 2 * height, squares, 3).mean(axis=(1, 3))


def _textures(scene: Scene) -> tuple[list[str], list[int | None]]:
    """Albedo textures as images in the page (data:), and the number of each mesh's own."""
    images: dict[str, int] = {}
    numbers: list[int | None] = []
    for mesh, material in zip(scene.meshes, scene.materials, strict=True):
        shape = scene.mitsuba.shapes()[mesh.shape]
        if material.constant or not material.diffuse or not shape.has_vertex_texcoords():
            numbers.append(None)
            continue
        image = _albedo_image(material.bsdf, mesh)
        numbers.append(None if image is None else images.setdefault(image, len(images)))
    return list(images), numbers


def _albedo_image(bsdf: mi.BSDF, mesh: Mesh) -> str | None:
    """The diffuse reflectance over a square of texture coordinates, as a PNG (data:)."""
    cells = (np.arange(TEXTURE) + 0.5) / TEXTURE
    si = dr.zeros(mi.SurfaceInteraction3f, TEXTURE * TEXTURE)
    v, u = np.meshgrid(cells, cells, indexing="ij")
    si.uv = mi.Point2f(u.ravel(), v.ravel())
    si.wi = mi.Vector3f(0, 0, 1)
    values = np.array(bsdf.eval_diffuse_reflectance(si)).T.reshape(TEXTURE, TEXTURE, 3)
    if not np.ptp(values.reshape(-1, 3), axis=0).any():
        return None  # it is colours of vertices or of faces that vary
    return _image_url(values, "png", optimize=True)


def _texcoords(scene: Scene, mesh: Mesh) -> NDArray[np.float32]:
    shape = scene.mitsuba.shapes()[mesh.shape]
    own = scene.fronts[mesh.shape].vertices
    if not shape.has_vertex_texcoords():
        return np.zeros((mesh.vertices.stop - mesh.vertices.start, 2), np.float32)
    values = np.array(mi.traverse(shape)["vertex_texcoords"], np.float32).reshape(-1, 2)
    return values[scene.front_of[mesh.vertices] - own.start]
