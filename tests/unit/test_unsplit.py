"""Rays that need no vertices are traced in a scene of fewer triangles: they meet the same surfaces there."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import BALL, GROUND, T, build, problem_at

import mi_sparse_prt as prt
from mi_sparse_prt.core.bits import unpack
from mi_sparse_prt.core.run import Run
from mi_sparse_prt.methods.brute_force import exact_direct
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.specular_chains import Cells, SpecularChains, draw_strata, specular_form_factors

TEXTURED = {
    "type": "diffuse",
    "reflectance": {
        "type": "checkerboard",
        "color0": 0.1,
        "color1": 0.8,
        "to_uv": mi.ScalarTransform3f().scale(5),
    },
}
CUBE = {
    "type": "cube",
    "to_world": T().translate([0.3, 0.5, -0.4]).rotate([0.6, 0, 0.8], 40).scale(0.4),
    "bsdf": TEXTURED,
}
MIRROR = {
    "type": "rectangle",
    "to_world": T().translate([-1, 1, 0]).scale(0.3),
    "bsdf": {"type": "conductor"},
}


def random_rays(n: int) -> mi.Ray3f:
    """From everywhere in the unit box in all directions."""
    rng = np.random.default_rng(5)
    origins, ways = rng.uniform(-0.5, 0.5, (3, n)), rng.normal(size=(3, n))
    ways /= np.linalg.norm(ways, axis=0)
    ray = mi.Ray3f(mi.Point3f(origins.astype(np.float32)), mi.Vector3f(ways.astype(np.float32)))
    dr.eval(ray)
    return ray


def met(scene: mi.Scene, ray: mi.Ray3f) -> dict[str, np.ndarray]:
    """What rays meet, one column each."""
    si = scene.ray_intersect(ray)
    wo = mi.Vector3f(0.36, 0.48, 0.8)
    found = {
        "valid": si.is_valid(),
        "distance": dr.select(si.is_valid(), si.t, 0),
        "place": dr.select(si.is_valid(), si.p, 0),
        "normal": si.n,
        "shading": si.sh_frame.n,
        "tangent": si.sh_frame.s,
        "uv": si.uv,
        "reflected": si.bsdf().eval(mi.BSDFContext(), si, wo, si.is_valid()),
        "blocked": scene.ray_test(ray),
    }
    return {name: np.atleast_2d(value.numpy()) for name, value in found.items()}


@pytest.mark.parametrize(
    "placed", [T(), T().translate([7, -3, 2]).rotate([0.6, 0.8, 0], 33).scale(20)], ids=["here", "there"]
)
def test_rays_meet_the_same(placed: mi.ScalarTransform4f) -> None:
    """
    Expected: hits, distances, frames, texture coordinates and BSDFs as with all triangles, but for 1 in 2000 rays, at
        edges of shapes and of a checkerboard's squares.
    """
    shapes = {"ground": {**GROUND, "bsdf": TEXTURED}, "cube": CUBE, "ball": BALL}
    moved = {k: {**s, "to_world": placed @ s.get("to_world", T())} for k, s in shapes.items()}
    scene = build(0.1 / build(1.0, **moved).scale, **moved)
    ray = random_rays(200_000)
    split, whole = met(scene.normalised, ray), met(scene.unsplit, ray)
    counts = [
        (a.face_count(), b.face_count())
        for a, b in zip(scene.normalised.shapes(), scene.unsplit.shapes(), strict=True)
    ]
    assert counts[0][0] > 100 and counts[0][1] == 2
    assert counts[1][0] > 100 and counts[1][1] == 12
    assert counts[2][0] == counts[2][1]
    assert split["valid"].mean() > 0.1 and (split["reflected"] > 0).any()
    for name, values in split.items():
        off = np.abs(values.astype(float) - whole[name]).max(axis=0) > 1e-3
        assert off.mean() < 5e-4, name


def test_smooth_meshes_keep_their_triangles() -> None:
    """Rationale: normals between split edges are normalised once more; shading would differ.

    Expected: nothing but the ground is traced with fewer triangles; without a ground, there is one scene.
    """
    ball = build(0.3, ball=BALL)
    assert ball.unsplit is ball.normalised
    scene = build(0.3, ball=BALL, ground=GROUND)
    assert [s.face_count() for s in scene.unsplit.shapes()][1] == 2
    assert scene.unsplit.shapes()[0] is scene.normalised.shapes()[0]


def test_smooth_normals_on_long_edges() -> None:
    """
    Expected: a mesh whose corners have other normals than their triangles is traced as it was split.
    """
    mesh = mi.Mesh("bent", 3, 1, has_vertex_normals=True)
    parameters = mi.traverse(mesh)
    parameters["faces"] = mi.UInt32([0, 1, 2])
    parameters["vertex_positions"] = mi.Float([0, 0, 0, 1, 0, 0, 0, 1, 0])
    parameters.update()
    bent = np.array([[0.2, 0, 1], [-0.2, 0, 1], [0, 0.2, 1]])
    parameters["vertex_normals"] = mi.Float((bent / np.linalg.norm(bent, axis=1, keepdims=True)).ravel())
    parameters.update()
    scene = build(0.1, bent=mesh)
    assert scene.normalised.shapes()[0].face_count() > 50
    assert scene.unsplit is scene.normalised


def test_instances_are_whole_too() -> None:
    """
    Expected: three boxes, of which one has longer edges, are one mesh of 36 triangles.
    """
    group = {"type": "shapegroup", "cube": {"type": "cube"}}
    places = [T().translate([3 * k, 0, 0]).scale([1, 1, 1 + k]) for k in range(3)]
    copies = {
        f"copy_{k}": {"type": "instance", "group": {"type": "ref", "id": "boxes"}, "to_world": w}
        for k, w in enumerate(places)
    }
    scene = build(0.5, boxes=group, **copies)
    assert [s.face_count() for s in scene.unsplit.shapes()] == [36]
    ray = random_rays(20_000)
    split, whole = met(scene.normalised, ray), met(scene.unsplit, ray)
    assert (split["valid"] == whole["valid"]).mean() > 0.999
    assert split["valid"].mean() > 0.05


def test_specular_surfaces_alone() -> None:
    """
    Expected: a scene of the mirror; of all surfaces, if all are mirrors.
    """
    scene = build(0.3, ground=GROUND, mirror=MIRROR)
    assert [s.id() for s in scene.specular_surfaces.shapes()] == ["mirror"]
    alone = build(0.3, mirror=MIRROR)
    assert alone.specular_surfaces is alone.unsplit


def test_lamps_are_known_in_both() -> None:
    """
    Expected: what rays of either scene meet is the same shape of the world's.
    """
    lamp = {**MIRROR, "bsdf": TEXTURED, "emitter": {"type": "area", "radiance": 1.0}}
    scene = build(0.2, ground=GROUND, lamp=lamp)
    ray = random_rays(20_000)
    emitters = []
    for traced in (scene.normalised, scene.unsplit):
        si = traced.ray_intersect(ray)
        shape = scene.shape_in_world(si.shape, si.is_valid())
        emitters.append(dr.reinterpret_array(mi.UInt32, shape.emitter()).numpy())
    assert (emitters[0] != emitters[1]).mean() < 1e-3
    assert 0 < (emitters[0] > 0).mean() < 0.5


def test_matrices_are_the_same() -> None:
    """
    Expected: direct light of both scenes differs in less than 1 in 2000 elements.
    """
    scene = build(0.15, ground=GROUND, cube=CUBE)
    lighting = prt.CubemapLighting(8)
    found = prt.precompute(scene, lighting, method="brute_force", max_depth=2, progress=False).rows(
        np.arange(scene.n_vertices)
    )
    scene.unsplit = scene.normalised
    every = prt.precompute(scene, lighting, method="brute_force", max_depth=2, progress=False).rows(
        np.arange(scene.n_vertices)
    )
    assert (np.abs(found - every) > 1e-6).mean() < 5e-4
    assert found.any()


PANE = {
    "type": "rectangle",
    "to_world": T().translate([0, 1.2, 0]).rotate([1, 0, 0], 90).scale(0.6),
    "bsdf": {"type": "thindielectric"},
}
LEAF = {
    "type": "rectangle",
    "to_world": T().translate([0.4, 0.8, 0.3]).rotate([1, 0, 0], -70).scale(0.4),
    "bsdf": {
        "type": "mask",
        "opacity": {"type": "checkerboard", "color0": 0.0, "color1": 1.0},
        "nested": {"type": "diffuse"},
    },
}


def test_what_blocks_is_asked_for_apart() -> None:
    """Rationale: light that passes panes and masks is told by rays among these alone, where nothing else is in the way.

    Expected: bits, and light that passes in part, as of rays that look for all surfaces one after the other, but for 1
        in 1000 elements.
    """
    scene = build(0.2, ground=GROUND, pane=PANE, leaf=LEAF, ball=BALL)
    assert [s.id() for s in scene.passing_surfaces.shapes()] == ["pane", "leaf"]
    assert [s.id() for s in scene.blocking_surfaces.shapes()] == ["ground", "ball"]
    ids = np.arange(scene.n_vertices)
    found = []
    for _ in "ab":
        problem = replace(problem_at(scene, prt.CubemapLighting(8)), specular_apart=True)
        bits, passed = DirectSolver(problem).rows_and_passed(ids.astype(np.uint32))
        light = np.zeros((scene.n_vertices * 384, passed.values.shape[1]))
        light[passed.elements] = passed.values
        found.append((unpack(bits, 384), light))
        scene.__dict__ |= {"blocking_surfaces": None, "passing_surfaces": scene.unsplit}
    (seen, light), (known, every) = found
    assert (seen != known).mean() < 1e-3
    assert (np.abs(light - every).max(axis=1) > 1e-6).mean() < 1e-3
    assert (light > 0).any(axis=1).mean() > 0.02
    assert 0.1 < seen.mean() < 0.5


def test_rays_to_centres_are_traced_once() -> None:
    """
    Expected: direct light takes no rays more where those of light that passes have told it; it is that of a scene
        without the memory of these.
    """
    scene = build(0.2, ground=GROUND, pane=PANE, leaf=LEAF)
    lighting = prt.CubemapLighting(8)
    matrix = prt.precompute(scene, lighting, target_error=0.5, progress=False)
    assert matrix.report["rays"]["direct"] == 0
    direct = exact_direct(DirectSolver(replace(problem_at(scene, lighting), specular_apart=True)), Run())
    ids = np.arange(scene.n_vertices)
    np.testing.assert_array_equal(matrix.operators["direct"].rows(ids), direct.direct.rows(ids))


@pytest.mark.parametrize("max_depth", [4, -1], ids=["by depth", "without a limit"])
def test_chains_in_one_kernel_are_those_surface_by_surface(max_depth: int) -> None:
    """Rationale: rays to the sky are followed in a loop on the device, others from one surface to the next.

    Expected: the same rays bring the same light to each point from each texel, after as many surfaces; glass, a mirror
        behind it, and a mask send them on. Sums differ by what fixed-point numbers leave out.
    """
    ball = {**BALL, "bsdf": {"type": "dielectric"}}
    scene = build(0.3, ground=GROUND, ball=ball, mirror=MIRROR, leaf=LEAF)
    problem = replace(problem_at(scene, prt.CubemapLighting(4), max_depth=max_depth), specular_apart=True)
    chains, ids = SpecularChains(problem), np.arange(scene.n_vertices)
    cells = chains.find_cells(ids, 1)
    strata = np.full(len(cells.rows), 2)
    every = draw_strata(cells, problem.points.keys, 4.0 * np.ones(len(strata)), 2, 1)
    light = chains.gather_light(ids, every, 2).light
    depths = max(problem.depths_apart, 1)
    known = np.zeros((3, scene.n_vertices, depths, 96))
    for depth, ends in enumerate(chains._follow(*chains._rays_into(ids, cells, strata, 2), True)):
        kept = ends.valid.numpy()
        place = cells.rows[ends.of.numpy()[kept]], min(depth, depths - 1), ends.column.numpy()[kept]
        for c in range(3):
            np.add.at(known[c], place, ends.weight.numpy()[c, kept] / (16 * 2) ** 2)
    for c in range(3):
        np.testing.assert_allclose(light[c].toarray().reshape(known[c].shape), known[c], atol=1e-5)
    shares = known.sum(axis=(0, 1, 3))
    assert (shares > 0.01 * shares.sum()).all()


def test_points_that_see_no_specular_surface() -> None:
    """
    Rationale: blocks of points may have no ray towards one, and the process ends where no rays at all are traced.

    Expected: no light and no surfaces at the ground, whose horizon hides a mirror below it.
    """
    below = {**MIRROR, "to_world": T().translate([0, -1, 0]).scale(0.3)}
    scene = build(0.3, ground=GROUND, mirror=below)
    problem = replace(problem_at(scene, prt.CubemapLighting(4)), specular_apart=True)
    ids = np.arange(scene.meshes[0].vertices.stop)
    for matrix in specular_form_factors(problem, ids, 64, 1):
        assert matrix.shape == (len(ids), scene.n_vertices)
        assert matrix.nnz == 0
    cells = Cells(np.zeros(4, np.int64), np.arange(4), np.ones(4, np.float32))
    chains = SpecularChains(problem)
    assert len(chains.find_cells(ids, 1).rows) == 0
    strata = draw_strata(cells, problem.points.keys, np.ones(4), 1, 1)
    assert chains.gather_light(ids[:1], strata, 2).light[0].nnz == 0
