"""The comparison of methods with brute force: what is known without running it, and once from end to end."""

import json
import time

import mitsuba as mi
import numpy as np
import psutil
import pytest
from conftest import COLOURS, T, altered, build, diffuse, problem_at, still_life
from rich.console import Console

import mi_sparse_prt as prt
from mi_sparse_prt.benchmark.brute_force import BLOCKS, time_rows
from mi_sparse_prt.benchmark.converged_reference import Reference, ReferenceEffort
from mi_sparse_prt.benchmark.direct_error import direct_error
from mi_sparse_prt.benchmark.measuring import kept_memory
from mi_sparse_prt.benchmark.method_comparison import (
    RAYS,
    ComparisonEffort,
    measure_methods,
    seconds_of_stages,
)
from mi_sparse_prt.benchmark.method_figures import PictureEffort
from mi_sparse_prt.benchmark.relit_reference import (
    RelitEffort,
    RelitReference,
    environments_of,
    path_traced,
)
from mi_sparse_prt.benchmark.sampled_norms import joint_relative_l2, mean_square, sampled_relative_l2
from mi_sparse_prt.cli.tables.methods import methods_tables
from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.solvers.paths import PathSolver

SCENE = """<scene version="3.0.0">
    <sensor type="perspective">
        <transform name="to_world"><lookat origin="0, 3, 4" target="0, 0, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm"><integer name="width" value="36"/><integer name="height" value="24"/></film>
    </sensor>
    <emitter type="constant"/>
    <shape type="rectangle" id="floor">
        <transform name="to_world"><rotate x="1" angle="-90"/><scale value="2"/></transform>
        <bsdf type="diffuse"/>
    </shape>
    <shape type="cube" id="box">
        <transform name="to_world"><scale value="0.5"/><translate y="0.6"/></transform>
        <bsdf type="diffuse"/>
    </shape>
</scene>
"""


# Small references: noisy, but all of their parts take part
QUICK = ComparisonEffort(
    ReferenceEffort(vertices=120, texels=12, element_spp=64, rows=24, row_spp=16),
    RelitEffort(vertices=20, paths=1024, rotations=4),
    PictureEffort(paths=64, pixel_samples=1, width=60),
)


@pytest.fixture(scope="module")
def brute_force(grey_scene, small_lighting):
    return prt.precompute(grey_scene, small_lighting, "brute_force", spp=64, seed=5, progress=False)


# ----------------------------------------------------------------------------------------------------- estimates


def test_mean_square_of_a_known_and_an_unknown_part():
    """Expected: with every vertex sampled and no noise, exactly the mean square of the sum."""
    rng = np.random.default_rng(0)
    d, r = rng.normal(size=(2, 50, 7))
    found = mean_square(float((d**2).mean()), d, r, r)
    assert found.value == pytest.approx(((d + r) ** 2).mean())


def test_noise_of_the_halves_drops_out():
    """Expected: independent noise as large as the signal leaves the mean square within four standard errors."""
    rng = np.random.default_rng(1)
    r, a, b = rng.normal(size=(3, 4000, 5))
    found = mean_square(0.0, np.zeros_like(r), r + a, r + b)
    assert abs(found.value - (r**2).mean()) < 4 * found.rest.std() / np.sqrt(len(r))
    assert mean_square(0.0, np.zeros_like(r), r + a, r + a).value > 1.8  # one and the same noise does not


def test_standard_error_of_a_relative_error():
    """Expected: the bootstrap agrees with the spread over independent samples of vertices."""
    rng = np.random.default_rng(2)
    values, deviations = [], []
    for _ in range(200):
        error, norm = 0.1 * rng.normal(size=(60, 1)), 1 + rng.random((60, 1))
        zero = np.zeros((60, 1))
        pair = mean_square(0.0, zero, error, error), mean_square(0.0, zero, norm, norm)
        value, deviation = sampled_relative_l2(*pair)
        values.append(value)
        deviations.append(deviation)
    assert np.mean(deviations) == pytest.approx(np.std(values), rel=0.25)


