"""`terms="auto"`: glossy surfaces by as many factors as images need, everything else as it was."""

import warnings
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import psutil
import pytest
from conftest import PIPELINE, T, assert_same, build, diffuse, problem_at

import mi_sparse_prt as prt
from mi_sparse_prt.core.metrics import relative_l2_without_noise
from mi_sparse_prt.methods.plan import Plan
from mi_sparse_prt.planner.memory import terms_fit
from mi_sparse_prt.solvers.paths import PathSolver
from mi_sparse_prt.validation.mitsuba_reference import path_image

LIGHTING = prt.CubemapLighting(8)
PLAN = Plan("edges", "gather", rays=256, tolerance=0.03)
BRUSHED = {"type": "roughconductor", "material": "Al", "alpha": 0.5}
CAMERA = {
    "type": "perspective",
    "fov": 36,
    "to_world": T().look_at(origin=[0.6, 1.9, 3.2], target=[0, 0.35, 0], up=[0, 1, 0]),
    "film": {"type": "hdrfilm", "width": 40, "height": 30, "rfilter": {"type": "box"}, "pixel_format": "rgb"},
}


def sky() -> np.ndarray:
    """A cubemap's texels (6 n^2, 3): brighter above, and brightest around one direction."""
    up = LIGHTING.directions[:, 1:2]
    sun = np.exp(6 * (LIGHTING.directions @ np.array([0.5, 0.7, 0.5], np.float32)[:, None] - 1))
    texels: np.ndarray = (0.3 + 0.5 * np.maximum(up, 0)) * [0.8, 0.9, 1.0] + 2 * sun * [1.0, 0.9, 0.7]
    return texels.astype(np.float32)


def ball(x: float, bsdf: dict, z: float = 0.0) -> dict:
    return {"type": "sphere", "center": [x, 0.45, z], "radius": 0.4, "bsdf": bsdf}


def scene_of(edge_length: float = 0.1, **shapes: dict) -> prt.Scene:
    """Shapes over a grey ground, under the sky, with a camera."""
    ground = {
        "type": "rectangle",
        "to_world": T().rotate([1, 0, 0], -90).scale(2),
        "bsdf": diffuse(0.5, 0.5, 0.5),
    }
    light = {"type": "cubemap", "data": mi.TensorXf(sky())}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", prt.PrtWarning)
        return build(edge_length, ground=ground, sky=light, camera=CAMERA, **shapes)


def image_error(
    scene: prt.Scene, *transports: prt.LightTransport, spp: int = 64
) -> list[tuple[float, float]]:
    """Of each matrix, the image's relative L2 beyond noise against ``path``, and what noise may show as one."""
    sensor, depth = scene.mitsuba.sensors()[0], transports[0].max_depth
    halves = [path_image(scene.mitsuba, sensor, depth, 2048, seed) for seed in (1, 2)]
    pairs = [[prt.render(scene, t, sky(), spp=spp, seed=seed) for seed in (3, 4)] for t in transports]
    return [relative_l2_without_noise(a, *halves, other_estimate=b) for a, b in pairs]


def computed(scene: prt.Scene, terms: int | str, max_depth: int = 4) -> prt.LightTransport:
    return prt.precompute(scene, LIGHTING, PLAN, "texel", max_depth, terms=terms, progress=False)


