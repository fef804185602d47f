"""Pages that Python answers, in a browser: served, and in a notebook."""

import asyncio
import base64
import json
import threading
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from conftest import T, build, diffuse, still_life, without_held_out
from pages_in_browser import DROP, MARKS, SIZE, UNTIL, browser, linear, open_page, picture, sky, webdriver
from scipy.ndimage import binary_dilation

import mi_sparse_prt as prt
from mi_sparse_prt.benchmark.gallery import images_beside
from mi_sparse_prt.core.metrics import flip_map
from mi_sparse_prt.relighting.viewer import make_live_page
from mi_sparse_prt.relighting.viewer.question import page_sensor
from mi_sparse_prt.relighting.viewer.server import PageServer
from mi_sparse_prt.relighting.viewer.turning import turn_matrix

pytestmark = MARKS
LIGHTING = prt.CubemapLighting(8)
LIGHTS = {"first": sky(1), "second": sky(2)}
FLIP = 0.05


def shapes() -> dict:
    """The still life with a rough golden ball, under a lamp and a sky."""
    return still_life(((0.7, 0.6, 0.5), (0.8, 0.3, 0.2), (0.2, 0.4, 0.8))) | {
        "gold": {
            "type": "sphere",
            "center": [0.4, 0.35, 0.9],
            "radius": 0.3,
            "bsdf": {"type": "roughconductor", "alpha": 0.5, "material": "Au"},
        },
        "lamp": {
            "type": "rectangle",
            "to_world": T().translate([0.5, 1.6, -0.8]).rotate([1, 0, 0], 50).scale(0.4),
            "bsdf": diffuse(0.2, 0.2, 0.2),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [4, 3, 2]}},
        },
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.2, 0.25, 0.3]}},
        "camera": {
            "type": "perspective",
            "fov": 45,
            "to_world": T().look_at(origin=[1.2, 1.9, 3.2], target=[0, 0.5, 0], up=[0, 1, 0]),
            "film": {"type": "hdrfilm", "width": SIZE[0], "height": SIZE[1], "rfilter": {"type": "box"}},
        },
    }


@pytest.fixture(scope="module")
def scene():
    return build(0.15, **shapes())


@pytest.fixture(scope="module")
def transports(scene):
    options = {"method": "gather", "max_depth": 3, "progress": False}
    with without_held_out():
        found = {
            "glossy": prt.precompute(scene, LIGHTING, terms=6, **options),
            "lamps": prt.precompute(scene, prt.SceneEmitters(scene), max_depth=3, progress=False),
        }
    clusters = prt.compress(prt.precompute(scene, LIGHTING, terms=0, **options), progress=False)
    return found | {"clusters": clusters}


@pytest.fixture(scope="module")
def driver():
    opened = browser()
    yield opened
    opened.quit()


class Served:
    """A page and its server, until it is closed."""

    def __init__(self, scene, transport, lights):
        self.made = make_live_page(scene, transport, lights, kept=0.5)
        self.server = PageServer(self.made.text.encode(), 0, self.made.answers.reply)
        threading.Thread(target=self.server.serve_forever, daemon=True).start()

    def close(self):
        self.server.shutdown()
        self.server.server_close()
        self.made.answers.close()


@pytest.fixture
def served(driver, scene, transports, request):
    kind = request.param
    page = Served(scene, transports[kind], {} if kind == "lamps" else LIGHTS)
    open_page(driver, page.server.url)
    # a frame that was asked for while the page was held came to nothing
    driver.execute_script("v.held = false; v.touch()")
    yield SimpleNamespace(made=page.made, transport=transports[kind], kind=kind)
    wrong = [entry["message"] for entry in driver.get_log("browser") if entry["level"] == "SEVERE"]
    page.close()
    driver.get("about:blank")
    assert wrong == []


def settled(driver) -> np.ndarray:
    """The picture once nothing moves and Python has answered; linear."""
    quiet = (
        "v.exact && !v.changed && !(v.streamed && (v.streamed.busy || v.streamed.again || v.streamed.old))"
    )
    driver.execute_async_script(UNTIL, quiet, 20000)
    assert driver.execute_script("return " + quiet)
    return linear(picture(driver))


def far(ours: np.ndarray, theirs: np.ndarray) -> float:
    return float(flip_map(np.clip(theirs, 0, 1), ours).mean())


