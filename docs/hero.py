"""Makes images/hero.jpg: one matrix under two environments, beside Mitsuba's ``path``; prints what they differ by.

The reference is lit by the environment's image itself, not by its projection to the cubemap. Errors are relative L2
over the pixels that show the scene.

``python docs/hero.py`` from the root of the repository. It takes some minutes.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

import mi_sparse_prt as prt

ROOT = Path(__file__).parents[1]
HALVES = 2  # of the reference, independent of each other: their product has no noise on average


def main() -> None:
    """Precompute, relight twice, render twice."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", default="spot")
    parser.add_argument("--lights", nargs=2, default=["forest:216", "studio:0"], help="NAME:DEGREES, twice")
    parser.add_argument("--target-error", type=float, default=0.01)
    parser.add_argument("--spp", type=int, default=1024, help="of each half of the reference")
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--output", type=Path, default=ROOT / "images" / "hero.jpg")
    options = parser.parse_args()

    scene = prt.load_scene(
        ROOT / "scenes_xml" / f"{options.scene}.xml", width=options.width, height=options.width * 3 // 4
    )
    transport = prt.precompute(
        scene, prt.CubemapLighting(32), basis="texel", target_error=options.target_error, progress=False
    )
    report = transport.report
    print(f"{scene.n_vertices} vertices, {report['plan']}, {report['seconds']['total']:.1f} s")
    print(f"held-out estimate {report['estimated_error']['total']:.2%}")

    seen = np.array(mi.render(lit_scene(scene, {"type": "depth"}, {"type": "constant"}), spp=16))[..., :1] > 0
    rows = []
    for name, degrees in (light.split(":") for light in options.lights):
        image = ROOT / "scenes_xml" / "envmaps" / f"{name}.exr"
        relit = prt.render(
            scene, transport, prt.load_environment(image).rotated(float(degrees)), spp=64, progress=False
        )
        emitter = {
            "type": "envmap",
            "filename": str(image),
            "to_world": mi.ScalarTransform4f().rotate([0, 1, 0], float(degrees)),
        }
        lit = lit_scene(scene, {"type": "path", "max_depth": 5}, emitter)
        halves = [np.array(mi.render(lit, spp=options.spp, seed=k))[..., :3] for k in range(HALVES)]
        error, noise = difference(relit * seen, [half * seen for half in halves])
        print(f"{name}: relative L2 {error:.2%}; noise of the reference {noise:.2%}")
        rows.append((relit, np.mean(halves, axis=0)))
    draw(rows, HALVES * options.spp, options.output)


def lit_scene(scene: prt.Scene, integrator: dict[str, Any], light: dict[str, Any]) -> mi.Scene:
    """The scene's shapes and camera with another integrator and light."""
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": integrator,
            "sensor": scene.mitsuba.sensors()[0],
            "light": light,
            **{f"shape_{k}": shape for k, shape in enumerate(scene.mitsuba.shapes())},
        }
    )


def difference(relit: NDArray[np.float32], halves: list[NDArray[np.float32]]) -> tuple[float, float]:
    """Relative L2 of an image (h, w, 3) without the reference's noise, and that noise."""
    x, y = halves
    squares = np.mean(x * y)
    return (
        float(np.sqrt(max(0.0, np.mean((relit - x) * (relit - y)) / squares))),
        float(np.sqrt(np.mean((x - y) ** 2) / 4 / squares)),
    )


def draw(rows: list[tuple[NDArray[np.float32], NDArray[np.float32]]], spp: int, output: Path) -> None:
    """Two pictures of each light; both are exposed alike."""
    height, width = rows[0][0].shape[:2]
    figure, panels = plt.subplots(
        len(rows), 2, figsize=(2 * width / 100, len(rows) * height / 100 + 0.3), layout="constrained"
    )
    for axes, (relit, reference) in zip(panels, rows, strict=True):
        white = np.percentile(reference, 98)
        for ax, image in zip(axes, (relit, reference), strict=True):
            ax.imshow(np.clip(image / white, 0, 1) ** (1 / 2.2), interpolation="antialiased")
            ax.axis("off")
    panels[0, 0].set_title("one matrix, relit")
    panels[0, 1].set_title(f"Mitsuba path, {spp} spp")
    figure.savefig(output, dpi=75, pil_kwargs={"quality": 90} if output.suffix == ".jpg" else None)


if __name__ == "__main__":
    main()
