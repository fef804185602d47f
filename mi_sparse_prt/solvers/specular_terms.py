"""Light by way of mirrors, glass and masks, as the in-out factors of glossy points receive it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple, TypeAlias

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mi_sparse_prt.core.random_keys import element_seeds, random_stream
from mi_sparse_prt.operators.operator import Ids
from mi_sparse_prt.reflection.in_out_factors import InOutFactors
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.lobes import Lobes
from mi_sparse_prt.solvers.problem import Problem
from mi_sparse_prt.solvers.specular import SPECULAR, SpecularLight, passed_light
from mi_sparse_prt.solvers.specular_chains import CELLS, LANES, SpecularChains

STRATA = 4  # per axis of a cell of a hemisphere, each with a ray

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
    matrices : three (glossy vertices * K, k * n_directions) sparse float32
        Of the channels; columns are those of ``SpecularLight.matrices``.
    rays : int
        That were traced.
    """

    matrices: list[Sparse]
    rays: int

    def after(self, specular: SpecularLight) -> SpecularLight:
        """Specular light with these rows after those of all vertices."""
        known = specular.matrices
        matrices = tuple(
            scipy.sparse.csr_array(scipy.sparse.vstack([known[min(c, len(known) - 1)], terms], format="csr"))
            for c, terms in enumerate(self.matrices)
        )
        return replace(specular, matrices=matrices, rays=specular.rays + self.rays)


def term_rows(problem: Problem, seed: int) -> TermRows:
    """Specular light as the terms of glossy vertices receive it.

    Light by way of mirrors and glass is weighted by incident factors in the direction of each ray, and is noisier than
    that of unit-albedo rows; light that comes straight through, in the direction of its texel's centre.

    Parameters
    ----------
    problem : Problem
        With in-out factors, at the vertices of its scene.
    seed : int
    """
    reflection = problem.reflection
    assert isinstance(reflection, InOutFactors)
    ids, lobes = reflection.glossy, Lobes(reflection)
    (bent_seed,) = element_seeds(random_stream(seed, SPECULAR, 1), 1)
    chains = _TermChains(problem)
    shape = len(ids) * reflection.terms, problem.emission.size * max(problem.depths_apart, 1)
    sums = [scipy.sparse.csr_array(shape, dtype=np.float32) for _ in range(3)]
    parts = [chains.bent(ids, lobes, bent_seed)] if problem.scene.bends_light else []
    if problem.scene.passes_straight:
        parts.append(_straight(problem, ids, lobes))
    for part in parts:
        for found in part:
            sums = [a + b for a, b in zip(sums, _rows_of_terms(found, shape), strict=True)]
    return TermRows(sums, chains.traced)


class _TermChains(SpecularChains):
    """Rays that remember in which direction they left their points."""

    def __init__(self, problem: Problem) -> None:
        super().__init__(problem)
        self.traced = 0

    def bent(self, ids: Ids, lobes: Lobes, seed: int) -> Iterator[_Light]:
        """Light that points receive by way of mirrors and glass, for some rays at a time."""
        cells = self.find_cells(ids, seed)
        self.traced += len(ids) * CELLS**2 + len(cells.rows) * STRATA**2
        step = max(1, LANES // (STRATA**2 * 8))
        for a in range(0, len(cells.rows), step):
            some = cells.take(slice(a, a + step))
            ray, entry, rng = self._rays_into(ids, some, np.full(len(some.rows), STRATA), seed)
            of_lane = some.rows[entry.numpy()]
            point = mi.UInt32(np.asarray(ids)[of_lane].astype(np.uint32))
            into = _weights(lobes, point, ray.d)
            for depth, ends in enumerate(self._follow(ray, dr.arange(mi.UInt32, len(of_lane)), rng, True)):
                kept = ends.valid.numpy()
                lanes, texels, light = (
                    x[kept] for x in (ends.of.numpy(), ends.column.numpy(), ends.weight.numpy().T)
                )
                share = light / np.float32((CELLS * STRATA) ** 2)
                columns = texels.astype(np.int64) + (depth * self._size if self._apart else 0)
                yield _Light(of_lane[lanes], columns, into[lanes], share)


def _straight(problem: Problem, ids: Ids, lobes: Lobes) -> Iterator[_Light]:
    """Light that comes straight through surfaces which let a part of it pass."""
    found = passed_light(DirectSolver(problem), ids).tocoo()
    step = LANES // 8
    for a in range(0, found.nnz, step):
        rows, columns = (x[a : a + step] for x in found.coords)
        point = mi.UInt32(np.asarray(ids)[rows].astype(np.uint32))
        texels = columns % problem.emission.size
        towards = mi.Vector3f(np.ascontiguousarray(problem.emission.directions[texels].T))
        light = np.repeat(found.data[a : a + step, None], 3, axis=1)
        yield _Light(rows.astype(np.int64), columns.astype(np.int64), _weights(lobes, point, towards), light)


def _weights(lobes: Lobes, point: mi.UInt32, direction: mi.Vector3f) -> Floats:
    """Terms (n, K) of unit-albedo light from directions (world)."""
    if dr.width(point) == 0:
        return np.zeros((0, lobes.terms), np.float32)
    return np.stack([weight.numpy() for weight in lobes.incident(point, direction)], axis=1)


def _rows_of_terms(found: _Light, shape: tuple[int, int]) -> list[Sparse]:
    """Light as a matrix (points * K, texels) of each channel."""
    count, terms = found.into.shape
    columns = (found.rows[:, None] * terms + np.arange(terms)).ravel()
    starts = np.arange(0, count * terms + 1, terms)
    into = scipy.sparse.csr_array((found.into.ravel(), columns, starts), shape=(count, shape[0]))
    into = scipy.sparse.csr_array(into.T)  # [term of a point, end]
    grey = bool((found.light == found.light[:, :1]).all())
    matrices = []
    for light in found.light.T[: 1 if grey else 3]:
        ends = scipy.sparse.csr_array(
            (np.ascontiguousarray(light), found.columns, np.arange(count + 1)), shape=(count, shape[1])
        )
        matrices.append(scipy.sparse.csr_array(into @ ends).astype(np.float32))
    return matrices * 3 if grey else matrices
