"""Spherical harmonics on a cubemap's texels, against Dr.Jit's, and against what rotations may not change."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.emission.spherical_harmonics import harmonic_orders, spherical_harmonics
from mi_sparse_prt.relighting.approximations import Bands, Linear, PerBand


@pytest.mark.parametrize("n", [1, 4, 32])
def test_harmonics_are_orthonormal(n):
    basis = spherical_harmonics(CubemapLighting(n), 1 if n == 1 else min(n, 12)).astype(np.float64)
    assert_allclose(basis.T @ basis, np.eye(basis.shape[1]), atol=1e-5)


def test_harmonics_are_those_of_drjit():
    lighting, order = CubemapLighting(64), 9
    ours = spherical_harmonics(lighting, order) / np.sqrt(lighting.solid_angles)[:, None]
    d = mi.Vector3f(np.ascontiguousarray(lighting.directions.T))
    values = [np.array(value) for value in dr.sh_eval(d, order)]
    theirs = np.stack(np.broadcast_arrays(*values), axis=1)  # the first is one number
    inner = np.einsum("mk,mk->k", ours * lighting.solid_angles[:, None], theirs)
    assert_allclose(np.abs(inner), 1, atol=2e-3)  # conventions differ in signs
    assert np.abs(ours - np.sign(inner) * theirs).max() < 0.02 * np.abs(theirs).max()


def test_a_rotated_light_has_the_same_energy_in_each_order():
    lighting, order = CubemapLighting(64), 12
    basis, number = spherical_harmonics(lighting, order), harmonic_orders(order)

    def energies(axis):
        lobe = np.exp(6 * (lighting.directions @ axis - 1)) * np.sqrt(lighting.solid_angles)
        return np.bincount(number, (basis.T @ lobe) ** 2)

    first, second = (energies(np.array(v) / np.linalg.norm(v)) for v in ([0, 0, 1], [1, -2, 0.5]))
    assert_allclose(first, second, rtol=0.01, atol=1e-7 * first.sum())
    assert_array_equal(np.bincount(number), 2 * np.arange(order + 1) + 1)


def test_linear_keeps_the_coarsest_and_bands_of_harmonics_go_on():
    rng, number = np.random.default_rng(0), harmonic_orders(4)
    bands = Bands(number, np.ones(25, np.float32))
    linear, per_band = Linear(bands), PerBand(bands, exhaustive=False)
    first, second = rng.normal(size=(2, 25, 3)).astype(np.float32)
    for method in (linear, per_band):
        method.update(first, None)
        assert_array_equal(method.applied, first)
    linear.update(second, 9)
    assert_array_equal(linear.applied[:9], second[:9])
    assert not linear.applied[9:].any()
    for _ in range(13):
        per_band.update(second, 2)
    assert_array_equal(per_band.applied, second)
