"""A floor may be one mesh on both sides of a wall; neighbours behind it have light that is not there."""

import importlib
from functools import cache, partial

import numpy as np
import pytest
from conftest import T, build, diffuse
from numpy.typing import NDArray

import mi_sparse_prt as prt
from mi_sparse_prt.measurement.neighbours import Neighbours
from mi_sparse_prt.measurement.vertices import vertex_points
from mi_sparse_prt.methods.plan import Plan
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.solvers.walls import Walls

pytestmark = pytest.mark.usefixtures("no_held_out")
LIGHTING = prt.CubemapLighting(8)
WIDTH, HEIGHT, THICK = 0.05, 0.3, 0.005  # of a closed corridor on the floor; halves, but for the height
LENGTH, CLOSET = 0.5, 0.05


@cache
def corridor(length: float = LENGTH) -> Scene:
    """A floor from -1 to 1, and four walls and a roof that close a corridor on it."""
    grey = diffuse(0.7, 0.7, 0.7)

    def slab(centre: tuple, half: tuple) -> dict:
        return {"type": "cube", "to_world": T().translate(centre).scale(half), "bsdf": grey}

    sides = {
        f"side{x}": slab((x * WIDTH, 0, HEIGHT / 2), (THICK, length + THICK, HEIGHT / 2)) for x in (-1, 1)
    }
    ends = {f"end{y}": slab((0, y * length, HEIGHT / 2), (WIDTH + THICK, THICK, HEIGHT / 2)) for y in (-1, 1)}
    roof = slab((0, 0, HEIGHT), (WIDTH + THICK, length + THICK, THICK))
    return build(0.06, floor={"type": "rectangle", "bsdf": grey}, **sides, **ends, roof=roof)


def of_floor(inside: bool, length: float = LENGTH) -> NDArray[np.int64]:
    """Vertices of the floor in the corridor, or at some distance from it."""
    scene = corridor(length)
    x, y, _ = np.abs(scene.positions[scene.meshes[0].vertices]).T
    within = (x < WIDTH - 2 * THICK) & (y < length - 2 * THICK)
    return np.flatnonzero(within if inside else (x > 3 * WIDTH) | (y > length + 2 * WIDTH))


def light(transport: prt.LightTransport, part: str, ids: NDArray[np.int64]) -> NDArray[np.float64]:
    """Of some vertices under an even sky."""
    return transport.operators[part].rows(ids).sum(axis=(1, 2), dtype=np.float64)


@pytest.mark.parametrize("plan", [Plan("consensus", "none"), Plan("sparse", "sparse", spp=16)])
def test_neighbours_behind_a_wall_do_not_vote(plan):
    """Rationale: in a closet of a few vertices all known ones are outside, see the sky, and agree.
    Expected: no direct light on the floor of a closed closet, as its rays say.
    Result: none. Without a look at walls, consensus finds 10% of an open floor's."""
    found = prt.precompute(corridor(CLOSET), LIGHTING, method=plan, progress=False)
    inside, outside = (of_floor(where, CLOSET) for where in (True, False))
    assert 1 <= len(inside) <= 12
    assert light(found, "direct", inside).max() == 0
    assert light(found, "direct", outside).mean() > 0.8


def test_light_is_not_interpolated_through_a_wall():
    """Rationale: indirect light of sparse vertices is that of dense ones around them.
    Expected: none in a closed corridor, next to walls that are lit from outside.
    Result: none. Without a look at walls, 3.4 times that of the floor outside."""
    found = prt.precompute(corridor(), LIGHTING, method="sparse", spp=16, progress=False)
    outside = light(found, "indirect", of_floor(inside=False)).mean()
    assert outside > 0
    assert light(found, "indirect", of_floor(inside=True)).max() <= 1e-5 * outside


def test_nodes_light_their_own_side(monkeypatch):
    """Rationale: where scenes have more vertices than nodes, these may be on the other side of a wall.
    Expected: with 2500 nodes and with one at each vertex, at most 1% of the indirect light outside in the corridor.
    Result: 0.08% with a node at each vertex, none with few. Without a look at walls, 4.4 times that outside with few
    nodes, and 45% with all, by triangles of the floor that pass below the walls."""
    execution = importlib.import_module("mi_sparse_prt.methods.execution")
    every = prt.precompute(corridor(), LIGHTING, method="gather", progress=False)
    few_nodes = partial(execution.choose_nodes, most=2500, small=64)
    monkeypatch.setattr(execution, "choose_nodes", few_nodes)
    found = prt.precompute(corridor(), LIGHTING, method="gather", progress=False)
    for transport in (every, found):
        outside = light(transport, "indirect", of_floor(inside=False)).mean()
        assert light(transport, "indirect", of_floor(inside=True)).max() <= 0.01 * outside


def test_neighbours_of_bent_surfaces_are_not_behind_walls():
    """Rationale: the straight line between two vertices of a ball is inside of it.
    Expected: nothing stands between vertices whose normals are 60 degrees apart at most, and the ball between
    those far apart.
    Result: as expected."""
    scene = build(0.1, ball={"type": "sphere", "bsdf": diffuse(0.5, 0.5, 0.5)})
    n = scene.normals
    first, second = np.random.default_rng(0).choice(len(n), (2, 4000))
    cosine, hidden = np.einsum("ij,ij->i", n[first], n[second]), Walls(scene, vertex_points(scene)).between
    assert not hidden(first, second)[cosine > 0.5].any()
    assert hidden(first, second)[(cosine < -0.5) & (cosine > -0.9)].all()


def test_what_is_left_of_neighbours_comes_first():
    """Rationale: whoever reads neighbours stops at the first that is missing.
    Expected: those behind a wall are gone, others keep their order and distances, and few are counted as few.
    Result: as expected."""
    scene, walls = corridor(), Walls(corridor(), vertex_points(corridor()))
    inside, outside = of_floor(inside=True), of_floor(inside=False)
    near = np.array([[2, 0, 3, 1, -1]], np.int32)  # out, in, out, in
    candidates = np.concatenate([inside[1:3], outside[:2]])
    given = Neighbours(near, np.array([[1, 2, 3, 4, np.inf]], np.float32))
    left = walls.without_hidden(inside[:1], given, candidates)
    np.testing.assert_array_equal(left.ids, [[0, 1, -1, -1, -1]])
    np.testing.assert_array_equal(left.distances, [[2, 4, np.inf, np.inf, np.inf]])
    numbers = np.append(candidates, -1)[near].astype(np.int32)
    for least, few in ((1, False), (2, False), (3, True)):
        assert walls.leave_fewer(least, inside[:1], numbers)[0] == few
    assert scene.meshes[0].name == "floor"
