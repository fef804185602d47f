"""The diffuse part of a textured BSDF as a Mitsuba texture."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_sparse_prt.reflection.brdf_factors import diffuse_reflectance
from mi_sparse_prt.reflection.brdf_factors.diffuse_part import SLANTED


class VaryingDiffuse(mi.Texture):
    """Reflectance of the diffuse part of a BSDF that varies over the surface, as ``diffuse_reflectance`` tells it.

    Parameters
    ----------
    bsdf : mi.BSDF
        One that was factored: nothing but its Lambertian part varies.
    """

    def __init__(self, bsdf: mi.BSDF) -> None:
        super().__init__(mi.Properties())
        self._bsdf = bsdf
        origin = dr.zeros(mi.SurfaceInteraction3f)
        known = diffuse_reflectance(bsdf, "factored", origin)[0]
        self._offset = mi.ScalarColor3f(
            *map(float, known - np.ravel(self._evaluate_slanted(origin, mi.Bool(True))))
        )

    def _evaluate_slanted(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Color3f:
        """The BRDF times pi, away from the highlight."""
        back = mi.Vector3f(*SLANTED)
        here = mi.SurfaceInteraction3f(si)
        here.wi = back
        return self._bsdf.eval(mi.BSDFContext(), here, back, active) * (dr.pi / SLANTED[2])

    def eval(self, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.Color3f:
        return dr.maximum(self._evaluate_slanted(si, active) + self._offset, 0)

    def is_spatially_varying(self) -> bool:
        return True

    def to_string(self) -> str:
        return f"VaryingDiffuse[{self._bsdf}]"
