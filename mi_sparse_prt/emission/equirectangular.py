"""Exact integrals of an equirectangular image over parts of the sphere, by Green's theorem.

With azimuth phi and height y = cos(theta) a solid angle is d phi dy, so pixels are rectangles in the (phi, y) plane.
Let the potential C(phi, y) be the integral of (image - its mean) over heights from -1 to y. By Green's theorem the
integral of (image - mean) over a region is the line integral of C d phi along its border. Texels of a cubemap are
bordered by great arcs, and on a great arc within one pixel C d phi has a closed form. Hence

* the result is the exact, area-weighted one, linear in the image, at the cost of the borders alone;
* neighbours share a border, so nothing is lost or counted twice: energy is kept to rounding;
* a constant image has no potential: constants stay constant;
* the total of (image - mean) is zero, so regions around a pole need no special treatment.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.ragged import concatenate_ranges

Floats = NDArray[np.floating]
Ints = NDArray[np.int_]

# No arc may touch a pole, where phi is undefined, nor lie in the equator's plane; texel borders do both in the most
# common orientation. A turn by this vector (radians) ends that and moves nothing by a visible amount.
NUDGE = 1e-10 * np.array([0.62, 0.31, -0.72])


def pixel_solid_angles(height: int, width: int) -> Floats:
    """Solid angles (height, width) of the pixels of an equirectangular image, in steradians; their sum is 4 pi."""
    theta = np.pi * (np.arange(height) + 0.5) / height  # [row], polar angle of each row's middle
    # cos(a) - cos(b) = 2 sin((a + b) / 2) sin((b - a) / 2) loses no digits at the poles
    bands = 2 * np.sin(theta) * np.sin(np.pi / (2 * height))
    return np.broadcast_to(bands[:, None] * (2 * np.pi / width), (height, width))


def resampled(pixels: NDArray[np.floating], height: int, width: int) -> Floats:
    """Means (height, width, 3) over the pixels of another size, of an image that is constant over each of its own.

    By solid angle: what arrives from the whole sphere stays the same.
    """
    if pixels.shape[:2] == (height, width):
        return pixels
    rows, columns = pixels.shape[:2]
    # -cos(polar angle) ascends, and is as even in solid angle as azimuths are
    heights = (-np.cos(np.pi * np.arange(n + 1) / n) for n in (rows, height))
    azimuths = (np.arange(n + 1) / n for n in (columns, width))
    tall = np.tensordot(_shares(*heights), pixels, 1)  # [row, old column, rgb]
    return np.einsum("cw,rwk->rck", _shares(*azimuths), tall, optimize=True).astype(pixels.dtype)


def _shares(old: Floats, new: Floats) -> Floats:
    """Shares (new, old) that old intervals have in each new one; both by their ends, ascending."""
    common = np.minimum(new[1:, None], old[1:]) - np.maximum(new[:-1, None], old[:-1])
    return np.maximum(common, 0) / np.diff(new)[:, None]


class Potential:
    """The potential C of an image, ready to be integrated along great arcs.

    Parameters
    ----------
    pixels : (h, w, 3) array
        Radiance, constant over each pixel; orientation of `emission.environment`. Kept, not copied.

    Attributes
    ----------
    mean : (3,) float64
        The image's mean over the sphere.
    """

    def __init__(self, pixels: NDArray[np.floating]) -> None:
        self.height, self.width = pixels.shape[:2]
        self.mean = np.einsum("hwc,hw->c", pixels, pixel_solid_angles(self.height, self.width)) / (4 * np.pi)
        self.pixels = pixels
        # [row edge], y from 1 down to -1
        self.edges = np.cos(np.pi * np.arange(self.height + 1) / self.height)
        # [row, col, rgb], C at each pixel's upper edge; in place, images can be large
        self.above = pixels - self.mean
        self.above *= -np.diff(self.edges)[:, None, None]
        np.cumsum(self.above[::-1], axis=0, out=self.above[::-1])

    def along_arcs(self, start: Floats, end: Floats) -> Floats:
        """Integrals (m, 3) of C d phi along the great arcs from `start` to `end`, (m, 3) unit vectors each.

        Frame of the environment. The arcs are longer than 0 and shorter than half a circle.
        """
        arcs = _Arcs(start + np.cross(NUDGE, start), end + np.cross(NUDGE, end))
        arc, points, phi = arcs.cut_at_pixels(self.height, self.width)

        # Pieces from points[piece] to points[piece + 1], each inside one pixel
        piece = np.flatnonzero(arc[1:] == arc[:-1])
        p, q = points[piece], points[piece + 1]
        d_phi = phi[piece + 1] - phi[piece]
        theta = _polar_angle(p + q)
        row = np.minimum((theta * (self.height / np.pi)).astype(int), self.height - 1)
        u = (phi[piece + 1] + phi[piece]) / (4 * np.pi)
        col = np.floor(u * self.width).astype(int) % self.width

        # C = above + slope (y - upper edge) within a pixel
        slope = self.pixels[row, col] - self.mean  # [piece, rgb]
        rise = _height_integral(p, q, d_phi) - self.edges[row] * d_phi
        values = self.above[row, col] * d_phi[:, None] + slope * rise[:, None]  # [piece, rgb]
        return np.stack([np.bincount(arc[piece], v, minlength=len(start)) for v in values.T], axis=1)


class _Arcs:
    """Great arcs p(a) = top cos(a) + side sin(a) for a0 <= a <= a0 + length; y(a) = top_y cos(a)."""

    def __init__(self, start: Floats, end: Floats) -> None:
        normal = np.cross(start, end)
        sine = np.linalg.norm(normal, axis=1)
        nx, ny, nz = normal.T / sine
        self.top_y = np.hypot(nx, nz)
        self.top = np.stack([-ny * nx / self.top_y, self.top_y, -ny * nz / self.top_y], axis=1)
        self.side = np.cross(np.stack([nx, ny, nz], axis=1), self.top)
        self.a0 = np.arctan2(_dot(start, self.side), _dot(start, self.top))
        self.length = np.arctan2(sine, _dot(start, end))
        self.start_y, self.end_y = start[:, 1], end[:, 1]
        self.phi0 = _azimuth(start)
        self.phi1 = self.phi0 + _wrap(_azimuth(end) - self.phi0)

    def point(self, arc: Ints, a: Floats) -> Floats:
        return self.top[arc] * np.cos(a)[:, None] + self.side[arc] * np.sin(a)[:, None]

    def cut_at_pixels(self, height: int, width: int) -> tuple[Ints, Floats, Floats]:
        """All points where arcs start, end or enter another pixel: arc (k,), point (k, 3) and azimuth (k,).

        Ordered by arc, then from start to end. The azimuth runs on through 2 pi.
        """
        every = np.arange(len(self.a0))
        col_arc, col_a, col_phi = self._column_cuts(width)
        row_arc, row_a, row_phi = self._row_cuts(height)
        arc = np.concatenate([every, every, col_arc, row_arc])
        phi = np.concatenate([self.phi0, self.phi1, col_phi, row_phi])
        inner = np.concatenate([col_a - self.a0[col_arc], row_a - self.a0[row_arc]]) % (2 * np.pi)
        way = np.concatenate([0 * self.a0, self.length, inner])  # from the arc's start

        kept = np.flatnonzero(way <= self.length[arc])
        kept = kept[np.lexsort((way[kept], arc[kept]))]
        arc, phi = arc[kept], phi[kept]
        return arc, self.point(arc, self.a0[arc] + way[kept]), phi

    def _column_cuts(self, width: int) -> tuple[Ints, Floats, Floats]:
        """Where arcs cross the meridians between columns: arc, a (modulo 2 pi), azimuth (exact)."""
        step = 2 * np.pi / width
        low, high = np.minimum(self.phi0, self.phi1) / step, np.maximum(self.phi0, self.phi1) / step
        arc, col = _ranges(np.ceil(low).astype(int), np.floor(high).astype(int) + 1)
        phi = col * step
        # The meridian lies in the plane through the poles with this normal, on the side of this horizontal vector
        normal = np.stack([np.cos(phi), 0 * phi, np.sin(phi)], axis=1)
        forward = np.stack([np.sin(phi), 0 * phi, -np.cos(phi)], axis=1)
        a = np.arctan2(-_dot(self.top[arc], normal), _dot(self.side[arc], normal))
        behind = _dot(self.point(arc, a), forward) < 0
        return arc, a + np.pi * behind, phi

    def _row_cuts(self, height: int) -> tuple[Ints, Floats, Floats]:
        """Where the circles of the arcs cross the parallels between rows: arc, a (modulo 2 pi), azimuth."""
        over_top, over_bottom = ((turn - self.a0) % (2 * np.pi) < self.length for turn in (0, np.pi))
        highest = np.where(over_top, self.top_y, np.maximum(self.start_y, self.end_y))
        lowest = np.where(over_bottom, -self.top_y, np.minimum(self.start_y, self.end_y))
        first, last = (np.arccos(np.clip(y, -1, 1)) * (height / np.pi) for y in (highest, lowest))
        arc, row = _ranges(np.ceil(first).astype(int), np.floor(last).astype(int) + 1)
        # cos(a) = y / top_y has two solutions, one on either side of the top
        a = np.arccos(np.clip(np.cos(np.pi * row / height) / self.top_y[arc], -1, 1))
        arc, a = np.tile(arc, 2), np.concatenate([a, -a])
        phi = self.phi0[arc] + _wrap(_azimuth(self.point(arc, a)) - self.phi0[arc])
        return arc, a, phi


def _height_integral(p: Floats, q: Floats, d_phi: Floats) -> Floats:
    """Integral of y d phi along short great arcs p -> q: d phi less the triangle that they form with a pole."""
    pole = np.where(p[:, 1] + q[:, 1] < 0, -1.0, 1.0)  # the nearer one, for precision
    triple = p[:, 0] * q[:, 2] - p[:, 2] * q[:, 0]
    triangle = 2 * np.arctan2(triple, 1 + pole * (p[:, 1] + q[:, 1]) + _dot(p, q))
    return pole * (d_phi - triangle)


def _azimuth(p: Floats) -> Floats:
    return np.arctan2(p[:, 0], -p[:, 2])


def _polar_angle(p: Floats) -> Floats:
    return np.arctan2(np.hypot(p[:, 0], p[:, 2]), p[:, 1])


def _wrap(angle: Floats) -> Floats:
    """The same angle in [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def _dot(a: Floats, b: Floats) -> Floats:
    return np.einsum("ij,ij->i", a, b)


def _ranges(first: Ints, stop: Ints) -> tuple[Ints, Ints]:
    """Concatenated ranges first[i], ..., stop[i] - 1: the index i of each member, and the member."""
    return concatenate_ranges(first, np.maximum(stop - first, 0))
