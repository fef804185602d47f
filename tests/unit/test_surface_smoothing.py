"""Noise averaged out along surfaces, as far as Stein's estimate says that it is worth it."""

import numpy as np
import pytest
from conftest import T, build, diffuse

from mi_sparse_prt.core.threads import run_in_parts
from mi_sparse_prt.measurement.vertices import vertex_points
from mi_sparse_prt.reconstruction.surface_smoothing import _risks, smooth_light, smoothing_levels


def _room(**others):
    """A floor of 4 x 4 under a thin wall that divides it."""
    floor = {
        "type": "rectangle",
        "to_world": T().rotate([1, 0, 0], -90).scale(2),
        "bsdf": diffuse(0.5, 0.5, 0.5),
    }
    wall = {
        "type": "cube",
        "to_world": T().translate([0, 1, 0]).scale([0.01, 1, 2]),
        "bsdf": diffuse(0.5, 0.5, 0.5),
    }
    return build(edge_length=0.08, floor=floor, wall=wall, **others)


@pytest.fixture(scope="module")
def scene():
    return _room()


@pytest.fixture(scope="module")
def levels(scene):
    return smoothing_levels(scene, vertex_points(scene))


@pytest.mark.parametrize("number", range(3))
def test_a_level_keeps_what_is_linear_and_stays_on_its_side(scene, levels, number):
    """Expected: weights sum to 1; no vertex of the floor takes light from the other side of the wall."""
    step, reach = levels[number], (0.5, 0.5, 1.2)[number]
    np.testing.assert_allclose(step.sum(axis=1), 1, atol=1e-5)
    floor = next(mesh for mesh in scene.meshes if mesh.name == "floor").vertices
    x = scene.positions[floor, 0]
    row, column = step[floor, floor].nonzero()
    apart = (np.abs(x[row]) > 0.02) & (np.abs(x[column]) > 0.02)  # and not below the wall
    assert apart.any()
    assert (x[row] * x[column] > 0)[apart].all()
    inner = np.abs(scene.positions[floor][:, [0, 2]]).max(axis=1) < 2 - reach
    inner &= np.abs(np.abs(x) - 1) < 1 - reach if number < 2 else np.abs(np.abs(x) - 1) < 0.3
    assert inner.sum() > 50
    smooth = step[floor, floor] @ scene.positions[floor]
    np.testing.assert_allclose(smooth[inner], scene.positions[floor][inner], atol=0.02)


def test_noise_goes_and_light_stays(scene, levels):
    """Rationale: of light that is smooth, noise is averaged over many vertices; at edges of shadows, over few.

    Expected: of 10% noise less than 3.5% is left of smooth light, and its mean is the same within 1%. A shadow whose
    edge is sharp loses a third of the error at least. A closed room beside a bright one is exactly as dark as before.
    """
    rng = np.random.default_rng(3)
    p = scene.positions
    even = (1 + 0.5 * np.sin(1.5 * p[:, 0]) * np.cos(1.2 * p[:, 2]))[:, None, None] * np.ones((1, 1, 3))
    shadow = np.where(p[:, :1, None] + 0.3 * p[:, 2:, None] > 0.9, 1.0, 0.2) * np.ones((1, 1, 3))
    closed = np.where(p[:, :1, None] > 0, 1.0, 0.0) * np.ones((1, 1, 3))
    truth = np.concatenate([even, shadow, closed], axis=1)
    deviation = 0.1 * truth
    noisy = (truth + deviation * rng.normal(size=truth.shape)).astype(np.float32)
    found = smooth_light(noisy, (deviation**2).astype(np.float32), levels)
    error = np.sqrt(((found - truth) ** 2).mean(axis=(0, 2)) / (truth**2).mean(axis=(0, 2)))
    print(error, found.mean(axis=(0, 2)) / truth.mean(axis=(0, 2)))
    assert error[0] < 0.035
    assert error[1] < 0.1 * 2 / 3
    np.testing.assert_allclose(found.mean(axis=(0, 2)) / truth.mean(axis=(0, 2)), 1, atol=0.01)
    floor = next(mesh for mesh in scene.meshes if mesh.name == "floor").vertices
    dark = np.flatnonzero(p[floor, 0] < -0.02) + floor.start
    assert not found[dark, 2].any()


def test_without_noise_nothing_changes(scene, levels):
    """Expected: as given, where variances are 0; with little noise, what is no noise is kept."""
    rng = np.random.default_rng(4)
    light = rng.random((scene.n_vertices, 1, 3)).astype(np.float32)
    np.testing.assert_array_equal(smooth_light(light, np.zeros_like(light), levels), light)
    kept = smooth_light(light, np.full_like(light, 1e-8), levels)
    np.testing.assert_allclose(kept, light, atol=1e-5)


def test_noisy_peaks_keep_their_light(scene, levels):
    """Rationale: light of a lamp close to a floor is smoothed widely around its peak, and little at the peak.

    Expected: where noise is as large as light, the sum over the floor is that of the light that was given within 2%, of
    which the standard error of 64 draws is less than a quarter.
    """
    p, rng = scene.positions, np.random.default_rng(5)
    distance = np.square(p - [-1, 0.2, 0.3]).sum(axis=1)
    truth = (distance**-2.0)[:, None, None] * np.ones((1, 1, 3))
    floor = next(mesh for mesh in scene.meshes if mesh.name == "floor").vertices
    off = []
    for _ in range(64):
        noisy = (truth * rng.exponential(size=(len(truth), 1, 1))).astype(np.float32)
        found = smooth_light(noisy, (truth**2).astype(np.float32), levels)
        off.append((found - noisy)[floor].sum() / truth[floor].sum())
    print(f"{np.mean(off):.2%} +- {np.std(off) / 8:.2%}")
    assert abs(np.mean(off)) < 0.02
    assert np.std(off) / 8 < 0.005


def test_risk_is_steins_estimate():
    """
    Expected: |S x - x|^2 + (2 S_ii - 1) s^2 of all channels of each lamp, as NumPy has it, to rounding.
    """
    rng = np.random.default_rng(5)
    smooth, light, noise = (rng.random((50, 12), np.float32) for _ in "xyz")
    counts, found = 2 * rng.random(50, np.float32) - 1, np.empty((50, 4), np.float32)
    run_in_parts(_risks, 50, smooth, light, noise, counts, 3, found)
    expected = ((smooth - light) ** 2 + counts[:, None] * noise).reshape(50, 4, 3).sum(axis=2)
    assert np.allclose(found, expected, rtol=1e-5, atol=1e-6)
