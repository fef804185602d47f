"""Two-sided surfaces: which backs have vertices, what these are made of, and where they look."""

from contextlib import nullcontext

import mitsuba as mi
import numpy as np
import pytest
from conftest import COLOURS, T, build, diffuse, problem_at, still_life

import mi_sparse_prt as prt
from mi_sparse_prt.core.metrics import relative_l2
from mi_sparse_prt.measurement.vertices import sensor_points, vertex_rays
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.paths import PathSolver
from mi_sparse_prt.solvers.radiosity import RadiositySolver

pytestmark = pytest.mark.usefixtures("never_held_out")

RED, BLUE = diffuse(0.8, 0.2, 0.1), diffuse(0.1, 0.2, 0.9)
GROUND = {
    "type": "rectangle",
    "to_world": T().rotate([1, 0, 0], -90).scale(3),
    "bsdf": diffuse(0.5, 0.5, 0.5),
}


def twosided(*bsdfs: dict) -> dict:
    return {"type": "twosided", **{f"side_{k}": bsdf for k, bsdf in enumerate(bsdfs)}}


def leaf(bsdf: dict, **others: object) -> dict:
    place = T().translate([0, 0.8, 0]).rotate([1, 0, 0], 20).scale(0.7)
    return {"type": "rectangle", "to_world": place, "bsdf": bsdf, **others}


def walls(count: int, bsdf: dict, size: float = 0.5) -> dict:
    """The first sides of a box of separate rectangles, each facing outwards."""
    turns = [
        ([1, 0, 0], 0),
        ([1, 0, 0], 90),
        ([1, 0, 0], 180),
        ([1, 0, 0], 270),
        ([0, 1, 0], 90),
        ([0, 1, 0], 270),
    ]
    move = T().translate([0, 1, 0]).scale(size)
    return {
        f"wall_{k}": {
            "type": "rectangle",
            "to_world": move @ T().rotate(*turn) @ T().translate([0, 0, 1]),
            "bsdf": bsdf,
        }
        for k, turn in enumerate(turns[:count])
    }


def test_a_leaf_has_two_sheets():
    """Expected: both at the same places, with opposite normals and triangles, and each with its own BSDF's colour."""
    scene = build(ground=GROUND, leaf=leaf(twosided(RED, BLUE)), other=leaf(RED))
    assert [mesh.name for mesh in scene.meshes] == ["ground", "leaf", "other", "leaf_back"]
    assert scene.fronts == scene.meshes[:3]
    assert [mesh.shape for mesh in scene.meshes] == [0, 1, 2, 1]
    front, back = scene.meshes[1], scene.meshes[3]
    ids = np.arange(scene.n_vertices)
    assert scene.front_of.tolist() == [*ids[: back.vertices.start], *ids[front.vertices]]
    assert (scene.backs[front.vertices] == ids[back.vertices]).all()
    assert (np.delete(scene.backs, ids[front.vertices]) == -1).all()
    assert (scene.positions == scene.positions[scene.front_of]).all()
    assert (scene.normals[back.vertices] == -scene.normals[front.vertices]).all()
    assert scene.albedo[front.vertices] == pytest.approx(
        np.tile([0.8, 0.2, 0.1], (len(ids[front.vertices]), 1))
    )
    assert scene.albedo[back.vertices] == pytest.approx(
        np.tile([0.1, 0.2, 0.9], (len(ids[front.vertices]), 1))
    )
    for mesh in scene.meshes:
        a, b, c = (scene.positions[mesh.vertices][mesh.triangles[:, k]] for k in range(3))
        assert (
            np.einsum("td,td->t", np.cross(b - a, c - a), scene.normals[mesh.vertices][mesh.triangles[:, 0]])
            > 0
        ).all()


def test_names_are_unique():
    scene = build(leaf=leaf(twosided(RED)), leaf_back=leaf(RED))
    assert [mesh.name for mesh in scene.meshes] == ["leaf", "leaf_back", "leaf_back_"]


