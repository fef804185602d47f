"""Lights that move, frame by frame: lighting L (6 n^2, 3) of a cubemap, one array after the other."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.relighting.light import TurningLight, disc

Floats = NDArray[np.float32]


def turning(light: TurningLight, degrees: float = 180, frames: int = 100, still: int = 0) -> Iterator[Floats]:
    """An environment that turns about +y, faster and faster, and stops at once.

    Parameters
    ----------
    light : TurningLight
    degrees : float
        Of the last frame. Acceleration is constant: slow at frame 30 of 100, fast at 75 ([OBRG06] 4.1).
    frames : int
        Of the turn; the first and the last have the exact light, not a quickly resampled one.
    still : int
        Frames that follow, with the light of the last one.
    """
    yield light.exact(0)
    for frame in range(1, frames - 1):
        yield light.turned(degrees * (frame / (frames - 1)) ** 2)
    last = light.exact(degrees)
    for _ in range(1 + still):
        yield last


def interpolation(first: Floats, last: Floats, frames: int = 100, still: int = 0) -> Iterator[Floats]:
    """From one light to another in equal steps ([OBRG06] Figure 11); then ``still`` frames more."""
    for frame in range(frames + still):
        t = np.float32(min(frame / max(frames - 1, 1), 1))
        yield (1 - t) * first + t * last


def moving_disc(
    lighting: CubemapLighting,
    ambient: float = 0.1,
    radiance: float = 50,
    degrees: tuple[float, float] = (3, 8),
    frames: int = 100,
    still: int = 0,
) -> Iterator[Floats]:
    """A round light that rises, crosses the sky and grows, in a light that is the same from everywhere.

    Parameters
    ----------
    lighting : CubemapLighting
    ambient, radiance : float
        Of the light from everywhere, and of the round one.
    degrees : (float, float)
        Radius of the first and of the last frame.
    frames, still : int
        Frames that move, and that follow with the light of the last one.
    """
    for frame in range(frames + still):
        t = min(frame / max(frames - 1, 1), 1)
        azimuth, height = np.radians(120 * t), np.radians(25 + 40 * t)
        towards = (np.cos(height) * np.sin(azimuth), np.sin(height), np.cos(height) * np.cos(azimuth))
        radius = (1 - t) * degrees[0] + t * degrees[1]
        yield np.maximum(disc(lighting, towards, radius, radiance), np.float32(ambient))


def cut(first: Floats, last: Floats, frame: int = 50, frames: int = 100) -> Iterator[Floats]:
    """One light, and from a frame on another."""
    for k in range(frames):
        yield first if k < frame else last
