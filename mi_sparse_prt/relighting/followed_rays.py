"""Rays of a camera that go on from the surfaces that they meet, by Mitsuba's own samples of what these scatter.

Mirrors, glass and masks scatter into single directions: of these, rays follow one. Glossy surfaces that no in-out
factors stand for (narrow lobes, BSDFs that vary over the surface, bent normals, rough glass) are followed as a whole:
one random direction, and light of the environment by a shadow ray as well, weighted as in Mitsuba's ``path``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi

from mi_sparse_prt.emission.space import SampledEmission
from mi_sparse_prt.reflection.in_out_factors import InOutFactors
from mi_sparse_prt.reflection.reflection import Reflection
from mi_sparse_prt.scene.materials import sample_weight, single_direction
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.scene.traced_scene import TracedScene

LONGEST = 64  # surfaces that a ray meets, where ``max_depth`` sets no limit
NEAR_LAMP = 1e-3  # of the way to a lamp: what is met there is the lamp itself


class Way(NamedTuple):
    """How a ray came to be.

    Attributes
    ----------
    depth : UInt32
        Surfaces that it met before.
    last : Mask
        None may reflect after these.
    density : Float
        With which its direction was chosen, per solid angle; 0 if it could be no other.
    met : Mask
        It met more than surfaces that it passed straight on.
    told : Mask
        It went on from a surface of which rows tell a part of the light that it finds (``Seen.partly``).
    """

    depth: Any
    last: Any
    density: Any
    met: Any
    told: Any


class Seen(NamedTuple):
    """What a ray meets.

    Attributes
    ----------
    radiance : Color3f
        But for what a surface scatters into directions that are followed.
    si : SurfaceInteraction3f
    whole : Mask
        All that the surface scatters is followed, not only single directions.
    partly : Mask
        So it is, for the sake of a part of the light; rows tell what it scatters of all other.
    """

    radiance: Any
    si: Any
    whole: Any
    partly: Any = False


def surfaces_to_follow(scene: Scene, reflection: Reflection | None = None) -> list[mi.BSDF]:
    """BSDFs of which no row tells all that they reflect: not diffuse, factored, or of single directions alone."""
    found: list[mi.BSDF] = []
    for mesh, material in zip(scene.meshes, scene.materials, strict=True):
        factored = isinstance(reflection, InOutFactors) and reflection.material[mesh.vertices.start] >= 0
        front = scene.materials[mesh.shape].bsdf
        if not (material.known_by_irradiance or factored or any(front is bsdf for bsdf in found)):
            found.append(front)
    return found


@dr.syntax
def follow(
    seen: Callable[[mi.Ray3f, Way, mi.Sampler, mi.Mask], Seen],
    ray: mi.Ray3f,
    sampler: mi.Sampler,
    active: mi.Mask,
    max_depth: int,
    before: mi.UInt32 | int = 0,
) -> tuple[mi.Color3f, mi.Mask]:
    """The radiance of what rays see that go on from surfaces, and whether they meet more than they pass straight on.

    Parameters
    ----------
    seen : callable
    ray : Ray3f, world
    sampler : Sampler
    active : Mask
    max_depth : int
        Surfaces and the light after them, as for ``path``.
    before : UInt32
        Surfaces that count already.
    """
    ray, active = mi.Ray3f(ray), mi.Mask(active)
    total, throughput, density = mi.Color3f(0), mi.Color3f(1), mi.Float(0)
    depth, valid, told = mi.UInt32(before), mi.Mask(False), mi.Mask(False)
    limit = dr.opaque(mi.UInt32, max_depth if 0 <= max_depth < LONGEST else LONGEST)
    active &= depth < limit
    while active:
        way = Way(depth, depth + 1 >= limit, density, valid, told)
        radiance, si, whole, partly = seen(ray, way, sampler, active)
        total += dr.select(active, throughput * radiance, 0)
        active &= si.is_valid()
        sample, weight = _scattered(si, whole | partly, sampler, active)
        valid |= active & ~mi.has_flag(sample.sampled_type, mi.BSDFFlags.Null)
        single = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
        told |= active & partly & ~single
        density = dr.select(single, 0, sample.pdf)
        # roulette: faint light is worth few rays; that it is denser in glass (eta) does not matter
        denser = dr.select(sample.eta > 0, dr.square(sample.eta), 1)
        goes_on = dr.sqrt(dr.minimum(dr.max(weight) * denser, 1))
        active &= (depth + 1 < limit) & (sampler.next_1d(active) < goes_on)
        throughput *= weight / goes_on
        ray = si.spawn_ray(si.to_world(sample.wo))
        depth += 1
    return total, valid


@dr.syntax
def past_lamps(scene: mi.Scene, ray: mi.Ray3f, active: mi.Mask) -> mi.Ray3f:
    """Rays that begin behind all area lamps which they would meet first."""
    ray, on_lamp = mi.Ray3f(ray), mi.Mask(active)
    while on_lamp:
        si = scene.ray_intersect(ray, on_lamp)
        on_lamp &= si.is_valid() & (si.shape.emitter() != None)  # noqa: E711  Dr.Jit compares each
        ray = dr.select(on_lamp, si.spawn_ray(ray.d), ray)
    return ray


def _scattered(
    si: mi.SurfaceInteraction3f, whole: mi.Mask, sampler: mi.Sampler, active: mi.Mask
) -> tuple[mi.BSDFSample3f, mi.Color3f]:
    """A direction that rays go on in, and what it weighs: 0 where there is none."""
    bsdf, u, v = si.bsdf(), sampler.next_1d(active), mi.Point2f(sampler.next_2d(active))
    delta = int(mi.BSDFFlags.Delta)  # Null is among them
    alone = active & ~whole & mi.has_flag(bsdf.flags(), delta)
    sample, weight = single_direction(si, u, v, alone, delta)
    if not (whole.state == dr.VarState.Literal and dr.none(whole)):
        every, its = bsdf.sample(mi.BSDFContext(), si, u, v, active & whole)
        its = sample_weight(every, its)
        sample, weight = dr.select(whole, every, sample), dr.select(active & whole, its, weight)
    return sample, weight


def background_light(background: mi.Emitter, ray: mi.Ray3f, way: Way, active: mi.Mask) -> mi.Color3f:
    """What rays see that leave the scene; a share of it where shadow rays see the same (multiple importance)."""
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wi = -ray.d
    there = dr.zeros(mi.DirectionSample3f)
    there.d = ray.d
    other = background.pdf_direction(si, there, active)
    share = dr.select(way.density > 0, way.density / (way.density + other), 1)
    return dr.select(active, background.eval(si, active) * share, 0)


def reflected_background(
    background: mi.Emitter,
    scene: TracedScene,
    si: mi.SurfaceInteraction3f,
    sampler: mi.Sampler,
    active: mi.Mask,
) -> mi.Color3f:
    """Light of the environment that surfaces reflect, by a shadow ray; the rest of it is found by following them."""
    there, light = background.sample_direction(si, mi.Point2f(sampler.next_2d(active)), active)
    active &= (there.pdf > 0) & ~scene.ray_test(si.spawn_ray(there.d), active)
    value, density = si.bsdf().eval_pdf(mi.BSDFContext(), si, si.to_local(there.d), active)
    share = dr.select(there.delta, 1, there.pdf / (there.pdf + density))
    return dr.select(active, value * light * share, 0)


def reflected_light(
    light: mi.Emitter,
    arrives: Callable[[mi.Ray3f, mi.Mask], mi.Mask],
    si: mi.SurfaceInteraction3f,
    sampler: mi.Sampler,
    active: mi.Mask,
) -> mi.Color3f:
    """All that surfaces reflect of light from infinitely far away, by a shadow ray; none is found by following them.

    ``arrives`` tells which rays nothing is in the way of.
    """
    there, radiance = light.sample_direction(si, mi.Point2f(sampler.next_2d(active)), active)
    active = active & (there.pdf > 0)
    active &= arrives(si.spawn_ray(there.d), active)
    value = si.bsdf().eval(mi.BSDFContext(), si, si.to_local(there.d), active)
    return dr.select(active, value * radiance, 0)


def reflected_lamps(
    lamps: SampledEmission,
    brightness: mi.Color3f,
    scene: TracedScene,
    si: mi.SurfaceInteraction3f,
    sampler: mi.Sampler,
    active: mi.Mask,
) -> mi.Color3f:
    """Light that surfaces reflect of lamps which no ray can meet, points and directions, by a shadow ray.

    It goes to one lamp at random. The others are found by following rays.
    """
    chosen = mi.UInt32(sampler.next_1d(active) * lamps.size)
    element = dr.minimum(chosen, dr.opaque(mi.UInt32, lamps.size - 1))
    towards, irradiance, distance, _ = lamps.sample(element, si.p, mi.Point2f(sampler.next_2d(active)))
    ray = si.spawn_ray(towards)
    met = scene.ray_intersect(ray, active)
    found, _ = lamps.element_of(met, ray, active)
    active &= (found != mi.Int32(element)) & ~(met.t < distance * (1 - NEAR_LAMP))
    value = si.bsdf().eval(mi.BSDFContext(), si, si.to_local(towards), active)
    light = irradiance * dr.gather(mi.Color3f, brightness, element, active) * lamps.size
    return dr.select(active, value * light, 0)