@pytest.mark.parametrize(
    "shapes, names",
    [
        ({"ball": {"type": "sphere", "bsdf": twosided(RED)}}, ["ball"]),
        ({"cube": {"type": "cube", "bsdf": twosided(RED)}}, ["cube"]),
        ({"cube": {"type": "cube", "flip_normals": True, "bsdf": twosided(RED)}}, ["cube", "cube_back"]),
        (walls(6, twosided(RED)), [f"wall_{k}" for k in range(6)]),
        (walls(5, twosided(RED)), [*(f"wall_{k}" for k in range(5)), *(f"wall_{k}_back" for k in range(5))]),
        # what lights the inside of a box: no front in it, but an area lamp, or a wall that light passes through
        (walls(6, twosided(RED)) | {"ball": {"type": "sphere", "radius": 0.1, "center": [0, 1, 0], "bsdf": RED}},
         [*(f"wall_{k}" for k in range(6)), "ball"]),
        (walls(6, twosided(RED)) | {"ball": {"type": "sphere", "radius": 0.1, "center": [0, 1, 0], "bsdf": RED,
                                             "emitter": {"type": "area", "radiance": 1.0}}},
         [*(f"wall_{k}" for k in range(6)), "ball", *(f"wall_{k}_back" for k in range(6))]),
        (walls(5, twosided(RED)) | {"wall_5": walls(6, {"type": "thindielectric"})["wall_5"]},
         [*(f"wall_{k}" for k in range(6)), *(f"wall_{k}_back" for k in range(5))]),
        # which reflect nothing on their backs, though their flags do not say so
        ({"leaf": leaf({"type": "principled"})}, ["leaf"]),
        ({"leaf": leaf(twosided(RED, diffuse(0, 0, 0)))}, ["leaf"]),
        ({"leaf": leaf({"type": "mask", "opacity": 0.5, "bsdf": twosided(RED)})}, ["leaf", "leaf_back"]),
    ],
)  # fmt: skip
@pytest.mark.filterwarnings("ignore::mi_sparse_prt.core.errors.PrtWarning")
def test_backs_that_light_reaches(shapes, names):
    assert [mesh.name for mesh in build(0.15, **shapes).meshes] == names


def test_only_the_pieces_that_light_reaches():
    """A closed ball and an open leaf in one mesh: the report names it, and only the leaf has a back."""
    sides = mi.load_dict(twosided(RED))
    box = {"type": "cube", "to_world": T().translate([3, 0, 0]), "bsdf": sides}
    scene = build(0.3, optimize=True, box=box, leaf=leaf(sides))
    assert len(scene.fronts) == 1
    alone = build(0.3, leaf=leaf(twosided(RED)))
    assert len(scene.meshes[1].triangles) == len(alone.meshes[1].triangles)
    assert scene.dark_backs == [scene.meshes[0].name]
    report = prt.precompute(scene, prt.CubemapLighting(2), max_depth=2, progress=False).report
    assert any(
        s.startswith("backs that no light reaches, of 1 two-sided shapes: ") for s in report["skipped"]
    )


@pytest.mark.parametrize("lamp", ["point", "spot", "projector", None])
def test_a_lamp_lights_a_closed_room(lamp):
    """Expected: the inside of a closed two-sided box has vertices if, and only if, a lamp shines in it."""
    pose = T().look_at([0, 1, 0], [0.3, 0, 0.1], [0, 0, 1])
    lamps = {
        "point": {"type": "point", "position": [0, 1, 0]},
        "spot": {"type": "spot", "to_world": pose},
        "projector": {
            "type": "projector",
            "to_world": pose,
            "irradiance": {"type": "rgb", "value": [1.0, 1.0, 1.0]},
        },
        None: {"type": "point", "position": [0, 5, 0]},
    }
    scene = build(0.5, **walls(6, twosided(RED)), lamp=lamps[lamp])
    inside = [mesh.name for mesh in scene.meshes if mesh.name.endswith("_back")]
    assert inside == ([f"wall_{k}_back" for k in range(6)] if lamp else [])
    assert len(scene.dark_backs) == (0 if lamp else 6)
    assert scene.hash != build(0.5, **walls(6, twosided(RED)), lamp=lamps[None]).hash or lamp is None


