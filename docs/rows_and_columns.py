"""Errors and times of many lights by numbers of rows and columns, at 400 x 300 pixels: one line for each.

python docs/rows_and_columns.py scenes_xml/many_lights/room.xml 3 300/900:hasan2007 130/400 250/400
"""

from __future__ import annotations

import sys
import time

import mitsuba as mi
import numpy as np

import mi_sparse_prt as prt  # noqa: F401  chooses a variant
from mi_sparse_prt.core.run import Run
from mi_sparse_prt.manylights.elements import Elements
from mi_sparse_prt.manylights.render import RowColumn, Settings, find_view, matrix_of

PIXELS = 2000  # at which all lights are added up
SHARE = 0.005  # of the columns, that tell what all take


def settings_of(asked: str, seed: int) -> Settings:
    """Of rows/columns, or rows/columns:method."""
    numbers, _, method = asked.partition(":")
    rows, columns = map(int, numbers.split("/"))
    return Settings(rows=rows, columns=columns, seed=seed, method=method or "adaptive")


def measure(elements: Elements, settings: Settings) -> tuple[float, float]:
    """Relative 2-norm of RGB at some pixels, against all lights, and seconds."""
    samples = elements.samples
    rows, _ = samples.rows_of_pixels(PIXELS, np.random.default_rng(5))
    start = time.perf_counter()
    values = RowColumn(elements, settings, Run(settings.seed)).estimate().values[rows]
    seconds = time.perf_counter() - start
    ours, true = (
        samples.pixel_means(np.ascontiguousarray(of.T)[:, None], rows)
        for of in (values, elements.sum_of_rows(rows))
    )
    return float(np.linalg.norm(ours - true) / np.linalg.norm(true)), seconds


def main(path: str, seeds: int, every: list[str]) -> None:
    """Print a line for each pair of numbers."""
    scene = mi.load_file(path)
    film = mi.traverse(scene.sensors()[0])
    film["film.size"] = film["film.crop_size"] = mi.ScalarVector2u(400, 300)
    film.update()
    found: dict[str, list[tuple[float, float]]] = {asked: [] for asked in every}
    for seed in range(seeds):
        elements = matrix_of(find_view(scene, 0), Settings(seed=seed), Run(seed))
        n = len(elements.lights)
        if not seed:  # kernels are compiled before anything is timed
            for asked in every:
                few = Settings(rows=20, columns=60, method=settings_of(asked, 0).method)
                RowColumn(elements, few, Run(0)).estimate()
            some = np.random.default_rng(1).choice(n, round(SHARE * n), replace=False)
            start = time.perf_counter()
            elements.sum_columns(some, np.ones((len(some), 3), np.float32))
            whole = (time.perf_counter() - start) * n / len(some)
            print(f"{len(elements.samples)} samples, {n} lights, all of them {whole:.0f} s")
        for asked in every:
            found[asked].append(measure(elements, settings_of(asked, seed)))
    for asked, pairs in found.items():
        errors, seconds = np.array(pairs).T
        error, took = np.sqrt((errors**2).mean()), np.median(seconds)
        print(f"{asked:20} {error:.2%}, worst {errors.max():.2%}; {took:.1f} s, {whole / took:.0f} x")


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), sys.argv[3:])
