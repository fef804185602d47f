"""S_i V E by tracing light: photons leave a lamp, and are counted at the vertices that they arrive at.

A path that starts at a point finds the light of a small bright place by chance alone: of the inside of a lampshade, or
of where a spot meets the ceiling. Photons come from there. Their number is in proportion to light, so that dark corners
have next to no noise; but where vertices are near each other few arrive at each, and in the open most are lost. Paths
and photons are two estimates of the same (Arvo 1986, "Backward Ray Tracing"; Veach 1997, 4.A and 10.3).

A photon's power goes to a corner of the triangle that it meets, by chance and with the barycentric weight as its
probability: what is known of a vertex is the mean of light around it, with the linear function as its weight that
interpolates its light. Nodes among many vertices take what arrives at those that are interpolated from them.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numba
import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mi_sparse_prt.core.random_keys import element_seeds, random_generator, random_stream
from mi_sparse_prt.core.sparse_product import multiply_sparse
from mi_sparse_prt.scene.materials import is_one_of, sample_weight
from mi_sparse_prt.scene.ray_offsets import ray_offset
from mi_sparse_prt.scene.triangle_mesh import unique_rows
from mi_sparse_prt.solvers.form_factors import NOTHING, Surfaces
from mi_sparse_prt.solvers.paths import Estimate
from mi_sparse_prt.solvers.problem import Problem
from mi_sparse_prt.solvers.surface_nodes import Nodes

LANES = 1 << 21  # photons per wavefront
PHOTONS = 13  # spawn key
TRIED = 16  # places on each side of a triangle, at which it is looked whether photons arrive there
SURVIVAL = 0.95  # at most, where ``max_depth`` sets no limit, as Mitsuba's ``path`` has it
OPEN = 0.05  # of the area around a node, at least, on which photons arrive
ALIKE = 1e-3  # normals

Doubles = NDArray[np.float64]
Floats = NDArray[np.float32]


class _Photons(NamedTuple):
    """On the device: rays of the normalised frame, what photons carry, random numbers, and which are scattered light.

    Scattered is light that a surface has sent on, and not mirrors and glass alone.
    """

    ray: Any
    power: Any
    rng: Any
    scattered: Any

    def take(self, index: mi.UInt32) -> _Photons:
        """Some of them."""
        rng = mi.PCG32()
        rng.state, rng.inc = (dr.gather(mi.UInt64, x, index) for x in (self.rng.state, self.rng.inc))
        ray, power, scattered = (dr.gather(type(x), x, index) for x in (self.ray, self.power, self.scattered))
        return _Photons(ray, power, rng, scattered)


class LightTracing:
    """Indirect light of lamps at nodes, from photons.

    What comes by way of mirrors and glass alone is not part of it (``solvers.specular``).

    Parameters
    ----------
    problem : Problem
        At vertices, with lamps of which some are ``emitted``.
    nodes : Nodes
        Among the vertices.
    seed : int
    apart : int
        Of light that met 1, 2, ... surfaces, so many numbers: three channels of each.

    Attributes
    ----------
    traced : int
        Photons so far.
    """

    def __init__(self, problem: Problem, nodes: Nodes, seed: int, apart: int = 1) -> None:
        self._problem, self._scene, self._nodes, self._apart = problem, problem.scene, nodes, apart
        self._surfaces = Surfaces(problem.scene)
        self._seeds, self.traced = element_seeds(random_stream(seed, PHOTONS), 2), 0

    def light(self, lamp: int, count: int, pilot: bool = False) -> Estimate:
        """Unit-albedo light of a lamp, times 1 as that of ``LampPaths``.

        Parameters
        ----------
        lamp : int
            A column that is ``emitted``.
        count : int
            Photons.
        pilot : bool
            Others than those of another call.

        Returns
        -------
        Estimate
            Mean (n, 3 * apart), and its variance as if one photon of the average power had arrived besides: infinite of
            nodes that have no surface of their own.
        """
        sums, squares = (np.zeros((self._alike.max() + 1, 3 * self._apart)) for _ in "sq")
        for met, vertex, power in self._arrivals(lamp, count, self._seeds[pilot]):
            place = 3 * (min(met, self._apart) - 1)
            _count(self._alike, vertex, power, place, sums, squares)
        self.traced += count
        arrived = (float(squares.sum()) / max(float(sums.sum()), 1e-300)) ** 2  # of an average photon
        area, uncertain = (x.astype(np.float32)[:, None] for x in self._areas)
        mean = self._of_nodes(sums, 1) / area
        variance = (
            self._of_nodes(squares, 2) + np.float32(arrived / 3)
        ) / area / area + uncertain * mean * mean
        closed = ~np.isfinite(area[:, 0])
        mean[closed], variance[closed] = 0, np.inf
        return Estimate(mean, variance)

    def _of_nodes(self, values: Doubles, power: int) -> Floats:
        """Sums (n, k) at nodes of what arrived at vertices, those alike together (g, k), by weights to a power."""
        if self._nodes.weights is None:
            return values.astype(np.float32)[self._alike]
        return multiply_sparse(self._weights[power], values.astype(np.float32))

    @cached_property
    def _weights(self) -> dict[int, scipy.sparse.csr_array]:
        """(n, g) by power: which share of what arrives at vertices, those alike together, goes to nodes; or squared."""
        assert self._nodes.weights is not None
        weights = scipy.sparse.csr_array(self._nodes.weights.T)
        weights.data = np.maximum(weights.data, 0)  # some are extrapolated, by next to nothing
        n = len(self._alike)
        together = scipy.sparse.csr_array((np.ones(n, np.float32), self._alike, np.arange(n + 1)))
        return {power: weights.power(power) @ together for power in (1, 2)}

    @cached_property
    def _areas(self) -> tuple[Doubles, Doubles]:
        """Areas times pi (n,) of the surface on which photons are counted at nodes, and its relative variance.

        A third of the triangles' at each vertex, but where a wall hides corners of a triangle from a part of it, or
        another surface lies on it; infinite if next to nothing is left.
        """
        corners, layers = self._corners, self._layers
        p = self._scene.positions[corners].astype(np.float64)
        areas = np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1) / 2
        whole, tried = (
            np.bincount(corners.ravel(), np.repeat(x / 3, 3), self._scene.n_vertices).astype(np.float64)
            for x in (areas / layers, np.full(len(corners), float(TRIED)))
        )
        arrives = whole.copy()
        for expected, found, area in self._taken_elsewhere(areas):
            for vertex, sign in ((expected, -1), (found, 1)):
                known = vertex != NOTHING
                np.add.at(arrives, vertex[known], sign * area[known])
        together = (np.bincount(self._alike, x).astype(np.float64) for x in (arrives, whole, tried))
        arrives, whole, tried = (self._of_nodes(x[:, None], 1)[:, 0].astype(np.float64) for x in together)
        share = arrives / np.maximum(whole, 1e-300)
        uncertain = np.maximum(1 - share, 0) / np.maximum(share * tried, 1e-30)
        return np.where(share > OPEN, np.pi * arrives, np.inf), uncertain

    @cached_property
    def _corners(self) -> NDArray[np.int64]:
        """Vertices (t, 3) of the triangles of all sheets, fronts first."""
        return np.concatenate([mesh.triangles + mesh.vertices.start for mesh in self._scene.meshes])

    @cached_property
    def _alike(self) -> NDArray[np.int64]:
        """Numbers (n_v,) of vertices, the same of those at one place that face one way.

        At seams they part what arrives. Of walls that have a face each way at the same place, rays meet either.
        """
        normals = np.rint(self._scene.normals / ALIKE)
        return unique_rows(np.column_stack([self._scene.positions, normals]))[1]

    @cached_property
    def _layers(self) -> NDArray[np.int64]:
        """How many triangles lie on each other (t,)."""
        every = unique_rows(np.sort(self._alike[self._corners], axis=1))[1]
        return np.bincount(every)[every]

    def _taken_elsewhere(
        self, areas: Doubles
    ) -> Iterator[tuple[NDArray[np.uint32], NDArray[np.uint32], Doubles]]:
        """Pieces of surface whose photons are not counted at the corner that is to be expected, and where they are.

        But of triangles that lie on each other as wholes: these share what arrives.
        """
        fronts = sum(len(mesh.triangles) for mesh in self._scene.fronts)
        triangles = np.flatnonzero(self._layers[:fronts] == 1).astype(np.uint32)
        for side in (1, -1):
            for a in range(0, len(triangles), LANES // TRIED):
                count = min(LANES // TRIED, len(triangles) - a)
                lane = dr.arange(mi.UInt32, TRIED * count)
                those = mi.UInt32(triangles[a : a + count])
                triangle = dr.gather(mi.UInt32, those, lane // TRIED)
                rng = random_generator(mi.UInt64(triangle), lane % TRIED, mi.UInt32(0), PHOTONS)
                expected, found = self._surfaces.corners_above(triangle, mi.Float(side), rng)
                dr.eval(expected, found)
                index = dr.compress(expected != found)
                if len(index):
                    which, *vertices = (
                        dr.gather(mi.UInt32, x, index).numpy() for x in (triangle, expected, found)
                    )
                    yield (*vertices, areas[which] / TRIED)

    def _arrivals(
        self, lamp: int, count: int, seed: int
    ) -> Iterator[tuple[int, NDArray[np.uint32], NDArray[np.float32]]]:
        """Photons that arrive at vertices: how many surfaces they met before, where, and their power (3, k)."""
        depth = self._problem.max_depth
        for a in range(0, count, LANES):
            photons = self._emitted(lamp, a, min(LANES, count - a), count, seed)
            met = 0
            while True:
                hit = self._scene.normalised.ray_intersect_preliminary(photons.ray)
                si = self._scene.normalised.interaction(hit, photons.ray)
                if met:
                    yield (met, *self._arrived(photons, hit, si))
                if met == depth - 2:
                    break
                photons, alive = self._sent_on(photons, si)
                dr.eval(*photons, alive)
                index = dr.compress(alive)
                if len(index) == 0:
                    break
                photons, met = photons.take(index), met + 1

    def _emitted(self, lamp: int, first: int, count: int, every: int, seed: int) -> _Photons:
        """Photons that leave a lamp."""
        number = dr.arange(mi.UInt32, count) + dr.opaque(mi.UInt32, first)
        element = dr.opaque(mi.UInt32, lamp, count)
        rng = random_generator(mi.UInt64(number), element, mi.UInt32(0), seed)
        u, place, towards = (
            rng.next_float32(),
            *(mi.Point2f(rng.next_float32(), rng.next_float32()) for _ in "at"),
        )
        ray, power = self._problem.emission.emit(element, u, place, towards)
        origin = self._scene.from_world(ray.o)
        # off the lamp's own surface
        ray = mi.Ray3f(dr.fma(ray.d, ray_offset(origin), origin), ray.d)
        # a kernel on a GPU traces rays in one scene only, and lamps with textures may look for places by rays
        dr.eval(ray, power, rng)
        return _Photons(ray, power / dr.opaque(mi.Float, every), rng, dr.zeros(mi.Mask, count))

    def _arrived(
        self, photons: _Photons, hit: mi.PreliminaryIntersection3f, si: mi.SurfaceInteraction3f
    ) -> tuple[NDArray[np.uint32], NDArray[np.float32]]:
        """Vertices (k,) at which photons are counted, and their power (3, k).

        Light at a vertex is irradiance about its shading normal, while surface is met by the cosine at its own.
        """
        vertex = self._surfaces.corner_met(hit, photons.ray, photons.rng.next_float32(), hit.is_valid())
        shaded, own = (dr.abs(dr.dot(n, photons.ray.d)) for n in (si.sh_frame.n, si.n))
        power = photons.power * dr.select(own > 0, shaded / own, 0)
        counts = photons.scattered & (vertex != NOTHING) & (dr.max(power) > 0)
        dr.eval(vertex, power, counts, photons.rng)
        index = dr.compress(counts)
        if len(index) == 0:
            return np.zeros(0, np.uint32), np.zeros((3, 0), np.float32)
        vertex, power = dr.gather(mi.UInt32, vertex, index), dr.gather(mi.Color3f, power, index)
        return vertex.numpy(), power.numpy()

    def _sent_on(self, photons: _Photons, si: mi.SurfaceInteraction3f) -> tuple[_Photons, mi.Mask]:
        """Photons after a surface, and which there still are: by Russian roulette, each keeps about its power."""
        rng, valid = photons.rng, si.is_valid()
        sample, weight = si.bsdf().sample(
            mi.BSDFContext(mi.TransportMode.Importance),
            si,
            rng.next_float32(),
            mi.Point2f(rng.next_float32(), rng.next_float32()),
            valid,
        )
        onwards = si.to_world(sample.wo)
        weight = sample_weight(sample, weight) * _of_shading_normals(si, sample.wo, onwards)
        # without a limit, light between white surfaces would not end
        survival = dr.minimum(dr.max(weight), 1 if self._problem.max_depth >= 0 else SURVIVAL)
        alive = valid & (survival > 0) & (rng.next_float32() < survival)
        power = dr.select(alive, photons.power * weight / survival, 0)
        straight = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
        scattered = photons.scattered | (~straight & ~is_one_of(self._scene.rough_glass, si))
        return _Photons(si.spawn_ray(onwards), power, rng, scattered), alive & (dr.max(power) > 0)


def _of_shading_normals(si: mi.SurfaceInteraction3f, local: mi.Vector3f, onwards: mi.Vector3f) -> mi.Float:
    """What photons that go on count, so that BSDFs about shading normals are the adjoint of paths' (Veach 1997, 5.3.2).

    0 where shading normals would let light leak, as in Mitsuba's ``ptracer``.
    """
    came, goes = dr.dot(si.n, si.to_world(si.wi)), dr.dot(si.n, onwards)
    cosine_in, cosine_out = mi.Frame3f.cos_theta(si.wi), mi.Frame3f.cos_theta(local)
    valid = (came * cosine_in > 0) & (goes * cosine_out > 0)
    return dr.select(valid, dr.abs(cosine_in * goes / (cosine_out * came)), 0)


@numba.njit(nogil=True, cache=True)
def _count(
    alike: NDArray[np.int64],
    vertex: NDArray[np.uint32],
    power: NDArray[np.float32],
    place: int,
    sums: Doubles,
    squares: Doubles,
) -> None:
    """Add up what arrives at vertices, those alike together, in three columns from ``place`` on, and its squares."""
    for i in range(len(vertex)):
        row = alike[vertex[i]]
        for c in range(3):
            own = np.float64(power[c, i])
            sums[row, place + c] += own
            squares[row, place + c] += own * own
