"""Visible areas of texels by strata: against many more rays, for what is finer than texels, and what they cost."""

from dataclasses import replace
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from conftest import build, diffuse, problem_at

import mi_sparse_prt as prt
from mi_sparse_prt.estimation.pilot_elements import PilotElements
from mi_sparse_prt.measurement.vertices import Points
from mi_sparse_prt.methods.plan import Plan
from mi_sparse_prt.operators.mean_cosine import MeanCosine
from mi_sparse_prt.planner import pilot
from mi_sparse_prt.planner.choice import Costs
from mi_sparse_prt.planner.direct_costs import DirectCost, adaptive_cost, points_at
from mi_sparse_prt.planner.path_costs import PathCosts
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.solvers import adaptive_strata
from mi_sparse_prt.solvers.adaptive_strata import ACROSS, Strata, adaptive_visibility
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.problem import Problem

T = mi.ScalarTransform4f
LIGHTING = prt.CubemapLighting(8)


def under_slats(pitch: float, gap: float, bsdf: dict | None = None, beside: dict | None = None) -> Scene:
    """A floor of 2 x 2 under slats at a height of 1, with gaps of a share of their pitch."""
    slats = {
        f"slat_{k}": {
            "type": "rectangle",
            "bsdf": bsdf or diffuse(0.5, 0.5, 0.5),
            "to_world": T().translate([x, 0, 1]).scale([pitch * (1 - gap) / 2, 6, 1]).rotate([1, 0, 0], 180),
        }
        for k, x in enumerate(np.arange(-4, 4, pitch))
    }
    return build(0.4, floor={"type": "rectangle", "bsdf": diffuse(0.5, 0.5, 0.5)}, **slats)


def floor_of(scene: Scene, lighting: prt.CubemapLighting = LIGHTING) -> Problem:
    problem = problem_at(scene, lighting, basis="texel")
    inside = scene.meshes[0].vertices
    return problem.at(points_at(problem.points, np.arange(inside.start, inside.stop)))


def rows(problem: Problem, strata: int, seed: int) -> np.ndarray:
    """Direct light of all points, by as many strata in each texel."""
    found = DirectSolver(problem, strata, seed).rows(np.arange(len(problem.points)))
    return MeanCosine(found, problem.emission).rows(np.arange(len(found)))[..., 0].astype(float)


def error_of(ours: np.ndarray, x: np.ndarray, y: np.ndarray) -> float:
    """Relative L2, without the noise of two estimates."""
    return float(np.sqrt(((ours - x) * (ours - y)).sum() / (x * y).sum()))


@pytest.mark.parametrize("first", [1, 2])
def test_few_rays_where_little_is_seen_in_part(first):
    """One board above the floor: less than half of the rays of 6 x 6 strata everywhere, for 1.25 times its error."""
    board = {"type": "rectangle", "bsdf": diffuse(0.5, 0.5, 0.5), "to_world": T().translate([0, 0, 2])}
    problem = floor_of(build(0.4, floor={"type": "rectangle", "bsdf": diffuse(0.5, 0.5, 0.5)}, board=board))
    x, y = (rows(problem, 16, seed) for seed in (101, 102))
    found, rays = adaptive_visibility(problem, Strata(first, 6), 5)
    ours = found.rows(np.arange(len(problem.points)))[..., 0]
    assert error_of(ours, x, y) < 1.25 * error_of(rows(problem, 6, 7), x, y)
    assert rays.sum() < 6**2 * x.size / 4


@pytest.mark.parametrize(
    ("gap", "across"), [pytest.param(0.5, 4, marks=pytest.mark.slow), (0.5, 8), (0.2, 6)]
)
def test_as_exact_as_strata_everywhere(gap, across):
    """
    Scenario: slats and gaps of 0.3, under which texels at the zenith are cut once or twice.
    Expected: at most 1.25 times the error of as many strata in all texels, a quarter of that of 2 x 2 at 8 x 8; all
        light that arrives, within 1%.
    """
    problem = floor_of(under_slats(0.6, gap))
    x, y = (rows(problem, 16, seed) for seed in (101, 102))
    found, _ = adaptive_visibility(problem, Strata(across=across), 5)
    ours = found.rows(np.arange(len(problem.points)))[..., 0]
    exact, few = (error_of(rows(problem, strata, 7), x, y) for strata in (across, 2))
    assert error_of(ours, x, y) < 1.25 * exact
    assert across < 8 or error_of(ours, x, y) < few / 4
    assert ours.sum() == pytest.approx((x + y).sum() / 2, rel=0.01)


