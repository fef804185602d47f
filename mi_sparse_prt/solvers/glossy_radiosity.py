"""Interreflection among glossy surfaces by finite elements: terms of BRDFs are elements like vertices' white light.

Light that leaves vertex y towards w_o is ``rho_y B_y + sum_l g_l(w_o) B_yl``: a diffuse part and the coefficients B_yl
that incident factors f_l have found ([HR10] eq. 2-3, [Leh07] 2.5). What rays from x find of it, weighted by 1 (white
light) and by f_k(w) pi / cos (its own terms), is one sparse matrix over all of these.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numba
import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mi_sparse_prt.core.metrics import relative_noise
from mi_sparse_prt.core.random_keys import mix
from mi_sparse_prt.measurement.point_arrays import PointArrays
from mi_sparse_prt.measurement.vertices import Points
from mi_sparse_prt.operators.direct_columns import DirectColumns
from mi_sparse_prt.operators.factored_visibility import FactoredVisibility
from mi_sparse_prt.operators.low_rank import LowRank
from mi_sparse_prt.operators.operator import Part
from mi_sparse_prt.reflection.factor_tables import looked_up
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.solvers.first_bounce import MIXED
from mi_sparse_prt.solvers.form_factors import BEHIND, LANES, Surfaces, cosine_rays, sobol
from mi_sparse_prt.solvers.radiosity import NEGLIGIBLE, FiniteElements
from mi_sparse_prt.solvers.surface_nodes import Nodes
from mi_sparse_prt.solvers.touching_surfaces import contacts

MOST_BOUNCES = 64  # where there is no limit
NOISE_VERTICES = 4096  # at which noise is looked at
MOST_NOISE = 0.5  # of the first bounce: a tolerance beyond would leave it out

Floats = NDArray[np.float32]


class GlossyGather(FiniteElements):
    """Indirect light of one channel at the vertices of a scene and of the terms of its glossy ones.

    Rows are numbered as in ``FactoredVisibility``.

    Parameters
    ----------
    matrix : (n, n) sparse float32
        Of ``glossy_gather_matrix``.
    albedo : (n,) float32
        Of the diffuse part of each vertex; 1 for terms.
    scene : Scene
    points : Points
        Of all vertices.
    direct : FactoredVisibility
    max_depth, seed : int
        As for ``RadiositySolver``.
    """

    def __init__(
        self,
        matrix: scipy.sparse.csr_array,
        albedo: Floats,
        scene: Scene,
        points: Points,
        direct: FactoredVisibility,
        max_depth: int,
        seed: int,
    ) -> None:
        term = np.tile(np.arange(1, direct.terms + 1), len(direct.glossy)).astype(np.uint64)
        keys = [points.keys, mix(np.repeat(points.keys[direct.glossy], direct.terms) + term)]
        super().__init__(
            matrix,
            albedo[None],
            np.concatenate(keys),
            Nodes(np.arange(direct.count), None),
            contacts(scene, direct.lighting),
            direct.lighting,
            max_depth,
            seed,
        )

    def _count_for(self, direct: Part) -> int:
        """By the direct light of white surfaces: that of terms is dear, and joins with the first bounce."""
        assert isinstance(direct, FactoredVisibility)
        white = direct.white.relight(np.ones((self.lighting.n_directions, 3), np.float32))[:, 0]
        return self.bounces(np.concatenate([white, np.zeros(direct.count - len(white), np.float32)]))

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
        Weights in white light and in the terms of ``point``, times the number of rays.
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
        """Relative L2 of what their randomness leaves in the first bounce of white light.

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
        light = DirectColumns(direct.white, direct.lighting).combined(MIXED, np.random.default_rng(seed))
        return relative_noise(*np.split(halves @ light, 2))


