"""What frames of many lights lack: errors, and how much brightness changes by them from frame to frame.

``python docs/film_flicker.py scenes_xml/many_lights/room.xml --animate slide=0:0.5``, or without ``--animate`` for a
camera that turns by a quarter of a degree a frame. References are all lights of each frame.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

import mi_sparse_prt as prt
from mi_sparse_prt.core.run import Run
from mi_sparse_prt.manylights.render import Settings, find_view, matrix_of
from mi_sparse_prt.scene.loading import load_mitsuba

SIZE = {"width": 80, "height": 60}
DEGREES = 0.25  # of a camera, from frame to frame

Images = NDArray[np.float64]


def frames(path: str, animate: str | None, count: int) -> tuple[Callable[[int], mi.Scene], list[mi.Sensor]]:
    """The scene of each frame, and cameras."""
    name, _, ends = (animate or "").partition("=")
    still = load_mitsuba(path, **SIZE)
    if animate:
        first, last = map(float, ends.split(":"))
        values = np.linspace(first, last, count)
        return lambda k: load_mitsuba(path, **SIZE, **{name: values[k]}), [still.sensors()[0]] * count
    cameras = []
    for k in range(count):
        camera = load_mitsuba(path, **SIZE).sensors()[0]
        known = mi.traverse(camera)
        turn = mi.Transform4f().rotate([0, 1, 0], DEGREES * k)
        known["to_world"] = mi.Transform4f(known["to_world"].matrix) @ turn
        known.update()
        cameras.append(camera)
    return lambda _: still, cameras


def images(found: Iterable[prt.ManyLightsImage]) -> Images:
    """Of all frames."""
    return np.array([frame.image for frame in found], np.float64)


def main() -> None:
    """Print a line for each way to make a film."""
    parser = argparse.ArgumentParser()
    parser.add_argument("scene")
    parser.add_argument("--animate")
    parser.add_argument("--frames", type=int, default=6)
    parser.add_argument("--lights", type=int, default=20_000)
    parser.add_argument("--rows", type=int, default=300)
    parser.add_argument("--columns", type=int, default=900)
    asked = parser.parse_args()
    at, cameras = frames(asked.scene, asked.animate, asked.frames)
    size, lights = (asked.rows, asked.columns), {"lights": asked.lights}

    def every(seeds: Iterable[int]) -> Images:
        """All lights."""
        found = []
        for (k, camera), seed in zip(enumerate(cameras), seeds, strict=True):
            matrix = matrix_of(find_view(at(k), camera), Settings(seed=seed, **lights), Run(seed))
            n = len(matrix.lights)
            values = matrix.sum_columns(np.arange(n), np.ones((n, 3), np.float32))
            found.append(matrix.samples.image(values))
        return np.array(found, np.float64)

    def alone(seeds: Iterable[int], method: str = "adaptive") -> Images:
        return images(
            prt.render_many_lights(at(k), *size, sensor=camera, seed=seed, method=method, **lights)
            for (k, camera), seed in zip(enumerate(cameras), seeds, strict=True)
        )

    one, others = [0] * asked.frames, range(asked.frames)
    whole, whole_of_others = every(one), every(others)
    for name, found, true in (
        ("frames", images(prt.render_many_lights_frames(at, cameras, *size, **lights)), whole),
        ("pictures, one seed", alone(one), whole),
        ("pictures, other seeds", alone(others), whole_of_others),
        ("as published", alone(others, "hasan2007"), whole_of_others),
    ):
        apart = found - true
        error = np.linalg.norm(apart) / np.linalg.norm(true)
        shift = apart.mean(axis=(1, 2, 3)) / true.mean(axis=(1, 2, 3))
        flicker = np.sqrt(np.square(np.diff(shift)).mean())
        print(f"{name}: error {error:.2%}, brightness of a frame to the next {flicker:.3%}")


if __name__ == "__main__":
    main()
