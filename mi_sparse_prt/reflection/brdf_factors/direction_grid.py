"""Directions of the upper hemisphere on a grid, in the local frame of a surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse
from numpy.typing import NDArray
from scipy.special import gammaln, lpmv

from mi_sparse_prt.core.sparse_product import multiply_sparse

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
        waves = np.arange(order + 1)[:, None] * (
            (np.arange(self.azimuths) + 0.5) * (2 * np.pi / self.azimuths)
        )
        sine, cosine, heights = np.sin(waves), np.cos(waves), self.harmonics_by_height(order)
        found = []
        for degree in range(order + 1):
            for m in range(-degree, degree + 1):
                around = sine[-m] if m < 0 else cosine[m]
                found.append(np.multiply.outer(heights[degree, abs(m)], around).ravel())
        return np.array(found)

    def harmonics_by_height(self, order: int) -> Doubles:
        """What of real spherical harmonics depends on the height, (order + 1, order + 1, heights), by degree and m.

        Times sin(m phi) and cos(m phi) it is the harmonics; 0 where m is larger than the degree.
        """
        height = np.cos((np.arange(self.heights) + 0.5) * (np.pi / 2 / self.heights))
        found = np.zeros((order + 1, order + 1, self.heights))
        for degree in range(order + 1):
            for m in range(degree + 1):
                ratio = np.exp(gammaln(degree - m + 1) - gammaln(degree + m + 1))  # of factorials
                norm = np.sqrt((2 * degree + 1) / (4 * np.pi) * ratio * (2 if m else 1))
                found[degree, m] = norm * lpmv(m, degree, height)
        return found

    def interpolate(self, values: NDArray[np.floating], directions: Floats) -> Floats:
        """Values (..., heights * azimuths) at directions (m, 3): (..., m); 0 below the horizon."""
        theta = np.arccos(np.clip(directions[:, 2], 0, 1)) * (self.heights / (np.pi / 2)) - 0.5
        phi = np.arctan2(directions[:, 1], directions[:, 0]) * (self.azimuths / (2 * np.pi)) - 0.5
        row, column = np.floor(theta).astype(np.int64), np.floor(phi).astype(np.int64)
        a, b = (theta - row).astype(np.float32), (phi - column).astype(np.float32)
        above = np.clip(row + np.array([[0], [1]]), 0, self.heights - 1) * self.azimuths
        places = above[:, None] + (column + np.array([[0], [1]])) % self.azimuths  # [down, across, direction]
        weights = np.stack([1 - a, a])[:, None] * np.stack([1 - b, b]) * (directions[:, 2] > 0)
        flat = np.ascontiguousarray(values.reshape(-1, values.shape[-1]).T, np.float32)
        corners = (
            weights.reshape(4, -1).T.ravel(),
            places.reshape(4, -1).T.ravel(),
            np.arange(0, 4 * len(row) + 1, 4),
        )
        found = multiply_sparse(scipy.sparse.csr_array(corners, shape=(len(row), len(flat))), flat)
        return found.T.reshape(*values.shape[:-1], len(row))
