"""The BSDFs `phong` and `ashikhmin_shirley` of [HR10] (Figures 17 to 19), which Mitsuba 3 does not have."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.plugins.reflective_bsdf import (
    ReflectiveBSDF,
    phong_lobe_density,
    phong_lobe_power,
    sample_phong_lobe,
)


class GlossyBSDF(ReflectiveBSDF):
    """A diffuse and a specular lobe on the front of a surface, all in the local frame.

    Subclasses give both lobes and sample the specular one. Which lobe is sampled is chosen by the means of both
    reflectances; the probability density is that of both together.
    """

    anisotropic = False

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.diffuse = props.get_texture("diffuse_reflectance", 0.5)
        self.specular = props.get_texture("specular_reflectance", 0.2)
        for name, texture in (("diffuse", self.diffuse), ("specular", self.specular)):
            if not 0 <= _mean(texture) <= 1:
                raise PrtError(
                    f"{props.plugin_name()}: {name}_reflectance has the mean {_mean(texture):g}; give 0 to 1"
                )
        glossy, front = mi.BSDFFlags.GlossyReflection, mi.BSDFFlags.FrontSide
        uneven = mi.BSDFFlags.Anisotropic if self.anisotropic else mi.BSDFFlags.Empty
        varying = [
            mi.BSDFFlags.SpatiallyVarying if texture.is_spatially_varying() else mi.BSDFFlags.Empty
            for texture in (self.specular, self.diffuse)
        ]
        self.m_components = [
            glossy | front | uneven | varying[0],
            mi.BSDFFlags.DiffuseReflection | front | varying[1],
        ]
        self.m_flags = self.m_components[0] | self.m_components[1]
        self._share = self._specular_share()

    def traverse(self, callback: mi.TraversalCallback) -> None:
        super().traverse(callback)
        callback.put("diffuse_reflectance", self.diffuse, mi.ParamFlags.Differentiable)
        callback.put("specular_reflectance", self.specular, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys: list[str]) -> None:
        super().parameters_changed(keys)
        self._share = self._specular_share()

    def _specular_share(self) -> float:
        """Of the samples; a lobe that reflects at all has at least one in fifty."""
        diffuse, specular, least = _mean(self.diffuse), _mean(self.specular), 0.02
        if min(diffuse, specular) <= 0:
            return float(specular > 0)
        return min(max(specular / (diffuse + specular), least), 1 - least)

    def _probability(self, context: mi.BSDFContext) -> tuple[bool, bool, float]:
        """Whether the specular and the diffuse lobe are asked for, and the share of samples of the first."""
        specular = context.is_enabled(mi.BSDFFlags.GlossyReflection, 0)
        diffuse = context.is_enabled(mi.BSDFFlags.DiffuseReflection, 1)
        return specular, diffuse, self._share if specular and diffuse else float(specular)

    def sample_direction(
        self, context: mi.BSDFContext, si: mi.SurfaceInteraction3f, sample1: mi.Float, sample2: mi.Point2f
    ) -> tuple[mi.Vector3f, mi.UInt32]:
        specular = sample1 < self._probability(context)[2]
        cosine = mi.warp.square_to_cosine_hemisphere(sample2)
        direction = dr.select(specular, self.sample_lobe(si, sample2), cosine)
        return direction, dr.select(specular, mi.UInt32(0), mi.UInt32(1))

    def reflect(
        self, context: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool
    ) -> tuple[mi.Color3f, mi.Float]:
        specular, diffuse, share = self._probability(context)
        value, density = mi.Color3f(0), mi.Float(0)
        if specular:
            lobe, lobe_density = self.lobe(si, wo, active)
            value, density = value + lobe, density + share * lobe_density
        if diffuse:
            value += self.diffuse_lobe(si, wo, active)
            density += (1 - share) * mi.warp.square_to_cosine_hemisphere_pdf(wo)
        return value * mi.Frame3f.cos_theta(wo), density

    def lobe(
        self, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool
    ) -> tuple[mi.Color3f, mi.Float]:
        """The specular BRDF, without the cosine, and the density of ``sample_lobe``."""
        raise NotImplementedError

    def sample_lobe(self, si: mi.SurfaceInteraction3f, sample: mi.Point2f) -> mi.Vector3f:
        """Directions of the specular lobe; some may be below the surface."""
        raise NotImplementedError

    def diffuse_lobe(self, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool) -> mi.Color3f:
        """The diffuse BRDF, without the cosine."""
        raise NotImplementedError


class Phong(GlossyBSDF):
    r"""Modified Phong BSDF (:monosp:`phong`)
    ---------------------------------------

    A diffuse lobe and a power of the cosine to the mirrored direction, with the factors of Lafortune and Willems 1994
    ("Using the modified Phong reflectance model for physically based rendering"): it is reciprocal, and reflects no
    more than ``diffuse_reflectance + specular_reflectance``, exactly that for light along the normal.

    .. list-table::
       :header-rows: 1

       * - Parameter
         - Type
         - Meaning (default)
       * - exponent
         - float
         - Of the specular lobe (30)
       * - specular_reflectance
         - |spectrum| or |texture|
         - Share that the specular lobe reflects along the normal (0.2). |exposed|
       * - diffuse_reflectance
         - |spectrum| or |texture|
         - Share that is reflected diffusely (0.5). |exposed|

    .. tabs::
        .. code-tab:: xml

            <bsdf type="phong">
                <float name="exponent" value="60"/>
                <rgb name="specular_reflectance" value="0.3"/>
                <rgb name="diffuse_reflectance" value="0.4, 0.3, 0.2"/>
            </bsdf>

        .. code-tab:: python

            'type': 'phong', 'exponent': 60.0, 'specular_reflectance': {'type': 'rgb', 'value': 0.3}

    Raises `PrtError` (which Mitsuba wraps in its own message) if the exponent or a mean reflectance is out of range.
    """

    def __init__(self, props: mi.Properties) -> None:
        self.exponent = _exponent(props, "exponent", 30.0)
        super().__init__(props)

    def traverse(self, callback: mi.TraversalCallback) -> None:
        super().traverse(callback)
        callback.put("exponent", self.exponent, mi.ParamFlags.Differentiable)

    def lobe(
        self, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool
    ) -> tuple[mi.Color3f, mi.Float]:
        power = phong_lobe_power(si.wi, self.exponent, wo)
        value = self.specular.eval(si, active) * ((self.exponent + 2) * dr.inv_two_pi * power)
        return value, phong_lobe_density(power, self.exponent)

    def sample_lobe(self, si: mi.SurfaceInteraction3f, sample: mi.Point2f) -> mi.Vector3f:
        return sample_phong_lobe(si.wi, self.exponent, sample)

    def diffuse_lobe(self, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool) -> mi.Color3f:
        return self.diffuse.eval(si, active) * dr.inv_pi

    def to_string(self) -> str:
        return f"Phong[exponent={self.exponent}, specular={self.specular}, diffuse={self.diffuse}]"


class AshikhminShirley(GlossyBSDF):
    r"""Anisotropic BSDF of Ashikhmin and Shirley (:monosp:`ashikhmin_shirley`)
    -------------------------------------------------------------------------

    The anisotropic Phong model of Ashikhmin and Shirley 2000 ("An anisotropic Phong BRDF model"): a specular lobe
    around the half vector, with one exponent along each tangent and Schlick's Fresnel term, and a diffuse lobe that
    gives way to it at grazing angles. It is reciprocal and conserves energy.

    .. list-table::
       :header-rows: 1

       * - Parameter
         - Type
         - Meaning (default)
       * - exponent_u, exponent_v
         - float
         - Of the specular lobe along the first and the second tangent (100, 100)
       * - specular_reflectance
         - |spectrum| or |texture|
         - Specular reflectance along the normal (0.2). |exposed|
       * - diffuse_reflectance
         - |spectrum| or |texture|
         - Diffuse reflectance below the specular lobe (0.5). |exposed|

    .. tabs::
        .. code-tab:: xml

            <bsdf type="ashikhmin_shirley">
                <float name="exponent_u" value="10"/>
                <float name="exponent_v" value="500"/>
            </bsdf>

        .. code-tab:: python

            'type': 'ashikhmin_shirley', 'exponent_u': 10.0, 'exponent_v': 500.0

    Raises `PrtError` (which Mitsuba wraps in its own message) if an exponent or a mean reflectance is out of range.
    """

    anisotropic = True

    def __init__(self, props: mi.Properties) -> None:
        self.exponent_u = _exponent(props, "exponent_u", 100.0)
        self.exponent_v = _exponent(props, "exponent_v", 100.0)
        super().__init__(props)

    def traverse(self, callback: mi.TraversalCallback) -> None:
        super().traverse(callback)
        callback.put("exponent_u", self.exponent_u, mi.ParamFlags.Differentiable)
        callback.put("exponent_v", self.exponent_v, mi.ParamFlags.Differentiable)

    def lobe(
        self, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool
    ) -> tuple[mi.Color3f, mi.Float]:
        half = dr.normalize(si.wi + wo)
        cosine = dr.maximum(dr.dot(half, wo), 1e-6)
        density = self._density_of(half) / (4 * cosine)
        grazing = dr.maximum(mi.Frame3f.cos_theta(si.wi), mi.Frame3f.cos_theta(wo))
        normal = self.specular.eval(si, active)
        fresnel = normal + (1 - normal) * (1 - cosine) ** 5
        # sqrt(..) / (8 pi) pow / (cosine grazing) is the density of directions over 'grazing', with h's n + 1 for n
        return fresnel * (density / dr.maximum(grazing, 1e-6)), density

    def _density_of(self, half: mi.Vector3f) -> mi.Float:
        """Of half vectors, per solid angle."""
        u, v = self.exponent_u, self.exponent_v
        sine = dr.maximum(half.x * half.x + half.y * half.y, 1e-12)
        exponent = (u * half.x * half.x + v * half.y * half.y) / sine
        scale = dr.sqrt((u + 1) * (v + 1)) * dr.inv_two_pi
        return scale * dr.maximum(half.z, 0) ** exponent

    def sample_lobe(self, si: mi.SurfaceInteraction3f, sample: mi.Point2f) -> mi.Vector3f:
        u, v = self.exponent_u, self.exponent_v
        # the angle within a quadrant by the tangent, the quadrant by where the number lies
        quadrant = dr.minimum(dr.floor(4 * sample.x), 3)
        within = 4 * sample.x - quadrant
        s, c = dr.sincos(0.5 * dr.pi * within)
        ratio = dr.sqrt((u + 1) / (v + 1))
        length = dr.rsqrt(c * c + ratio * ratio * s * s)
        c, s = c * length, ratio * s * length
        x = dr.select((quadrant == 1) | (quadrant == 2), -c, c)
        y = dr.select(quadrant >= 2, -s, s)
        cosine = (1 - sample.y) ** (1 / (u * c * c + v * s * s + 1))
        sine = dr.safe_sqrt(1 - cosine * cosine)
        return mi.reflect(si.wi, mi.Normal3f(sine * x, sine * y, cosine))

    def diffuse_lobe(self, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool) -> mi.Color3f:
        reflectance = self.diffuse.eval(si, active) * (1 - self.specular.eval(si, active))
        fall = 1.0
        for w in (si.wi, wo):
            fall *= 1 - (1 - 0.5 * mi.Frame3f.cos_theta(w)) ** 5
        return reflectance * (28 / (23 * dr.pi) * fall)

    def to_string(self) -> str:
        exponents = f"exponent_u={self.exponent_u}, exponent_v={self.exponent_v}"
        return f"AshikhminShirley[{exponents}, specular={self.specular}, diffuse={self.diffuse}]"


def _mean(texture: mi.Texture) -> float:
    return float(np.ravel(texture.mean())[0])


def _exponent(props: mi.Properties, name: str, default: float) -> mi.Float:
    """A parameter of the plugin; opaque, so that another value compiles no kernel."""
    value, largest = float(props.get(name, default)), 1e5  # beyond, float32 does not resolve the lobe
    if not 0 <= value <= largest:
        raise PrtError(f"{props.plugin_name()}: {name} is {value:g}; give 0 to {largest:g}")
    return dr.opaque(mi.Float, value)
