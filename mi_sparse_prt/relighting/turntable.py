"""Light of an environment that turns about its own axis: means of texels from sums along the rows of the image.

Within a row of pixels a texel covers an interval of azimuths, and a turn moves all intervals alike. With the sums of each
row from azimuth 0 on, what a texel gets from the row is one difference, of values that are linear within a pixel: exact
in the turn. That the border of a texel may be slanted within a row is what is left out: each interval has the mean and
the variance of the azimuths that the texel covers there.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.emission.cube_faces import FACE_FRAMES
from mi_sparse_prt.emission.cubemap import CubemapLighting

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Ints = NDArray[np.int64]

SQUARES = 32  # along the edge of a texel, by which it is measured
LEAST_VARIANCE = 1e-6  # of azimuths, in pixels: intervals have a length


class Turntable:
    """An image (h, w, 3) around the +y axis, as lighting of a cubemap for any azimuth of the image.

    Parameters
    ----------
    pixels : (h, w, 3) float
        As ``Environment.pixels``.
    lighting : CubemapLighting
        Of two texels along an edge at least: no texel of it goes all around the axis.
    """

    def __init__(self, pixels: NDArray[np.floating], lighting: CubemapLighting) -> None:
        self._height, self._width = pixels.shape[:2]
        self._texels = lighting.n_directions
        self._starts, self._rows, self._intervals = _intervals(
            FACE_FRAMES, lighting.resolution, self._height, self._width, SQUARES
        )
        self._sums = np.zeros((self._height, 2 * self._width + 1, 3))  # twice around: intervals may cross azimuth 0
        np.cumsum(np.tile(pixels, (1, 2, 1)), axis=1, dtype=np.float64, out=self._sums[:, 1:])

    def at(self, degrees: float) -> Floats:
        """L (6 n^2, 3) of the image turned so far about +y, as ``Environment.rotated``."""
        result = np.empty((self._texels, 3), np.float32)
        shift = float(degrees) % 360 * self._width / 360
        _means(self._sums, self._starts, self._rows, self._intervals, shift, result)
        return result


@numba.njit(parallel=True, cache=True)
def _intervals(frames: Doubles, n: int, height: int, width: int, s: int) -> tuple[Ints, NDArray[np.int32], Doubles]:
    """Rows that texels meet: where each texel's begin (6 n^2 + 1,), their numbers, and (k, 3) for each: first column
    (azimuth in pixels), columns, and the share of the texel per column.
    """
    texels = 6 * n * n
    most = 2 + int(2.0 * height / n)  # rows of a texel: it is less than 2 / n radians high
    counts = np.zeros(texels + 1, np.int64)
    rows, found = np.zeros((texels, most), np.int32), np.zeros((texels, most, 3))
    for texel in numba.prange(texels):
        sums = np.zeros((height, 3))  # weight, azimuth, its square
        face, row, column = texel // (n * n), texel // n % n, texel % n
        whole, middle = 0.0, 0.0
        for p in range(-1, s * s):  # first the texel's centre
            a = (row + 0.5) if p < 0 else (row + (p // s + 0.5) / s)
            b = (column + 0.5) if p < 0 else (column + (p % s + 0.5) / s)
            t, u = 2 * a / n - 1, 2 * b / n - 1
            x = frames[face, 2, 0] + u * frames[face, 0, 0] + t * frames[face, 1, 0]
            y = frames[face, 2, 1] + u * frames[face, 0, 1] + t * frames[face, 1, 1]
            z = frames[face, 2, 2] + u * frames[face, 0, 2] + t * frames[face, 1, 2]
            azimuth = np.arctan2(x, -z) * width / (2 * np.pi)
            if p < 0:
                middle = azimuth
                continue
            azimuth = (azimuth - middle + 0.5 * width) % width - 0.5 * width
            weight = (1 + u * u + t * t) ** -1.5
            r = min(int(np.arctan2(np.hypot(x, z), y) * height / np.pi), height - 1)
            sums[r, 0] += weight
            sums[r, 1] += weight * azimuth
            sums[r, 2] += weight * azimuth * azimuth
            whole += weight
        for r in range(height):
            if sums[r, 0] > 0:
                mean = sums[r, 1] / sums[r, 0]
                columns = np.sqrt(12 * max(sums[r, 2] / sums[r, 0] - mean * mean, LEAST_VARIANCE))
                k = counts[texel + 1]
                rows[texel, k] = r
                found[texel, k] = middle + mean - columns / 2, columns, sums[r, 0] / (whole * columns)
                counts[texel + 1] += 1
    starts = np.cumsum(counts)
    listed, intervals = np.empty(starts[-1], np.int32), np.empty((starts[-1], 3))
    for texel in numba.prange(texels):
        first, last = starts[texel], starts[texel + 1]
        listed[first:last] = rows[texel, : last - first]
        intervals[first:last] = found[texel, : last - first]
    return starts, listed, intervals


@numba.njit(parallel=True, fastmath=True, cache=True)
def _means(
    sums: Doubles, starts: Ints, rows: NDArray[np.int32], intervals: Doubles, shift: float, result: Floats
) -> None:
    """Means of texels; ``shift`` is how far the image was turned, in pixels."""
    width = (sums.shape[1] - 1) // 2
    for texel in numba.prange(len(result)):
        red = green = blue = 0.0
        for e in range(starts[texel], starts[texel + 1]):
            row = np.uint32(rows[e])
            first = intervals[e, 0] + shift
            first -= width * np.floor(first / width)
            last, share = first + intervals[e, 1], intervals[e, 2]
            # unsigned: a negative index would be counted from the end, which takes time to find out
            i, j = np.uint32(first), np.uint32(last)
            u, v, next_i, next_j = first - i, last - j, i + np.uint32(1), j + np.uint32(1)
            a, b, c, d = share * (1 - v), share * v, -share * (1 - u), -share * u
            red += a * sums[row, j, 0] + b * sums[row, next_j, 0] + c * sums[row, i, 0] + d * sums[row, next_i, 0]
            green += (
                a * sums[row, j, 1] + b * sums[row, next_j, 1] + c * sums[row, i, 1] + d * sums[row, next_i, 1]
            )
            blue += a * sums[row, j, 2] + b * sums[row, next_j, 2] + c * sums[row, i, 2] + d * sums[row, next_i, 2]
        result[texel, 0], result[texel, 1], result[texel, 2] = red, green, blue
