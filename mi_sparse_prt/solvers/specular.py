"""Light that arrives from the sky, or from lamps, by way of mirrors, glass and masks.

It is sharp and noisy: an operator of its own, with few elements, found by as many rays as its noise asks for. What
goes straight through (masks, thin panes, ``null``) needs no random rays: see ``passed_light``.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np
import scipy.ndimage
import scipy.sparse
from numpy.typing import NDArray

from mi_sparse_prt.core.bits import Bits
from mi_sparse_prt.core.random_keys import element_seeds, random_stream
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.operators.by_depth import ByDepth
from mi_sparse_prt.operators.operator import Ids
from mi_sparse_prt.operators.sparse_rows import SparseRows
from mi_sparse_prt.solvers.direct_rays import DirectSolver, PassedLight
from mi_sparse_prt.solvers.lamps import LampRays
from mi_sparse_prt.solvers.problem import Problem
from mi_sparse_prt.solvers.specular_chains import (
    CELLS,
    LANES,
    Cells,
    Sparse,
    SpecularChains,
    Strata,
    draw_strata,
)

SAMPLE = 512  # points that tell how much direct light there is
SPECULAR = 7  # spawn key
ROUNDS = 6  # after the first
FEWEST = (
    1 << 18
)  # rays at first, if that is no more than one of each cell: of very few, all may miss the light
GROWTH = 4.0  # times all rays before, at most in one round: those that come after it are better placed
ENOUGH = 1.1  # times the squared noise that is wanted, after a round: it is known about as well
LEAST_SHARE = 1 / 64  # of light, as which less counts: what one ray saw of a cell may be less than is there
STRATA = 1, 2, 3, 4, 8  # per axis of a texel, of light that passes straight
FINE = 16  # texels along an edge of a face, or rays in their place: panes that are smaller are missed

Doubles = NDArray[np.float64]
Floats = NDArray[np.float32]


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
        At most; cells from which more light arrives have more, until the noise is small enough.
    error : float
        Noise that is small enough: relative L2, of direct and specular light together.
    strata : int
        Texel basis: rays per axis of a texel, at first, for light that goes straight on and of which a part is lost.
    """

    first: float = 0.5
    last: int = 16
    error: float = 0.0
    strata: int = 2


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


class Averaging(Protocol):
    """Averages out noise between neighbouring vertices (``reconstruction.specular_noise``)."""

    def judge(self, halves: list[list[Sparse]], power: Doubles) -> float:
        """What squared noise is left of two halves' mean."""

    def averaged(self, light: Sparse) -> Sparse:
        """Light (n, m) with as little."""


class _Limit(NamedTuple):
    """What squared noise may be: a share of the squared norm of light, and a number; or a share of it alone."""

    share: float
    number: float
    alone: float

    def of(self, square: float) -> float:
        return max(self.share * square + self.number, self.alone * square)


class _Estimate(NamedTuple):
    """Two halves, each of three channels; the squared norm of radiance, the squared noise of the mean, and rays."""

    halves: list[list[Sparse]]
    square: float
    noise: float
    rays: int


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
    ) -> None:
        every = np.arange(len(problem.points)) if ids is None else np.asarray(ids)
        seeds = [int(s) for s in element_seeds(random_stream(seed, SPECULAR), 128)]
        power = np.square(problem.reflection.albedo[every].astype(np.float64))
        self._direct, self._depths = _direct_norm(problem, every, power, seeds[-1]), problem.depths_apart
        self._parts, self.seen = [], None
        if problem.scene.bends_light:
            self._parts.append(_Arriving(problem, every, power, seeds[:32]).estimated(options, averaging))
        if problem.scene.passes_straight and isinstance(problem.emission, CubemapLighting):
            passing = _Passing(problem, every, power, seeds[32:-1])
            self._parts.append(passing.estimated(options))
            self.seen = passing.seen

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

    def refine(self, error: float, noise: float = 0.0) -> None:
        """Trace more rays until either is about so much: noise relative to all light, or to specular light alone."""
        for part in self._parts:
            square = sum(p.total.square for p in self._parts) + self._direct
            others = sum(p.noise for p in self._parts if p is not part) / max(square, 1e-300)
            share = max(error**2 - others, error**2 / len(self._parts))
            part.refine(_Limit(share, share * self._direct, noise**2))

    def light(self) -> SpecularLight:
        """What was found so far."""
        means = [part.mean() for part in self._parts]
        mean = [sum(matrices[1:], matrices[0]) for matrices in zip(*means, strict=True)]
        grey = all((mean[0] != other).nnz == 0 for other in mean[1:])
        matrices = tuple(scipy.sparse.csr_array(m) for m in (mean[:1] if grey else mean))
        rays = sum(part.total.rays for part in self._parts)
        return SpecularLight(matrices, self._depths, self.noise, self.error, rays, self.seen)


