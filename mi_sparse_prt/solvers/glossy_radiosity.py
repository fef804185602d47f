"""Interreflection among glossy surfaces by finite elements: terms of BRDFs are elements as vertices are.

Light that leaves vertex y towards w_o is ``rho_y B_y + sum_l g_l(w_o) B_yl``: a diffuse part and the coefficients B_yl
that incident factors f_l have found ([HR10] eq. 2-3, [Leh07] 2.5). What rays from x find of it, weighted by 1 (white
light) and by f_k(w) pi / cos (its own terms), is one sparse matrix over all of these.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numba
import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mi_sparse_prt.core.metrics import relative_noise
from mi_sparse_prt.core.ragged import row_starts
from mi_sparse_prt.core.random_keys import mix
from mi_sparse_prt.measurement.point_arrays import PointArrays
from mi_sparse_prt.measurement.vertices import Points
from mi_sparse_prt.operators.by_depth import ByDepth
from mi_sparse_prt.operators.column_blocks import random_combinations
from mi_sparse_prt.operators.factored_visibility import FactoredVisibility
from mi_sparse_prt.operators.operator import Operator
from mi_sparse_prt.operators.sparse_rows import SparseRows
from mi_sparse_prt.reflection.factor_tables import outgoing_tables
from mi_sparse_prt.reflection.in_out_factors import InOutFactors
from mi_sparse_prt.reflection.reflection import Reflection
from mi_sparse_prt.solvers.first_bounce import USUAL
from mi_sparse_prt.solvers.form_factors import LANES, NOTHING, Surfaces, cosine_rays, sobol
from mi_sparse_prt.solvers.lobes import Lobes
from mi_sparse_prt.solvers.problem import Problem
from mi_sparse_prt.solvers.radiosity import (
    NEGLIGIBLE,
    FiniteElements,
    Gathered,
    GatheredByDepth,
    joined_channels,
)
from mi_sparse_prt.solvers.specular_chains import specular_form_factors
from mi_sparse_prt.solvers.surface_nodes import Nodes

MOST_BOUNCES = 64  # where there is no limit
NOISE_VERTICES = 4096  # at which noise is looked at
MOST_NOISE = 0.5  # of the first bounce: a tolerance beyond would leave it out
EVEN = 1e-6  # relative difference of channels that is none

Floats = NDArray[np.float32]


class GlossyGather(FiniteElements):
    """Indirect light of one channel at the vertices of a scene and of the terms of its glossy ones.

    Rows are numbered as in ``FactoredVisibility``.

    Parameters
    ----------
    matrices : sequence of (n, n) sparse float32
        As for ``FiniteElements``.
    albedo : (n,) float32
        Of the diffuse part of each vertex; 1 for terms.
    problem : Problem
    direct : FactoredVisibility
    seed : int
    """

    def __init__(
        self,
        matrices: Sequence[scipy.sparse.csr_array],
        albedo: Floats,
        problem: Problem,
        direct: FactoredVisibility,
        seed: int,
    ) -> None:
        points = problem.points
        term = np.tile(np.arange(1, direct.terms + 1), len(direct.glossy)).astype(np.uint64)
        keys = [points.keys, mix(np.repeat(points.keys[direct.glossy], direct.terms) + term)]
        super().__init__(
            matrices,
            albedo[None],
            np.concatenate(keys),
            Nodes(np.arange(direct.shape[0]), None),
            problem.max_depth,
            seed,
        )
        self._visibility = direct.visibility

    def _count_for(self, direct: Operator) -> int:
        """By the direct light of white surfaces: that of terms is dear, and joins with the first bounce."""
        unit_albedo = self._visibility.relight(np.ones((direct.shape[1], 3), np.float32))[:, 0]
        return self.bounces(
            np.concatenate([unit_albedo, np.zeros(direct.shape[0] - len(unit_albedo), np.float32)])
        )

    def bounces(self, even: Floats) -> int:
        """How many interreflections count for anything; terms may be negative, so that this is no strict bound."""
        total, count, light = 0.0, 0, even[:, None]
        while count < (self.max_depth - 2 if self.max_depth >= 0 else MOST_BOUNCES):
            light = self.matrix @ (self._albedo[0][:, None] * light)
            peak = float(np.abs(light).max(initial=0))
            if peak <= NEGLIGIBLE * total or peak == 0:
                break
            count, total = count + 1, total + peak
        return count


@dataclass(frozen=True)
class GatherRays:
    """What rays from all vertices meet, ordered by vertices.

    Attributes
    ----------
    point, seen : (m,) int64
        The vertex that a ray gathers for, and the one it meets.
    number : (m,) int64
        Of a ray among those of its vertex, side by side.
    into : (m, 1 + K) float32
        Weights in unit-albedo light and in the terms of ``point``, times the number of rays.
    out : (m, channels * K) float32
        g_k of ``seen`` towards the ray's origin.
    per_vertex : int
        Rays, those that meet nothing among them.
    """

    point: NDArray[np.int64]
    seen: NDArray[np.int64]
    number: NDArray[np.int64]
    into: Floats
    out: Floats
    per_vertex: int

    def noise(self, direct: FactoredVisibility, albedo: Floats, points: Points, seed: int) -> float:
        """Relative L2 of what their randomness leaves in the first bounce of unit-albedo light.

        From how far two halves of them differ, at some vertices and under random sums of columns.
        ``albedo`` is that of one channel, (n_v,).
        """
        some = np.argsort(mix(points.keys), kind="stable")[:NOISE_VERTICES]
        row = np.full(len(points), -1)
        row[some] = np.arange(len(some))
        own = np.flatnonzero(row[self.point] >= 0)
        # rays are in Morton's order, so that this is a checkerboard
        half = (np.bitwise_count(self.number[own]) % 2).astype(np.int64)
        shape = 2 * len(some), len(points)
        place = row[self.point[own]] + half * len(some), self.seen[own]
        halves = scipy.sparse.csr_array((albedo[self.seen[own]], place), shape=shape)
        light = random_combinations(direct.visibility, USUAL.mixed, np.random.default_rng(seed))
        return relative_noise(*np.split(halves @ light, 2))


def gather_rays(problem: Problem, outgoing: Floats, rays_per_vertex: int, seed: int) -> GatherRays:
    """Cosine-distributed rays from all vertices.

    Parameters
    ----------
    problem : Problem
        With in-out factors.
    outgoing : (channels, materials, size, size, K) float32
        g_k.
    rays_per_vertex : int
        A power of two.
    seed : int
    """
    assert isinstance(problem.reflection, InOutFactors)
    points = problem.points
    surfaces, arrays, samples = Surfaces(problem.scene), PointArrays(points), sobol(rays_per_vertex)
    lobes = Lobes(problem.reflection, outgoing)
    size = max(1, LANES // rays_per_vertex)
    hits, into, out = [], [], []
    for a in range(0, len(points), size):
        ids = dr.arange(mi.UInt32, min(size, len(points) - a)) + dr.opaque(mi.UInt32, a)
        ray, point, u = cosine_rays(arrays, ids, samples, seed)
        vertex = surfaces.traced(ray, u)
        weights, values = lobes.incident(point, ray.d), lobes.outgoing(vertex, -ray.d)
        dr.eval(vertex, weights, values)
        met = np.flatnonzero(vertex.numpy() < NOTHING)
        hits.append(
            np.stack([point.numpy()[met], vertex.numpy()[met], met % rays_per_vertex]).astype(np.int64)
        )
        into.append(np.stack([np.ones(len(met), np.float32), *(w.numpy()[met] for w in weights)], axis=1))
        out.append(np.stack([v.numpy()[met] for v in values], axis=1))
    point, seen, number = np.concatenate(hits, axis=1)
    return GatherRays(point, seen, number, np.concatenate(into), np.concatenate(out), rays_per_vertex)


def gather_matrix(direct: FactoredVisibility, rays: GatherRays, channel: int) -> scipy.sparse.csr_array:
    """G (n, n) of one channel, over unit-albedo light of all vertices and terms of the glossy ones."""
    n, terms = len(direct.material), direct.terms
    number = np.full(n, -1)  # of a vertex among the glossy ones
    number[direct.glossy] = np.arange(len(direct.glossy))
    own = slice(channel * terms, (channel + 1) * terms)
    entries = 1 + terms * (number[rays.seen] >= 0)  # of a ray, in each row that it is in
    lengths = np.bincount(rays.point, weights=entries, minlength=n).astype(np.int64)
    starts = row_starts(np.concatenate([lengths, np.repeat(lengths[direct.glossy], terms)]))
    columns, values = np.empty(starts[-1], np.int32), np.empty(starts[-1], np.float32)
    first = np.searchsorted(rays.point, np.arange(n + 1))
    into, out = rays.into / np.float32(rays.per_vertex), np.ascontiguousarray(rays.out[:, own])
    _fill(first, rays.seen, number, into, out, starts, columns, values)
    return scipy.sparse.csr_array((values, columns, starts), shape=(direct.shape[0], direct.shape[0]))


@numba.njit(parallel=True, cache=True)
def _fill(
    first: NDArray[np.int64],
    seen: NDArray[np.int64],
    number: NDArray[np.int64],
    into: Floats,
    out: Floats,
    starts: NDArray[np.int64],
    columns: NDArray[np.int32],
    values: Floats,
) -> None:
    """Rows of each point in turn: unit-albedo light, then its terms; entries of a ray likewise."""
    n, terms = len(number), out.shape[1]
    for i in numba.prange(n):
        for row in range(1 + terms if number[i] >= 0 else 1):
            at = starts[i] if row == 0 else starts[n + number[i] * terms + row - 1]
            for ray in range(first[i], first[i + 1]):
                weight = into[ray, row]
                columns[at], values[at] = seen[ray], weight
                at += 1
                other = number[seen[ray]]
                if other >= 0:
                    for k in range(terms):
                        columns[at], values[at] = n + other * terms + k, weight * out[ray, k]
                        at += 1


def glossy_indirect(
    problem: Problem,
    direct: FactoredVisibility,
    rays_per_vertex: int,
    tolerance: float,
    seed: int,
    specular: SparseRows | ByDepth | None = None,
) -> tuple[Gathered | GatheredByDepth, float]:
    """Indirect light of all rows of ``direct``, factored per channel, and the noise of the rays.

    Parameters
    ----------
    problem : Problem
        Its reflection has the factors of ``direct``.
    direct : FactoredVisibility
    rays_per_vertex : int
        A power of two.
    tolerance : float
        As for ``RadiositySolver.indirect``; no less than the noise of the rays, whose rank is full.
    seed : int
    specular : SparseRows or ByDepth, optional
        Light from the sky by way of mirrors and glass, which surfaces send on as well. What they send on by way of
        mirrors and glass reaches unit-albedo rows, and of glossy surfaces as far as these are diffuse.
    """
    albedo, outgoing = _channels(problem.reflection, 1 if specular is None else specular.shape[2])
    ones = np.ones(direct.shape[0] - len(albedo), np.float32)
    rays = gather_rays(problem, outgoing, rays_per_vertex, seed)
    noise = rays.noise(direct, albedo.mean(axis=1), problem.points, seed)
    after_mirrors = _after_mirrors(problem, direct.shape[0], rays_per_vertex, seed)
    found = []
    for channel, shade in enumerate(albedo.T):
        matrices = [gather_matrix(direct, rays, channel), *after_mirrors]
        solver = GlossyGather(matrices, np.concatenate([shade, ones]), problem, direct, seed)
        own = None if specular is None else _channel(specular, channel)
        found.append(solver.indirect(direct, max(tolerance, min(noise, MOST_NOISE)), own))
    return _joined(found), noise


def _channel(specular: SparseRows | ByDepth, number: int) -> Operator:
    """One of three channels alone."""
    if isinstance(specular, ByDepth):
        return ByDepth(tuple(t.channel(number) for t in specular.terms if isinstance(t, SparseRows)))
    return specular.channel(number)


def _joined(found: list[Gathered | GatheredByDepth]) -> Gathered | GatheredByDepth:
    """Light of several channels, each of which was found on its own."""
    by_depth = [f for f in found if isinstance(f, GatheredByDepth)]
    if by_depth:
        return joined_channels(by_depth)
    summed = [f for f in found if isinstance(f, Gathered)]
    return Gathered(
        tuple(f.left[0] for f in summed),
        tuple(f.right[0] for f in summed),
        max(f.left_out for f in summed),
        max(f.bounces for f in summed),
    )


def _after_mirrors(problem: Problem, rows: int, rays: int, seed: int) -> list[scipy.sparse.csr_array]:
    """G_1, G_2, ... (rows, rows) of unit-albedo rows; none where there are no specular surfaces."""
    if not problem.specular_apart:
        return []
    matrices = specular_form_factors(problem, np.arange(len(problem.points)), rays, seed)
    for matrix in matrices:
        matrix.resize((rows, rows))
    return matrices


def _channels(reflection: Reflection, least: int) -> tuple[Floats, Floats]:
    """Albedos (n_v, channels) and g_k (channels, ...); one channel where all are alike and ``least`` is no more."""
    assert isinstance(reflection, InOutFactors)
    albedo, outgoing = reflection.albedo, outgoing_tables(reflection.factors)
    grey = np.ptp(albedo, axis=1).max() <= EVEN and np.ptp(outgoing, axis=4).max() <= EVEN * outgoing.max()
    count = least if grey else 3
    return np.ascontiguousarray(albedo[:, :count]), np.ascontiguousarray(np.moveaxis(outgoing, 4, 0)[:count])
