"""Exported pages in a browser (headless Chromium, WebGL by its software renderer), against Python."""

import itertools

import mitsuba as mi
import numpy as np
import pytest
import scipy.ndimage
from conftest import T, build, diffuse, still_life, without_held_out
from numpy.testing import assert_allclose
from pages_in_browser import (
    DROP,
    MARKS,
    SIZE,
    UNTIL,
    browser,
    linear,
    open_page,
    picture,
    pixels_of,
    radiance_file,
    sky,
    webdriver,
)

import mi_sparse_prt as prt
from mi_sparse_prt.core.metrics import flip_map, relative_l2
from mi_sparse_prt.emission.haar import haar_colours
from mi_sparse_prt.methods.plan import Plan
from mi_sparse_prt.relighting.approximations import (
    Everything,
    Incremental,
    NonIncremental,
    PerBand,
    wavelet_bands,
    weighted_error,
)
from mi_sparse_prt.relighting.players import ClusteredPlayer
from mi_sparse_prt.relighting.viewer import make_page
from mi_sparse_prt.relighting.viewer.answers import page_sensor
from mi_sparse_prt.relighting.viewer.colourings import DENSE, OTHERS, colourings
from mi_sparse_prt.relighting.viewer.page_scene import draw_order
from mi_sparse_prt.relighting.viewer.turning import turn_matrix
from mi_sparse_prt.validation.matrix_figures import panels

pytestmark = MARKS

LIGHTING = prt.CubemapLighting(16)
FLIP = 0.05  # of a picture against Python's own


LIGHTS = {"first": sky(1), "second": sky(2)}
TURNS = (
    {"degrees": 0.0, "axis": "y", "tip": [0, 0, 0]},
    {"degrees": 130.0, "axis": "y", "tip": [0, 0, 0]},
    {"degrees": 40.0, "axis": "y", "tip": [50, 0, -35]},
    {"degrees": 250.0, "axis": "z", "tip": [90, 0, 0]},
    {"degrees": 77.5, "axis": "x", "tip": [0, 120, 100]},
)


def shapes() -> dict:
    """The still life, a leaf that is two-sided, and a ball with a texture."""
    checks = {"type": "checkerboard", "to_uv": T().scale([8, 4, 1])}
    return still_life(((0.7, 0.6, 0.5), (0.8, 0.3, 0.2), (0.2, 0.4, 0.8))) | {
        "leaf": {
            "type": "rectangle",
            "to_world": T()
            .translate([0.2, 1.3, -0.4])
            .rotate([0, 1, 0], 40)
            .rotate([1, 0, 0], 60)
            .scale(0.4),
            "bsdf": {"type": "twosided", "bsdf": diffuse(0.3, 0.7, 0.3)},
        },
        "marble": {
            "type": "sphere",
            "center": [0.3, 0.25, 0.9],
            "radius": 0.25,
            "bsdf": {"type": "diffuse", "reflectance": checks},
        },
        "camera": {
            "type": "perspective",
            "fov": 45,
            "to_world": T().look_at(origin=[1.2, 1.9, 3.2], target=[0, 0.5, 0], up=[0, 1, 0]),
            "film": {"type": "hdrfilm", "width": SIZE[0], "height": SIZE[1], "rfilter": {"type": "box"}},
        },
    }


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    scene = build(0.15, **shapes())
    with without_held_out():
        transport = prt.precompute(scene, LIGHTING, method=Plan("consensus", "gather"), progress=False)
    transport = prt.compress(transport, progress=False)
    page = make_page(scene, transport, LIGHTS, kept=0.3)
    path = tmp_path_factory.mktemp("page") / "page.html"
    path.write_text(page.text)
    return scene, transport, page, path


@pytest.fixture(scope="module")
def driver():
    opened = browser()
    yield opened
    opened.quit()


@pytest.fixture
def page(driver, exported):
    """The page, just opened, in pictures of a size."""
    open_page(driver, exported[3].as_uri())
    yield driver
    wrong = [entry["message"] for entry in driver.get_log("browser") if entry["level"] == "SEVERE"]
    assert wrong == []


def array(driver, name: str) -> np.ndarray:
    return np.array(driver.execute_script(f"return Array.from(v.{name});"), np.float32)