class _Mean:
    """The mean of estimates; each counts by how little noise it has.

    Where rays of a later one go depends on those before it, what they find on average does not.

    Parameters
    ----------
    total : _Estimate
        The first.
    sample : callable, optional
        Another estimate, of as much squared noise as it is asked for, about, and whether it is as fine as can be; None
        if the first is.
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
        total: _Estimate,
        sample: Callable[[float], tuple[_Estimate, bool]] | None = None,
        power: Doubles | None = None,
        averaging: Averaging | None = None,
    ) -> None:
        self._sample, self._power, self._averaging, self._enough = sample, power, averaging, 1.0
        self._take(total)

    def _take(self, total: _Estimate) -> None:
        self.total, self.noise = total, total.noise
        if self._averaging is not None and self._power is not None and total.noise > 0:
            halves = _distinct(total.halves)
            power = self._power if len(halves[0]) > 1 else self._power.sum(axis=1, keepdims=True)
            self.noise = min(max(self._averaging.judge(halves, power), 0), total.noise)

    def refine(self, limit: _Limit) -> None:
        """Add estimates until the noise is small enough."""
        for _ in range(ROUNDS):
            bound, before = max(limit.of(self.total.square), 1e-30), self.total.noise
            if self._sample is None or self.noise <= self._enough * bound:
                break
            # its mean with what there is has as much as is wanted, of which the same share is left
            found, finest = self._sample(before * bound / (self.noise - bound))
            self._take(_mean_of(self.total, found))
            self._enough = ENOUGH
            if finest:
                self._sample = None

    def mean(self) -> list[Sparse]:
        """Light of all channels, of both halves together."""
        first, second = _distinct(self.total.halves)
        mean = [(a + b) * np.float32(0.5) for a, b in zip(first, second, strict=True)]
        if self._averaging is not None and self.total.noise > 0:
            mean = [self._averaging.averaged(light) for light in mean]
        return mean * (len(self.total.halves[0]) // len(mean))


def _distinct(halves: list[list[Sparse]]) -> list[list[Sparse]]:
    """Of channels that are all the same, one."""
    same = all((half[0] != other).nnz == 0 for half in halves for other in half[1:])
    return [half[:1] for half in halves] if same else halves


class _Arriving:
    """Light that arrives around corners: by mirrors and glass."""

    def __init__(self, problem: Problem, ids: Ids, power: Doubles, seeds: list[int]) -> None:
        self._chains, self._ids, self._power, self._seeds = SpecularChains(problem), ids, power, iter(seeds)
        self._size = problem.emission.size * max(problem.depths_apart, 1)
        self._keys = problem.points.keys[np.asarray(ids)]
        self._cells = self._chains.find_cells(ids, next(self._seeds))
        self._moments = _Moments(self._cells, power.max(axis=1))

    def estimated(self, options: SpecularOptions, averaging: Averaging | None = None) -> _Mean:
        """As many rays as the noise asks for; those before say where light comes from.

        First, rays are in proportion to the share of light that surfaces send on.
        """
        found, most = len(self._ids) * CELLS**2, max(int(options.last), 1)
        if options.first >= options.last:
            only = self._sampled(np.full(len(self._cells.rows), float(options.first**2)), most)
            return _Mean(only._replace(rays=found + only.rays), None, self._power, averaging)
        shares = np.clip(self._cells.shares.astype(np.float64), LEAST_SHARE, 1)
        each = np.clip(FEWEST / max(len(shares), 1), options.first**2, max(options.first, 1) ** 2)
        first = self._sampled(each * shares, most)

        def sample(wanted: float) -> tuple[_Estimate, bool]:
            rays = self._moments.best_rays(wanted)
            rays *= min(GROWTH * self._moments.traced / max(2 * rays.sum(), 1), 1)
            rays = np.minimum(rays, float(most**2))
            return self._sampled(rays, most), bool((rays == most**2).all())

        return _Mean(first._replace(rays=found + first.rays), sample, self._power, averaging)

    def _sampled(self, rays: Doubles, most: int) -> _Estimate:
        """Light from so many rays into each cell, about, twice."""
        halves, traced = [], 0
        for _ in "ab":
            seed = next(self._seeds)
            strata = draw_strata(self._cells, self._keys, rays, most, seed)
            half, squares = self._light(strata, seed)
            self._moments.add(strata, squares)
            halves.append(half)
            traced += int((strata.across**2).sum())
        total = _compared(halves, self._power, traced)
        self._moments.noise, self._moments.rays = total.noise, rays
        return total

    def _light(self, strata: Strata, seed: int) -> tuple[list[Sparse], NDArray[np.float32]]:
        """Light (points, texels) of each channel, for some points at a time."""
        none = scipy.sparse.csr_array((len(self._ids), self._size), dtype=np.float32)
        lit, starts = np.unique(strata.cells.rows, return_index=True)  # rows are sorted
        starts = np.append(starts, len(strata.which))
        rays = np.concatenate([[0], np.cumsum(strata.across**2)])[starts]
        found, squares, first = [], [np.zeros(0, np.float32)], 0
        while first < len(lit):
            most = int(np.searchsorted(rays, rays[first] + LANES, side="right")) - 1
            last = min(max(most, first + 1), len(lit))
            some = strata.take(slice(starts[first], starts[last]))
            rows = np.searchsorted(lit[first:last], some.cells.rows)
            some = some._replace(cells=some.cells._replace(rows=rows))
            arrived = self._chains.gather_light(self._ids[lit[first:last]], some, seed)
            found.append(arrived.light)
            squares.append(arrived.squares)
            first = last
        channels = [scipy.sparse.vstack(blocks, format="csr") for blocks in zip(*found, strict=True)]
        return [_spread(m, lit, none.shape) for m in channels] or [none] * 3, np.concatenate(squares)


def _spread(matrix: Sparse, rows: Ids, shape: tuple[int, int]) -> Sparse:
    """A matrix with more rows, of which some are those of another."""
    counts = np.zeros(shape[0], np.int64)
    counts[rows] = np.diff(matrix.indptr)
    starts = np.concatenate([[0], np.cumsum(counts)])
    return scipy.sparse.csr_array((matrix.data, matrix.indices, starts), shape=shape)


class _Moments:
    """Squared weights of rays into cells, which tell where more of them are worth most.

    Attributes
    ----------
    noise : float
        Squared, of the last estimate.
    rays : (m,) float64
        Into each cell, by each of its halves.
    """

    def __init__(self, cells: Cells, power: Doubles) -> None:
        lit, rows = np.unique(cells.rows, return_inverse=True)
        self._lit, self._place = len(lit), rows * CELLS**2 + cells.numbers
        least = LEAST_SHARE * power.max(initial=0)  # black vertices have rays, too
        self._power = np.maximum(power, least)[cells.rows]
        self._squares, self._traced = np.zeros(len(rows)), np.zeros(len(rows))
        self.noise, self.rays = 0.0, np.ones(len(rows))

    def add(self, strata: Strata, squares: Floats) -> None:
        """What more rays found."""
        self._squares[strata.which] += squares
        self._traced[strata.which] += strata.across**2

    @property
    def traced(self) -> float:
        """Rays so far."""
        return float(self._traced.sum())

    def best_rays(self, noise: float) -> Doubles:
        """Rays (m,) into each cell, of each of two halves, whose mean has so much squared noise, about.

        In proportion to the roots of moments, those of neighbouring cells together, as if there were one average ray
        more: so is the sum of moments over numbers of rays least. The last estimate says what that is in noise.
        """
        average = self._squares.sum() / max(self._traced.sum(), 1)
        second = (self._around(self._squares) + average) / (self._around(self._traced) + 1)
        best = np.sqrt(second * self._power)
        known = (best**2 / np.maximum(self.rays, 1e-30)).sum()
        return best * best.sum() * (self.noise / max(known, 1e-300) / noise)

    def _around(self, values: Doubles) -> Doubles:
        """Sums over each cell and those beside it."""
        grid = np.zeros(self._lit * CELLS**2, np.float32)
        grid[self._place] = values
        mean = scipy.ndimage.uniform_filter(grid.reshape(-1, CELLS, CELLS), (0, 3, 3), mode="constant")
        return np.maximum(9.0 * mean.ravel()[self._place].astype(np.float64), 0)


class _Passing:
    """Light that goes straight through surfaces that take a part of it."""

    def __init__(self, problem: Problem, ids: Ids, power: Doubles, seeds: list[int]) -> None:
        self._problem, self._ids, self._power, self._seeds = problem, ids, power, iter(seeds)
        strata = max(1, FINE // problem.emission.resolution)
        #: Which points see the centres of texels, where rays are at these.
        self.seen: Bits | None = None
        if problem.basis == "direction" or strata == 1:
            self.seen, self._found = _seen_and_passed(DirectSolver(replace(problem, basis="direction")), ids)
        else:
            self._found = passed_light(DirectSolver(problem, strata, next(self._seeds)), ids)
        self._rays = len(ids) * problem.emission.size * (strata**2 if self.seen is None else 1)
        self._rows, self._texels = _with_neighbours(self._found, problem)

    def estimated(self, options: SpecularOptions) -> _Mean:
        """As many strata in each texel as the noise asks for; none is random in the direction basis.

        Squared noise of strata falls as strata**-3 at the edges of light. With as many rays in all as strata**2 it is
        least where strata are in proportion to the fifth root of each texel's own, which two first halves tell,
        averaged with those of its neighbours.
        """
        if self._problem.basis == "direction":
            return _Mean(_compared([[self._found] * 3] * 2, self._power, self._rays))
        strata = np.full(len(self._rows), options.strata)
        first, squares = self._sampled(strata)
        if not len(strata) or options.strata >= STRATA[-1]:
            return _Mean(first)
        law = self._averaged(squares) * options.strata**3
        between = np.sqrt(np.array(STRATA[:-1]) * STRATA[1:])

        def sample(wanted: float) -> tuple[_Estimate, bool]:
            scale = (float((law**0.4).sum()) / wanted) ** (1 / 3)
            strata = np.array(STRATA)[np.searchsorted(between, scale * law**0.2)]
            return self._sampled(strata)[0], bool((strata == STRATA[-1]).all())

        return _Mean(first, sample)

    def _averaged(self, squares: Doubles) -> Doubles:
        """Squared noise of each element, averaged with its neighbours on the cubemap and one average element."""
        shape = len(self._ids), self._problem.emission.size
        noise = scipy.sparse.coo_array((squares, (self._rows, self._texels)), shape=shape).tocsr()
        beside = _beside(self._problem)
        total = scipy.sparse.csr_array(noise @ beside)[self._rows, self._texels]
        return (np.asarray(total).ravel() + squares.mean()) / (np.diff(beside.indptr)[self._texels] + 1)

    def _sampled(self, strata: NDArray[np.int64]) -> tuple[_Estimate, Doubles]:
        """Light through strata of each texel, twice; and the squared noise of each element."""
        depths, shape = max(self._problem.depths_apart, 1), self._found.shape
        values = [np.zeros((len(strata), depths), np.float32) for _ in "ab"]
        for own in np.unique(strata):
            which = np.flatnonzero(strata == own)
            solver = DirectSolver(self._problem, int(own))
            for half in values:
                passed = solver.partly_passed(
                    self._ids[self._rows[which]], self._texels[which], next(self._seeds)
                )
                half[which[passed.elements]] = passed.values
        every = np.arange(len(strata))
        halves = [
            [_side_by_side(PassedLight(every, half), self._rows, self._texels, shape)] * 3 for half in values
        ]
        traced, self._rays = self._rays + 2 * int((strata**2).sum()), 0
        spread = np.square(values[0] - values[1], dtype=np.float64).sum(axis=1) / 4
        return _compared(halves, self._power, traced), spread * self._power.max(axis=1)[self._rows]


def _side_by_side(passed: PassedLight, rows: Ids, texels: Ids, shape: tuple[int, int]) -> Sparse:
    """Light of some of listed elements, told apart by depth, as a matrix (n, k * n_directions)."""
    element, depth = np.nonzero(passed.values)
    which = passed.elements[element]
    columns = texels[which] + depth * (shape[1] // passed.values.shape[1])
    return scipy.sparse.coo_array(
        (passed.values[element, depth], (rows[which], columns)), shape=shape
    ).tocsr()


def _with_neighbours(found: Sparse, problem: Problem) -> tuple[Ids, Ids]:
    """Rows and texels of a matrix's elements, and of those that are beside these on the cubemap."""
    place = found.tocoo()
    at = place.row, place.col % problem.emission.size
    found = scipy.sparse.coo_array((place.data, at), shape=(found.shape[0], problem.emission.size)).tocsr()
    grown = scipy.sparse.csr_array(found @ _beside(problem))
    rows, texels = grown.tocoo().coords
    return rows.astype(np.int64), texels.astype(np.int64)


