"""Milliseconds of a page's frames in headless Chromium, whose WebGL is a software renderer: the slowest there is.

    mi-sparse-prt view bunny.prt --export bunny.html
    python docs/page_speed.py bunny.html

Prints JSON, medians of 15. ``script``: all that JavaScript does in a frame of a light that turns, by PBI and 30
wavelets; ``frame``: the same with its picture (640 x 480), until one of its pixels is read; ``colours``, ``surfaces and
background``, ``background``, ``smooth``: parts of it. Nothing else should run beside it.
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
const draw = (smooth) => () => { v.draw(smooth); read(); };
v.pinned = v.held = true;
v.resize(640, 480);
v.relight("everything");
draw(false)();
const result = { vertices: v.scene.vertices, script: median(turn), frame: median((k) => { turn(k); draw(false)(); }) };
result.colours = median(() => {
  v.picture.relight(v.clusters.total);
  gl.bindFramebuffer(gl.FRAMEBUFFER, v.picture.target);
  gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.FLOAT, values);
  gl.bindFramebuffer(gl.FRAMEBUFFER, null);
});
result["surfaces and background"] = median(draw(false));
result.smooth = median(draw(true));
const { meshes } = v.scene;
v.scene.meshes = [];
result.background = median(draw(false));
v.scene.meshes = meshes;
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
