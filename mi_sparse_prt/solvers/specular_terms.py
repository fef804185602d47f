"""Light by way of mirrors, glass and masks, as the in-out factors of glossy points receive it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple, TypeAlias

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mi_sparse_prt.core.device_arrays import on_device
from mi_sparse_prt.core.random_keys import element_seeds, random_stream
from mi_sparse_prt.core.sparse_arrays import sparse_of_rows
from mi_sparse_prt.operators.operator import Ids
from mi_sparse_prt.reflection.in_out_factors import InOutFactors
from mi_sparse_prt.solvers.bent_light import LEAST_SHARE
from mi_sparse_prt.solvers.lobes import Lobes
from mi_sparse_prt.solvers.problem import Problem
from mi_sparse_prt.solvers.specular import SPECULAR, SpecularLight
from mi_sparse_prt.solvers.specular_chains import (
    CELLS,
    LANES,
    Cells,
    SpecularChains,
    Strata,
    draw_strata,
    kept_ends,
)

STRATA = 4  # per axis of a cell of a hemisphere that sends all light on, each with a ray

Floats = NDArray[np.float32]
Sparse: TypeAlias = scipy.sparse.csr_array


class _Light(NamedTuple):
    """Light at points: which ones (n,), its directions' weights in terms (n, K), and channels (n, 3).

    Columns are those of ``SpecularLight.matrices``.
    """

    rows: NDArray[np.int64]
    columns: NDArray[np.int64]
    into: Floats
    light: Floats


class TermRows(NamedTuple):
    """Specular light of the terms of glossy vertices.

    Attributes
    ----------
    matrices : one or three (glossy vertices * K, k * n_directions) sparse float32
        Of the channels, or of all of them; columns are those of ``SpecularLight.matrices``.
    rays : int
        That were traced.
    """

    matrices: list[Sparse]
    rays: int

    def after(self, specular: SpecularLight) -> SpecularLight:
        """Specular light with these rows after those of all vertices."""
        count = max(len(self.matrices), len(specular.matrices))
        pairs = zip(*(_of_channels(some, count) for some in (specular.matrices, self.matrices)), strict=True)
        matrices = tuple(scipy.sparse.csr_array(scipy.sparse.vstack(pair, format="csr")) for pair in pairs)
        return replace(specular, matrices=matrices, rays=specular.rays + self.rays)


def term_rows(
    problem: Problem, seed: int, passed: Sparse | None = None, every: InOutFactors | None = None
) -> TermRows:
    """Specular light as the terms of glossy vertices receive it.

    Light by way of mirrors and glass is weighted by incident factors in the direction of each ray, and is noisier than
    that of unit-albedo rows; light that comes straight through, in the direction of its texel's centre.

    Parameters
    ----------
    problem : Problem
        At the vertices of its scene.
    seed : int
    passed : (n, k * n_directions) sparse float32, optional
        Unit-albedo light that goes straight on, if there is any, as ``SpecularLight.matrices`` have it.
    every : InOutFactors, optional
        Whose terms are asked for; the problem's if not given.
    """
    reflection = every or problem.reflection
    assert isinstance(reflection, InOutFactors)
    ids, lobes = reflection.glossy, Lobes(reflection)
    bent_seeds = element_seeds(random_stream(seed, SPECULAR, 1), 2)
    chains = _TermChains(problem)
    width = problem.emission.size * max(problem.depths_apart, 1)
    parts = [chains.bent(ids, lobes, *bent_seeds)] if problem.scene.bends_light else []
    if passed is not None:
        parts.append(_straight(passed[ids], problem, ids, lobes))
    found = [_stacked(part, reflection.terms, width) for part in parts]
    return TermRows(_added(found), chains.traced)


class _TermChains(SpecularChains):
    """Rays that remember in which direction they left their points."""

    def __init__(self, problem: Problem) -> None:
        super().__init__(problem)
        self.traced = 0

    def bent(self, ids: Ids, lobes: Lobes, cells_seed: int, seed: int) -> Iterator[tuple[int, list[_Light]]]:
        """Light that points receive by way of mirrors and glass, for some points at a time, and how many these are.

        What rays find must not depend on those by which cells were chosen: two seeds.
        """
        strata = self._worth_rays(ids, self.find_cells(ids, cells_seed), cells_seed)
        self.traced += len(ids) * CELLS**2 + int((strata.across**2).sum())
        starts = np.searchsorted(strata.cells.rows, np.arange(len(ids) + 1))
        rays = np.concatenate([[0], np.cumsum(strata.across**2)])[starts]  # before each point
        first = 0
        while first < len(ids):
            most = int(np.searchsorted(rays, rays[first] + LANES // 8, side="right")) - 1
            last = min(max(most, first + 1), len(ids))
            some = strata.take(slice(starts[first], starts[last]))
            if len(some.which):
                some = some._replace(cells=some.cells._replace(rows=some.cells.rows - first))
                yield last - first, list(self._found(ids[first:last], some, lobes, seed))
            else:
                yield last - first, []
            first = last

    def _worth_rays(self, ids: Ids, cells: Cells, seed: int) -> Strata:
        """Strata of cells, with rays in proportion to the share of light that is sent on."""
        wanted = STRATA**2 * np.clip(cells.shares, LEAST_SHARE, 1)
        return draw_strata(
            cells, self._problem.points.keys[np.asarray(ids)], wanted.astype(np.float64), STRATA, seed
        )

    def _found(self, ids: Ids, strata: Strata, lobes: Lobes, seed: int) -> Iterator[_Light]:
        """Light of rays into cells of some points, after one specular surface, after two, ..."""
        ray, entry, rng = self._rays_into(ids, strata.cells, strata.across, seed)
        of = entry.numpy()
        of_lane, share = strata.cells.rows[of], strata.shares[of].astype(np.float32)
        into = _weights(lobes, on_device(mi.UInt32, np.asarray(ids)[of_lane].astype(np.uint32)), ray.d)
        for depth, ends in enumerate(self._follow(ray, dr.arange(mi.UInt32, len(of)), rng, True)):
            lanes, texels, light = kept_ends(ends)
            columns = texels.astype(np.int64) + (depth * self._size if self._apart else 0)
            yield _Light(of_lane[lanes], columns, into[lanes], light.T * share[lanes, None])


def _straight(found: Sparse, problem: Problem, ids: Ids, lobes: Lobes) -> Iterator[tuple[int, list[_Light]]]:
    """Light that comes straight through surfaces which let a part of it pass, found as unit-albedo rows of points."""
    step = max(1, LANES // 8 // problem.emission.size)
    for first in range(0, len(ids), step):
        some = found[first : first + step].tocoo()
        rows, columns = some.coords
        point = on_device(mi.UInt32, np.asarray(ids)[first + rows].astype(np.uint32))
        texels = columns % problem.emission.size
        towards = mi.Vector3f(np.ascontiguousarray(problem.emission.directions[texels].T))
        light = np.repeat(some.data[:, None], 3, axis=1)
        yield (
            some.shape[0],
            [_Light(rows.astype(np.int64), columns.astype(np.int64), _weights(lobes, point, towards), light)],
        )


def _stacked(found: Iterator[tuple[int, list[_Light]]], terms: int, width: int) -> list[Sparse]:
    """Matrices (n * K, width) from light of points, some after others: of each channel, or one if all are the same."""
    blocks = [[scipy.sparse.csr_array((0, width), dtype=np.float32)]]
    for n, lights in found:
        none = [scipy.sparse.csr_array((n * terms, width), dtype=np.float32)]
        blocks.append(_added([none, *(_rows_of_terms(light, none[0].shape) for light in lights)]))
    count = max(map(len, blocks))
    channels = zip(*(_of_channels(block, count) for block in blocks), strict=True)
    return [scipy.sparse.vstack(some, format="csr") for some in channels]


def _added(found: list[list[Sparse]]) -> list[Sparse]:
    """Sums of matrices of each channel, or of one for all."""
    count = max(map(len, found))
    channels = zip(*(_of_channels(some, count) for some in found), strict=True)
    return [scipy.sparse.csr_array(sum(some[1:], some[0])) for some in channels]


def _of_channels(matrices: Sequence[Sparse], count: int) -> Sequence[Sparse]:
    """So many of one that is the same for all."""
    return [matrices[0]] * count if len(matrices) == 1 else matrices


def _weights(lobes: Lobes, point: mi.UInt32, direction: mi.Vector3f) -> Floats:
    """Terms (n, K) of unit-albedo light from directions (world)."""
    if dr.width(point) == 0:
        return np.zeros((0, lobes.terms), np.float32)
    return np.stack([weight.numpy() for weight in lobes.incident(point, direction)], axis=1)


def _rows_of_terms(found: _Light, shape: tuple[int, int]) -> list[Sparse]:
    """Light as a matrix (points * K, texels) of each channel, or of all."""
    count, terms = found.into.shape
    columns = (found.rows[:, None] * terms + np.arange(terms)).ravel()
    starts = np.arange(0, count * terms + 1, terms)
    into = sparse_of_rows(found.into.ravel(), columns, starts, shape[0])
    into = scipy.sparse.csr_array(into.T)  # [term of a point, end]
    grey = bool((found.light == found.light[:, :1]).all())
    matrices = []
    for light in found.light.T[: 1 if grey else 3]:
        ends = scipy.sparse.csr_array(
            (np.ascontiguousarray(light), found.columns, np.arange(count + 1)), shape=(count, shape[1])
        )
        matrices.append(scipy.sparse.csr_array(into @ ends).astype(np.float32))
    return matrices
