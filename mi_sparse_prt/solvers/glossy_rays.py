"""What rays from vertices find of the light that glossy surfaces send out, and how much of it is noise.

Rays are weighted by 1, for unit-albedo light, and by f_k(w) pi / cos, for the terms of a glossy vertex; what they meet
sends out a diffuse part and g_l(w_o) times its own terms ([HR10] eq. 2-3): one sparse matrix over all of these, which
is kept as weights of rays times what each of them finds.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numba
import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mi_sparse_prt.core.bits import BITS
from mi_sparse_prt.core.device_arrays import on_device
from mi_sparse_prt.core.factored_sparse import FactoredSparse
from mi_sparse_prt.core.ragged import row_starts
from mi_sparse_prt.core.random_keys import mix
from mi_sparse_prt.core.sparse_arrays import sparse_of_rows
from mi_sparse_prt.core.sparse_product import multiply_sparse
from mi_sparse_prt.core.threads import run_in_parts
from mi_sparse_prt.measurement.point_arrays import PointArrays
from mi_sparse_prt.operators.column_blocks import combine_randomly
from mi_sparse_prt.operators.factored_visibility import FactoredVisibility
from mi_sparse_prt.reflection.in_out_factors import InOutFactors
from mi_sparse_prt.solvers.first_bounce import USUAL
from mi_sparse_prt.solvers.form_factors import LANES, NOTHING, Surfaces, sobol
from mi_sparse_prt.solvers.lobes import Lobes
from mi_sparse_prt.solvers.problem import Problem

NOISE_VERTICES = 4096  # at which noise is looked at, at most
NOISE_ENTRIES = 1 << 24  # of matrices by which that is done, at most

Floats = NDArray[np.float32]
LookUp = Callable[[mi.UInt32, mi.Vector3f], list[mi.Float]]  # factors of vertices in directions


class Noise(NamedTuple):
    """What the randomness of rays leaves of the radiance of the first bounce.

    Attributes
    ----------
    bounce : float
        Relative L2.
    share : float
        Norm of that radiance, relative to that of all light that surfaces send on, later bounces left out.
    """

    bounce: float
    share: float


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
    sender : (m,) int32
        The one whose terms it finds there.
    half : (m,) bool
        To which of two halves of the rays it belongs.
    into : (rays of glossy vertices, K) float32
        Weights in the terms of its own vertex.
    out : (rays that meet glossy vertices, channels * K) float32
        g_k of ``sender`` towards the ray's origin; of rays whose senders are glossy.
    per_vertex : int
        Rays, those that meet nothing among them.
    """

    points: NDArray[np.int64]
    counts: NDArray[np.int64]
    seen: NDArray[np.int32]
    sender: NDArray[np.int32]
    half: NDArray[np.bool_]
    into: Floats
    out: Floats
    per_vertex: int

    def noise(self, direct: FactoredVisibility, problem: Problem, seed: int) -> Noise:
        """What their randomness leaves of the first bounce, and in the matrix.

        From how far two halves of them differ, at some vertices and under random sums of columns, in one channel.
        Vertices that no camera sees terms of do not count: others average what these send.
        """
        reflection = problem.sending
        unseen = np.isin(self.points, np.setdiff1d(reflection.glossy, problem.reflection.glossy))
        order = np.lexsort((mix(problem.points.keys[self.points]), unseen))[:NOISE_VERTICES]
        order = order[~unseen[order]]
        own, terms = direct.material[self.points], direct.own_terms
        weights = np.where(own >= 0, 1 + terms[own], 0) * self.counts
        entries = np.cumsum((weights + self.entries(direct.material, terms))[order])
        which = np.sort(order[: max(1, int(np.searchsorted(entries, NOISE_ENTRIES, side="right")))])
        ids, n = self.points[which], len(direct.material)
        light = np.empty((direct.shape[0], min(BITS, direct.shape[1])), np.float32)
        combine_randomly(direct, USUAL.mixed, np.random.default_rng(seed), light)
        sent = light.copy()
        sent[:n] *= reflection.albedo.mean(axis=1)[:, None]
        x, y = (
            multiply_sparse(
                gather_matrices(direct, self._half(which, half, direct.material), 1, ids)[0], sent
            )
            for half in (False, True)
        )
        squares = np.zeros(3)
        for some in (ids[direct.material[ids] < 0], ids[direct.material[ids] >= 0]):
            if len(some):
                gram = reflection.gram(some).mean(axis=3)
                rows = reflection.rows_of_each(some, gram.shape[1])
                own = np.where(rows < n, np.searchsorted(ids, rows), rows - n + len(ids))
                noise, bounce = (x[own] - y[own]) / 2, (x[own] + y[own]) / 2
                squares += [_squared_norm(gram, part) for part in (noise, bounce, light[rows] + bounce)]
        noise, bounce, every = np.sqrt(np.maximum(squares, 1e-30))
        return Noise(float(noise / bounce), float(bounce / every))

    def entries(self, material: NDArray[np.integer], terms: NDArray[np.int64]) -> NDArray[np.int64]:
        """How many numbers (n,) the rays of each point find: what they meet, and the terms (materials,) of that."""
        met = material[self.sender]
        of_terms = np.cumsum(np.where(met >= 0, terms[met], 0))
        return self.counts + np.diff(np.concatenate([[0], of_terms])[row_starts(self.counts)])

    def _half(self, which: NDArray[np.integer], half: bool, material: NDArray[np.integer]) -> GatherRays:
        """Half of the rays of some points, by their place among all."""
        chosen = np.zeros(len(self.points), bool)
        chosen[which] = True
        kept = np.repeat(chosen, self.counts) & (self.half == half)
        glossy = np.repeat(material[self.points] >= 0, self.counts)
        of = np.repeat(np.arange(len(self.points)), self.counts)[kept]
        return GatherRays(
            self.points[which],
            np.bincount(of, minlength=len(self.points))[which],
            self.seen[kept],
            self.sender[kept],
            self.half[kept],
            self.into[kept[glossy]],
            self.out[kept[material[self.sender] >= 0]],
            self.per_vertex // 2,
        )


