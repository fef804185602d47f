"""Light that goes straight through surfaces: noise of neighbouring elements together, and few rays without edges."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import T, build, diffuse, problem_at
from numpy.testing import assert_allclose

import mi_sparse_prt as prt
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.passed_light import PassingLight, _are_alike, _rays_of, _sum_beside
from mi_sparse_prt.solvers.refined_mean import Limit, Timed


def test_values_are_added_to_those_of_texels_beside():
    """Expected: what a loop over rows of all texels adds up, where some elements are not listed; rows may be empty."""
    rng, lighting = np.random.default_rng(3), prt.CubemapLighting(4)
    beside, size = lighting.sides.tables.beside, lighting.n_directions
    listed = rng.random((7, size)) < 0.4
    listed[2] = False
    rows, texels = np.nonzero(listed)
    values = rng.random(len(rows))
    every = np.zeros((7, size))
    every[rows, texels] = values
    expected = np.array(
        [every[i, j] + sum(every[i, k] for k in beside[j]) for i, j in zip(rows, texels, strict=True)]
    )
    sums = np.empty(len(rows))
    starts = np.searchsorted(rows, np.arange(8))
    for first, last in ((0, 3), (3, 7)):
        _sum_beside(first, last, starts, texels, values, beside, sums)
    assert_allclose(sums, expected, rtol=1e-12)


@pytest.fixture(scope="module")
def problem():
    """A floor under a half-open sheet and a pane; some of its points."""
    shapes = {
        "floor": {
            "type": "rectangle",
            "to_world": T().rotate([1, 0, 0], -90),
            "bsdf": diffuse(0.5, 0.5, 0.5),
        },
        "sheet": {
            "type": "rectangle",
            "to_world": T().translate([-0.6, 0.7, 0]).rotate([1, 0, 0], 70).scale(0.6),
            "bsdf": {
                "type": "mask",
                "opacity": 0.4,
                "bsdf": {"type": "twosided", "bsdf": diffuse(0.5, 0.5, 0.5)},
            },
        },
        "pane": {
            "type": "rectangle",
            "to_world": T().translate([0.7, 0.8, 0]).rotate([0, 1, 0], 60).scale(0.5),
            "bsdf": {"type": "thindielectric"},
        },
    }
    scene = build(0.4, **shapes)
    return replace(problem_at(scene, prt.CubemapLighting(16), basis="texel"), specular_apart=True)


IDS = np.arange(0, 24, 2)  # of the floor


def search(problem, seed):
    seeds = np.random.default_rng(seed).integers(1 << 31, size=95).tolist()
    return PassingLight(problem, IDS, np.ones((len(IDS), 3)), seeds)


def test_elements_without_edges(problem):
    """Expected: those that let as much pass as all texels beside them above the horizon, by as many surfaces."""
    light = search(problem, 1)
    lighting, depths = problem.emission, problem.depths_apart
    cosine = problem.points.normals[IDS] @ lighting.directions.T
    power = np.where(cosine > 0, cosine * lighting.solid_angles / np.pi, np.inf)
    by_depth = light._found.toarray().reshape(len(IDS), depths, -1) / power[:, None]
    share, met = by_depth.sum(axis=1), by_depth.argmax(axis=1)
    expected = [
        share[i, j] > 0
        and all(
            cosine[i, k] <= 0
            or (met[i, k] == met[i, j] and abs(share[i, k] - share[i, j]) <= 0.1 * share[i, j])
            for k in lighting.sides.tables.beside[j]
        )
        for i, j in zip(light._rows, light._texels, strict=True)
    ]
    assert np.array_equal(light._without_edges(), expected)
    assert 0.1 < np.mean(expected) < 0.9


def test_rays_that_there_is_time_for(problem, monkeypatch):
    """
    Expected: first, one ray in each element where strata take longer than there is time for; then as many in all as
        are affordable, and nearly as many, or none at all if there is no time for one in each.
    """
    light = search(problem, 3)
    light._timed = Timed(1.0, 2 * len(light._rows))
    assert light.estimated(seconds=1.5)._expected > 4 * search(problem, 3).estimated()._expected
    affordable = 2 * 5 * len(light._rows)
    traced, sampled = [], light._sampled
    monkeypatch.setattr(light, "_sampled", lambda strata: traced.append(_rays_of(strata)) or sampled(strata))
    rounds = light.estimated()
    assert rounds._sample(1e-12, affordable) is not None
    assert rounds._sample(1e-12, 2 * len(light._rows) - 1) is None
    assert 0.5 * affordable < traced[1] <= affordable and len(traced) == 2


def test_first_rays_in_no_time_are_unbiased(problem):
    """Expected: one ray of each half in each element finds the light of 256 rays, on average; 2% would show."""
    n = problem.emission.n_directions
    fine = DirectSolver(problem, 16).partly_passed(np.repeat(IDS, n), np.tile(np.arange(n), len(IDS)))
    sums = [
        search(problem, seed).estimated(seconds=0.0).mean()[0].sum() / fine.values.sum() for seed in range(12)
    ]
    spread = np.std(sums, ddof=1) / np.sqrt(len(sums))
    print(f"{np.mean(sums):.4f} +- {spread:.4f}")
    assert spread < 0.0045
    assert np.mean(sums) == pytest.approx(1, abs=4 * spread + 0.001)


def test_light_that_rounding_leaves_at_the_horizon():
    """A cosine of exactly 0 beside light that came by one of 1e-9: an edge, and no division by it."""
    lighting = prt.CubemapLighting(1)
    beside = lighting.sides.tables.beside
    normals, powers = np.float32([[0, 1, 0]]), lighting.solid_angles / np.float32(np.pi)
    up, side = (int(np.argmax(lighting.directions @ axis)) for axis in ([0, 1, 0], [1, 0, 0]))
    assert lighting.directions[side, 1] == 0
    columns = np.sort([up, side]).astype(np.int32)
    values = np.where(columns == up, powers[up], 1e-9).astype(np.float32)
    found, alike = (np.int32([0, 2]), columns, values), np.ones(2, bool)
    where = normals, lighting.directions, powers
    _are_alike(0, 1, np.array([0, 2]), columns.astype(np.int64), found, where, beside, alike)
    assert alike.tolist() == [bool(c == up) for c in columns]


def test_few_rays_without_edges_take_nothing_away(problem):
    """Expected: light is that of 256 rays in each texel, within its noise, which is as large as is told."""
    n = problem.emission.n_directions
    fine = DirectSolver(problem, 16).partly_passed(np.repeat(IDS, n), np.tile(np.arange(n), len(IDS)))
    exact = np.zeros(len(IDS) * n)
    exact[fine.elements] = fine.values.sum(axis=1)
    sums, errors, told = [], [], []
    for seed in range(8):
        light = search(problem, seed).estimated()
        if seed % 2:
            light.refine(Limit(1e-3, 0.0, 0.0))
        (mean,) = light.mean()
        found = mean.toarray().reshape(len(IDS), -1, n).sum(axis=1).ravel()
        sums.append(found.sum() / exact.sum())
        errors.append(3 * np.square(found - exact).sum())
        told.append(light.noise)
    spread = np.std(sums, ddof=1) / np.sqrt(len(sums))
    print(f"{np.mean(sums):.4f} +- {spread:.4f}; told {told}, true {errors}")
    assert spread < 0.004
    assert np.mean(sums) == pytest.approx(1, abs=4 * spread + 0.001)
    for half in (slice(0, None, 2), slice(1, None, 2)):
        assert np.sqrt(np.mean(told[half])) == pytest.approx(np.sqrt(np.mean(errors[half])), rel=0.15)
    assert np.mean(told[1::2]) < 0.5 * np.mean(told[::2])
