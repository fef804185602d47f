"""What a wall hides from a point on a triangle that it passes through lights no such point."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import BALL, GROUND, PALE, T, build, problem_at

import mi_sparse_prt as prt
from mi_sparse_prt.measurement.hidden_corners import hidden_corners
from mi_sparse_prt.measurement.vertices import vertex_points
from mi_sparse_prt.methods.plan import Plan
from mi_sparse_prt.relighting.image import render
from mi_sparse_prt.solvers import form_factors
from mi_sparse_prt.solvers.paths import PathSolver
from mi_sparse_prt.validation.mitsuba_reference import path_image

pytestmark = pytest.mark.usefixtures("no_held_out")
LIGHTING = prt.CubemapLighting(4)
X = 0.07  # of the wall: between two rows of the ground's vertices
WALL = {
    "type": "rectangle",
    "to_world": T().translate([X, 0.4, 0]).rotate([0, 1, 0], 90).scale([2, 0.5, 1]),
    "bsdf": {"type": "twosided", "bsdf": PALE},
}


def on_ground(scene: prt.Scene) -> tuple[mi.UInt32, mi.SurfaceInteraction3f, list[mi.Float], np.ndarray]:
    """Random points of the ground: triangles, hits and barycentric weights; and the x of corners [point, corner]."""
    rng, n = np.random.default_rng(0), 20_000
    top = (np.array([0, 0.001, 0]) - scene.centre) * scene.scale
    x, z = (0.98 * scene.scale * rng.uniform(-1, 1, (2, n))).astype(np.float32)
    ray = mi.Ray3f(mi.Point3f(x, np.full(n, top[1], np.float32), z), mi.Vector3f(0, -1, 0))
    hit = scene.normalised.ray_intersect_preliminary(ray)
    si = hit.compute_surface_interaction(ray)
    u, v = hit.prim_uv
    corners = scene.positions[scene.meshes[0].triangles[hit.prim_index.numpy()], 0]
    return hit.prim_index, si, [1 - u - v, u, v], corners


def as_rows(weights):
    """(3, n) of three arrays on the device."""
    return np.stack([w.numpy() for w in weights])


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e3])
def test_in_world_they_are_the_same(size):
    """Rationale: pictures look for hidden corners in world space, whatever the scene's size is and wherever it stands.

    Expected: weights as in the normalised frame, but for 0.1% of the points, which are as near to the wall as rounding.
    """
    place = T().translate([3 * size, -2 * size, 5 * size]).scale(size)
    low = {**WALL, "to_world": T().translate([X, 0, 0]).rotate([0, 1, 0], 90).scale([2, 0.03, 1])}
    shapes = {"ground": GROUND, "wall": low}  # a ray that is lifted too far passes over it
    moved = {name: {**shape, "to_world": place @ shape["to_world"]} for name, shape in shapes.items()}
    scene, plain = build(0.2 * size, **moved), build(0.2, **shapes)
    triangle, si, weights, _ = on_ground(plain)
    world = hidden_corners(scene).in_world(scene)
    assert world.some and scene.n_vertices == plain.n_vertices
    dr.eval(triangle, si, weights)  # a kernel on a GPU traces rays in one scene only
    known = as_rows(hidden_corners(plain).corners(triangle, si.p, -si.n, weights, mi.Mask(True))[1])
    found = as_rows(world.corners(triangle, scene.to_world(si.p), -si.n, weights, mi.Mask(True))[1])
    given = as_rows(weights)
    assert (np.abs(known - given).max(axis=0) > 1e-3).mean() > 0.02
    assert (np.abs(found - known).max(axis=0) > 1e-3).mean() < 1e-3


def test_corners_on_the_same_side():
    """
    Expected: of points on triangles that the wall passes through, weights of corners behind it are 0 and of the others
        in proportion, and no number chooses a hidden one; of all other points, everything is as it was.
    """
    scene = build(0.2, ground=GROUND, wall=WALL)
    triangle, si, weights, corners = on_ground(scene)
    hidden, every = hidden_corners(scene), mi.Mask(True)
    assert hidden.some
    side = si.p.numpy()[0] / scene.scale + scene.centre[0] > X
    same = (corners > X) == side[:, None]  # [point, corner]
    given, found = (np.stack([w.numpy() for w in some], -1) for some in (
        weights, hidden.corners(triangle, si.p, -si.n, weights, every)[1]
    ))  # fmt: skip
    cut = ~same.all(axis=1)
    assert 0.02 < cut.mean() < 0.3
    np.testing.assert_allclose(found[~cut], given[~cut], atol=1e-5)
    expected = given * same
    np.testing.assert_allclose(found[cut], (expected / expected.sum(axis=1, keepdims=True))[cut], atol=1e-3)
    for u in (0.0, 0.3, 0.6, 0.999):
        chosen = hidden.choose(triangle, si.p, -si.n, weights, mi.Float(u), every).numpy()
        assert same[np.arange(len(same)), chosen].all()
    rng = mi.PCG32(dr.width(triangle))
    chosen = hidden.choose(triangle, si.p, -si.n, weights, rng.next_float32(), every).numpy()
    for k in range(3):
        share = found[cut, k]
        error = np.sqrt((share * (1 - share)).sum())
        assert abs((chosen[cut] == k).sum() - share.sum()) < 4 * error


def test_nothing_is_hidden_where_nothing_passes_through():
    """
    Expected: none of a floating ball and the ground below it, nor of a cube's faces and edges.
    """
    assert not hidden_corners(build(0.2, ground=GROUND, cube={"type": "cube", "bsdf": PALE} | {
        "to_world": T().translate([0, 0.5, 0]).scale(0.2)
    })).some  # fmt: skip


def test_pictures_beside_a_wall():
    """
    Rationale: light from one side alone, a wall between two rows of vertices: interpolation carries light into the
        shadow.
    Expected: in a picture, the shadow's ground beside the wall has less than 2% of the light on the other side.
    Result: none. With all corners of triangles, 10%.
    """
    scene = build(0.2, ground=GROUND, wall=WALL)
    found = prt.precompute(scene, LIGHTING, Plan("exact", "none"), max_depth=2, progress=False)
    d = LIGHTING.directions
    light = np.repeat(((d[:, 0] > 0.5) & (d[:, 1] > 0) & (d[:, 1] < 0.4))[:, None], 3, axis=1).astype(
        np.float32
    )
    camera = mi.load_dict({
        "type": "orthographic",
        "to_world": T().look_at([X, 3, 0], [X, 0, 0], [0, 0, 1]).scale(0.15),
        "film": {"type": "hdrfilm", "width": 32, "height": 32, "rfilter": {"type": "box"}},
    })  # fmt: skip
    image = render(scene, found, light, camera, spp=16)[..., 0]
    left, right = image[:, 2:14].mean(), image[:, 18:30].mean()
    assert min(left, right) < 0.02 * max(left, right)


@pytest.mark.parametrize("name", ["wall", "ball"])
@pytest.mark.parametrize(
    ("direct", "basis"), [("exact", "direction"), ("exact", "texel"), ("edges", "texel")]
)
def test_no_light_leaks(name, direct, basis):
    """
    Rationale: light from below the ground, or from behind a wall that touches it, meets the backs of both.
    Expected: what finite elements make of texels entirely behind the surface is within 3% of the light from the others,
        at every vertex near it; paths, without noise there, find none at all (a ball's underside is lit from below
        beyond the ground's rim, so the ground is asked alone, near its middle).
    """
    wall = {"type": "rectangle", "bsdf": PALE, "to_world": T().translate([-1, 1, 0]).rotate([0, 1, 0], 90)}
    scene = build(0.1, ground=GROUND, **{name: wall if name == "wall" else BALL})
    transport = prt.precompute(scene, LIGHTING, Plan(direct, "gather"), basis, max_depth=3, progress=False)
    behind = LIGHTING.directions @ (np.array([1, 0, 0]) if name == "wall" else np.array([0, 1, 0])) < -0.3
    ground = np.arange(scene.n_vertices)[scene.meshes[0].vertices]
    p = scene.positions[ground]
    asked = (
        ground[np.abs(p + 0.9).min(axis=1) < 0.06]
        if name == "wall"
        else ground[np.linalg.norm(p, axis=1) < 0.3]
    )
    light = transport.operators["indirect"].rows(asked)[..., 0]
    assert len(asked) > 5 and (light[:, ~behind].sum(axis=1) > 0).all()
    assert light[:, behind].sum(axis=1).max() < 0.03 * light[:, ~behind].sum(axis=1).max()


@pytest.mark.slow  # test_no_light_leaks
def test_errors_at_a_contact_shrink(monkeypatch):
    """
    Expected: around the foot of a ball, indirect rows are nearer to paths' than with all corners, by a quarter (what
        narrow gaps are asked for is left out: there that alone has most of the effect).
    """
    monkeypatch.setattr(form_factors, "NARROW", 0)
    scene, errors = build(0.1, ground=GROUND, ball=BALL), []
    near = np.linalg.norm(scene.positions, axis=1)
    ids = np.flatnonzero((near < 0.35) & (near > 1e-3))
    every = np.repeat(ids, LIGHTING.n_directions), np.tile(np.arange(LIGHTING.n_directions), len(ids))
    paths = PathSolver(problem_at(scene, LIGHTING, vertex_points(scene), max_depth=3), 1024)
    true = paths.elements(*every, 0).mean[..., 0] * LIGHTING.solid_angles[every[1]]
    for some in (True, False):
        monkeypatch.setattr(hidden_corners(scene), "some", some)
        found = prt.precompute(
            scene, LIGHTING, Plan("exact", "gather", 1024, 0.001), max_depth=3, progress=False
        )
        ours = found.indirect.elements(*every)[..., 0]
        errors.append(np.linalg.norm(ours - true) / np.linalg.norm(true))
    print("{:.2%}, {:.2%} with all corners".format(*errors))
    assert errors[0] < errors[1] / 1.33


@pytest.mark.parametrize("depth", [0.0, pytest.param(0.005, marks=pytest.mark.slow)], ids=["sheet", "board"])
def test_what_stands_just_before_a_wall(depth):
    """Rationale: vertices of a wall in the gap behind a board are dark, and the wall beside the board is not.

    A board of 0.66 x 0.66, a millimetre before a wall with edges of 0.1, under an even sky, direct light.

    Expected: the mean of the wall within 0.1 of the board is that of `path` within 2%, and 4% at single pixels.
    Result: 0.1% more and 1.0% (sheet), 0.4 and 1.5% (board); without, 9% less and 18%.
    """
    front = T().translate([0, 0, 0.001 + depth]).scale(0.33)
    sides = T().translate([0, 0, 0.001 + depth / 2]).scale([0.33, 0.33, depth / 2])
    board = {"type": "cube", "to_world": sides} if depth else {"type": "rectangle", "to_world": front}
    wall = {"type": "rectangle", "bsdf": PALE}
    camera = {
        "type": "orthographic",
        "to_world": T().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0]).scale(0.5),
        "film": {"type": "hdrfilm", "width": 100, "height": 100, "rfilter": {"type": "box"}},
    }
    scene = build(0.1, wall=wall, board={**board, "bsdf": {"type": "twosided", "bsdf": PALE}}, camera=camera)
    transport = prt.precompute(scene, LIGHTING, Plan("exact"), "texel", max_depth=2, progress=False)
    sky = np.ones((LIGHTING.n_directions, 3), np.float32)
    ours = render(scene, transport, sky, spp=64)
    with LIGHTING.scene_lit_by(sky, scene) as lit:
        theirs = path_image(lit, scene.sensor(0), 2, 1024, 0)
    far = np.abs((np.arange(100) + 0.5) / 100 - 0.5)
    away = np.maximum(far[:, None], far)  # from the middle, in units of the picture's width
    beside = (away > 0.34) & (away < 0.43)
    error = ours[beside] / theirs[beside].mean() - 1
    print(f"{error.mean():+.1%}, {np.sqrt(np.mean((ours[beside] / theirs[beside] - 1) ** 2)):.1%}")
    assert abs(error.mean()) < 0.02
    assert np.sqrt(np.mean((ours[beside] / theirs[beside] - 1) ** 2)) < 0.04


def test_what_is_nailed_to_a_post():
    """Rationale: where boards touch a post, its vertices are inside of these and dark, and some triangles between two
        boards have no other corners.

    A post with boards of 0.1 that touch its front, 0.05 apart; edges of 0.15 (all vertices but those at the ends are
    below boards), an even sky, direct light.

    Expected: the mean of the post's front between boards is that of `path` within 15% (light changes near boards
        within less than an edge), and no more than a tenth of its pixels have less than 70% of what is there.
    Result: 6.4% more, 98% at the darkest tenth; without, 57% less and 0.
    """
    post = {"type": "cube", "to_world": T().translate([0, 0, -0.1]).scale([0.1, 0.6, 0.1]), "bsdf": PALE}
    boards = {
        f"board{k}": {
            "type": "cube",
            "to_world": T().translate([0, 0.15 * k, 0.02]).scale([0.4, 0.05, 0.02]),
            "bsdf": PALE,
        }
        for k in range(-3, 4)
    }
    camera = {
        "type": "orthographic",
        "to_world": T().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0]).scale(0.3),
        "film": {"type": "hdrfilm", "width": 96, "height": 96, "rfilter": {"type": "box"}},
    }
    scene = build(0.16, post=post, **boards, camera=camera)
    transport = prt.precompute(scene, LIGHTING, Plan("exact"), "texel", max_depth=2, progress=False)
    sky = np.ones((LIGHTING.n_directions, 3), np.float32)
    ours = render(scene, transport, sky, spp=64)[..., 0]
    with LIGHTING.scene_lit_by(sky, scene) as lit:
        theirs = path_image(lit, scene.sensor(0), 2, 1024, 0)[..., 0]
    at = 0.3 * (2 * (np.arange(96) + 0.5) / 96 - 1)
    bare = np.abs(at - 0.15 * np.round(at / 0.15)) > 0.055
    beside = bare[:, None] & (np.abs(at) < 0.095)
    ratio = ours[beside] / theirs[beside]
    print(f"{ratio.mean() - 1:+.1%}, {np.quantile(ratio, 0.1):.0%}")
    assert abs(ratio.mean() - 1) < 0.15 and np.quantile(ratio, 0.1) > 0.7
