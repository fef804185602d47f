"""Matrix row-column sampling beside what it competes with: time against error, and the tables of [HPB07]."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from mi_sparse_prt.benchmark.many_lights_figures import many_lights_figures
from mi_sparse_prt.benchmark.measuring import describe_machine, kept_memory, timed
from mi_sparse_prt.core.metrics import flip_map, relative_l2, relative_noise
from mi_sparse_prt.core.profiling import peak_memory, reset_peak_memory
from mi_sparse_prt.core.run import Run
from mi_sparse_prt.manylights.baselines import all_lights, draw_by_power, instant_radiosity
from mi_sparse_prt.manylights.elements import Elements, Floats
from mi_sparse_prt.manylights.lightcuts import lightcuts
from mi_sparse_prt.manylights.render import METHODS, RowColumn, Settings, find_view, matrix_of
from mi_sparse_prt.scene.loading import load_mitsuba
from mi_sparse_prt.validation.validate import save_figures

RATIOS = {"1:1": 1.0, "1:2": 2.0, "1:3": 3.0, "3:1": 1 / 3}  # rows to columns ([HPB07] Figure 6)
SIZES = 100, 400, 1200  # rows and columns together
SETTINGS = (100, 100), (300, 900)  # of [HPB07] Table 2
LIGHTS = 100, 500, 2500  # of the baselines
CUTS = 0.1, 0.05, 0.02  # thresholds of lightcuts, in diffuse scenes
PATH_SPP = 1, 4, 16, 64
COUNT = 100_000  # lights in all
SEEDS = 2
ALL_LIGHTS_SHARE = 0.01  # of the columns tell how long all take
SINGULAR = 1200, 1001  # samples and lights whose singular values are drawn ([HPB07] Figure 3)


def measure_many_lights(
    path: Path,
    parameters: dict[str, str],
    progress: bool = True,
    figures: Path | None = None,
    seeds: int | None = None,
    settings: Settings | None = None,
) -> dict[str, Any]:
    """Time and error of both methods, at four ratios of rows to columns, and of the baselines, on one scene.

    Samples and lights are the same for all, and not counted, as in the paper. Errors are those of images, 2-norm,
    relative to the sum of all lights; those of ``path`` are its noise, from two renders: it has no clamp, and no bias.

    Parameters
    ----------
    path : Path
        Mitsuba scene, an XML file; its film has the size.
    parameters : dict
        Values for its <default> entries.
    progress : bool
    figures : Path, optional
        Folder for ``many_lights.png`` and others; finished samples of the reference are kept there as well.
    seeds : int
        Runs of each point.
    settings : Settings
        Lights, samples per pixel and depth, those of ``render_many_lights`` if not given; rows and columns are chosen
        here.

    Returns
    -------
    dict
        ``machine``, ``scene``, ``all_lights`` (seconds, from 1% of the columns), ``curves``: a list of points by name,
        with ``seconds``, mean ``error`` and its ``spread`` over seeds, and ``predicted`` where it is known; ``table``
        (as [HPB07] Table 2), ``singular_values``, ``path``. JSON as it is.
    """
    scene, settings = load_mitsuba(path, **parameters), settings or Settings(lights=COUNT)
    run = Run(settings.seed, progress=progress)
    elements = matrix_of(find_view(scene, 0), settings, run)
    m, n = elements.shape
    with kept_memory(), tempfile.TemporaryDirectory() as scratch:
        reference = elements.samples.image(all_lights(elements, run, figures or Path(scratch)))
        bench = _Bench(elements, settings, reference, seeds or SEEDS)
        bench.warm_up()
        report: dict[str, Any] = {
            "machine": describe_machine(),
            "scene": {
                "path": str(path),
                "samples": m,
                "lights": n,
                "image": list(elements.samples.shape),
                "shapes": len(scene.shapes()),
            },
            "all_lights": bench.all_lights(),
        }
        report["curves"] = bench.curves(run)
        report["path"] = _path(scene, settings.max_depth)
        report["table"] = [bench.row_of_table(method, *pair) for method in METHODS for pair in SETTINGS]
        report["singular_values"] = _singular_values(elements)
        if figures is not None:
            save_figures(figures, many_lights_figures(report, {"reference": reference, **bench.pictures}))
    return report


class _Bench:
    """One matrix, its reference image, and what is measured on it."""

    def __init__(self, elements: Elements, settings: Settings, reference: Floats, seeds: int) -> None:
        self._elements, self._settings, self._reference = elements, settings, reference
        self._seeds = seeds
        self.pictures: dict[str, Floats] = {}

    def warm_up(self) -> None:
        """Compile all kernels."""
        for method in METHODS:
            self._run(method, 16, 48, 0)

    def all_lights(self) -> dict[str, float]:
        """Seconds for all columns, from some of them."""
        n = len(self._elements.lights)
        ids = np.random.default_rng(0).choice(n, max(1, round(ALL_LIGHTS_SHARE * n)), replace=False)
        weights = np.ones((len(ids), 3), np.float32)
        seconds, _ = timed(self._elements.sum_columns, np.sort(ids), weights)
        return {"seconds": seconds * n / len(ids), "columns_timed": len(ids)}

    def curves(self, run: Run) -> dict[str, list[dict[str, Any]]]:
        """Of both methods at all ratios, and of the baselines."""
        found = {}
        baselines: dict[str, Sequence[float]] = {"instant radiosity": LIGHTS, "power sampling": LIGHTS}
        if self._elements.surfaces.all_lambertian:
            baselines["lightcuts"] = CUTS
        with run.bar(len(METHODS) * len(RATIOS) + len(baselines), "curves", " curves") as bar:
            for method in METHODS:
                for name, ratio in RATIOS.items():
                    found[f"{method} {name}"] = self.curve(method, ratio)
                    bar.update()
            for name, sizes in baselines.items():
                found[name] = self.baseline(name, sizes)
                bar.update()
        return found

    def curve(self, method: str, ratio: float) -> list[dict[str, Any]]:
        """A point for each size."""
        m, n = self._elements.shape
        points = []
        for size in SIZES:
            rows = max(1, round(size / (1 + ratio)))
            columns = size - rows
            if rows <= m and columns <= n:
                points.append(self._point(method, rows, columns))
        return points

    def _point(self, method: str, rows: int, columns: int) -> dict[str, Any]:
        found = [self._run(method, rows, columns, 1 + seed) for seed in range(self._seeds)]
        errors = np.array([error for _, error, _, _ in found])
        predicted = [p for _, _, p, _ in found if p is not None]
        return {
            "rows": rows,
            "columns": columns,
            "seconds": float(np.median([seconds["total"] for seconds, _, _, _ in found])),
            "error": float(np.sqrt(np.mean(errors**2))),
            "spread": float(errors.std(ddof=1)) if len(errors) > 1 else 0.0,
            "worst": float(errors.max()),
            "predicted": float(np.sqrt(np.mean(np.square(predicted)))) if predicted else None,
        }

    def _run(
        self, method: str, rows: int, columns: int, seed: int
    ) -> tuple[dict[str, float], float, float | None, Floats]:
        run = Run(seed)
        asked = replace(self._settings, method=method, rows=rows, columns=columns, seed=seed, seconds=None)
        sampled = RowColumn(self._elements, asked, run)
        estimate = sampled.estimate()
        seconds = dict(run.clock.seconds)
        seconds["total"] = sum(v for k, v in seconds.items() if k != "compile")
        image = self._elements.samples.image(estimate.values)
        square = float(np.square(self._reference, dtype=np.float64).sum())
        known = math.isfinite(estimate.squared_error)
        predicted = math.sqrt(estimate.squared_error / square) if known and square > 0 else None
        return seconds, float(relative_l2(image, self._reference)), predicted, image

    def baseline(self, name: str, sizes: Sequence[float]) -> list[dict[str, Any]]:
        """A point for each number of lights, or for each error that lightcuts allow."""
        points = []
        for size in sizes:
            seconds, errors = [], []
            for seed in range(self._seeds):
                took, image = timed(self._baseline_image, name, size, 1 + seed)
                seconds.append(took)
                errors.append(float(relative_l2(image, self._reference)))
            points.append(
                {
                    "threshold" if name == "lightcuts" else "lights": size,
                    "seconds": float(np.median(seconds)),
                    "error": float(np.sqrt(np.mean(np.square(errors)))),
                    "spread": float(np.std(errors, ddof=1)) if len(errors) > 1 else 0.0,
                    "worst": max(errors),
                }
            )
            self.pictures[name] = image
        return points

    def _baseline_image(self, name: str, size: float, seed: int) -> Floats:
        if name == "lightcuts":
            values = lightcuts(self._elements, seed, size)
        elif name == "instant radiosity":
            options = replace(self._settings, seed=seed).light_options()
            values = instant_radiosity(self._elements, int(size), options)
        else:
            chosen = draw_by_power(self._elements.lights.flux, int(size), np.random.default_rng(seed))
            values = self._elements.sum_columns(*chosen)
        return self._elements.samples.image(values)

    def row_of_table(self, method: str, rows: int, columns: int) -> dict[str, Any]:
        """Seconds by phase, as [HPB07] Table 2, with the peak of memory and how the image looks."""
        reset_peak_memory()
        seconds, error, predicted, image = self._run(method, rows, columns, 1)
        self.pictures[f"{method} {rows}/{columns}"] = image
        return {
            "method": method,
            "rows": rows,
            "columns": columns,
            "seconds": seconds,
            "error": error,
            "predicted": predicted,
            "flip": float(flip_map(self._reference, image).mean()),
            "peak_memory_bytes": peak_memory(),
        }


def _path(scene: mi.Scene, max_depth: int) -> list[dict[str, Any]]:
    """Time and noise of Mitsuba's path, with its samples: it makes its own image, which is not clamped."""
    integrator = mi.load_dict({"type": "path", "max_depth": max_depth})
    mi.render(scene, integrator=integrator, spp=1)
    points = []
    for spp in PATH_SPP:
        (seconds, first), (_, second) = (
            timed(
                lambda seed, spp=spp: np.array(mi.render(scene, integrator=integrator, spp=spp, seed=seed)), k
            )
            for k in (1, 2)
        )
        noise = math.sqrt(2) * relative_noise(first[..., :3], second[..., :3])
        points.append({"spp": spp, "seconds": seconds, "error": noise})
    return points


def _singular_values(elements: Elements) -> list[float]:
    """Of a small version of the matrix, norms of its colours, relative to the largest."""
    m, n = elements.shape
    rows = elements.samples.stratified_rows(SINGULAR[0], 0)
    columns = np.unique(np.linspace(0, n - 1, min(n, SINGULAR[1])).astype(np.int64))
    norms = np.linalg.norm(elements.block(rows, columns), axis=2)
    values = np.linalg.svd(norms, compute_uv=False)
    return [float(v / values[0]) for v in values] if len(values) and values[0] > 0 else []