def _squared_norm(gram: Floats, light: NDArray[np.floating]) -> float:
    """Squared norm of the radiance of rows (k, R, columns) of points."""
    return float((gram * np.einsum("kaw,kbw->kab", light, light, optimize=True)).sum(dtype=np.float64))


def gather_rays(
    problem: Problem, outgoing: Floats, rays_per_vertex: int, seed: int, points: NDArray[np.int64]
) -> GatherRays:
    """Cosine-distributed rays from vertices.

    Parameters
    ----------
    problem : Problem
        Whose vertices send light by in-out factors.
    outgoing : (channels, materials, size, size, K) float32
        g_k.
    rays_per_vertex : int
        A power of two.
    seed : int
    points : (n,) integers
        Vertices, ascending.
    """
    assert isinstance(problem.sending, InOutFactors)
    surfaces = Surfaces(problem.scene, problem.max_depth)
    arrays, samples = PointArrays(problem.points), sobol(rays_per_vertex)
    lobes = Lobes(problem.sending, outgoing)
    senders = None if problem.sent is None else on_device(mi.UInt32, problem.sent.senders.astype(np.uint32))
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
        sender = vertex if senders is None else dr.gather(mi.UInt32, senders, vertex)
        row, number = np.divmod(met.numpy(), np.uint32(rays_per_vertex))
        blocks.append((
            np.bincount(row, minlength=len(some)),
            mi.Int32(vertex).numpy(),
            mi.Int32(sender).numpy(),
            np.bitwise_count(number) % 2 == 1,  # rays are in Morton's order, so that this is a checkerboard
            _of_glossy(lobes, lobes.incident, point, d),
            _of_glossy(lobes, lobes.outgoing, sender, -last),
        ))  # fmt: skip
    counts, seen, sender, half, into, out = (np.concatenate(x) for x in zip(*blocks, strict=True))
    return GatherRays(points, counts, seen, sender, half, into, out, rays_per_vertex)


def _of_glossy(lobes: Lobes, look_up: LookUp, vertex: mi.UInt32, direction: mi.Vector3f) -> Floats:
    """Factors (lanes, k) of those lanes, few as a rule, whose vertices are glossy."""
    lanes = dr.compress(lobes.is_glossy(vertex)) if dr.width(vertex) else mi.UInt32()
    if not len(lanes):
        return np.empty((0, len(look_up(mi.UInt32(0), mi.Vector3f(0, 0, 1)))), np.float32)
    values = look_up(dr.gather(mi.UInt32, vertex, lanes), dr.gather(mi.Vector3f, direction, lanes))
    count = len(values)  # side by side at once: to put columns together takes as long as to find them
    found, place = dr.empty(mi.Float, count * len(lanes)), count * dr.arange(mi.UInt32, len(lanes))
    for k, value in enumerate(values):
        dr.scatter(found, value, place + k)
    return found.numpy().reshape(-1, count)