@pytest.mark.parametrize("served", ["glossy", pytest.param("lamps", marks=pytest.mark.slow)], indirect=True)
def test_streamed_pictures_are_those_of_render(driver, scene, served, artefact):
    """Rationale: glossy surfaces are shaded for each view, lamps for each brightness, and Python sends the colours.

    Expected: FLIP below 0.05, before and after light and view change; with the light that it had before, it is not. A
    matrix of lamps has no terms: there, the page draws the golden ball as a diffuse one, and it is left out.
    """
    first = settled(driver)
    if served.kind == "lamps":
        light, other = np.ones(2, np.float32), np.array([0.2, 2.0], np.float32)
        driver.execute_script("v.set({lamps: [0.2, 2.0]})")
    else:
        light, other = LIGHTS["first"], LIGHTS["second"].rotated(120)
        driver.execute_script("v.set({environment: 1, degrees: 120})")
    second = settled(driver)
    for name, ours, shone in (("first", first, light), ("second", second, other)):
        theirs = prt.render(scene, served.transport, shone, 0, 32)
        if served.kind == "lamps":
            theirs = np.where(pixels_of(scene, "gold")[..., None], ours, theirs)
        artefact(images_beside({"page": ours, "render": theirs}, theirs), name)
        assert far(ours, theirs) < FLIP, name
    assert far(first, second) > 2 * FLIP


def pixels_of(scene, name: str) -> np.ndarray:
    """Where a shape is seen (height, width), and two pixels around it."""
    width, height = SIZE
    y, x = (mi.Float(v.ravel().astype(np.float32)) for v in np.indices((height, width)))
    at = mi.Point2f((x + 0.5) / width, (y + 0.5) / height)
    ray, _ = scene.sensor(0).sample_ray(0, 0.5, at, mi.Point2f(0.5))
    si = scene.mitsuba.ray_intersect(ray)
    shape = next(shape for shape in scene.mitsuba.shapes() if shape.id() == name)
    return binary_dilation((si.shape == mi.ShapePtr(shape)).numpy().reshape(height, width), iterations=2)


@pytest.mark.slow  # their colours towards another eye: tests/unit/test_answers.py
@pytest.mark.parametrize("served", ["glossy"], indirect=True)
def test_another_view_shades_glossy_surfaces_anew(driver, scene, served):
    settled(driver)
    before = driver.execute_script("return v.python.asked")
    driver.execute_script("v.camera.orbit(0.9, 0.1); v.touch()")
    ours = settled(driver)
    assert driver.execute_script("return v.python.asked") > before
    theirs = served_image(served, view_of(driver), 24)
    assert far(ours, theirs) < FLIP


def view_of(driver) -> dict:
    """From where the page looks, at which light."""
    return driver.execute_script(
        "const {eye, target, up, height} = v.camera; return {eye, target, up, height, ...v.shown}"
    )


def served_image(served, view: dict, spp: int) -> np.ndarray:
    """By Python."""
    sensor = page_sensor(view | {"columns": SIZE[0], "rows": SIZE[1]})
    answers = served.made.answers
    turn = turn_matrix(view["degrees"], view["axis"], view["tip"])
    light = answers.environments[view["light"]].rotated(turn)
    return prt.render(answers.scene, answers.transport, light, sensor, spp)


@pytest.mark.parametrize("served", ["clusters"], indirect=True)
@pytest.mark.parametrize("by", [pytest.param("render", marks=pytest.mark.slow), "path"])
def test_a_picture_by_python_lies_over_the_page(driver, served, by):
    """Right of the line is Python's picture, of the same view and light; it goes when the light moves."""
    settled(driver)
    driver.execute_script(
        "v.set({degrees: 30, axis: 'z', tip: [70, 0, -20], beside: arguments[0], line: 0.25})", by
    )
    driver.execute_async_script(UNTIL, "v.beside.passes >= 3 && !v.beside.canvas.hidden", 30000)
    text = driver.execute_script("return v.beside.canvas.toDataURL('image/png')")
    assert driver.execute_script("return v.beside.canvas.style.clipPath").endswith("25%)")
    stream = mi.MemoryStream()
    stream.write(base64.b64decode(text.split(",")[1]))
    stream.seek(0)
    shown = linear(np.array(mi.Bitmap(stream))[..., :3].astype(np.float32) / 255)
    view = view_of(driver)
    driver.execute_script("v.set({degrees: 90})")
    driver.execute_async_script(UNTIL, "v.beside.canvas.hidden", 5000)
    assert driver.execute_script("return v.beside.canvas.hidden || v.beside.passes > 0")
    driver.execute_script("v.set({beside: ''})")
    driver.execute_async_script(UNTIL, "v.beside.canvas.hidden && !v.beside.busy", 10000)
    assert driver.execute_script("return v.beside.canvas.hidden")
    theirs = served_image(
        served, view, 24
    )  # not before: threads that add passes to a picture would be in the way
    assert shown.shape == theirs.shape
    assert far(shown, theirs) < (0.06 if by == "render" else 0.2)  # 12 samples and more per pixel
    assert shown.mean() == pytest.approx(np.clip(theirs, 0, 1).mean(), rel=0.03)


