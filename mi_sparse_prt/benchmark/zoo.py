"""Which scenes come out right: a small one for each plugin of Mitsuba, by ``sparse_prt`` and by ``path``."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from tqdm.auto import tqdm

from mi_sparse_prt.benchmark.measuring import describe_machine
from mi_sparse_prt.benchmark.zoo_figures import SceneImages, draw_contact_sheet
from mi_sparse_prt.benchmark.zoo_rendering import (
    Pair,
    Rendering,
    ZooEffort,
    render_matrix,
    render_reference,
)
from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.core.metrics import relative_l2_without_noise, relative_noise
from mi_sparse_prt.core.worker_process import DONE, ERROR, WorkerProcess
from mi_sparse_prt.validation.validate import save_figures

ZOO = Path(__file__).parents[2] / "scenes_xml" / "zoo"
LIMIT = 0.02  # relative L2 of an image beyond its noise, up to which it agrees
HALF = 0.5  # of an error: an estimate from there on has told it
AGREES, TOLD, OFF, UNCLEAR = "agrees", "told to be off", "off", "unclear"
REFERENCE_SECONDS = 300.0  # for the reference of a scene

# parts of warnings that are no word about the picture: of the estimate itself, the cache, and what was tidied up
NOT_ABOUT_PICTURES = ("target error", "cache", "that no triangle uses", "without area", "of length zero")

FULL = ZooEffort()

Report = dict[str, Any]


def measure_zoo(
    place: Path | None = None,
    progress: bool = True,
    figures: Path | None = None,
    effort: ZooEffort = FULL,
) -> Report:
    """Render scenes by ``sparse_prt`` and by ``path``, and say which agree.

    Parameters
    ----------
    place : path, optional
        A folder of scene files, or one of them; the zoo of the repository if not given.
    progress : bool
    figures : path, optional
        Folder for ``zoo.png``, a contact sheet, made if needed.
    effort : ZooEffort, optional

    Returns
    -------
    dict
        JSON as it is. ``machine``, ``parameters``, ``counts`` of each verdict, and ``scenes``, each with ``name``,
        ``verdict`` (see ``verdict``; ``refused`` by the package, ``error``, ``too long``), ``error`` (relative L2 of
        the image, without the noise of both sides), ``uncertainty`` (an error that noise alone may show),
        ``noise`` of the reference, ``seconds``, ``estimated_error`` of its matrix, ``told_by`` (see ``told_by``), and
        ``sentences``: its warnings, or why there is no picture.

    Raises
    ------
    PrtError
        If there is no scene file.
    """
    files = scene_files(ZOO if place is None else place)
    found, images = [], {}
    with WorkerProcess() as process:
        for path in tqdm(files, desc="zoo", unit=" scenes", disable=not progress):
            report, pictures = _measure_scene(process, path, effort)
            found.append(report)
            images[path.stem] = pictures
    if figures is not None:
        save_figures(figures, {"zoo": draw_contact_sheet(images, {f["name"]: f["verdict"] for f in found})})
    return {
        "machine": describe_machine(),
        "parameters": {name: getattr(effort, name) for name in ("resolution", "target_error")},
        "counts": dict(Counter(f["verdict"] for f in found).most_common()),
        "scenes": found,
    }


def scene_files(place: Path) -> list[Path]:
    """The scene files of a folder by name, or the one file.

    Raises
    ------
    PrtError
        If there is none.
    """
    files = sorted(place.glob("*.xml")) if place.is_dir() else [place]
    if not files or not files[0].is_file():
        raise PrtError(
            f"no scene file at {place}: give a folder with Mitsuba's XML files in it, or one of them"
        )
    return files


def _measure_scene(process: WorkerProcess, path: Path, effort: ZooEffort) -> tuple[Report, SceneImages]:
    """The report of a scene, and what there is of its pictures."""
    outcome, truth = process.call(render_reference, path, effort, seconds=REFERENCE_SECONDS)
    if outcome != DONE:
        return _without_picture(path.stem, outcome, f"path: {truth}"), SceneImages()
    outcome, ours = process.call(render_matrix, path, effort, seconds=effort.seconds)
    reference = np.mean(truth, axis=0)
    if outcome != DONE:
        return _without_picture(path.stem, outcome, ours), SceneImages(reference)
    return judge(path.stem, ours, truth), SceneImages(reference, np.mean(ours.images, axis=0))


def _without_picture(name: str, outcome: str, sentence: str) -> Report:
    unknown = dict.fromkeys(("error", "uncertainty", "noise", "seconds", "estimated_error"))
    return {"name": name, "verdict": outcome, **unknown, "told_by": [], "sentences": [sentence]}


def judge(name: str, ours: Rendering, truth: Pair) -> Report:
    """The report of a scene of which there are pictures by both."""
    for whose, pictures in (("path", truth), ("sparse_prt", ours.images)):
        if not np.isfinite(pictures).all():  # NaN would be no different from anything
            return _without_picture(name, ERROR, f"{whose}: pixels are NaN or infinite")
    error, uncertainty = image_error(ours.images, truth)
    about_picture = [w for w in ours.warnings if not any(part in w for part in NOT_ABOUT_PICTURES)]
    told = told_by(error, ours.estimated_error, bool(about_picture))
    found = verdict(error, uncertainty, bool(told))
    return {
        "name": name,
        "verdict": found,
        "error": error,
        "uncertainty": uncertainty,
        "noise": relative_noise(*truth),
        "seconds": ours.seconds,
        "estimated_error": ours.estimated_error,
        "told_by": told if found == TOLD else [],
        "sentences": ours.warnings,
    }


def image_error(ours: Pair, truth: Pair) -> tuple[float, float]:
    """Relative L2 of an image beyond the noise of both sides, and an error that this noise alone may show."""
    return relative_l2_without_noise(ours[0], truth[0], truth[1], other_estimate=ours[1])


def told_by(error: float, estimate: float | None, warned: bool) -> list[str]:
    """Who said that an image has this error.

    ``"estimate"``, where the matrix's own is at least half of it; ``"warning"``, where one said that the picture would
    not be right.
    """
    close = estimate is not None and estimate >= HALF * error
    return ["estimate"] * close + ["warning"] * warned


def verdict(error: float, uncertainty: float, told: bool) -> str:
    """What an image's error means.

    Parameters
    ----------
    error, uncertainty : float
        As ``image_error`` finds them.
    told : bool
        Whether anybody said that there is such an error.

    Returns
    -------
    str
        ``agrees``: within 2%; ``unclear``: it seems so, but noise may hide more. If it is not: ``told to be off`` where
        somebody said so, else ``off``.
    """
    if error <= LIMIT:
        return AGREES if uncertainty <= LIMIT else UNCLEAR
    return TOLD if told else OFF