def side_by_side(ours: np.ndarray, theirs: np.ndarray):
    figure, axes = panels(14, 4, 1, 3)
    for axis, (title, image) in zip(
        axes,
        {"page": ours, "render": theirs, "difference x 5": 5 * np.abs(ours - theirs)}.items(),
        strict=True,
    ):
        axis.imshow(np.clip(image, 0, 1) ** (1 / 2.2))
        axis.set(title=title)
    return figure


def test_a_picture_is_that_of_render(page, exported, artefact):
    scene, transport, _, _ = exported
    for number, how in enumerate(TURNS[1:4]):
        name = [*LIGHTS][number % 2]
        ours = picture(
            page, "v.set({environment: arguments[0], ...arguments[1]})", [*LIGHTS].index(name), how
        )
        light = LIGHTS[name].rotated(turn_matrix(**how))
        theirs = prt.render(scene, transport, light, 0, 64, progress=False)
        away = flip_map(np.clip(theirs, 0, 1), linear(ours)).mean()
        artefact(side_by_side(linear(ours), theirs), f"turn {number}")
        assert away < FLIP, f"{name} {how}: {away:.4f}"
        assert relative_l2(linear(ours), np.clip(theirs, 0, 1)) < 0.06


def test_the_background_turns_with_the_light(page, exported):
    """A camera that sees the sky alone. Expected: that of ``render``, as far as a JPEG keeps it, turned as it is."""
    scene, transport, _, _ = exported
    page.execute_script("v.camera.eye = [0, 8, 0]; v.camera.target = [0.4, 8.9, -0.5]")
    view = page.execute_script("const {eye, target, up, height} = v.camera; return {eye, target, up, height}")
    sensor = page_sensor(view | {"columns": SIZE[0], "rows": SIZE[1]})
    for number, how in enumerate(TURNS[:3]):
        ours = linear(picture(page, "v.set({environment: 1, exposure: -2, ...arguments[0]})", how))
        light, turn = LIGHTS["second"], turn_matrix(**how)
        right, wrong = (
            prt.render(scene, transport, light.rotated(t), sensor, 16) / 4 for t in (turn, turn.T)
        )
        assert relative_l2(ours, right) < 0.06, how
        assert number == 0 or relative_l2(ours, wrong) > 0.3, how


def test_rows_of_the_background_lie_where_mitsuba_has_them(driver, exported, tmp_path):
    """Rationale: Mitsuba's first and last rows of pixels lie at the poles, those of a texture half a pixel from them.

    Expected: a sky of rows, some beyond white, as ``render`` has it but for 0.06; where a texture has rows it is 0.2.
    """
    scene, transport, _, _ = exported
    rows = np.random.default_rng(7).choice([0.1, 0.5, 0.9], 128)
    rows[20:24] = 4.0
    light = prt.Environment(np.tile(rows[:, None, None], (1, 256, 3)))
    make_page(scene, transport, {"rows": light}, kept=0.3).save(tmp_path / "rows.html")
    open_page(driver, (tmp_path / "rows.html").as_uri())
    driver.execute_script("v.camera.eye = [0, 8, 0]; v.camera.target = [0.4, 8.9, -0.5]")
    ours = linear(picture(driver))
    view = driver.execute_script(
        "const {eye, target, up, height} = v.camera; return {eye, target, up, height}"
    )
    sensor = page_sensor(view | {"columns": SIZE[0], "rows": SIZE[1]})
    theirs = np.clip(prt.render(scene, transport, light, sensor, 64), 0, 1)
    assert np.ptp(theirs) > 0.5
    assert relative_l2(ours, theirs) < 0.1


def test_colours_of_vertices_are_those_of_python(page, exported):
    """The graphics card's part: clusters to vertices. Expected: those of what the page keeps, to 0.1%."""
    scene, _, made, _ = exported
    player = ClusteredPlayer(made.clusters)
    page.execute_script("v.set({environment: 1, degrees: 40}); v.relight('everything')")
    light = array(page, "light").reshape(-1, 3)
    player.apply(Everything(wavelet_bands(LIGHTING.resolution)).update(light, None))
    found = np.array(page.execute_script(COLOURS), np.float32).reshape(-1, 4)[: scene.n_vertices, :3]
    expected = np.maximum(player.incident, 0)[draw_order(scene).order]
    assert relative_l2(found, expected) < 1e-3