@pytest.mark.parametrize("first", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_light_through_narrow_gaps_is_not_lost(first):
    """
    Scenario: gaps of 1% of the slats: a texel and those around it have one of 36 rays in a gap, or none.
    Expected: all light that arrives, within four standard errors of independent runs, and these within 2%.
    """
    problem = floor_of(under_slats(0.6, 0.01))
    truth = np.mean([rows(problem, 24, seed).sum() for seed in range(101, 105)])
    sums = [
        adaptive_visibility(problem, Strata(first, 6), 10 * seed)[0]
        .rows(np.arange(len(problem.points)))
        .sum()
        for seed in range(12)
    ]
    error = np.std(sums, ddof=1) / np.sqrt(len(sums))
    assert error < 0.02 * truth
    assert np.mean(sums) == pytest.approx(truth, abs=4 * error + 0.01 * truth)


def test_the_same_for_any_block_of_points(monkeypatch):
    problem = floor_of(under_slats(0.6, 0.5))
    whole, rays = adaptive_visibility(problem, Strata(across=3), 1)
    monkeypatch.setattr(adaptive_strata, "ELEMENTS", 7 * LIGHTING.n_directions)
    parts, as_many = adaptive_visibility(problem, Strata(across=3), 1)
    assert np.array_equal(rays, as_many)
    for name in ("bits", "starts", "texels", "shares"):
        assert np.array_equal(getattr(whole, name), getattr(parts, name))
    other, _ = adaptive_visibility(problem, Strata(across=3), 2)
    assert not np.array_equal(whole.shares, other.shares)


def test_no_strata_are_refused():
    with pytest.raises(prt.PrtError, match=r"Strata\(first=2, across=0\): both must be at least 1"):
        Plan("adaptive", strata=Strata(across=0))


def test_no_points():
    problem = floor_of(under_slats(0.6, 0.5))
    none = problem.at(Points(*(x[:0] for x in vars(problem.points).values())))
    found, rays = adaptive_visibility(none, Strata(across=3), 1)
    assert found.shape == (0, LIGHTING.n_directions, 1) and len(rays) == 0


def test_below_the_horizon_nothing_is_seen():
    """A floor without anything above: shares of texels that the horizon cuts are those of their part above it."""
    problem = floor_of(build(0.5, floor={"type": "rectangle", "bsdf": diffuse(0.5, 0.5, 0.5)}))
    found, rays = adaptive_visibility(problem, Strata(across=4), 1)
    ours, truth = found.rows(np.arange(len(problem.points)))[..., 0], rows(problem, 16, 3)
    assert np.abs(ours - truth).max() < 0.02 * truth.max()
    one, fewer = adaptive_visibility(problem, Strata(1, 4), 1)
    assert np.array_equal(one.bits, found.bits) and np.array_equal(4 * fewer, rays)
    assert np.all(rays == 4 * LIGHTING.n_directions // 2)


def test_light_that_passes_slats_is_not_in_their_way():
    """Slats of opacity 0 hide nothing: rays that look through surfaces do so stratum by stratum."""
    clear = {"type": "mask", "opacity": 0.0, "nested": diffuse(0.5, 0.5, 0.5)}
    scene = under_slats(0.6, 0.5, clear)
    problem = replace(problem_at(scene, LIGHTING, basis="texel"), specular_apart=True)
    inside = np.arange(scene.meshes[0].vertices.start, scene.meshes[0].vertices.stop)
    problem = problem.at(points_at(problem.points, inside))
    found, _ = adaptive_visibility(problem, Strata(across=3), 1)
    open_floor = floor_of(build(0.4, floor={"type": "rectangle", "bsdf": diffuse(0.5, 0.5, 0.5)}))
    truth = adaptive_visibility(open_floor, Strata(across=3), 1)[0].rows(np.arange(len(inside)))
    assert found.rows(np.arange(len(inside))).sum() == pytest.approx(truth.sum(), rel=1e-3)


def test_strata_that_a_pilot_chooses():
    """
    Expected: the error that a pilot predicts is the true one, within 20%; as many strata as an error takes, the most if
        it takes more; more of them are more exact, and take longer.
    """
    scene = under_slats(0.6, 0.5)
    direct = DirectSolver(problem_at(scene, LIGHTING, basis="texel"))
    x, y = (rows(direct.problem, 10, seed) for seed in (101, 102))
    held = PilotElements(direct.problem, False, 0, 384, 24)
    costs = [adaptive_cost(direct, held, aim, 0) for aim in (0.5, 0.012, 1e-6)]
    assert costs[0].strata == Strata(1, ACROSS[0]) and costs[-1].strata == Strata(2, ACROSS[-1])
    assert costs[0].error > costs[1].error >= costs[2].error
    for cost in costs[:2]:  # the most strata of all take seconds
        assert cost.strata is not None
        plan = Plan("adaptive", strata=cost.strata)
        found = prt.precompute(scene, LIGHTING, plan, "texel", max_depth=2, progress=False)
        assert found.report["plan"]["parameters"] == {"strata": cost.strata._asdict()}
        ours = found.rows(np.arange(len(x)))[..., 0] / 0.5
        assert cost.error == pytest.approx(error_of(ours, x, y), rel=0.2)


def test_points_of_a_pilot_stand_for_those_of_their_mesh():
    """
    Scenario: a floor under a board, and an open one with many more points; a pilot looks at as many of each.
    Expected: rays that it predicts for all points, within 10%. Were each of its points one of as many, they would be
        30% more at the least; a choice of points, each as often as it stands for others, has the right share of both.
    """
    grey, to_world = (
        diffuse(0.5, 0.5, 0.5),
        [T().translate([0, 0, 1]).scale(0.5), T().translate([50, 0, 0]).scale(5)],
    )
    shapes = [{"type": "rectangle", "bsdf": grey} | ({"to_world": t} if t else {}) for t in (None, *to_world)]
    scene = build(0.2, optimize=False, floor=shapes[0], board=shapes[1], wide=shapes[2])
    direct = DirectSolver(problem_at(scene, LIGHTING, basis="texel"))
    held = PilotElements(direct.problem, False, 0, 64, 8)
    n, strata = len(direct.points), Strata(1, 6)
    rays = adaptive_visibility(direct.problem, strata, 0)[1].sum()
    some = adaptive_visibility(direct.problem.at(points_at(direct.points, held.vertices)), strata, 0)[1]
    assert held.stand_for.sum() == pytest.approx(n)
    assert held.stand_for @ some == pytest.approx(rays, rel=0.1)
    assert some.mean() * n > 1.3 * rays
    often = held.shares_of(1000)
    assert often.sum() == 1000 and np.abs(often - 1000 * held.stand_for / n).max() <= 1


@pytest.mark.parametrize(
    ("bias", "path", "aim"),
    [
        # half of the square of 95% of the target
        (0.01, 1e6, 0.95 * 0.05 / 2**0.5),
        # paths have no floor, and take 444 / 4 seconds
        (0.1, 1.0, 0.95 * 0.05 / 2**0.5),
        # sqrt(0.2^2 + aim^2) is 0.2 / 0.9
        (0.1, 1e6, 0.2 * (0.9**-2 - 1) ** 0.5),
    ],
    ids=["no floor", "quick paths", "floor"],
)
def test_direct_light_is_as_exact_as_is_worth_beside_a_floor(bias, path, aim, monkeypatch):
    """A pilot asks for strata of this error: bounces make a bias of the first one twice as large."""
    asked = []
    monkeypatch.setattr(
        pilot, "adaptive_cost", lambda _d, _h, aim, _s: asked.append(aim) or DirectCost(1.0, aim)
    )
    gather = SimpleNamespace(growth=2.0, bias=bias)
    paths = PathCosts(seconds={8: path}, noise={8: 1.0}, bias={8: 0.0})
    costs = Costs(0.0, {"edges": DirectCost(1.0, 0.5)}, gather=gather, paths=paths)
    settings = SimpleNamespace(method="auto", basis="texel", target_error=0.05, max_seconds=300.0, seed=0)
    found = pilot._with_adaptive(costs, None, None, settings)
    assert asked == [pytest.approx(aim, rel=1e-6)]
    assert set(found.direct) == {"edges", "adaptive"}
