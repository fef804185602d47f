"""Makes docs/images/lamps.jpg, room.jpg and pixels.jpg: other columns and other rows of T, beside Mitsuba's ``path``.

``python docs/lamps_and_pixels.py`` from the root of the repository. It takes some minutes.
"""

from __future__ import annotations

from pathlib import Path
from time import perf_counter
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

import mi_sparse_prt as prt

ROOT = Path(__file__).parents[1]
IMAGES = ROOT / "docs" / "images"
T = mi.ScalarTransform4f
DEPTH = 5

Image = NDArray[np.float32]


def main() -> None:
    """All pictures."""
    draw_lamps()
    draw_room()
    draw_pixels()


def draw_lamps() -> None:
    """Each lamp of a room alone, all of them, and what Mitsuba renders."""
    lit = mi.load_dict(room(), optimize=False)
    scene = prt.Scene.from_mitsuba(lit, 0.03)
    lamps = prt.SceneEmitters(scene)
    transport = prt.precompute(scene, lamps, max_depth=DEPTH, progress=False)
    print(f"{scene.n_vertices} vertices x {lamps.size} lamps, {transport.report['seconds']['total']:.1f} s")
    print(f"held-out estimate {transport.report['estimated_error']['total']:.2%}")
    images = {name: prt.render(scene, transport, {name: 1.0}, spp=64, progress=False) for name in lamps.names}
    images["all"] = prt.render(scene, transport, 1.0, spp=64, progress=False)
    images["Mitsuba path"], noise = reference(lit, lit.sensors()[0])
    compare("lamps", images["all"], images["Mitsuba path"], noise)
    draw(images, np.percentile(images["all"], 98), IMAGES / "lamps.jpg")


def draw_room() -> None:
    """The room by ``sparse_prt``, and again with its panel at a tenth, beside Mitsuba."""
    lit = mi.load_dict(room(), optimize=False)
    integrator = mi.load_dict({"type": "sparse_prt", "max_depth": DEPTH, "progress": False})
    parameters, images = mi.traverse(lit), {}
    for light in ("as authored", "dimmed"):
        start = perf_counter()
        mi.render(lit, integrator=integrator, spp=4)
        print(f"{light}: {perf_counter() - start:.1f} s with 4 samples per pixel")
        image = np.array(mi.render(lit, integrator=integrator, spp=1024, seed=5))[..., :3]
        truth, noise = reference(lit, lit.sensors()[0])
        compare(light, image, truth, noise)
        images |= {f"sparse_prt, {light}": image, f"path, {light}": truth}
        images[f"10 x error, {light}"] = 10 * np.abs(image - truth)
        parameters["panel.emitter.radiance.value"] *= 0.1
        parameters.update()
    draw(images, np.percentile(images["path, as authored"], 98), IMAGES / "room.jpg")


def draw_pixels() -> None:
    """A textured model by interpolation between vertices, by rows at the pixels, and by Mitsuba."""
    scene = prt.load_scene(ROOT / "scenes_xml" / "spot.xml", width=160, height=120)
    lighting, light = prt.CubemapLighting(16), prt.load_environment(ROOT / "scenes_xml/envmaps/studio.exr")
    texels = lighting.project(light)
    images = {}
    for name, measurement in (("vertices", None), ("pixels", prt.camera_pixels(scene, spp=16))):
        transport = prt.precompute(
            scene, lighting, basis="texel", measurement=measurement, max_depth=DEPTH, progress=False
        )
        seconds, size = transport.report["seconds"]["total"], transport.nbytes / 1e6
        print(f"{name}: {transport.shape}, {seconds:.1f} s, {size:.0f} MB")
        images[f"rows at {name}"] = prt.render(scene, transport, texels, spp=64, progress=False)
    with lighting.scene_lit_by(texels, scene) as lit:
        images["Mitsuba path"], noise = reference(lit, scene.sensor(0))
    for name in ("rows at vertices", "rows at pixels"):
        compare(name, images[name], images["Mitsuba path"], noise)
    draw(images, np.percentile(images["Mitsuba path"], 98), IMAGES / "pixels.jpg")


