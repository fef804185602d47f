"""Seconds and memory for a year of hourly skies, to the colours of all vertices.

    python docs/year_of_skies.py scenes_xml/bunny.xml

Precomputes and compresses the scene's matrix (resolution 32), then streams 8760 skies to a callback, that takes the
colours block by block and keeps the mean. Skies are brightest around a sun at 45 degrees north, the ground is grey.
Prints JSON: what making the skies and the callback take is told apart from ``relight``. Nothing else should run
beside it.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import mi_sparse_prt as prt
from mi_sparse_prt.core.profiling import peak_memory, reset_peak_memory

HOURS = 8760
LATITUDE, TILT = np.radians(45), np.radians(23.44)

Floats = NDArray[np.float32]


def sun(hour: int) -> Floats:
    """Direction to the sun (world, +y up, +z south) at an hour of the year."""
    season = -TILT * np.cos(2 * np.pi * (hour / 24 + 10) / 365)
    angle = 2 * np.pi * (hour % 24 - 12) / 24
    east, south, pole = -np.cos(season) * np.sin(angle), np.cos(season) * np.cos(angle), np.sin(season)
    up = np.sin(LATITUDE) * pole + np.cos(LATITUDE) * south
    return np.array([east, up, np.sin(LATITUDE) * south - np.cos(LATITUDE) * pole], np.float32)


def skies(lighting: prt.CubemapLighting) -> Iterator[Floats]:
    """Radiance (n_directions, 3) hour by hour: a glow around the sun, a blue sky, and what the ground reflects."""
    above = lighting.directions[:, 1] > 0
    for hour in range(HOURS):
        towards = sun(hour)
        day = max(float(towards[1]), 0.0)
        glow = np.exp(8 * (lighting.directions @ towards - 1))[:, None] * np.array([9, 8, 6], np.float32)
        sky = day * (np.array([0.3, 0.5, 0.9], np.float32) + glow)
        yield np.where(above[:, None], sky, np.float32(0.2 * day)).astype(np.float32)


def main() -> None:
    """Make the matrix and measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("scene", type=Path, metavar="SCENE.xml")
    scene = prt.load_scene(parser.parse_args().scene)
    transport = prt.compress(prt.precompute(scene, prt.CubemapLighting(32), target_error=0.02))
    start = time.perf_counter()
    for _ in skies(transport.lighting):
        pass
    making = time.perf_counter() - start
    mean, adding = np.zeros(transport.shape[::2], np.float64), [0.0]

    def add(first: int, colours: Floats) -> None:
        start = time.perf_counter()
        mean[...] += colours.sum(axis=2) / HOURS
        adding[0] += time.perf_counter() - start

    transport.relight_many([next(skies(transport.lighting))], add)  # compiles
    mean[...] = adding[0] = 0
    reset_peak_memory()
    start = time.perf_counter()
    transport.relight_many(skies(transport.lighting), add)
    seconds = time.perf_counter() - start
    expected = transport.relight(sum(sky / HOURS for sky in skies(transport.lighting)))
    report = {
        "vertices": scene.n_vertices,
        "skies": making,
        "callback": adding[0],
        "relight": seconds - making - adding[0],
        "peak_memory_bytes": peak_memory(),
        "mean_differs_from_that_of_the_mean_sky": float(np.abs(mean - expected).max() / expected.max()),
    }
    print(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
