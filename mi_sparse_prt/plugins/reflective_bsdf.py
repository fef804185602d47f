"""What BSDFs written in Python have in common: methods of Mitsuba that all follow from two."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi


class ReflectiveBSDF(mi.BSDF):
    """A BSDF on the front of a surface, black from behind and opaque, in the local frame.

    Subclasses draw directions (``sample_direction``) and tell what is reflected and how densely they draw
    (``reflect``); the texture ``diffuse`` is their diffuse reflectance.
    """

    diffuse: mi.Texture

    def sample_direction(
        self, context: mi.BSDFContext, si: mi.SurfaceInteraction3f, sample1: mi.Float, sample2: mi.Point2f
    ) -> tuple[mi.Vector3f, mi.UInt32]:
        """A direction, which may be below the surface, and the number of the component that it is drawn from."""
        raise NotImplementedError

    def reflect(
        self, context: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool
    ) -> tuple[mi.Color3f, mi.Float]:
        """BRDF times the cosine of ``wo``, and the density of ``sample_direction``, both above the surface."""
        raise NotImplementedError

    def sample(
        self,
        context: mi.BSDFContext,
        si: mi.SurfaceInteraction3f,
        sample1: mi.Float,
        sample2: mi.Point2f,
        active: mi.Bool = True,
    ) -> tuple[mi.BSDFSample3f, mi.Color3f]:
        bs = dr.zeros(mi.BSDFSample3f)
        bs.wo, component = self.sample_direction(context, si, sample1, sample2)
        value, bs.pdf = self.eval_pdf(context, si, bs.wo, active)
        bs.eta = 1.0
        bs.sampled_component = component
        bs.sampled_type = mi.UInt32(int(mi.BSDFFlags.GlossyReflection))
        if len(self.m_components) > 1:
            diffuse = mi.UInt32(int(mi.BSDFFlags.DiffuseReflection))
            bs.sampled_type = dr.select(component == 0, bs.sampled_type, diffuse)
        return bs, dr.select(bs.pdf > 0, value / bs.pdf, 0)

    def eval_pdf(
        self,
        context: mi.BSDFContext,
        si: mi.SurfaceInteraction3f,
        wo: mi.Vector3f,
        active: mi.Bool = True,
    ) -> tuple[mi.Color3f, mi.Float]:
        active &= (mi.Frame3f.cos_theta(si.wi) > 0) & (mi.Frame3f.cos_theta(wo) > 0)
        value, density = self.reflect(context, si, wo, active)
        return dr.select(active, value, 0), dr.select(active, density, 0)

    def eval(self, *arguments: Any, **named: Any) -> mi.Color3f:
        return self.eval_pdf(*arguments, **named)[0]

    def pdf(self, *arguments: Any, **named: Any) -> mi.Float:
        return self.eval_pdf(*arguments, **named)[1]

    def eval_diffuse_reflectance(self, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.Color3f:
        return self.diffuse.eval(si, active)


def sample_phong_lobe(wi: mi.Vector3f, exponent: float | mi.Float, sample: mi.Point2f) -> mi.Vector3f:
    """A direction of a Phong lobe around the mirrored one; it may be below the surface."""
    cosine = (1 - sample.y) ** (1 / (exponent + 1))
    sine, (s, c) = dr.safe_sqrt(1 - cosine * cosine), dr.sincos(dr.two_pi * sample.x)
    return mi.Frame3f(mi.reflect(wi)).to_world(mi.Vector3f(sine * c, sine * s, cosine))


def phong_lobe_power(wi: mi.Vector3f, exponent: float | mi.Float, wo: mi.Vector3f) -> mi.Float:
    """The lobe, 1 in the mirrored direction."""
    return dr.maximum(dr.dot(mi.reflect(wi), wo), 0) ** exponent


def phong_lobe_density(power: mi.Float, exponent: float | mi.Float) -> mi.Float:
    """Density of ``sample_phong_lobe`` per solid angle, where the lobe has this power."""
    return (exponent + 1) * dr.inv_two_pi * power