def room() -> dict[str, Any]:
    """Walls, a floor and a ball under a panel, a bulb, a spot and a dim sky."""

    def wall(axis: list[float], angle: float, place: list[float], colour: list[float]) -> dict[str, Any]:
        bsdf = {"type": "diffuse", "reflectance": {"type": "rgb", "value": colour}}
        return {"type": "rectangle", "to_world": T().translate(place).rotate(axis, angle), "bsdf": bsdf}

    def rgb(*values: float) -> dict[str, Any]:
        return {"type": "rgb", "value": list(values)}

    grey = {"type": "diffuse", "reflectance": 0.5}
    return {
        "type": "scene",
        "floor": wall([1, 0, 0], -90, [0, -1, 0], [0.7, 0.7, 0.7]),
        "back": wall([1, 0, 0], 0, [0, 0, -1], [0.7, 0.7, 0.7]),
        "left": wall([0, 1, 0], 90, [-1, 0, 0], [0.7, 0.1, 0.1]),
        "right": wall([0, 1, 0], -90, [1, 0, 0], [0.1, 0.6, 0.1]),
        "ball": {"type": "sphere", "center": [0.2, -0.6, 0], "radius": 0.4, "bsdf": grey},
        "panel": {
            "type": "rectangle",
            "to_world": T().translate([0, 0.9, 0]).rotate([1, 0, 0], 90).scale(0.3),
            "bsdf": {"type": "diffuse", "reflectance": 0.2},
            "emitter": {"type": "area", "radiance": rgb(8, 7, 5)},
        },
        "bulb": {"type": "point", "position": [-0.5, 0.2, 0.3], "intensity": rgb(0.2, 0.3, 1.0)},
        "spot": {
            "type": "spot",
            "to_world": T().look_at([0.5, 0.9, 0.8], [0.2, -0.6, 0], [0, 1, 0]),
            "intensity": rgb(2, 0.6, 0.6),
        },
        "sky": {"type": "constant", "radiance": rgb(0.2, 0.2, 0.24)},
        "camera": {
            "type": "perspective",
            "fov": 40,
            "to_world": T().look_at([0, 0, 3.5], [0, 0, 0], [0, 1, 0]),
            "film": {"type": "hdrfilm", "width": 240, "height": 240},
        },
    }


def reference(scene: mi.Scene, sensor: mi.Sensor) -> tuple[Image, float]:
    """Mitsuba's image, and its relative noise from two halves."""
    path = mi.load_dict({"type": "path", "max_depth": DEPTH})
    halves = [
        np.array(mi.render(scene, sensor=sensor, integrator=path, spp=1024, seed=k))[..., :3] for k in (1, 2)
    ]
    mean = (halves[0] + halves[1]) / 2
    return mean, float(np.linalg.norm(halves[0] - halves[1]) / 2 / np.linalg.norm(mean))


def compare(name: str, image: Image, true: Image, noise: float) -> None:
    """Print what an image and the reference differ by."""
    error = np.linalg.norm(image - true) / np.linalg.norm(true)
    print(f"{name}: mean {image.mean() / true.mean():.4f}, relative L2 {error:.2%}, of it noise {noise:.2%}")


def draw(images: dict[str, Image], white: float, output: Path) -> None:
    """Side by side, exposed alike."""
    height, width = next(iter(images.values())).shape[:2]
    size = 2 * len(images), 2 * height / width + 0.3
    figure, panels = plt.subplots(1, len(images), figsize=size, layout="constrained")
    for axes, (name, image) in zip(panels, images.items(), strict=True):
        axes.imshow(np.clip(image / white, 0, 1) ** (1 / 2.2), interpolation="antialiased")
        axes.set_title(name, fontsize=9)
        axes.axis("off")
    figure.savefig(output, dpi=120, pil_kwargs={"quality": 90})


if __name__ == "__main__":
    main()
