"""Pictures by ``path`` that a page asks for, in a process of their own."""

import threading
import time

import numpy as np
import pytest
from numpy.testing import assert_allclose

import mi_sparse_prt as prt
from mi_sparse_prt.relighting.viewer import make_live_page

pytestmark = pytest.mark.usefixtures("never_held_out")

LIGHTING = prt.CubemapLighting(4)
LIGHTS = {name: prt.Environment(np.random.default_rng(k).random((8, 16, 3))) for k, name in enumerate("ab")}
VIEW = {"eye": [1.2, 1.9, 3.2], "target": [0, 0.5, 0], "up": [0, 1, 0], "height": 0.8}
ASKED = {"ask": "picture", "by": "path", "environment": 1, "degrees": 40.0, "tip": [30, 0, 10]} | VIEW
SMALL = {"columns": 40, "rows": 30, "pass": 3}


XML = """<scene version="3.0.0">
  <shape type="rectangle" id="ground">
    <transform name="to_world"><scale value="2"/><rotate x="1" angle="-90"/></transform>
    <bsdf type="diffuse"><rgb name="reflectance" value="0.7 0.6 0.5"/></bsdf>
  </shape>
  <shape type="cube" id="box">
    <transform name="to_world"><scale value="0.4"/><translate x="0.3" y="0.4"/></transform>
    <bsdf type="diffuse"><rgb name="reflectance" value="0.8 $green 0.2"/></bsdf>
  </shape>
  <shape type="rectangle" id="lamp">
    <transform name="to_world"><scale value="0.4"/><rotate x="1" angle="90"/><translate y="2"/></transform>
    <emitter type="area"><rgb name="radiance" value="4 2 1"/></emitter>
  </shape>
</scene>
"""


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "scene.xml"
    path.write_text(XML)
    return path


def page_of(scene, light="cubemap"):
    if light == "lamps":
        lamps = prt.precompute(scene, prt.SceneEmitters(scene), max_depth=2, progress=False)
        return make_live_page(scene, lamps, {}).answers
    transport = prt.precompute(scene, LIGHTING, method="gather", max_depth=2, progress=False)
    return make_live_page(scene, transport, LIGHTS).answers


def picture(answers, asked, content=b""):
    header, found = answers.answer(ASKED | asked, content)
    assert header == {"spp": 4}
    return np.frombuffer(found, "<f2").reshape(asked["rows"], asked["columns"], 3).astype(np.float32)


@pytest.mark.parametrize("light", [pytest.param("cubemap", marks=pytest.mark.slow), "lamps"])
def test_the_process_renders_what_this_one_would(file, light):
    """Rationale: it has a scene, an environment or lamps, a camera and a depth of its own, from what it is sent.

    Expected: the same samples, so the same pictures up to half floats; of another pass another picture.
    """
    scene = prt.load_scene(file, edge_length=0.5, green=0.3)
    answers = page_of(scene, light)
    content = np.array([[0.5, 1.0, 2.0]], np.float32).tobytes()
    there = picture(answers, SMALL, content)
    assert answers._path.reason is None
    again = picture(answers, SMALL | {"pass": 4}, content)
    answers._path.reason = "as if it had failed"
    here = picture(answers, SMALL, content)
    answers.close()
    assert there.mean() > 0.005
    assert_allclose(there, here, rtol=2e-3, atol=1e-4)
    assert not np.array_equal(there, again)


def test_others_do_not_wait_for_it(file):
    """Expected: a row is answered before a large picture that was asked for before; then the page is closed."""
    scene = prt.load_scene(file, edge_length=0.5, green=0.3)
    answers, found = page_of(scene), []
    asked = ASKED | {"columns": 2048, "rows": 2048, "pass": 0}
    slow = threading.Thread(target=lambda: found.append(answers.reply(asked)))
    slow.start()
    header, row = answers.answer({"ask": "row", "eye": VIEW["eye"], "towards": [-1.2, -1.9, -3.2]})
    assert slow.is_alive() and header["vertex"] is not None and row
    time.sleep(0.5)
    answers.close()
    slow.join(20)
    assert not slow.is_alive()
    assert found == [({"error": "the page was closed"}, b"")]


def test_a_file_that_was_changed_is_not_shown_for_the_scene(file):
    """Expected: the scene as it was loaded, rendered by this process, which knows why; bad questions change nothing."""
    scene = prt.load_scene(file, edge_length=0.5, green=0.3)
    answers = page_of(scene, "lamps")
    assert "shape (2, 3)" in answers.reply(ASKED | SMALL, bytes(24))[0]["error"]
    assert answers._path.reason is None
    content = np.ones((1, 3), np.float32).tobytes()
    before = picture(answers, SMALL, content)
    answers.close()
    text = file.read_text()
    assert text.count("0.7 0.6 0.5") == 1
    file.write_text(text.replace("0.7 0.6 0.5", "0.1 0.1 0.1"))
    answers = make_live_page(scene, answers.transport, {}).answers
    after = picture(answers, SMALL, content)
    assert "was changed" in answers._path.reason
    answers.close()
    assert_allclose(after, before, rtol=2e-3, atol=1e-4)
