"""Where seconds go: phases, what is in none of them, and compilation apart from both."""

import importlib.util
import random
import time
from threading import Thread
from types import ModuleType, SimpleNamespace

import drjit as dr
import mitsuba as mi
import numba
import pytest
from numba.core.event import end_event, start_event

from mi_sparse_prt.core.profiling import Stopwatch


class Now:
    """A clock that stands still until it is told to go on, and the kernels that Dr.Jit compiled meanwhile."""

    def __init__(self) -> None:
        self.seconds = 0.0
        self.kernels: list[dict[str, float]] = []

    def passes(self, seconds: float, of_compiling: float = 0.0) -> None:
        self.seconds += seconds
        self.kernels.append({"backend_time": 1e3 * of_compiling})

    def history(self, _: object) -> list[dict[str, float]]:
        found, self.kernels = self.kernels, []
        return found


@pytest.fixture
def now(monkeypatch: pytest.MonkeyPatch) -> Now:
    clock = Now()
    monkeypatch.setattr(
        "mi_sparse_prt.core.profiling.time", SimpleNamespace(perf_counter=lambda: clock.seconds)
    )
    monkeypatch.setattr(dr, "kernel_history", clock.history)
    return clock


def adds_up(report: dict[str, float]) -> bool:
    phases = {name: seconds for name, seconds in report.items() if name not in ("total", "compile")}
    return sum(phases.values()) == pytest.approx(report["total"])


def test_what_belongs_to_no_phase_is_other(now):
    clock = Stopwatch()
    now.passes(1)
    with clock.phase("a"):
        now.passes(2)
        with clock.phase("b"):
            now.passes(4)
        now.passes(8)
    with clock.phase("b"):
        now.passes(16)
    clock.add("c", 0.25)
    assert clock.report() == {"a": 10, "b": 20, "c": 0.25, "other": 0.75, "total": 31, "compile": 0}


def test_kernels_are_compiled_apart_from_the_phase_that_launches_them(now):
    clock = Stopwatch()
    with clock.phase("a"):
        now.passes(2, of_compiling=1.5)
        with clock.phase("b"):
            now.passes(4, of_compiling=0.5)
        now.passes(8, of_compiling=1)
    assert clock.report() == {"a": 7.5, "b": 3.5, "other": 0, "total": 11, "compile": 3}


def test_a_phase_that_fails_is_counted_too(now):
    """And what comes after it is not taken for a part of it."""
    clock = Stopwatch()
    with pytest.raises(KeyboardInterrupt), clock.phase("a"):
        now.passes(1)
        with clock.phase("b"):
            now.passes(2)
            raise KeyboardInterrupt
    with clock.phase("c"):
        now.passes(4)
    assert clock.report() == {"a": 1, "b": 2, "c": 4, "other": 0, "total": 7, "compile": 0}
    assert not dr.flag(dr.JitFlag.KernelHistory)


def test_threads_that_compile_do_not_meet_in_a_phase(now):
    """Two threads compile at once: numba tells of the second one's start before the first one's end.

    Expected: no error, and the time of other threads stays in the phase of the one that waits for them.
    """
    clock = Stopwatch()
    with clock.phase("a"):
        now.passes(1)
        start_event("numba:compiler_lock")
        other = Thread(target=lambda: start_event("numba:compiler_lock"))
        other.start()
        other.join()
        now.passes(2)
        end_event("numba:compiler_lock")
        now.passes(4)
        other = Thread(target=lambda: end_event("numba:compiler_lock"))
        other.start()
        other.join()
    assert clock.report() == {"a": 5, "other": 0, "total": 7 - 2, "compile": 2}


def test_numba_compiles_apart_from_the_phase_that_calls():
    """A function that calls another one: compiling the first compiles the second, and that counts once.

    Expected: what numba itself says that it took, and the phase keeps the time in which it slept.
    """

    @numba.njit
    def inner(x: float) -> float:
        return x + 1

    @numba.njit
    def outer(x: float) -> float:
        return 2 * inner(x)

    clock = Stopwatch()
    with clock.phase("a"):
        assert outer(1.0) == 4
        time.sleep(0.05)
    report = clock.report()
    expected = outer.get_metadata(outer.signatures[0])["timers"]["compiler_lock"]
    assert report["compile"] == pytest.approx(expected, rel=0.1)
    assert 0.05 <= report["a"] < 0.05 + 0.5 * expected
    assert adds_up(report)

    with clock.phase("a"):
        outer(2.0)
    assert clock.report()["compile"] == report["compile"]


def test_loading_from_the_cache_of_numba_is_compilation(tmp_path):
    (tmp_path / "cached.py").write_text(
        "import numba\n\n@numba.njit(cache=True)\ndef plus_one(x):\n    return x + 1\n"
    )
    _module(tmp_path / "cached.py").plus_one(1.0)
    again, clock = _module(tmp_path / "cached.py").plus_one, Stopwatch()
    with clock.phase("a"):
        again(1.0)
    assert sum(again.stats.cache_hits.values()) == 1
    report = clock.report()
    assert report["compile"] > report["a"] > 0  # to add 1 takes no time
    assert adds_up(report)


def _module(path: object) -> ModuleType:
    """The module in a file, loaded anew."""
    spec = importlib.util.spec_from_file_location("cached", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def new_kernel() -> mi.Float:
    """One that no process has compiled before: its constants are part of a kernel."""
    return dr.sin(dr.arange(mi.Float, 16) * random.SystemRandom().random())


def test_drjit_compiles_apart_from_the_phase_that_launches():
    values, clock = new_kernel(), Stopwatch()
    with clock.phase("a"):
        dr.eval(values)
        dr.sync_thread()
    report = clock.report()
    assert report["compile"] > 0.001
    assert report["a"] >= 0 and adds_up(report)


def test_the_kernel_history_of_a_caller_stays_theirs():
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        clock = Stopwatch()
        with clock.phase("a"):
            dr.eval(new_kernel())
        (kernel,) = dr.kernel_history([dr.KernelType.JIT])
    assert kernel["backend_time"] > 0
    assert clock.report()["compile"] == 0
    assert not dr.flag(dr.JitFlag.KernelHistory)
