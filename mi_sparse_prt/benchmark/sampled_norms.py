"""Relative L2 errors from a part that is known everywhere and another that is known, with noise, at random vertices.

The square of a sum d + r of a known part d (direct light, exact bits) and a path-traced one r is
``mean(d^2)`` over all vertices plus ``mean((d + x)(d + y) - d^2)`` over the sampled ones, x and y being two independent
estimates of r: their noise drops out, and the sampling of vertices matters only for what is not known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.metrics import relative_l2_from_squares

RESAMPLINGS = 1000


@dataclass(frozen=True)
class MeanSquare:
    """Mean square of a quantity over the vertices of a mesh.

    Attributes
    ----------
    known : float
        Mean square of its known part, over all vertices.
    rest : (k,) float64
        What the unknown part adds to it at the sampled vertices; without noise only in the mean.
    """

    known: float
    rest: NDArray[np.float64]

    @property
    def value(self) -> float:
        return self.known + float(self.rest.mean())


def mean_square(
    known: float, at_samples: NDArray[np.floating], x: NDArray[np.floating], y: NDArray[np.floating]
) -> MeanSquare:
    """Mean square of d + r.

    Parameters
    ----------
    known : float
        Mean of d^2 over everything.
    at_samples : (k, ...) float
        d at the sampled vertices; broadcast.
    x, y : (k, ...) float
        Two independent estimates of r there.
    """
    d = at_samples.astype(np.float64)
    rest = (d + x) * (d + y) - d**2
    return MeanSquare(known, rest.reshape(len(rest), -1).mean(axis=1))


def sampled_relative_l2(error: MeanSquare, norm: MeanSquare) -> tuple[float, float]:
    """sqrt(error / norm) and its standard error, by a bootstrap over the sampled vertices, which both may share."""
    return joint_relative_l2([error], [norm], [1])


def joint_relative_l2(
    errors: Sequence[MeanSquare], norms: Sequence[MeanSquare], sizes: Sequence[float]
) -> tuple[float, float]:
    """Relative L2 of several meshes together, and its standard error.

    Parameters
    ----------
    errors, norms : sequence of MeanSquare
        One of each for every mesh. Where both have as many samples, these are of the same vertices.
    sizes : sequence of float
        How many vertices each mesh has.
    """
    square, squares = _weighted_sum(errors, sizes)
    norm, resampled = _weighted_sum(norms, sizes)
    return float(relative_l2_from_squares(square, norm)), float(
        relative_l2_from_squares(squares, resampled).std()
    )


def _weighted_sum(parts: Sequence[MeanSquare], sizes: Sequence[float]) -> tuple[float, NDArray[np.float64]]:
    """Sum over meshes of size times mean square, and the same of resampled vertices (RESAMPLINGS,)."""
    value, resampled = 0.0, np.zeros(RESAMPLINGS)
    for mesh, (part, size) in enumerate(zip(parts, sizes, strict=True)):
        value += size * part.value
        k = len(part.rest)
        # The seed makes samples of the same vertices be drawn together
        drawn = np.random.default_rng([mesh, k]).integers(k, size=(RESAMPLINGS, k))
        resampled += size * (part.known + part.rest[drawn].mean(axis=1))
    return value, resampled
