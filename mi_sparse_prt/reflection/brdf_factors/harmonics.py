"""Factors that serve any BRDF: incident functions that are known before it is chosen.

[HR10] 8 proposes them: transport is precomputed for spherical harmonics of the incident direction, BRDFs come later.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.reflection.brdf_factors.diffuse_part import GlossyPart
from mi_sparse_prt.reflection.brdf_factors.direction_grid import DirectionGrid, Doubles
from mi_sparse_prt.reflection.brdf_factors.factorization import BrdfFactors, glossy_rows, join_factors


def harmonic_factors(bsdf: mi.BSDF, name: str, order: int, grid: DirectionGrid | None = None) -> BrdfFactors:
    """Fit a reflective BSDF with incident functions that are the same for all BSDFs.

    These are real spherical harmonics in the local frame times the root of the cosine, made orthonormal on the upper
    hemisphere, where they are not, lower orders first: the first (l + 1)^2 terms are the factors of order l. Outgoing
    functions are the least-squares fit, by solid angle of the incident direction. (Times the cosine itself, they fit a
    Phong lobe better and one of Ashikhmin and Shirley worse, which stays bright at the horizon; without it, the other
    way round: 4.8% and 7.1% at order 3 under smooth random light, 6.2% and 5.3%; the root has 5.3% and 5.6%.)

    Parameters
    ----------
    bsdf : mi.BSDF
        Its front is fitted. A diffuse part that varies over the surface is left to the caller, see `BrdfFactors`.
    name : str
        For messages.
    order : int
        0 to 12; the factors have (order + 1)^2 terms.
    grid : DirectionGrid, optional
        Of incident and of outgoing directions, 64 x 128 if not given.

    Returns
    -------
    BrdfFactors
        ``incident`` depends on order and grid alone.

    Raises
    ------
    PrtError
        If the order is out of range, and as ``factor_brdf``.
    """
    highest = 12  # 169 terms
    if not 0 <= order <= highest:
        raise PrtError(f"shape '{name}': harmonics of order {order}; give 0 to {highest}")
    part = GlossyPart(bsdf, name)
    grid = grid or DirectionGrid()
    roots = np.sqrt(grid.solid_angles)
    basis = _orthonormal_basis(grid, order)  # [term, incident]
    n = len(roots)
    fit = np.zeros((len(basis), part.channels * n))
    for some, values in glossy_rows(part, grid):
        fit += (basis[:, some] * roots[some]).astype(np.float32) @ values.reshape(-1, fit.shape[1])
    return join_factors(part, grid, basis / roots, fit.reshape(len(basis), -1, n))


def _orthonormal_basis(grid: DirectionGrid, order: int) -> Doubles:
    """Functions (terms, grid) that span harmonics times the cosine's root, times roots of solid angles."""
    scaled = grid.harmonics(order) * np.sqrt(grid.directions[:, 2] * grid.solid_angles)
    q, r = np.linalg.qr(scaled.T)
    basis: Doubles = (q * np.sign(np.diag(r))).T
    return basis
