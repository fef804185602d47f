"""In-out factors of a BRDF: rho(w_i, w_o) cos(w_i) as a short sum of products ([HR10] eq. 2 and 3).

All directions are in the local frame of a surface, +Z along its normal. The diffuse part comes first, then factors of
what is left, on a grid of directions; values between grid points are bilinear.
"""

from mi_sparse_prt.reflection.brdf_factors.diffuse_part import (
    UnfactorableError,
    diffuse_reflectance,
    evaluate_brdf,
    is_anisotropic,
)
from mi_sparse_prt.reflection.brdf_factors.direction_grid import DirectionGrid
from mi_sparse_prt.reflection.brdf_factors.factor_cache import (
    FactorOptions,
    factors_for_images,
    factors_of,
)
from mi_sparse_prt.reflection.brdf_factors.factor_error import FactorError, measure_factor_error
from mi_sparse_prt.reflection.brdf_factors.factorization import MOST_TERMS, BrdfFactors, factor_brdf
from mi_sparse_prt.reflection.brdf_factors.harmonics import harmonic_factors

__all__ = [
    "MOST_TERMS",
    "BrdfFactors",
    "DirectionGrid",
    "FactorError",
    "FactorOptions",
    "UnfactorableError",
    "is_anisotropic",
    "diffuse_reflectance",
    "evaluate_brdf",
    "factor_brdf",
    "measure_factor_error",
    "factors_for_images",
    "factors_of",
    "harmonic_factors",
]