@pytest.mark.parametrize("served", ["clusters"], indirect=True)
def test_nothing_waits_for_a_picture_by_path(driver, served):
    """Expected: a row comes although a picture by ``path`` never does; for one by ``render`` it would wait."""
    settled(driver)
    driver.execute_script(
        "const way = v.python.way, never = () => new Promise((end) => (window.end = end));"
        "v.python.way = (question, c) => (question.ask === 'picture' ? never() : way(question, c));"
    )
    row = "v.python.ask({ask: 'row', eye: v.camera.eye, towards: [0, -1, 0]}).then(() => window.told = true);"
    for by, told in (("path", True), ("render", False)):
        driver.execute_script(
            "window.told = false; v.python.ask({ask: 'picture', by: arguments[0]});" + row, by
        )
        driver.execute_async_script(UNTIL, "window.told", 1000)
        assert driver.execute_script("return window.told") is told, by
    driver.execute_script("window.end([{}, new ArrayBuffer(0)])")
    driver.execute_async_script(UNTIL, "window.told", 5000)
    assert driver.execute_script("return window.told")


@pytest.mark.parametrize("served", ["clusters"], indirect=True)
def test_a_click_shows_a_row(driver, scene, served):
    settled(driver)
    driver.execute_script("v.pinned = false; v.touch()")
    canvas = driver.find_element("id", "view")
    webdriver.ActionChains(driver).move_to_element_with_offset(canvas, 150, 60).click().perform()
    driver.execute_async_script(UNTIL, "v.row", 10000)
    words = driver.find_element("id", "vertex").text
    vertex = int(words.split()[3])
    row = np.array(driver.execute_script("return Array.from(v.row)"), np.float32).reshape(-1, 3)
    assert np.array_equal(row, served.transport.rows([vertex])[0]) and row.max() > 0
    (mesh,) = (m.name for m in scene.meshes if m.vertices.start <= vertex < m.vertices.stop)
    assert f"({mesh})" in words


@pytest.mark.slow  # Python's part of it: tests/unit/test_answers.py; the page's: tests/system/test_browser.py
@pytest.mark.parametrize("served", ["clusters"], indirect=True)
def test_dropped_images_are_checked_in_python(driver, served, tmp_path):
    light = sky(5)
    mi.Bitmap(light.pixels).write(str(tmp_path / "own.exr"))
    for name, content, words in (
        ("own.exr", (tmp_path / "own.exr").read_bytes(), ""),
        ("a.exr", b"nothing", "cannot be read"),
        ("a.txt", b"nothing", "ends in .exr"),
    ):
        driver.execute_async_script(DROP, name, list(content))
        driver.execute_async_script(UNTIL, "!v.python.failed === !" + json.dumps(words), 5000)
        assert words in driver.find_element("id", "sentence").text
    assert driver.execute_script("return v.shown.light") == "own.exr"
    ours = settled(driver)
    assert far(ours, served_image(served, view_of(driver), 24)) < FLIP


@pytest.mark.parametrize("served", [pytest.param("glossy", marks=pytest.mark.slow), "lamps"], indirect=True)
def test_colours_that_are_not_known_say_so(driver, served):
    """A matrix that is not compressed, and whose vertices were all sampled alike. Expected: options that say so."""
    for name, words in (
        ("clusters", "no clusters"),
        ("rank", "not compressed"),
        ("dense", "all were sampled alike"),
    ):
        option = driver.find_element("css selector", f"select[name=colours] option[value={name}]")
        assert not option.is_enabled() and option.get_attribute("textContent").endswith(": not known")
        assert words in option.get_attribute("title")
        assert words in driver.find_element("id", "notes").get_attribute("textContent")


