"""Where surfaces touch, light from behind one does not leak to the other."""

import mitsuba as mi
import numpy as np
import pytest
import scipy.sparse
from conftest import build, diffuse, problem_at

import mi_sparse_prt as prt
from mi_sparse_prt.measurement.vertices import vertex_points
from mi_sparse_prt.methods.plan import Plan
from mi_sparse_prt.operators.interpolated import Interpolated
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.form_factors import gather_matrix
from mi_sparse_prt.solvers.paths import PathSolver
from mi_sparse_prt.solvers.touching_surfaces import contacts

LIGHTING = prt.CubemapLighting(4)
WHITE = diffuse(0.8, 0.8, 0.8)


def rectangle(*steps: tuple[str, list[float], float]) -> dict:
    """A square of edge 2, turned and moved."""
    place = mi.ScalarTransform4f()
    for kind, axis, value in steps:
        if kind == "turn":
            place = mi.ScalarTransform4f().rotate(axis, value) @ place
        else:
            place = mi.ScalarTransform4f().translate([value * x for x in axis]) @ place
    return {"type": "rectangle", "to_world": place, "bsdf": WHITE}


GROUND = rectangle(("turn", [1, 0, 0], -90))
WALL = rectangle(("turn", [0, 1, 0], 90), ("move", [-1, 0, 0], 1), ("move", [0, 1, 0], 1))
BALL = {"type": "sphere", "center": [0.0, 0.4, 0.0], "radius": 0.4, "bsdf": WHITE}


@pytest.fixture(scope="module", params=["wall", "ball"])
def scene(request) -> prt.Scene:
    return build(0.1, ground=GROUND, **{request.param: WALL if request.param == "wall" else BALL})


def test_only_what_touches(scene):
    """
    Expected: at the foot of the wall, the vertices of both, open to what is above the other; of the ball the lowest
        vertex alone, for which no texel counts, as the ground's horizon is its own. Nowhere else, and nowhere on a
        surface that is curved or cornered but touches nothing.
    """
    found = contacts(scene, LIGHTING)
    p, d = scene.positions[found.vertices], LIGHTING.directions
    assert len(found.vertices)
    every = np.arange(len(d))
    for k, vertex in enumerate(found.vertices):
        counts = found.counts(np.full(len(d), vertex), every)
        if scene.meshes[1].name == "wall":
            assert np.abs(p[k, :2] - (-1, 0)).max() < 1e-5
            normal = scene.normals[vertex]
            other = (1, 0, 0) if normal[1] > 0.5 else (0, 1, 0)
            assert np.array_equal(counts, d @ np.array(other) > 0)
        else:
            assert np.linalg.norm(p[k]) < 0.15
            assert not (counts & (d @ scene.normals[vertex] > 1e-2)).any() or p[k, 1] > 1e-3
    others = np.setdiff1d(np.arange(scene.n_vertices), found.vertices)
    assert found.counts(others, np.zeros(len(others), np.int64)).all()
    assert not len(contacts(build(0.1, ball=BALL), LIGHTING).vertices)
    cube = {"type": "cube", "bsdf": WHITE}
    assert not len(contacts(build(0.2, cube=cube), LIGHTING).vertices)


