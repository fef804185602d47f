"""Scenes of the zoo by Mitsuba's ``path`` and by ``sparse_prt``, as a user renders them."""

from __future__ import annotations

import re
import tempfile
import time
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.benchmark.converged_reference import MAX_DEPTH
from mi_sparse_prt.core.errors import PrtWarning
from mi_sparse_prt.core.metrics import relative_l2_without_noise
from mi_sparse_prt.storage import load_transport
from mi_sparse_prt.validation.mitsuba_reference import path_image

SEEDS = 7919  # passes of one half stay apart from those of the other

Image = NDArray[np.float32]  # (height, width, 3), linear RGB
Pair = tuple[Image, Image]  # of independent samples


@dataclass(frozen=True)
class ZooEffort:
    """How a zoo is rendered.

    Attributes
    ----------
    resolution, target_error : int, float
        Of ``sparse_prt``.
    spp : int
        Of each of its two pictures.
    pass_spp, passes : int
        Samples by which each half of the reference grows, and how often at most.
    noise : float
        The reference is good enough when its noise could show no larger relative error.
    seconds : float
        After which a picture is given up.
    """

    resolution: int = 16
    target_error: float = 0.05
    spp: int = 256
    pass_spp: int = 128
    passes: int = 16
    noise: float = 0.005
    seconds: float = 60.0


@dataclass(frozen=True)
class Rendering:
    """What ``sparse_prt`` made of a scene.

    Attributes
    ----------
    images : two (height, width, 3) float32
        Of one matrix, with independent samples of pixels.
    seconds : float
        From the loaded scene to the first picture, the matrix and all compilation included.
    estimated_error : float or None
        The largest of its matrices' own; None if it kept none.
    warnings : list of str
    """

    images: Pair
    seconds: float
    estimated_error: float | None
    warnings: list[str]


def render_reference(path: Path, effort: ZooEffort, **parameters: Any) -> Pair:
    """Two independent pictures of a scene file by ``path``; parameters are values for its ``<default>`` entries."""
    scene = mi.load_file(str(path), **parameters)
    halves = [np.zeros(1, np.float32), np.zeros(1, np.float32)]
    for done in range(effort.passes):
        for k, half in enumerate(halves):
            fresh = path_image(scene, scene.sensors()[0], _depth(scene), effort.pass_spp, SEEDS * k + done)
            halves[k] = half + (fresh - half) / np.float32(done + 1)
        first, second = halves
        if relative_l2_without_noise((first + second) / 2, first, second)[1] <= effort.noise:
            break
    return first, second


def render_matrix(path: Path, effort: ZooEffort, **parameters: Any) -> Rendering:
    """Two pictures of a scene file by ``sparse_prt``, whose matrices are in a cache that starts empty."""
    scene = mi.load_file(str(path), **parameters)
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", PrtWarning)
        integrator = mi.load_dict(
            {
                "type": "sparse_prt",
                "resolution": effort.resolution,
                "target_error": effort.target_error,
                "max_depth": _depth(scene),
                "cache": folder,
                "progress": False,
            }
        )
        start = time.perf_counter()
        first = _picture(scene, integrator, effort.spp, seed=0)
        seconds = time.perf_counter() - start
        second = _picture(scene, integrator, effort.spp, seed=1)
        matrices = [load_transport(file) for file in Path(folder).glob("*.prt")]
    estimates = [matrix.report["estimated_error"]["total"] for matrix in matrices]
    said = dict.fromkeys(str(w.message) for w in caught if issubclass(w.category, PrtWarning))
    return Rendering((first, second), seconds, max(estimates, default=None), list(said))


def _depth(scene: mi.Scene) -> int:
    """``max_depth`` of the scene's own integrator; of one that has none, or no limit, that of all benchmarks."""
    found = re.search(r"max_depth = (\d+)", str(scene.integrator()))
    depth = int(found[1]) if found else MAX_DEPTH
    return depth if depth < 1 << 31 else MAX_DEPTH


def _picture(scene: mi.Scene, integrator: mi.Integrator, spp: int, seed: int) -> Image:
    return np.array(mi.render(scene, integrator=integrator, spp=spp, seed=seed))[..., :3]
