"""The BSDF `in_out_factors`: exactly what in-out factors of a BRDF reflect, for any integrator of Mitsuba."""

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
from mi_sparse_prt.reflection.brdf_factors import BrdfFactors
from mi_sparse_prt.reflection.factor_tables import incident_tables, look_up, outgoing_tables
from mi_sparse_prt.reflection.varying_diffuse import VaryingDiffuse

LOBE = 10.0  # exponent of the lobe that is sampled: wider than most that few factors can tell
LOBE_SHARE = 0.5  # of the samples; the others are cosine-distributed


class InOutFactors(ReflectiveBSDF):
    r"""In-out factors BSDF (:monosp:`in_out_factors`)
    ------------------------------------------

    A diffuse part and a sum of products ([HR10] eq. 2 and 3): rho(w_i, w_o) cos(w_i) = R / pi cos(w_i) +
    sum_k f_k(w_i) g_k(w_o) on the front of a surface, in its shading frame, w_i towards the light. Transport with
    factored BRDFs reflects just that, so that `path` with it is the reference of such transport, free of the error of
    the factors themselves. Sums of few products are neither reciprocal nor positive everywhere: negative values are
    passed on as they are. (Russian roulette ends paths of negative weight: give `path` an `rr_depth` beyond its
    `max_depth`.)

    Tables hold a direction (x, y, z) at (x, y) / (1 + z), the square [-1, 1]^2 with corners at its edges
    (`reflection.factor_tables`), row by row in y; values between entries are bilinear. Samples are half
    cosine-distributed, half of a Phong lobe of exponent 10.

    .. list-table::
       :header-rows: 1

       * - Parameter
         - Type
         - Meaning (default)
       * - incident
         - tensor
         - f_k, the cosine included, (size, size, K), `mi.TensorXf`. From Python only. |exposed|
       * - outgoing
         - tensor
         - g_k, (size, size, K, 3), `mi.TensorXf`. From Python only. |exposed|
       * - diffuse_reflectance
         - |spectrum| or |texture|
         - R (0). |exposed|

    .. tabs::
        .. code-tab:: python

            'type': 'in_out_factors', 'incident': mi.TensorXf(f), 'outgoing': mi.TensorXf(g)

    Raises `PrtError` (which Mitsuba wraps in its own message) if a tensor is missing, the shapes do not fit each other
    or values are not finite.
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.incident, self.outgoing = (_table(props, name) for name in ("incident", "outgoing"))
        self.diffuse = props.get_texture("diffuse_reflectance", 0.0)
        varying = self.diffuse.is_spatially_varying()
        self.m_components = [
            mi.BSDFFlags.GlossyReflection
            | mi.BSDFFlags.FrontSide
            | mi.BSDFFlags.Anisotropic
            | (mi.BSDFFlags.SpatiallyVarying if varying else mi.BSDFFlags.Empty)
        ]
        self.m_flags = self.m_components[0]
        self._rebuild()

    def _rebuild(self) -> None:
        f, g = self.incident.shape, self.outgoing.shape
        if len(f) != 3 or f[0] != f[1] or f[0] < 2 or g != (*f, 3):
            raise PrtError(
                f"in_out_factors: incident has shape {f}, outgoing {g}; give (n, n, K) and (n, n, K, 3)"
            )
        self._size, self._terms = f[0], f[2]
        # as many lookups as terms and channels: one table each, term last
        values = self.outgoing.numpy()
        self._f = mi.Float(self.incident.array)
        self._g = [mi.Float(np.ascontiguousarray(values[..., c]).ravel()) for c in range(3)]

    def traverse(self, callback: mi.TraversalCallback) -> None:
        super().traverse(callback)
        callback.put("incident", self.incident, mi.ParamFlags.NonDifferentiable)
        callback.put("outgoing", self.outgoing, mi.ParamFlags.NonDifferentiable)
        callback.put("diffuse_reflectance", self.diffuse, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys: list[str]) -> None:
        super().parameters_changed(keys)
        self._rebuild()

    def sample_direction(
        self, context: mi.BSDFContext, si: mi.SurfaceInteraction3f, sample1: mi.Float, sample2: mi.Point2f
    ) -> tuple[mi.Vector3f, mi.UInt32]:
        lobe, cosine = sample_phong_lobe(si.wi, LOBE, sample2), mi.warp.square_to_cosine_hemisphere(sample2)
        return dr.select(sample1 < LOBE_SHARE, lobe, cosine), mi.UInt32(0)

    def reflect(
        self, context: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool
    ) -> tuple[mi.Color3f, mi.Float]:
        active &= context.is_enabled(mi.BSDFFlags.GlossyReflection, 0)
        # Mitsuba's wi is where the light leaves for, wo where it comes from
        into = self._looked_up(self._f, wo, active)
        glossy = [dr.dot(into, self._looked_up(g, si.wi, active)) for g in self._g]
        cosine = mi.Frame3f.cos_theta(wo)
        value = mi.Color3f(*glossy) + self.diffuse.eval(si, active) * (cosine * dr.inv_pi)
        density = LOBE_SHARE * phong_lobe_density(phong_lobe_power(si.wi, LOBE, wo), LOBE)
        density += (1 - LOBE_SHARE) * mi.warp.square_to_cosine_hemisphere_pdf(wo)
        return dr.select(active, value, 0), dr.select(active, density, 0)

    def _looked_up(self, table: mi.Float, local: mi.Vector3f, active: mi.Bool) -> mi.ArrayXf:
        return mi.ArrayXf(look_up(table, self._size, self._terms, mi.UInt32(0), local, active))

    def to_string(self) -> str:
        return f"InOutFactors[terms={self._terms}, size={self._size}, diffuse={self.diffuse}]"


def factored_bsdf(factors: BrdfFactors, bsdf: mi.BSDF | None = None) -> mi.BSDF:
    """The BSDF `in_out_factors` of factors, in the tables that transport has of them.

    Parameters
    ----------
    factors : BrdfFactors
    bsdf : mi.BSDF, optional
        What was factored; needed, and used, only if its diffuse part varies over the surface.

    Raises
    ------
    PrtError
        If it is needed and missing.
    """
    if factors.varying_diffuse and bsdf is None:
        raise PrtError(
            "factored_bsdf: the diffuse part varies over the surface; give the BSDF that was factored"
        )
    diffuse = {"type": "rgb", "value": np.broadcast_to(np.clip(factors.diffuse, 0, 1), 3).tolist()}
    return mi.load_dict(
        {
            "type": "in_out_factors",
            "incident": mi.TensorXf(incident_tables([factors])[0]),
            "outgoing": mi.TensorXf(outgoing_tables([factors])[0]),
            "diffuse_reflectance": VaryingDiffuse(bsdf) if factors.varying_diffuse else diffuse,
        }
    )


def _table(props: mi.Properties, name: str) -> mi.TensorXf:
    if name not in props:
        raise PrtError(f"in_out_factors: {name} is missing; give a mi.TensorXf")
    values = np.array(props[name], np.float32)
    if not np.isfinite(values).all():
        raise PrtError(f"in_out_factors: {name} has values that are NaN or infinite; repair it")
    return mi.TensorXf(values)