def test_error_of_two_meshes_together():
    """Expected: the sums over all vertices; the standard error is that of the spread over independent samples, also
    where errors and norms come from different vertices."""
    rng = np.random.default_rng(3)
    sizes, scales, counts = [1000, 3000], [0.2, 0.05], [(60, 60), (20, 60)]
    values, deviations = [], []
    for _ in range(200):
        errors, norms = [], []
        for scale, (k, m) in zip(scales, counts, strict=True):
            error, norm = scale * rng.normal(size=(k, 1)), 1 + rng.random((m, 1))
            errors.append(mean_square(0.0, np.zeros((k, 1)), error, error))
            norms.append(mean_square(0.0, np.zeros((m, 1)), norm, norm))
        value, deviation = joint_relative_l2(errors, norms, sizes)
        values.append(value)
        deviations.append(deviation)
    mean_norm = 7 / 3  # of (1 + u)^2, u uniform
    expected = np.sqrt((1000 * 0.2**2 + 3000 * 0.05**2) / (4000 * mean_norm))
    assert np.sqrt(np.mean(np.square(values))) == pytest.approx(expected, rel=0.03)
    assert np.mean(deviations) == pytest.approx(np.std(values), rel=0.25)


# ---------------------------------------------------------------------------------------------- direct light, rows


