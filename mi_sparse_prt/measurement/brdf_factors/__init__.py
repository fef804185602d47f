"""In-out factors of a BRDF: rho(w_i, w_o) cos(w_i) as a short sum of products ([HR10] eq. 2 and 3).

All directions are in the local frame of a surface, +Z along its normal. The diffuse part comes first, then factors of
what is left, on a grid of directions; values between grid points are bilinear.
"""

from .cached import factors_of
from .directions import DirectionGrid
from .factors import MOST_TERMS, BrdfFactors, factor_brdf
from .harmonics import harmonic_factors
from .held_out import FactorError, factor_error
from .parts import anisotropic, diffuse_reflectance, evaluated

__all__ = [
    "MOST_TERMS",
    "BrdfFactors",
    "DirectionGrid",
    "FactorError",
    "anisotropic",
    "diffuse_reflectance",
    "evaluated",
    "factor_brdf",
    "factor_error",
    "factors_of",
    "harmonic_factors",
]
