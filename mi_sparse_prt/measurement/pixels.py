"""M at the pixels of a camera: its G-buffer samples, with the film's reconstruction filter as weights."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mi_sparse_prt.core.device_arrays import on_device
from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.core.random_keys import hash_rows
from mi_sparse_prt.measurement.measurement import Measurement, MeshRange
from mi_sparse_prt.measurement.vertices import Points
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.scene.traced_scene import TracedScene


def camera_pixels(scene: Scene, sensor: int | mi.Sensor = 0, spp: int = 16, seed: int = 0) -> Measurement:
    """The points that the pixels of a camera see.

    Parameters
    ----------
    scene : Scene
    sensor : int or mi.Sensor
        One of ``scene.mitsuba.sensors()``, or any other; its film has the size of the image and the filter.
    spp : int
        Points per pixel, jittered. Each keeps a row of T: 640 x 480 x 16 rows of bits take 3.8 GB for 6144 directions.
    seed : int

    Returns
    -------
    Measurement
        Outputs are pixels, row by row; ``image`` is (height, width). Points are on sheets of surfaces that reflect;
        the share of a pixel that other samples have is missing in its weights.

    Raises
    ------
    PrtError
        If the scene has no such sensor, or the camera sees no surface.
    """
    sensor = scene.sensor(sensor)
    film = sensor.film()
    width, height = (int(n) for n in film.crop_size())
    places = jittered_places(width, height, spp, seed)
    si, reflects = _seen(scene.world, sensor, places, (width, height))
    kept = np.flatnonzero(reflects)
    if not len(kept):
        raise PrtError("the camera sees no surface that reflects; move it, or choose another sensor")
    here = on_device(mi.UInt32, kept.astype(np.uint32))
    points, albedo = _surface_points(scene, dr.gather(mi.SurfaceInteraction3f, si, here))
    weights = _filter_weights(film.rfilter(), places, width, height)[:, kept]
    return Measurement(
        keys=points.keys,
        areas=np.ones(len(kept), np.float32),
        groups=(MeshRange("pixels", slice(0, len(kept))),),
        kind="pixels",
        normalised=points,
        frame=(scene.centre, scene.scale),
        scene_hash=scene.hash,
        albedo=albedo,
        weights=weights,
        image=(height, width),
    )


def jittered_places(width: int, height: int, spp: int, seed: int) -> NDArray[np.float32]:
    """Places (width * height * spp, 2) in pixels: one in each of some strata of a pixel, pixels row by row.

    Raises
    ------
    PrtError
        If there is to be less than one.
    """
    if spp != int(spp) or spp < 1:
        raise PrtError(f"spp is {spp}; it must be a whole number of at least 1")
    rows = max(k for k in range(1, int(np.sqrt(spp)) + 1) if spp % k == 0)
    random = np.random.default_rng([seed, 7]).random((height, width, rows, spp // rows, 2), np.float32)
    y, x, i, j = np.meshgrid(*(np.arange(n) for n in random.shape[:4]), indexing="ij", sparse=True)
    places = np.stack([x + (j + random[..., 0]) / (spp // rows), y + (i + random[..., 1]) / rows], axis=-1)
    return places.reshape(-1, 2).astype(np.float32)


def _seen(
    scene: TracedScene, sensor: mi.Sensor, places: NDArray[np.float32], size: tuple[int, int]
) -> tuple[mi.SurfaceInteraction3f, NDArray[np.bool_]]:
    """What camera rays meet, and which of them meet the front of a surface, or a back that reflects as well."""
    at = mi.Point2f(*(np.ascontiguousarray(places[:, k] / size[k]) for k in range(2)))
    ray, _ = sensor.sample_ray(mi.Float(0), mi.Float(0.5), at, mi.Point2f(0.5))
    si = scene.ray_intersect(ray)
    two_sided = mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.BackSide)
    return si, (si.is_valid() & (two_sided | (mi.Frame3f.cos_theta(si.wi) > 0))).numpy()


def _surface_points(scene: Scene, si: mi.SurfaceInteraction3f) -> tuple[Points, NDArray[np.float32]]:
    """Points in the normalised frame, and their albedo (n, 3), with textures at full resolution."""
    positions = ((np.array(si.p).T.astype(np.float64) - scene.centre) * scene.scale).astype(np.float32)
    side = dr.sign(mi.Frame3f.cos_theta(si.wi))
    normals = np.array(mi.Normal3f(si.sh_frame.n * side)).T.astype(np.float32)
    geometric = np.array(si.n * side).T.astype(np.float32)
    albedo = np.array(mi.Color3f(si.bsdf().eval_diffuse_reflectance(si))).T.astype(np.float32)
    keys = hash_rows(positions, hash_rows(normals))
    points = Points(positions, np.ascontiguousarray(normals), np.ascontiguousarray(geometric), keys)
    return points, np.ascontiguousarray(albedo)


def _filter_weights(
    rfilter: mi.ReconstructionFilter, places: NDArray[np.float32], width: int, height: int
) -> scipy.sparse.csr_array:
    """Weights (pixels, samples): the filter around the centre of each pixel, over its sum for all samples."""
    reach = int(np.ceil(rfilter.radius() - 0.5))
    column, row = np.floor(places).astype(np.int64).T
    entries = []
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            x, y = column + dx, row + dy
            inside = np.flatnonzero((x >= 0) & (x < width) & (y >= 0) & (y < height))
            away = places[inside] - np.stack([x[inside] + 0.5, y[inside] + 0.5], axis=1).astype(np.float32)
            value = np.ones(len(inside))
            for k in range(2):
                value = value * rfilter.eval(mi.Float(np.ascontiguousarray(away[:, k]))).numpy()
            used = value != 0
            entries.append((value[used], y[inside][used] * width + x[inside][used], inside[used]))
    values, pixels, samples = (np.concatenate(part) for part in zip(*entries, strict=True))
    matrix = scipy.sparse.coo_array((values, (pixels, samples)), shape=(width * height, len(places))).tocsr()
    total = np.asarray(matrix.sum(axis=1)).ravel()
    scale = scipy.sparse.diags_array(np.where(total != 0, 1 / np.where(total != 0, total, 1), 0))
    return scipy.sparse.csr_array(scale @ matrix).astype(np.float32)
