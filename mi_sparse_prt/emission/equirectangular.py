"""Exact integrals of an equirectangular image over parts of the sphere, by Green's theorem.

With azimuth phi and height y = cos(theta) a solid angle is d phi dy, so pixels are rectangles in the (phi, y) plane.
For the potential C(phi, y), the integral of (image - its mean) over y' from -1 to y, the integral of (image - mean) over
a region is the line integral of C d phi along the region's border. Texels of a cubemap have borders of great arcs, and
on a great arc within one pixel C d phi has a closed form. Hence

* the result is the exact, area-weighted one, linear in the image, at the cost of the borders alone;
* neighbours share a border, so nothing is lost or counted twice: energy is kept to rounding;
* a constant image has no potential: constants stay constant;
* the total of (image - mean) is zero, so regions around a pole need no special treatment.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# No arc may touch a pole, where phi is undefined, nor lie in the equator's plane; texel borders do both in the most
# common orientation. A turn by this vector (radians) ends that and moves nothing by a visible amount.
NUDGE = 1e-10 * np.array([0.62, 0.31, -0.72])


def pixel_solid_angles(height: int, width: int) -> NDArray[np.float64]:
    """Solid angles (height, width) of the pixels of an equirectangular image, in steradians; their sum is 4 pi."""
    theta = np.pi * (np.arange(height) + 0.5) / height  # [row], polar angle of each row's middle
    # cos(a) - cos(b) = 2 sin((a + b) / 2) sin((b - a) / 2) loses no digits at the poles
    bands = 2 * np.sin(theta) * np.sin(np.pi / (2 * height))
    return np.repeat(bands[:, None] * (2 * np.pi / width), width, axis=1)


class Potential:
    """The potential C of an image, ready to be integrated along great arcs.

    Parameters
    ----------
    pixels : (h, w, 3) array
        Radiance, constant over each pixel; orientation of `emission.environment`.

    Attributes
    ----------
    mean : (3,) float64
        The image's mean over the sphere.
    """

    def __init__(self, pixels: NDArray[np.floating]) -> None:
        self.height, self.width = pixels.shape[:2]
        self.mean = np.einsum("hwc,hw->c", pixels, pixel_solid_angles(self.height, self.width)) / (4 * np.pi)
        y = np.cos(np.pi * np.arange(self.height + 1) / self.height)  # [row edge], from 1 down to -1
        self.slope = pixels - self.mean  # [row, col, rgb], C = offset + slope y within a pixel
        rises = self.slope * -np.diff(y)[:, None, None]
        above = np.cumsum(rises[::-1], axis=0)[::-1]  # [row, col, rgb], C at each pixel's upper edge
        self.offset = above - self.slope * y[:-1, None, None]

    def along_arcs(self, start: NDArray[np.float64], end: NDArray[np.float64]) -> NDArray[np.float64]:
        """Integrals (m, 3) of C d phi along the great arcs from `start` to `end`, (m, 3) unit vectors each.

        Frame of the environment. The arcs are shorter than half a circle.
        """
        start, end = (p + np.cross(NUDGE, p) for p in (start, end))
        arc, points, phi = self._cut_at_pixels(start, end)

        piece = np.flatnonzero(arc[1:] == arc[:-1])  # from points[piece] to points[piece + 1], inside one pixel
        p, q = points[piece], points[piece + 1]
        d_phi = phi[piece + 1] - phi[piece]
        y_d_phi = _height_integral(p, q, d_phi)

        middle = p + q
        theta = np.arctan2(np.hypot(middle[:, 0], middle[:, 2]), middle[:, 1])
        row = np.minimum((theta * (self.height / np.pi)).astype(int), self.height - 1)
        col = np.floor((phi[piece + 1] + phi[piece]) / 2 * (self.width / (2 * np.pi))).astype(int) % self.width

        values = self.offset[row, col] * d_phi[:, None] + self.slope[row, col] * y_d_phi[:, None]  # [piece, rgb]
        return np.stack([np.bincount(arc[piece], v, minlength=len(start)) for v in values.T], axis=1)

    def _cut_at_pixels(
        self, start: NDArray[np.float64], end: NDArray[np.float64]
    ) -> tuple[NDArray[np.int_], NDArray[np.float64], NDArray[np.float64]]:
        """Cut arcs where they enter another pixel: arc (k,), point (k, 3) and azimuth (k,) of all cuts and ends.

        Ordered by arc, then from start to end. The azimuth runs on through 2 pi.
        """
        # An arc is p(a) = top cos(a) + side sin(a), y(a) = top_y cos(a), for a0 <= a <= a1
        normal = np.cross(start, end)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        nx, ny, nz = normal.T
        top_y = np.hypot(nx, nz)
        top = np.stack([-ny * nx / top_y, top_y, -ny * nz / top_y], axis=1)
        side = np.cross(normal, top)
        a0 = np.arctan2(_dot(start, side), _dot(start, top))
        a1 = a0 + np.arctan2(_dot(normal, np.cross(start, end)), _dot(start, end))
        phi0 = np.arctan2(start[:, 0], -start[:, 2])
        phi1 = phi0 + _wrapped(np.arctan2(end[:, 0], -end[:, 2]) - phi0)

        # Columns: the meridian phi lies in the plane of normal m; its half with p . h > 0 counts
        step = 2 * np.pi / self.width
        low, high = np.minimum(phi0, phi1) / step, np.maximum(phi0, phi1) / step
        col_arc, col = _ranges(np.ceil(low).astype(int), np.floor(high).astype(int) + 1)
        col_phi = col * step
        m = np.stack([np.cos(col_phi), 0 * col_phi, np.sin(col_phi)], axis=1)
        h = np.stack([np.sin(col_phi), 0 * col_phi, -np.cos(col_phi)], axis=1)
        col_a = np.arctan2(-_dot(top[col_arc], m), _dot(side[col_arc], m))
        opposite = np.cos(col_a) * _dot(top[col_arc], h) + np.sin(col_a) * _dot(side[col_arc], h) < 0
        col_a += np.pi * opposite

        # Rows: cos(a) = y / top_y has two solutions, on either side of the arc's top
        y0, y1 = start[:, 1], end[:, 1]
        reach_top, reach_bottom = ((turn - a0) % (2 * np.pi) < a1 - a0 for turn in (0, np.pi))
        highest = np.where(reach_top, top_y, np.maximum(y0, y1))
        lowest = np.where(reach_bottom, -top_y, np.minimum(y0, y1))
        first, last = (np.arccos(np.clip(y, -1, 1)) * (self.height / np.pi) for y in (highest, lowest))
        row_arc, row = _ranges(np.ceil(first).astype(int), np.floor(last).astype(int) + 1)
        row_a = np.arccos(np.clip(np.cos(np.pi * row / self.height) / top_y[row_arc], -1, 1))
        row_arc, row_a = np.tile(row_arc, 2), np.concatenate([row_a, -row_a])

        # All cuts, those outside their arc dropped
        every = np.arange(len(start))
        arc = np.concatenate([every, every, col_arc, row_arc])
        a = np.concatenate([a0, a1, col_a, row_a])
        phi = np.concatenate([phi0, phi1, col_phi, np.full(len(row_a), np.nan)])
        from_start = np.concatenate([0 * a0, a1 - a0, (a[2 * len(every) :] - a0[arc[2 * len(every) :]]) % (2 * np.pi)])
        kept = np.flatnonzero(from_start <= (a1 - a0)[arc])
        kept = kept[np.lexsort((from_start[kept], arc[kept]))]
        arc, a, phi = arc[kept], a[kept], phi[kept]

        points = top[arc] * np.cos(a)[:, None] + side[arc] * np.sin(a)[:, None]
        unknown = np.isnan(phi)
        x, z, reference = points[unknown, 0], points[unknown, 2], phi0[arc[unknown]]
        phi[unknown] = reference + _wrapped(np.arctan2(x, -z) - reference)
        return arc, points, phi


def _height_integral(
    p: NDArray[np.float64], q: NDArray[np.float64], d_phi: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Integral of y d phi along short great arcs p -> q: d phi less the triangle that they form with a pole."""
    pole = np.where(p[:, 1] + q[:, 1] < 0, -1.0, 1.0)  # the nearer one, for precision
    triple = p[:, 0] * q[:, 2] - p[:, 2] * q[:, 0]
    triangle = 2 * np.arctan2(triple, 1 + pole * (p[:, 1] + q[:, 1]) + _dot(p, q))
    return pole * (d_phi - triangle)


def _dot(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.einsum("ij,ij->i", a, b)


def _wrapped(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """The same angle in [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def _ranges(first: NDArray[np.int_], stop: NDArray[np.int_]) -> tuple[NDArray[np.int_], NDArray[np.int_]]:
    """Concatenated ranges first[i], ..., stop[i] - 1: the index i of each member, and the member."""
    counts = np.maximum(stop - first, 0)
    owner = np.repeat(np.arange(len(first)), counts)
    return owner, np.arange(len(owner)) - (np.cumsum(counts) - counts)[owner] + first[owner]
