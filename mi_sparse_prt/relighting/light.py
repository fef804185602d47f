"""E that moves: the light of a frame in about a millisecond, instead of an exact projection of the environment.

An environment that turns about +y, as most do, is summed along its rows (``relighting.turntable``). One that is turned
otherwise is looked up in a cubemap four times as fine that holds its exact means. The lookups are linear, so that a
texel of the result is a mean over squares of a quarter of its own size. Texels within which these differ much, at the
border of a lamp, get more of them.
"""

from __future__ import annotations

from functools import cached_property

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.emission.cube_faces import FACE_FRAMES, subtexels, texels_towards
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.emission.environment import Environment
from mi_sparse_prt.relighting.turntable import Turntable

Floats = NDArray[np.float32]

FINER = 4  # texels of the stored cubemap along the edge of one of the light's
FINEST = 256  # along a face: more would take seconds to prepare
LOOKUPS, MORE_LOOKUPS = 2, 8  # along the edge of a texel
SHARP = 4.0  # differences within a texel, in means over the sphere, above which it gets more lookups
UPRIGHT = 1e-9  # a turn is about +y if it moves that axis by no more: 1 less the cosine
BORDER, MOST_BORDER = 8, 256  # squares along the edge of a texel that the border of a disc crosses


class TurningLight:
    """An environment that turns, as lighting of a cubemap, frame by frame.

    Parameters
    ----------
    environment : Environment
    lighting : CubemapLighting
        Of the result; the first turn takes a second or two of one with 64 texels along an edge.
    """

    def __init__(self, environment: Environment, lighting: CubemapLighting) -> None:
        self.environment, self.lighting = environment, lighting
        power = np.einsum("hwc,hw->c", environment.pixels, environment.solid_angles)
        self._power = power.astype(np.float64)  # [rgb], no turn changes it

    def turned(self, rotation: ArrayLike) -> Floats:
        """L of the turned environment, quickly: (6 n^2, 3) mean radiance of texels.

        Parameters
        ----------
        rotation : float or (3, 3) array
            Degrees about +y or a rotation matrix, as for ``Environment.rotated``.
        """
        own, steep = self.environment.rotation, self.lighting.resolution == 1
        if np.ndim(rotation) == 0 and np.isfinite(rotation) and _upright(own) and not steep:
            result = self._turntable.at(_azimuth(own) + float(np.asarray(rotation)))
        else:
            matrix = self.environment.rotated(rotation).rotation
            about_up = _upright(matrix) and not steep
            result = self._turntable.at(_azimuth(matrix)) if about_up else self._resampled(matrix)
        _give_power(result, self.lighting.solid_angles, self._power)
        return result

    @cached_property
    def _turntable(self) -> Turntable:
        return Turntable(self.environment.pixels, self.lighting)

    @cached_property
    def _padded(self) -> Floats:
        """The environment, in its own frame, as a finer cubemap with the texels beside its faces."""
        n = self.lighting.resolution
        fine = CubemapLighting(max(n, min(FINER * n, FINEST)))
        return _padded(fine.project(Environment(self.environment.pixels)), fine.resolution)

    def _resampled(self, matrix: NDArray[np.float64]) -> Floats:
        n, result = self.lighting.resolution, np.empty((self.lighting.n_directions, 3), np.float32)
        frames = FACE_FRAMES.reshape(-1, 3) @ matrix  # of faces, seen from the environment
        sharp = np.float32(SHARP * self._power.sum() / (4 * np.pi))
        _resample(self._padded, frames.reshape(6, 3, 3).astype(np.float32), n, sharp, result)
        return result

    def exact(self, rotation: ArrayLike) -> Floats:
        """L of the turned environment as ``CubemapLighting.project`` has it: for a light that stands still."""
        return self.lighting.project(self.environment.rotated(rotation))


def _upright(matrix: NDArray[np.float64]) -> bool:
    """Whether a rotation is about +y."""
    return bool(matrix[1, 1] > 1 - UPRIGHT)


