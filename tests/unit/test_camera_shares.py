"""What cameras see, and errors of that: a dim room below a bright sky, a lamp behind a door."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import T, build, diffuse

import mi_sparse_prt as prt
from mi_sparse_prt.estimation.held_out import Sample, estimate_errors, held_out_error
from mi_sparse_prt.estimation.held_out_lamps import held_out_lamp_error
from mi_sparse_prt.measurement.camera_shares import camera_shares
from mi_sparse_prt.measurement.measurement import mesh_vertices
from mi_sparse_prt.operators.dense import Dense
from mi_sparse_prt.reflection.reflection import Diffuse
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.solvers.problem import Problem, diffuse_problem

GREY = diffuse(0.5, 0.5, 0.5)


def camera(origin: list[float], target: list[float], fov: float = 50) -> dict:
    """Of a square film."""
    film = {"type": "hdrfilm", "width": 64, "height": 64}
    pose = T().look_at(origin, target, [0, 1, 0])
    return {"type": "perspective", "fov": fov, "to_world": pose, "film": film}


def of_meshes(scene: Scene) -> dict[str, float]:
    shares = camera_shares(scene)
    return {mesh.name: float(shares[mesh.vertices].sum()) for mesh in scene.meshes}


def square(x: float, z: float = 0.0, bsdf: dict | None = None, **more: object) -> dict:
    """A quarter of a unit in size, at z, facing the camera at a large z."""
    pose = T().translate([x, 0, z]).scale(0.25)
    return {"type": "rectangle", "to_world": pose, "bsdf": bsdf or GREY, **more}


def test_shares_are_those_of_the_film():
    """Two squares, one twice as far and so a quarter as large, one that the first hides, one behind the camera."""
    view = camera([0, 0, 2], [0, 0, 0])
    shapes = {
        "near": square(-0.4),
        "far": square(0.8, -2),
        "hidden": square(-0.7, -1.5),
        "back": square(0, 3),
    }
    shares = of_meshes(build(0.1, sensor=view, **shapes))
    assert shares["hidden"] == shares["back"] == 0
    assert shares["near"] + shares["far"] == pytest.approx(1)
    assert shares["near"] / shares["far"] == pytest.approx(4, rel=0.02)
    assert not camera_shares(build(0.1, **shapes)).any()


def test_backs_and_what_is_in_a_mirror():
    """A two-sided square from behind; one to the side of the camera, which looks at a mirror that shows it."""
    sides = {"type": "twosided", "bsdf": GREY}
    mirror = {"type": "conductor", "material": "Ag"}
    turned = square(0.0, bsdf=sides, flip_normals=True)
    assert of_meshes(build(0.1, sensor=camera([0, 0, 2], [0, 0, 0]), turned=turned)) == {
        "turned": 0,
        "turned_back": pytest.approx(1),
    }
    pose = T().translate([0, 0, -0.5]).rotate([0, 1, 0], 45)
    side = {"type": "rectangle", "bsdf": GREY, "to_world": T().translate([2, 0, -0.5]).rotate([0, 1, 0], -90)}
    seen = {"type": "rectangle", "bsdf": mirror, "to_world": pose.scale(0.3)}
    shares = of_meshes(build(0.1, sensor=camera([0, 0, 2], [0, 0, -0.5]), mirror=seen, side=side))
    assert shares["mirror"] == pytest.approx(0.5) and shares["side"] == pytest.approx(0.5)


@pytest.mark.parametrize("wrong", ["seen", "unseen"])
def test_the_error_of_what_is_seen(wrong):
    """Rows of one of two alike squares are off by 20%: told is that of all, and of the one that a camera sees."""
    view = camera([-0.4, 0, 1], [-0.4, 0, 0], 30)
    scene = build(0.05, sensor=view, seen=square(-0.4), unseen=square(0.8))
    lighting = prt.CubemapLighting(4)
    exact = prt.precompute(scene, lighting, max_depth=2, progress=False)
    rows = exact.operators["direct"].rows(np.arange(scene.n_vertices)).astype(np.float32)
    mesh = next(mesh for mesh in scene.meshes if mesh.name == wrong)
    rows[mesh.vertices] *= 1.2
    problem = diffuse_problem(scene, lighting, 2)
    found = held_out_error(problem, replace(exact, operators={"direct": Dense(rows)}), 1)
    assert found.total == pytest.approx(0.2 / np.sqrt(2), rel=0.03)
    assert found.seen == pytest.approx(0.2 if wrong == "seen" else 0.0, abs=0.003)
    assert found.in_view.total == max(found.total, found.seen)
    assert found.report()["seen"] == found.seen


def tent(view: dict) -> Problem:
    """A floor under a lamp; on it a box that is open on the side turned away, lit by light of the floor and a wall."""
    both = {"type": "twosided", "bsdf": diffuse(0.7, 0.7, 0.7)}
    poses = [
        T().rotate([1, 0, 0], -90).scale([4, 2, 1]),
        T().translate([3.5, 1, 0]).rotate([0, 1, 0], -90),
        T().translate([1, 0.6, 0]).rotate([1, 0, 0], 90).scale([0.5, 0.5, 1]),
        T().translate([0.5, 0.3, 0]).rotate([0, 1, 0], 90).scale([0.5, 0.3, 1]),
        T().translate([1, 0.3, 0.5]).scale([0.5, 0.3, 1]),
        T().translate([1, 0.3, -0.5]).scale([0.5, 0.3, 1]),
    ]
    shapes = {
        f"wall_{k}": {"type": "rectangle", "to_world": pose, "bsdf": both} for k, pose in enumerate(poses)
    }
    lamp = {
        "type": "sphere",
        "radius": 0.1,
        "center": [-2, 1, 0],
        "emitter": {"type": "area", "radiance": 5.0},
    }
    scene = build(0.12, optimize=False, sensor=view, lamp=lamp, **shapes)
    return Problem(scene, prt.SceneEmitters(scene), mesh_vertices(scene), Diffuse(scene.albedo), "texel", 5)


def test_a_lamp_is_told_of_as_it_is_seen():
    """Light in the box is off by 30%, elsewhere right: the error of all is far smaller than that of what is seen."""
    problem = tent(camera([0.8, 0.3, 0], [0.5, 0.25, 0.1], 90))
    transport = prt.precompute(problem.scene, problem.emission, max_depth=5, spp=256, progress=False)
    off = np.where(camera_shares(problem.scene) > 0, 1.3, 1.0).astype(np.float32)[:, None, None]
    parts = {name: Dense(part.rows(np.arange(len(off))) * off) for name, part in transport.operators.items()}
    found = held_out_lamp_error(problem, replace(transport, operators=parts), 0)
    assert found.seen == pytest.approx(0.3, rel=0.25)
    assert found.total < found.seen / 3


def test_nothing_is_said_of_what_is_dark():
    """Noise of next to no light, and an error of 10% where there is some."""
    rng, n = np.random.default_rng(0), 1000
    for light, told in ((1.0, 0.1), (1e-4, None)):
        norms = light + 0.01 * rng.standard_normal(n)
        squares = 0.01 * light + 1e-3 * rng.standard_normal(n)
        sample = Sample(np.ones(n), squares[:, None], norms[:, None], np.ones(n), np.ones(n))
        found = estimate_errors({("floor", "direct"): sample}).seen
        assert found == (None if told is None else pytest.approx(told, rel=0.05))
