"""Light of a few columns, such as lamps: their direct light by samples, and what surfaces make of it."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.device_arrays import on_device
from mi_sparse_prt.core.random_keys import element_seeds, random_generator, random_stream
from mi_sparse_prt.emission.space import SampledEmission
from mi_sparse_prt.measurement.point_arrays import PointArrays, start_ray
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.solvers.direct_rays import arriving_share
from mi_sparse_prt.solvers.paths import Estimate, Light, PathSolver, has_mirrors, trace_reflected
from mi_sparse_prt.solvers.problem import Problem

LANES = 1 << 22  # rays per wavefront
SHARED_OUT = 9  # spawn key
DIRECT = 12  # spawn key
SELDOM = (
    0.5  # a cosine-distributed ray counts more than shadow rays of its direction, though these are many more
)
PILOT = 4  # for so many paths, one more tells how many an element needs
# Surfaces before Russian roulette starts. For as much noise as with 5, in five scenes of lamps, 2 take 0.68 to 0.88 of
# the time; in a sixth 1.18, or 0.81 without the noisiest 0.1% of its elements.
ROULETTE = 2
MOST = 256  # times as many paths as others may an element have

Floats = NDArray[np.float32]


class LampRays:
    """Unit-albedo direct light of lamps at points: multiple importance sampling of lamps and of the cosine.

    Parameters
    ----------
    problem : Problem
        Whose emission space is sampled.
    strata : int
        Per axis of a lamp: strata**2 shadow rays per element, each at a random place of its stratum. Besides,
        ``strata`` cosine-distributed rays look for lamps that are near; as many others count, strata**2 where one is.
    seed : int

    Attributes
    ----------
    rays : int
        That were traced.
    """

    def __init__(self, problem: Problem, strata: int = 16, seed: int = 0) -> None:
        self._emission: SampledEmission = problem.emission
        self._scene, self._strata, self._seed = problem.scene, strata, seed
        self._max_depth, self.rays = problem.max_depth, 0
        self._points = PointArrays(problem.points)

    def elements(
        self, point_ids: NDArray[np.integer], columns: NDArray[np.integer], seed: int | None = None
    ) -> Estimate:
        """Irradiance / pi of listed elements: mean (m, 3) and the variance of that mean, strata left out of account."""
        n, stream = len(point_ids), random_stream(self._seed if seed is None else seed, DIRECT)
        looking, *seeds = element_seeds(stream, 3)
        mean, variance = np.zeros((n, 3), np.float32), np.zeros((n, 3), np.float32)
        counts = self._cosine_ray_counts(point_ids, columns, looking)
        for count in np.unique(counts).tolist():
            those, size = np.flatnonzero(counts == count), max(1, LANES // (self._strata**2 + count))
            for a in range(0, len(those), size):
                some = those[a : a + size]
                asked = on_device(mi.UInt32, point_ids[some]), on_device(mi.UInt32, columns[some])
                kinds = [(self._shadow_rays, self._strata**2), (self._cosine_rays, count)]
                self.rays += len(some) * (self._strata**2 + count)
                for (samples, rays), own in zip(kinds[: 2 if count else 1], seeds, strict=False):
                    found = _moments(samples(*asked, count, own), rays)
                    mean[some] += found.mean[:, :3]
                    variance[some] += found.variance[:, :3]
        return Estimate(mean, variance)

    def _cosine_ray_counts(
        self, point_ids: NDArray[np.integer], columns: NDArray[np.integer], seed: int
    ) -> NDArray[np.int64]:
        """Cosine-distributed rays of each element (m,): many where shadow rays alone would be noisy, if any."""
        if len(self._emission.unmet) == self._emission.size:
            return np.zeros(len(point_ids), np.int64)
        counts, size = np.full(len(point_ids), self._strata), LANES // self._strata
        self.rays += int(counts.sum())
        for a in range(0, len(counts), size):
            part = slice(a, a + size)
            asked = on_device(mi.UInt32, point_ids[part]), on_device(mi.UInt32, columns[part])
            found = _moments(self._cosine_rays(*asked, self._strata, seed), self._strata)
            seldom, whole = found.mean[:, 3:].T
            # more noise would be left in it than in what shadow rays find
            counts[part][seldom * self._strata > whole] = self._strata**2
        return counts

    def rows(self, point_ids: NDArray[np.integer]) -> Floats:
        """Whole rows (k, size, 3)."""
        m = self._emission.size
        found = self.elements(np.repeat(point_ids, m), np.tile(np.arange(m), len(point_ids)))
        return found.mean.reshape(len(point_ids), m, 3)

    def _shadow_rays(self, points: mi.UInt32, lamps: mi.UInt32, others: int, seed: int) -> list[mi.Float]:
        """One value per channel and ray, rays of an element side by side; it has so many cosine-distributed others."""
        point, lamp, stratum, rng = self._lanes(points, lamps, self._strata**2, seed)
        row = stratum // self._strata
        uv = mi.Point2f(
            (mi.Float(stratum - row * self._strata) + rng.next_float32()) / self._strata,
            (mi.Float(row) + rng.next_float32()) / self._strata,
        )
        origin = self._origin(point)
        direction, irradiance, distance, density = self._emission.sample(
            lamp, self._scene.to_world(origin), uv
        )
        cosine = dr.dot(self._points.normal(point), direction)
        lit = (cosine > 0) & (dr.max(irradiance) > 0)
        lamp_at = origin + direction * (distance * self._scene.scale)
        ray = ray_to(start_ray(self._points, point, direction), lamp_at)
        value = dr.select(lit, irradiance * (cosine * dr.inv_pi), 0) * self._arriving(ray, lamp_at, lit)
        value *= dr.select(density > 0, 1 - self._cosine_weight(cosine, density, others), 1)
        return [value.x, value.y, value.z]

    @dr.syntax
    def _cosine_rays(self, points: mi.UInt32, lamps: mi.UInt32, rays: int, seed: int) -> list[mi.Float]:
        """The same by cosine-distributed rays: next to a lamp a few places of it send nearly all light.

        Two more values tell how bright the light is that shadow rays would seldom find, and all of it.
        """
        point, lamp, stratum, rng = self._lanes(points, lamps, rays, seed)
        across = (mi.Float(stratum) + rng.next_float32()) / dr.opaque(mi.Float, rays)
        local = mi.warp.square_to_cosine_hemisphere(mi.Point2f(across, rng.next_float32()))
        ray = start_ray(self._points, point, mi.Frame3f(self._points.normal(point)).to_world(local))
        scene, emission = self._scene.unsplit, self._emission
        value, share, left, active = mi.Color3f(0), mi.Color3f(1), self._passable(), mi.Mask(True)
        whole, seldom = mi.Float(0), mi.Float(0)
        while active:
            si = scene.ray_intersect(ray, active)
            there, from_world = in_world(self._scene, si, ray, active)
            met, radiance = emission.element_of(there, from_world, active)
            from_world.o = self._scene.to_world(self._origin(point))
            found = active & (met == mi.Int32(lamp))
            density = emission.density(there, from_world, found)
            part = dr.select(found & (density > 0), self._cosine_weight(local.z, density, rays), 0)
            value += dr.select(part > 0, share * radiance * part, 0)
            bright = dr.select(found, dr.max(share * radiance), 0)
            whole += bright
            seldom += dr.select(part > SELDOM, bright, 0)
            active &= si.is_valid() & (left > 0)
            active &= mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.Null)
            share *= dr.select(active, mi.Color3f(si.bsdf().eval_null_transmission(si, active)), 1)
            active &= dr.max(share) > 0
            left -= 1
            ray = si.spawn_ray(ray.d)
        return [value.x, value.y, value.z, seldom, whole]

    def _origin(self, point: mi.UInt32) -> mi.Point3f:
        """Where rays above the surface begin: next to a lamp, densities of both kinds agree for the same place only."""
        return start_ray(self._points, point, mi.Vector3f(self._points.normal(point))).o

    def _lanes(
        self, points: mi.UInt32, lamps: mi.UInt32, rays: int, seed: int
    ) -> tuple[mi.UInt32, mi.UInt32, mi.UInt32, mi.PCG32]:
        """The point, the lamp and the stratum of each ray, and its random numbers."""
        lane, each = dr.arange(mi.UInt32, len(points) * rays), dr.opaque(mi.UInt32, rays)
        element = lane // each
        stratum = lane - element * each
        point, lamp = dr.gather(mi.UInt32, points, element), dr.gather(mi.UInt32, lamps, element)
        return point, lamp, stratum, random_generator(self._points.key(point), lamp, stratum, seed)

    def _cosine_weight(self, cosine: mi.Float, density: mi.Float, rays: int) -> mi.Float:
        """How much a direction counts among cosine-distributed rays.

        By the power heuristic (Veach 1997, 9.2.4): shadow rays are stratified better, and tell nearly all where they
        are many.
        """
        own = dr.maximum(cosine, 0) * (dr.opaque(mi.Float, rays) * dr.inv_pi)
        return own**2 / (own**2 + (self._strata**2 * density) ** 2)

    def _passable(self) -> mi.UInt32:
        """Surfaces that light may pass."""
        return dr.opaque(mi.UInt32, self._max_depth - 2 if self._max_depth >= 0 else 1 << 30)

    def _arriving(self, ray: mi.Ray3f, lamp_at: mi.Point3f, active: mi.Mask) -> mi.Color3f:
        """The share of light that arrives along shadow rays: what masks, thin panes and ``null`` let through counts."""
        scene, onwards = self._scene, lambda si: ray_to(si.spawn_ray(ray.d), lamp_at)
        return arriving_share(scene.unsplit, ray, active, scene.passes_straight, self._passable(), onwards)[0]


def _moments(samples: list[mi.Float], count: int) -> Estimate:
    """Means (m, 3) of so many samples each, side by side, and the variance of these means."""
    powers = [x * x for x in samples]
    dr.eval(samples, powers)
    mean, squares = (
        np.stack([dr.block_reduce(dr.ReduceOp.Add, x, count).numpy() for x in xs], axis=1) / count
        for xs in (samples, powers)
    )
    variance = np.maximum(squares - mean**2, 0) / max(count - 1, 1)
    return Estimate(mean.astype(np.float32), variance.astype(np.float32))


class LampPaths(PathSolver):
    """Indirect light of lamps at points, by path tracing: elements (m, 3), times 1 rather than per solid angle.

    What comes by way of mirrors and glass alone is not part of it (``solvers.specular``).

    Parameters
    ----------
    problem : Problem
        Whose emission space is sampled.
    spp, seed : int
        As for ``PathSolver``.
    apart : int
        Of light that met 1, 2, ... surfaces, so many numbers: three channels of each, (m, 3 * apart).
    """

    def __init__(self, problem: Problem, spp: int = 64, seed: int = 0, apart: int = 1) -> None:
        self.problem, self.scene, self.points = problem, problem.scene.unsplit, problem.points
        self.spp, self.seed = spp, seed
        self.max_depth, self.channels, self._apart = problem.max_depth, 3 * apart, apart
        self._world, self._emission = problem.scene, problem.emission
        self._points = PointArrays(problem.points)

    def _radiance(self, ray: mi.Ray3f, texel: mi.UInt32, rng: mi.PCG32) -> list[mi.Float]:
        bounces = dr.opaque(mi.UInt32, self.max_depth - 2 if self.max_depth >= 0 else 1 << 31)

        def sample(si: mi.SurfaceInteraction3f, rng: mi.PCG32) -> tuple[Any, Any, Any, Any]:
            uv = mi.Point2f(rng.next_float32(), rng.next_float32())
            direction, irradiance, distance, density = self._emission.sample(
                texel, self._world.to_world(si.p), uv
            )
            return direction, irradiance, distance * self._world.scale, density

        def met(si: mi.SurfaceInteraction3f, ray: mi.Ray3f, active: mi.Mask) -> tuple[mi.Color3f, mi.Float]:
            there, from_world = in_world(self._world, si, ray, active)
            lamp, radiance = self._emission.element_of(there, from_world, active)
            found = active & (lamp == mi.Int32(texel))
            return dr.select(found, radiance, 0), self._emission.density(there, from_world, found)

        light = Light(sample, scattered=True, rough_glass=self._world.rough_glass, roulette=ROULETTE)
        if has_mirrors(self.scene) or len(self._emission.unmet) < self._emission.size:
            light.met = met
        found = trace_reflected(self.scene, ray, light, rng, bounces, self._apart)
        return [channel for colour in found for channel in colour]


class LightByPaths:
    """Indirect light of listed elements of lamps by some paths of each, and by more of those whose paths spread.

    A few paths more tell how far those of an element spread, and half as many as all are shared out in proportion to
    that (Neyman 1934): near a lamp, a few elements have most of the noise.

    Parameters
    ----------
    problem : Problem
        With lamps.
    point_ids, columns : (m,) integers
    spp : int
        Paths of an element, at least.
    seed : int
    apart : int
        As of ``LampPaths``: estimates are (m, 3 * apart).
    few : int, optional
        The first paths of an element, in place of a quarter of ``spp``.

    Attributes
    ----------
    traced : int
        Paths so far.
    """

    def __init__(
        self,
        problem: Problem,
        point_ids: NDArray[np.integer],
        columns: NDArray[np.integer],
        spp: int,
        seed: int,
        apart: int = 1,
        few: int | None = None,
    ) -> None:
        self._problem, self._asked, self._spp, self._apart = problem, (point_ids, columns), spp, apart
        self._few = spp // PILOT if few is None else few
        self._pilot, self._main = element_seeds(random_stream(seed, SHARED_OUT), 2)
        self.traced = 0

    @cached_property
    def first(self) -> Estimate | None:
        """By few paths of all elements; None where one alone would not tell how far they spread."""
        if self._few < 2:
            return None
        paths = LampPaths(self._problem, self._few, self._pilot, self._apart)
        self.traced += len(self._asked[0]) * paths.spp
        return paths.elements(*self._asked)

    def estimate(
        self, least: NDArray[np.int64] | None = None, ticks: Callable[[int], None] = lambda _: None
    ) -> Estimate:
        """What paths find; it does not depend on the first ones, but for elements of which these are enough.

        Parameters
        ----------
        least : (m,) int64, optional
            Paths of each element in place of ``spp``, at least; 0 where the first ones are enough.
        ticks : callable, optional
            Is told of elements that are done.
        """
        shape = len(self._asked[0]), 3 * self._apart
        found = Estimate(np.zeros(shape, np.float32), np.zeros(shape, np.float32))
        counts = np.full(shape[0], self._spp) if least is None else least
        if self.first is not None:
            enough, counts = counts == 0, self._shared_out(self.first, counts)
            found.mean[enough], found.variance[enough] = self.first.mean[enough], self.first.variance[enough]
            ticks(int(enough.sum()))
        self.traced += int(counts.sum())
        for count in np.unique(counts[counts > 0]):
            those = np.flatnonzero(counts == count)
            paths = LampPaths(self._problem, int(count), self._main, self._apart)
            for a in range(0, len(those), paths.block_elements):
                some = those[a : a + paths.block_elements]
                points, columns = (ids[some] for ids in self._asked)
                block = paths.elements(points, columns)
                found.mean[some], found.variance[some] = block.mean, block.variance
                ticks(len(some))
        return found

    def _shared_out(self, first: Estimate, least: NDArray[np.int64]) -> NDArray[np.int64]:
        """Paths of each element (m,), none where none are asked for."""
        counts, more, seen = least.copy(), np.flatnonzero(least), self._few
        if len(more):
            albedo = np.tile(self._problem.reflection.albedo[self._asked[0][more]], self._apart)
            spread = seen * (np.square(albedo.astype(np.float64)) * first.variance[more]).sum(axis=1)
            counts[more] = shared_out(spread, seen, least[more])
        return counts


def shared_out(squares: NDArray[np.float64], seen: int, least: int | NDArray[np.int64]) -> NDArray[np.int64]:
    """How many paths each element gets: the least by powers of two, half as many more in all, about.

    Parameters
    ----------
    squares : (m,) float64
        Variance of an element's paths, as ``seen`` of them show it. It is taken as if one more had been seen, of an
        average element: light that is found seldom is not found by few.
    seen : int
    least : int or (m,) int64
    """
    spread = np.sqrt((seen * squares + squares.mean()) / (seen + 1))
    share = spread / max(spread.mean(), 1e-300) / 2
    return least * 2 ** np.rint(np.log2(1 + np.minimum(share, MOST))).astype(np.int64)


def lamp_met(
    problem: Problem, si: mi.SurfaceInteraction3f, ray: mi.Ray3f, active: mi.Mask
) -> tuple[mi.Int32, mi.Color3f]:
    """The lamp at what rays meet (both of the normalised frame), -1 for none, and its radiance."""
    return problem.emission.element_of(*in_world(problem.scene, si, ray, active), active)


def in_world(
    scene: Scene, si: mi.SurfaceInteraction3f, ray: mi.Ray3f, active: mi.Mask
) -> tuple[mi.SurfaceInteraction3f, mi.Ray3f]:
    """What rays of the normalised frame meet, and these rays, in world space."""
    there = mi.SurfaceInteraction3f(si)
    there.p, there.shape = scene.to_world(si.p), scene.shape_in_world(si.shape, active & si.is_valid())
    return there, mi.Ray3f(scene.to_world(ray.o), ray.d)


def lamp_asked(
    problem: Problem, si: mi.SurfaceInteraction3f, rng: mi.PCG32, active: mi.Mask
) -> tuple[mi.UInt32, mi.Vector3f, mi.Color3f]:
    """A lamp at random of those that no ray can meet, asked by a shadow ray from surfaces (normalised frame).

    Its column, the direction, and its irradiance at right angles to that, as if it was all of them; 0 where it is
    hidden, or of another kind in the same column.
    """
    lamps, scene = problem.emission, problem.scene
    unmet = mi.UInt32(lamps.unmet.astype(np.uint32))
    count = dr.opaque(mi.UInt32, len(unmet))
    place = dr.minimum(mi.UInt32(rng.next_float32() * mi.Float(count)), count - 1)
    lamp = dr.gather(mi.UInt32, unmet, place, active)
    uv = mi.Point2f(rng.next_float32(), rng.next_float32())
    towards, irradiance, distance, _ = lamps.sample(lamp, scene.to_world(si.p), uv)
    lit = active & ~scene.unsplit.ray_test(si.spawn_ray_to(si.p + towards * (distance * scene.scale)), active)
    ray = si.spawn_ray(towards)
    met, _ = lamp_met(problem, scene.unsplit.ray_intersect(ray, lit), ray, lit)
    return lamp, towards, dr.select(lit & (met != mi.Int32(lamp)), irradiance * mi.Float(count), 0)


def ray_to(ray: mi.Ray3f, place: mi.Point3f) -> mi.Ray3f:
    """A shadow ray from the origin of another nearly to a place, as Mitsuba's ``Interaction.spawn_ray_to``.

    The origin is off its surface. A ray of the length that was measured from the surface would end inside of a lamp
    that is near.
    """
    towards = place - ray.o
    distance = dr.norm(towards)
    return mi.Ray3f(
        ray.o, towards / distance, distance * (1 - mi.math.ShadowEpsilon), ray.time, ray.wavelengths
    )
