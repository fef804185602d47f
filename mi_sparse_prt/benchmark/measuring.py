"""What a timing needs and depends on: a clock, memory that stays, processor, versions, and the size of the problem."""

from __future__ import annotations

import ctypes
import os
import platform
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import drjit as dr
import psutil

from mi_sparse_prt.core.profiling import versions
from mi_sparse_prt.core.variant import variant
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.scene.scene import Scene

_TRIM_THRESHOLD, _MMAP_MAX = -1, -4  # parameters of mallopt in glibc's malloc.h
_DEFAULTS = {_TRIM_THRESHOLD: 128 << 10, _MMAP_MAX: 65536}

Result = TypeVar("Result")


def timed(work: Callable[..., Result], *arguments: Any) -> tuple[float, Result]:
    """Seconds that a call takes, and what it returns."""
    start = time.perf_counter()
    result = work(*arguments)
    return time.perf_counter() - start, result


@contextmanager
def kept_memory() -> Iterator[None]:
    """Let the process keep the memory that it frees, for its next arrays; elsewhere than under glibc, do nothing.

    Many virtual machines give freed pages back to their host. The first touch of 150 MB then took 0.55 s where pages
    of its own take 0.04 s: time of the machine, that would look like time of the method.
    """
    libc = ctypes.CDLL(None)
    glibc = hasattr(libc, "mallopt") and hasattr(libc, "malloc_trim")
    if glibc:
        libc.mallopt(_MMAP_MAX, 0)
        libc.mallopt(_TRIM_THRESHOLD, (1 << 31) - 1)
    try:
        yield
    finally:
        if glibc:
            for parameter, value in _DEFAULTS.items():
                libc.mallopt(parameter, value)
            libc.malloc_trim(0)


def report_header(scene: Scene, lighting: CubemapLighting) -> dict[str, Any]:
    """With what every report of a benchmark begins: ``machine`` and ``scene``."""
    return {
        "machine": describe_machine(),
        "scene": {
            "path": scene.path,
            "hash": scene.hash,
            "vertices": len(scene.positions),
            "triangles": sum(len(mesh.triangles) for mesh in scene.meshes),
            "directions": lighting.n_directions,
        },
    }


def describe_machine() -> dict[str, Any]:
    """Facts for a report; ``load_average`` above ``cores`` means that others were working and times are too long."""
    return {
        "cpu": _cpu_model(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "drjit_threads": dr.thread_count(),
        "gpu": _gpu_model(),
        "memory_bytes": psutil.virtual_memory().total,
        "load_average": os.getloadavg()[0],
        "system": platform.platform(),
        "versions": versions(),
    }


def _gpu_model() -> str | None:
    """The GPU that kernels run on, None if they run on the processor."""
    if variant() != "cuda_ad_rgb":
        return None
    asked = ["nvidia-smi", "--query-gpu=name", "--format=csv,noheader"]
    try:
        return subprocess.run(asked, capture_output=True, text=True, check=True).stdout.splitlines()[0]
    except (OSError, subprocess.CalledProcessError, IndexError):
        return "a GPU whose name nvidia-smi does not tell"


def _cpu_model() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:  # not Linux
        return platform.processor()
    return next(
        (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine()
    )
