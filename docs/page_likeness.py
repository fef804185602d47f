"""FLIP of a page's pictures against those of ``prt.render``: same matrix, lights and views.

    python docs/page_likeness.py scenes_xml/bunny.xml bunny.prt --figures DIRECTORY

Prints JSON: for each environment of the page the mean FLIP of three views, each under a light turned otherwise, at
640 x 480 and 64 samples per pixel. Surfaces that the page draws plain are not left out. Pictures of both are
written beside each other.
"""

from __future__ import annotations

import argparse
import base64
import json
import tempfile
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from page_speed import opened

import mi_sparse_prt as prt
from mi_sparse_prt.benchmark.gallery import images_beside
from mi_sparse_prt.benchmark.relit_reference import environments_of
from mi_sparse_prt.core.metrics import flip_map
from mi_sparse_prt.relighting.viewer import make_page
from mi_sparse_prt.relighting.viewer.question import page_sensor
from mi_sparse_prt.relighting.viewer.turning import turn_matrix

SIZE = 640, 480
SPP = 64
VIEWS = ((0.0, 0.0, 0.0), (0.7, 0.2, 100.0), (2.5, -0.1, 220.0))  # orbit in radians, degrees of the light
DRAW = """
v.pinned = v.held = true;
v.resize(arguments[0], arguments[1]);
v.set({ environment: arguments[2], degrees: arguments[3] });
v.camera.orbit(arguments[4], arguments[5]);
v.relight("everything");
v.draw(true);
const { eye, target, up, height } = v.camera;
return { eye, target, up, height, ...v.shown, picture: v.picture.canvas.toDataURL("image/png") };
"""

Image = NDArray[np.float32]


def drawn(text: str) -> Image:
    """Linear pixels of a PNG (data:)."""
    stream = mi.MemoryStream()
    stream.write(base64.b64decode(text.split(",")[1]))
    stream.seek(0)
    srgb = np.array(mi.Bitmap(stream))[..., :3].astype(np.float32) / 255
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4).astype(np.float32)


def compare(scene: prt.Scene, transport: prt.LightTransport, folder: Path | None) -> dict[str, Any]:
    """FLIP of each environment and view."""
    lights, found = environments_of(scene), dict[str, list[float]]()
    with tempfile.TemporaryDirectory() as temporary:
        page = Path(temporary) / "page.html"
        make_page(scene, transport, lights).save(page)
        for number, name in enumerate(lights):
            found[name] = []
            for around, over, degrees in VIEWS:
                with opened(page) as driver:  # each from the first view
                    view = driver.execute_script(DRAW, *SIZE, number, degrees, around, over)
                assert view["light"] == name
                sensor = page_sensor(view | {"columns": SIZE[0], "rows": SIZE[1]})
                light = lights[name].rotated(turn_matrix(view["degrees"], view["axis"], view["tip"]))
                ours = drawn(view["picture"])
                # a screen shows no more than 1
                theirs = np.clip(prt.render(scene, transport, light, sensor, SPP), 0, 1)
                found[name].append(float(flip_map(theirs, ours).mean()))
                if folder is not None:
                    beside = images_beside({"page": ours, "render": theirs}, theirs)
                    beside.savefig(folder / f"{name}_{len(found[name])}.png")
    return {"scene": scene.path, "flip": found, "worst": max(max(each) for each in found.values())}


def main() -> None:
    """Compare and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("scene", metavar="SCENE.xml")
    parser.add_argument("matrix", metavar="MATRIX.prt")
    parser.add_argument("--figures", type=Path, metavar="DIRECTORY")
    asked = parser.parse_args()
    if asked.figures:
        asked.figures.mkdir(parents=True, exist_ok=True)
    scene, transport = prt.load_scene(asked.scene), prt.load_transport(asked.matrix)
    if "compressed" not in transport.operators:
        transport = prt.compress(transport)
    print(json.dumps(compare(scene, transport, asked.figures), indent=1))


if __name__ == "__main__":
    main()
