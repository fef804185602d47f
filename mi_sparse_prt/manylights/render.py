"""A picture of a scene lit by many lights, without precomputation ([HPB07])."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.core.profiling import peak_memory, reset_peak_memory, versions
from mi_sparse_prt.core.random_keys import random_stream
from mi_sparse_prt.core.run import Run
from mi_sparse_prt.core.variant import check_variant
from mi_sparse_prt.manylights.compensation import PATHS, SURVEY, LeftOut, joined, trace_left_out
from mi_sparse_prt.manylights.elements import Elements, Floats, ReducedColumns, Representatives
from mi_sparse_prt.manylights.estimate import (
    PIXELS,
    SECOND,
    Estimate,
    Partition,
    defensive_partition,
    draw_coloured_representatives,
    draw_representatives,
    published_partition,
    sum_with_error,
)
from mi_sparse_prt.manylights.image import ManyLightsImage, relative_error
from mi_sparse_prt.manylights.lights import LightOptions, scene_lights
from mi_sparse_prt.manylights.samples import Samples
from mi_sparse_prt.manylights.suggested_rows import LOOKED_AT, MOST_COLUMNS, reduce_columns
from mi_sparse_prt.manylights.surfaces import Surfaces
from mi_sparse_prt.sampling.row_column import random_projection
from mi_sparse_prt.scene.loading import load_mitsuba
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.scene.unfolding import unfold_instances

METHODS = "hasan2007", "adaptive"
PROJECTED = 50  # dimensions of reduced columns ([HPB07] 4: r')
COLUMNS_PER_ROW = 1.0, 3.0  # within a time budget or an error; most results of [HPB07] have 2 or 3
ROWS_SHARE = 0.2  # of what columns cost, that rows may, where these are cheap: few lights, many samples
FEWEST = 16, 48  # rows and columns
FIRST = 50  # rows, where an error is asked for
GROWTH = 1.5, 4.0  # of rows and columns from one try to the next: the error falls about as they grow
_PROJECT, _CLUSTER, _DRAW, _, _SUGGEST = range(5)  # keys of random numbers; frames have one

PILOT = 16  # rows, and columns, that tell what others cost
CLUSTERING = 7e-9  # seconds for each light and cluster
EARLY = 9  # times fewer columns for a preview
RESERVE = 0.05  # of a time budget

View = tuple[mi.Scene, mi.Sensor]


class Costs(NamedTuple):
    """Seconds of a row, of a column, and of clustering for each column."""

    row: float
    column: float
    clustering: float


@dataclass(frozen=True)
class Settings:
    """What ``render_many_lights`` is asked for; see there.

    Raises
    ------
    PrtError
        A number is too small, or the method is unknown.
    """

    rows: int = 300
    columns: int = 900
    seconds: float | None = None
    method: str = "adaptive"
    spp: int = 4
    lights: int = 100_000
    max_depth: int = 5
    clamp: float | None = None
    seed: int = 0
    groups: bool = False
    compensate: bool = False
    error: float | None = None

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise PrtError(f"method {self.method!r} is unknown: choose from {', '.join(METHODS)}")
        for name in ("rows", "columns"):
            if getattr(self, name) < 1:
                raise PrtError(f"{name} is {getattr(self, name)}: give 1 or more")
        if self.seconds is not None and not self.seconds > 0:
            raise PrtError(f"seconds is {self.seconds}: give a number above 0")
        if self.error is not None and not self.error > 0:
            raise PrtError(f"error is {self.error}: give a number above 0, 0.02 for 2%")
        if self.error is not None and self.method != "adaptive":
            raise PrtError(
                f"method {self.method!r} does not know its error: take adaptive, or leave error out"
            )
        self.light_options()

    def light_options(self) -> LightOptions:
        """Those of the lights."""
        return LightOptions(self.lights, max_depth=self.max_depth, clamp=self.clamp, seed=self.seed)

    def random(self, purpose: int) -> np.random.Generator:
        """Random numbers for one purpose."""
        return np.random.default_rng(random_stream(self.seed, purpose))


def render_many_lights(
    scene: mi.Scene | Scene | str | Path,
    rows: int = 300,
    columns: int = 900,
    seconds: float | None = None,
    sensor: int | mi.Sensor = 0,
    progress: bool = False,
    preview: Callable[[Floats], object] | None = None,
    **settings: Any,
) -> ManyLightsImage:
    """Render a scene by matrix row-column sampling: all its light as many point lights, few of which are evaluated.

    Some rows of the matrix of samples and lights tell which columns are alike, one column stands for each cluster of
    these. There is no precomputation; whatever changes, the next picture is a new one.

    Parameters
    ----------
    scene : mi.Scene, Scene, str or Path
        Of any shapes that Mitsuba can intersect, instances and curves too; world units. A path is that of an XML file:
        of that, many instances become meshes first, as kernels of a thousand instances take minutes to compile.
    rows, columns : int
        That are evaluated ([HPB07] recommends two or three columns for each row; ``seconds`` and ``error`` choose fewer
        where samples outnumber lights, as rows are cheap then).
    seconds : float, optional
        Choose rows and columns by what they cost, to be done by then; compilation is not counted.
    sensor : int or mi.Sensor
    progress : bool
        Show a forecast and progress bars.
    preview : callable, optional
        Is given an image (height, width, 3) early, from a ninth of the columns; the result is the same without.
    **settings
        ``method``: ``"adaptive"``, or ``"hasan2007"`` for the paper as published. ``spp``: samples per pixel (4).
        ``lights``: about how many (100,000). ``max_depth``: as for ``path`` (5). ``clamp``: see ``LightOptions``.
        ``seed`` (0). ``groups``: no cluster has lights of two emitters, and the image comes in layers, one for each
        (false). ``compensate``: add what the clamp cuts off, and light that comes to samples by way of mirrors and
        glass, by paths from samples (false); the image is that of ``path`` then, with some grain. ``error``: in place
        of ``rows`` and ``columns``, try more and more until the estimated error is at most this one, or the next try
        would take longer than ``seconds``.

    Returns
    -------
    ManyLightsImage

    Raises
    ------
    PrtError
        A number that makes no sense; no such sensor; a light, a medium or a variant that is not supported; light that
        is not finite, naming the shape.

    Notes
    -----
    Hasan, Pellacini, Bala: Matrix Row-Column Sampling for the Many-Light Problem, SIGGRAPH 2007. Indirect light is that
    of virtual point lights, whose geometry term is clamped: corners are a little too dark.
    """
    check_variant()
    try:
        asked = Settings(rows, columns, seconds, **settings)
    except TypeError as error:
        raise PrtError(f"render_many_lights: {error}") from None
    reset_peak_memory()
    run = Run(asked.seed, progress=progress)
    with run.clock.phase("load"):
        view = find_view(scene, sensor)
    found = RowColumn(matrix_of(view, asked, run), asked, run)
    found.trace_left_out()  # first: what it takes is not left for rows and columns
    return found.picture(found.compensated(found.estimate(preview)))


def find_view(scene: mi.Scene | Scene | str | Path, sensor: int | mi.Sensor) -> View:
    """A scene, and one of its cameras; of a file, many instances are meshes.

    Raises
    ------
    PrtError
        There is no such file or camera.
    """
    if isinstance(scene, (str, Path)):
        scene = unfold_instances(load_mitsuba(scene))
    if isinstance(scene, Scene):
        scene = scene.mitsuba
    if isinstance(sensor, int):
        sensors = scene.sensors()
        if not 0 <= sensor < len(sensors):
            raise PrtError(
                f"the scene has {len(sensors)} sensors, and no sensor {sensor}: add one, or give another"
            )
        sensor = sensors[sensor]
    return scene, sensor


def matrix_of(view: View, settings: Settings, run: Run) -> Elements:
    """The matrix of a view; samples and lights are phases of the run's clock."""
    scene, sensor = view
    surfaces = Surfaces(scene)
    with run.clock.phase("samples"):
        samples = Samples(
            scene, surfaces, sensor, settings.spp, settings.max_depth, settings.seed, settings.groups
        )
    with run.clock.phase("lights"):
        lights = scene_lights(scene, settings.light_options())
    return Elements(scene, surfaces, samples, lights)