def test_diffuse_scenes_do_not_change(grey_scene):
    """Bit by bit, and without a word."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", prt.PrtWarning)
        matrices = [computed(grey_scene, terms) for terms in (0, "auto")]
    assert matrices[0].report["parameters"] == matrices[1].report["parameters"]
    for matrix in matrices:
        matrix.report.clear()  # times differ
    assert_same(*matrices)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::mi_sparse_prt.core.errors.PrtWarning")
@pytest.mark.usefixtures("no_held_out")
def test_rough_conductor():
    """
    Rationale: a rough metal ball as large as a third of the image is as right by its factors as by rays that go on
        from it, which a matrix without terms needs; factors have no noise, rays have.
    Expected: both within 1% of ``path``, beyond noise; two images by rays differ 10 times more than two by factors.
    """
    scene = scene_of(0.15, ball=ball(0, BRUSHED))
    transports = computed(scene, 0), computed(scene, "auto")
    (followed, _), (error, uncertainty) = image_error(scene, *transports)
    print(f"followed {followed:.2%}, auto {error:.2%} (noise may show {uncertainty:.2%})")
    assert uncertainty < 0.008
    assert max(error, followed) < 0.01
    pairs = [[prt.render(scene, t, 1.0, spp=16, seed=seed) for seed in (3, 4)] for t in transports]
    inside = slice(11, 15), slice(18, 22)  # of the ball: at its edges samples differ as well
    noises = [float(np.abs(a - b)[inside].mean()) for a, b in pairs]
    print("noise of rays and of factors", noises)
    assert noises[1] < 0.1 * noises[0]


@pytest.mark.usefixtures("no_held_out")
def test_rays_go_on_where_terms_have_no_room(monkeypatch):
    """
    Rationale: fifty copies of a plastic figure have a million vertices and ten rows each; pictures need none of these.
    Expected: with a byte less than light between terms takes in any case, a matrix without terms and one warning; its
        picture is within 1% of ``path``, beyond noise, as one with terms is. With that byte, terms.
    """
    scene = scene_of(0.15, ball=ball(0, BRUSHED))
    terms = computed(scene, "auto")
    assert terms.terms > 0
    takes = (4 * 96 + 3 * 4 * 96) * terms.reflection.row_count
    room = SimpleNamespace(available=takes)
    with monkeypatch.context() as patch:
        patch.setattr(psutil, "virtual_memory", lambda: room)
        assert terms_fit(terms.reflection, 0)
        room.available -= 1
        assert not terms_fit(terms.reflection, 0)
    monkeypatch.setattr(PIPELINE, "terms_fit", lambda *_: False)
    with pytest.warns(prt.PrtWarning, match="no memory for the terms of so many points"):
        found = computed(scene, "auto")
    assert found.terms == 0
    ((error, uncertainty),) = image_error(scene, found, spp=1024)
    print(f"{error:.2%} (noise may show {uncertainty:.2%})")
    assert uncertainty < 0.008 and error < 0.01


@pytest.mark.filterwarnings("ignore::mi_sparse_prt.core.errors.PrtWarning")
@pytest.mark.usefixtures("no_held_out")
def test_what_narrow_lobes_send_to_a_wall(usual_factors):
    """
    Rationale: pictures show a polished metal by rays that go on; what it throws on a wall is blurred there, and 16
        factors of it are enough.
    Expected: under a low sun, indirect light of a wall over such a floor is that of paths, of the real metal, within 2%
        and four standard errors; with the floor as a diffuse one of the same albedo, it is less than half of that.
    Result: 0.9% more (noise 0.6%); 78% less.
    """
    polished = {"type": "roughconductor", "material": "Al", "alpha": 0.12}
    scene = build(
        0.15,
        floor={"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90), "bsdf": polished},
        wall={"type": "rectangle", "to_world": T().translate([0, 1, -1]), "bsdf": diffuse(0.7, 0.7, 0.7)},
    )
    d = LIGHTING.directions
    sun = ((d @ np.array([0, 0.4, 0.9]) / 0.985) > 0.95).astype(np.float32)[:, None] * np.ones(3, np.float32)
    wall = np.arange(scene.n_vertices)[scene.meshes[1].vertices][::7]
    texels = np.flatnonzero(sun[:, 0])
    place = np.repeat(wall, len(texels)), np.tile(texels, len(wall))
    paths = PathSolver(problem_at(scene, LIGHTING, basis="texel", max_depth=3), 1024).elements(*place)
    power = LIGHTING.solid_angles[place[1]][:, None]
    known, error = (paths.mean * power).sum(), np.sqrt((paths.variance * power**2).sum())
    ours = {}
    for terms in ("auto", 0):
        indirect = computed(scene, terms, 3).operators["indirect"].elements(*place)
        ours[terms] = float(np.broadcast_to(indirect, paths.mean.shape).sum() / known - 1)
    print(f"auto {ours['auto']:+.2%}, as diffuse {ours[0]:+.2%}, noise {error / known:.2%}")
    assert abs(ours["auto"]) < 0.02 + 4 * error / known
    assert ours[0] < -0.5


@pytest.mark.filterwarnings("ignore::mi_sparse_prt.core.errors.PrtWarning")
@pytest.mark.usefixtures("no_held_out")
def test_beside_mirror_and_mask():
    """
    Rationale: a camera's ray goes on at a mirror and at a half-open sheet, and meets rough metal behind them; metal
        receives light through the sheet and from the mirror.
    Expected: within 2.5% of ``path``.
    """
    half = {"type": "mask", "opacity": 0.5, "bsdf": {"type": "twosided", "bsdf": diffuse(0.6, 0.6, 0.6)}}
    sheet = {"type": "rectangle", "to_world": T().translate([0.1, 0.5, 0.75]).scale(0.35), "bsdf": half}
    mirror = {
        "type": "rectangle",
        "to_world": T().look_at([-0.9, 0.55, 0], [0.5, 0.45, 1.5], [0, 1, 0]).scale(0.4),
        "bsdf": {"type": "conductor"},
    }
    scene = scene_of(0.2, metal=ball(0.1, BRUSHED), mirror=mirror, sheet=sheet)
    transport = computed(
        scene, "auto", -1
    )  # a limit would count mirrors that are looked into otherwise than ``path``
    assert transport.terms > 1
    named = {mesh.name: transport.reflection.material[mesh.vertices] for mesh in transport.meshes}
    assert (named["metal"] == 0).all() and (named["mirror"] == -1).all() and (named["sheet"] == -1).all()
    ((error, uncertainty),) = image_error(scene, transport)
    print(f"{error:.2%} (noise may show {uncertainty:.2%})")
    assert uncertainty < 0.015
    assert error < 0.025


def test_what_cannot_be_factored_is_named(tmp_path):
    """By the integrator, whose default it is: one warning, an image, and the metal beside it has its factors."""
    weight = {"type": "checkerboard", "to_uv": T().scale(4)}
    red, blue = (
        {"type": "blendbsdf", "weight": weight, "metal": BRUSHED, "paint": diffuse(*rgb)}
        for rgb in ((0.5, 0.1, 0.1), (0.1, 0.1, 0.5))
    )
    scene = scene_of(0.3, metal=ball(0.4, BRUSHED), quilt=ball(-0.5, red), rug=ball(-1.5, blue))
    integrator = mi.load_dict(
        {"type": "sparse_prt", "resolution": 4, "max_depth": 2, "cache": str(tmp_path), "progress": False}
    )
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", prt.PrtWarning)
        image = np.array(mi.render(scene.mitsuba, integrator=integrator, spp=4))
    said = [str(w.message) for w in caught if "diffuse" in str(w.message)]
    assert len(said) == 1
    assert (
        "'quilt', 'rug' (BlendBSDF varies over the surface" in said[0]
        and "estimated error does not know" in said[0]
    )
    assert np.isfinite(image).all() and image.mean() > 0.1
    (file,) = tmp_path.glob("*.prt")
    assert prt.load_transport(file).terms > 1


def test_methods_without_terms_fall_back():
    """With a warning in place of the error that a number of terms leads to."""
    with pytest.warns(prt.PrtWarning):
        scene = build(0.4, ball=ball(0, BRUSHED))
    with pytest.raises(prt.PrtError, match="share per texel"):
        prt.precompute(scene, LIGHTING, "sparse", max_depth=2, terms=4, progress=False)
    with pytest.warns(prt.PrtWarning, match="left as diffuse: .* share per texel"):
        assert prt.precompute(scene, LIGHTING, "sparse", max_depth=2, terms="auto", progress=False).terms == 0
    with pytest.raises(prt.PrtError, match="auto"):
        prt.precompute(scene, LIGHTING, terms="many", progress=False)
