"""Light that arrives from the sky, or from lamps, by way of mirrors, glass and masks.

It is sharp and noisy: an operator of its own, with few elements, found by as many rays as its noise asks for. What
goes straight through (masks, thin panes, ``null``) needs few random rays or none: see ``passed_light``; all other light
is ``bent_light``.
"""

from __future__ import annotations

import itertools
import math
import time
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.sparse

from mi_sparse_prt.core.bits import Bits
from mi_sparse_prt.core.random_keys import element_seeds, random_stream
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.operators.by_depth import ByDepth
from mi_sparse_prt.operators.operator import Ids
from mi_sparse_prt.operators.sparse_rows import SparseRows
from mi_sparse_prt.solvers.bent_light import BentLight
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.lamps import LampRays
from mi_sparse_prt.solvers.passed_light import PassingLight
from mi_sparse_prt.solvers.problem import Problem
from mi_sparse_prt.solvers.refined_mean import Averaging, Doubles, Limit, RefinedMean
from mi_sparse_prt.solvers.specular_chains import Sparse

SAMPLE = 512  # points that tell how much direct light there is
SPECULAR = 7  # spawn key


@dataclass(frozen=True)
class SpecularOptions:
    """How many rays look for specular light.

    Attributes
    ----------
    first : float
        Strata per axis of a cell of the hemisphere, each with a ray, in each of two independent halves; fewer where
        what is seen sends on a small share of light, unless as many as ``last``. Where less than 1, some cells stand
        for others.
    last : int
        At most; cells from which more light arrives have more, until the noise is small enough. If no more than
        ``first``, that is all there is, and in the texel basis also the strata per axis of a texel, for light that goes
        straight on and of which a part is lost.
    error : float
        Noise that is small enough: relative L2, of direct and specular light together.
    """

    first: float = 0.5
    last: int = 16
    error: float = 0.0

    @property
    def once(self) -> bool:
        """Whether there is nothing to refine."""
        return self.first >= self.last


@dataclass(frozen=True)
class SpecularLight:
    """Light from the sky by way of specular surfaces alone.

    Attributes
    ----------
    matrices : tuple of (n, k * n_directions) sparse float32
        Unit-albedo transport of all channels, or of each of three: side by side that of light which met 1, 2, ... k
        surfaces, where it is told apart by these; else k is 1.
    depths_apart : int
        k, or 0.
    noise : float
        Its relative L2 error, as estimated from two halves.
    error : float
        The same noise, relative to direct and specular light together.
    rays : int
        That were traced.
    seen : (n, words) uint32 bits, optional
        Which points see the centres of texels, if that was found on the way.
    """

    matrices: tuple[Sparse, ...]
    depths_apart: int
    noise: float
    error: float
    rays: int
    seen: Bits | None = None

    def take(self, rows: Ids) -> SpecularLight:
        """Some rows alone."""
        return replace(self, matrices=tuple(scipy.sparse.csr_array(m[rows]) for m in self.matrices))

    @cached_property
    def operator(self) -> SparseRows | ByDepth:
        """Its operator, (n, n_directions)."""
        if not self.depths_apart:
            return SparseRows(self.matrices)
        cuts = np.linspace(0, self.matrices[0].shape[1], self.depths_apart + 1).astype(int)
        return ByDepth(
            tuple(
                SparseRows(tuple(scipy.sparse.csr_array(m[:, a:b]) for m in self.matrices))
                for a, b in itertools.pairwise(cuts)
            )
        )


def specular_light(
    problem: Problem,
    seed: int,
    options: SpecularOptions = SpecularOptions(),  # noqa: B008
    ids: Ids | None = None,
    averaging: Averaging | None = None,
) -> SpecularLight:
    """Light from the sky, or of lamps, that arrives by way of mirrors and glass, at some points.

    Of lamps, light that passes straight on is not part of it (``LampRays`` has that).

    A few rays tell in which cells of its hemisphere a point sees specular surfaces; those are sampled, finer where more
    light arrives, until the noise is small enough. What is smaller than a cell, and met by no ray, is not found.

    Parameters
    ----------
    problem : Problem
    seed : int
    options : SpecularOptions
    ids : (n,) integers, optional
        Points; all if not given.
    averaging : Averaging, optional
        Of all points, if these are vertices: what mirrors and glass bring is smooth where they are far away.
    """
    search = SpecularSearch(problem, seed, options, ids, averaging)
    search.refine(options.error)
    return search.light()


