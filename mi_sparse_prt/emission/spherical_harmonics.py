"""Real spherical harmonics of a cubemap's texels: few smooth functions, a basis to compare wavelets with."""

from __future__ import annotations

import numpy as np
import scipy.special
from numpy.typing import NDArray

from mi_sparse_prt.emission.cubemap import CubemapLighting

TEXELS = 4096  # at a time: scipy's table holds all orders in complex doubles


def spherical_harmonics(lighting: CubemapLighting, order: int) -> NDArray[np.float32]:
    """Harmonics up to an order, as coefficients L sqrt(d_omega) of lights that have their shape.

    Sums over texels are no integrals, so that the harmonics at texels' centres are not quite orthonormal. They are made
    so, each against all before it: the first (l + 1)^2 columns span the harmonics of orders up to l.

    Parameters
    ----------
    lighting : CubemapLighting
    order : int
        At most its resolution: finer ones repeat themselves between texels.

    Returns
    -------
    (n_directions, (order + 1)^2) float32
        Orthonormal columns, by order l, then by m from -l to l.
    """
    values = np.concatenate(
        [
            _harmonics(part, order)
            for part in np.split(lighting.directions, range(TEXELS, len(lighting.directions), TEXELS))
        ]
    )
    basis, triangle = np.linalg.qr(np.sqrt(lighting.solid_angles)[:, None] * values)
    return (basis * np.sign(np.diag(triangle))).astype(np.float32)


def harmonic_orders(order: int) -> NDArray[np.int64]:
    """The order l of each harmonic up to an order, ((order + 1)^2,)."""
    return np.repeat(np.arange(order + 1), 2 * np.arange(order + 1) + 1)


def _harmonics(directions: NDArray[np.floating], order: int) -> NDArray[np.float64]:
    """Values (n, (order + 1)^2) of the harmonics in some directions."""
    x, y, z = np.asarray(directions, np.float64).T
    table = scipy.special.sph_harm_y_all(order, order, np.arccos(np.clip(z, -1, 1)), np.arctan2(y, x))
    columns = []
    for degree in range(order + 1):
        for m in range(-degree, degree + 1):
            value = table[degree, abs(m)]
            part = value.imag if m < 0 else value.real
            columns.append(part if m == 0 else np.sqrt(2) * part)
    return np.stack(columns, axis=1)
