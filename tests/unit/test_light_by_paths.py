"""Indirect light of lamps: where paths spread there are more of them, and near lamps are met by chance."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import T, build
from numpy.typing import NDArray

import mi_sparse_prt as prt
from mi_sparse_prt.core.run import Run
from mi_sparse_prt.measurement.measurement import mesh_vertices
from mi_sparse_prt.methods import lamps
from mi_sparse_prt.methods.lamps import path_traced_lamps
from mi_sparse_prt.methods.result import MethodResult
from mi_sparse_prt.reconstruction import lamp_light
from mi_sparse_prt.reconstruction.lamp_light import LampLight
from mi_sparse_prt.reconstruction.node_placement import choose_nodes
from mi_sparse_prt.reconstruction.surface_smoothing import smoothing_levels
from mi_sparse_prt.reflection.reflection import Diffuse
from mi_sparse_prt.solvers import lamps as lamp_solvers
from mi_sparse_prt.solvers.lamps import LampPaths, LightByPaths, shared_out
from mi_sparse_prt.solvers.paths import Estimate
from mi_sparse_prt.solvers.problem import Problem
from mi_sparse_prt.solvers.surface_nodes import Nodes


@pytest.fixture(scope="module")
def problem() -> Problem:
    """A ball that shines above a floor of rough metal, beside a wall."""
    scene = build(
        edge_length=0.25,
        floor={
            "type": "rectangle",
            "to_world": T().rotate([1, 0, 0], -90),
            "bsdf": {"type": "roughconductor", "alpha": 0.3},
        },
        wall={
            "type": "rectangle",
            "to_world": T().translate([0, 1, -1]),
            "bsdf": {"type": "diffuse", "reflectance": 0.7},
        },
        lamp={
            "type": "sphere",
            "center": [0, 0.4, -0.6],
            "radius": 0.2,
            "emitter": {"type": "area", "radiance": 1.0},
        },
        bulb={"type": "point", "position": [0.5, 1.0, 0.5], "intensity": 1.0},
    )
    lamps = prt.SceneEmitters(scene)
    return Problem(scene, lamps, mesh_vertices(scene), Diffuse(scene.albedo), "texel", 5)


def elements(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    n, m = problem.scene.n_vertices, problem.emission.size
    return np.repeat(np.arange(n), m), np.tile(np.arange(m), n)


def test_paths_that_meet_a_lamp_and_paths_that_ask_it_agree(problem, monkeypatch):
    """Rationale: near a lamp, samples of it have no bound to what they weigh in a glossy lobe; rays that meet it have.

    Expected: the sums over all vertices agree within four standard errors, these below 1%; paths that do both have less
    than half of the variance of those that only ask.
    Result: 0.8 +- 0.4%, and 0.43 of it; of 12 seeds 0.1 +- 0.2%. With a gap of 0.02 and sharper metal, 0.01.
    """
    asked = elements(problem)
    both = LampPaths(problem, 4096, 1).elements(*asked)
    monkeypatch.setattr(prt.SceneEmitters, "unmet", np.arange(problem.emission.size))
    only = LampPaths(problem, 4096, 2).elements(*asked)
    lamp = asked[1] == problem.emission.names.index("lamp")
    sums = [float(x.mean[lamp].sum()) for x in (both, only)]
    error = np.sqrt(sum(float(x.variance[lamp].sum()) for x in (both, only)) * 3)  # channels are alike
    print(f"{sums[0] / sums[1] - 1:.2%} +- {error / sums[1]:.2%}", both.variance.sum() / only.variance.sum())
    assert error < 0.01 * sums[1]
    assert abs(sums[0] - sums[1]) < 4 * error
    assert both.variance[lamp].sum() < only.variance[lamp].sum() / 2
    np.testing.assert_allclose(
        both.mean[~lamp].sum(), only.mean[~lamp].sum(), rtol=0.02
    )  # a point is only asked


@pytest.mark.slow  # their mean: tests/unit/test_unit_lamps.py; how many there are: below
def test_more_paths_where_they_spread(problem):
    """Rationale: what more paths are given to depends on others, so that the mean of the result does not.

    Expected: the mean of 16 seeds is that of 4096 paths within four standard errors, below 0.5%; squared
    noise is at least 5% less than that of as many paths of all.
    Result: 13% less (101 paths); in a kitchen with a lamp on its worktop, half.
    """
    asked = elements(problem)
    truth = LampPaths(problem, 4096, 99).elements(*asked)
    paths = [LightByPaths(problem, *asked, 64, seed) for seed in range(16)]
    runs, counts = [each.estimate() for each in paths], [each.traced for each in paths]
    sums = np.array([run.mean.sum() for run in runs], np.float64)
    known, error = float(truth.mean.sum()), sums.std(ddof=1) / 4
    error = np.hypot(error, np.sqrt(float(truth.variance.sum()) * 3))
    assert error < 0.005 * known
    assert abs(sums.mean() - known) < 4 * error
    per_element = np.mean(counts) / len(asked[0])
    assert 64 < per_element < 150
    even = LampPaths(problem, round(per_element), 3).elements(*asked)
    power = problem.reflection.albedo[asked[0]] ** 2
    noise = np.mean([(power * (run.mean - truth.mean) ** 2).sum() for run in runs])
    print(per_element, noise / float((power * even.variance).sum()))
    assert noise < 0.95 * float((power * even.variance).sum())


def test_how_paths_are_shared_out():
    """Expected: all have the least, half as many more in all, in powers of two, in proportion to the spread."""
    squares = np.array([0.0] * 96 + [1.0] * 4) ** 2
    counts = shared_out(squares, 1 << 20, 64)
    assert counts.min() == 64
    assert (counts[:96] == 64).all()
    assert (counts[96:] == 64 * 16).all()  # 12.5 times as many more, rounded
    assert (shared_out(np.zeros(5), 16, 32) == 32).all()
    seen_by_few = shared_out(squares, 1, 64)  # what few did not find may be there
    assert seen_by_few[0] >= 64 and seen_by_few[-1] < counts[-1]


def test_same_seed_same_light(problem):
    asked = elements(problem)
    first, again = (LightByPaths(problem, *asked, 64, 5).estimate().mean for _ in "ab")
    np.testing.assert_array_equal(first, again)
    some = asked[0][::-1], asked[1][::-1]  # in another order
    np.testing.assert_array_equal(LightByPaths(problem, *some, 64, 5).estimate().mean[::-1], first)


def test_light_apart_by_depth_is_all_light(problem):
    """Expected: light that met 1, 2 and 3 surfaces sums to all of it, and what met at most k is that of a lower
    ``max_depth``: of the same paths, but for what roulette ends, of which there is none before the fifth bounce."""
    asked = elements(problem)
    apart = LampPaths(problem, 64, 5, apart=3).elements(*asked).mean.reshape(-1, 3, 3)
    for most, depth in ((1, 3), (2, 4), (3, 5)):
        lower = replace(problem, max_depth=depth)
        whole = LampPaths(lower, 64, 5).elements(*asked).mean
        np.testing.assert_allclose(apart[:, :most].sum(axis=1), whole, rtol=1e-4, atol=1e-6)
    two = LampPaths(problem, 64, 5, apart=2).elements(*asked).mean.reshape(-1, 2, 3)
    np.testing.assert_allclose(two[:, 1], apart[:, 1:].sum(axis=1), rtol=1e-4, atol=1e-6)
    assert apart.sum(axis=(0, 2)).min() > 0.01 * apart.sum()  # each depth has some


def test_few_paths_where_they_are_enough(problem):
    """Expected: elements that need no more keep what a quarter of the paths found, and others have as many as ever;
    both are unbiased: sums of 24 seeds are those of 4096 paths within four standard errors, these below 1%."""
    asked = elements(problem)
    enough = np.arange(len(asked[0])) % 3 == 0
    paths = LightByPaths(problem, *asked, 64, 5, apart=3)
    some = paths.estimate(np.where(enough, 0, 64))
    assert 16 * len(enough) < paths.traced < 85 * len(enough)
    np.testing.assert_array_equal(some.mean[enough], paths.first.mean[enough])
    assert some.variance[~enough].mean() < some.variance[enough].mean() / 2
    truth = LampPaths(problem, 4096, 99).elements(*asked)
    for part in (enough, ~enough):
        sums = [
            LightByPaths(problem, *asked, 64, seed)
            .estimate(np.where(enough, 0, 64))
            .mean[part]
            .sum(dtype=np.float64)
            for seed in range(24)
        ]
        known = float(truth.mean[part].sum(dtype=np.float64))
        error = np.hypot(np.std(sums, ddof=1) / 24**0.5, np.sqrt(3 * float(truth.variance[part].sum())))
        print(f"{np.mean(sums) / known - 1:.2%} +- {error / known:.2%}")
        assert error < 0.01 * known and abs(np.mean(sums) - known) < 4 * error


def test_roulette_takes_no_light(monkeypatch):
    """Rationale: in a closed room most light has met many surfaces, and roulette may end its paths.

    Expected: the light of a bulb in it is that of paths that nothing ends early, within four standard errors, these
    below 0.3%.
    Result: -0.08 +- 0.05%; -5.6% with 0.9 as an exponent of the weight of survivors.
    """
    box = {"type": "cube", "flip_normals": True, "bsdf": {"type": "diffuse", "reflectance": 0.6}}
    scene = build(
        edge_length=0.8, box=box, bulb={"type": "point", "position": [0.3, 0.2, 0.1], "intensity": 1.0}
    )
    room = Problem(scene, prt.SceneEmitters(scene), mesh_vertices(scene), Diffuse(scene.albedo), "texel", 9)
    found = []
    for start in (lamp_solvers.ROULETTE, 100):
        monkeypatch.setattr(lamp_solvers, "ROULETTE", start)
        found.append(LampPaths(room, 16384, start).elements(*elements(room)))
    ours, whole = (float(x.mean[:, 0].sum(dtype=np.float64)) for x in found)
    error = np.sqrt(sum(float(x.variance[:, 0].sum(dtype=np.float64)) for x in found))
    print(f"{ours / whole - 1:.2%} +- {error / whole:.2%}")
    assert error < 0.003 * whole and abs(ours - whole) < 4 * error


def attempts(problem: Problem, target: float | None = None) -> list[MethodResult]:
    return list(path_traced_lamps(problem, Run(3), 64, target, seen=False))


def test_noise_of_lamps_is_brought_below_a_target(problem):
    """Rationale: which numbers of paths are enough is predicted by some, after smoothing.

    Expected: a looser target takes fewer paths; what is left is below the target, of the indirect light of each
    lamp; the least target takes all paths. Where fewer seem enough, all follow, as if no target was given.
    Result: 16, 26 and 101 paths of an element leave 37 and 32, 37 and 32, 22 and 17%; the truth has 6 and 5% of noise.
    """
    n, m = problem.scene.n_vertices, problem.emission.size
    truth = LampPaths(problem, 4096, 99).elements(*elements(problem)).mean.astype(np.float64).reshape(n, m, 3)
    power, counts = np.square(problem.reflection.albedo.astype(np.float64))[:, None], []
    energy = (power * truth**2).sum(axis=(0, 2))
    (whole,) = attempts(problem)
    for target in (1.0, 0.6, 1e-4):
        found, *others = attempts(problem, target)
        light = found.indirect.rows(np.arange(n)).astype(np.float64)
        errors = np.sqrt((power * (light - truth) ** 2).sum(axis=(0, 2)) / energy)
        counts.append(found.rays["indirect_paths"] / (n * m))
        print(target, counts[-1], errors, found.skipped)
        assert (errors < target).all() or target == 1e-4
        assert bool(found.skipped) == bool(others) == (target != 1e-4)
        last = others[-1] if others else found
        np.testing.assert_array_equal(last.indirect.rows(np.arange(n)), whole.indirect.rows(np.arange(n)))
    assert counts[0] < counts[1] < counts[2] == whole.rays["indirect_paths"] / (n * m)


def test_few_paths_of_an_element_are_not_fewer(problem):
    """Expected: where no first paths could tell, a target changes nothing."""
    (found,) = path_traced_lamps(problem, Run(3), 3, 0.5, seen=False)
    assert (
        not found.skipped
        and found.rays["indirect_paths"] == 3 * problem.scene.n_vertices * problem.emission.size
    )


def test_many_elements_share_what_paths_there_are(problem, monkeypatch):
    """Rationale: offices have fifty lamps, and streets hundreds of thousands of vertices.

    Expected: of a tenth of the usual paths each element has as many as there are, and the report says so.
    """
    n, m = problem.scene.n_vertices, problem.emission.size
    monkeypatch.setattr(lamps, "PATHS", 6 * n * m)
    monkeypatch.setattr(lamp_light, "FIRST", 2 * n * m)
    (found,) = path_traced_lamps(problem, Run(3), None, seen=False)
    assert found.spp == 6 and "6 of an element, not 64" in found.skipped[0]
    assert 6 * n * m < found.rays["indirect_paths"] + found.rays["photons"] < 6 * 3 * n * m
    kept = prt.precompute(problem.scene, problem.emission, method="brute_force", progress=False)
    assert kept.report["parameters"]["spp"] == 6


@pytest.mark.slow  # of 64 paths: above; photons beside paths: tests/unit/test_light_tracing.py
def test_few_paths_of_many_elements_are_right_in_the_mean(problem, monkeypatch):
    """
    Expected: before it is smoothed, light of 6 paths of an element, of which two came first, is that of 4096 paths,
    within four standard errors of the mean of 64 seeds; of the bulb below 0.5%.
    Result: -1.4 +- 1.2% and -0.5 +- 0.4%.
    """
    n, m = problem.scene.n_vertices, problem.emission.size
    monkeypatch.setattr(lamp_light, "FIRST", 2 * n * m)

    def sums(found: Estimate) -> NDArray[np.float64]:
        return found.mean.astype(np.float64).reshape(n, m, 3).sum(axis=(0, 2))

    levels, truth = (
        smoothing_levels(problem.scene, problem.points),
        LampPaths(problem, 4096, 99).elements(*elements(problem)),
    )
    lights = (LampLight(problem, np.arange(n), Nodes(np.arange(n), None), levels, 6, k, 1) for k in range(64))
    off = np.array([sums(light.estimate(np.full(m, 6))) for light in lights]) / sums(truth) - 1
    error = off.std(axis=0, ddof=1) / 8
    print(f"{off.mean(axis=0)} +- {error}")
    assert (abs(off.mean(axis=0)) < 4 * error).all() and error[1] < 0.005


def test_a_few_first_paths_are_no_result(problem, monkeypatch):
    """Rationale: weights of paths and photons that are made of two of each favour what happens to be small.

    Expected: however loose a target, first paths are a result if they are eight of an element, and not if two.
    """
    n, m = problem.scene.n_vertices, problem.emission.size
    for first, least in ((16, 0), (2, 1)):
        monkeypatch.setattr(lamp_light, "FIRST", first * n * m)
        nodes = Nodes(np.arange(n), None)
        levels = smoothing_levels(problem.scene, problem.points)
        light = LampLight(problem, nodes.ids, nodes, levels, 64, 3, 1)
        assert (light.effort(100.0) == least).all()


def test_paths_are_as_many_as_a_target_takes(problem, monkeypatch):
    """Rationale: half of the time of a staircase of lamps are paths; the next power of two is a third too many.

    Expected: paths that are predicted to leave so much noise are in inverse proportion to its square, but for rounding
    up, where they are neither as few as the first ones nor as many as there are at most.
    """
    n = problem.scene.n_vertices
    nodes, levels = Nodes(np.arange(n), None), smoothing_levels(problem.scene, problem.points)
    monkeypatch.setattr(lamp_light, "ENOUGH", 1 << 20)  # first ones are no result
    light = LampLight(problem, nodes.ids, nodes, levels, 1 << 10, 3, 1)
    targets = np.geomspace(0.04, 0.2, 5)
    efforts = np.array([light.effort(float(target)) for target in targets])
    print(efforts)
    assert ((efforts > 4) & (efforts < 1 << 10)).sum() >= 6
    expected = efforts[:-1] * (targets[:-1] / targets[1:])[:, None] ** 2
    known = efforts[:-1] < 1 << 10
    assert (abs(efforts[1:] - expected)[known] <= 1).all()


def test_many_vertices_take_their_light_from_nodes(monkeypatch):
    """Rationale: only nodes have paths where there are many vertices; a lit corner with a wall of plastic.

    Expected: a third of the paths, and indirect light of all vertices as by 4096 paths, within 2% in all and 6% at
    single vertices, root mean square.
    Result: 0.49%, 4.3% (256 paths of a vertex, and interpolation).
    """
    plastic = {"type": "roughplastic", "diffuse_reflectance": 0.7, "alpha": 0.3}
    scene = build(
        edge_length=0.07,
        floor={"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90)},
        wall={"type": "rectangle", "to_world": T().translate([0, 1, -1]), "bsdf": plastic},
        bulb={"type": "point", "position": [0.3, 1.5, 0.6], "intensity": 1.0},
    )
    bulb = prt.SceneEmitters(scene)
    corner = Problem(scene, bulb, mesh_vertices(scene), Diffuse(scene.albedo), "texel", 4)
    monkeypatch.setattr(lamps, "choose_nodes", lambda *where: choose_nodes(*where, scene.n_vertices // 3, 64))
    (found,) = path_traced_lamps(corner, Run(3), 256, seen=False)
    assert found.rays["indirect_paths"] < 0.7 * 256 * scene.n_vertices
    truth = LampPaths(corner, 4096, 99).elements(*elements(corner)).mean.astype(np.float64)
    light = found.indirect.rows(np.arange(scene.n_vertices)).reshape(truth.shape).astype(np.float64)
    error = np.linalg.norm(light - truth) / np.linalg.norm(truth)
    print(scene.n_vertices, f"{light.sum() / truth.sum() - 1:.2%}, {error:.2%}")
    assert light.sum() == pytest.approx(truth.sum(), rel=0.02)
    assert error < 0.06


def test_what_a_target_saves_is_done_if_it_is_missed(problem, monkeypatch):
    """Expected: where few paths seem enough and are not, the matrix is that without a target; all paths are counted."""
    monkeypatch.setattr(LampLight, "effort", lambda self, target: np.zeros(problem.emission.size, np.int64))
    asked = {"method": "brute_force", "spp": 64, "progress": False}
    few, again, whole = (
        prt.precompute(problem.scene, problem.emission, **asked, **target)
        for target in ({"target_error": 0.5}, {"target_error": 1e-4}, {})
    )
    paths = [matrix.report["rays"]["indirect_paths"] for matrix in (few, again, whole)]
    assert paths[0] < paths[1] == paths[2]  # the first paths tell how the others are shared out
    assert few.report["rays"]["photons"] < whole.report["rays"]["photons"]
    np.testing.assert_array_equal(again.rows(np.arange(50)), whole.rows(np.arange(50)))
    assert any("fewer than 64" in line for line in few.report["skipped"])


def test_a_target_of_lamps_is_told_if_missed():
    """Expected: a warning with the estimate, where no number of paths that is tried meets the target."""
    scene = build(
        floor={"type": "rectangle", "bsdf": {"type": "roughconductor", "alpha": 0.3}},
        wall={"type": "rectangle", "to_world": T().translate([0, 1, 1]).rotate([1, 0, 0], 90)},
        bulb={"type": "point", "position": [0.5, 0.5, 0.5], "intensity": 1.0},
        edge_length=0.5,
    )
    with pytest.warns(prt.PrtWarning, match=r"the target error 1e-06 was not met: the estimate is 0\.0"):
        prt.precompute(
            scene, prt.SceneEmitters(scene), method="brute_force", target_error=1e-6, progress=False
        )