COLOURS = """
const { gl, colours, size } = v.picture, pixels = new Float32Array(4 * size[0] * size[1]);
gl.bindFramebuffer(gl.FRAMEBUFFER, colours);
gl.readPixels(0, 0, ...size, gl.RGBA, gl.FLOAT, pixels);
gl.bindFramebuffer(gl.FRAMEBUFFER, null);
return Array.from(pixels);
"""


def test_surfaces_are_as_bright_as_those_of_render(page, exported):
    """What is interpolated, reflected and shown: the mean of surfaces, edges and what is too bright left out.

    Expected: within 0.7%, of which 8 bits and truncation are a part; 2% would not pass.
    """
    scene, transport, _, _ = exported
    ours = linear(picture(page, "v.set({environment: 0, degrees: 250, exposure: -1})"))
    theirs = prt.render(scene, transport, LIGHTS["first"].rotated(250), 0, 64) / 2
    lit = prt.render(scene, transport, 1.0, 0, 64)
    inside = np.abs(lit - 1).max(axis=-1) > 0.05  # the background is 1 there
    inside = scipy.ndimage.binary_erosion(inside, iterations=3) & (theirs.max(axis=-1) < 1)
    assert inside.mean() > 0.3
    for channel in range(3):
        assert ours[inside, channel].mean() == pytest.approx(theirs[inside, channel].mean(), rel=0.007)


def test_what_is_kept_of_a_view_is_used_for_that_view_alone(page):
    """Triangles of pixels are looked up again when the camera or the size is another one. Expected: the same bytes as
    from nothing, and as before where the camera comes back.
    """
    show = "; v.relight('everything'); v.draw(); return v.picture.canvas.toDataURL('image/png')"
    first = pixels_of(page.execute_script("v.set({degrees: 10})" + show))
    for script in (
        "v.camera.orbit(0.3, 0.1)",
        "v.set({degrees: 80})",
        "v.resize(200, 240)",
        "v.camera.dolly(0.7)",
    ):
        kept = pixels_of(page.execute_script(script + show))
        anew = pixels_of(page.execute_script("v.picture.view = null" + show))
        assert np.array_equal(kept, anew), script
    back = "v.camera.home(); v.set({degrees: 10}); v.resize(...arguments)"
    assert np.array_equal(pixels_of(page.execute_script(back + show, *SIZE)), first)


def test_what_stands_still_becomes_smooth(page):
    """Frame by frame, from one sample of a pixel to four. Expected: the picture of all at once, and then no more."""
    at_once = picture(page, "v.set({degrees: 30})")
    steps = page.execute_script(
        """v.moved = performance.now(); const more = [v.frame(v.moved)], pictures = [];
        for (let k = 0; k < 4; k++) {
          more.push(v.frame(v.moved + 1000));
          pictures.push(v.picture.canvas.toDataURL('image/png'));
        }
        return [more, pictures];"""
    )
    assert steps[0] == [True, True, True, True, False]
    apart = [np.abs(pixels_of(text) - at_once).mean() for text in steps[1]]
    assert apart[-1] < 0.2 / 255 < apart[0]
    assert max(apart[1:]) < apart[0] / 2


def test_turning_and_moving_change_the_picture(page):
    before = picture(page)
    assert np.ptp(before) > 0.5
    for script in (
        "v.set({degrees: 90})",
        "v.set({exposure: 1})",
        "v.set({colours: 'light'})",
        "v.set({colours: 'clusters'})",
        "v.set({colours: 'radiance'})",
        "v.turn(0, 40)",
        "v.set({axis: 'x'})",
        "v.set({environment: 1, colours: 'radiance'})",
        "v.camera.orbit(0.5, 0.2)",
        "v.camera.dolly(0.7)",
    ):
        after = picture(page, script)
        assert np.abs(after - before).mean() > 0.005, script
        before = after


def test_dragging_and_keys(page):
    driver, state = page, "return [v.camera.state, v.state.degrees, v.state.exposure]"
    canvas = driver.find_element("id", "view")
    actions = webdriver.ActionChains(driver, duration=20)
    before = driver.execute_script(state)
    actions.move_to_element(canvas).click_and_hold().move_by_offset(60, 20).release().perform()
    moved = driver.execute_script(state)
    assert moved[0] != before[0] and moved[1] == before[1]
    keys = webdriver.Keys
    actions = webdriver.ActionChains(driver, duration=20)
    actions.key_down(keys.SHIFT).move_to_element(canvas).click_and_hold().move_by_offset(
        60, 0
    ).release().key_up(keys.SHIFT)
    actions.send_keys("+").perform()
    turned = driver.execute_script(state)
    assert turned[0] == moved[0] and turned[1] != moved[1] and turned[2] == moved[2] + 0.25