def _beside(problem: Problem) -> Sparse:
    """Which texels (n_directions, n_directions) are the same, or beside each other on the cubemap: ones."""
    beside = problem.emission.sides.tables.beside
    texel = np.repeat(np.arange(len(beside)), beside.shape[1])
    ones = np.ones(beside.size + len(beside), np.float32)
    near = np.append(texel, np.arange(len(beside))), np.append(beside.ravel(), np.arange(len(beside)))
    return scipy.sparse.coo_array((ones, near), shape=(len(beside),) * 2).tocsr()


def _mean_of(a: _Estimate, b: _Estimate) -> _Estimate:
    """Of independent estimates, in proportion to how precise they are."""
    share = a.noise / max(a.noise + b.noise, 1e-300)  # of the second
    halves = [
        [x * np.float32(1 - share) + y * np.float32(share) for x, y in zip(*pair, strict=True)]
        for pair in zip(a.halves, b.halves, strict=True)
    ]
    square = (1 - share) * a.square + share * b.square
    return _Estimate(halves, square, share * b.noise, a.rays + b.rays)


def _compared(halves: list[list[Sparse]], power: Doubles, rays: int) -> _Estimate:
    """With the squared norm of radiance, and of the noise in the mean of the two halves."""
    square, noise = 0.0, 0.0
    for c, (a, b) in enumerate(zip(*halves, strict=True)):
        square += float(power[:, c] @ (a.multiply(b)).sum(axis=1))
        noise += float(power[:, c] @ ((a - b).power(2)).sum(axis=1)) / 4
    return _Estimate(halves, max(square, 0.0), noise, rays)


