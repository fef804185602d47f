"""Pages in headless Chromium, whose WebGL is a software renderer: what tests of them share."""

import base64
import shutil

import mitsuba as mi
import numpy as np
import pytest

import mi_sparse_prt as prt

webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed: bash .ci/setup")
BROWSER, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
MARKS = [
    pytest.mark.browser,
    pytest.mark.skipif(not (BROWSER and DRIVER), reason="no chromium or chromedriver: apt-get install both"),
]
SIZE = 320, 240  # pixels of a picture


def sky(seed: int, height: int = 64) -> prt.Environment:
    """A gradient with a few soft lamps."""
    rng = np.random.default_rng(seed)
    theta = np.pi * (np.arange(height) + 0.5) / height
    phi = np.pi * (np.arange(2 * height) + 0.5) / height
    d = np.stack(
        np.broadcast_arrays(
            np.sin(theta)[:, None] * np.sin(phi),
            np.cos(theta)[:, None],
            -np.sin(theta)[:, None] * np.cos(phi),
        ),
        axis=-1,
    )
    pixels = np.full((*d.shape[:2], 3), 0.1) + 0.4 * np.maximum(d[..., 1:2], 0) * [0.5, 0.7, 1.0]
    for _ in range(4):
        towards = rng.normal(size=3) + [0, 0.8, 0]
        lobe = np.exp(20 * (d @ (towards / np.linalg.norm(towards)) - 1))
        pixels += lobe[..., None] * rng.uniform(0.5, 2, 3)
    return prt.Environment(pixels.astype(np.float32))


def browser(*arguments: str):
    options = webdriver.ChromeOptions()
    options.binary_location = BROWSER
    for argument in ("--headless=new", "--no-sandbox", "--enable-unsafe-swiftshader", *arguments):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options, webdriver.ChromeService(DRIVER))
    driver.set_script_timeout(60)
    return driver


def open_page(driver, address: str) -> None:
    """The viewer is ``v`` then, and frames are made by tests."""
    assert opens(driver, address)
    driver.execute_script("v.pinned = v.held = true; v.resize(...arguments);", *SIZE)


def opens(driver, address: str) -> bool:
    """Whether a page has what it needs; what it makes of itself is ``v`` then."""
    driver.get("about:blank")
    driver.get(address)
    return driver.execute_async_script(
        "const done = arguments[0]; window.viewer.then((viewer) => { window.v = viewer; done(viewer !== null); });"
    )


def picture(driver, script: str = "", *arguments) -> np.ndarray:
    """Pixels (height, width, 3) in sRGB, 0 to 1, after a script."""
    text = driver.execute_script(
        script
        + "; if (v.changed) v.relight('everything'); v.draw(true); return v.picture.canvas.toDataURL('image/png');",
        *arguments,
    )
    return pixels_of(text)


def pixels_of(text: str) -> np.ndarray:
    """Pixels (height, width, 3) of a PNG (data:), 0 to 1."""
    stream = mi.MemoryStream()
    stream.write(base64.b64decode(text.split(",")[1]))
    stream.seek(0)
    return np.array(mi.Bitmap(stream))[..., :3].astype(np.float32) / 255


def linear(srgb: np.ndarray) -> np.ndarray:
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4).astype(np.float32)


def radiance_file(pixels: np.ndarray) -> bytes:
    """An .hdr file with rows that are not runs."""
    mantissa, exponent = np.frexp(pixels.max(axis=-1))
    scale = np.where(mantissa > 0, 256 * mantissa / np.maximum(pixels.max(axis=-1), 1e-30), 0)
    rgbe = np.concatenate([pixels * scale[..., None], exponent[..., None] + 128], axis=-1).astype(np.uint8)
    head = f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {pixels.shape[0]} +X {pixels.shape[1]}\n"
    return head.encode() + rgbe.tobytes()


UNTIL = """
const [what, milliseconds, done] = arguments, test = new Function("return " + what), start = performance.now();
const look = () => (test() || performance.now() - start > milliseconds ? done() : setTimeout(look, 20));
look();
"""


DROP = """
const [name, bytes, done] = arguments, transfer = new DataTransfer();
transfer.items.add(new File([new Uint8Array(bytes)], name));
document.dispatchEvent(new DragEvent("drop", { dataTransfer: transfer }));
setTimeout(() => done(document.getElementById("sentence").textContent), 500);
"""