def test_dragging_tips_the_light(page):
    """With control, down the picture: light from behind the camera goes down, by half a turn for the picture's height.

    Shift alone never tips it, a key sets it upright again, and the camera stays where it is.
    """
    driver, keys = page, webdriver.Keys
    canvas, camera = driver.find_element("id", "view"), driver.execute_script("return v.camera.state")
    height = canvas.size["height"]

    def dragged(key, across, down):
        actions = webdriver.ActionChains(driver, duration=20).key_down(key).move_to_element(canvas)
        actions.click_and_hold().move_by_offset(across, down).release().key_up(key).perform()

    dragged(keys.SHIFT, 40, 60)
    before = np.array(driver.execute_script("return v.rotation"))
    assert driver.execute_script("return v.state.tip") == [0, 0, 0] and before[0, 2] != 0
    dragged(keys.CONTROL, 0, 60)
    after = np.array(driver.execute_script("return v.rotation"))
    frame = {name: np.array(axis) for name, axis in driver.execute_script("return v.camera.frame()").items()}
    further = after @ before.T
    assert further @ frame["back"] @ frame["up"] == pytest.approx(-np.sin(np.pi * 60 / height), abs=1e-6)
    assert_allclose(further @ frame["right"], frame["right"], atol=1e-6)
    dragged(keys.CONTROL, 30, 0)
    turned = np.array(driver.execute_script("return v.rotation")) @ after.T
    assert_allclose(turned, turn_matrix(180 * 30 / height), atol=1e-6)
    webdriver.ActionChains(driver).send_keys(keys.ARROW_UP, "u").perform()
    assert driver.execute_script("return v.state.tip") == [0, 0, 0]
    assert driver.execute_script("return v.camera.state") == camera


def test_about_another_axis_the_light_stays(page):
    before = picture(page, "v.set({degrees: 70, tip: [20, 0, 10]})")
    page.execute_script(
        "const menu = document.getElementById('panel').elements.axis; menu.value = 'z';"
        "menu.dispatchEvent(new Event('input', { bubbles: true }))"
    )
    assert page.execute_script("return v.state.axis") == "z"
    assert np.abs(picture(page) - before).max() < 0.02
    assert np.abs(picture(page, "v.turn(60)") - before).mean() > 0.005


def test_colours_say_what_the_matrix_is_made_of(page, exported, artefact):
    """Each colouring shows what its legend says: colours of its own, those of Python at the vertices.

    Dense vertices are bright dots on dark surfaces; ranks go from dark to bright.
    """
    scene, transport, _, _ = exported
    made, order = colourings(transport), draw_order(scene).order
    pictures = {"radiance": picture(page)}
    for name in ("clusters", "rank", "dense"):
        pictures[name] = picture(page, "v.set({colours: arguments[0]}); v.held = false; v.touch()", name)
        page.execute_async_script(
            UNTIL, f"document.getElementById('legend').textContent === {made[name].legend!r}", 5000
        )
        assert page.find_element("id", "legend").text == made[name].legend
        sent = np.array(page.execute_script(f"return Array.from(v.scene.arrays.{name}Colours)")).reshape(
            -1, 3
        )
        assert np.array_equal(sent, made[name].colours[order])
        page.execute_script("v.held = true")
    figure, axes = panels(14, 4, 1, 4)
    for axis, (name, image) in zip(axes, pictures.items(), strict=True):
        axis.imshow(image)
        axis.set(title=name)
    artefact(figure, "colourings")
    for a, b in itertools.combinations(pictures, 2):
        assert np.abs(pictures[a] - pictures[b]).mean() > 0.02, (a, b)
    bright, dark = (
        (np.abs(pictures["dense"] - np.array(colour) / 255).max(axis=-1) < 0.1).mean()
        for colour in (DENSE, OTHERS)
    )
    assert bright > 0.002 and dark > 0.1, (bright, dark)
    options = page.find_elements("css selector", "select[name=colours] option")
    assert all(option.is_enabled() for option in options if option.get_attribute("value") != "error")


