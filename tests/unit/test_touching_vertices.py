"""Vertices that lie on another surface are moved off it, to the side with more room."""

import mitsuba as mi
import numpy as np
import pytest
from conftest import BALL, GROUND, PALE, T, build

import mi_sparse_prt as prt
from mi_sparse_prt.measurement.touching_vertices import APART
from mi_sparse_prt.measurement.vertices import vertex_points
from mi_sparse_prt.methods.plan import Plan

LIGHTING = prt.CubemapLighting(4)


def standing(below: float) -> dict:
    """A wall on the middle of the ground that goes on below it."""
    return {
        "type": "rectangle",
        "to_world": T().translate([0, 0.5 - below, 0]).scale([0.6, 0.5, 1]),
        "bsdf": PALE,
    }


def lid(height: float) -> dict:
    """A smaller ground, upside down."""
    flat = T().translate([0, height, 0]).rotate([1, 0, 0], 90).scale(0.9)
    return {"type": "rectangle", "to_world": flat, "bsdf": PALE}


def moved(scene: prt.Scene) -> np.ndarray:
    """How far vertices were moved (n_v, 3), in ray offsets."""
    points = vertex_points(scene).positions
    return (points - scene.normalised_positions) / (
        (1 + np.abs(points).max(axis=1, keepdims=True)) * mi.math.RayEpsilon
    )


@pytest.mark.parametrize("height", [-0.2, 0.2])
def test_to_the_side_with_more_room(height):
    """
    Expected: the wall's vertices in the plane of the ground are moved up or down, away from a lid that is below or
        above it, by four ray offsets; of all others, none but those on borders.
    """
    scene = build(0.25, ground=GROUND, wall=standing(0.5), lid=lid(height))
    wall = scene.meshes[1].vertices
    p, by = scene.positions[wall], moved(scene)[wall]
    border = (np.abs(np.abs(p[:, 0]) - 0.6) < 1e-5) | (np.abs(np.abs(p[:, 1]) - 0.5) < 1e-5)
    on_ground = np.abs(p[:, 1]) < 1e-6
    assert (on_ground & ~border).sum() >= 3
    expected = np.tile([0, -np.sign(height) * APART, 0], ((on_ground & ~border).sum(), 1))
    np.testing.assert_allclose(by[on_ground & ~border], expected, atol=0.1)
    assert not by[~on_ground & ~border & (np.abs(p[:, 1] - height) > 1e-3)].any()


def test_what_touches_nothing_stays():
    """
    Expected: no vertex of a ball that floats leaves its surface, nor any of a cube's faces; those on borders are moved
        along it.
    """
    for shape in (BALL, {"type": "cube", "bsdf": PALE}):
        scene = build(0.2, ground=GROUND | {"to_world": T().translate([0, -2, 0])}, shape=shape)
        assert np.abs((moved(scene) * scene.normals).sum(axis=1)).max() < 0.5


def test_light_at_the_foot_of_a_wall():
    """
    Rationale: a vertex in the plane of the ground does not see the ground, and lacks the light that it sends.
    Expected: where a wall passes through the ground, light is that of a wall which ends there, within 3%, noise
        included (1.5%).
    """
    feet = []
    for below in (0.0, 0.5):
        scene = build(0.25, ground=GROUND, wall=standing(below), lid=lid(-0.2))
        found = prt.precompute(scene, LIGHTING, Plan("exact", "gather", 1024), max_depth=3, progress=False)
        wall = np.arange(scene.n_vertices)[scene.meshes[1].vertices]
        p = scene.positions[wall]
        foot = wall[(np.abs(p[:, 1]) < 1e-6) & (np.abs(p[:, 0]) < 0.5)]
        feet.append(found.relight(np.ones((LIGHTING.n_directions, 3)))[foot].mean())
    assert abs(feet[1] / feet[0] - 1) < 0.03