def _azimuth(matrix: NDArray[np.float64]) -> float:
    """Degrees of a rotation about +y."""
    return float(np.degrees(np.arctan2(matrix[0, 2], matrix[0, 0])))


def disc(lighting: CubemapLighting, towards: ArrayLike, degrees: float, radiance: ArrayLike = 1.0) -> Floats:
    """L of a round light far away, a sun or a lamp: (6 n^2, 3) mean radiance of texels.

    Parameters
    ----------
    lighting : CubemapLighting
    towards : (3,)
        Direction of its centre, world; any length but 0.
    degrees : float
        Its radius.
    radiance : float or (3,)

    Raises
    ------
    PrtError
        If the direction is 0 or not finite, or the radius not between 0 and 180 degrees.
    """
    centre = np.asarray(towards, np.float64)
    length = np.linalg.norm(centre)
    if centre.shape != (3,) or not np.isfinite(length) or length == 0:
        raise PrtError(f"a light cannot lie in the direction {towards!r}: give three numbers, not all 0")
    if not 0 < degrees <= 180:
        raise PrtError(f"a light of {degrees} degrees: its radius is above 0, and 180 at most")
    n, radius, centre = lighting.resolution, np.radians(degrees), centre / length
    angles = np.arccos(np.clip(lighting.directions @ centre, -1, 1))
    covered = (angles < radius).astype(np.float64)
    near = np.flatnonzero(np.abs(angles - radius) < 2 / n)  # no texel reaches farther
    squares = int(np.clip(np.ceil(8 / (n * radius)), BORDER, MOST_BORDER))  # a quarter of the radius
    directions, parts = subtexels(near, n, squares)
    inside = directions @ centre > np.cos(radius)
    covered[near] = (inside * parts).sum(axis=1) / parts.sum(axis=1)
    covered *= 2 * np.pi * (1 - np.cos(radius)) / max(covered @ lighting.solid_angles, 1e-30)
    return covered[:, None].astype(np.float32) * np.broadcast_to(np.asarray(radiance, np.float32), 3)


