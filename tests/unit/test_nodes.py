"""Nodes: where light is gathered, if not at every vertex, and how the others follow."""

import numpy as np
import pytest
import scipy.sparse
from conftest import COLOURS, T, build, diffuse, mesh, problem_at, still_life

import mi_sparse_prt as prt
from mi_sparse_prt.measurement.vertices import Points, vertex_points
from mi_sparse_prt.methods import execution
from mi_sparse_prt.methods.plan import Plan
from mi_sparse_prt.planner.radiosity_costs import _Pilot
from mi_sparse_prt.reconstruction import node_placement
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.radiosity import RadiositySolver
from mi_sparse_prt.solvers.surface_nodes import Nodes


@pytest.fixture(scope="module")
def scene() -> Scene:
    return build(0.12, **still_life(COLOURS))


def choose_nodes(scene: Scene, points: Points, most: int) -> Nodes:
    """Meshes of more than 200 vertices have fewer nodes."""
    return node_placement.choose_nodes(scene, points, most, small=200)


def test_small_meshes_keep_all_vertices(scene):
    points = vertex_points(scene)
    assert choose_nodes(scene, points, scene.n_vertices).weights is None
    nodes = choose_nodes(scene, points, 1000)
    assert 900 < len(nodes) < 1100
    for one in scene.meshes:
        size = one.vertices.stop - one.vertices.start
        kept = np.sum((nodes.ids >= one.vertices.start) & (nodes.ids < one.vertices.stop))
        assert kept == size if size <= 200 else 200 <= kept < size


