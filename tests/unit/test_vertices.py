"""Where rows are measured: vertices, and the rays by which a Mitsuba sensor reaches them."""

import mitsuba as mi
import numpy as np
import pytest
from conftest import T, build, bumpy_ball, diffuse, mesh, problem_at, still_life

import mi_sparse_prt as prt
from mi_sparse_prt.measurement.vertices import sensor_points, vertex_points, vertex_rays
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.solvers.direct_rays import DirectSolver

WHITE = diffuse(1, 1, 1)
FLAT = {"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90), "bsdf": WHITE}
OFFSET = float(mi.math.RayEpsilon)  # of a spawned ray, at the origin


def longest_edges(scene: Scene) -> np.ndarray:
    """(n_v,) longest edge of the triangles around each vertex, normalised frame."""
    result = np.zeros(scene.n_vertices)
    for part in scene.meshes:
        triangles = part.triangles + part.vertices.start
        p = scene.normalised_positions[triangles]
        edge = np.linalg.norm(np.roll(p, -1, axis=1) - p, axis=2).max(axis=1)
        np.maximum.at(result, triangles, edge[:, None])
    return result


# ------------------------------------------------------------------------------------ measurement points


def test_interior_vertices_are_measured_where_they_are(grey_scene):
    points = vertex_points(grey_scene)
    ball = grey_scene.meshes[1].vertices  # closed: it has no border
    assert np.array_equal(points.positions[ball], grey_scene.normalised_positions[ball])
    ground = grey_scene.meshes[0].vertices
    border = (np.abs(grey_scene.positions[ground, 0]) > 1.499) | (
        np.abs(grey_scene.positions[ground, 2]) > 1.499
    )
    moved = (points.positions[ground] != grey_scene.normalised_positions[ground]).any(axis=1)
    assert 4 < border.sum() < len(border)
    assert np.array_equal(moved, border)
    assert points.normals is points.offset_normals
    assert np.array_equal(points.normals, grey_scene.normals)


def test_border_vertices_move_into_their_mesh_by_a_few_ray_offsets():
    scene = build(0.5, plane=FLAT)
    before, after = scene.normalised_positions, vertex_points(scene).positions
    distance = np.linalg.norm(after - before, axis=1)
    border = np.abs(before).max(axis=1) > 0.4999
    assert (distance[~border] == 0).all()
    assert (distance[border] > 3 * OFFSET).all()
    assert (distance[border] < 6.1 * OFFSET).all()  # four offsets, each grows as 1 + |p|
    assert (np.abs(after[:, [0, 2]]).max(axis=1) < 0.5 - OFFSET).all()  # inside, corners too
    np.testing.assert_allclose(after[:, 1], before[:, 1], atol=1e-9)


def test_border_vertices_of_tiny_triangles_stay_in_them():
    """A triangle smaller than the offsets: no corner may leave it."""
    tiny = np.array([[0, 0, 0], [1e-4, 0, 0], [0, 0, -1e-4]])
    scene = build(
        float("inf"), plane=FLAT, tiny=mesh("tiny", tiny + [0, 0.5, 0], np.array([[0, 1, 2]]), WHITE)
    )
    p = vertex_points(scene).positions[scene.meshes[1].vertices] / scene.scale + scene.centre
    assert (p[:, 0] > 0).all()
    assert (p[:, 2] < 0).all()
    assert (p[:, 0] - p[:, 2] < 1e-4).all()


@pytest.mark.parametrize("sides", [3, 4, 6])
def test_border_vertices_on_a_fold_stay_on_their_surface(sides):
    """The ends of an open, smooth-shaded prism: a mean of its triangles would lie inside of it, in the dark.

    All vertices along an edge of the prism have one normal and, the prism being convex, about one view of the sky.
    Expected: the end rings have at least three quarters of the middle ring's irradiance (a point on one side of the
    edge does not see what lies below that side's own horizon). Inside of the prism they would have under a tenth.
    """
    phi = 2 * np.pi * np.arange(sides) / sides
    rings = [np.stack([0.3 * np.cos(phi), 0 * phi + y, 0.3 * np.sin(phi)], axis=-1) for y in (-0.5, 0, 0.5)]
    index = np.arange(3 * sides).reshape(3, sides)
    right = np.roll(index, -1, axis=1)
    lower = np.stack([index[:-1], index[1:], right[:-1]], axis=-1).reshape(-1, 3)
    upper = np.stack([right[:-1], index[1:], right[1:]], axis=-1).reshape(-1, 3)
    prism = mesh("prism", np.concatenate(rings), np.concatenate([lower, upper]), WHITE)
    scene = build(float("inf"), prism=prism)
    direct = DirectSolver(problem_at(scene, prt.CubemapLighting(8)))
    points, texels = np.repeat(np.arange(3 * sides), 384), np.tile(np.arange(384), 3 * sides)
    irradiance = direct.elements(points, texels).reshape(3, sides, 384).sum(axis=2)
    assert (irradiance[1] > 0.5).all()
    assert (irradiance[[0, 2]] > 0.75 * irradiance[1]).all()
    assert (irradiance[[0, 2]] < 1.02 * irradiance[1]).all()


def test_coincident_vertices_of_meeting_meshes_have_their_own_keys():
    """Two rectangles side by side share a border: same place, normal and albedo, but two rows."""
    left, right = ({**FLAT, "to_world": T().translate([x, 0, 0]) @ FLAT["to_world"]} for x in (-1, 1))
    points = vertex_points(build(1.0, left=left, right=right))
    assert len(np.unique(points.keys)) == len(points)
    swapped = vertex_points(build(1.0, right=right, left=left))
    assert np.array_equal(np.sort(points.keys), np.sort(swapped.keys))
    by_key = points.positions[np.argsort(points.keys)]
    assert np.array_equal(by_key, swapped.positions[np.argsort(swapped.keys)])


# ------------------------------------------------------------------------------------ rays to vertices


def fan_of_slivers() -> mi.Mesh:
    """A disk of 64 triangles with an aspect ratio of 1:1000 and a needle of 1:10000."""
    angle = 2 * np.pi * np.arange(64) / 64
    rim = np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=-1)
    inner = 0.999 * rim
    n = np.arange(64)
    thin = np.stack([n, 64 + n, 64 + np.roll(n, -1)], -1)
    needle = [[0, 0.3, 0], [1, 0.3, 0], [0.5, 0.3, -1e-4]]
    return mesh("slivers", np.concatenate([inner, rim, needle]), np.append(thin, [[128, 129, 130]], 0), WHITE)


