"""What an open page gets when it asks Python."""

import threading

import mitsuba as mi
import numpy as np
import pytest
from conftest import T, build, diffuse, still_life, without_held_out
from numpy.testing import assert_allclose, assert_array_equal

import mi_sparse_prt as prt
from mi_sparse_prt.relighting.image import background_emitter
from mi_sparse_prt.relighting.viewer import make_live_page
from mi_sparse_prt.relighting.viewer.page_scene import draw_order
from mi_sparse_prt.relighting.viewer.question import page_sensor
from mi_sparse_prt.scene.mitsuba_meshes import lit_scene
from mi_sparse_prt.validation.mitsuba_reference import path_image

pytestmark = pytest.mark.usefixtures("never_held_out")

LIGHTING = prt.CubemapLighting(4)
RNG = np.random.default_rng(1)
LIGHTS = {
    "first": prt.Environment(RNG.random((16, 32, 3))),
    "second": prt.Environment(RNG.random((8, 16, 3))),
}
RADIANCE = [4.0, 2.0, 1.0]
VIEW = {
    "eye": [1.2, 1.9, 3.2],
    "target": [0, 0.5, 0],
    "up": [0, 1, 0],
    "height": 0.8,
    "columns": 40,
    "rows": 30,
}


def room() -> dict:
    """The still life under a lamp, with a glossy ball."""
    lamp = {
        "type": "rectangle",
        "to_world": T().translate([0, 2, 0]).rotate([1, 0, 0], 90).scale(0.4),
        "bsdf": diffuse(0.2, 0.2, 0.2),
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": RADIANCE}},
    }
    gold = {
        "type": "sphere",
        "center": [0.3, 0.3, 0.9],
        "radius": 0.25,
        "bsdf": {"type": "roughconductor", "alpha": 0.4, "material": "Au"},
    }
    return still_life(((0.7, 0.6, 0.5), (0.8, 0.3, 0.2), (0.2, 0.4, 0.8))) | {"lamp": lamp, "gold": gold}


@pytest.fixture(scope="module")
def scene():
    return build(0.5, **room(), sky={"type": "constant", "radiance": 0.3})


@pytest.fixture(scope="module")
def glossy(scene):
    with without_held_out():
        transport = prt.precompute(scene, LIGHTING, terms=4, method="gather", max_depth=3, progress=False)
    return transport, make_live_page(scene, transport, LIGHTS)


@pytest.fixture(scope="module")
def lamps(scene):
    with without_held_out():
        transport = prt.precompute(scene, prt.SceneEmitters(scene), max_depth=3, progress=False)
    return transport, make_live_page(scene, transport, {})


def halves(content: bytes, *shape: int) -> np.ndarray:
    return np.frombuffer(content, "<f2").astype(np.float32).reshape(*shape)


def test_colours_are_those_of_relight_towards_the_eye(scene, glossy):
    """What diffuse surfaces send, plus the rest. Expected: the sum to half floats, where surfaces face the eye."""
    transport, page = glossy
    light = LIGHTING.project(LIGHTS["first"])
    asked = {"ask": "colours", "eye": VIEW["eye"]}
    _, content = page.answers.answer(asked, light.astype("<f4").tobytes())
    unit, shine = halves(content, 2, scene.n_vertices, 3)
    order = draw_order(scene).order
    assert_allclose(unit, transport.irradiance(light)[order], rtol=2e-3, atol=1e-6)
    away = np.array(VIEW["eye"], np.float32) - scene.positions
    faces = (np.sum(away * scene.normals, axis=1) > 0)[order]
    whole = transport.relight(light, away)[order]
    found = scene.albedo[order] * unit + shine
    assert_allclose(found[faces], whole[faces], rtol=5e-3, atol=2e-3)
    assert np.abs(shine[faces]).max() > 0.1 and not shine[~faces].any()