@pytest.mark.parametrize("form", ["bits", "fixed point", "shares", "any other"])
def test_what_counts_is_as_it_was_and_the_rest_is_dark(scene, form):
    """
    Expected: rows of touching vertices are zero where their texels do not count, all others as before, exactly;
        columns and relighting are those of these rows.
    """
    if form in ("bits", "any other"):
        part = prt.precompute(scene, LIGHTING, Plan("exact"), max_depth=2, progress=False).direct
    else:
        plan = Plan("exact" if form == "fixed point" else "edges")
        part = prt.precompute(scene, LIGHTING, plan, "texel", max_depth=2, progress=False).direct
    if form == "any other":
        every = scipy.sparse.eye_array(scene.n_vertices, dtype=np.float32, format="csr")
        part = Interpolated(part, every)
    found, n = contacts(scene, LIGHTING), LIGHTING.n_directions
    ids, texels = np.arange(scene.n_vertices), np.arange(n)
    counts = found.counts(np.repeat(ids, n), np.tile(texels, len(ids))).reshape(-1, n)
    before, lit = part.rows(ids)[..., 0], found.lit(part)
    assert before[~counts].any() and np.array_equal(
        part.rows(ids)[..., 0], before
    )  # the part itself is left alone
    after = lit.rows(ids)[..., 0]
    assert np.array_equal(after, before * counts)
    assert np.allclose(lit.columns(texels)[..., 0], after, rtol=1e-6)
    light = np.random.default_rng(0).random((n, 3), dtype=np.float32)
    assert np.allclose(lit.relight(light), after @ light, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(
    ("direct", "basis"), [("exact", "direction"), ("exact", "texel"), ("edges", "texel")]
)
def test_no_light_leaks(scene, direct, basis):
    """
    Rationale: light from below the ground, or from behind the wall, meets the backs of both.
    Expected: what finite elements make of texels entirely behind the surface is within 3% of the light from the others,
        at every vertex that is not itself at the contact; paths, without noise there, find none at all (a ball's
        underside is lit from below beyond the ground's rim, so the ground is asked alone, near its middle).
    """
    wall = scene.meshes[1].name == "wall"
    transport = prt.precompute(scene, LIGHTING, Plan(direct, "gather"), basis, max_depth=3, progress=False)
    behind = LIGHTING.directions @ (np.array([1, 0, 0]) if wall else np.array([0, 1, 0])) < -0.3
    ground = np.arange(scene.n_vertices)[scene.meshes[0].vertices]
    p = scene.positions[ground]
    asked = ground[np.abs(p + 0.9).min(axis=1) < 0.06] if wall else ground[np.linalg.norm(p, axis=1) < 0.3]
    asked = np.setdiff1d(asked, contacts(scene, LIGHTING).vertices)
    light = transport.rows(asked)[..., 0] - elements_of(transport.direct, asked)
    assert len(asked) > 5 and (light[:, ~behind].sum(axis=1) > 0).all()
    assert light[:, behind].sum(axis=1).max() < 0.03 * light[:, ~behind].sum(axis=1).max()


def elements_of(part, ids: np.ndarray) -> np.ndarray:
    n = LIGHTING.n_directions
    return 0.8 * part.elements(np.repeat(ids, n), np.tile(np.arange(n), len(ids))).reshape(len(ids), n)


def test_errors_at_a_contact_shrink():
    """
    Expected: around the foot of a ball, indirect rows are nearer to paths' than those of a direct part that leaks, by a
        quarter at least.
    """
    scene, lighting = build(0.1, ground=GROUND, ball=BALL), LIGHTING
    points, near = vertex_points(scene), np.linalg.norm(scene.positions, axis=1)
    ids = np.setdiff1d(np.nonzero(near < 0.35)[0], contacts(scene, lighting).vertices)
    paths = PathSolver(problem_at(scene, lighting, points, max_depth=3), 1024)
    every = np.repeat(ids, lighting.n_directions), np.tile(np.arange(lighting.n_directions), len(ids))
    shape = len(ids), lighting.n_directions
    true = paths.elements(*every, 0).mean.reshape(shape) * lighting.solid_angles
    direct = DirectSolver(problem_at(scene, lighting, points))
    found = prt.precompute(scene, lighting, Plan("exact", "gather", 1024, 0.001), max_depth=3, progress=False)
    ours = found.indirect.elements(*every).reshape(shape)
    light = direct.elements(
        np.repeat(np.arange(scene.n_vertices), shape[1]), np.tile(np.arange(shape[1]), scene.n_vertices)
    ).reshape(-1, shape[1])
    leaking = gather_matrix(scene, points, 1024, 0, ids) @ (scene.albedo[:, :1] * light)
    ours_error, leaking_error = (np.linalg.norm(x - true) / np.linalg.norm(true) for x in (ours, leaking))
    print(f"{ours_error:.2%}, {leaking_error:.2%} with leaks")
    assert ours_error < leaking_error / 1.33
