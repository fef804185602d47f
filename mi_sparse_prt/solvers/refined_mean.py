"""Sparse light that is known twice, from rays of its own, refined until the two agree."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.solvers.specular_chains import Sparse

ROUNDS = 6  # after the first
ENOUGH = 1.1  # times the squared noise that is wanted, after a round: it is known about as well

Doubles = NDArray[np.float64]


class Averaging(Protocol):
    """Averages out noise between neighbouring vertices (``reconstruction.specular_noise``)."""

    def judge(self, halves: list[list[Sparse]], power: Doubles) -> float:
        """What squared noise is left of two halves' mean."""

    def averaged(self, light: Sparse) -> Sparse:
        """Light (n, m) with as little."""


class Limit(NamedTuple):
    """What squared noise may be: a share of the squared norm of light, and a number; or a share of it alone."""

    share: float
    number: float
    alone: float

    def of(self, square: float) -> float:
        return max(self.share * square + self.number, self.alone * square)


class Timed(NamedTuple):
    """Seconds that so many rays took."""

    seconds: float
    rays: int

    def rays_in(self, seconds: float) -> float:
        """How many rays a time is enough for."""
        return seconds * self.rays / self.seconds if self.rays and self.seconds > 0 else math.inf


class Estimate(NamedTuple):
    """Two halves, of one channel for all or of three; squared norm of radiance, squared noise of the mean, and rays.

    With the seconds that its last rays took, and how many these are, where time can be limited.
    """

    halves: list[list[Sparse]]
    square: float
    noise: float
    rays: int
    timed: Timed = Timed(0.0, 0)


class Round(NamedTuple):
    """One more estimate, the squared noise that was expected of it, and whether it is as fine as can be."""

    found: Estimate
    expected: float
    finest: bool


class RefinedMean:
    """The mean of estimates; each counts by how little noise is expected of it.

    Where rays of a later one go depends on those before it, what they find on average does not. What they find does not
    decide how much it counts: few rays that happen to find no light would seem to have no noise.

    Parameters
    ----------
    total : Estimate
        The first.
    sample : callable, optional
        Another estimate, of as much squared noise as it is asked for, about, but of no more rays than are given, or
        None if these are too few; None in its place if the first is as fine as can be.
    power : (n, 3) float64, optional
        What the squares of each row count.
    averaging : Averaging, optional

    Attributes
    ----------
    noise : float
        Squared, that averaging leaves.
    """

    def __init__(
        self,
        total: Estimate,
        sample: Callable[[float, float], Round | None] | None = None,
        power: Doubles | None = None,
        averaging: Averaging | None = None,
    ) -> None:
        self._sample, self._power, self._averaging, self._enough = sample, power, averaging, 1.0
        self._expected = total.noise
        self._take(total)

    def _take(self, total: Estimate) -> None:
        self.total, self.noise = total, total.noise
        if self._averaging is not None and self._power is not None and total.noise > 0:
            halves = _distinct(total.halves)
            self.noise = min(
                max(self._averaging.judge(halves, _power_of(halves, self._power)), 0), total.noise
            )

    def refine(self, limit: Limit, seconds: float = math.inf) -> bool:
        """Add estimates until the noise is small enough, for no more than about so many seconds.

        Returns whether these were enough.
        """
        end = time.perf_counter() + seconds
        for _ in range(ROUNDS):
            bound, before = max(limit.of(self.total.square), 1e-30), self.total.noise
            if self._sample is None or self.noise <= self._enough * bound:
                break
            # its mean with what there is has as much as is wanted, of which the same share is left
            rays = self.total.timed.rays_in(end - time.perf_counter())
            more = self._sample(before * bound / (self.noise - bound), rays)
            if more is None:
                return False
            share = self._expected / max(self._expected + more.expected, 1e-300)
            self._expected = share * more.expected
            self._take(_mean_of(self.total, more.found, share))
            self._enough = ENOUGH
            if more.finest:
                self._sample = None
        return True

    def mean(self) -> list[Sparse]:
        """Light of both halves together, of as many channels as these have."""
        first, second = _distinct(self.total.halves)
        mean = [(a + b) * np.float32(0.5) for a, b in zip(first, second, strict=True)]
        if self._averaging is not None and self.total.noise > 0:
            mean = [self._averaging.averaged(light) for light in mean]
        return mean * (len(self.total.halves[0]) // len(mean))


def _distinct(halves: list[list[Sparse]]) -> list[list[Sparse]]:
    """Of channels that are all the same, one."""
    same = all((half[0] != other).nnz == 0 for half in halves for other in half[1:])
    return [half[:1] for half in halves] if same else halves


def _mean_of(a: Estimate, b: Estimate, share: float) -> Estimate:
    """Of independent estimates; ``share`` is that of the second."""
    halves = [
        [x * np.float32(1 - share) + y * np.float32(share) for x, y in zip(*pair, strict=True)]
        for pair in zip(a.halves, b.halves, strict=True)
    ]
    square = (1 - share) * a.square + share * b.square
    noise = (1 - share) ** 2 * a.noise + share**2 * b.noise
    return Estimate(halves, square, noise, a.rays + b.rays, b.timed)


def _power_of(halves: list[list[Sparse]], power: Doubles) -> Doubles:
    """What the squares of each row count in each channel that halves have."""
    return power if len(halves[0]) > 1 else power.sum(axis=1, keepdims=True)


def compared(halves: list[list[Sparse]], power: Doubles, rays: int) -> Estimate:
    """With the squared norm of radiance, and of the noise in the mean of the two halves."""
    square, noise, power = 0.0, 0.0, _power_of(halves, power)
    for c, (a, b) in enumerate(zip(*halves, strict=True)):
        square += float(power[:, c] @ (a.multiply(b)).sum(axis=1))
        noise += float(power[:, c] @ ((a - b).power(2)).sum(axis=1)) / 4
    return Estimate(halves, max(square, 0.0), noise, rays)
