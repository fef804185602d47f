"""Factors whose incident functions any BRDF shares: harmonics, and the best fit that they allow."""

import mitsuba as mi
import numpy as np
import pytest

import mi_sparse_prt as prt
from mi_sparse_prt.reflection.brdf_factors import (
    DirectionGrid,
    evaluate_brdf,
    harmonic_factors,
    measure_factor_error,
)

GRID = DirectionGrid(12, 24)
BRUSHED = {"type": "ashikhmin_shirley", "exponent_u": 5.0, "exponent_v": 60.0}


def coloured() -> mi.BSDF:
    specular = {"type": "rgb", "value": [0.5, 0.3, 0.1]}
    return mi.load_dict({"type": "phong", "exponent": 10.0, "specular_reflectance": specular})


def test_incident_functions_are_the_same_for_all():
    a, b = (harmonic_factors(bsdf, "vase", 3, GRID) for bsdf in (coloured(), mi.load_dict(BRUSHED)))
    assert a.incident.shape == (16, 288) and np.array_equal(a.incident, b.incident)
    assert a.outgoing.shape == (16, 3, 288) and b.outgoing.shape == (16, 1, 288)


@pytest.mark.parametrize("order", [3, 12])
def test_they_are_orthonormal_on_the_hemisphere(order):
    f = harmonic_factors(coloured(), "vase", order, GRID).incident.astype(np.float64)
    assert np.allclose((f * GRID.solid_angles) @ f.T, np.eye(len(f)), atol=1e-5)


def test_fewer_terms_are_a_lower_order():
    high, low = (harmonic_factors(coloured(), "vase", order, GRID) for order in (4, 2))
    assert np.array_equal(high.first(9).incident, low.incident)
    assert np.allclose(high.first(9).outgoing, low.outgoing, atol=1e-6)


@pytest.mark.parametrize("order", [0, 1, 3])
def test_the_fit_is_the_best_one(order):
    """Against least squares with all monomials of (x, y, z) up to that degree, which span the same functions."""
    bsdf = coloured()
    found = harmonic_factors(bsdf, "vase", order, GRID)
    w, n = GRID.directions, len(GRID.directions)
    wi, wo = np.repeat(w, n, axis=0), np.tile(w, (n, 1))
    true = evaluate_brdf(bsdf, "vase", wi, wo).astype(np.float64)
    glossy = (true - wi[:, 2:] * found.diffuse / np.pi).reshape(n, -1)
    x, y, z = w.T.astype(np.float64)
    powers = [
        (a, b, c) for a in range(order + 1) for b in range(order + 1 - a) for c in range(order + 1 - a - b)
    ]
    roots = np.sqrt(GRID.solid_angles)[:, None]
    basis = np.stack([x**a * y**b * z**c * np.sqrt(z) for a, b, c in powers], axis=1) * roots
    fit = basis @ np.linalg.lstsq(basis, glossy * roots, rcond=1e-5)[0]
    missing = (true - found.values(wi, wo)).reshape(n, -1) * roots
    assert np.allclose(missing, glossy * roots - fit, atol=1e-4 * np.abs(true).max())


def test_light_that_is_smooth_is_right():
    """
    Rationale: a precomputed transport of these functions has no more of a light than its lowest harmonics.
    Expected: a picture of a lobe that takes dozens of terms is within 2% under even light with nine.
    """
    bsdf = coloured()
    found = harmonic_factors(bsdf, "vase", 2, DirectionGrid(16, 32))
    grid = found.grid
    w, n = grid.directions, len(grid.directions)
    wi, wo = np.repeat(w, n, axis=0), np.tile(w, (n, 1))
    true, values = evaluate_brdf(bsdf, "vase", wi, wo).reshape(n, n, 3), found.values(wi, wo).reshape(n, n, 3)
    seen = (grid.solid_angles * w[:, 2])[:, None]
    picture, missing = (np.tensordot(grid.solid_angles, x, 1) for x in (true, values - true))
    assert np.sqrt((seen * missing**2).sum()) < 0.02 * np.sqrt((seen * picture**2).sum())
    error = measure_factor_error(found, bsdf, "vase")
    assert len(error.whole) == 9 and error.whole[8] < 0.6 * error.whole[0]


@pytest.mark.parametrize("order", [-1, 13])
def test_orders_that_are_none(order):
    with pytest.raises(prt.PrtError, match="shape 'vase': harmonics of order .* give 0 to 12"):
        harmonic_factors(coloured(), "vase", order, GRID)
