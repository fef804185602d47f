"""Edges near small things are short, also those of large things beside them."""

import mitsuba as mi
import numpy as np
import pytest
from conftest import T, diffuse

from mi_sparse_prt.scene import sizing_field
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.scene.subdivision import subdivide

GREY = diffuse(0.5, 0.5, 0.5)


def scene(size: float, *others: dict, edge_length: float | None = None) -> Scene:
    """A plain of some size, and what stands on it."""
    plain = {"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90).scale(size), "bsdf": GREY}
    shapes = {f"thing_{k}": {**other, "bsdf": GREY} for k, other in enumerate(others)}
    return Scene.from_mitsuba(
        mi.load_dict({"type": "scene", "plain": plain, **shapes}, optimize=False), edge_length
    )


def box(x: float, side: float) -> dict:
    return {"type": "cube", "to_world": T().translate([x, side / 2, 0]).scale(side / 2)}


def edges(found: Scene, mesh: int) -> tuple[np.ndarray, np.ndarray]:
    """Lengths of the edges of a mesh, and their midpoints."""
    listed = found.meshes[mesh]
    corners = found.positions[listed.vertices][listed.triangles].astype(np.float64)
    ends = corners, np.roll(corners, -1, axis=1)
    return np.linalg.norm(ends[0] - ends[1], axis=2).ravel(), ((ends[0] + ends[1]) / 2).reshape(-1, 3)


def test_edges_grow_with_the_distance():
    """
    Scenario: a box of side 1 on a plain 200 across, on which edges are 4.4 long.
    Expected: none is longer than 0.31 (an eighth of its diagonal, times sqrt(2)) where it stands, or than half of the
        distance from it (and of what points of it are apart), and no vertex lies on an edge of another triangle.
    """
    found = scene(100, box(3, 1))
    for mesh in (0, 1):
        length, middle = edges(found, mesh)
        away = np.linalg.norm(np.maximum(np.abs(middle - [3, 0.5, 0]) - 0.5, 0), axis=1)
        assert np.all(length <= 1.01 * np.maximum(0.31, 0.5 * (away + 0.31)))
    assert found.n_vertices < 4225 + 24 + 8192
    length, middle = edges(found, 0)
    inside = np.abs(middle[:, [0, 2]]).max(axis=1) < 99.9
    _, times = np.unique(np.round(middle[inside], 4), axis=0, return_counts=True)
    assert np.all(times == 2)  # both triangles beside an edge have it whole


def test_where_all_is_large_nothing_changes():
    """Expected: a box as large as an eighth of the scene, or edges that were asked for, leave it as it was."""
    found = scene(3, box(0, 1))
    assert found.n_vertices == scene(3, box(0, 1), edge_length=np.sqrt(36 + 36 + 1) / 64).n_vertices
    np.testing.assert_allclose(found.centre, [0, 0.5, 0], atol=1e-6)
    assert found.scale == pytest.approx(1 / 6)
    assert scene(100, box(3, 1), edge_length=5).meshes[0].vertices.stop == 65**2


def test_the_frame_is_that_of_small_things():
    """Expected: the normalised frame has its origin where they are, and its unit shrinks as edges do."""
    found = scene(1000, box(300, 1))
    np.testing.assert_allclose(found.centre, [300, 0.5, 0], atol=0.6)
    shortest = edges(found, 1)[0].min()
    longest = edges(found, 0)[0].max()
    assert 1 / found.scale == pytest.approx(2000 * shortest / longest, rel=1)
    assert 1e-4 / found.scale < 0.01 * shortest  # how far off rays start


def test_vertices_lie_on_round_shapes():
    """Expected: a large ball and a pipe below small boxes have their vertices where they are, and normals too."""
    ball = {"type": "sphere", "center": [0, -100, 0], "radius": 100}
    pipe = {"type": "cylinder", "p0": [40, -100, 0], "p1": [40, 100, 0], "radius": 30, "flip_normals": True}
    found = scene(1, ball, pipe, box(0, 0.5), box(9.7, 0.5))
    of_ball, of_pipe = found.meshes[1].vertices, found.meshes[2].vertices
    out = found.positions[of_ball] - [0, -100, 0]
    np.testing.assert_allclose(np.linalg.norm(out, axis=1), 100, rtol=1e-6)
    np.testing.assert_allclose(found.normals[of_ball], out / 100, atol=1e-5)
    out = (found.positions[of_pipe] - [40, 0, 0]) * [1, 0, 1]
    np.testing.assert_allclose(np.linalg.norm(out, axis=1), 30, rtol=1e-5)
    np.testing.assert_allclose(found.normals[of_pipe], -out / 30, atol=1e-5)
    for mesh in (1, 2):
        length, middle = edges(found, mesh)
        assert length[np.linalg.norm(middle - [[0, 0, 0], [10, 0, 0]][mesh - 1], axis=1) < 0.5].max() < 0.31


def test_vertices_are_limited(monkeypatch):
    """Expected: of very many small things, edges are shorter only as far as vertices suffice; all have the same."""
    rng = np.random.default_rng(0)
    boxes = [box(float(x), 0.3) for x in rng.uniform(-90, 90, 100)]
    monkeypatch.setattr(sizing_field, "LEAST", 0)
    monkeypatch.setattr(sizing_field, "SHARE", 0.0)
    few = scene(100, *boxes).n_vertices
    for more in (300, 3000, 30000):
        monkeypatch.setattr(sizing_field, "LEAST", more)
        assert few <= scene(100, *boxes).n_vertices <= few + more
    assert scene(100, *boxes).n_vertices > few + 3000


def test_what_is_fine_enough_is_not_looked_at_one_by_one(monkeypatch):
    """
    Rationale: a thousand shapes loaded three times as long as they do since pieces of all meshes are found together.
    Expected: of 100 balls, which are fine enough, only the plain below them is split, and pieces of one size together,
        in some tries: vertices may not suffice for all of these.
    """
    calls = []
    monkeypatch.setattr(
        sizing_field, "subdivide", lambda mesh, *more: calls.append(mesh.name) or subdivide(mesh, *more)
    )
    places = np.random.default_rng(0).uniform(-9, 9, (100, 2)).tolist()
    balls = [
        {"type": "sphere", "center": [x, 0.3, z], "radius": (0.3, 0.6)[k % 2]}
        for k, (x, z) in enumerate(places)
    ]
    scene(10, *balls)
    assert 1 < len(calls) < 12


def test_instances_are_as_fine_as_other_things():
    """Expected: a box of a group and one of its own are split alike; round copies stay as they are."""
    plain = {"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90).scale(100), "bsdf": GREY}
    group = {
        "type": "shapegroup",
        "cube": {**box(0, 1), "bsdf": GREY},
        "ball": {"type": "sphere", "bsdf": GREY},
    }
    copy = {
        "type": "instance",
        "group": {"type": "ref", "id": "group"},
        "to_world": T().translate([-10, 0, 0]),
    }
    shapes = {"plain": plain, "own": {**box(10, 1), "bsdf": GREY}, "group": group, "copy": copy}
    found = Scene.from_mitsuba(mi.load_dict({"type": "scene", **shapes}, optimize=False))
    own, copy = (edges(found, k)[0] for k in (1, 2))
    assert own.max() < 0.31
    assert sorted(copy) == pytest.approx(sorted(own), rel=1e-4)
    assert len(edges(found, 3)[0]) == 3 * 32 * 30  # as of any ball
