"""Rays go where what they find is seen: few to dark surfaces, none to those that keep no light."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import T, build, diffuse, problem_at

import mi_sparse_prt as prt
from mi_sparse_prt.operators.mean_cosine import MeanCosine
from mi_sparse_prt.planner.direct_costs import points_at
from mi_sparse_prt.reflection.surfaces import vertex_reflection
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.solvers.adaptive_strata import Strata, adaptive_visibility, importance_of
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.problem import Problem
from mi_sparse_prt.solvers.specular import SpecularOptions, specular_light

LIGHTING = prt.CubemapLighting(8)
DARK, WHITE = diffuse(0.004, 0.004, 0.004), diffuse(0.8, 0.8, 0.8)


def mean_square_of(bsdf: dict) -> float:
    """Of (pi f)^2, by squared incident and outgoing cosines; 1 of a white diffuse one."""
    rng, n = np.random.default_rng(0), 1 << 18
    incoming, outgoing = (
        mi.warp.square_to_cosine_hemisphere(mi.Point2f(*rng.random((2, n)).astype(np.float32)))
        for _ in range(2)
    )
    si = dr.zeros(mi.SurfaceInteraction3f, n)
    si.wi = outgoing
    weighted = mi.load_dict(bsdf).eval(mi.BSDFContext(), si, incoming)  # times the cosine of what comes in
    squares = np.square(np.pi * np.array(weighted)) / np.array(mi.Frame3f.cos_theta(incoming))
    # the integral of cos is pi, that of cos^2 is 2 pi / 3
    return float(squares.mean() * np.pi / (2 * np.pi / 3))


@pytest.mark.parametrize("alpha", [0.4, 0.5])
def test_importance_of_glossy_surfaces_is_that_of_their_brdf(alpha):
    """Truth: the mean square of Mitsuba's BRDF, of which many terms miss little."""
    bsdf = {"type": "roughconductor", "material": "Cu", "alpha": alpha}
    scene = build(1.0, floor={"type": "rectangle", "bsdf": bsdf})
    found = vertex_reflection(scene, 16, None).importance
    assert np.ptp(found) == 0
    assert found[0] ** 2 == pytest.approx(mean_square_of(bsdf), rel=0.05)


def test_importance_of_diffuse_surfaces_is_their_albedo():
    scene = build(1.0, floor={"type": "rectangle", "bsdf": diffuse(0.2, 0.4, 0.6)})
    found = problem_at(scene, LIGHTING).reflection.importance
    assert found == pytest.approx(np.sqrt((0.04 + 0.16 + 0.36) / 3))
    assert mean_square_of(diffuse(0.5, 0.5, 0.5)) == pytest.approx(0.25, rel=0.01)


def floors_under_slats(*bsdfs: dict) -> tuple[Problem, list[slice]]:
    """Floors beside each other under slats, in the texel basis; the vertices of each floor."""
    slats = {
        f"slat_{k}": {
            "type": "rectangle",
            "bsdf": DARK,
            "to_world": T().translate([x, 0, 1]).scale([0.15, 12, 1]).rotate([1, 0, 0], 180),
        }
        for k, x in enumerate(np.arange(-1.5, 1.6, 0.6))
    }
    floors = {
        f"floor_{k}": {"type": "rectangle", "bsdf": bsdf, "to_world": T().translate([0, 6 * k, 0])}
        for k, bsdf in enumerate(bsdfs)
    }
    scene = build(0.5, optimize=False, **floors, **slats)
    return problem_at(scene, LIGHTING, basis="texel"), [mesh.vertices for mesh in scene.meshes[: len(bsdfs)]]


