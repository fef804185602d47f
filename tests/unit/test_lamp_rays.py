"""Direct light of lamps, where they are next to what they light."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import T, build

import mi_sparse_prt as prt
from mi_sparse_prt.estimation.element_sampling import draw_by_energy
from mi_sparse_prt.estimation.held_out_lamps import held_out_lamp_error
from mi_sparse_prt.measurement.measurement import mesh_vertices
from mi_sparse_prt.operators.dense import Dense
from mi_sparse_prt.reflection.reflection import Diffuse
from mi_sparse_prt.solvers.lamps import LampRays, LightByPaths
from mi_sparse_prt.solvers.problem import Problem

FLOOR = {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": 0.8}}


def under_a_lamp(gap: float) -> Problem:
    """A square of 0.2 x 0.2 over a floor of 2 x 2."""
    scene = build(
        edge_length=0.5,
        floor=FLOOR,
        lamp={
            "type": "rectangle",
            "to_world": T().translate([0, 0, gap]).rotate([1, 0, 0], 180).scale(0.1),
            "emitter": {"type": "area", "radiance": 1.0},
        },
    )
    lamps = prt.SceneEmitters(scene)
    return Problem(scene, lamps, mesh_vertices(scene), Diffuse(scene.albedo), "texel", 4)


@pytest.mark.parametrize("gap", [0.001, pytest.param(0.01, marks=pytest.mark.slow), 0.1])
def test_lamps_next_to_a_surface_light_it_without_much_noise(gap):
    """Rationale: samples of a lamp see the place above a point seldom, which then counts without bounds.

    Truth: the form factor of a square above a point; 64 seeds. Expected: their mean within four standard errors, each
    within 10% (standard deviation 3%), and as much noise as variances tell, within a half.
    Result: 0.5 to 1%; by shadow rays alone 640% of 1 mm below, 24% of 1 cm.
    """
    problem = under_a_lamp(gap)
    below = np.flatnonzero((np.abs(problem.scene.positions) < 1e-5).all(axis=1))
    cosine = 0.1 / np.hypot(0.1, gap)
    truth = 4 / np.pi * np.arctan(cosine) * cosine
    seeds = [LampRays(problem, 16, seed).elements(below, np.zeros(1, int)) for seed in range(64)]
    found = np.array([float(x.mean[0, 0]) for x in seeds])
    spread, told = found.std(ddof=1), np.sqrt(np.mean([x.variance[0, 0] for x in seeds]))
    assert abs(found.mean() - truth) < 4 * spread / np.sqrt(len(found))
    assert spread < 0.03 * truth
    np.testing.assert_allclose(found, truth, rtol=0.1)
    assert told > spread / 1.5  # strata are left out of account: it may be more


def test_few_elements_stand_for_all():
    """Rationale: those drawn by energy must add up to all of any other quantity, too. 4000 draws of about 32 of 500."""
    rng = np.random.default_rng(5)
    energy, other = rng.exponential(1, 500) ** 3, rng.normal(2, 1, 500)
    groups = slice(0, 180), slice(180, 500)
    sums = []
    for _ in range(4000):
        drawn = [draw_by_energy(energy, group, 32, 2, rng) for group in groups]
        chosen, weights = (np.concatenate(part) for part in zip(*drawn, strict=True))
        sums.append([weights.sum(), weights @ energy[chosen], weights @ other[chosen]])
    assert 31 <= len(chosen) <= 33
    truth = np.array([500, energy.sum(), other.sum()])
    error = np.std(sums, axis=0, ddof=1) / np.sqrt(len(sums))
    assert (error < 0.005 * truth).all()
    assert (np.abs(np.mean(sums, axis=0) - truth) < 4 * error).all()
    chosen, weights = draw_by_energy(energy, slice(100, 500), 1000, 2, rng)
    np.testing.assert_array_equal(chosen, np.arange(100, 500))
    assert (weights == 1).all()


@pytest.mark.slow
def test_the_error_of_a_matrix_of_lamps_next_to_surfaces_is_told():
    """Rationale: a post under a ball that shines has most of its light, and a few points drawn evenly miss it.

    The matrix has errors of 10% by chance, those of the post 30%. Truth: all elements by many rays and paths.
    Expected: eight seeds tell the true error within 20% on average, each of them within a half.
    """
    scene = build(
        edge_length=0.25,
        floor={**FLOOR, "to_world": T().rotate([1, 0, 0], -90)},
        post={
            "type": "cube",
            "to_world": T().translate([0, 0.1, 0]).scale([0.02, 0.099, 0.02]),
            "bsdf": {"type": "diffuse", "reflectance": 0.5},
        },
        ball={
            "type": "sphere",
            "center": [0, 0.3, 0],
            "radius": 0.1,
            "emitter": {"type": "area", "radiance": 1.0},
        },
    )
    problem = Problem(
        scene, prt.SceneEmitters(scene), mesh_vertices(scene), Diffuse(scene.albedo), "texel", 3
    )
    n = scene.n_vertices
    every = np.arange(n), np.zeros(n, int)
    direct = LampRays(problem, 64, 1).elements(*every).mean
    indirect = LightByPaths(problem, *every, 4096, 2).estimate().mean
    right = direct + indirect
    rng = np.random.default_rng(3)
    off = rng.choice([-1.0, 1.0], n)[:, None] * np.where(scene.positions[:, 1] > 0.01, 0.3, 0.1)[:, None]
    transport = prt.precompute(
        scene, prt.SceneEmitters(scene), max_depth=3, method="brute_force", spp=16, progress=False
    )
    operators = {"direct": Dense((direct * (1 + off))[:, None].astype(np.float32))}
    operators["indirect"] = Dense((indirect * (1 + off))[:, None].astype(np.float32))
    wrong = replace(transport, operators=operators)
    power = scene.albedo.astype(np.float64) ** 2
    truth = np.sqrt((power * (right * off) ** 2).sum() / (power * right**2).sum())
    told = np.array([held_out_lamp_error(problem, wrong, seed).total for seed in range(8)])
    assert told.mean() == pytest.approx(truth, rel=0.2)
    np.testing.assert_allclose(told, truth, rtol=0.5)
