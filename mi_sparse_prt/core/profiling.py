"""What a computation costs: seconds of its phases, memory at its peak, and with which versions."""

from __future__ import annotations

import platform
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from importlib.metadata import version
from pathlib import Path
from threading import get_ident

import drjit as dr
import mitsuba as mi
from numba.core.event import Event, Listener, install_listener


class Stopwatch:
    """Seconds of named phases; what belongs to none is ``other``, so that they add up to the total.

    Phases may nest: the inner one's time is its own. What numba (loading from its cache included) and Dr.Jit compile
    while a phase runs is apart from it, in ``compile``: numba announces it, and Dr.Jit has it in its kernel history.
    That tells the time in LLVM or PTX, not the milliseconds in which a kernel of ``~/.drjit`` is loaded. Where the
    caller keeps a kernel history, it stays the caller's, and Dr.Jit's compilation stays in the phases.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._start = time.perf_counter()
        self._inside = 0.0  # seconds of the phases that ended inside of the one that runs
        self._watching = False  # a phase runs
        self._recording = False  # and the kernel history is ours

    @contextmanager
    def phase(self, name: str) -> Iterator[None]:
        """Add the time spent inside to a phase."""
        with nullcontext() if self._watching else self._watched_compilers():
            self._take_kernels()  # those of the outer phase
            start, outer, self._inside = time.perf_counter(), self._inside, 0.0
            try:
                yield
            finally:
                self._take_kernels()
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

    @contextmanager
    def _watched_compilers(self) -> Iterator[None]:
        """Around the outermost phase: hear of numba's compilations, and let Dr.Jit record its kernels."""
        history = dr.JitFlag.KernelHistory
        self._watching, self._recording = True, not dr.flag(history)
        if self._recording:
            dr.kernel_history_clear()
        try:
            with install_listener("numba:compiler_lock", _Compiler(self)), dr.scoped_set_flag(history, True):
                yield
        finally:
            self._watching = self._recording = False

    def _take_kernels(self) -> None:
        """Move what Dr.Jit compiled since the last call from the phase that runs to ``compile``."""
        if not self._recording:
            return
        seconds = sum(kernel["backend_time"] for kernel in dr.kernel_history([dr.KernelType.JIT])) / 1e3
        if seconds > 0:
            self.add("compile", seconds)
            self._inside += seconds


class _Compiler(Listener):
    """Makes a phase of every stretch of time in which numba compiles, or loads what it compiled before.

    Its lock is what both have in common; the event named after compilation leaves loading out. What other threads
    compile meanwhile stays in the phase: phases are those of one thread, and the events of two interleave.
    """

    def __init__(self, clock: Stopwatch) -> None:
        self._clock, self._thread = clock, get_ident()
        self._phases: list[AbstractContextManager[None]] = []  # the lock may be taken again by whoever has it

    def on_start(self, event: Event) -> None:
        if get_ident() != self._thread:
            return
        self._phases.append(self._clock.phase("compile"))
        self._phases[-1].__enter__()

    def on_end(self, event: Event) -> None:
        if get_ident() == self._thread:
            self._phases.pop().__exit__(None, None, None)


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
