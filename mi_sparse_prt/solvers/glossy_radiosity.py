"""Interreflection among glossy surfaces by finite elements: terms of BRDFs are elements as vertices are.

Light that leaves vertex y towards w_o is ``rho_y B_y + sum_l g_l(w_o) B_yl``: a diffuse part and the coefficients B_yl
that incident factors f_l have found ([HR10] eq. 2-3, [Leh07] 2.5). What rays from x find of it, weighted by 1 (white
light) and by f_k(w) pi / cos (its own terms), is one sparse matrix over all of these.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numba
import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mi_sparse_prt.core.bits import BITS
from mi_sparse_prt.core.metrics import relative_noise
from mi_sparse_prt.core.ragged import row_starts
from mi_sparse_prt.core.random_keys import mix
from mi_sparse_prt.core.threads import run_in_parts
from mi_sparse_prt.measurement.point_arrays import PointArrays
from mi_sparse_prt.measurement.vertices import Points
from mi_sparse_prt.operators.by_depth import ByDepth
from mi_sparse_prt.operators.column_blocks import combine_randomly
from mi_sparse_prt.operators.factored_visibility import FactoredVisibility
from mi_sparse_prt.operators.low_rank import LowRank
from mi_sparse_prt.operators.operator import Operator
from mi_sparse_prt.operators.sparse_rows import SparseRows
from mi_sparse_prt.reflection.factor_tables import outgoing_tables
from mi_sparse_prt.reflection.in_out_factors import InOutFactors
from mi_sparse_prt.reflection.reflection import Reflection
from mi_sparse_prt.solvers.first_bounce import USUAL
from mi_sparse_prt.solvers.form_factors import LANES, NOTHING, Surfaces, sobol
from mi_sparse_prt.solvers.lobes import Lobes
from mi_sparse_prt.solvers.problem import Problem
from mi_sparse_prt.solvers.radiosity import (
    NEGLIGIBLE,
    FiniteElements,
    Gathered,
    GatheredByDepth,
)
from mi_sparse_prt.solvers.specular_chains import specular_form_factors
from mi_sparse_prt.solvers.surface_nodes import Nodes

MOST_BOUNCES = 64  # where there is no limit
NOISE_VERTICES = 4096  # at which noise is looked at
MOST_NOISE = 0.5  # of the first bounce: a tolerance beyond would leave it out
EVEN = 1e-6  # relative difference of channels that is none

Floats = NDArray[np.float32]
LookUp = Callable[[mi.UInt32, mi.Vector3f], list[mi.Float]]  # factors of vertices in directions


class GlossyGather(FiniteElements):
    """Indirect light of one channel at the vertices of a scene and of the terms of its glossy ones.

    Rows are numbered as in ``FactoredVisibility``.

    Parameters
    ----------
    matrices : sequence of (n_nodes, n) sparse float32
        As for ``FiniteElements``.
    albedo : (n,) float32
        Of the diffuse part of each vertex; 1 for terms.
    problem : Problem
    direct : FactoredVisibility
    nodes : Nodes
        See ``nodes_and_terms``.
    seed : int
    """

    def __init__(
        self,
        matrices: Sequence[scipy.sparse.csr_array],
        albedo: Floats,
        problem: Problem,
        direct: FactoredVisibility,
        nodes: Nodes,
        seed: int,
    ) -> None:
        points = problem.points
        term = np.tile(np.arange(1, direct.terms + 1), len(direct.glossy)).astype(np.uint64)
        keys = [points.keys, mix(np.repeat(points.keys[direct.glossy], direct.terms) + term)]
        super().__init__(matrices, albedo[None], np.concatenate(keys), nodes, problem.max_depth, seed)
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
            found = self.matrix @ (self._albedo[0][:, None] * light)
            peak = float(np.abs(found).max(initial=0))
            if peak <= NEGLIGIBLE * total or peak == 0:
                break
            count, total, light = count + 1, total + peak, self.nodes.interpolate(found)
        return count


def nodes_and_terms(nodes: Nodes, direct: FactoredVisibility) -> Nodes:
    """Rows that gather light: those of some vertices, between which others interpolate theirs, and of all terms."""
    n, rows = len(direct.material), direct.shape[0]
    weights = nodes.weights
    if weights is not None:
        weights = scipy.sparse.block_diag([weights, scipy.sparse.eye_array(rows - n)], "csr", np.float32)
    return Nodes(np.concatenate([nodes.ids, np.arange(n, rows)]), weights)


@dataclass(frozen=True)
class GatherRays:
    """What rays from some vertices meet, vertex after vertex.

    Attributes
    ----------
    points : (n,) int64
        The vertices, ascending.
    counts : (n,) int64
        Of their rays that meet a surface.
    seen : (m,) int32
        The vertex that each of these meets.
    half : (m,) bool
        To which of two halves of the rays it belongs.
    into : (rays of glossy vertices, K) float32
        Weights in the terms of its own vertex.
    out : (rays that meet glossy vertices, channels * K) float32
        g_k of ``seen`` towards the ray's origin.
    per_vertex : int
        Rays, those that meet nothing among them.
    """

    points: NDArray[np.int64]
    counts: NDArray[np.int64]
    seen: NDArray[np.int32]
    half: NDArray[np.bool_]
    into: Floats
    out: Floats
    per_vertex: int

    def noise(self, direct: FactoredVisibility, albedo: Floats, points: Points, seed: int) -> float:
        """Relative L2 of what their randomness leaves in the first bounce of unit-albedo light.

        From how far two halves of them differ, at some vertices and under random sums of columns.
        ``albedo`` is that of one channel, (n_v,).
        """
        some = np.argsort(mix(points.keys[self.points]), kind="stable")[:NOISE_VERTICES]
        row = np.full(len(self.points), -1)
        row[some] = np.arange(len(some))
        row = np.repeat(row, self.counts)
        own = np.flatnonzero(row >= 0)
        shape = 2 * len(some), len(points)
        place = row[own] + self.half[own] * len(some), self.seen[own]
        halves = scipy.sparse.csr_array((albedo[self.seen[own]], place), shape=shape)
        light = np.empty((len(points), min(BITS, direct.shape[1])), np.float32)
        combine_randomly(direct.visibility, USUAL.mixed, np.random.default_rng(seed), light)
        return relative_noise(*np.split(halves @ light, 2))


def gather_rays(
    problem: Problem, outgoing: Floats, rays_per_vertex: int, seed: int, points: NDArray[np.int64]
) -> GatherRays:
    """Cosine-distributed rays from vertices.

    Parameters
    ----------
    problem : Problem
        With in-out factors.
    outgoing : (channels, materials, size, size, K) float32
        g_k.
    rays_per_vertex : int
        A power of two.
    seed : int
    points : (n,) integers
        Vertices, ascending.
    """
    assert isinstance(problem.reflection, InOutFactors)
    surfaces = Surfaces(problem.scene, problem.max_depth)
    arrays, samples = PointArrays(problem.points), sobol(rays_per_vertex)
    lobes = Lobes(problem.reflection, outgoing)
    size = max(1, LANES // rays_per_vertex)
    blocks = []
    for a in range(0, len(points), size):
        some = points[a : a + size]
        found = surfaces.traced(arrays, mi.UInt32(some.astype(np.uint32)), samples, seed)
        vertex, point, first, last = found.vertex, found.point, found.ray.d, mi.Vector3f(found.ray.d)
        dr.eval(point, first, last)
        dr.scatter(last, found.last, found.gaps)
        met = dr.compress(vertex < NOTHING)
        point, vertex, d, last = (dr.gather(type(x), x, met) for x in (point, vertex, first, last))
        row, number = np.divmod(met.numpy(), np.uint32(rays_per_vertex))
        blocks.append((
            np.bincount(row, minlength=len(some)),
            mi.Int32(vertex).numpy(),
            np.bitwise_count(number) % 2 == 1,  # rays are in Morton's order, so that this is a checkerboard
            _of_glossy(lobes, lobes.incident, point, d),
            _of_glossy(lobes, lobes.outgoing, vertex, -last),
        ))  # fmt: skip
    counts, seen, half, into, out = (np.concatenate(x) for x in zip(*blocks, strict=True))
    return GatherRays(points, counts, seen, half, into, out, rays_per_vertex)


def _of_glossy(lobes: Lobes, look_up: LookUp, vertex: mi.UInt32, direction: mi.Vector3f) -> Floats:
    """Factors (lanes, k) of those lanes, few as a rule, whose vertices are glossy."""
    lanes = dr.compress(lobes.is_glossy(vertex))
    if not len(lanes):
        return np.empty((0, len(look_up(mi.UInt32(0), mi.Vector3f(0, 0, 1)))), np.float32)
    values = look_up(dr.gather(mi.UInt32, vertex, lanes), dr.gather(mi.Vector3f, direction, lanes))
    dr.eval(values)
    return np.stack([value.numpy() for value in values], axis=1)


def gather_matrix(
    direct: FactoredVisibility, rays: GatherRays, channel: int, nodes: NDArray[np.integer]
) -> scipy.sparse.csr_array:
    """G of one channel: rows of nodes, then of terms, over unit-albedo light of all vertices and terms."""
    n, terms, rows = len(direct.material), direct.terms, len(nodes) + direct.shape[0] - len(direct.material)
    number = np.full(n, -1)  # of a vertex among the glossy ones
    number[direct.glossy] = np.arange(len(direct.glossy))
    node = np.full(n, -1)  # and among the nodes
    node[nodes] = np.arange(len(nodes))
    own = slice(channel * terms, (channel + 1) * terms)
    first = row_starts(rays.counts)
    shiny = np.concatenate([[0], np.cumsum(number[rays.seen] >= 0)])[
        first
    ]  # rays of points before that meet such
    entries = np.diff(first) + terms * np.diff(shiny)  # of a point, in each of its rows
    lengths, glossy = np.zeros(rows, np.int64), number[rays.points] >= 0
    is_node = node[rays.points] >= 0
    lengths[node[rays.points[is_node]]] = entries[is_node]
    lengths[len(nodes) :] = np.repeat(entries[glossy], terms)
    starts = row_starts(lengths)
    columns, values = np.empty(starts[-1], np.int32), np.empty(starts[-1], np.float32)
    into = row_starts(np.where(glossy, rays.counts, 0))
    where = rays.points, first, into, shiny
    found = rays.into, np.ascontiguousarray(rays.out[:, own]), np.float32(1 / rays.per_vertex)
    numbers = number, node, len(nodes)
    run_in_parts(_fill, len(rays.points), where, rays.seen, numbers, found, starts, columns, values)
    return scipy.sparse.csr_array((values, columns, starts), shape=(rows, direct.shape[0]))


@numba.njit(nogil=True, cache=True)
def _fill(
    first: int,
    last: int,
    where: tuple[NDArray[np.int64], ...],
    seen: NDArray[np.int32],
    numbers: tuple[NDArray[np.int64], NDArray[np.int64], int],
    found: tuple[Floats, Floats, np.float32],
    starts: NDArray[np.int64],
    columns: NDArray[np.int32],
    values: Floats,
) -> None:
    """Rows of each point: unit-albedo light, then its terms; entries of a ray likewise."""
    (points, rays, first_into, first_out), (number, node, nodes) = where, numbers
    into, out, share = found
    n, terms = len(number), out.shape[1]
    for i in range(first, last):
        own = number[points[i]]
        for row in range(1 + terms if own >= 0 else 1):
            if row == 0 and node[points[i]] < 0:
                continue
            at = starts[node[points[i]]] if row == 0 else starts[nodes + own * terms + row - 1]
            shiny = first_out[i]
            for ray in range(rays[i], rays[i + 1]):
                weight = share if row == 0 else share * into[first_into[i] + ray - rays[i], row - 1]
                columns[at], values[at] = seen[ray], weight
                at += 1
                other = number[seen[ray]]
                if other >= 0:
                    for k in range(terms):
                        columns[at], values[at] = n + other * terms + k, weight * out[shiny, k]
                        at += 1
                    shiny += 1


def glossy_indirect(
    problem: Problem,
    direct: FactoredVisibility,
    rays_per_vertex: int,
    tolerance: float,
    nodes: Nodes,
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
    nodes : Nodes
        Vertices that gather unit-albedo light, others interpolate theirs; terms are gathered at all glossy ones.
    seed : int
    specular : SparseRows or ByDepth, optional
        Light from the sky by way of mirrors and glass, which surfaces send on as well. What they send on by way of
        mirrors and glass reaches unit-albedo rows, and of glossy surfaces as far as these are diffuse.
    """
    albedo, outgoing = _channels(problem.reflection, 1 if specular is None else specular.shape[2])
    ones = np.ones(direct.shape[0] - len(albedo), np.float32)
    points = np.union1d(nodes.ids, direct.glossy)
    rays = gather_rays(problem, outgoing, rays_per_vertex, seed, points)
    noise = rays.noise(direct, albedo.mean(axis=1), problem.points, seed)
    rows = nodes_and_terms(nodes, direct)
    after_mirrors = _after_mirrors(problem, nodes.ids, (len(rows), direct.shape[0]), rays_per_vertex, seed)
    found = []
    for channel, shade in enumerate(albedo.T):
        matrices = [gather_matrix(direct, rays, channel, nodes.ids), *after_mirrors]
        solver = GlossyGather(matrices, np.concatenate([shade, ones]), problem, direct, rows, seed)
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
        terms = (
            LowRank(tuple(t.left[0] for t in some), tuple(t.right[0] for t in some))
            for some in zip(*(f.terms for f in by_depth), strict=True)
        )
        return GatheredByDepth(tuple(terms), max(f.left_out for f in by_depth))
    summed = [f for f in found if isinstance(f, Gathered)]
    return Gathered(
        tuple(f.left[0] for f in summed),
        tuple(f.right[0] for f in summed),
        max(f.left_out for f in summed),
        max(f.bounces for f in summed),
    )


def _after_mirrors(
    problem: Problem, ids: NDArray[np.integer], shape: tuple[int, int], rays: int, seed: int
) -> list[scipy.sparse.csr_array]:
    """G_1, G_2, ... of unit-albedo rows, the first ones of this shape; none where there are no specular surfaces."""
    if not problem.specular_apart:
        return []
    matrices = specular_form_factors(problem, ids, rays, seed)
    for matrix in matrices:
        matrix.resize(shape)
    return matrices


def _channels(reflection: Reflection, least: int) -> tuple[Floats, Floats]:
    """Albedos (n_v, channels) and g_k (channels, ...); one channel where all are alike and ``least`` is no more."""
    assert isinstance(reflection, InOutFactors)
    albedo, outgoing = reflection.albedo, outgoing_tables(reflection.factors)
    grey = np.ptp(albedo, axis=1).max() <= EVEN and np.ptp(outgoing, axis=4).max() <= EVEN * outgoing.max()
    count = least if grey else 3
    return np.ascontiguousarray(albedo[:, :count]), np.ascontiguousarray(np.moveaxis(outgoing, 4, 0)[:count])