@pytest.mark.parametrize("served", ["clusters"], indirect=True)
def test_errors_of_meshes_are_colours(driver, scene, served):
    before = settled(driver)
    driver.execute_script("v.set({colours: 'error'})")
    after = settled(driver)
    assert np.abs(after - before).mean() > 0.02
    errors = driver.execute_script("return v.scene.errors")
    told = served.transport.report["estimated_error"]["meshes"]
    assert {name: entry["error"] for name, entry in errors.items()} == pytest.approx(told)


def test_two_browsers_and_one_that_comes_back(driver, scene, transports):
    """Both get their own answers; a page whose server is gone says so, and goes on when there is one again."""
    page = Served(scene, transports["glossy"], LIGHTS)
    other = browser()
    try:
        for one in (driver, other):
            open_page(one, page.server.url)
            one.execute_script("v.held = false; v.touch()")
        driver.execute_script("v.set({degrees: 10})")
        other.execute_script("v.set({degrees: 200})")
        ours, theirs = settled(driver), settled(other)
        assert far(ours, theirs) > 0.02
    finally:
        other.quit()
    port = page.server.server_address[1]
    page.server.shutdown()
    page.server.server_close()
    driver.execute_script("v.set({degrees: 77})")
    driver.execute_async_script(UNTIL, "v.python.failed", 20000)
    assert "still running" in driver.find_element("id", "sentence").text
    again = PageServer(b"", port, page.made.answers.reply)
    again._token = page.server._token  # as if the connection had been lost alone
    threading.Thread(target=again.serve_forever, daemon=True).start()
    driver.execute_script("v.set({degrees: 80})")
    driver.execute_async_script(UNTIL, "!v.python.failed", 20000)
    assert driver.find_element("id", "sentence").text == ""
    again.shutdown()
    again.server_close()
    page.made.answers.close()
    driver.get("about:blank")
    driver.get_log("browser")  # it told of the server that was gone


@pytest.mark.slow
def test_memory_stays_as_it_is(driver, scene, transports):
    """5,000 frames of a light that turns. Expected: less than 1 MB more is in use after the second half.

    Heaps and array buffers, each time after everything that nothing refers to is collected: 0.4 kB that a frame leaves
    behind would be seen.
    """
    page = Served(scene, transports["clusters"], LIGHTS)
    open_page(driver, page.server.url)

    def used_after_frames() -> float:
        driver.execute_script(
            """
            for (let k = 0; k < 2500; k++) {
              v.set({ degrees: 0.7 * k, budget: 10 });
              v.relight("per_band");
              if (k % 500 === 0) v.draw();
            }
            """
        )
        driver.execute_cdp_cmd("HeapProfiler.collectGarbage", {})
        usage = driver.execute_cdp_cmd("Runtime.getHeapUsage", {})
        return (
            sum(usage.get(name, 0) for name in ("usedSize", "embedderHeapUsedSize", "backingStorageSize"))
            / 1e6
        )

    first, second = used_after_frames(), used_after_frames()
    page.close()
    assert second < first + 1, (first, second)


# --- in a notebook

NOTEBOOK = """
<!doctype html><meta charset="utf-8"><div id="cell"></div>
<script type="module">
import widget from "data:text/javascript;base64,{code}";
const traits = {traits}, handlers = {};
window.sent = [];
window.model = {
  get: (name) => traits[name],
  set: (name, value) => {
    if (String(traits[name]) === String(value)) return;
    traits[name] = value;
    (handlers["change:" + name] || []).forEach((handler) => handler());
  },
  save_changes: () => (window.saved = (window.saved || 0) + 1),
  on: (names, handler) =>
    names.split(" ").forEach((name) => (handlers[name] = [...(handlers[name] || []), handler])),
  off: (names, handler) =>
    names.split(" ").forEach((name) => (handlers[name] = (handlers[name] || []).filter((h) => h !== handler))),
  send: (content, callbacks, buffers) => window.sent.push([content, Array.from(new Uint8Array(buffers[0] || []))]),
  receive: (content, bytes) => {
    const buffers = [new DataView(new Uint8Array(bytes).buffer)];
    handlers["msg:custom"].forEach((handler) => handler(content, buffers));
  },
};
window.end = widget.render({ model, el: document.getElementById("cell") });
end.then(async () => { window.v = await document.querySelector("iframe").contentWindow.viewer; });
</script>
"""


