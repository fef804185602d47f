"""Light of an environment that turns about its own axis: means of texels from sums along the rows of the image.

Within a row of pixels a texel covers an interval of azimuths, and a turn moves all intervals alike. With the sums of
each row from azimuth 0 on, what a texel gets from the row is one difference, of values that are linear within a pixel:
exact in the turn. That the border of a texel may be slanted within a row is what is left out: each interval has the
mean and the variance of the azimuths that the texel covers there.
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
        n, self._count = lighting.resolution, lighting.n_directions
        texels, rows, intervals = _intervals(FACE_FRAMES, n, self._height, self._width, SQUARES)
        # a row of sums stays in the cache for all texels of a face that meet it
        face_rows = texels // (n * n) * self._height + rows
        order = np.lexsort((intervals[:, 0], face_rows))
        self._starts = np.searchsorted(face_rows[order], np.arange(6 * self._height + 1))
        self._texels, self._intervals = texels[order].astype(np.int32), intervals[order].astype(np.float32)
        self._sums = np.zeros(
            (self._height, 2 * self._width + 1, 3)
        )  # twice around: intervals may cross azimuth 0
        np.cumsum(np.tile(pixels, (1, 2, 1)), axis=1, dtype=np.float64, out=self._sums[:, 1:])

    def at(self, degrees: float) -> Floats:
        """L (6 n^2, 3) of the image turned so far about +y, as ``Environment.rotated``."""
        result = np.zeros((self._count, 3), np.float32)
        shift = float(degrees) % 360 * self._width / 360
        _means(self._sums, self._starts, self._texels, self._intervals, shift, result)
        return result


def _intervals(frames: Doubles, n: int, height: int, width: int, s: int) -> tuple[Ints, Ints, Doubles]:
    """Texels and rows that meet, (k,) each, and (k, 3): first column (azimuth in pixels), columns, and the share of
    the texel per column.
    """
    most = 2 + int(2.0 * height / n)  # rows of a texel: it is less than 2 / n radians high
    rows = np.full((6 * n * n, most), -1, np.int32)
    found = np.zeros((6 * n * n, most, 3))
    _find_intervals(frames, height, width, s, rows, found)
    met = rows >= 0
    return np.nonzero(met)[0], rows[met].astype(np.int64), found[met]


@numba.njit(parallel=True, cache=True)
def _find_intervals(
    frames: Doubles, height: int, width: int, s: int, rows: NDArray[np.int32], found: Doubles
) -> None:
    n = int(np.sqrt(len(rows) // 6))
    for texel in numba.prange(len(rows)):
        _find_intervals_of(texel, frames, n, (height, width), s, rows[texel], found[texel])


@numba.njit(cache=True)
def _find_intervals_of(
    texel: int,
    frames: Doubles,
    n: int,
    size: tuple[int, int],
    s: int,
    rows: NDArray[np.int32],
    found: Doubles,
) -> None:
    """Of one texel; apart from the parallel loop, in which it would take three times as long to compile."""
    height, width = size
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
    k = 0
    for r in range(height):
        if sums[r, 0] > 0:
            mean = sums[r, 1] / sums[r, 0]
            columns = np.sqrt(12 * max(sums[r, 2] / sums[r, 0] - mean * mean, LEAST_VARIANCE))
            rows[k] = r
            found[k, 0], found[k, 1] = middle + mean - columns / 2, columns
            found[k, 2] = sums[r, 0] / (whole * columns)
            k += 1


@numba.njit(parallel=True, fastmath=True, cache=True)
def _means(
    sums: Doubles, starts: Ints, texels: NDArray[np.int32], intervals: Floats, shift: float, result: Floats
) -> None:
    """Add to means of texels, face by face and row by row; ``shift`` is how far the image was turned, in pixels."""
    height, width = len(sums), (sums.shape[1] - 1) // 2
    for face in numba.prange(6):
        for row in range(height):
            own = sums[row]
            for e in range(starts[face * height + row], starts[face * height + row + 1]):
                first = np.float64(intervals[e, 0]) + shift
                first -= width * np.floor(first / width)
                last, share = first + intervals[e, 1], intervals[e, 2]
                # unsigned: a negative index would be counted from the end, which takes time to find out
                i, j, texel = np.uint32(first), np.uint32(last), np.uint32(texels[e])
                u, v, next_i, next_j = first - i, last - j, i + np.uint32(1), j + np.uint32(1)
                for c in range(3):
                    upper = own[j, c] + v * (own[next_j, c] - own[j, c])
                    lower = own[i, c] + u * (own[next_i, c] - own[i, c])
                    result[texel, c] += np.float32(share * (upper - lower))
