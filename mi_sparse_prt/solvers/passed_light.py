"""Light that goes straight through surfaces that take a part of it: masks, thin panes, ``null``."""

from __future__ import annotations

import math
import time
from dataclasses import replace

import numba
import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mi_sparse_prt.core.bits import Bits
from mi_sparse_prt.core.threads import run_in_parts
from mi_sparse_prt.operators.operator import Ids
from mi_sparse_prt.solvers.direct_rays import DirectSolver, PassedLight
from mi_sparse_prt.solvers.problem import Problem
from mi_sparse_prt.solvers.refined_mean import Doubles, Estimate, RefinedMean, Round, Timed, compared
from mi_sparse_prt.solvers.specular_chains import LANES, Sparse

Floats = NDArray[np.float32]

STRATA = 1, 2, 3, 4, 8  # per axis of a texel
FIRST = 2  # strata per axis at edges: with one, noise is seven times as large for a quarter of the rays
ALIKE = 0.1  # as a share: what neighbouring texels let through may differ by so much without an edge
FEWER = 0.9  # times the strata per axis, until their rays are no more than there is time for
FINE = 16  # texels along an edge of a face, or rays in their place: panes that are smaller are missed


class PassingLight:
    """Light that goes straight through surfaces that take a part of it."""

    def __init__(self, problem: Problem, ids: Ids, power: Doubles, seeds: list[int]) -> None:
        self._problem, self._ids, self._power, self._seeds = problem, ids, power, iter(seeds)
        strata, begin = max(1, FINE // problem.emission.resolution), time.perf_counter()
        #: Which points see the centres of texels, where rays are at these.
        self.seen: Bits | None = None
        if problem.basis == "direction" or strata == 1:
            self.seen, self._found = _seen_and_passed(DirectSolver(replace(problem, basis="direction")), ids)
        else:
            self._found = _passed_light(DirectSolver(problem, strata, next(self._seeds)), ids)
        self._rays = len(ids) * problem.emission.size * (strata**2 if self.seen is None else 1)
        self._timed = Timed(time.perf_counter() - begin, self._rays)
        self._rows, self._texels = _with_neighbours(self._found, problem)

    def estimated(self, across: int | None = None, seconds: float = math.inf) -> RefinedMean:
        """So many strata per axis of a texel, or as many as the noise asks for; none in the direction basis.

        Squared noise of strata falls as strata**-3 at the edges of light. With as many rays in all as strata**2 it is
        least where strata are in proportion to the fifth root of each texel's own, which two first halves tell,
        averaged with those of its neighbours. These begin with one ray where centres of texels tell of no edge, or
        where more would take longer than so many seconds, about.
        """
        if self._problem.basis == "direction":
            return RefinedMean(compared([[self._found]] * 2, self._power, self._rays))
        strata = np.full(len(self._rows), across or FIRST)
        if across is None and self.seen is not None:
            strata[self._without_edges()] = 1
        if across is None and _rays_of(strata) > self._timed.rays_in(seconds):
            strata[:] = 1
        first, squares = self._sampled(strata)
        if across is not None or not len(squares):
            return RefinedMean(first)
        law = self._averaged(squares * strata**3.0)
        between, best = np.sqrt(np.array(STRATA[:-1]) * STRATA[1:]), law**0.2

        def strata_of(scale: float) -> NDArray[np.int64]:
            return np.array(STRATA)[np.searchsorted(between, scale * best)]

        def sample(wanted: float, affordable: float) -> Round | None:
            if affordable < 2 * len(law):
                return None
            scale = (float((law**0.4).sum()) / wanted) ** (1 / 3)
            while _rays_of(strata := strata_of(scale)) > affordable:
                scale *= FEWER
            expected = float((law / strata**3.0).sum())
            return Round(self._sampled(strata)[0], expected, bool((strata == STRATA[-1]).all()))

        return RefinedMean(first, sample)

    def _averaged(self, squares: Doubles) -> Doubles:
        """Squared noise of each element, averaged with its neighbours on the cubemap and one average element."""
        beside = self._problem.emission.sides.tables.beside
        sums = np.empty(len(squares))
        run_in_parts(_sum_beside, len(self._ids), self._starts(), self._texels, squares, beside, sums)
        return (sums + squares.mean()) / (beside.shape[1] + 2)

    def _without_edges(self) -> NDArray[np.bool_]:
        """Whether as much light passes as many surfaces as in the texels beside it, as far as centres tell."""
        lighting = self._problem.emission
        powers = lighting.solid_angles / np.float32(np.pi)
        where = self._problem.points.normals[self._ids], lighting.directions, powers
        found = self._found.indptr, self._found.indices, self._found.data
        alike = np.empty(len(self._rows), bool)
        beside = lighting.sides.tables.beside
        run_in_parts(_are_alike, len(self._ids), self._starts(), self._texels, found, where, beside, alike)
        return alike

    def _starts(self) -> NDArray[np.int64]:
        """Where elements of each point begin."""
        return np.searchsorted(self._rows, np.arange(len(self._ids) + 1))

    def _sampled(self, strata: NDArray[np.int64]) -> tuple[Estimate, Doubles]:
        """Light through strata of each texel, twice; and the squared noise of each element."""
        depths, shape, begin = max(self._problem.depths_apart, 1), self._found.shape, time.perf_counter()
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
            [_side_by_side(PassedLight(every, half), self._rows, self._texels, shape)] for half in values
        ]
        before, self._rays, rays = self._rays, 0, _rays_of(strata)
        self._timed = Timed(time.perf_counter() - begin, rays)
        spread = np.square(values[0] - values[1], dtype=np.float64).sum(axis=1) / 4
        found = compared(halves, self._power, before + rays)._replace(timed=self._timed)
        return found, spread * self._power.max(axis=1)[self._rows]