class SpecularSearch:
    """Looks for specular light with more and more rays, see ``specular_light``; ``options.error`` plays no part.

    After so many ``seconds``, about, the first rays are fewer, and with noise that tells more.

    Attributes
    ----------
    seen : (n, words) uint32 bits or None
        As of ``SpecularLight``.
    """

    def __init__(
        self,
        problem: Problem,
        seed: int,
        options: SpecularOptions,
        ids: Ids | None = None,
        averaging: Averaging | None = None,
        seconds: float = math.inf,
    ) -> None:
        end = time.perf_counter() + seconds
        every = np.arange(len(problem.points)) if ids is None else np.asarray(ids)
        seeds = [int(s) for s in element_seeds(random_stream(seed, SPECULAR), 128)]
        power = np.square(problem.reflection.albedo[every].astype(np.float64))
        self._direct, self._depths = _direct_norm(problem, every, power, seeds[-1]), problem.depths_apart
        self._parts, self.seen, self._passing = list[RefinedMean](), None, None
        if problem.scene.bends_light:
            self._parts.append(
                BentLight(problem, every, power, seeds[:32]).estimated(options.first, options.last, averaging)
            )
        if problem.scene.passes_straight and isinstance(problem.emission, CubemapLighting):
            passing = PassingLight(problem, every, power, seeds[32:-1])
            self._passing = passing.estimated(
                max(1, options.last) if options.once else None, end - time.perf_counter()
            )
            self._parts.append(self._passing)
            self.seen = passing.seen

    @property
    def passed(self) -> Sparse | None:
        """Light that goes straight on, as far as it was found: of all channels, as ``SpecularLight.matrices``."""
        return None if self._passing is None else self._passing.mean()[0]

    @property
    def error(self) -> float:
        """As of ``SpecularLight``, of what was found so far."""
        return self._relative(sum(part.total.square for part in self._parts) + self._direct)

    @property
    def noise(self) -> float:
        """As of ``SpecularLight``, of what was found so far."""
        return self._relative(sum(part.total.square for part in self._parts))

    def _relative(self, square: float) -> float:
        return float(np.sqrt(sum(part.noise for part in self._parts) / max(square, 1e-300)))

    def refine(self, error: float, noise: float = 0.0, seconds: float = math.inf) -> bool:
        """Trace more rays until either is about so much: noise relative to all light, or to specular light alone.

        For no more than so many seconds, about; returns whether these were enough.
        """
        end, enough = time.perf_counter() + seconds, True
        for i, part in enumerate(self._parts):
            square = sum(p.total.square for p in self._parts) + self._direct
            others = sum(p.noise for p in self._parts if p is not part) / max(square, 1e-300)
            share = max(error**2 - others, error**2 / len(self._parts))
            left = (end - time.perf_counter()) / (len(self._parts) - i)
            enough &= part.refine(Limit(share, share * self._direct, noise**2), left)
        return enough

    def light(self) -> SpecularLight:
        """What was found so far."""
        means = [part.mean() for part in self._parts]
        channels = max(map(len, means))
        means = [mean * (channels // len(mean)) for mean in means]
        mean = [sum(matrices[1:], matrices[0]) for matrices in zip(*means, strict=True)]
        grey = all((mean[0] != other).nnz == 0 for other in mean[1:])
        matrices = tuple(scipy.sparse.csr_array(m) for m in (mean[:1] if grey else mean))
        rays = sum(part.total.rays for part in self._parts)
        return SpecularLight(matrices, self._depths, self.noise, self.error, rays, self.seen)


def _direct_norm(problem: Problem, ids: Ids, power: Doubles, seed: int) -> float:
    """Squared norm of the radiance of direct light, about: from some of the points, drawn by what their light counts.

    Where few of many points are bright, others say next to nothing.
    """
    chance = power.sum(axis=1)
    if not chance.any():
        return 0.0
    chance /= chance.sum()
    some = np.random.default_rng(seed).choice(len(ids), SAMPLE, p=chance)
    size = problem.emission.size
    place = np.repeat(ids[some], size), np.tile(np.arange(size), len(some))
    if isinstance(problem.emission, CubemapLighting):
        light = DirectSolver(problem, 1, seed).elements(*place).astype(np.float64)[:, None]
    else:
        light = LampRays(problem, 4, seed).elements(*place).mean.astype(np.float64)
    squares = np.square(light).reshape(len(some), size, -1).sum(axis=1) * np.ones(3)
    return float(((squares * power[some]).sum(axis=1) / chance[some]).mean())