class RowColumn:
    """Matrix row-column sampling of one matrix, step by step.

    Parameters
    ----------
    elements : Elements
    settings : Settings
    run : Run
        Its clock tells where time goes.
    flux : (n,) float64, optional
        Of the lights, for columns that no row sees: that which they have, if not given.
    """

    def __init__(
        self, elements: Elements, settings: Settings, run: Run, flux: NDArray[np.float64] | None = None
    ) -> None:
        self.elements, self.settings, self.run = elements, settings, run
        self.samples, self.lights = elements.samples, elements.lights
        self._flux = self.lights.flux if flux is None else flux
        self.rows, self.columns = settings.rows, settings.columns
        self.layers: dict[str, Floats] = {}
        self.tries: list[dict[str, float]] = []
        self._left_out: LeftOut | None = None
        self._added, self._added_of = np.zeros((1, 3), np.float32), dict[str, Floats]()

    def costs(self) -> Costs:
        """What a row and a column take, from a few of them, and clustering for each column."""
        clock = self.run.clock
        with clock.phase("pilot"):
            rows = self.samples.stratified_rows(PILOT, self.settings.seed)
            columns = np.linspace(0, len(self.lights) - 1, PILOT).astype(np.int64)
            weights, projection = np.ones((PILOT, 3), np.float32), np.eye(len(rows), dtype=np.float32)
            took = []
            for _ in range(2):  # kernels are compiled in the first round
                start = time.perf_counter()
                self.elements.reduce_columns(rows, projection)
                middle = time.perf_counter()
                self.elements.sum_columns(columns, weights)
                took.append((middle - start, time.perf_counter() - middle))
        row, column = (seconds / PILOT for seconds in took[-1])
        more, clustered = (
            (0.0, 1) if self.settings.method == "hasan2007" else (2 * SECOND * PIXELS + LOOKED_AT, 2)
        )
        return Costs(row, column * (1 + more), clustered * CLUSTERING * len(self.lights))

    def forecast(self, costs: Costs) -> float:
        """Seconds that rows, clustering and columns will take."""
        return self.rows * costs.row + self.columns * (costs.column + costs.clustering)

    def _affordable(self, costs: Costs, seconds: float) -> tuple[int, int]:
        """Rows and columns that fit into what is left of so many seconds."""
        left = seconds - self.run.clock.report()["total"]
        each = costs.row + self._columns_per_row() * (costs.column + costs.clustering)
        rows = int(left / (each * (1 + RESERVE)))
        rows, columns = max(rows, FEWEST[0]), max(round(self._columns_per_row() * rows), FEWEST[1])
        return min(rows, len(self.samples)), min(columns, len(self.lights))

    def _columns_per_row(self) -> float:
        """Columns for each row: a row has an element of each light, a column one of each sample."""
        m, n = self.elements.shape
        return float(np.clip(n / (ROWS_SHARE * m), *COLUMNS_PER_ROW))

    def reduced(self, rows: int) -> ReducedColumns:
        """Reduced columns of so many rows: at even distances, or half of them where columns suggest them."""
        rows, seed = min(rows, len(self.samples)), self.settings.seed
        projection = random_projection(rows, PROJECTED, self.settings.random(_PROJECT))
        with self.run.clock.phase("rows"), self.run.bar(rows, "rows") as bar:
            if self.settings.method == "hasan2007":
                ids = self.samples.stratified_rows(rows, seed)
                return self.elements.reduce_columns(ids, projection, bar.update)
            parts = self.lights.group.astype(np.int64) if self.settings.groups else None
            return reduce_columns(self.elements, projection, self._suggesting, seed, bar.update, parts)

    def _suggesting(self, reduced: ReducedColumns) -> Representatives:
        """Columns that suggest rows."""
        partition = self.partition(reduced, min(self.columns, MOST_COLUMNS))
        return draw_representatives(partition, 1, self.settings.random(_SUGGEST))

    def partition(
        self, reduced: ReducedColumns, columns: int, ids: NDArray[np.int64] | None = None
    ) -> Partition:
        """Clusters by the method.

        Parameters
        ----------
        reduced : ReducedColumns
        columns : int
            Clusters.
        ids : (k,) int64, optional
            Lights that they are to have; all if not given.
        """
        with self.run.clock.phase("clustering"):
            if ids is None:
                return self._partition(reduced, columns, self._flux)
            found = self._partition(reduced.of_lights(ids), columns, self._flux[ids])
            return found.numbered(ids, len(self.lights))

    def _partition(self, reduced: ReducedColumns, columns: int, flux: NDArray[np.float64]) -> Partition:
        rng = self.settings.random(_CLUSTER)
        if self.settings.method == "hasan2007":
            return published_partition(reduced, columns, rng)
        return defensive_partition(reduced, flux, columns, rng)

    def summed(self, reduced: ReducedColumns, partition: Partition) -> Estimate:
        """The sum of all columns by those that represent their clusters, all of which are in it."""
        rng = self.settings.random(_DRAW)
        with self.run.clock.phase("columns"), self.run.bar(len(partition), "columns", " columns") as bar:
            if self.settings.method == "hasan2007":
                chosen = draw_coloured_representatives(partition, reduced.channel_norms, rng)
                return Estimate(self.elements.sum_columns(*chosen, bar.update), float("nan"))
            spp, seen = self.settings.spp, reduced.seen
            return sum_with_error(self.elements, partition, spp, rng, bar.update, seen)

    def trace_left_out(self) -> None:
        """Light that the matrix does not have: of all samples, if it is to be added, else of some, to tell how much."""
        seed, m, whole = self.settings.seed, len(self.samples), self.settings.compensate
        rows = np.arange(m) if whole or m <= SURVEY else self.samples.stratified_rows(SURVEY, seed)
        names = self.lights.names if whole and self.settings.groups else ()
        bar = self.run.bar(len(rows) * max(len(names), 1), "compensation", " samples")
        with self.run.clock.phase("compensation"), bar:
            trace = partial(trace_left_out, self.elements, rows, PATHS if whole else 1, seed, bar.update)
            found = [trace(k) for k in range(len(names))] or [trace()]
        self._left_out = joined(found)
        if whole:
            self._added = self._left_out.values
            self._added_of = {name: own.values for name, own in zip(names, found, strict=False)}

    def compensated(self, estimate: Estimate) -> Estimate:
        """With the light that paths found, if it is to be added: layers have theirs, too."""
        if self._left_out is None or not self.settings.compensate:
            return estimate
        for name, values in self._added_of.items():
            self.layers[name] = self.layers.get(name, 0) + values
        noise = float(self._left_out.variances[:, -1].sum()) / self.samples.spp**2
        return Estimate(estimate.values + self._added, estimate.squared_error + noise)

    def estimate(self, preview: Callable[[Floats], object] | None = None) -> Estimate:
        """All steps; within a time budget, rows and columns by what a few of them cost."""
        if self._is_dark():
            return self._nothing()
        if self.settings.error is not None:
            return self._until_good(self.settings.error, preview)
        if self.settings.seconds is not None or self.run.progress:
            costs = self.costs()
            if self.settings.seconds is not None:
                self.rows, self.columns = self._affordable(costs, self.settings.seconds)
            self._announce(f", about {self.forecast(costs):.2g} s")
        reduced = self.reduced(self.rows)
        if preview is not None:
            rough = self.partition(reduced, -(-self.columns // EARLY))
            preview(self.samples.image(self.summed(reduced, rough).values + self._added))
        return self.estimate_from(reduced)

    def _is_dark(self) -> bool:
        return not len(self.samples) or not len(self.lights)

    def _nothing(self) -> Estimate:
        self.rows = self.columns = 0
        return Estimate(np.zeros((len(self.samples), 3), np.float32), 0.0)

    def _until_good(self, error: float, preview: Callable[[Floats], object] | None) -> Estimate:
        """Ever more rows and columns, from new ones: all tries but the last take about as long as that one."""
        m, n = self.elements.shape
        rows, spent = float(FIRST), self.run.clock.report()["total"]
        while True:
            self.rows, self.columns = min(round(rows), m), min(round(self._columns_per_row() * rows), n)
            every = self.rows == m and self.columns == n
            self._announce()
            found = self.estimate_from(self.reduced(self.rows))
            image = self.samples.image(found.values + self._added)
            known = relative_error(image, found.squared_error)
            self.tries.append({"rows": self.rows, "columns": self.columns, "estimated_error": known})
            if preview is not None:
                preview(image)
            growth = float(np.clip(np.nan_to_num(known / error, nan=np.inf), *GROWTH))
            now = self.run.clock.report()["total"]
            if known <= error or every or now + growth * (now - spent) > (self.settings.seconds or np.inf):
                return found
            rows, spent = growth * rows, now

    def estimate_from(self, reduced: ReducedColumns) -> Estimate:
        """From columns that are reduced already, by rows of this or of other views."""
        if self._is_dark():
            return self._nothing()
        self.rows = min(self.rows, len(self.samples))
        if self.settings.groups:
            return self._by_group(reduced)
        partition = self.partition(reduced, self.columns)
        self.columns = len(partition)
        return self.summed(reduced, partition)

    def _by_group(self, reduced: ReducedColumns) -> Estimate:
        """The light of each emitter apart, with as many columns as what rows see of it is worth."""
        found, columns = [], 0
        for group, name in enumerate(self.lights.names):
            ids = np.flatnonzero(self.lights.group == group)
            if len(ids):
                share = reduced.norms[ids].sum() / max(reduced.norms.sum(), 1e-300)
                partition = self.partition(reduced, max(1, round(share * self.columns)), ids)
                found.append(self.summed(reduced.of_part(group), partition))
                self.layers[name], columns = found[-1].values, columns + len(partition)
        self.columns = columns
        values = np.asarray(sum(one.values for one in found), np.float32)
        return Estimate(values, sum(one.squared_error for one in found))

    def _announce(self, more: str = "") -> None:
        if self.run.progress:
            m, n = self.elements.shape
            print(
                f"{m:,} samples, {n:,} lights: {self.rows} rows and {self.columns} columns{more}",
                file=sys.stderr,
            )

    def picture(self, estimate: Estimate) -> ManyLightsImage:
        """The image, and the report of the run."""
        with self.run.clock.phase("filter"):
            image = self.samples.image(estimate.values)
            covered = self.samples.covered.astype(np.float32)[:, None]
            alpha = self.samples.filtered(covered)[..., 0]
            names, dark = self.lights.names if self.settings.groups else (), np.zeros((1, 3), np.float32)
            layers = {
                name: self.samples.image_of(k, self.layers.get(name, dark)) for k, name in enumerate(names)
            }
        return ManyLightsImage(image, alpha, layers, self._report(image, estimate.squared_error))

    def _report(self, image: Floats, squared_error: float) -> dict[str, Any]:
        m, n = self.elements.shape
        error = relative_error(image, squared_error)
        return {
            "seconds": self.run.clock.report(),
            "rows": self.rows,
            "columns": self.columns,
            "samples": m,
            "lights": {"total": n, "emitters": self.lights.counts()},
            "elements_total": m * n,
            "elements_evaluated": self.elements.evaluated,
            "estimated_error": error if np.isfinite(error) else None,
            "tries": self.tries,
            "left_out": self._shares(image),
            "clamp": self.lights.clamp if np.isfinite(self.lights.clamp) else None,
            "peak_memory_bytes": peak_memory(),
            "parameters": {**vars(self.settings), "image": list(self.samples.shape)},
            "seed": self.settings.seed,
            "versions": versions(),
        }

    def _shares(self, image: Floats) -> dict[str, Any] | None:
        """Of the mean radiance of the image with all light, what the matrix does not have."""
        if self._left_out is None:
            return None
        found, added = self._left_out.of_image(self.samples), self.settings.compensate
        lost = 0.0 if added else sum(mean for mean, _ in found.values())
        whole = max(float(image.mean(dtype=np.float64)) + lost, 1e-300)
        shares = {
            kind: {"share": mean / whole, "standard_error": error / whole}
            for kind, (mean, error) in found.items()
        }
        return {**shares, "added": added}