@pytest.fixture
def notebook(driver, scene, transports, tmp_path):
    """The widget's own module in a page, with a model that the test passes messages of."""
    viewer = prt.show(scene, transports["glossy"], LIGHTS)
    sent = []
    viewer.send = lambda content, buffers=(): sent.append((content, [bytes(b) for b in buffers]))
    code = base64.b64encode(str(prt.Viewer._esm).encode()).decode()
    names = ("page", "height", "light", "degrees", "axis", "tip", "exposure", "camera", "lamps")
    traits = json.dumps({name: getattr(viewer, name) for name in names}).replace("</", "<\\/")
    path = tmp_path / "notebook.html"
    path.write_text(NOTEBOOK.replace("{code}", code).replace("{traits}", traits))
    driver.get(path.as_uri())
    driver.execute_async_script(UNTIL, "window.v", 20000)

    def exchange():
        for content, values in driver.execute_script("return window.sent.splice(0)"):
            viewer._received(viewer, content, [bytes(values)])
        for content, buffers in sent:
            values = list(buffers[0]) if buffers else []
            driver.execute_script("model.receive(arguments[0], arguments[1])", content, values)
        sent.clear()

    yield SimpleNamespace(viewer=viewer, exchange=exchange)
    wrong = [entry["message"] for entry in driver.get_log("browser") if entry["level"] == "SEVERE"]
    driver.get("about:blank")
    assert wrong == []


def exchanged(driver, notebook, until: str) -> None:
    for _ in range(200):
        notebook.exchange()
        if driver.execute_script("return " + until):
            return
        driver.execute_async_script("setTimeout(arguments[0], 50)")
    raise AssertionError(f"never: {until}")


@pytest.mark.slow
def test_a_notebook_has_light_and_camera_as_traits(driver, scene, transports, notebook):
    viewer, quiet = notebook.viewer, "v.exact && !v.streamed.busy && !v.streamed.again && !v.streamed.old"
    exchanged(driver, notebook, quiet)
    driver.execute_script("model.set('degrees', 90); model.set('light', 'second')")
    exchanged(driver, notebook, "v.state.degrees === 90 && v.environment.name === 'second' && " + quiet)
    driver.execute_script("model.set('tip', [40, 0, 15])")
    exchanged(driver, notebook, "String(v.state.tip) === '40,0,15' && " + quiet)
    driver.execute_script("v.camera.orbit(0.3, 0); v.turnAbout('x'); v.set({degrees: 45})")
    exchanged(driver, notebook, "model.get('degrees') === 45 && model.get('axis') === 'x' && " + quiet)
    for name in ("degrees", "axis", "tip", "light", "camera"):
        setattr(viewer, name, driver.execute_script("return model.get(arguments[0])", name))
    assert driver.execute_script("return window.saved") >= 1
    driver.execute_script("v.held = v.pinned = true; v.resize(...arguments)", *SIZE)
    ours = linear(picture(driver))
    theirs = viewer.image(*SIZE, spp=64)
    assert far(ours, theirs) < FLIP


def test_a_notebook_gets_the_pages_own_picture(driver, notebook):
    exchanged(driver, notebook, "v.exact && !v.streamed.busy")

    async def asked() -> bytes:
        found = asyncio.ensure_future(notebook.viewer.screenshot())
        while not found.done():
            await asyncio.sleep(0.05)
            notebook.exchange()
        return found.result()

    png = asyncio.run(asked())
    stream = mi.MemoryStream()
    stream.write(png)
    stream.seek(0)
    assert np.ptp(np.array(mi.Bitmap(stream))[..., :3]) > 100


def test_a_notebook_without_a_browser_says_so(scene, transports, monkeypatch):
    monkeypatch.setattr("mi_sparse_prt.relighting.viewer.widget.PATIENCE", 0.05)
    viewer = prt.show(scene, transports["glossy"], LIGHTS["first"])
    with pytest.raises(prt.PrtError, match="no browser"):
        asyncio.run(viewer.screenshot())
    viewer.light = "nowhere"
    with pytest.raises(prt.PrtError, match="no light 'nowhere'; there are: environment"):
        viewer.image()
    lamps = prt.show(scene, transports["lamps"])
    lamps.lamps = [0.0, 1.0]
    dark = lamps.image(32, 24, 4)
    lamps.lamps = [1.0, 1.0]
    assert lamps.image(32, 24, 4).mean() > 1.05 * dark.mean() > 0
