"""The light mixer in a browser (headless Chromium, WebGL by its software renderer), against Python's sums."""

import threading

import numpy as np
import pytest
from pages_in_browser import MARKS, UNTIL, browser, opens, pixels_of

import mi_sparse_prt as prt
from mi_sparse_prt.cli.files import srgb_pixels
from mi_sparse_prt.relighting.viewer import make_mixer
from mi_sparse_prt.relighting.viewer.server import PageServer

pytestmark = MARKS
NAMES = ("window", "lamp <left>", "lamp/right & more", "bulb")
HEIGHT, WIDTH = 300, 400


def layers() -> dict[str, np.ndarray]:
    """Smooth light with noise, a thousandth to a hundred; one lamp is seen, and one is bright."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:HEIGHT, :WIDTH] / HEIGHT
    found = {}
    for k, name in enumerate(NAMES):
        smooth = np.exp(-4 * np.hypot(x - 0.3 * k, y - 0.2 * k))[..., None] * rng.uniform(0.2, 1, 3)
        found[name] = (smooth * rng.uniform(0.5, 1.5, smooth.shape)).astype(np.float32)
    found["window"][:20, :30] = 100
    found["bulb"] *= 1e5
    return found


LAYERS = layers()
PICTURE = prt.ManyLightsImage(np.asarray(sum(LAYERS.values())), np.ones((HEIGHT, WIDTH)), LAYERS, {})


@pytest.fixture(scope="module")
def driver():
    opened = browser()
    yield opened
    opened.quit()


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("mixer") / "mixer.html"
    make_mixer(LAYERS, "mixer").save(path)
    return path


@pytest.fixture
def page(driver, file):
    """The page, just opened from disk."""
    assert opens(driver, file.as_uri())
    yield driver
    wrong = [entry["message"] for entry in driver.get_log("browser") if entry["level"] == "SEVERE"]
    assert wrong == []


def seen(driver, script: str = "", *arguments) -> np.ndarray:
    drawn = "; v.draw(); return v.picture.canvas.toDataURL('image/png')"
    return pixels_of(driver.execute_script(script + drawn, *arguments))


def assert_shows(picture: np.ndarray, expected: np.ndarray, exposure: float = 0.0) -> None:
    """Pixels are those of a linear picture, within 1/255, and it is neither black nor white."""
    theirs = srgb_pixels(expected, exposure).astype(np.float32) / 255
    assert theirs.std() > 0.02
    assert np.abs(picture - theirs).max() <= 1.01 / 255


def linear_colour(text: str) -> np.ndarray:
    srgb = np.array([int(text[k : k + 2], 16) for k in (1, 3, 5)]) / 255
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


SET = "arguments[0].forEach((lamp, k) => v.set(k, lamp)); v.expose(arguments[1])"


def test_pictures_are_the_sums_of_python(page) -> None:
    """Random intensities, colours and exposures. Expected: within 1/255 of the sum that Python shows as sRGB."""
    rng = np.random.default_rng(1)
    dim = {"bulb": -17.0}
    for _ in range(6):
        stops = {name: float(rng.uniform(-3, 3)) + dim.get(name, 0) for name in NAMES}
        colours = {name: f"#{rng.integers(1 << 24):06x}" for name in NAMES}
        exposure = float(rng.uniform(-1, 1))
        lamps = [{"stops": stops[name], "colour": colours[name]} for name in NAMES]
        weights = {name: linear_colour(colours[name]) * 2 ** stops[name] for name in NAMES}
        found = seen(page, SET, lamps, exposure)
        assert_allclose_weights(page, weights)
        assert_shows(found, PICTURE.mixed(weights), exposure)


def assert_allclose_weights(driver, weights: dict[str, np.ndarray]) -> None:
    """What the button `weights` saves is what ``mixed`` takes."""
    found = driver.execute_script("return v.weights")
    np.testing.assert_allclose(found, [weights[name] for name in NAMES], rtol=1e-6)


def test_solo_and_off(page) -> None:
    assert_shows(seen(page, "v.expose(-18)"), PICTURE.mixed({}), -18)
    without = PICTURE.mixed({"bulb": 0})
    assert_shows(seen(page, "v.expose(0); v.set(3, {on: false})"), without)
    assert_shows(seen(page, "v.set(1, {solo: true})"), LAYERS["lamp <left>"])
    both = LAYERS["lamp <left>"] + LAYERS["window"]
    assert_shows(seen(page, "v.set(0, {solo: true})"), both)
    assert_shows(seen(page, "v.set(3, {solo: true})"), both)  # it is off
    assert_shows(
        seen(page, "v.set(0, {solo: false}); v.set(1, {solo: false}); v.set(3, {solo: false})"), without
    )
    assert seen(page, "v.lamps.forEach((_, k) => v.set(k, {on: false}))").max() == 0
    assert_shows(seen(page, "v.reset(); v.expose(-18)"), PICTURE.mixed({}), -18)


def row(driver, name: str):
    """The controls of a lamp."""
    rows = driver.find_elements("css selector", "fieldset")
    return next(r for r in rows if r.find_element("css selector", "span").text == name)


def test_controls_and_the_address(page, file) -> None:
    """A person's clicks and drags change what is seen; the address keeps it, and nothing that is as rendered."""
    names = [
        r.find_element("css selector", "span").text for r in page.find_elements("css selector", "fieldset")
    ]
    assert names == [*NAMES]
    left = row(page, "lamp <left>")
    row(page, "bulb").find_element("name", "on").click()
    left.find_element("name", "solo").click()
    moved = (
        "arguments[0].value = arguments[1]; arguments[0].dispatchEvent(new Event('input', { bubbles: true }))"
    )
    page.execute_script(moved, left.find_element("name", "stops"), 1.5)
    page.execute_script(moved, left.find_element("name", "colour"), "#80ff40")
    page.execute_script(moved, page.find_element("name", "exposure"), -0.5)
    expected = LAYERS["lamp <left>"] * (2**1.5 * linear_colour("#80ff40"))
    assert_shows(seen(page), expected, -0.5)
    page.execute_async_script(UNTIL, "location.hash.includes('exposure=-0.5')", 5000)
    assert left.find_element("css selector", "output").text == "+1.5"
    address = page.current_url
    assert address.count("lamp.") == 2 and "window" not in address
    assert opens(page, address)
    assert_shows(seen(page), expected, -0.5)
    page.execute_async_script(UNTIL, "document.querySelectorAll('.dark').length === 3", 5000)
    page.find_element("name", "reset").click()
    assert page.execute_script("return [v.address, v.exposure]") == ["", 0]
    assert opens(page, file.as_uri() + "#exposure=much&lamp.bulb=1_zz_on_mixed&lamp.none=1")
    assert page.execute_script("return v.address") == ""


