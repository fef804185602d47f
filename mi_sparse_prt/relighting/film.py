"""Frames of a film: environments, one that turns and one that becomes another meanwhile, and what a camera sees."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.emission.environment import Environment
from mi_sparse_prt.relighting.fixed_camera import FixedCamera, stands_for_pictures
from mi_sparse_prt.relighting.image import render
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.transport import LightTransport

Floats = NDArray[np.float32]


def film_lights(
    first: Environment, last: Environment | None, degrees: float, frames: int
) -> Iterator[Environment]:
    """An environment that turns about +y at constant speed; each is a background as sharp as the images.

    Parameters
    ----------
    first : Environment
        Of the first frame.
    last : Environment, optional
        Of the last frame: radiance goes from one to the other in equal steps. It has to be turned as ``first`` is. If
        one image is smaller, its pixels are cut into those of the other: its light stays as it is.
    degrees : float
        Of the last frame, counter-clockwise seen from above; the first one is not turned.
    frames : int
        A single one shows the first.
    """
    pixels = None if last is None else _of_one_size(first.pixels, last.pixels)
    for frame in range(frames):
        t = frame / max(frames - 1, 1)
        light = first
        if pixels is not None:
            share = np.float32(t)
            light = Environment((1 - share) * pixels[0] + share * pixels[1], first.rotation)
        yield light.rotated(degrees * t)


def film_images(
    scene: Scene, transport: LightTransport, lights: Iterable[Environment], sensor: int | mi.Sensor, spp: int
) -> Iterator[Floats]:
    """Pictures (height, width, 3), linear RGB, of a camera that stands still under one light after the other.

    Rays are traced for the first picture alone, unless they go on from mirrors, glass or masks: then for each, as by
    ``render``.
    """
    if not stands_for_pictures(scene, transport):
        for light in lights:
            yield render(scene, transport, light, sensor, spp)
        return
    camera = FixedCamera(scene, transport, sensor, spp)
    for light in lights:
        yield camera.image(transport.incident.relight(transport.emission.project(light)), light)


def _of_one_size(first: Floats, last: Floats) -> tuple[Floats, Floats]:
    """Both images with the rows and columns of the larger one."""
    rows, columns = np.maximum(first.shape[:2], last.shape[:2])
    return _resampled(first, rows, columns), _resampled(last, rows, columns)


def _resampled(pixels: Floats, rows: int, columns: int) -> Floats:
    """Means over new pixels of an image that is constant over each of its own: a small sun keeps its power."""
    if pixels.shape[:2] == (rows, columns):
        return pixels
    height, width = pixels.shape[:2]
    tall = np.tensordot(_overlaps(rows, height), pixels, 1)  # [row, old column, rgb]
    return np.einsum("cw,rwk->rck", _overlaps(columns, width), tall, optimize=True)


def _overlaps(new: int, old: int) -> Floats:
    """Shares (new, old) that ``old`` equal parts of a line have in each of ``new`` ones."""
    ends, old_ends = np.arange(new + 1) / new, np.arange(old + 1) / old
    common = np.minimum(ends[1:, None], old_ends[1:]) - np.maximum(ends[:-1, None], old_ends[:-1])
    return (new * np.maximum(common, 0)).astype(np.float32)
