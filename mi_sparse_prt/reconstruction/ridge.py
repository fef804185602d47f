"""Weights known beforehand, corrected by a few noisy samples: ridge regression towards the interpolating weights.

Samples of a vertex are ``y = A a + noise``, and its weights a scatter about those of interpolation along the surface by
a deviation tau: the most probable ones minimize ``||A a - y||^2 / noise + ||a - prior||^2 / tau^2``. So [HR10] 5.1 fits
weights, but towards a good guess instead of towards 0; how good it is, the samples tell themselves.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class RidgeOptions:
    """When samples correct weights.

    Attributes
    ----------
    deviations : tuple of float
        Of weights from the prior ones, tried beside 0.
    confidence : float
        Standard errors that the saving must be above 0.
    minimum_gain : float
        Of the squared error that samples must save, or they are not worth their paths.
    """

    deviations: tuple[float, ...] = (0.005, 0.01, 0.02, 0.04)
    confidence: float = 3
    minimum_gain: float = 0.05


@dataclass(frozen=True)
class System:
    """Samples of n vertices in Gram form, about the prior weights.

    Attributes
    ----------
    gram : (n, k, k) float64
        A^T A over the samples.
    slope : (n, k) float64
        A^T (y - A prior).
    square : (n,) float64
        ||y - A prior||^2.
    count : (n,) int64
        Samples.
    """

    gram: Floats
    slope: Floats
    square: Floats
    count: NDArray[np.int64]

    def __add__(self, other: System) -> System:
        return System(*(a + b for a, b in zip(astuple(self), astuple(other), strict=True)))


def shift_to_prior(
    prior: Floats, gram: Floats, correlation: Floats, squared_norm: Floats, count: NDArray[np.int64]
) -> System:
    """The system of `reconstruction.normal_equations`, moved to the prior weights (n, k)."""
    product = np.einsum("nij,nj->ni", gram, prior)
    square = squared_norm - 2 * (prior * correlation).sum(axis=1) + (prior * product).sum(axis=1)
    return System(gram, correlation - product, square, count)


def fit_correction(system: System, noise: Floats, deviation: float) -> Floats:
    """What to add to the prior weights, (n, k).

    Parameters
    ----------
    system : System
    noise : (n,) float64
        Variance of each sample of a vertex.
    deviation : float
        tau, positive.
    """
    least_ridge = 1e-3  # of the trace of a Gram matrix
    k = system.gram.shape[1]
    largest = np.einsum("nii->n", system.gram)
    # keeps weights bounded where samples have no noise; dark ones decide nothing
    ridge = np.maximum(noise / deviation**2, np.where(largest > 0, least_ridge * largest, 1.0))
    damped = system.gram + ridge[:, None, None] * np.eye(k)
    return np.asarray(np.linalg.solve(damped, system.slope[..., None])[..., 0])


def choose_deviation(
    halves: tuple[System, System], noise: Floats, options: RidgeOptions | None = None
) -> float:
    """The tau whose correction from one half of the samples fits the other half best; 0 if none is worth it.

    Parameters
    ----------
    halves : two System
        Independent samples of the same vertices.
    noise : (n,) float64
        Variance of each sample.
    options : RidgeOptions, optional
    """
    options = options or RidgeOptions()
    error = sum(float((half.square - half.count * noise).sum()) for half in halves)
    best, most = 0.0, options.minimum_gain * max(error, 0.0)
    for deviation in options.deviations:
        saved = _saving(*halves, noise, deviation) + _saving(*halves[::-1], noise, deviation)
        error_of_sum = np.linalg.norm(saved)  # its standard error, were its mean 0
        if saved.sum() > max(most, options.confidence * error_of_sum):
            best, most = deviation, float(saved.sum())
    return best


def _saving(one: System, other: System, noise: Floats, deviation: float) -> Floats:
    """By how much the correction from one half lowers the square of the other, (n,)."""
    a = fit_correction(one, noise, deviation)
    product = np.einsum("nij,nj->ni", other.gram, a)
    return np.asarray((2 * a * other.slope - a * product).sum(axis=1))
