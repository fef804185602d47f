"""How much is kept of the light that a point on a surface sends to a sample near to it.

A point that stands for light from around it is too bright where it is too near: its geometry term has no limit
(Kollig and Keller: Illumination in the Presence of Weak Singularities, 2004). It is clamped, glossy reflection
counted in as far as it is more than that of white diffuse surfaces.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def receiving(cosine: mi.Float, value: mi.Color3f) -> mi.Float:
    """The factor of the sample: the cosine there, or pi times the BSDF (cosine counted in) if that is more."""
    return dr.maximum(dr.abs(cosine), dr.pi * dr.max(value))


def sending(cosine: mi.Float, value: mi.Color3f, scale: mi.Float) -> mi.Float:
    """The factor of the point, cosine / distance^2, or pi times the BSDF and its ``scale`` if that is more."""
    return dr.maximum(cosine, dr.pi * dr.max(value) * scale)


def kept(receives: mi.Float, sends: mi.Float, clamp: mi.Float) -> mi.Float:
    """Share of the light: all of it, where the product of both factors is at most ``clamp``."""
    near = receives * sends
    return dr.select(near > clamp, clamp / near, 1)
