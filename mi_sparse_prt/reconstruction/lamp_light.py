"""Indirect light of lamps at nodes, from paths that start there and photons that arrive: each counts by its noise.

Photons are noisy next to lamps and in the open, paths where light comes from small bright places. Few of both, which
are no part of the result, tell how noisy they are at each node, and which lamps need what.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mi_sparse_prt.reconstruction.surface_smoothing import OWN, SurfaceSmoothing, noise_left
from mi_sparse_prt.solvers.lamps import PILOT, LightByPaths
from mi_sparse_prt.solvers.light_tracing import LightTracing
from mi_sparse_prt.solvers.paths import Estimate
from mi_sparse_prt.solvers.problem import Problem
from mi_sparse_prt.solvers.surface_nodes import Nodes

SHARED = 1.5  # times as many paths are traced as elements have at least (``shared_out``)
SPLITS = (0.0, 0.5, 1.0)  # of what is traced, what may be photons
LEAST = 1e-30  # variance, where there is no light
FIRST = 1 << 23  # paths that come first, of all elements: seconds
# first paths of an element that are a result: they also tell what photons and paths count, and of two of each, what
# happens to be small would count most (an office was 6% too dark)
ENOUGH = 8

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]


class LampLight:
    """Paths and photons of lamps.

    Parameters
    ----------
    problem : Problem
        With lamps.
    ids : (n,) int64
        Points at which light is found.
    nodes : Nodes, optional
        These, if they are among vertices: photons arrive at vertices alone.
    levels : list of (n, n) sparse float32
        As of ``smoothing_levels``; none where points are no vertices.
    spp : int
        Paths of an element, at least.
    seed : int
    apart : int
        As of ``LampPaths``: estimates are (n * m, 3 * apart).
    """

    def __init__(
        self,
        problem: Problem,
        ids: NDArray[np.int64],
        nodes: Nodes | None,
        levels: list[scipy.sparse.csr_array],
        spp: int,
        seed: int,
        apart: int,
    ) -> None:
        n, m = len(ids), problem.emission.size
        self._shape, self._spp, self._levels = (n, m, 3 * apart), spp, levels
        self._few = 0 if spp < PILOT else max(2, min(spp // PILOT, FIRST // max(n * m, 1)))
        elements = np.repeat(ids, m), np.tile(np.arange(m), n)
        self._paths = LightByPaths(problem, *elements, spp, seed, apart, self._few)
        self._power = np.square(problem.reflection.albedo[ids].astype(np.float64)).mean(axis=1)
        self._photons: LightTracing | None = None
        self._split = np.zeros(m)  # by lamp, what of it are photons
        first = self._paths.first
        self._known = first is not None and nodes is not None and len(levels) > 0
        if first is not None and nodes is not None and levels:
            self._pool = SurfaceSmoothing(levels).pooled
            emitted = np.asarray(getattr(problem.emission, "emitted", ()), np.int64)
            if len(emitted):
                self._photons = LightTracing(problem, nodes, seed, apart)
            self._first = [first, self._first_photons(emitted)]
            self._each = [
                self._of_one(found, count) for found, count in zip(self._first, self._seen, strict=True)
            ]
            self._split = np.array([self._best_split(lamp) for lamp in range(m)])

    @property
    def rays(self) -> dict[str, int]:
        """That were traced so far, by kind."""
        photons = {} if self._photons is None else {"photons": self._photons.traced}
        return {"indirect_paths": self._paths.traced} | photons

    @property
    def _seen(self) -> tuple[int, int]:
        """First paths of each element, and first photons of each lamp."""
        return self._few, self._few * self._shape[0]

    def _first_photons(self, emitted: NDArray[np.int64]) -> Estimate:
        """Of lamps that send out none, as of nodes without a surface of their own, infinite variance."""
        n, m, k = self._shape
        mean, variance = np.zeros((n, m, k), np.float32), np.full((n, m, k), np.inf, np.float32)
        for lamp in emitted:
            assert self._photons is not None
            found = self._photons.light(int(lamp), self._seen[1], pilot=True)
            mean[:, lamp], variance[:, lamp] = found.mean, found.variance
        return Estimate(mean.reshape(n * m, k), variance.reshape(n * m, k))

    def _of_one(self, found: Estimate, count: int) -> Doubles:
        """Variance (n, m) of one of so many paths or photons, that of neighbours together."""
        own = found.variance.reshape(self._shape).sum(axis=2)
        known = np.isfinite(own)
        finite = np.where(known, own, 0).astype(np.float32)
        pooled = self._pool(finite) / np.maximum(self._pool(known.astype(np.float32)), 1e-6)
        each = count * np.maximum(pooled, OWN * finite).astype(np.float64)
        # light that is found seldom is not found by few: as if one of average variance had been seen besides
        mean = each.sum(axis=0) / np.maximum(known.sum(axis=0), 1)
        return np.where(known, np.maximum((count * each + mean) / (count + 1), LEAST), np.inf)

    def _best_split(self, lamp: int) -> float:
        """Which part of all that is traced for a lamp should be photons."""
        return min(SPLITS, key=lambda split: float(self._power @ self._variance(lamp, SHARED, split)))

    def _variance(self, lamp: int, effort: float, split: float) -> Doubles:
        """Of light at nodes (n,), by so many paths of each or as many photons, of which these are a part."""
        paths, photons = (each[:, lamp] for each in self._each)
        known = (effort * (1 - split)) / paths + (effort * split * len(paths)) / photons
        return np.where(known > 0, 1 / np.maximum(known, 1e-300), paths / effort)

    def effort(self, target: float) -> NDArray[np.int64] | None:
        """Paths of each element, or as many photons, by lamps (m,), after which smoothing leaves so little noise.

        0 where the first ones are enough, and ``spp`` at most; None where no first ones tell. Noise is relative to
        indirect light alone: a camera may look at places that no lamp lights directly.
        """
        if not self._known:
            return None
        both = self._combined(self._first, self._weights(np.full(self._shape[1], 0.5)))
        light, variance = (x.reshape(self._shape) for x in (both.mean, both.variance))
        left = noise_left(light, variance, self._levels).sum(axis=2)
        left = left / np.maximum(variance.sum(axis=2), LEAST)
        by_colour = light.reshape(*self._shape[:2], -1, 3).sum(axis=2)
        whole = np.square(by_colour).sum(axis=2) - variance.sum(axis=2)
        least, few = np.full(self._shape[1], self._spp), self._seen[0]
        for lamp in range(len(least)):
            enough = target**2 * float(self._power @ whole[:, lamp])
            first = self._left(lamp, few, self._first_split(lamp), left) if few >= ENOUGH else 0.0
            one = self._left(lamp, SHARED, self._split[lamp], left)
            if 0 < first <= enough:
                least[lamp] = 0
            elif 0 < one < enough * self._spp:
                least[lamp] = math.ceil(one / enough)
        return least

    def _left(self, lamp: int, effort: float, split: float, share: Doubles) -> float:
        """Squared noise, of which smoothing leaves a share (n, m), see ``_variance``."""
        return float(self._power @ (self._variance(lamp, effort, split) * share[:, lamp]))

    def _first_split(self, lamp: int) -> float:
        """Whether the first paths or the first photons have less noise."""
        return min((0.0, 1.0), key=lambda split: float(self._power @ self._variance(lamp, 1, split)))

    def _weights(self, split: Doubles) -> Floats:
        """What photons count (n, m), if so much (m,) of all that is traced for a lamp are photons."""
        paths, photons = self._each
        others, known = (1 - split) / paths, split * len(paths) / photons
        alone = known == 0  # where no photons arrive, paths count even if all that is traced are photons
        return np.where(alone, 0, known / np.where(alone, 1, known + others)).astype(np.float32)

    def _combined(self, found: Sequence[Estimate], weights: Floats) -> Estimate:
        """Paths and photons, which count as much as weights (n, m) say."""
        share = weights.reshape(-1, 1)
        paths, photons = found
        mean = (1 - share) * paths.mean + share * photons.mean
        spread = np.where(share > 0, photons.variance, 0)
        return Estimate(mean, (1 - share) ** 2 * paths.variance + share**2 * spread)

    def estimate(self, effort: NDArray[np.int64], ticks: Callable[[int], None] = lambda _: None) -> Estimate:
        """Light (n * m, 3 * apart), which does not depend on the first paths and photons unless these are enough.

        Parameters
        ----------
        effort : (m,) int64
            Of each lamp, see ``effort``.
        ticks : callable, optional
            Is told of elements that are done.
        """
        if not self._known:
            return self._paths.estimate(np.tile(effort, self._shape[0]), ticks)
        n, m, k = self._shape
        split = np.where(effort > 0, self._split, [self._first_split(lamp) for lamp in range(m)])
        weights = self._weights(split)
        of_paths = np.where(weights > 0, 1 - split, 1)
        counts = np.where(weights < 1, np.rint(effort * of_paths), 0).astype(np.int64)
        paths = self._paths.estimate(counts.ravel(), ticks)
        mean, variance = (x.reshape(n, m, k).copy() for x in vars(self._first[1]).values())
        for lamp in np.flatnonzero((effort > 0) & (split > 0)):
            assert self._photons is not None
            found = self._photons.light(int(lamp), round(SHARED * effort[lamp] * split[lamp] * n))
            mean[:, lamp], variance[:, lamp] = found.mean, found.variance
        both = self._combined([paths, Estimate(mean.reshape(n * m, k), variance.reshape(n * m, k))], weights)
        # where no photons arrive, some paths that find no light do not tell that there is none
        alone = (weights == 0) & (split > 0) & (counts > 0)
        expected = np.where(alone, self._each[0] / np.maximum(counts, 1), 0).astype(np.float32) / k
        return Estimate(both.mean, np.maximum(both.variance, expected.reshape(-1, 1)))