def gather_matrices(
    direct: FactoredVisibility, rays: GatherRays, channels: int, nodes: NDArray[np.integer]
) -> list[FactoredSparse]:
    """G of each channel: rows of nodes, then of terms, over unit-albedo light of all vertices and terms.

    Rows of a glossy vertex are sums over the same rays; those of a diffuse one are put together at once.
    """
    n, terms, glossy = len(direct.material), direct.terms, direct.material[rays.points] >= 0
    shape = len(nodes) + direct.shape[0] - n, direct.shape[0]
    node, number = _numbers(nodes, n), _numbers(direct.glossy, n)
    of_terms = len(nodes) + number[rays.points[glossy]][:, None] * terms + np.arange(terms)
    of_terms[np.arange(terms) >= direct.own_terms[direct.material[rays.points[glossy]]][:, None]] = -1
    rows = np.column_stack([node[rays.points[glossy]], of_terms])
    share, inner = np.float32(1 / rays.per_vertex), row_starts(rays.counts[glossy])
    weights = share * np.column_stack([np.ones(len(rays.into), np.float32), rays.into])
    lengths = np.zeros(shape[0], np.int64)
    lengths[node[rays.points[~glossy]]] = rays.entries(direct.material, direct.own_terms)[~glossy]
    starts = row_starts(lengths)
    right, found = (
        _met(direct, rays, np.flatnonzero(np.repeat(of, rays.counts)), channels) for of in (glossy, ~glossy)
    )
    rest = [sparse_of_rows(share * x.data, x.indices, starts, shape[1]) for x in found]
    return [FactoredSparse(rows, inner, weights, *own) for own in zip(right, rest, strict=True)]


def _numbers(ids: NDArray[np.integer], n: int) -> NDArray[np.int64]:
    """The place of each of n vertices among some of them, -1 if it is not there."""
    found = np.full(n, -1)
    found[ids] = np.arange(len(ids))
    return found


def _met(
    direct: FactoredVisibility, rays: GatherRays, some: NDArray[np.int64], channels: int
) -> list[scipy.sparse.csr_array]:
    """What some rays find (rays, n), in each channel: the light of a vertex and, if it is glossy, of all its terms."""
    number = _numbers(direct.glossy, len(direct.material))[rays.sender]
    shiny = np.cumsum(number >= 0) - 1  # its place among rays that meet such
    counts = np.append(direct.own_terms, 0)[direct.material[rays.sender]]  # of terms
    starts = row_starts(1 + counts[some])
    columns, found = np.empty(starts[-1], np.int32), list[scipy.sparse.csr_array]()
    out = rays.out.reshape(len(rays.out), rays.out.shape[1] // direct.terms, direct.terms)
    for channel in range(channels):
        met, values = (rays.seen, number, counts, shiny, out, channel), np.empty(starts[-1], np.float32)
        run_in_parts(_fill, len(some), some, met, len(direct.material), starts, columns, values)
        found.append(sparse_of_rows(values, columns, starts, direct.shape[0]))  # all have the same columns
    return found


@numba.njit(nogil=True, cache=True)
def _fill(
    first: int,
    last: int,
    rays: NDArray[np.int64],
    met: tuple[NDArray[np.int32], NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], Floats, int],
    n: int,
    starts: NDArray[np.int64],
    columns: NDArray[np.int32],
    values: Floats,
) -> None:
    """Columns and values of what each ray finds, the diffuse part of a vertex first, in one channel."""
    seen, number, counts, shiny, out, channel = met
    terms = out.shape[2]
    for i in range(first, last):
        ray, at = rays[i], starts[i]
        columns[at], values[at] = seen[ray], 1
        for k in range(counts[ray]):
            columns[at + 1 + k] = n + number[ray] * terms + k
            values[at + 1 + k] = out[shiny[ray], channel, k]
