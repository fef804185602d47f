"""What matrix row-column sampling is compared with, on the same elements ([HPB07] 5)."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np

from mi_sparse_prt.core.run import Run
from mi_sparse_prt.io.checkpoint import Checkpoint
from mi_sparse_prt.manylights.elements import Elements, Floats, Ids
from mi_sparse_prt.manylights.estimate import Representatives
from mi_sparse_prt.manylights.lights import LightOptions, scene_lights

RECORD = 4096  # rows that are finished together


def all_lights(elements: Elements, run: Run, rows: Ids, folder: Path | None = None) -> Floats:
    """The sums (len(rows), 3) of all columns at some rows: what the others estimate.

    Parameters
    ----------
    elements : Elements
    run : Run
        Shows progress.
    rows : (k,) integers
    folder : Path, optional
        Where finished rows are kept, under a name that stands for rows, samples and lights: an interrupted run goes
        on, and a finished one is read.
    """
    found = np.zeros((len(rows), 3), np.float32)
    kept = (
        Checkpoint(folder / f"all_lights_{_hash(elements, rows)}.rows", found) if folder is not None else None
    )
    first = 0 if kept is None else kept.rows_done
    with run.bar(len(rows), "all lights", " samples", first) as bar:
        for a in range(first, len(rows) if len(elements.lights) else 0, RECORD):
            part = rows[a : a + RECORD]
            found[a : a + RECORD] = elements.sum_of_rows(part)
            bar.update(len(part))
            if kept is not None:
                kept.append(found[a : a + RECORD])
    return found


def instant_radiosity(elements: Elements, count: int, options: LightOptions) -> Floats:
    """All columns (m, 3) of a matrix of fewer lights (Keller 1997).

    Parameters
    ----------
    elements : Elements
        Of other lights; samples are the same.
    count : int
        Lights.
    options : LightOptions
        Of the lights, but for their number.
    """
    lights = scene_lights(elements.scene, replace(options, count=count))
    fewer = Elements(elements.scene, elements.surfaces, elements.samples, lights)
    return fewer.sum_columns(np.arange(len(lights)), np.ones((len(lights), 3), np.float32))


def draw_by_power(flux: np.ndarray, count: int, rng: np.random.Generator) -> Representatives:
    """Lights drawn in proportion to their flux, with replacement, each times 1 / (count p): power sampling.

    Parameters
    ----------
    flux : (n,) float
    count : int
        Draws; a light that is drawn more often is listed once.
    rng : np.random.Generator
    """
    p = flux / flux.sum()
    ids, times = np.unique(rng.choice(len(p), count, p=p), return_counts=True)
    scale = times / (count * p[ids])
    return Representatives(ids, np.repeat(scale[:, None], 3, axis=1).astype(np.float32))


def _hash(elements: Elements, rows: Ids) -> str:
    """Stands for rows, samples and lights, and for how they look to each other: some elements."""
    state = hashlib.sha256(np.asarray(rows, np.int64).tobytes())
    m, n = elements.shape
    state.update(np.array([m, n, elements.lights.clamp, elements.samples.max_depth]).tobytes())
    state.update(elements.lights.arrays.power.numpy().tobytes())
    state.update(mi.Point3f(elements.lights.arrays.place).numpy().tobytes())
    state.update(elements.samples.seen.tobytes() + elements.samples.ids.tobytes())
    if m and n:
        some, columns = np.linspace(0, m - 1, 64).astype(int), np.linspace(0, n - 1, 64).astype(int)
        state.update(elements.block(some, columns).tobytes())
    return state.hexdigest()[:24]
