"""Milliseconds of a page's frames in headless Chromium, whose WebGL is a software renderer: the slowest there is.

    mi-sparse-prt view bunny.prt --export bunny.html
    python docs/page_speed.py bunny.html

Prints JSON, medians of 15 frames, after 30 of a light that turns: browsers compile what runs often. ``script``: all
that JavaScript does in a frame of a light that turns, by PBI and 30 wavelets; ``light``: the same with its picture
(640 x 480), until one of its pixels is read; ``view``: a frame of a camera that moves; ``still``: one that becomes
smooth; ``colours`` of vertices and ``pixels`` are parts of these.
Nothing else should run beside it.
"""

from __future__ import annotations

import argparse
import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from selenium import webdriver

MEASURE = """
const gl = v.picture.gl, pixel = new Uint8Array(4), values = new Float32Array(4);
const median = (work) => {
  const times = Array.from({ length: 15 }, (_, k) => {
    const start = performance.now();
    work(k);
    return performance.now() - start;
  });
  return times.sort((a, b) => a - b)[7];
};
const turn = (k) => { v.set({ degrees: 3 * k, budget: 30, method: "per_band" }); v.relight(); };
const read = () => gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
const draw = () => { v.draw(); read(); };
v.pinned = v.held = true;
v.resize(640, 480);
v.relight("everything");
for (let k = 0; k < 30; k++) {
  turn(k);
  draw();
}
const result = { vertices: v.scene.vertices, script: median(turn), light: median((k) => { turn(k); draw(); }) };
result.view = median(() => { v.camera.orbit(1e-3, 0); draw(); });
result.still = median((k) => { v.picture.addSample(v.drawn, k); read(); });
result.colours = median(() => {
  v.picture.relight(v.clusters.total);
  gl.bindFramebuffer(gl.FRAMEBUFFER, v.picture.colours);
  gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.FLOAT, values);
  gl.bindFramebuffer(gl.FRAMEBUFFER, null);
});
draw();
result.pixels = median(draw);
return result;
"""
OPEN = "const done = arguments[0]; window.viewer.then((viewer) => { window.v = viewer; done(viewer !== null); });"


@contextmanager
def opened(page: Path, *arguments: str) -> Iterator[webdriver.Chrome]:
    """A browser that shows a page, whose viewer scripts find as ``v``."""
    options = webdriver.ChromeOptions()
    options.binary_location = str(shutil.which("chromium"))
    for argument in ("--headless=new", "--no-sandbox", "--enable-unsafe-swiftshader", *arguments):
        options.add_argument(argument)
    driver = webdriver.Chrome(options, webdriver.ChromeService(shutil.which("chromedriver")))
    try:
        driver.get(page.resolve().as_uri())
        if not driver.execute_async_script(OPEN):
            raise SystemExit(driver.find_element("id", "sentence").text)
        yield driver
    finally:
        driver.quit()


def main() -> None:
    """Open the page and measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("page", type=Path, metavar="PAGE.html")
    with opened(parser.parse_args().page) as driver:
        print(json.dumps(driver.execute_script(MEASURE), indent=1))


if __name__ == "__main__":
    main()