def test_light_of_the_page_is_the_projection(page):
    for k, (name, light) in enumerate(LIGHTS.items()):
        for how in TURNS:
            page.execute_script(
                "v.set({environment: arguments[0], ...arguments[1]}); v.relight('everything')", k, how
            )
            exact = LIGHTING.project(light.rotated(turn_matrix(**how)))
            assert relative_l2(array(page, "texels").reshape(-1, 3), exact) < 0.01, (name, how)
            wavelets = haar_colours(exact, np.sqrt(LIGHTING.solid_angles, dtype=np.float32))
            assert relative_l2(array(page, "light").reshape(-1, 3), wavelets) < 0.01
            assert_allclose(array(page, "light"), array(page, "approximation.applied"))


def test_turns_are_those_of_python(page):
    """Random states: their matrix. And the same light about another axis, or turned further about any direction."""
    rng, names = np.random.default_rng(4), ["x", "y", "z"]
    for k in range(12):
        how = {
            "degrees": float(rng.uniform(0, 360)),
            "axis": names[k % 3],
            "tip": [*map(float, rng.normal(size=3) * 80)],
        }
        before = turn_matrix(**how)
        found = page.execute_script("v.set(arguments[0]); return v.rotation", how)
        assert_allclose(found, before, atol=1e-9)
        split = page.execute_script("v.turnAbout(arguments[0]); return v.shown", names[(k + 1) % 3])
        assert split["axis"] == names[(k + 1) % 3]
        assert_allclose(turn_matrix(split["degrees"], split["axis"], split["tip"]), before, atol=1e-9)
        assert abs(split["tip"][(k + 1) % 3]) < 1e-6  # at right angles
        right = np.array(page.execute_script("return v.camera.frame().right"))
        page.execute_script("v.turn(17, 23)")
        further = turn_matrix(17, split["axis"]) @ turn_matrix(0, "y", 23 * right) @ before
        assert_allclose(page.execute_script("return v.rotation"), further, atol=1e-9)


def test_inverse_is_the_inverse(page):
    page.execute_script(
        "v.relight('everything'); w = new Float32Array(v.texels.length); v.cubemap.inverse(v.light, w)"
    )
    found = np.array(page.execute_script("return Array.from(w)"), np.float32)
    assert_allclose(found, array(page, "texels"), atol=1e-5)


@pytest.mark.parametrize(
    "method",
    ["per_band", *(pytest.param(m, marks=pytest.mark.slow) for m in ("non_incremental", "incremental"))],
)
def test_choices_and_sums_are_those_of_python(page, exported, method):
    made = exported[2]
    bands = wavelet_bands(LIGHTING.resolution, made.clusters.norms())
    approximation = {
        "non_incremental": NonIncremental(bands),
        "incremental": Incremental(bands),
        "per_band": PerBand(bands, exhaustive=False),
    }[method]
    player = ClusteredPlayer(made.clusters, approximation.groups)
    page.execute_script("v.set({budget: 40, method: arguments[0]})", method)
    for frame in range(5):
        how = "v.set({degrees: arguments[0]}); v.relight(...arguments[1])"
        page.execute_script(how, 12.0 * frame**1.5, [] if frame else ["everything"])
        light = array(page, "light").reshape(-1, 3)
        player.apply(approximation.update(light, 40 if frame else None))
        applied = array(page, "approximation.applied").reshape(-1, 3)
        assert np.mean((applied != approximation.applied).any(axis=1)) < 0.005  # sizes that are alike
        area = wavelet_bands(LIGHTING.resolution)
        ours = page.execute_script("return v.approximation.error(v.light)")
        assert ours == pytest.approx(weighted_error(approximation.applied, light, area), rel=0.02, abs=1e-6)
        total = array(page, "clusters.total").reshape(-1, 4)[:, :3]
        assert relative_l2(total, (applied.T @ made.clusters.columns).T) < 1e-4


def test_a_light_that_stands_still_is_exact(page):
    left_out = page.execute_script(
        "v.held = false; v.set({budget: 5, degrees: 10}); v.relight('everything');"
        "v.set({degrees: 100}); v.relight(); return v.approximation.error(v.light)"
    )
    assert left_out > 0.05
    page.execute_async_script(UNTIL, "v.exact", 5000)  # frames go on by themselves
    assert page.execute_script("return v.approximation.error(v.light)") == 0
    fresh = "v.clusters.sums.forEach((s) => s.fill(0)); v.approximation.applied.fill(0)"
    kept = array(page, "clusters.total")
    page.execute_script(fresh + "; v.relight('everything')")
    assert relative_l2(kept, array(page, "clusters.total")) < 1e-6


