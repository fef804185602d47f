"""S_i by path tracing: interreflected light, one independent estimate per element ([Leh07] eq. 12 with T - V apart).

Every element is a small Monte Carlo problem of its own: paths start at its point, and each surface they meet is lit
by its texel through one shadow ray. Nothing about the surfaces is assumed; they are asked through Mitsuba's BSDF
interface. The estimates of different elements are independent, which later statistics rely on.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.device_arrays import on_device
from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.core.random_keys import random_generator
from mi_sparse_prt.emission.texel_arrays import TexelArrays
from mi_sparse_prt.measurement.point_arrays import PointArrays, start_ray
from mi_sparse_prt.scene.materials import is_one_of, sample_weight
from mi_sparse_prt.scene.traced_scene import TracedScene
from mi_sparse_prt.solvers.direct_rays import arriving_share
from mi_sparse_prt.solvers.problem import Problem

LANES = 1 << 22  # paths per wavefront, about half a second each
ROULETTE_DEPTH = 5  # bounces before Russian roulette starts, as Mitsuba's ``path`` has it


@dataclass(frozen=True)
class Estimate:
    """Mean of an element's samples, and the variance of that mean, each (n, channels) float32."""

    mean: NDArray[np.float32]
    variance: NDArray[np.float32]


class PathSolver:
    """Indirect light at points of a scene, one element per point and texel.

    Parameters
    ----------
    problem : Problem
        Light from a texel's centre alone, or radiance 1 over the whole texel, by its basis.
    spp : int
        Paths per element.
    seed : int
    """

    def __init__(self, problem: Problem, spp: int = 16, seed: int = 0) -> None:
        self.problem, self.scene = problem, problem.scene.unsplit
        self.lighting, self.points = problem.emission, problem.points
        self.basis, self.max_depth, self.channels = problem.basis, problem.max_depth, problem.channels
        self.spp, self.seed = spp, seed
        self._points, self._texels = PointArrays(self.points), TexelArrays(self.lighting)

    @property
    def block_elements(self) -> int:
        """Elements whose paths fill one wavefront."""
        return max(1, LANES // self.spp)

    @property
    def block_size(self) -> int:
        """Rows whose paths fill one wavefront."""
        return max(1, self.block_elements // self.lighting.n_directions)

    def any_hit(self, rays_per_point: int) -> bool:
        """Whether any of a few cosine-distributed rays per point meets a surface; often the first ones tell."""
        for a, b in ((0, 1), (1, rays_per_point)):
            lane = dr.arange(mi.UInt32, len(self.points) * (b - a))
            point = lane // (b - a)
            sample = lane - point * (b - a) + a
            rng = random_generator(self._points.key(point), mi.UInt32(0), sample, self.seed)
            if dr.any(self.scene.ray_test(self._first_ray(point, rng))):
                return True
        return False

    def rows(self, point_ids: NDArray[np.integer]) -> Estimate:
        """Whole rows: mean and variance (len(point_ids), n_directions, channels), see ``elements``."""
        shape = (len(point_ids), self.lighting.n_directions, self.channels)
        points = np.repeat(np.asarray(point_ids, dtype=np.uint32), self.lighting.n_directions)
        texels = np.tile(np.arange(self.lighting.n_directions, dtype=np.uint32), len(point_ids))
        estimate = self.elements(points, texels)
        return Estimate(estimate.mean.reshape(shape), estimate.variance.reshape(shape))

    def elements(
        self,
        point_ids: NDArray[np.integer],
        texel_ids: NDArray[np.integer],
        seed: int | None = None,
    ) -> Estimate:
        """Unit-albedo indirect transport of listed elements per solid angle: the T of albedo 1, divided by d_omega.

        Parameters
        ----------
        point_ids, texel_ids : (n,) integers
            Neighbouring elements should share the point: their rays are then coherent.
        seed : int, optional
            Another seed than the solver's gives independent estimates.

        Returns
        -------
        Estimate
            ``mean`` (n, channels) in 1/sr, and the variance of that mean.

        Raises
        ------
        PrtError
            If a BSDF gives a value that is not finite, naming the first point and texel whose paths find it.
        """
        mean = np.zeros((len(point_ids), self.channels), dtype=np.float32)
        variance = np.zeros_like(mean)
        seed = self.seed if seed is None else seed
        size = self.block_elements
        for a in range(0, len(point_ids), size):
            part = slice(a, a + size)
            points, texels = (on_device(mi.UInt32, ids[part]) for ids in (point_ids, texel_ids))
            block = self._estimate(points, texels, seed)
            mean[part], variance[part] = block.mean, block.variance
        return Estimate(mean, variance)

    def _estimate(self, points: mi.UInt32, texels: mi.UInt32, seed: int) -> Estimate:
        lane = dr.arange(mi.UInt32, len(points) * self.spp)
        spp = dr.opaque(mi.UInt32, self.spp)  # one kernel for all numbers
        element = lane // spp
        point, texel = dr.gather(mi.UInt32, points, element), dr.gather(mi.UInt32, texels, element)
        rng = random_generator(self._points.key(point), texel, lane - element * spp, seed)
        ray = self._first_ray(point, rng)
        samples = self._weighted(point, ray.d, self._radiance(ray, texel, rng))
        powers = [x * x for x in samples]
        dr.eval(samples, powers)  # in one kernel
        sums, squares = (
            [dr.block_reduce(dr.ReduceOp.Add, x, self.spp) for x in xs] for xs in (samples, powers)
        )
        mean = np.stack([x.numpy() for x in sums], axis=-1) / self.spp
        second = np.stack([x.numpy() for x in squares], axis=-1) / self.spp
        self._check_finite(np.isfinite(mean) & np.isfinite(second), points, texels)
        variance = np.maximum(second - mean**2, 0) / max(self.spp - 1, 1)
        return Estimate(mean.astype(np.float32), variance.astype(np.float32))

    def _check_finite(self, finite: NDArray[np.bool_], points: mi.UInt32, texels: mi.UInt32) -> None:
        """Refuse a block of elements (n, channels) of which one is not finite, naming the first."""
        bad = np.flatnonzero(~finite.all(axis=1))
        if not len(bad):
            return
        point, texel = int(points.numpy()[bad[0]]), int(texels.numpy()[bad[0]])
        direction = np.round(self.lighting.directions[texel].astype(float), 4).tolist()
        raise PrtError(
            f"vertex {point} gets indirect light that is not finite from texel {texel}, direction {direction} "
            f"({len(bad)} such elements): repair the BSDF or texture of a surface that it sees"
        )

    def _first_ray(self, point: mi.UInt32, rng: mi.PCG32) -> mi.Ray3f:
        """Cosine-distributed about the shading normal."""
        local = mi.warp.square_to_cosine_hemisphere(mi.Point2f(rng.next_float32(), rng.next_float32()))
        return start_ray(self._points, point, mi.Frame3f(self._points.normal(point)).to_world(local))

    def _weighted(self, point: mi.UInt32, direction: mi.Vector3f, radiance: list[mi.Float]) -> list[mi.Float]:
        """One sample per channel of (1/pi) times the irradiance at points, by the radiance that their first rays find.

        These are cosine-distributed, which makes it the mean of that radiance, wherever they go.
        """
        return radiance[: self.channels]

    def _radiance(self, ray: mi.Ray3f, texel: mi.UInt32, rng: mi.PCG32) -> list[mi.Float]:
        """One sample of the radiance that first rays find on other surfaces, per d_omega, one for each channel."""
        bounces = dr.opaque(mi.UInt32, self.max_depth - 2 if self.max_depth >= 0 else 1 << 31)
        apart = self.problem.specular_apart
        if self.basis == "direction" and not apart:
            light = Light(distant(self._texels.centre(texel), mi.Float(1)))
            return list(trace_reflected(self.scene, ray, light, rng, bounces)[0])
        # Radiance 1 over the texel: each path sees its own direction in it, weighted to 1 on average.
        mean = self._texels.solid_angle(texel)
        if self.basis == "direction":
            shadow = distant(self._texels.centre(texel), mi.Float(1))
        else:
            direction, solid_angle = self._texels.inside(texel, rng.next_float32(), rng.next_float32())
            shadow = distant(direction, solid_angle / mean)
        light = Light(shadow)
        if has_mirrors(self.scene) or apart:
            inside = lambda d: self._texels.contains(texel, d)  # noqa: E731
            light = Light(
                shadow,
                inside,
                1 / mean,
                apart,
                self.problem.scene.rough_glass,
                passes=self.problem.scene.passes_straight,
            )
        return list(trace_reflected(self.scene, ray, light, rng, bounces)[0])


@dataclass
class Light:
    """The light of one element, as surfaces on the way of a path receive it.

    Attributes
    ----------
    sample : callable
        Of an interaction (its ``p`` in the frame of the scene) and the random numbers of a path: a direction, the
        irradiance at right angles to it, how far the light is, None if it is not near, and the density of the sample
        per solid angle, 0 if no ray can meet it.
    contains : callable, optional
        A shadow ray cannot find a light through a mirror. Where there are mirrors and the light has an extent, paths
        that leave the scene right after one collect ``radiance`` if they leave towards the light.
    radiance : Float, optional
    scattered : bool
        Only paths collect it that another surface has scattered on the way, and not by mirrors and glass alone.
    rough_glass : sequence of mi.BSDF
        These are glass as well, then.
    met : callable, optional
        Of lamps, in place of ``contains``: the radiance that rays meet, and the density with which ``sample`` finds it.
        Both estimates count, by the balance heuristic of multiple importance sampling.
    passes : bool
        Of light with ``contains``: shadow rays tell what masks, panes and ``null`` let through straight on, and paths
        that have met no other mirrors and glass do not. ``path`` finds it by such paths alone, which seldom leave the
        scene towards one texel.
    """

    sample: Callable[[Any, Any], tuple[Any, Any, Any, Any]]
    contains: Callable[[mi.Vector3f], mi.Mask] | None = None
    radiance: mi.Float | None = None
    scattered: bool = False
    rough_glass: Sequence[mi.BSDF] = ()
    met: Callable[[mi.SurfaceInteraction3f, mi.Ray3f, mi.Mask], tuple[mi.Color3f, mi.Float]] | None = None
    passes: bool = False
    roulette: int = ROULETTE_DEPTH


def distant(direction: mi.Vector3f, irradiance: mi.Float) -> Callable[[Any, Any], tuple[Any, Any, Any, Any]]:
    """The same direction everywhere."""
    return lambda si, rng: (direction, irradiance, None, mi.Float(0))


def has_mirrors(scene: mi.Scene | TracedScene) -> bool:
    """Whether any surface scatters into single directions."""
    return any(mi.has_flag(shape.bsdf().flags(), mi.BSDFFlags.Delta) for shape in scene.shapes())


@dr.syntax
def trace_reflected(
    scene: mi.Scene | TracedScene,
    ray: mi.Ray3f,
    light: Light,
    rng: mi.PCG32,
    bounces: mi.UInt32,
    apart: int = 1,
) -> list[mi.Color3f]:
    """Radiance along a ray from the surfaces of a scene under one light, direct light on the ray itself left out.

    Follows Mitsuba's ``path``: at each surface one shadow ray, then a BSDF sample; ``bounces`` surfaces at most. Of
    light that met 1, 2, ... surfaces, ``apart`` numbers; that which met more belongs to the last.
    """
    context = mi.BSDFContext()
    ray = mi.Ray3f(ray)
    result, throughput = [mi.Color3f(0) for _ in range(apart)], mi.Color3f(1)
    depth = mi.UInt32(0)
    mirrored, counts, density = mi.Mask(False), mi.Mask(not light.scattered), mi.Float(0)
    # by mirrors or glass, since the last surface that scattered; before the first one no shadow ray tells what passes
    bent = mi.Mask(not light.scattered)
    active = mi.Mask(depth < bounces)
    while active:
        si = scene.ray_intersect(ray, active)
        if light.contains is not None:
            escaped = active & mirrored & counts & ~si.is_valid() & (bent | mi.Mask(not light.passes))
            found = dr.select(escaped & light.contains(ray.d), throughput * light.radiance, 0)
            result = added(result, depth, found)
        if light.met is not None:
            meets = active & counts & (depth > 0)
            radiance, sampled = light.met(si, ray, meets)
            share = dr.select(mirrored | (sampled == 0), 1, density / (density + sampled))
            found = dr.select(meets & ~dr.all(radiance == 0), throughput * radiance * share, 0)
            result = added(result, depth, found)
        active &= si.is_valid() & (depth < bounces)

        # Light, from one direction
        towards, irradiance, reach, chance = light.sample(si, rng)
        bsdf = si.bsdf(ray)
        u, v = rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32())
        value, other, sample, weight = bsdf.eval_pdf_sample(context, si, si.to_local(towards), u, v, active)
        # NaN is lit, so that it is noticed, and what factored BSDFs make negative
        rough = is_one_of(light.rough_glass, si)
        lit = active & ~dr.all(value == 0) & (counts | ~rough)
        shadow = si.spawn_ray(towards) if reach is None else si.spawn_ray_to(si.p + towards * reach)
        onwards = lambda there, towards=towards: there.spawn_ray(towards)  # noqa: E731
        arrives, passed = arriving_share(scene, shadow, lit, light.passes, bounces - depth - 1, onwards)
        lit &= dr.max(arrives) > 0
        if light.met is not None:
            irradiance *= dr.select(chance > 0, chance / (chance + other), 1)
        found = dr.select(lit, throughput * value * arrives * irradiance, 0)
        result = added(result, depth + 1 + passed, found)

        # Next surface
        depth += 1
        throughput *= sample_weight(sample, weight)
        ray = si.spawn_ray(si.to_world(sample.wo))
        mirrored, density = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta), sample.pdf
        bent = mirrored & (bent | ~mi.has_flag(sample.sampled_type, mi.BSDFFlags.Null))
        counts |= ~mirrored & ~rough
        active &= ~dr.all(throughput == 0)  # and not any(... != 0), which is false for NaN here
        if light.contains is None and light.met is None:
            active &= depth < bounces
        else:  # one more ray, or one after the last mirror, to see the light itself
            active &= (depth < bounces) | (mirrored | mi.Mask(light.met is not None)) & (depth == bounces)

        # Russian roulette
        survival = dr.select(depth >= light.roulette, dr.minimum(dr.max(dr.abs(throughput)), 0.95), 1)
        active &= rng.next_float32() < survival
        throughput /= survival
    return result


def added(result: list[mi.Color3f], met: mi.UInt32, light: mi.Color3f) -> list[mi.Color3f]:
    """Light that met 1, 2, ... surfaces, and more of it that met some number."""
    last = len(result)
    if last == 1:
        return [result[0] + light]
    return [
        whole + dr.select((met == k) if k < last else (met >= k), light, 0)
        for k, whole in enumerate(result, 1)
    ]