def test_a_change_takes_milliseconds(page) -> None:
    """From a change to a pixel that shows it, 400 x 300 and four layers, without a graphics card: below 50 ms.

    A quarter of the changes has to: others may have had to wait for a processor.
    """
    times = np.array(page.execute_script(CHANGES))
    print(f"a change takes {np.median(times):.1f} ms (median), {times.min():.1f} to {times.max():.1f} ms")
    assert np.quantile(times, 0.25) < 50


CHANGES = """
const { gl } = v.picture, times = [];
for (let k = 0; k < 30; k++) {
  const start = performance.now();
  v.set(k % 4, { stops: (k % 7) - 3 });
  v.draw();
  gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
  times.push(performance.now() - start);
}
return times;
"""


def test_a_lost_context_comes_back(page) -> None:
    page.execute_script(
        "v.set(3, {on: false}); window.lost = v.picture.gl.getExtension('WEBGL_lose_context')"
    )
    page.execute_script("lost.loseContext()")
    page.execute_async_script(UNTIL, "v.picture.gl.isContextLost()", 5000)
    page.execute_script("setTimeout(() => lost.restoreContext(), 50)")
    page.execute_async_script(UNTIL, "!v.picture.gl.isContextLost()", 5000)
    page.execute_async_script("requestAnimationFrame(() => requestAnimationFrame(arguments[0]))")
    assert_shows(seen(page), PICTURE.mixed({"bulb": 0}))


def test_it_is_served_as_well(driver) -> None:
    with PageServer(make_mixer(LAYERS).text.encode()) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        assert opens(driver, server.url)
        assert_shows(seen(driver, "v.set(3, {on: false})"), PICTURE.mixed({"bulb": 0}))
        server.shutdown()


def test_more_lamps_than_the_card_can_mix(driver, tmp_path) -> None:
    many = {f"lamp {k}": np.full((1, 1, 3), 1e-4, np.float32) for k in range(2049)}
    make_mixer(many).save(tmp_path / "many.html")
    assert not opens(driver, (tmp_path / "many.html").as_uri())
    sentence = driver.find_element("id", "sentence").text
    assert sentence == "2049 lamps are more than the 2048 that this graphics card can mix."
