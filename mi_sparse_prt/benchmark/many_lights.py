"""Matrix row-column sampling beside what it competes with: time against error, and the tables of [HPB07]."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import mitsuba as mi
import numpy as np

from mi_sparse_prt.benchmark.many_lights_figures import many_lights_figures
from mi_sparse_prt.benchmark.many_lights_reference import PICTURE, Reference
from mi_sparse_prt.benchmark.measuring import describe_machine, kept_memory, timed
from mi_sparse_prt.core.metrics import flip_map, relative_noise
from mi_sparse_prt.core.profiling import peak_memory, reset_peak_memory
from mi_sparse_prt.core.run import Run
from mi_sparse_prt.manylights.baselines import draw_by_power, instant_radiosity
from mi_sparse_prt.manylights.elements import Elements, Floats
from mi_sparse_prt.manylights.lightcuts import lightcuts
from mi_sparse_prt.manylights.render import METHODS, RowColumn, Settings, find_view, matrix_of
from mi_sparse_prt.scene.loading import load_mitsuba
from mi_sparse_prt.validation.validate import save_figures

RATIOS = {
    "1:1": 1.0,
    "1:2": 2.0,
    "1:3": 3.0,
    "3:1": 1 / 3,
}  # columns for each row ([HPB07] Figure 6 has rows first)
SIZES = 100, 400, 1200  # rows and columns together
SETTINGS = (100, 100), (300, 900)  # of [HPB07] Table 2
HALF = 90, 370  # adaptive: less than half as many elements as 300/900 (r n + c m)
EQUAL_TIME = 300, 900  # rows and columns that others have as long as ([HPB07] Figure 5)
LIGHTS = 100, 500, 2500  # of the baselines
CUTS = 0.1, 0.05, 0.02  # thresholds of lightcuts, in small images of diffuse scenes
PATH_SPP = 1, 4, 16, 64
COUNT = 100_000  # lights in all
CURVE_SEEDS = 2  # of each point of a curve
SEEDS = 10  # of each row of the table
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

    Samples and lights are the same for all, and not counted, as in the paper. Errors are 2-norms over pixels (means of
    their samples), relative to the sum of all lights, which is known at all pixels of a small image, and at pixels at
    random of a large one. Those of ``path`` are its noise, from two renders: it has no clamp, and no bias.

    Parameters
    ----------
    path : Path
        Mitsuba scene, an XML file; its film has the size.
    parameters : dict
        Values for its <default> entries.
    progress : bool
    figures : Path, optional
        Folder for ``many_lights.png`` and others; finished rows of the reference are kept there as well.
    seeds : int
        Runs of each row of the table, 10 if not given; points of curves have two.
    settings : Settings
        Lights, samples per pixel and depth, those of ``render_many_lights`` if not given; rows and columns are chosen
        here.

    Returns
    -------
    dict
        ``machine``, ``scene``, ``all_lights`` (seconds, from 1% of the columns), ``reference`` (its ``pixels``, and
        the error of the picture that FLIP compares with), ``curves``: a list of points by name, with ``seconds``, RMS
        ``error``, its ``spread`` over seeds, and ``predicted`` where it is known; ``table`` (as [HPB07] Table 2),
        ``equal_time`` (as Figure 5), ``singular_values``, ``path``. JSON as it is.
    """
    scene, settings = load_mitsuba(path, **parameters), settings or Settings(lights=COUNT)
    run = Run(settings.seed, progress=progress)
    elements = matrix_of(find_view(scene, 0), settings, run)
    m, n = elements.shape
    with kept_memory(), tempfile.TemporaryDirectory() as scratch:
        reference = Reference(elements, run, figures or Path(scratch))
        bench = _Bench(elements, settings, reference)
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
        report["reference"] = bench.paint_reference()
        report["curves"] = bench.curves(run)
        report["path"] = _path(scene, settings.max_depth)
        report["table"] = bench.table(seeds or SEEDS, run)
        report["equal_time"] = bench.at_equal_time(report, scene)
        report["singular_values"] = _singular_values(elements)
        if figures is not None:
            save_figures(figures, many_lights_figures(report, bench.pictures, bench.equal_time))
    return report