def test_errors_of_the_direct_part(grey_scene, small_lighting, brute_force):
    """Expected: 0 for exact bits; one flipped bit is found at its row and column, with the right size."""
    exact = brute_force.direct
    none = direct_error(exact, brute_force)
    assert all(none.relative_l2(mesh.name) == 0 for mesh in grey_scene.meshes)
    assert not none.vertices().any()

    mesh = grey_scene.meshes[1]
    rows = exact.rows(np.arange(mesh.vertices.start, mesh.vertices.stop))[..., 0].astype(np.float64)
    lit = np.linalg.norm(rows, axis=0) > 0.5 * np.linalg.norm(rows, axis=0).max()
    vertex, texel = np.unravel_index(np.argmax(rows * lit), rows.shape)
    bits = exact.bits.copy()
    bits[mesh.vertices.start + vertex, texel // 32] ^= np.uint32(1 << (texel % 32))
    wrong = altered(brute_force, direct=type(exact)(bits, exact.normals, small_lighting))
    found = direct_error(exact, wrong)
    size = rows[vertex, texel]
    assert found.relative_l2(mesh.name) == pytest.approx(size / np.linalg.norm(rows), rel=1e-5)
    assert found.relative_l2(grey_scene.meshes[0].name) == 0
    row = found.row_errors(mesh.name)
    assert row["vertex"] == mesh.vertices.start + vertex and row["95th_percentile"] == 0
    assert row["max"] == pytest.approx(size / np.linalg.norm(rows[vertex]), rel=1e-5)
    column = found.column_errors(mesh.name)
    assert column["texel"] == texel
    assert column["max"] == pytest.approx(size / np.linalg.norm(rows[:, texel]), rel=1e-5)


# -------------------------------------------------------------------------------------------- under environments


@pytest.mark.parametrize("coloured", [False, True])
def test_path_traced_light_is_that_of_the_elements(coloured, grey_scene, small_lighting):
    """
    Rationale: the reference of relit vertices draws texels; brute force evaluates all of them.
    Expected: both agree within four standard errors, which are below 4%, under even light and one bright texel.
    Result: as expected.
    """
    scene = build(**still_life(COLOURS)) if coloured else grey_scene
    lights = np.random.default_rng(0).random((2, small_lighting.n_directions, 3))
    lights[1] *= 0.01
    lights[1, 17] = [30, 20, 10]
    vertices = np.arange(0, len(scene.positions), 40)
    runs = np.stack([path_traced(scene, small_lighting, lights, vertices, 2048, seed) for seed in range(6)])
    solver = PathSolver(problem_at(scene, small_lighting), 2048, seed=9)
    rows = solver.rows(vertices)
    weights = small_lighting.solid_angles[:, None].astype(np.float64)
    expected = np.einsum("vjc,ljc->lvc", rows.mean * weights, lights)
    variance = np.einsum("vjc,ljc->lvc", rows.variance * weights**2, lights**2)
    deviation = np.sqrt(runs.var(axis=0, ddof=1) / len(runs) + variance)
    # of the mean over vertices: single ones may have been unlucky in so few runs
    mean, error = expected.mean(axis=1), np.sqrt((deviation**2).sum(axis=1)) / len(vertices)
    assert (error < 0.04 * mean).all()
    assert (np.abs(runs.mean(axis=(0, 2)) - mean) < 4 * error).all()


def test_no_light_is_no_light(grey_scene, small_lighting):
    dark = np.zeros((1, small_lighting.n_directions, 3))
    assert not path_traced(grey_scene, small_lighting, dark, np.arange(3), 16, 0).any()


def test_a_turn_of_the_circle_closes(grey_scene, small_lighting, brute_force):
    """
    Rationale: a matrix that is right has no error in any light.
    Expected: brute force with 64 paths has no direct error; its error under environments and its changes while one
        turns are a small share of the light's.
    Result: below 2%, where the light changes by more than 10%.
    """
    relit = RelitReference(grey_scene, brute_force.direct, progress=False, effort=QUICK.relit)
    assert list(relit.environments) == ["sky", "sun"] and relit.turning == "sun"  # the scene has no file
    np.testing.assert_array_equal(relit.lights[2], relit.lights[-1])
    report = relit.errors(brute_force)
    assert report["rotation"]["degrees"] == [0, 90, 180, 270]
    for mesh in grey_scene.meshes:
        assert report["environments"][mesh.name]["sky"]["relative_l2"] < 0.02
        frames = report["rotation"]["meshes"][mesh.name]["frames"]
        assert {len(values) for values in frames.values()} == {4}
        assert max(frames["change_of_error"]) < 0.1 * min(frames["change_of_light"])
    assert all(0 < noise < 0.1 for of_mesh in relit.noise().values() for noise in of_mesh.values())


def test_direct_errors_under_a_light_are_exact(small_lighting):
    """Expected: without indirect light, where nothing is sampled, what the two matrices themselves give.

    Two plates side by side: nothing is reflected between them.
    """
    beside = T().translate([3, 0, 0]).rotate([1, 0, 0], -90)
    scene = build(
        left={"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90), "bsdf": diffuse(0.5, 0.5, 0.5)},
        right={"type": "rectangle", "to_world": beside, "bsdf": diffuse(0.6, 0.6, 0.6)},
    )
    exact = prt.precompute(scene, small_lighting, "brute_force", max_depth=2, progress=False)
    bits = exact.direct.bits & np.uint32(0xFFFF00FF)
    wrong = altered(exact, direct=type(exact.direct)(bits, exact.direct.normals, small_lighting))
    relit = RelitReference(scene, exact.direct, progress=False, effort=QUICK.relit)
    light = small_lighting.project(relit.environments["sky"])
    found = relit.errors(wrong)["environments"]
    for mesh in scene.meshes:
        truth = exact.relight(light)[mesh.vertices]
        expected = np.linalg.norm(wrong.relight(light)[mesh.vertices] - truth) / np.linalg.norm(truth)
        assert expected > 0.05
        assert found[mesh.name]["sky"]["relative_l2"] == pytest.approx(expected, rel=1e-4)
        assert found[mesh.name]["sky"]["standard_error"] < 1e-9


def test_environments_beside_the_scene(tmp_path):
    """Expected: the images of the folder by name; without a folder a sky and a sun, of which one texel is the sun."""
    (tmp_path / "scene.xml").write_text(SCENE)
    scene = prt.load_scene(tmp_path / "scene.xml", float("inf"))
    made = environments_of(scene)
    assert list(made) == ["sky", "sun"]
    folder = tmp_path / "envmaps"
    folder.mkdir()
    mi.Bitmap(np.full((4, 8, 3), 0.25, np.float32)).write(str(folder / "even.exr"))
    (folder / "notes.txt").write_text("no image")
    found = environments_of(scene)
    assert list(found) == ["even"] and (found["even"].pixels == 0.25).all()


# ------------------------------------------------------------------------------------------------------- reference


def test_errors_of_brute_force(grey_scene, small_lighting, brute_force):
    """
    Rationale: a matrix whose every element is right within noise shows what the reference can tell.
    Expected: no direct error; the indirect error is that of its own paths (their variance is known), within four
        standard errors of the estimate; whole rows have errors of the same size.
    Result: as expected.
    """
    measured = Reference(grey_scene, small_lighting, progress=False, effort=QUICK.reference)
    errors, _ = measured.errors(brute_force)
    solver = measured.paths(64, 5)
    for mesh in grey_scene.meshes:
        ids = np.arange(mesh.vertices.start, mesh.vertices.stop)
        rows = solver.rows(ids)
        weights = small_lighting.solid_angles[:, None].astype(np.float64)
        noise = (rows.variance * weights**2).sum()
        norm = ((measured.direct.rows(ids) + rows.mean * weights) ** 2).sum()
        found = errors[mesh.name]
        assert found["direct"] == 0
        deviation = found["standard_error"]["total"]
        assert abs(found["total"] - np.sqrt(noise / norm)) < 4 * deviation + 0.002
        assert found["total"] == pytest.approx(found["indirect"], rel=0.3)
        assert found["rows"]["max"] < 0.1 and found["rows"]["rows"] == 8
        assert found["direct_rows"]["max"] == found["direct_columns"]["max"] == 0


def test_errors_of_all_meshes_together(grey_scene, small_lighting, brute_force):
    """
    Rationale: three ways to the error of path-traced light: elements of a matrix, of its paths, rows of the adjoint.
    Expected: the total is that of all squared errors over all squared norms, so it lies between those of the meshes,
        nearer to that of the mesh with more light; all agree with the variance of the paths that is known at every
        element, within four standard errors.
    Result: as expected.
    """
    measured = Reference(grey_scene, small_lighting, progress=False, effort=QUICK.reference)
    everyone = np.arange(grey_scene.n_vertices)
    weights = small_lighting.solid_angles[:, None].astype(np.float64)
    albedo = grey_scene.albedo[:, :1, None].astype(np.float64)
    rows, adjoint = measured.paths(64, 5).rows(everyone), measured.adjoint(64).rows(everyone)
    norm = ((albedo * (measured.direct.rows(everyone) + rows.mean * weights)) ** 2).sum(axis=(1, 2))

    def expected(variance, ids):
        noise = (albedo**2 * variance * weights**2).sum(axis=(1, 2))
        return np.sqrt(noise[ids].sum() / norm[ids].sum())

    for found, variance in (
        (measured.relative_l2(brute_force), rows.variance),
        (measured.relative_l2_of_paths(64), rows.variance),
        (measured.relative_l2_of_adjoint(64), adjoint.variance),
    ):
        deviations = found["standard_error"]
        assert list(found["meshes"]) == [mesh.name for mesh in grey_scene.meshes]
        for mesh in grey_scene.meshes:
            ids = everyone[mesh.vertices]
            difference = found["meshes"][mesh.name] - expected(variance, ids)
            assert abs(difference) < 4 * deviations["meshes"][mesh.name] + 0.002
        assert abs(found["total"] - expected(variance, everyone)) < 4 * deviations["total"] + 0.002
        assert 0 < deviations["total"] < found["total"]
    noise = measured.noise()
    assert 0 < noise["total"] < max(noise["meshes"].values())


class Timed:
    """A solver of n rows that notes which it is asked for; a row moves a clock on by its own amount."""

    def __init__(self, seconds: np.ndarray) -> None:
        self.points, self._seconds = seconds, seconds
        self.traced: list[np.ndarray] = []
        self.now = 0.0

    def rows(self, ids: np.ndarray) -> None:
        self.traced.append(np.asarray(ids))
        self.now += self._seconds[ids].sum()


def test_brute_force_is_timed_on_successive_rows():
    """Expected: whole wavefronts of successive vertices, one in each part of the scene; or all, once, if few."""
    n = 2000
    solver = Timed(np.ones(n))
    found = time_rows(solver, 32)
    assert all((np.diff(ids) == 1).all() and len(ids) == 32 for ids in solver.traced)
    starts = np.array([ids[0] for ids in solver.traced[1:]])
    assert found.rows == 32 * BLOCKS < n and len(starts) == BLOCKS
    assert (np.abs(starts / n - (np.arange(BLOCKS) + 0.5) / BLOCKS) < 0.5 / BLOCKS + 64 / n).all()

    solver.traced.clear()
    found = time_rows(solver, n // 3)
    np.testing.assert_array_equal(np.concatenate(solver.traced[1:]), np.arange(n))
    assert found.rows == n and found.standard_error == 0


def test_time_of_all_rows_from_some(monkeypatch):
    """Expected: with a clock that every row moves on by its own amount, the sum over all rows within four errors."""
    each = 1 + 0.3 * np.random.default_rng(0).random(2000)
    solver = Timed(each)
    monkeypatch.setattr(time, "perf_counter", lambda: solver.now)
    found = time_rows(solver, 8)
    assert found.rows < len(each) / 4
    assert abs(found.seconds - each.sum()) < 4 * found.standard_error < 0.1 * each.sum()


# ---------------------------------------------------------------------------------------------------------- report


def test_breakdown_adds_up():
    seconds = {
        "dense_paths": 3.0,
        "dense_rays": 1.0,
        "rank": 0.5,
        "held_out": 2.0,
        "unheard_of": 0.25,
        "total": 7.0,
    }
    stages = seconds_of_stages(seconds)
    assert sum(stages.values()) == pytest.approx(7)
    assert stages["dense rays"] == 4 and stages["rank"] == 0.5 and stages["system"] == pytest.approx(0.5)


def test_a_method_that_cannot_be_compared():
    scene = build(plate={"type": "rectangle", "bsdf": diffuse(0.5, 0.5, 0.5)})
    with pytest.raises(PrtError, match="brute_force"):
        measure_methods(scene, prt.CubemapLighting(2), ["brute_force"], progress=False)


def test_from_end_to_end(tmp_path):
    """
    Rationale: one call gives the counterpart of every table and figure of the paper.
    Expected: files of all figures; ratio and elements with the held-out ones are what their definitions say; JSON and
        table have the method.
    Result: as expected.
    """
    folder = tmp_path / "figures"
    (tmp_path / "scene.xml").write_text(SCENE)
    scene = prt.load_scene(tmp_path / "scene.xml", 0.4)
    report = measure_methods(scene, prt.CubemapLighting(4), ["sparse", "gather"], False, folder, QUICK)
    assert json.loads(json.dumps(report)) == report
    console = Console(width=160, record=True)
    console.print(*methods_tables(report))
    printed = console.export_text()
    assert list(report["methods"]) == ["sparse", "gather"]
    brute = report["brute_force"]
    assert brute["seconds"] == pytest.approx(brute["direct_seconds"] + brute["paths_seconds"])
    for method, found in report["methods"].items():
        assert f"{method} against brute force" in printed
        seconds, held_out = found["seconds"], found["estimated_error"]["elements"]
        total = report["scene"]["vertices"] * 96
        assert found["ratio"] == pytest.approx(seconds["total"] / brute["seconds"])
        without = found["without_held_out"]
        assert found["elements"] - without["elements"] == pytest.approx(held_out / total)
        own = without["ratio"] * brute["seconds"]
        assert own + seconds["held_out"] == pytest.approx(seconds["total"])
        assert found["seconds_per_element"] == pytest.approx(found["ratio"] / found["elements"])
        assert sum(found["stages"].values()) == pytest.approx(seconds["total"])
        rays = sum(found["stages"][name] for name in RAYS)
        assert found["overhead"]["share"] == pytest.approx(1 - rays / seconds["total"])
        assert found["errors"]["floor"]["standard_error"]["total"] > 0
    assert report["methods"]["gather"]["overhead"]["microseconds_per_sparse_vertex"] is None
    assert report["methods"]["gather"]["errors"]["floor"]["direct"] == 0
    names = {"rates", "errors_times", "breakdown", "environments", "rotation", "dense_vertices", "ranks"}
    names |= {f"{what}_{method}" for what in ("vertex_error", "relit") for method in report["methods"]}
    assert {file.name for file in folder.iterdir()} == {f"{name}.png" for name in names}
    assert all(file.stat().st_size > 3000 for file in folder.iterdir())


def test_freed_memory_is_kept_for_a_while():
    """Expected: inside, an array that was freed leaves its pages with the process; afterwards they go back."""

    def resident_after_an_array() -> int:
        np.ones(64 << 20, np.uint8)
        return psutil.Process().memory_info().rss

    before = resident_after_an_array()
    with kept_memory():
        inside = resident_after_an_array()
    after = psutil.Process().memory_info().rss
    assert inside - before > 50 << 20
    assert after - before < 20 << 20
