"""Lights on the device, and the light that each sends to a point."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi

from mi_sparse_prt.manylights.clamping import sending

#: What a light is: light from one direction; a point that sends out light by the cosine; an emitter of Mitsuba that
#: shines from a point; a point on a surface that reflects light as its BSDF says.
DIRECTION, COSINE, EMITTER, SURFACE = range(4)


@dataclass
class LightArrays:
    """Lights, an array for each of their attributes (Dr.Jit).

    Attributes
    ----------
    kind : UInt32
    place : Point3f
        World position; of a ``DIRECTION`` the unit vector towards it.
    normal : Vector3f
        Of the surface, on the side that light leaves it on.
    power : Color3f
        Irradiance of a ``DIRECTION`` at right angles to it, radiant intensity along the normal of a ``COSINE``,
        incident flux of a ``SURFACE``; mean intensity of an ``EMITTER``, which nothing but sampling by power asks for.
    depth : UInt32
        Edges of the path camera - sample - ... - emitter, if nothing specular is on the way: 2 is direct light.
    emitter : EmitterPtr
        Of an ``EMITTER``.
    surface : UInt32
        Of a ``SURFACE``: its number among those.
    """

    kind: Any
    place: Any
    normal: Any
    power: Any
    depth: Any
    emitter: Any
    surface: Any

    def take(self, ids: mi.UInt32, active: mi.Mask = True) -> LightArrays:
        """Some of the lights."""
        return dr.gather(LightArrays, self, ids, active)


class Arriving(NamedTuple):
    """Light of one light at a point, as if nothing was in the way.

    Attributes
    ----------
    direction : Vector3f
        Towards the light.
    irradiance : Color3f
        At right angles to it.
    cosine : Float
        Geometry term without the cosine at the point, in 1 / unit^2: cos / distance^2, or more where a glossy surface
        sends more light than a white diffuse one would. 0 of lights that have none.
    """

    direction: Any
    irradiance: Any
    cosine: Any


def no_lights(count: int) -> LightArrays:
    """Dark lights, to be filled in."""
    return LightArrays(
        dr.zeros(mi.UInt32, count),
        dr.zeros(mi.Point3f, count),
        dr.zeros(mi.Vector3f, count),
        dr.zeros(mi.Color3f, count),
        dr.full(mi.UInt32, 2, count),
        dr.zeros(mi.EmitterPtr, count),
        dr.zeros(mi.UInt32, count),
    )


def joined(parts: Sequence[LightArrays]) -> LightArrays:
    """Lights of several arrays in one, in their order."""
    result = no_lights(sum(dr.width(part.kind) for part in parts))
    first = 0
    for part in parts:
        size = dr.width(part.kind)
        dr.scatter(result, part, dr.arange(mi.UInt32, size) + dr.opaque(mi.UInt32, first))
        first += size
    dr.eval(result)
    return result


class LightKinds(NamedTuple):
    """Which kinds there are at all: kernels have no code for the others."""

    emitters: bool
    surfaces: mi.SurfaceInteraction3f | None


def arriving(light: LightArrays, p: mi.Point3f, kinds: LightKinds, active: mi.Mask) -> Arriving:
    """What lights send to points.

    Parameters
    ----------
    light : LightArrays
        One for each lane.
    p : Point3f, world
    kinds : LightKinds
    active : Mask

    Notes
    -----
    A surface reflects the flux that a particle brought: f(in, out) |N_g . out| |N_s . in| / |N_g . in|. The last two
    are those of the adjoint BSDF where shading normals N_s differ from N_g (Veach 1997, 5.3).
    """
    distant = light.kind == DIRECTION
    towards = light.place - p
    square = dr.maximum(dr.squared_norm(towards), 1e-30)
    direction = dr.select(distant, mi.Vector3f(light.place), towards * dr.rsqrt(square))
    cosine = dr.select(distant, 0, facing(light.normal, direction) / square)
    irradiance = light.power * dr.select(distant, 1, cosine)
    if kinds.emitters:
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(p))
        si.p = p
        own = active & (light.kind == EMITTER)
        found, value = light.emitter.sample_direction(si, mi.Point2f(0.5), own)
        direction = dr.select(own, found.d, direction)
        irradiance = dr.select(own, mi.Color3f(value), irradiance)
    if kinds.surfaces is not None:
        own = active & (light.kind == SURFACE) & (cosine > 0)
        si = dr.gather(mi.SurfaceInteraction3f, kinds.surfaces, light.surface, own)
        value, scale = reflected(si, light.normal, direction, square, own)
        irradiance = dr.select(light.kind == SURFACE, light.power * value * scale, irradiance)
        cosine = sending(cosine, dr.select(own, value, 0), scale)
    return Arriving(direction, irradiance, cosine)


def facing(normal: mi.Vector3f, direction: mi.Vector3f) -> mi.Float:
    """Cosine at a light on a surface, of directions towards it; 0 behind."""
    return dr.maximum(-dr.dot(normal, direction), 0)


def reflected(
    si: mi.SurfaceInteraction3f,
    normal: mi.Vector3f,
    direction: mi.Vector3f,
    square: mi.Float,
    active: mi.Mask,
) -> tuple[mi.Color3f, mi.Float]:
    """What glossy surfaces reflect of flux from ``si.wi``, and its scale: their product is irradiance per flux.

    Parameters
    ----------
    si : SurfaceInteraction3f
    normal : Vector3f
        Geometric.
    direction : Vector3f
        From the point that is lit, world.
    square : Float
        Of the distance from there.
    active : Mask
    """
    out = si.to_local(-direction)
    value = si.bsdf().eval(mi.BSDFContext(mi.TransportMode.Importance), si, out, active)
    turned = dr.abs(dr.dot(normal, direction)) / dr.maximum(dr.abs(mi.Frame3f.cos_theta(out)), 1e-4)
    return value, dr.select(active, turned / square, 0)