def even_lights(lighting: CubemapLighting, count: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Lights all around the scene, that shine one at a time: together they are light of radiance 1 from everywhere.

    Returns
    -------
    (count, 3) float64
        Their directions, world, evenly spread (on a spiral from -y to +y).
    (n_directions,) int64
        Which of them each texel belongs to: the nearest.

    Raises
    ------
    PrtError
        If there is none, or there are more than texels.
    """
    if not 1 <= count <= lighting.n_directions:
        raise PrtError(f"{count} lights: give 1 to {lighting.n_directions}, the texels of this cubemap")
    y = (2 * np.arange(count) + 1) / count - 1
    phi, radius = np.pi * (3 - 5**0.5) * np.arange(count), np.sqrt(1 - y * y)
    directions = np.stack([radius * np.sin(phi), y, -radius * np.cos(phi)], axis=1)
    return directions, cKDTree(directions).query(lighting.directions)[1].astype(np.int64)


def _padded(texels: Floats, n: int) -> Floats:
    """Faces (6, n + 2, n + 2, 3) with the texels beside them, on the continued planes of the faces."""
    places = (2 * np.arange(-1, n + 1) + 1) / n - 1
    s_axis, t_axis, centre = (FACE_FRAMES[:, axis][:, None, None] for axis in range(3))
    directions = centre + places[None, None, :, None] * s_axis + places[None, :, None, None] * t_axis
    return texels[texels_towards(directions.reshape(-1, 3), n)].reshape(6, n + 2, n + 2, 3)


@numba.njit(parallel=True, fastmath=True, cache=True)
def _give_power(light: Floats, areas: Floats, power: NDArray[np.float64]) -> None:
    """Scale the channels of a light (m, 3) so that they have this power together."""
    red = green = blue = 0.0
    for j in numba.prange(len(light)):
        red += areas[j] * light[j, 0]
        green += areas[j] * light[j, 1]
        blue += areas[j] * light[j, 2]
    factors = np.ones(3, np.float32)
    for c, found in enumerate((red, green, blue)):
        if found > 0:
            factors[c] = power[c] / found
    for j in numba.prange(len(light)):
        for c in range(3):
            light[j, c] *= factors[c]


@numba.njit(inline="always")
def _place(
    x: np.float32, y: np.float32, z: np.float32, half: np.float32
) -> tuple[int, np.float32, np.float32]:
    """Face of a direction, and column and row of its point in a padded face of 2 ``half`` texels along an edge."""
    ax, ay, az = abs(x), abs(y), abs(z)
    on_x, on_y = ax >= max(ay, az), ay >= az
    major = x if on_x else (y if on_y else z)
    face = (0 if on_x else (2 if on_y else 4)) + (0 if major > 0 else 1)
    sign = np.float32(1.0) if major > 0 else np.float32(-1.0)
    s = -sign * z if on_x else (x if on_y else sign * x)
    t = sign * z if (on_y and not on_x) else -y
    scale = half / abs(major)
    shift = half + np.float32(0.5)
    return face, s * scale + shift, t * scale + shift


@numba.njit(inline="always")
def _look_up(faces: Floats, face: int, column: np.float32, row: np.float32) -> tuple[float, float, float]:
    """Linear in between the centres of texels."""
    last = faces.shape[1] - 2
    j, i = min(max(int(column), 0), last), min(max(int(row), 0), last)
    u, v = column - np.float32(j), row - np.float32(i)
    one = np.float32(1.0)
    a, b, c, d = (one - u) * (one - v), u * (one - v), (one - u) * v, u * v
    upper, lower = faces[face, i], faces[face, i + 1]
    return (
        a * upper[j, 0] + b * upper[j + 1, 0] + c * lower[j, 0] + d * lower[j + 1, 0],
        a * upper[j, 1] + b * upper[j + 1, 1] + c * lower[j, 1] + d * lower[j + 1, 1],
        a * upper[j, 2] + b * upper[j + 1, 2] + c * lower[j, 2] + d * lower[j + 1, 2],
    )


@numba.njit(inline="always")
def _texel(
    faces: Floats, frame: Floats, row: int, column: int, n: int, s: int
) -> tuple[np.float32, np.float32, np.float32, np.float32]:
    """Mean over s x s places of a texel, by their solid angles; and how far apart the values at them are."""
    half, step = np.float32(0.5 * (faces.shape[1] - 2)), np.float32(2.0 / (n * s))
    red = green = blue = total = np.float32(0)
    least, most = np.float32(np.inf), np.float32(-np.inf)
    one = np.float32(1.0)
    for p in range(s):
        t = (np.float32(row * s + p) + np.float32(0.5)) * step - one
        for q in range(s):
            u = (np.float32(column * s + q) + np.float32(0.5)) * step - one
            x = frame[2, 0] + u * frame[0, 0] + t * frame[1, 0]
            y = frame[2, 1] + u * frame[0, 1] + t * frame[1, 1]
            z = frame[2, 2] + u * frame[0, 2] + t * frame[1, 2]
            face, at_column, at_row = _place(x, y, z, half)
            r, g, b = _look_up(faces, face, at_column, at_row)
            weight = one / np.sqrt(one + u * u + t * t)
            weight = weight * weight * weight
            red, green, blue, total = red + weight * r, green + weight * g, blue + weight * b, total + weight
            brightness = np.float32(r + g + b)
            least, most = min(least, brightness), max(most, brightness)
    return red / total, green / total, blue / total, most - least


@numba.njit(parallel=True, fastmath=True, cache=True)
def _resample(faces: Floats, frames: Floats, n: int, sharp: np.float32, result: Floats) -> None:
    """Texels (6 n^2, 3) from padded faces; ``frames`` are the faces' axes and centres in the frame of these."""
    for line in numba.prange(6 * n):
        frame, row = frames[line // n], line % n
        for column in range(n):
            red, green, blue, spread = _texel(faces, frame, row, column, n, LOOKUPS)
            if spread > sharp:
                red, green, blue, spread = _texel(faces, frame, row, column, n, MORE_LOOKUPS)
            texel = line * n + column
            result[texel, 0], result[texel, 1], result[texel, 2] = red, green, blue
