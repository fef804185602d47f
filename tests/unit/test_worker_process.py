"""A process beside this one, and what fails in it."""

import os
import subprocess
import sys
import threading
import time

from mi_sparse_prt.core.worker_process import WorkerProcess
from mi_sparse_prt.scene.loading import load_scene


def test_a_process_outlives_what_fails_in_it():
    """Expected: results, refusals, exceptions, the end of the process and of its time; and results again after each."""
    with WorkerProcess() as process:
        assert process.call(max, 1, 2, seconds=60) == ("done", 2)
        outcome, sentence = process.call(load_scene, "nowhere", seconds=60)
        assert outcome == "refused" and "nowhere" in sentence
        assert process.call(int, "x", seconds=60)[1].startswith("ValueError")
        assert process.call(os._exit, 3, seconds=60) == ("error", "the process ended with exit code 3")
        start = time.perf_counter()
        assert process.call(time.sleep, 600, seconds=1)[0] == "too long"
        assert time.perf_counter() - start < 60
        assert process.call(max, 1, 2, seconds=60) == ("done", 2)


def test_it_is_killed_from_another_thread():
    """Expected: who waits is told so, and the next call starts it anew."""
    with WorkerProcess() as process:
        assert process.call(max, 1, 2) == ("done", 2)
        killer = threading.Timer(0.2, process.kill)
        killer.start()
        assert process.call(time.sleep, 600) == ("error", "the process ended with exit code -9")
        assert process.call(max, 1, 2) == ("done", 2)


def test_it_ends_with_its_parent_and_never_runs_its_script(tmp_path):
    """Rationale: a script without ``if __name__ == "__main__"`` is not run once more, as ``multiprocessing`` would.

    Expected: printed once; the process that sleeps is gone soon after the one that started it.
    """
    script = tmp_path / "script.py"
    script.write_text(
        "import os, threading, time\n"
        "from mi_sparse_prt.core.worker_process import WorkerProcess\n"
        "process = WorkerProcess()\n"
        "print('pid', process.call(os.getpid)[1], flush=True)\n"
        "threading.Thread(target=process.call, args=(time.sleep, 600), daemon=True).start()\n"
        "time.sleep(0.5)\n"
        "os._exit(0)\n"
    )
    text = subprocess.run([sys.executable, script], capture_output=True, text=True, check=True).stdout
    (line,) = text.splitlines()
    for _ in range(100):
        try:
            os.kill(int(line.split()[1]), 0)
        except ProcessLookupError:
            return
        time.sleep(0.1)
    raise AssertionError("it is still there")
