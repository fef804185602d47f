"""Light that surfaces reflect as points on these: particles from emitters ([HPB07] 4; Keller 1997)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_sparse_prt.manylights.light_arrays import COSINE, SURFACE, LightArrays, no_lights
from mi_sparse_prt.manylights.surfaces import Surfaces, diffuse_value
from mi_sparse_prt.scene.materials import sample_weight
from mi_sparse_prt.solvers.paths import ROULETTE_DEPTH

LONGEST = 256  # surfaces that a particle meets, where ``max_depth`` sets no limit
LEAST_COSINE = 1e-3  # of shading normals, which a particle's flux is divided by


@dataclass
class Landed:
    """Where particles landed, an array for each attribute (Dr.Jit): world, flux in RGB; numbers of particles."""

    si: Any
    flux: Any
    depth: Any
    emitter: Any
    particle: Any


Emit = Callable[[mi.UInt32], tuple[mi.Ray3f, mi.Color3f, mi.UInt32, mi.PCG32]]


def trace_particles(scene: mi.Scene, emit: Emit, count: int, max_depth: int) -> list[Landed]:
    """Follow particles from emitters; each surface that is met and not only specular keeps a record.

    Whether a particle goes on is decided by how much of its flux the surface reflects (Russian roulette), so that all
    records have about the same flux.

    Parameters
    ----------
    scene : mi.Scene
    emit : callable
        Of particles' numbers: rays, their flux, the numbers of their emitters, and random numbers.
    count : int
        Particles.
    max_depth : int
        As ``path`` counts; 3 is one reflection.

    Returns
    -------
    list of Landed
        One for each number of surfaces met, from 1.
    """
    particle = dr.arange(mi.UInt32, count)
    ray, flux, emitter, rng = emit(particle)
    context = mi.BSDFContext(mi.TransportMode.Importance)
    found, last = [], max_depth - 2 if max_depth >= 0 else LONGEST
    dr.eval(ray, flux, emitter, rng)
    for depth in range(1, last + 1):
        si = scene.ray_intersect(ray)
        alive = si.is_valid() & (dr.max(flux) > 0)
        bsdf = si.bsdf(ray)
        lands = alive & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        sample, weight = bsdf.sample(context, si, rng.next_float32(), next_2d(rng), alive)
        out = si.to_world(sample.wo)
        after = flux * sample_weight(sample, weight) * _adjoint(si, ray.d, out)
        before = dr.max(flux)
        survival = dr.minimum(
            dr.max(after) / dr.maximum(before, 1e-30), 1 if depth < ROULETTE_DEPTH else 0.95
        )
        goes_on = alive & (rng.next_float32() < survival)
        after = dr.select(goes_on, after / dr.maximum(survival, 1e-30), 0)
        edges = dr.full(mi.UInt32, depth + 2, dr.width(flux))
        record = Landed(si, mi.Color3f(flux), edges, emitter, particle)
        ray = si.spawn_ray(out)
        dr.eval(record, lands, goes_on, after, ray, rng, emitter)
        if len(here := dr.compress(lands)):
            found.append(dr.gather(Landed, record, here))
            dr.eval(found[-1])
        index = dr.compress(goes_on)
        if not len(index):
            break
        carried = ray, after, rng, emitter, particle
        ray, flux, rng, emitter, particle = (dr.gather(type(x), x, index) for x in carried)
    return found


def reflected_lights(
    landed: Landed, surfaces: Surfaces
) -> tuple[LightArrays, mi.SurfaceInteraction3f | None]:
    """What surfaces reflect of particles, as lights; with the interactions of those whose BSDF has to be asked.

    Diffuse surfaces reflect by the cosine: their albedo is looked up now, and never again.
    """
    si, count = landed.si, dr.width(landed.flux)
    incident = si.to_world(si.wi)
    geometric = dr.abs(dr.dot(si.n, incident))
    flux = landed.flux * (dr.abs(mi.Frame3f.cos_theta(si.wi)) / dr.maximum(geometric, LEAST_COSINE))
    lambertian = surfaces.lambertian(si)
    value = diffuse_value(si, lambertian)
    lights = no_lights(count)
    lights.kind = dr.select(lambertian, mi.UInt32(COSINE), mi.UInt32(SURFACE))
    lights.place = si.p
    lights.normal = dr.mulsign(mi.Vector3f(si.n), dr.dot(si.n, incident))
    lights.power = flux * dr.select(lambertian, value, 1)
    lights.depth = landed.depth
    dr.eval(lights, lambertian)
    index = dr.compress(~lambertian)
    if not len(index):
        return lights, None
    dr.scatter(lights.surface, dr.arange(mi.UInt32, len(index)), index)
    glossy = dr.gather(mi.SurfaceInteraction3f, si, index)
    dr.eval(lights, glossy)
    return lights, glossy


def _adjoint(si: mi.SurfaceInteraction3f, incident: mi.Vector3f, out: mi.Vector3f) -> mi.Float:
    """What a sampled BSDF value is multiplied with where shading normals differ from geometric ones (Veach 5.3)."""
    above = dr.abs(mi.Frame3f.cos_theta(si.wi)) * dr.abs(dr.dot(si.n, out))
    below = dr.abs(dr.dot(si.n, incident)) * dr.abs(dr.dot(si.sh_frame.n, out))
    factor = above / dr.maximum(below, LEAST_COSINE**2)
    return dr.select(below > 0, dr.minimum(factor, 8), 0)


def next_2d(rng: mi.PCG32) -> mi.Point2f:
    """A random point in the unit square."""
    return mi.Point2f(rng.next_float32(), rng.next_float32())