@pytest.mark.parametrize("seed", range(3))
def test_insides_of_solids_that_stand_in_each_other_are_dark(seed):
    """Boxes and balls, turned at random, through each other and a floor, whose fronts they see from inside."""
    rng, solids = np.random.default_rng(seed), {}
    for k in range(12):
        axis = rng.normal(size=3)
        pose = T().translate((1.5 * rng.normal(size=3)).tolist())
        pose = pose.rotate((axis / np.linalg.norm(axis)).tolist(), float(rng.uniform(0, 360)))
        solid = {"type": ("cube", "sphere")[k % 2], "to_world": pose.scale(float(rng.uniform(0.2, 1)))}
        solids[f"solid_{k}"] = solid | {"bsdf": twosided(RED)}
    scene = build(floor={**GROUND, "bsdf": twosided(RED)}, **solids)
    assert sorted(scene.dark_backs) == sorted(solids)
    assert [mesh.name for mesh in scene.meshes[len(scene.fronts) :]] == ["floor_back"]


@pytest.mark.parametrize("lamp", [True, False])
def test_walls_that_a_lamp_lights_around_corners(lamp):
    """A plate before one wall of a closed box, which a lamp in the middle does not see past: others light that wall."""
    hidden = {"type": "rectangle", "to_world": T().translate([0, 1, 0.4]).scale(0.45), "bsdf": twosided(RED)}
    shapes = {**walls(6, twosided(RED)), "plate": hidden}
    point = {"lamp": {"type": "point", "position": [0, 1, 0]}} if lamp else {}
    scene = build(0.25, **shapes, **point)
    backs = [mesh.name for mesh in scene.meshes[len(scene.fronts) :]]
    assert backs == ([f"{name}_back" for name in shapes] if lamp else [])


@pytest.mark.parametrize("camera", [True, False])
def test_a_dark_room_that_a_camera_is_in(camera):
    """Its walls have rows for a camera's sake: a room may be so dark on purpose."""
    pose = T().look_at([0, 1, 0], [0.1, 1, 0.3], [0, 1, 0])
    sensor = {"sensor": {"type": "perspective", "to_world": pose}} if camera else {}
    scene = build(0.25, **walls(6, twosided(RED)), **sensor)
    assert len(scene.meshes) - len(scene.fronts) == (6 if camera else 0)


@pytest.mark.usefixtures("no_held_out")
def test_a_room_with_a_lamp_is_not_black():
    """Expected: ``sparse_prt`` shows a closed two-sided room lit by a point as ``path`` does (mean within 2%)."""
    camera = {
        "type": "perspective",
        "fov": 80,
        "to_world": T().look_at([0.3, 1.2, 0.3], [-0.3, 0.9, -0.5], [0, 1, 0]),
        "film": {"type": "hdrfilm", "width": 32, "height": 24, "rfilter": {"type": "box"}},
    }
    shapes = {**walls(6, twosided(RED)), "lamp": {"type": "point", "position": [0, 1.2, 0.1]}}
    scene = mi.load_dict({"type": "scene", **shapes, "camera": camera})
    ours, known = (
        np.array(mi.render(scene, integrator=mi.load_dict({"type": kind, "max_depth": 5, **more}), spp=256))
        for kind, more in (("sparse_prt", {"progress": False, "edge_length": 0.08}), ("path", {}))
    )
    assert known.mean() > 0.1
    assert ours.mean() == pytest.approx(known.mean(), rel=0.02)


