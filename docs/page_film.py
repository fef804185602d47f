"""A film of a page whose light turns, as the README shows it.

mi-sparse-prt view bunny.prt --export bunny.html
python docs/page_film.py bunny.html images/viewer.webp
"""

from __future__ import annotations

import argparse
import io
from pathlib import Path

from page_speed import opened
from PIL import Image

FRAMES, DEGREES, MILLISECONDS = 36, 10, 90
SIZE = "--window-size=1060,700"
TURN = """
const [degrees, environment, done] = arguments;
v.set({ degrees, environment, exposure: -0.7, method: "per_band", budget: 100 });
requestAnimationFrame(() => requestAnimationFrame(() => setTimeout(done, 400)));
"""


def main() -> None:
    """Turn the light and take a picture of each step."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("page", type=Path, metavar="PAGE.html")
    parser.add_argument("film", type=Path, metavar="FILM.webp")
    options = parser.parse_args()
    frames = []
    with opened(options.page, SIZE) as driver:
        lights = driver.execute_script("return v.environments.length")
        for frame in range(FRAMES):
            light = min(frame * 3 // FRAMES, lights - 1)
            driver.execute_async_script(TURN, DEGREES * frame, light)
            frames.append(Image.open(io.BytesIO(driver.get_screenshot_as_png())).convert("RGB"))
    first, *others = frames
    first.save(
        options.film, save_all=True, append_images=others, duration=MILLISECONDS, loop=0, quality=70, method=6
    )
    print(f"{options.film}: {options.film.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
