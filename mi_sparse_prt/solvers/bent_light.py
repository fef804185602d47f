"""Light that arrives around corners, by mirrors and glass: rays into the cells of hemispheres where it comes from."""

from __future__ import annotations

import time

import numba
import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mi_sparse_prt.core.ragged import row_starts
from mi_sparse_prt.core.sparse_arrays import sparse_of_rows
from mi_sparse_prt.core.threads import run_in_parts
from mi_sparse_prt.operators.operator import Ids
from mi_sparse_prt.solvers.problem import Problem
from mi_sparse_prt.solvers.refined_mean import (
    Averaging,
    Doubles,
    Estimate,
    RefinedMean,
    Round,
    Timed,
    compared,
)
from mi_sparse_prt.solvers.specular_chains import (
    CELLS,
    LANES,
    Cells,
    Sparse,
    SpecularChains,
    Strata,
    draw_strata,
)

# rays at first, if that is no more than one of each cell: of very few, all may miss the light
FEWEST = 1 << 18
GROWTH = 4.0  # times all rays before, at most in one round: those that come after it are better placed
SHRINKING = 1 / 8  # of them, at least: fewer tell too little, also of their own noise
LEAST_SHARE = 1 / 64  # of light, as which less counts: what one ray saw of a cell may be less than is there

Floats = NDArray[np.float32]


class BentLight:
    """Light that arrives around corners, by mirrors and glass, at points that make anything of it.

    Parameters
    ----------
    problem : Problem
    ids : (n,) integers
        Points.
    power : (n, 3) float64
        What squared errors of their light count.
    seeds : list of int
    """

    def __init__(self, problem: Problem, ids: Ids, power: Doubles, seeds: list[int]) -> None:
        self._chains, self._ids, self._power, self._seeds = SpecularChains(problem), ids, power, iter(seeds)
        self._size = problem.emission.size * max(problem.depths_apart, 1)
        self._keys = problem.points.keys[np.asarray(ids)]
        albedo = problem.raise_to_mesh_mean(problem.reflection.albedo.max(axis=1))[ids].astype(np.float64)
        lit = np.flatnonzero(albedo)
        cells = self._chains.find_cells(ids[lit], next(self._seeds))
        self._cells = cells._replace(rows=lit[cells.rows])
        self._moments = _Moments(self._cells, albedo**2)
        #: What light counts in each cell: roots of squares, beside the most.
        self._worth = (albedo / max(albedo.max(initial=0), 1e-30))[self._cells.rows]

    def estimated(self, first: float, last: float, averaging: Averaging | None = None) -> RefinedMean:
        """As many rays as the noise asks for; those before say where light comes from.

        First, rays are in proportion to the share of light that surfaces send on, and to what points make of it.

        Parameters
        ----------
        first, last : float
            Strata per axis of a cell, see ``SpecularOptions``.
        averaging : Averaging, optional
        """
        found, most = len(self._ids) * CELLS**2, max(int(last), 1)
        if first >= last:
            only = self._sampled(np.full(len(self._cells.rows), float(first**2)), most)
            return RefinedMean(only._replace(rays=found + only.rays), None, self._power, averaging)
        shares = np.clip(self._cells.shares * self._worth, LEAST_SHARE, 1)
        each = np.clip(FEWEST / max(len(shares), 1), first**2, max(first, 1) ** 2)
        begun = self._sampled(each * shares, most)

        def sample(wanted: float, affordable: float) -> Round | None:
            before = self._moments.traced
            if affordable < SHRINKING * before:
                return None
            rays = self._moments.best_rays(wanted)
            all_rays = max(2 * float(rays.sum()), 1e-30)
            rays *= np.clip(1, SHRINKING * before / all_rays, min(GROWTH * before, affordable) / all_rays)
            rays = np.minimum(rays, float(most**2))
            expected = self._moments.foreseen(rays)
            return Round(self._sampled(rays, most), expected, bool((rays == most**2).all()))

        return RefinedMean(begun._replace(rays=found + begun.rays), sample, self._power, averaging)

    def _sampled(self, rays: Doubles, most: int) -> Estimate:
        """Light from so many rays into each cell, about, twice."""
        halves, traced, begin = [], 0, time.perf_counter()
        for _ in "ab":
            seed = next(self._seeds)
            strata = draw_strata(self._cells, self._keys, rays, most, seed)
            half, squares = self._light(strata, seed)
            self._moments.add(strata, squares)
            halves.append(half)
            traced += int((strata.across**2).sum())
        total = compared(halves, self._power, traced)
        self._moments.calibrate(total.noise, rays)
        return total._replace(timed=Timed(time.perf_counter() - begin, traced))

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
    return sparse_of_rows(matrix.data, matrix.indices, row_starts(counts), shape[1])