class _Found(NamedTuple):
    """One picture: seconds by phase, radiance of rows (m, 3), and their squared error, as predicted."""

    seconds: dict[str, float]
    values: Floats
    squared_error: float


class _Bench:
    """One matrix, its reference, and what is measured on it."""

    def __init__(self, elements: Elements, settings: Settings, reference: Reference) -> None:
        self._elements, self._settings, self._reference = elements, settings, reference
        self.pictures: dict[str, Floats] = {}
        self.equal_time: dict[str, Floats] = {}

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

    def paint_reference(self) -> dict[str, Any]:
        """The picture that others are looked at beside, and how far off it is itself."""
        values = self._reference.values(self._settings)
        self.pictures["reference"] = self._image(values)
        error, uncertainty = self._reference.error(values)
        return {
            "pixels": len(self._reference.pixels),
            "picture": "all lights" if self._reference.is_whole else f"adaptive {PICTURE[0]}/{PICTURE[1]}",
            "picture_error": error,
            "picture_error_uncertainty": uncertainty,
        }

    def _image(self, values: Floats) -> Floats:
        return self._elements.samples.image(values)

    def _flip(self, image: Floats) -> float:
        return float(flip_map(self.pictures["reference"], image).mean())

    def curves(self, run: Run) -> dict[str, list[dict[str, Any]]]:
        """Of both methods at all ratios, and of the baselines."""
        found = {}
        baselines: dict[str, Sequence[float]] = {"instant radiosity": LIGHTS, "power sampling": LIGHTS}
        if self._elements.surfaces.all_lambertian and self._reference.is_whole:
            baselines["lightcuts"] = CUTS  # which take hours on large images
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
                found = [self._run(method, rows, columns, 1 + seed) for seed in range(CURVE_SEEDS)]
                points.append({"rows": rows, "columns": columns, **self._quality(found)})
        return points

    def _quality(self, found: list[_Found]) -> dict[str, Any]:
        """Of pictures of several seeds: median time, and errors."""
        known = [self._reference.error(one.values) for one in found]
        errors = np.array([error for error, _ in known])
        squares = np.array([one.squared_error for one in found])
        square = self._reference.square()
        predicted = math.sqrt(squares.mean() / square) if np.isfinite(squares).all() and square > 0 else None
        return {
            "seconds": float(np.median([one.seconds["total"] for one in found])),
            "error": float(np.sqrt(np.mean(errors**2))),
            "error_uncertainty": float(max(own for _, own in known)),
            "mean_error": float(errors.mean()),
            "spread": float(errors.std(ddof=1)) if len(errors) > 1 else 0.0,
            "worst": float(errors.max()),
            "predicted": predicted,
        }

    def _run(self, method: str, rows: int, columns: int, seed: int) -> _Found:
        run = Run(seed)
        asked = replace(self._settings, method=method, rows=rows, columns=columns, seed=seed, seconds=None)
        estimate = RowColumn(self._elements, asked, run).estimate()
        seconds = {phase: taken for phase, taken in run.clock.seconds.items() if phase != "compile"}
        seconds["total"] = sum(seconds.values())
        return _Found(seconds, estimate.values, estimate.squared_error)

    def baseline(self, name: str, sizes: Sequence[float]) -> list[dict[str, Any]]:
        """A point for each number of lights, or for each error that lightcuts allow."""
        points = []
        for size in sizes:
            found = [self._run_baseline(name, size, 1 + seed) for seed in range(CURVE_SEEDS)]
            points.append({"threshold" if name == "lightcuts" else "lights": size, **self._quality(found)})
            self.pictures[name] = self._image(found[-1].values)
        return points

    def _run_baseline(self, name: str, size: float, seed: int) -> _Found:
        seconds, values = timed(self._baseline_values, name, size, seed)
        return _Found({"total": seconds}, values, math.inf)

    def _baseline_values(self, name: str, size: float, seed: int) -> Floats:
        if name == "lightcuts":
            return lightcuts(self._elements, seed, size)
        if name == "instant radiosity":
            options = replace(self._settings, seed=seed).light_options()
            return instant_radiosity(self._elements, int(size), options)
        chosen = draw_by_power(self._elements.lights.flux, int(size), np.random.default_rng(seed))
        return self._elements.sum_columns(*chosen)

    def table(self, seeds: int, run: Run) -> list[dict[str, Any]]:
        """As [HPB07] Table 2: a row for each method and size."""
        rows = [*((method, *size) for method in METHODS for size in SETTINGS), ("adaptive", *HALF)]
        found = []
        with run.bar(len(rows) * seeds, "table", " pictures") as bar:
            for method, r, c in rows:
                found.append(self._row_of_table(method, r, c, seeds, bar.update))
        return found

    def _row_of_table(
        self, method: str, rows: int, columns: int, seeds: int, done: Callable[[], object]
    ) -> dict[str, Any]:
        """Seconds by phase, with errors, the peak of memory, and how the first image looks."""
        reset_peak_memory()
        found = []
        for seed in range(seeds):
            found.append(self._run(method, rows, columns, 1 + seed))
            done()
        image = self._image(found[0].values)
        self.pictures[f"{method} {rows}/{columns}"] = image
        phases = {key: float(np.median([one.seconds[key] for one in found])) for key in found[0].seconds}
        return {
            "method": method,
            "rows": rows,
            "columns": columns,
            **self._quality(found),
            "seconds": phases,
            "flip": self._flip(image),
            "peak_memory_bytes": peak_memory(),
        }

    def at_equal_time(self, report: dict[str, Any], scene: mi.Scene) -> list[dict[str, Any]]:
        """What others have after as long as ``adaptive`` takes with many columns ([HPB07] Figure 5)."""
        rows, columns = (min(k, most) for k, most in zip(EQUAL_TIME, self._elements.shape, strict=True))
        ours = self._run("adaptive", rows, columns, 1)
        enough = max(
            1, round(ours.seconds["total"] * len(self._elements.lights) / report["all_lights"]["seconds"])
        )
        found = {f"adaptive {rows}/{columns}": ours}
        found[f"hasan2007 {rows}/{columns}"] = self._run("hasan2007", rows, columns, 1)
        for name in ("instant radiosity", "power sampling"):
            found[f"{name} {enough}"] = self._run_baseline(name, enough, 1)
        points = []
        for name, one in found.items():
            image = self.equal_time[name] = self._image(one.values)
            error, _ = self._reference.error(one.values)
            points.append(
                {"name": name, "seconds": one.seconds["total"], "error": error, "flip": self._flip(image)}
            )
        return [*points, self._path_at_equal_time(report["path"], scene, ours.seconds["total"])]

    def _path_at_equal_time(
        self, known: list[dict[str, Any]], scene: mi.Scene, seconds: float
    ) -> dict[str, Any]:
        """Of ``path``, whose error is its noise, as it has no clamp."""
        spp = max(1, round(seconds * known[-1]["spp"] / known[-1]["seconds"]))
        integrator = mi.load_dict({"type": "path", "max_depth": self._settings.max_depth})
        took, image = timed(lambda: np.array(mi.render(scene, integrator=integrator, spp=spp))[..., :3])
        self.equal_time[f"path {spp} spp"] = image
        noise = known[-1]["error"] * math.sqrt(known[-1]["spp"] / spp)
        return {"name": f"path {spp} spp", "seconds": took, "error": noise, "flip": None}


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
