"""Scenes of the zoo by Mitsuba's ``path`` and by ``sparse_prt``, as a user renders them, in a process of their own.

What takes too long is ended with its process, and a scene that takes its process down takes nothing else with it.
"""

from __future__ import annotations

import multiprocessing
import os
import re
import signal
import tempfile
import threading
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from tqdm.auto import tqdm

from mi_sparse_prt.benchmark.converged_reference import MAX_DEPTH
from mi_sparse_prt.core.errors import PrtError, PrtWarning
from mi_sparse_prt.core.metrics import relative_l2_without_noise
from mi_sparse_prt.storage import load_transport
from mi_sparse_prt.validation.mitsuba_reference import path_image

DONE, REFUSED, ERROR, TOO_LONG = "done", "refused", "error", "too long"
GRACE = 5.0  # seconds in which an idle process may end by itself
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


class RenderingProcess:
    """A process that renders one scene after the other; ended when one takes too long, and started again.

    Used as a context; kernels stay compiled in it from scene to scene.
    """

    def __init__(self) -> None:
        self._context = multiprocessing.get_context("spawn")
        self._process: Any = None
        self._connection: Connection | None = None

    def __enter__(self) -> RenderingProcess:
        return self

    def __exit__(self, *reasons: object) -> None:
        if self._connection is not None:
            self._connection.close()
            self._process.join(GRACE)
        self._end()

    def call(self, work: Callable[..., Any], *arguments: Any, seconds: float) -> tuple[str, Any]:
        """Do something in the process: ``"done"`` and its result, or how it failed and a sentence.

        ``"refused"`` by a ``PrtError``, ``"error"`` by any other exception or by the end of the process,
        ``"too long"`` after ``seconds``.
        """
        connection = self._started()
        try:
            connection.send((work, arguments))
            if not connection.poll(seconds):
                self._end()
                return TOO_LONG, f"ended after {seconds:g} s"
            return connection.recv()
        except (EOFError, OSError):
            self._process.join()
            code = self._process.exitcode
            self._end()
            return ERROR, f"the process ended with exit code {code}"

    def _started(self) -> Connection:
        if self._connection is None:
            self._connection, theirs = self._context.Pipe()
            self._process = self._context.Process(target=_serve, args=(theirs,), daemon=True)
            self._process.start()
            theirs.close()  # so that the end of the process is the end of the connection
        return self._connection

    def _end(self) -> None:
        if self._connection is not None:
            self._process.kill()  # gently would not do: a kernel that runs listens to nothing else
            self._process.join()
            self._connection.close()
            self._connection = None


def _serve(connection: Connection) -> None:
    """Do what is asked for until nobody asks any more."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C ends it at once and without a word
    threading.Thread(target=_end_with_parent, daemon=True).start()
    tqdm.set_lock(
        threading.RLock()
    )  # its own is shared among processes, and would be left behind by one that is ended
    while True:
        try:
            work, arguments = connection.recv()
        except EOFError:
            return
        try:
            answer = DONE, work(*arguments)
        except Exception as error:  # whatever it is belongs into the table
            answer = _explained(error)
        connection.send(answer)


def _end_with_parent() -> None:
    """End this process when the one that started it is gone: nobody waits for the picture any more."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _explained(error: BaseException) -> tuple[str, str]:
    """Whether the package refused a scene, or failed, and its sentence; Mitsuba wraps what its plugins raise."""
    causes = [error]
    while (cause := causes[-1].__cause__ or causes[-1].__context__) is not None:
        causes.append(cause)
    refusal = next((c for c in causes if isinstance(c, PrtError)), None)
    if refusal is not None:
        return REFUSED, str(refusal)
    text = " ".join(str(causes[-1]).split())
    return ERROR, f"{type(causes[-1]).__name__}: {text}"