def _rays_of(strata: NDArray[np.int64]) -> int:
    """Of two halves, of so many strata per axis of each texel."""
    return 2 * int(np.square(strata).sum())


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


def _passed_light(direct: DirectSolver, ids: Ids) -> Sparse:
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
    """``_passed_light`` in the direction basis, and which points see the centres of texels."""
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


@numba.njit(nogil=True, cache=True)
def _sum_beside(
    first: int,
    last: int,
    starts: NDArray[np.int64],
    texels: NDArray[np.int64],
    values: Doubles,
    beside: NDArray[np.int32],
    sums: Doubles,
) -> None:
    """Values of elements, row i's from starts[i] on, and of those beside them on the cubemap, if they are listed."""
    row = np.zeros(len(beside))
    for i in range(first, last):
        own = range(starts[i], starts[i + 1])
        for k in own:
            row[texels[k]] = values[k]
        for k in own:
            sums[k] = row[texels[k]]
            for texel in beside[texels[k]]:
                sums[k] += row[texel]
        for k in own:
            row[texels[k]] = 0


@numba.njit
def _cosine(normals: Floats, point: int, directions: Floats, texel: int) -> np.float32:
    """Not of slices, of which it would be counted who holds them, by one thread at a time."""
    total = np.float32(0)
    for k in range(3):
        total += normals[point, k] * directions[texel, k]
    return total


@numba.njit(nogil=True, cache=True)
def _are_alike(
    first: int,
    last: int,
    starts: NDArray[np.int64],
    texels: NDArray[np.int64],
    found: tuple[NDArray[np.int32], NDArray[np.int32], Floats],
    where: tuple[Floats, Floats, Floats],
    beside: NDArray[np.int32],
    alike: NDArray[np.bool_],
) -> None:
    """Which elements let as much light pass as those beside them above the horizon, by as many surfaces."""
    (begins, columns, values), (normals, directions, powers) = found, where
    size = len(beside)
    shares, met = np.zeros(size), np.zeros(size, np.int64)
    for i in range(first, last):
        own = range(begins[i], begins[i + 1])
        for k in own:
            texel = columns[k] % size
            reaches = _cosine(normals, i, directions, texel) * powers[texel]
            if reaches > 0:  # at the horizon 0 here, where the sum of three products was rounded otherwise
                shares[texel], met[texel] = values[k] / reaches, columns[k] // size
        for k in range(starts[i], starts[i + 1]):
            share, same = shares[texels[k]], shares[texels[k]] > 0
            for texel in beside[texels[k]]:
                if _cosine(normals, i, directions, texel) > 0:
                    same &= met[texel] == met[texels[k]] and abs(shares[texel] - share) <= ALIKE * share
            alike[k] = same
        for k in own:
            shares[columns[k] % size] = 0
