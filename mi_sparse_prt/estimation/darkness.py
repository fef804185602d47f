"""Whether there is any light to speak of: errors relative to next to nothing are worth no time."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.emission.cubemap import CubemapLighting

# Norm of a matrix that counts as dark, relative to what it would be if nothing was in the way. A vertex that sees a
# single one of 6144 texels has more than twice of it. Closed rooms of coarse meshes with smoothed normals have a half:
# light leaks in where these normals say that a direction is above the horizon, and the triangle says it is not.
DARK = 1e-2


def unoccluded_squares(albedo: NDArray[np.floating], lighting: CubemapLighting) -> NDArray[np.float64]:
    """Squared norms of rows of the matrix if nothing was in the way, and reflected no light.

    Parameters
    ----------
    albedo : (n, 3) float
    lighting : CubemapLighting

    Returns
    -------
    (n,) float64
        Sums over texels and channels of ``(albedo / pi * cosine * d_omega)^2``; the integral of squared cosines stands
        for their sum.
    """
    row = 2 * math.pi / 3 * float(np.square(lighting.solid_angles, dtype=np.float64).sum()) / (4 * math.pi)
    return np.square(albedo, dtype=np.float64).sum(axis=1) * (row / math.pi**2)