def gather_rays(
    scene: Scene,
    points: Points,
    direct: FactoredVisibility,
    outgoing: Floats,
    rays_per_vertex: int,
    seed: int,
) -> GatherRays:
    """Cosine-distributed rays from all vertices.

    Parameters
    ----------
    scene : Scene
    points : Points
        Of all vertices.
    direct : FactoredVisibility
        It has the frames and the incident factors.
    outgoing : (channels, materials, size, size, K) float32
        g_k.
    rays_per_vertex : int
        A power of two.
    seed : int
    """
    surfaces, arrays, samples = Surfaces(scene), PointArrays(points), sobol(rays_per_vertex)
    lobes = Lobes(direct, outgoing)
    size = max(1, LANES // rays_per_vertex)
    hits, into, out = [], [], []
    for a in range(0, len(points), size):
        ids = dr.arange(mi.UInt32, min(size, len(points) - a)) + dr.opaque(mi.UInt32, a)
        ray, point, u = cosine_rays(arrays, ids, samples, seed)
        vertex = surfaces.traced(ray, u)
        weights, values = lobes.incident(point, ray.d), lobes.outgoing(vertex, -ray.d)
        dr.eval(vertex, weights, values)
        met = np.flatnonzero(vertex.numpy() < BEHIND)
        hits.append(
            np.stack([point.numpy()[met], vertex.numpy()[met], met % rays_per_vertex]).astype(np.int64)
        )
        into.append(np.stack([np.ones(len(met), np.float32), *(w.numpy()[met] for w in weights)], axis=1))
        out.append(np.stack([v.numpy()[met] for v in values], axis=1))
    point, seen, number = np.concatenate(hits, axis=1)
    return GatherRays(point, seen, number, np.concatenate(into), np.concatenate(out), rays_per_vertex)


class Lobes:
    """Factors of BRDFs on the device, looked up at vertices; 0 at those that are not glossy."""

    def __init__(self, direct: FactoredVisibility, outgoing: Floats) -> None:
        n = len(direct.bits)
        self._size, self._terms = direct.tables.shape[1], direct.terms
        material = np.full(n, len(direct.tables), np.uint32)  # one more, which is dark
        material[direct.glossy] = direct.materials
        turn = np.zeros((n, 3, 3), np.float32)
        turn[direct.glossy] = direct.frames
        self._material = mi.UInt32(material)
        self._axes = [mi.Vector3f(np.ascontiguousarray(turn[:, k].T)) for k in range(3)]
        self._incident, self._outgoing = _with_dark(direct.tables), [_with_dark(t) for t in outgoing]

    def incident(self, vertex: mi.UInt32, direction: mi.Vector3f) -> list[mi.Float]:
        """Terms f_k(w) pi / cos for directions (world) that are cosine-distributed."""
        local = self._local(vertex, direction, mi.Mask(True))
        scale = dr.pi / dr.maximum(local.z, 1e-2)
        return [scale * value for value in self._looked_up(self._incident, vertex, local, mi.Mask(True))]

    def outgoing(self, vertex: mi.UInt32, direction: mi.Vector3f) -> list[mi.Float]:
        """Terms g_k(w_o) of each channel in turn; ``vertex`` may be none."""
        valid = vertex < BEHIND
        local = self._local(vertex, direction, valid)
        valid &= local.z > 0
        return [v for table in self._outgoing for v in self._looked_up(table, vertex, local, valid)]

    def _local(self, vertex: mi.UInt32, direction: mi.Vector3f, valid: mi.Mask) -> mi.Vector3f:
        return mi.Vector3f(
            *(dr.dot(dr.gather(mi.Vector3f, axis, vertex, valid), direction) for axis in self._axes)
        )

    def _looked_up(
        self, table: mi.Float, vertex: mi.UInt32, local: mi.Vector3f, valid: mi.Mask
    ) -> list[mi.Float]:
        material = dr.gather(mi.UInt32, self._material, vertex, valid)
        return looked_up(table, self._size, self._terms, material, local, valid)


def _with_dark(tables: Floats) -> mi.Float:
    dark = np.zeros_like(tables[:1])
    return mi.Float(np.concatenate([tables, dark]).ravel())


def gather_matrix(direct: FactoredVisibility, rays: GatherRays, channel: int) -> scipy.sparse.csr_array:
    """G (n, n) of one channel, over white light of all vertices and terms of the glossy ones."""
    n, terms = len(direct.bits), direct.terms
    number = np.full(n, -1)  # of a vertex among the glossy ones
    number[direct.glossy] = np.arange(len(direct.glossy))
    own = slice(channel * terms, (channel + 1) * terms)
    entries = 1 + terms * (number[rays.seen] >= 0)  # of a ray, in each row that it is in
    lengths = np.bincount(rays.point, weights=entries, minlength=n).astype(np.int64)
    starts = np.concatenate(
        [[0], np.cumsum(np.concatenate([lengths, np.repeat(lengths[direct.glossy], terms)]))]
    )
    columns, values = np.empty(starts[-1], np.int32), np.empty(starts[-1], np.float32)
    first = np.searchsorted(rays.point, np.arange(n + 1))
    into, out = rays.into / np.float32(rays.per_vertex), np.ascontiguousarray(rays.out[:, own])
    _fill(first, rays.seen, number, into, out, starts, columns, values)
    return scipy.sparse.csr_array((values, columns, starts), shape=(direct.count, direct.count))


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
    """Rows of each point in turn: white light, then its terms; entries of a ray: white light, then terms."""
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
    scene: Scene,
    points: Points,
    direct: FactoredVisibility,
    outgoing: Floats,
    albedo: Floats,
    rays_per_vertex: int,
    tolerance: float,
    max_depth: int,
    seed: int,
) -> tuple[LowRank, float]:
    """Indirect light of all rows of ``direct``, factored per channel, and the noise of the rays.

    Parameters
    ----------
    scene, points, direct, outgoing, rays_per_vertex, seed
        As for ``gather_rays``.
    albedo : (n_v, channels) float32
        Of the diffuse part of each vertex.
    tolerance : float
        As for ``RadiositySolver.indirect``; no less than the noise of the rays, whose rank is full.
    max_depth : int
    """
    ones = np.ones(direct.count - len(albedo), np.float32)
    rays = gather_rays(scene, points, direct, outgoing, rays_per_vertex, seed)
    noise = rays.noise(direct, albedo.mean(axis=1), points, seed)
    found = []
    for channel, shade in enumerate(albedo.T):
        matrix = gather_matrix(direct, rays, channel)
        solver = GlossyGather(matrix, np.concatenate([shade, ones]), scene, points, direct, max_depth, seed)
        found.append(solver.indirect(direct, max(tolerance, min(noise, MOST_NOISE))))
    return LowRank(tuple(f.left[0] for f in found), tuple(f.right[0] for f in found)), noise