def test_a_dropped_image_is_used(page, exported, tmp_path):
    light = sky(5)
    assert page.execute_async_script(DROP, "own.hdr", list(radiance_file(light.pixels))) == ""
    ours = picture(page)
    theirs = prt.render(exported[0], exported[1], light, 0, 64, progress=False)
    assert flip_map(np.clip(theirs, 0, 1), linear(ours)).mean() < FLIP
    mi.Bitmap(light.pixels).write(str(tmp_path / "runs.hdr"))  # Mitsuba's are runs
    assert page.execute_async_script(DROP, "runs.hdr", list((tmp_path / "runs.hdr").read_bytes())) == ""
    assert np.abs(picture(page) - ours).mean() < 0.004
    for name, content, words in (
        ("a.exr", b"", "only .hdr"),
        ("a.hdr", b"nothing", "first line"),
        ("a.hdr", radiance_file(light.pixels)[:-9], "ends too early"),
        ("a.hdr", radiance_file(light.pixels[:, :9]), "twice as wide"),
    ):
        assert words in page.execute_async_script(DROP, name, list(content))
    assert page.execute_script("return v.environments.length") == 4


def test_a_link_shows_the_same(page, exported):
    moved = picture(
        page,
        "v.set({environment: 1, degrees: 200, axis: 'z', tip: [60, -20, 5], exposure: 0.5}); v.camera.orbit(0.4, 0.1)",
    )
    address = page.execute_script("return '#' + v.address")
    open_page(page, exported[3].as_uri() + address)
    assert np.abs(picture(page) - moved).mean() < 0.002  # five digits of the camera's place


def test_a_film_is_recorded(page):
    """While the light turns. Expected: WebM by its first bytes, and frames in it."""
    head = page.execute_async_script(
        """
        const done = arguments[0];
        v.held = false;
        const bytes = async (film) => [...new Uint8Array(await film.arrayBuffer())];
        v.recorder.ended = async (film) => done([film.type, film.size, (await bytes(film)).slice(0, 4)]);
        v.recorder.toggle();
        v.playing = true;
        v.touch();
        setTimeout(() => { v.playing = false; v.recorder.toggle(); }, 1500);
        """
    )
    assert head[0].startswith("video/webm") and head[1] > 5000 and head[2] == [0x1A, 0x45, 0xDF, 0xA3]
    assert page.execute_script("return v.recorder.recording") is None


def test_a_lost_context_comes_back(page):
    before = picture(page)
    page.execute_script(
        "v.held = false; w = v.picture.gl.getExtension('WEBGL_lose_context'); w.loseContext()"
    )
    page.execute_async_script(
        "const done = arguments[0]; setTimeout(() => { w.restoreContext(); setTimeout(done, 800); }, 300)"
    )
    assert np.abs(picture(page) - before).max() < 0.01


def test_a_notebook_shows_the_page(page, exported, tmp_path):
    """In a frame, as Jupyter puts it into a cell's output."""
    notebook = tmp_path / "notebook.html"
    notebook.write_text(f"<!doctype html><meta charset='utf-8'>{exported[2]._repr_html_()}")
    page.get(notebook.as_uri())
    page.switch_to.frame(page.find_element("tag name", "iframe"))
    wait = "const done = arguments[0]; window.viewer.then((viewer) => { window.v = viewer; done(); });"
    page.execute_async_script(wait)
    page.execute_async_script(UNTIL, "v.exact", 5000)
    page.execute_script("v.pinned = v.held = true; v.resize(...arguments);", *SIZE)
    assert np.ptp(picture(page)) > 0.5
    page.switch_to.default_content()


def test_without_webgl_there_is_a_sentence(exported):
    opened = browser("--disable-3d-apis")
    try:
        opened.get(exported[3].as_uri())
        opened.execute_async_script("const done = arguments[0]; window.viewer.then(() => done());")
        assert "WebGL 2" in opened.find_element("id", "sentence").text
    finally:
        opened.quit()
