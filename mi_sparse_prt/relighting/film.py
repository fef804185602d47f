"""Frames of a film: environments, one that turns and one that becomes another meanwhile, and what a camera sees."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.emission.environment import Environment
from mi_sparse_prt.emission.equirectangular import resampled
from mi_sparse_prt.relighting.fixed_camera import FixedCamera, stands_for_pictures
from mi_sparse_prt.relighting.image import render
from mi_sparse_prt.relighting.light import even_lights
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.transport import LightTransport

TOGETHER = 192  # lights, one at a time, whose products are found at once

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


def images_one_light_at_a_time(
    scene: Scene, transport: LightTransport, count: int, sensor: int | mi.Sensor, spp: int
) -> Iterator[Floats]:
    """Pictures (height, width, 3), linear RGB, of each of so many ``even_lights`` of radiance 1, without a background.

    Raises
    ------
    PrtError
        If the matrix's light is no cubemap or has fewer texels, or rays go on from what the camera sees (see
        ``FixedCamera``).
    """
    if not isinstance(transport.emission, CubemapLighting):
        raise PrtError(f"even lights are parts of a cubemap; this matrix has {transport.emission!r}")
    _, owners = even_lights(transport.emission, count)
    camera = FixedCamera(scene, transport, sensor, spp)
    for first in range(0, count, TOGETHER):
        some = np.arange(first, min(first + TOGETHER, count))
        lights = (owners[:, None] == some).astype(np.float32)
        incident = transport.incident.apply(lights)  # [row, channel, light]
        for k in range(len(some)):
            yield camera.image(np.broadcast_to(incident[:, :, k], (len(incident), 3)))


def _of_one_size(first: Floats, last: Floats) -> tuple[Floats, Floats]:
    """Both images with the rows and columns of the larger one."""
    rows, columns = (int(n) for n in np.maximum(first.shape[:2], last.shape[:2]))
    return resampled(first, rows, columns), resampled(last, rows, columns)