def test_a_leaf_alone_is_lit_analytically():
    """Expected: nothing is in the way, so each sheet has the directions on its side, by their cosines."""
    scene, lighting = build(leaf=leaf(twosided(RED, BLUE))), prt.CubemapLighting(8)
    transport = prt.precompute(scene, lighting, max_depth=2, progress=False)
    cosine = np.maximum(scene.normals @ lighting.directions.T, 0) * lighting.solid_angles / np.pi
    known = scene.albedo[:, None] * cosine[..., None]
    assert (known[: len(known) // 2].sum(axis=2) * known[len(known) // 2 :].sum(axis=2) == 0).all()
    assert relative_l2(transport.rows(np.arange(scene.n_vertices)), known) < 1e-5


def test_vertices_are_seen_from_their_side():
    """Expected: rays end on the sheet, none is missed, and the sensor's points have the sheet's normals."""
    scene = build(ground=GROUND, leaf=leaf(twosided(RED, BLUE)))
    rays = vertex_rays(scene.normalised, scene)
    assert not rays.missed.any()
    assert (np.einsum("nd,nd->n", rays.directions, scene.normals) < -0.9).all()
    points = sensor_points(scene, rays)
    assert np.abs(points.normals - scene.normals).max() < 1e-4
    assert np.abs(points.offset_normals - scene.normals).max() < 1e-4


def test_light_is_gathered_from_the_sheet_that_rays_meet():
    """Rationale: a red and blue leaf between a ground and a roof: red light goes one way, blue the other.

    Expected: gathered light equals that of paths, row by row, within its standard errors; mixing up sheets would
    exchange the colours.
    """
    roof = {**GROUND, "to_world": T().translate([0, 1.6, 0]).rotate([1, 0, 0], 90).scale(0.6)}
    scene = build(0.15, leaf=leaf(twosided(RED, BLUE)), ground={**GROUND, "bsdf": twosided(RED)}, roof=roof)
    lighting = prt.CubemapLighting(1)
    problem = problem_at(scene, lighting, basis="texel", max_depth=4)
    gather = RadiositySolver(problem, 1024)
    direct = DirectSolver(problem, 4)
    ids = np.arange(scene.n_vertices)
    texels = np.tile(np.arange(6), len(ids))
    first = direct.elements(np.repeat(ids, 6), texels).reshape(-1, 6)
    gathered = gather.apply(first)
    paths = PathSolver(problem, 1024).rows(ids)
    known = paths.mean * lighting.solid_angles[:, None]
    for mesh in scene.meshes:
        ours, theirs = (x[mesh.vertices].mean(axis=0) for x in (gathered, known))
        noise = np.sqrt((paths.variance[mesh.vertices] * lighting.solid_angles[:, None] ** 2).sum(axis=0))
        noise /= mesh.vertices.stop - mesh.vertices.start
        print(mesh.name, np.round(ours, 4).tolist(), np.abs(ours - theirs).max(), noise.max())
        assert (np.abs(ours - theirs) <= 4 * noise + 0.02 * theirs.max()).all()
    top, below = (gathered[scene.meshes[k].vertices].mean(axis=(0, 1)) for k in (2, 1))
    assert top[0] > 1.5 * top[2]
    assert below.shape == (3,)


@pytest.mark.usefixtures("no_held_out")
def test_the_camera_sees_backs():
    """Expected: turning a rectangle round, with its two colours, changes nothing; nor does it for a rough conductor."""
    lighting = prt.CubemapLighting(4)
    light = np.random.default_rng(1).random((lighting.n_directions, 3)).astype(np.float32)
    film = {"type": "hdrfilm", "width": 24, "height": 18, "rfilter": {"type": "box"}}
    place = T().look_at([1, 0.2, -3], [0, 0.8, 0], [0, 1, 0])
    camera = {"type": "perspective", "fov": 40, "to_world": place, "film": film}
    for terms, one, two in ((0, RED, BLUE), (4, {"type": "roughconductor", "alpha": 0.4}, BLUE)):
        images = []
        for flip, sides in ((False, (one, two)), (True, (two, one))):
            shape = leaf(twosided(*sides), flip_normals=flip)
            with pytest.warns(prt.PrtWarning) if terms else nullcontext():
                scene = build(0.3, ground=GROUND, leaf=shape, camera=camera)
            transport = prt.precompute(
                scene, lighting, "brute_force", spp=4, max_depth=2, progress=False, terms=terms
            )
            images.append(prt.render(scene, transport, light, spp=16))
        assert images[0].max() > 0.1
        assert np.abs(images[0] - images[1]).max() < 2e-3 * images[0].max()


def test_one_sided_scenes_are_what_they_were():
    """No sheet, no other vertices, the same hash."""
    scene = build(**still_life(COLOURS))
    assert scene.fronts == scene.meshes
    assert (scene.front_of == np.arange(scene.n_vertices)).all()
    assert (scene.backs == -1).all()
    assert not scene.dark_backs