def test_no_rays_are_spent_on_dark_surfaces():
    """
    Scenario: floors of albedo 0.8, 0.004 and 0 under the same slats.
    Expected: the first as exact as if all counted alike; the others one ray a texel, without bias (in the mean of 16
        runs, within four standard errors), as what is dark in one picture is bright in the next.
    """
    problem, (bright, dark, black) = floors_under_slats(WHITE, DARK, diffuse(0.0, 0.0, 0.0))
    floors = np.arange(black.stop)
    x, y = (rows(problem.at(points_at(problem.points, floors)), 12, seed) for seed in (101, 102))

    def visible(seed: int, importance: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        found, rays = adaptive_visibility(problem, Strata(1, 5), seed, importance)
        return found.rows(floors)[..., 0].astype(float), rays

    even, even_rays = visible(3, np.ones(len(problem.points), np.float32))
    found, rays = visible(3)
    errors = [float(np.sqrt(((ours - x) * (ours - y))[bright].sum())) for ours in (even, found)]
    assert errors[1] < 1.1 * errors[0]
    assert rays[bright].sum() < 1.1 * even_rays[bright].sum()
    assert even_rays[dark].mean() > 4 * LIGHTING.n_directions
    assert max(rays[dark].max(), rays[black].max()) <= LIGHTING.n_directions
    sums, expected = [visible(seed)[0][dark].sum() for seed in range(16)], (x + y)[dark].sum() / 2
    error = np.std(sums, ddof=1) / 4
    assert error < 0.005 * expected
    assert np.mean(sums) == pytest.approx(expected, abs=4 * error + 0.002 * expected)


def rows(problem: Problem, strata: int, seed: int) -> np.ndarray:
    """Direct light (n, n_texels), by as many strata in each texel."""
    found = DirectSolver(problem, strata, seed).rows(np.arange(len(problem.points)))
    return MeanCosine(found, problem.emission).rows(np.arange(len(found)))[..., 0].astype(float)


def test_black_vertices_of_a_bright_texture_count_as_it_does():
    """Vertices at black squares of a chequered floor: pictures have white ones between them."""
    texture = {"type": "checkerboard", "color0": 0.0, "color1": 0.8, "to_uv": T().scale([3.3, 3.3, 1])}
    problem, _ = floors_under_slats({"type": "diffuse", "reflectance": texture})
    albedo = problem.reflection.albedo.mean(axis=1)
    floor = slice(0, problem.scene.meshes[0].vertices.stop)
    assert (albedo[floor] < 0.01).any()
    assert importance_of(problem)[floor].min() > 0.5


def before_a_mirror(*around: dict, edge_length: float = 0.15) -> Scene:
    """A white floor in front of a mirror; a little lower, a floor of 16 times its size around it."""
    mirror = {
        "type": "rectangle",
        "bsdf": {"type": "conductor", "material": "Ag"},
        "to_world": T().translate([0, 1, 1]).rotate([1, 0, 0], 90),
    }
    wide = T().translate([0, 0, -0.05]).scale(4)
    floors = {f"wide_{k}": {"type": "rectangle", "bsdf": b, "to_world": wide} for k, b in enumerate(around)}
    white = {"type": "rectangle", "bsdf": WHITE}
    return build(edge_length, optimize=False, floor=white, mirror=mirror, **floors)


@pytest.mark.parametrize("albedo", [0.004, pytest.param(0.0, marks=pytest.mark.slow)])
def test_rays_towards_mirrors_start_where_their_light_is_seen(albedo):
    """
    Scenario: a white floor before a mirror, alone and on a wide dark one; noise of 1% is asked for.
    Expected: at most 1.1 times the rays, beside those that look for mirrors (1.25 if a dark floor counted an eighth of
        the white one); a black one has no light at all, as nobody sees it.
    """
    options = SpecularOptions(error=0.01)
    rays = []
    for around in ((), (diffuse(albedo, albedo, albedo),)):
        problem = replace(problem_at(before_a_mirror(*around), LIGHTING, basis="texel"), specular_apart=True)
        found = specular_light(problem, 1, options)
        assert found.error < 1.2 * options.error
        rays.append(found.rays - 256 * len(problem.points))
    assert rays[1] < 1.1 * rays[0]
    lit = np.diff(found.matrices[0].indptr) > 0
    floor, wide = problem.scene.meshes[0].vertices, problem.scene.meshes[2].vertices
    assert lit[floor].mean() > 0.9 and lit[wide].any() == (albedo > 0)


def test_few_rays_of_dark_surfaces_lose_no_light():
    """What a wide dark floor receives from a mirror, from few rays: in the mean of 8 runs, that of many everywhere.

    Within four standard errors, and these within half a percent.
    """
    problem = problem_at(before_a_mirror(diffuse(0.02, 0.02, 0.02), edge_length=0.3), LIGHTING, basis="texel")
    problem, wide = replace(problem, specular_apart=True), problem.scene.meshes[2].vertices
    ids = np.arange(wide.start, wide.stop)

    def received(seed: int, options: SpecularOptions) -> float:
        return float(specular_light(problem, seed, options).matrices[0][ids].sum())

    truth = np.mean([received(seed, SpecularOptions(4, 4)) for seed in (101, 102)])
    sums = [received(seed, SpecularOptions(error=0.02)) for seed in range(8)]
    error = np.std(sums, ddof=1) / np.sqrt(len(sums))
    print(f"{np.mean(sums) / truth - 1:.3%} +- {error / truth:.3%}")
    assert error < 0.005 * truth
    assert np.mean(sums) == pytest.approx(truth, abs=4 * error + 0.002 * truth)
