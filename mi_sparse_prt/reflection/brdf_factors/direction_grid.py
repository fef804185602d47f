"""Directions of the upper hemisphere on a grid, in the local frame of a surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln, lpmv

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]


@dataclass(frozen=True)
class DirectionGrid:
    """Directions of the upper hemisphere, (heights x azimuths), midpoints of equal steps of both angles.

    Parameters
    ----------
    heights, azimuths : int
    """

    heights: int = 64
    azimuths: int = 128

    @property
    def directions(self) -> Floats:
        """(heights * azimuths, 3), by height first."""
        theta = (np.arange(self.heights) + 0.5) * (np.pi / 2 / self.heights)
        phi = (np.arange(self.azimuths) + 0.5) * (2 * np.pi / self.azimuths)
        sine, cosine = np.sin(theta)[:, None], np.cos(theta)[:, None] + 0 * phi
        grid = np.stack([sine * np.cos(phi), sine * np.sin(phi), cosine], axis=-1)
        return grid.reshape(-1, 3).astype(np.float32)

    @property
    def solid_angles(self) -> Doubles:
        """(heights * azimuths,)."""
        edges = np.cos(np.arange(self.heights + 1) * (np.pi / 2 / self.heights))
        return np.repeat(-np.diff(edges) * (2 * np.pi / self.azimuths), self.azimuths)

    def harmonics(self, order: int) -> Doubles:
        """Real spherical harmonics ((order + 1)^2, heights * azimuths), m from -l to l for each degree l.

        They are orthonormal on the whole sphere, not on this half of it.
        """
        w = self.directions.astype(np.float64)
        phi = np.arctan2(w[:, 1], w[:, 0])
        found = []
        for degree in range(order + 1):
            for m in range(-degree, degree + 1):
                k = abs(m)
                ratio = np.exp(gammaln(degree - k + 1) - gammaln(degree + k + 1))  # of factorials
                around = np.sqrt(2) * (np.sin(k * phi) if m < 0 else np.cos(k * phi)) if m else 1.0
                norm = np.sqrt((2 * degree + 1) / (4 * np.pi) * ratio)
                found.append(norm * lpmv(k, degree, w[:, 2]) * around)
        return np.array(found)

    def interpolate(self, values: NDArray[np.floating], directions: Floats) -> NDArray[np.floating]:
        """Values (..., heights * azimuths) at directions (m, 3): (..., m); 0 below the horizon."""
        theta = np.arccos(np.clip(directions[:, 2], 0, 1)) * (self.heights / (np.pi / 2)) - 0.5
        phi = np.arctan2(directions[:, 1], directions[:, 0]) * (self.azimuths / (2 * np.pi)) - 0.5
        row, column = np.floor(theta).astype(np.int64), np.floor(phi).astype(np.int64)
        a, b = (theta - row).astype(np.float32), (phi - column).astype(np.float32)
        total: NDArray[np.floating] = np.zeros((*values.shape[:-1], len(directions)), values.dtype)
        for down, across, weight in (
            (0, 0, (1 - a) * (1 - b)),
            (0, 1, (1 - a) * b),
            (1, 0, a * (1 - b)),
            (1, 1, a * b),
        ):
            place = np.clip(row + down, 0, self.heights - 1) * self.azimuths
            total += values[..., place + (column + across) % self.azimuths] * weight
        return total * (directions[:, 2] > 0)
