"""Scenes of more than a dozen meshes: what a mesh gets at least is shared, and cost follows vertices, not shapes."""

import mitsuba as mi
import numpy as np
import pytest
from conftest import PALE, T, build, diffuse

import mi_sparse_prt as prt
from mi_sparse_prt.estimation import held_out
from mi_sparse_prt.estimation.element_sampling import Effort
from mi_sparse_prt.estimation.held_out import _Estimator, held_out_error
from mi_sparse_prt.estimation.pilot_elements import PilotElements, vertices_of_each
from mi_sparse_prt.measurement.measurement import mesh_vertices
from mi_sparse_prt.methods.plan import Plan
from mi_sparse_prt.reflection.reflection import Diffuse
from mi_sparse_prt.scene import scene as scene_module
from mi_sparse_prt.scene.scene import FEW_MESHES, TOGETHER
from mi_sparse_prt.scene.triangle_mesh import connected_pieces, unique_rows
from mi_sparse_prt.solvers.problem import Problem, diffuse_problem

LIGHTING = prt.CubemapLighting(4)
SEEDS = range(6)


def crowd(count: int, order: int = 0, edge_length: float = 0.4) -> prt.Scene:
    """Boxes of several greys, turned and of different height, on a ground."""
    rng = np.random.default_rng(1)
    side = int(np.ceil(np.sqrt(count)))
    shapes = {
        "ground": {
            "type": "rectangle",
            "to_world": T().rotate([1, 0, 0], -90).scale(0.5 * side),
            "bsdf": diffuse(0.5, 0.5, 0.5),
        }
    }
    for k in range(count):
        height, angle, grey = 0.15 + 0.3 * rng.random(), 90 * rng.random(), 0.3 + 0.5 * rng.random()
        place = T().translate([k // side - side / 2 + 0.5, height + 0.01, k % side - side / 2 + 0.5])
        shapes[f"box{k}"] = {
            "type": "cube",
            "to_world": place.rotate([0, 1, 0], angle).scale([0.25, height, 0.25]),
            "bsdf": diffuse(grey, grey, grey),
        }
    names = np.random.default_rng(order).permutation(list(shapes)) if order else list(shapes)
    return build(edge_length, **{str(name): shapes[str(name)] for name in names})


@pytest.fixture(scope="module")
def scene() -> prt.Scene:
    return crowd(16)


@pytest.mark.parametrize("n_meshes", [13, 100, 1000])
def test_what_is_held_out_follows_vertices(n_meshes):
    """Expected: of many meshes hardly more elements than of one that has all their vertices; before, 40 times as many
    rays and 25 times as many paths of 300 boxes.
    """
    effort, total = Effort(), 40_000 * 6144
    whole = effort.rays_of(total, 1), effort.paths_of(total, 1)
    parts = [kind(total // n_meshes, n_meshes) * n_meshes for kind in (effort.rays_of, effort.paths_of)]
    assert parts[0] < 1.2 * whole[0]
    assert whole[1] / 2 < parts[1] < 1.2 * whole[1]


def test_few_meshes_have_what_they_had():
    assert all(Effort().rays_of(1 << 20, k) == 1 << 16 for k in range(1, FEW_MESHES + 1))
    assert Effort().paths_of(1 << 20, FEW_MESHES) == Effort().paths // FEW_MESHES


def test_a_pilot_looks_at_a_few_hundred_vertices(scene):
    held = PilotElements(diffuse_problem(scene, LIGHTING, max_depth=2), False, 0, 16, 4)
    assert len(held.vertices) == 16 * TOGETHER
    assert held.stand_for.sum() == pytest.approx(scene.n_vertices)
    # as many in all as of few meshes
    assert vertices_of_each(scene, 192) * TOGETHER == 192
    few = build(0.5, a={"type": "cube"}, b={"type": "rectangle"})
    assert vertices_of_each(few, 192) * len(few.meshes) == 192


@pytest.mark.slow  # that of few: test_held_out.py; that of each by itself: below
def test_the_error_of_many_meshes(scene):
    """Rationale: elements of all meshes are evaluated together, and told apart again.

    Expected: the estimate of a rough matrix, in total and of the largest meshes, is that against brute force.
    """
    transport = prt.precompute(
        scene, LIGHTING, Plan("consensus", "gather", 16, 0.2), max_depth=3, progress=False
    )
    truth = [
        prt.precompute(scene, LIGHTING, "brute_force", max_depth=3, spp=16, seed=50 + k, progress=False)
        .rows(np.arange(scene.n_vertices))
        .astype(np.float64)
        for k in (0, 1)
    ]
    ours = transport.rows(np.arange(scene.n_vertices)).astype(np.float64)

    def true(rows: slice) -> float:
        x, y = (t[rows] for t in truth)
        return float(np.sqrt(((ours[rows] - x) * (ours[rows] - y)).sum() / (x * y).sum()))

    problem = Problem(scene, LIGHTING, mesh_vertices(scene), Diffuse(scene.albedo), "direction", 3)
    runs = [held_out_error(problem, transport, seed) for seed in SEEDS]
    spread = np.sqrt(np.mean([run.standard_error["total"] ** 2 for run in runs]) / len(runs))
    found = np.sqrt(np.mean([run.total**2 for run in runs]))
    print(f"total {found:.4f} +- {spread:.4f}, true {true(slice(None)):.4f}")
    assert abs(found - true(slice(None))) < 3 * spread < 0.2 * found
    for mesh in scene.meshes[:4]:
        found = np.sqrt(np.mean([run.meshes[mesh.name] ** 2 for run in runs]))
        errors = [run.standard_error["meshes"][mesh.name] for run in runs]
        assert abs(found - true(mesh.vertices)) < 4 * np.sqrt(np.mean(np.square(errors)) / len(runs)) + 2e-3


@pytest.mark.parametrize("count", [5, 16])
def test_drawn_elements_stand_for_all(count):
    """Rationale: weights undo what is drawn more often, in few meshes and in many. The squared norm of direct light is
    known exactly; 40 draws of it would show a bias of 2%.
    """
    scene = crowd(count)
    transport = prt.precompute(scene, LIGHTING, Plan("exact"), max_depth=2, progress=False)
    exact = float((transport.rows(np.arange(scene.n_vertices)).astype(np.float64) ** 2).sum())
    problem = diffuse_problem(scene, LIGHTING, max_depth=2)
    estimator = _Estimator(
        problem, transport, Effort(), np.random.SeedSequence(3), False, np.zeros(scene.n_vertices)
    )
    found = []
    for seed in range(40):
        samples = estimator.samples(np.random.default_rng(seed), 1.0).values()
        found.append(sum(float(sample.weights @ sample.norms[:, 0]) for sample in samples) / exact)
    spread = np.std(found, ddof=1) / np.sqrt(len(found))
    print(f"{count + 1} meshes: {np.mean(found):.4f} +- {spread:.4f}")
    assert abs(np.mean(found) - 1) < 3 * spread
    assert 3 * spread < 0.02


def test_elements_evaluated_together_or_apart(scene, monkeypatch):
    """Expected: the same estimate to the last bit, of every mesh."""
    transport = prt.precompute(scene, LIGHTING, Plan("exact", "gather", 16, 0.2), progress=False)
    problem = diffuse_problem(scene, LIGHTING)
    together = held_out_error(problem, transport, 4)
    monkeypatch.setattr(held_out, "BATCH", 1)
    assert held_out_error(problem, transport, 4) == together


def test_order_of_many_shapes():
    """Expected: the same row for the same vertex, bit by bit, though all vertices are sampled as one surface."""
    rows = []
    for order in (1, 2):
        scene = crowd(14, order)
        assert len(scene.sampled_together) == 1
        transport = prt.precompute(scene, LIGHTING, Plan("consensus"), max_depth=2, progress=False)
        keys = scene.vertex_keys
        assert len(np.unique(keys)) == len(keys)
        rows.append(transport.rows(np.argsort(keys)))
    assert np.array_equal(*rows)


@pytest.mark.usefixtures("no_held_out")
def test_meshes_of_one_material_are_traced_as_one(monkeypatch):
    """
    Rationale: every shape makes every kernel slower to trace.

    Expected: neighbours in the file with one plain material are one shape for rays, others and lamps are not; the
        matrix and what is listed are those of shapes that are traced one by one, bit by bit; a lamp is found as itself.
    """
    white, red = diffuse(0.7, 0.7, 0.7), diffuse(0.7, 0.2, 0.2)
    colours = [white, white, *[red] * 9, white, white]
    flat = T().rotate([1, 0, 0], -90).scale(3)
    shapes = {"ground": {"type": "rectangle", "to_world": flat, "bsdf": white}}
    for k, bsdf in enumerate(colours):
        place = T().translate([k % 4 - 1.5, 0.31, k // 4 - 1.5]).rotate([0, 1, 0], 20 * k).scale(0.3)
        shapes[f"box{k}"] = {"type": "cube", "to_world": place, "bsdf": bsdf}
    shapes["box12"]["emitter"] = {"type": "area", "radiance": 1.0}
    scene = build(0.4, **shapes)
    assert [mesh.name for mesh in scene.fronts] == list(shapes)
    assert [shape.id() for shape in scene.normalised.shapes()] == ["ground", "box2", "box11", "box12"]
    assert [shape.id() for shape in scene.unsplit.shapes()] == ["ground", "box2", "box11", "box12"]
    plan = Plan("edges", "gather", 64, 0.1)
    arguments = {"max_depth": 4, "progress": False}
    ids = np.arange(scene.n_vertices)

    def rows(of: prt.Scene) -> list[np.ndarray]:
        distant = prt.precompute(of, LIGHTING, plan, "texel", **arguments)
        return [t.rows(ids) for t in (distant, prt.precompute(of, prt.SceneEmitters(of), **arguments))]

    found = rows(scene)
    monkeypatch.setattr(
        scene_module, "_alike", lambda materials: [slice(k, k + 1) for k in range(len(materials))]
    )
    apart = build(0.4, **shapes)
    assert len(apart.normalised.shapes()) == 14
    assert apart.hash == scene.hash
    for ours, known in zip(found, rows(apart), strict=True):
        np.testing.assert_array_equal(ours, known)


def test_matrices_of_a_sky_build_no_shapes_in_world_space():
    """Rationale: a thousand shapes that are alive make every kernel slower to trace; lamps and cameras need them."""
    scene = crowd(4)
    prt.precompute(scene, LIGHTING, Plan("exact", "gather", 16, 0.1), progress=False)
    assert "mitsuba" not in vars(scene)
    assert [shape.id() for shape in scene.mitsuba.shapes()] == [mesh.name for mesh in scene.fronts]


def test_pieces_of_all_meshes_are_those_of_each(scene):
    """Expected: numbered mesh by mesh; two that touch are apart, and a cube of 24 vertices is one."""
    count = 0
    for mesh in scene.meshes:
        first, same = unique_rows(scene.positions[mesh.vertices])
        own, of_place = connected_pieces(same[mesh.triangles], len(first))
        np.testing.assert_array_equal(scene.pieces[mesh.vertices], count + of_place[same])
        count += own
    assert count == len(scene.meshes)


def test_many_round_shapes_have_few_segments_each() -> None:
    """
    Expected: 64 balls that are small beside the scene have 32 segments around, as one has; a thousand have 12 each, and
        a scene of them no more than 100,000 vertices.
    """

    def balls(count: int) -> dict[str, dict]:
        places = np.random.default_rng(0).uniform(-5, 5, (count, 3)).tolist()
        return {
            f"b{k}": {"type": "sphere", "center": p, "radius": 0.02, "bsdf": PALE}
            for k, p in enumerate(places)
        }

    few, many = build(None, **balls(64)), build(None, **balls(1000))
    around = [len(np.unique(scene.positions[scene.meshes[0].vertices][:, 2])) for scene in (few, many)]
    assert few.n_vertices > 64 * 400
    assert many.n_vertices < 100_000
    assert around == [17, 7]


def test_names_of_shapes_that_mitsuba_merged() -> None:
    """Expected: the first one's, and how many more there are; shapes without a name are called by their type."""
    cubes = {
        f"c{k}": {
            "type": "cube",
            "to_world": T().translate([3.0 * k, 0, 0]),
            "bsdf": {"type": "ref", "id": "paint"},
        }
        for k in range(5)
    }
    scene = mi.load_dict({"type": "scene", "paint": PALE, **cubes})
    assert len(scene.shapes()) == 1
    assert [mesh.name for mesh in prt.Scene.from_mitsuba(scene).meshes] == ["cube_and_4_more"]
    quads = {name: {**cube, "type": "rectangle"} for name, cube in cubes.items()}
    scene = mi.load_dict({"type": "scene", "paint": PALE, **quads})
    assert [mesh.name for mesh in prt.Scene.from_mitsuba(scene).meshes] == ["mesh_0_and_4_more"]