def test_lamps_are_seen_themselves(scene, lamps):
    transport, page = lamps
    brightness = np.array([[0.5], [2.0]], np.float32) * np.ones(3, np.float32)
    assert transport.lights == ("lamp", "sky")
    _, content = page.answers.answer({"ask": "colours"}, brightness.tobytes())
    unit, shine = halves(content, 2, scene.n_vertices, 3)
    order = draw_order(scene).order
    assert_allclose(unit, transport.irradiance(brightness)[order], rtol=2e-3, atol=1e-6)
    (lamp,) = (mesh for mesh in scene.fronts if mesh.name == "lamp")
    on_lamp = (order >= lamp.vertices.start) & (order < lamp.vertices.stop)
    assert_allclose(shine[on_lamp], 0.5 * np.broadcast_to(RADIANCE, shine[on_lamp].shape), rtol=1e-3)
    assert not shine[~on_lamp].any()
    assert '"backgroundLamp"' not in page.text  # it is in the archive, deflated
    assert page.lights == ("lamps",)
    assert_allclose(page.answers.environments["lamps"].pixels, 0.3, rtol=1e-4)


def test_a_row_is_that_of_the_vertex_that_is_clicked(scene, glossy):
    transport, page = glossy
    vertex = int(np.argmax(scene.normals[:, 1] * (scene.positions[:, 0] > 1)))  # of the ground
    eye = scene.positions[vertex] + [0.01, 1, 0.02]
    towards = scene.positions[vertex] - eye
    asked = {"ask": "row", "eye": eye.tolist(), "towards": towards.tolist()}
    header, content = page.answers.answer(asked)
    assert header == {"vertex": vertex, "mesh": "ground"}
    assert_array_equal(np.frombuffer(content, "<f4").reshape(-1, 3), transport.rows([vertex])[0])
    assert page.answers.answer(asked | {"towards": [0, 1, 0]}) == ({"vertex": None}, b"")


@pytest.mark.parametrize("of", ["cubemap", "lamps"])
def test_pictures_are_those_of_render_and_of_path(scene, glossy, lamps, of):
    transport, page = glossy if of == "cubemap" else lamps
    brightness = np.array([[0.5], [2.0]], np.float32) * np.ones(3, np.float32)
    asked = {"ask": "picture", "environment": 1 if of == "cubemap" else 0, "degrees": 40.0} | VIEW
    sensor = mi.load_dict(
        {
            "type": "perspective",
            "fov_axis": "y",
            "fov": 2 * np.degrees(np.arctan(0.4)),
            "to_world": T().look_at(*(VIEW[name] for name in ("eye", "target", "up"))),
            "film": {"type": "hdrfilm", "width": 40, "height": 30, "rfilter": {"type": "box"}},
        }
    )
    light = LIGHTS["second"].rotated(40) if of == "cubemap" else brightness
    for by in ("render", "path"):
        passes = [
            halves(page.answers.answer(asked | {"by": by, "pass": k}, brightness.tobytes())[1], 30, 40, 3)
            for k in range(16)
        ]
        if by == "render":
            expected = [prt.render(scene, transport, light, sensor, 64, seed) for seed in (101, 102)]
        elif of == "cubemap":
            lit = lit_scene(scene.unlit_shapes(), background_emitter(light, LIGHTING))
            expected = [path_image(lit, sensor, 3, 256, seed) for seed in (101, 102)]
        else:
            with transport.emission.scene_lit_by(brightness, scene) as lit:
                expected = [path_image(lit, sensor, 3, 256, seed) for seed in (101, 102)]
        found, known = (
            np.mean([image.mean(axis=(0, 1)) for image in passes], axis=0),
            np.mean(expected, axis=(0, 1, 2)),
        )
        own = np.std([image.mean(axis=(0, 1)) for image in passes], axis=0, ddof=1) / 4
        noise = np.hypot(own, np.abs(np.subtract(*expected).mean(axis=(0, 1))))
        assert np.all(np.abs(found - known) < 5 * noise + 1e-3 * known), (by, found, known, noise)
        assert np.all(noise < 0.004 * known), by  # 2% would be seen
        assert not np.array_equal(passes[0], passes[1])


