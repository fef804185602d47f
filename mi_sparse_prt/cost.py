"""What a computation costs: seconds of its phases, memory at its peak, and with which versions."""

from __future__ import annotations

import platform
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path

import mitsuba as mi


class Stopwatch:
    """Seconds of named phases; what belongs to none is ``other``, so that they add up to the total.

    Phases may nest: the inner one's time is its own.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._start = time.perf_counter()
        self._inside = 0.0  # seconds of the phases that ended inside of the one that runs

    @contextmanager
    def phase(self, name: str) -> Iterator[None]:
        """Add the time spent inside to a phase."""
        start, outer, self._inside = time.perf_counter(), self._inside, 0.0
        yield
        elapsed = time.perf_counter() - start
        self.add(name, elapsed - self._inside)
        self._inside = outer + elapsed

    def add(self, name: str, seconds: float) -> None:
        """Add seconds to a phase."""
        self.seconds[name] = self.seconds.get(name, 0.0) + seconds

    def report(self) -> dict[str, float]:
        """Phases, ``total`` (their sum), and apart from these ``compile``."""
        elapsed = time.perf_counter() - self._start
        phases = {**self.seconds, "other": elapsed - sum(self.seconds.values())}
        compiling = phases.pop("compile", 0.0)
        return {**phases, "total": elapsed - compiling, "compile": compiling}


def reset_peak_memory() -> None:
    """Let the kernel forget the peak so far; where it cannot (not Linux), the report has that of the process."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        pass


def peak_memory() -> int:
    """Peak resident bytes of the process since ``reset_peak_memory``; 0 where the kernel does not tell."""
    status = Path("/proc/self/status")
    for line in status.read_text().splitlines() if status.exists() else ():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) * 1024
    return 0


def versions() -> dict[str, str]:
    """Versions of what a result depends on, and Mitsuba's variant."""
    names = ("mi-sparse-prt", "mitsuba", "drjit", "numpy")
    return {
        **{name: version(name) for name in names},
        "python": platform.python_version(),
        "variant": mi.variant(),
    }