SCENES = {
    "an open plane": lambda: build(0.25, plane=FLAT),
    "a sphere": lambda: build(0.3, ball={"type": "sphere", "bsdf": WHITE}),
    "a cube": lambda: build(0.5, box={"type": "cube", "bsdf": WHITE}),
    "an untessellated cube": lambda: build(float("inf"), box={"type": "cube", "bsdf": WHITE}),
    "slivers": lambda: build(float("inf"), fan=fan_of_slivers()),
    "a ball and a box over a ground": lambda: build(**still_life()),
    "small beside large": lambda: build(
        float("inf"),
        plane={**FLAT, "to_world": T().scale(100) @ FLAT["to_world"]},
        ball=mesh("ball", 0.5 * bumpy_ball()[0] + [0, 1, 0], bumpy_ball()[1], WHITE),
    ),
    "a box that stands in the ground": lambda: build(
        0.5, plane=FLAT, box={"type": "cube", "to_world": T().translate([0.2, 0.19, 0]).scale(0.2), "bsdf": WHITE}
    ),
}  # fmt: skip


@pytest.mark.parametrize("make", SCENES.values(), ids=SCENES.keys())
def test_every_vertex_is_reached(make):
    """Borders, poles, corners and slivers included: each ray ends on the vertex's own mesh, beside the vertex."""
    scene = make()
    rays = vertex_rays(scene.normalised)
    assert rays.missed.sum() == 0
    assert np.isfinite(rays.origins).all()
    np.testing.assert_allclose(np.linalg.norm(rays.directions, axis=1), 1, atol=1e-5)

    si = scene.normalised.ray_intersect(mi.Ray3f(mi.Point3f(rays.origins.T), mi.Vector3f(rays.directions.T)))
    assert si.is_valid().numpy().all()
    for part, shape in zip(scene.meshes, scene.normalised.shapes(), strict=True):
        assert (si.shape == mi.ShapePtr(shape)).numpy()[part.vertices].all()
    distance = np.linalg.norm(si.p.numpy().T - scene.normalised_positions, axis=1)
    assert (distance < 0.1 * longest_edges(scene) + 1e-6).all()

    points = sensor_points(scene, rays)
    assert np.array_equal(points.positions, si.p.numpy().T)
    np.testing.assert_allclose(np.linalg.norm(points.normals, axis=1), 1, atol=1e-5)
    assert np.array_equal(points.offset_normals, si.n.numpy().T)


def test_a_buried_vertex_is_reported():
    """Sheets at two heights lie over a plane so closely that no approach gets between them."""
    sheet = {
        k: {**FLAT, "to_world": T().translate([0, y * 2.0, 0]) @ T().scale(1.1) @ FLAT["to_world"]}
        for k, y in (("near", 2.5e-5), ("far", 5e-4))
    }
    scene = build(float("inf"), plane=FLAT, **sheet)
    missed = vertex_rays(scene.normalised).missed
    assert missed[scene.meshes[0].vertices].all()
    assert not missed[scene.meshes[2].vertices].any()


def test_rays_of_some_vertices(grey_scene):
    rays = vertex_rays(grey_scene.normalised)
    some = np.array([7, 3, 200])
    chosen = rays.take(some)
    assert np.array_equal(chosen.origins, rays.origins[some])
    assert np.array_equal(chosen.directions, rays.directions[some])
    assert chosen.missed.shape == (3,)