def test_a_dropped_image_is_a_light(glossy, tmp_path):
    page = glossy[1]
    pixels = RNG.random((8, 16, 3)).astype(np.float32)
    mi.Bitmap(pixels).write(str(tmp_path / "own.exr"))
    content = (tmp_path / "own.exr").read_bytes()
    before = len(page.answers.environments)
    for k in range(2):
        header, words = page.answers.answer({"ask": "environment", "name": "own.exr"}, content)
        assert header["number"] == before + k and len(words) == 4 * header["width"] * header["height"]
        assert header["background"].startswith("data:image/jpeg")
    assert_allclose([*page.answers.environments.values()][before].pixels, pixels, rtol=1e-3)
    for name, sent, words in (
        ("a.png", content, "ends in .exr"),
        ("a.exr", b"nothing", "cannot be read"),
        ("a.exr", content[:90], "cannot be read"),
    ):
        header, _ = page.answers.reply({"ask": "environment", "name": name}, sent)
        assert words in header["error"] and "\n" not in header["error"] and "/tmp" not in header["error"]
    assert len(page.answers.environments) == before + 2


@pytest.mark.parametrize(
    ("question", "words"),
    [
        ({}, "not for None"),
        ({"ask": "row", "eye": [0, 0, 0]}, "towards=None: three numbers"),
        ({"ask": "row", "eye": [0, 0, "x"], "towards": [0, 0, 1]}, "eye='x': a number"),
        ({"ask": "row", "eye": [0, 0, float("nan")], "towards": [0, 0, 1]}, "eye=nan"),
        ({"ask": "row", "eye": [0, 0, 0], "towards": [0, 0, 0]}, "no direction"),
        ({"ask": "colours", "eye": [0, 0, 0]}, "a light of 0 numbers"),
        ({"ask": "picture", "by": "path", "pass": 0} | VIEW, "environment=None: a whole number from 0"),
        ({"ask": "picture", "by": "eye", "pass": 0, "environment": 0, "degrees": 0} | VIEW, "not by 'eye'"),
        (
            {"ask": "picture", "by": "path", "pass": 0} | VIEW | {"columns": 9999, "rows": 9999},
            "window smaller",
        ),
        ({"ask": "picture", "by": "path", "pass": 0} | VIEW | {"target": VIEW["eye"]}, "another place"),
        ({"ask": "picture", "by": "path", "pass": -1} | VIEW, "pass=-1"),
    ],
)
def test_questions_that_make_no_sense(glossy, question, words):
    page = glossy[1]
    header, content = page.answers.reply(question)
    assert words in header["error"] and content == b""


def test_a_closed_page_answers_no_more(scene, glossy):
    transport, _ = glossy
    page = make_live_page(scene, transport, LIGHTS)
    asked = {"ask": "picture", "by": "render", "pass": 0, "environment": 0, "degrees": 0} | VIEW
    slow = threading.Thread(target=page.answers.reply, args=(asked,))
    slow.start()
    page.answers.close()
    assert page.answers.reply(asked)[0] == {"error": "the page was closed"}
    slow.join(10)
    assert not slow.is_alive()


def test_pages_of_other_matrices_are_refused(scene, glossy):
    transport, _ = glossy
    with pytest.raises(prt.PrtError, match="at least one environment"):
        make_live_page(scene, transport, {})
    pixels = prt.camera_pixels(scene, page_sensor(VIEW | {"columns": 4, "rows": 4}), 4)
    of_pixels = prt.precompute(
        scene, LIGHTING, "brute_force", spp=1, max_depth=2, measurement=pixels, progress=False
    )
    with pytest.raises(prt.PrtError, match="this one is of pixels"):
        make_live_page(scene, of_pixels, LIGHTS)