class _Moments:
    """Squared weights of rays into cells, which tell where more of them are worth most.

    Parameters
    ----------
    cells : Cells
        (m,) of n points.
    power : (n,) float64
        What the squares of each row count.
    """

    def __init__(self, cells: Cells, power: Doubles) -> None:
        starts = np.flatnonzero(np.diff(cells.rows, prepend=-1))
        self._numbers, self._starts = cells.numbers, np.append(starts, len(cells.rows))
        self._power = power[cells.rows]
        self._squares, self._traced = np.zeros(len(cells.rows)), np.zeros(len(cells.rows))
        self._noise, self._rays = 0.0, np.ones(len(cells.rows))  # of the last estimate
        self._known: Doubles | None = None

    def add(self, strata: Strata, squares: Floats) -> None:
        """What more rays found."""
        self._squares[strata.which] += squares
        self._traced[strata.which] += strata.across**2
        self._known = None

    @property
    def traced(self) -> float:
        """Rays so far."""
        return float(self._traced.sum())

    def calibrate(self, noise: float, rays: Doubles) -> None:
        """What squared noise the mean of two halves had, of so many rays (m,) into each cell; none tells nothing."""
        if noise > 0:
            self._noise, self._rays = noise, rays

    def best_rays(self, noise: float) -> Doubles:
        """Rays (m,) into each cell, of each of two halves, whose mean has so much squared noise, about.

        In proportion to the roots of moments: so is the sum of moments over numbers of rays least.
        """
        best = np.sqrt(self._second)
        return best * (self.foreseen(best) / noise)

    def foreseen(self, rays: Doubles) -> float:
        """Squared noise of the mean of two halves of so many rays, about: the last estimate says what one ray has."""
        second = self._second
        known = float((second / np.maximum(self._rays, 1e-30)).sum())
        return self._noise / max(known, 1e-300) * float((second / np.maximum(rays, 1e-30)).sum())

    @property
    def _second(self) -> Doubles:
        """Moments (m,), those of neighbouring cells together, as if there were one average ray more."""
        if self._known is None:
            average = self._squares.sum() / max(self._traced.sum(), 1)
            sums = self._squares, self._traced, self._power
            self._known = np.empty(len(self._numbers))
            run_in_parts(
                _smoothed, len(self._starts) - 1, self._starts, self._numbers, sums, average, self._known
            )
        return self._known


@numba.njit(nogil=True, cache=True)
def _smoothed(
    first: int,
    last: int,
    starts: NDArray[np.int64],
    numbers: NDArray[np.int64],
    sums: tuple[Doubles, Doubles, Doubles],
    average: float,
    moments: Doubles,
) -> None:
    """Moments of the cells of some points, of whose cells the first ones are given, with those of cells beside them."""
    squares, traced, power = sums
    grid = np.zeros((CELLS + 2, CELLS + 2, 2))
    for i in range(first, last):
        grid[:] = 0
        for k in range(starts[i], starts[i + 1]):
            grid[1 + numbers[k] // CELLS, 1 + numbers[k] % CELLS, 0] = squares[k]
            grid[1 + numbers[k] // CELLS, 1 + numbers[k] % CELLS, 1] = traced[k]
        for k in range(starts[i], starts[i + 1]):
            row, column = numbers[k] // CELLS, numbers[k] % CELLS
            square, count = 0.0, 0.0
            for y in range(row, row + 3):
                for x in range(column, column + 3):
                    square += grid[y, x, 0]
                    count += grid[y, x, 1]
            moments[k] = (square + average) / (count + 1) * power[k]