def test_pieces_of_a_mesh_are_as_meshes():
    """
    Rationale: a tree's leaves are one mesh or a thousand; near each other, they look elsewhere.
    Setup: 40 turned cards over a ground, as one mesh and as 40.
    Expected: the same nodes; each card vertex is one, and no weight of the ground's vertices is a card's.
    """
    rng = np.random.default_rng(5)
    corner = np.array([[-0.1, -0.1, 0], [0.1, -0.1, 0], [0.1, 0.1, 0], [-0.1, 0.1, 0]])
    corners = [
        corner @ np.linalg.qr(rng.normal(size=(3, 3)))[0] + rng.uniform([-1, 0.3, -1], 1) for _ in range(40)
    ]
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    grey = diffuse(0.5, 0.5, 0.5)
    ground = {"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90).scale(2), "bsdf": grey}
    own = {f"card{k}": mesh(f"card{k}", p, faces, grey, False) for k, p in enumerate(corners)}
    every = np.concatenate([faces + 4 * k for k in range(40)])
    one = {"cards": mesh("cards", np.concatenate(corners), every, grey, False)}
    found = []
    for cards in (own, one):
        scene = build(0.1, ground=ground, **cards)
        points = vertex_points(scene)
        nodes = choose_nodes(scene, points, 400)
        floor = scene.meshes[0].vertices
        assert scene.n_vertices > 600
        assert np.isin(np.arange(floor.stop, scene.n_vertices), nodes.ids).all()
        of_cards = nodes.ids >= floor.stop
        assert nodes.weights[: floor.stop][:, of_cards].nnz == 0
        assert (nodes.weights[floor.stop :].sum(axis=1) == 1).all()
        found.append(np.sort(points.keys[nodes.ids]))
    assert np.array_equal(*found)


def test_nodes_are_spread_evenly(scene):
    """On the flat ground no place is farther from a node than four times the spacing of a square grid of so many."""
    nodes = choose_nodes(scene, vertex_points(scene), 700)
    ground = scene.meshes[0].vertices
    p = scene.positions[ground][:, [0, 2]]
    at = scene.positions[nodes.ids[nodes.ids < ground.stop]][:, [0, 2]]
    nearest = np.linalg.norm(p[:, None] - at[None], axis=2).min(axis=1)
    assert nearest.max() < 4 * 3 / np.sqrt(len(at)) / 2


def test_constants_and_linear_functions_are_kept(scene):
    """Rows of weights sum to 1; inside of the flat ground, positions are met within a tenth of a node's spacing."""
    nodes = choose_nodes(scene, vertex_points(scene), 1000)
    one = np.ones((len(nodes), 1), np.float32)
    assert np.abs(nodes.interpolate(one) - 1).max() < 1e-5
    spread = nodes.interpolate(scene.positions[nodes.ids])
    ground = scene.meshes[0].vertices
    inside = (np.abs(scene.positions[ground][:, [0, 2]]) < 1.2).all(axis=1)
    error = (spread - scene.positions)[ground][inside]
    spacing = 3 / np.sqrt(np.sum(nodes.ids < ground.stop))
    assert np.sqrt((error**2).mean()) < 0.1 * spacing


def test_collect_is_the_transpose_of_spread(scene):
    nodes = choose_nodes(scene, vertex_points(scene), 800)
    rng = np.random.default_rng(0)
    light = rng.normal(size=(len(nodes), 9)).astype(np.float32)
    weights = rng.normal(size=(scene.n_vertices, 9)).astype(np.float32)
    left, right = (
        np.vdot(weights, nodes.interpolate(light)),
        np.vdot(nodes.interpolate_adjoint(weights), light),
    )
    assert left == pytest.approx(right, rel=1e-4)


def test_the_result_does_not_depend_on_the_order_of_shapes(scene):
    """The same nodes, and the same light at every vertex within rounding."""
    lighting = prt.CubemapLighting(2)

    def found(some: Scene) -> tuple[np.ndarray, np.ndarray]:
        points = vertex_points(some)
        order = np.argsort(points.keys)
        gather = RadiositySolver(
            problem_at(some, lighting, points), 64, nodes=choose_nodes(some, points, 800)
        )
        light = np.maximum(some.normals[:, 1:2], 0)
        return np.sort(points.keys[gather.nodes.ids]), gather.apply(light)[order, 0]

    backwards = build(0.12, **dict(reversed(still_life(COLOURS).items())))
    (nodes, light), (other_nodes, other_light) = found(scene), found(backwards)
    assert np.array_equal(nodes, other_nodes)
    assert light.max() > 0.05
    assert np.abs(light - other_light).max() < 1e-5


def test_fewer_nodes_fewer_rays_and_nearly_the_same_light(scene):
    """A quarter of the vertices of the larger meshes: indirect light within 8% of that of all, the mean within 1%."""
    points, lighting = vertex_points(scene), prt.CubemapLighting(2)
    light = np.maximum(0.5 + 0.5 * scene.normals[:, 1:2], 0)
    every = RadiositySolver(problem_at(scene, lighting, points), 256)
    some = RadiositySolver(problem_at(scene, lighting, points), 256, nodes=choose_nodes(scene, points, 800))
    assert some.rays == 256 * len(some.nodes) < 0.6 * every.rays
    known, found = every.apply(light), some.apply(light)
    assert np.linalg.norm(found - known) < 0.08 * np.linalg.norm(known)
    assert found.mean() == pytest.approx(known.mean(), rel=0.01)


@pytest.mark.usefixtures("no_held_out")
def test_glossy_vertices_have_terms_of_their_own(monkeypatch):
    """
    Rationale: unit-albedo light is interpolated between nodes, the terms of a BRDF in frames that turn are not.
    Expected: fewer rays, from nodes and from all glossy vertices; indirect rows of both kinds within 8% of those
        without nodes, their means within 1%.
    """
    phong = {"type": "phong", "exponent": 8.0, "specular_reflectance": 0.4, "diffuse_reflectance": 0.3}
    ball = {"type": "sphere", "center": [0.1, 0.5, 0], "radius": 0.4, "bsdf": phong}
    with pytest.warns(prt.PrtWarning, match="not diffuse"):
        scene = build(0.12, **(still_life(COLOURS) | {"ball": ball}))

    def found() -> tuple[prt.LightTransport, np.ndarray]:
        plan = Plan("exact", "gather", 256, 0.01)
        transport = prt.precompute(scene, prt.CubemapLighting(4), plan, terms=2, progress=False)
        return transport, transport.indirect.relight(np.ones((96, 3), np.float32)).astype(np.float64)

    every, known = found()
    monkeypatch.setattr(execution, "choose_nodes", lambda scene, points: choose_nodes(scene, points, 800))
    some, light = found()
    starts = np.union1d(choose_nodes(scene, vertex_points(scene), 800).ids, every.reflection.glossy)
    assert some.report["rays"]["gather"] == 256 * len(starts) < 0.8 * every.report["rays"]["gather"]
    n = scene.n_vertices
    for rows in (slice(n), slice(n, None)):
        assert np.linalg.norm(light[rows] - known[rows]) < 0.08 * np.linalg.norm(known[rows])
        assert light[rows].mean() == pytest.approx(known[rows].mean(), rel=0.01)


def test_what_sends_nothing_on_has_no_nodes():
    """A ball of glass above a floor; and alone, where others must not fail for want of nodes."""
    glass = {"type": "sphere", "radius": 0.4, "center": [0, 1, 0], "bsdf": {"type": "dielectric"}}
    floor = {"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90), "bsdf": diffuse(0.5, 0.5, 0.5)}
    scene = build(0.05, optimize=False, ball=glass, floor=floor)
    ball, plane = (mesh.vertices for mesh in scene.meshes)
    nodes = choose_nodes(scene, vertex_points(scene), 400)
    assert nodes.ids.min() >= plane.start and 300 < len(nodes) < 500
    light = nodes.interpolate(np.ones((len(nodes), 1), np.float32))
    assert light[plane] == pytest.approx(1, abs=1e-5) and not light[ball].any()
    alone = build(0.05, ball=glass)
    assert len(choose_nodes(alone, vertex_points(alone), 400)) > 300


@pytest.mark.filterwarnings("ignore::mi_sparse_prt.core.errors.PrtWarning")
def test_glass_alone_keeps_no_light():
    """Expected: no rays for light that no surface keeps, and a matrix of zeros; a picture shows the sky behind."""
    scene = build(0.1, ball={"type": "sphere", "bsdf": {"type": "dielectric"}})
    found = prt.precompute(scene, prt.CubemapLighting(4), target_error=0.05, progress=False)
    assert not found.rows(np.arange(scene.n_vertices)).any()
    assert any("every surface is black, or sends all light on" in line for line in found.report["skipped"])
    assert "specular" not in found.operators
    # where a pilot's rays find nothing that keeps light
    pilot = _Pilot(DirectSolver(problem_at(scene, prt.CubemapLighting(4))), np.arange(5))
    rays = scipy.sparse.csr_array((5, scene.n_vertices), dtype=np.float32)
    assert not pilot.light(rays, np.zeros((5, 3), np.int64)).any()