def _direct_norm(problem: Problem, ids: Ids, power: Doubles, seed: int) -> float:
    """Squared norm of the radiance of direct light, about: from some of the points."""
    some = np.random.default_rng(seed).permutation(len(ids))[:SAMPLE]
    size = problem.emission.size
    place = np.repeat(ids[some], size), np.tile(np.arange(size), len(some))
    if isinstance(problem.emission, CubemapLighting):
        light = DirectSolver(problem, 1, seed).elements(*place).astype(np.float64)[:, None]
    else:
        light = LampRays(problem, 4, seed).elements(*place).mean.astype(np.float64)
    squares = np.square(light).reshape(len(some), size, -1).sum(axis=1) * np.ones(3)
    return float((squares * power[some]).sum()) * len(ids) / max(len(some), 1)


def passed_light(direct: DirectSolver, ids: Ids) -> Sparse:
    """Light (n, k * m) of texels, at some points, of which surfaces on the way let a part through, straight on.

    All of it, and nothing, is told by bits; here is what lies between, side by side by depth (``SpecularLight``).
    """
    size = direct.lighting.size
    blocks = []
    for a in range(0, len(ids), max(1, LANES // size)):
        some = np.asarray(ids[a : a + max(1, LANES // size)])
        place = np.repeat(some, size), np.tile(np.arange(size), len(some))
        blocks.append(_rows_of(direct.partly_passed(*place), len(some), direct))
    return _stacked(blocks, direct)


def _seen_and_passed(direct: DirectSolver, ids: Ids) -> tuple[Bits, Sparse]:
    """``passed_light`` in the direction basis, and which points see the centres of texels."""
    seen, blocks, size = [direct.row_storage(0)], [], direct.block_size
    for a in range(0, len(ids), size):
        some = np.asarray(ids[a : a + size])
        bits, passed = direct.rows_and_passed(some)
        seen.append(bits)
        blocks.append(_rows_of(passed, len(some), direct))
    return np.concatenate(seen).astype(np.uint32, copy=False), _stacked(blocks, direct)


def _rows_of(passed: PassedLight, n: int, direct: DirectSolver) -> Sparse:
    """Light of elements that are numbered row by row, of n rows."""
    size = direct.lighting.size
    rows, texels = np.divmod(passed.elements, size)
    every = PassedLight(np.arange(len(rows)), passed.values)
    return _side_by_side(every, rows, texels, (n, size * passed.values.shape[1]))


def _stacked(blocks: list[Sparse], direct: DirectSolver) -> Sparse:
    """Of no block, too."""
    none = (0, direct.lighting.size * max(direct.problem.depths_apart, 1))
    return scipy.sparse.vstack([scipy.sparse.csr_array(none, dtype=np.float32), *blocks], format="csr")
