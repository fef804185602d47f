"""Compares run times of this checkout with those of another one, which may be older.

    python docs/paired_times.py OTHER_CHECKOUT [--jobs bunny glossy_bunny ...] [--pairs 9]

Each checkout has a process that stays warm. A job runs in turns: this, other, other, this, this, other ..., never in
both at once, so that a machine that becomes slower for a minute slows down both of a pair. The first run of each
compiles and is not counted. Both read the scenes of this checkout, and do the same by a plan that is given, whatever
``"auto"`` would choose. Factors of BRDFs are found in a cache on disk by checkouts that have one.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import cache
from importlib import import_module
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parents[1]
JOBS = ("bunny", "glossy_bunny", "compression", "spot", "dancer", "terrace", "load")
WORKER = "--worker"  # in place of the other checkout: this process does what its standard input says
PLANS = ("mi_sparse_prt.methods.plan", "mi_sparse_prt.planner.plan")  # where Plan is, and where it was

Run = Callable[[], object]


# --- the comparison -----------------------------------------------------------------------------------------


class WorkerError(Exception):
    """One line: which checkout, which job, and what is wrong."""


class Summary(NamedTuple):
    """Of pairs of runs: ratios this / other, and seconds."""

    ratio: float
    lowest: float
    highest: float
    this: float
    other: float


class Worker:
    """The warm process of a checkout.

    Parameters
    ----------
    checkout : Path
        The folder that holds ``mi_sparse_prt``.
    """

    def __init__(self, checkout: Path) -> None:
        self._checkout = checkout
        self._process = subprocess.Popen(
            [sys.executable, __file__, WORKER],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | {"PYTHONPATH": str(checkout)},
        )

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, *exception: object) -> None:
        self._process.communicate()  # the end of its input is the end of its work

    def setup(self, job: str) -> int | None:
        """Prepare a job; the bytes of the file that it reads, if it reads one."""
        return self._asked("setup", job)

    def seconds(self, job: str) -> float:
        """Of one run of the job that was prepared last."""
        return self._asked("run", job)

    def _asked(self, what: str, job: str) -> Any:
        assert self._process.stdin and self._process.stdout
        try:
            print(json.dumps([what, job]), file=self._process.stdin, flush=True)
        except BrokenPipeError:
            pass  # there is no answer either
        answer = self._process.stdout.readline()
        if not answer:
            raise WorkerError(
                f"{self._checkout}: {job}: the process ended with exit status {self._process.wait()}"
            )
        value, error = json.loads(answer)
        if error:
            raise WorkerError(f"{self._checkout}: {job}: {error}")
        return value


def summarised(pairs: list[tuple[float, float]]) -> Summary:
    """What pairs of seconds, this and other, say.

    The ratio is the median of each pair's, which is not the ratio of the medians: a slow minute cancels out.
    """
    ratios = [this / other for this, other in pairs]
    this, other = (median(seconds) for seconds in zip(*pairs, strict=True))
    return Summary(median(ratios), min(ratios), max(ratios), this, other)


def timed_pairs(this: Run, other: Run, pairs: int) -> Iterator[tuple[Any, Any]]:
    """What two calls return, in turns: who was last goes first in the next pair."""
    for pair in range(pairs):
        if pair % 2 == 0:
            first = this()
            yield first, other()
        else:
            second = other()
            yield this(), second


def compare(this: Worker, other: Worker, job: str, pairs: int) -> None:
    """Print a line on a job, and another one if it reads a file."""
    sizes = this.setup(job), other.setup(job)
    both = list(timed_pairs(lambda: this.seconds(job), lambda: other.seconds(job), pairs + 1))
    found = summarised(both[1:])
    spread = f"{found.lowest:.3f} to {found.highest:.3f}"
    print(
        f"{job:<12} {found.ratio:.3f} ({spread}) this {found.this:.4g} s, other {found.other:.4g} s",
        flush=True,
    )
    if sizes[0] and sizes[1]:
        size = f"this {sizes[0]} bytes, other {sizes[1]} bytes"
        print(f"{'size':<12} {sizes[0] / sizes[1]:.3f} {size}", flush=True)


def main() -> None:
    """Print the ratios of all jobs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("other", type=Path, metavar="OTHER_CHECKOUT")
    parser.add_argument("--jobs", nargs="+", choices=JOBS, default=JOBS, metavar="JOB", help=", ".join(JOBS))
    parser.add_argument("--pairs", type=int, default=9, help="counted runs of each; 9 if not given")
    options = parser.parse_args()
    checkout = options.other.resolve()
    if not (checkout / "mi_sparse_prt").is_dir():
        parser.error(f"{checkout} is no checkout: it holds no mi_sparse_prt")
    if options.pairs < 1:
        parser.error("--pairs is 1 or more")
    print(
        f"this / other: medians of {options.pairs} pairs (range); this {ROOT}, other {checkout}", flush=True
    )
    try:
        with Worker(ROOT) as this, Worker(checkout) as other:
            for job in options.jobs:
                compare(this, other, job, options.pairs)
    except WorkerError as error:
        sys.exit(str(error))


# --- the worker: what runs in both checkouts ----------------------------------------------------------------


def work() -> None:
    """Answer each line of the standard input by one: a value, and an error or null."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what others print is no answer
    job: Run | None = None
    with tempfile.TemporaryDirectory() as folder:
        for line in sys.stdin:
            what, name = json.loads(line)
            value: float | None = None
            error = None
            try:
                if what == "setup":
                    path = Path(folder) / f"{name}.prt"
                    job = prepared(name, path)
                    value = path.stat().st_size if path.exists() else None
                elif job:
                    value = seconds_of(job)
            except Exception as raised:
                error = " ".join(f"{type(raised).__name__}: {raised}".split())
            print(json.dumps([value, error]), file=answers, flush=True)


def seconds_of(job: Run) -> float:
    """Of one run; what the last one left behind is collected before, and what it returns dropped after."""
    gc.collect()
    start = time.perf_counter()
    result = job()
    seconds = time.perf_counter() - start
    del result
    return seconds


def prepared(job: str, path: Path) -> Run:
    """What is to be timed: calls that all checkouts know. A file is saved under the path if the job reads one."""
    import mi_sparse_prt as prt

    checkout = Path(os.environ["PYTHONPATH"])
    if checkout not in Path(prt.__file__).parents:
        raise ImportError(f"the package is {prt.__file__}")
    if job == "glossy_bunny":
        scene = prt.load_scene(ROOT / "scenes_xml" / "glossy_bunny.xml")
        # older ones have no precompute(terms=4), whose plan is the same
        return lambda: prt.precompute_glossy(scene, prt.CubemapLighting(32), terms=4, progress=False)
    if job == "compression":
        matrix = bunny_matrix()
        return lambda: prt.compress(matrix, progress=False)
    if job == "load":
        bunny_matrix().save(path)
        return lambda: prt.load_transport(path)
    return precomputation(job)


def precomputation(name: str) -> Callable[[], Any]:
    """Of a diffuse scene's matrix, by one plan."""
    import mi_sparse_prt as prt

    plan = plan_class()("consensus", "gather", 256, 0.06)
    scene = prt.load_scene(ROOT / "scenes_xml" / f"{name}.xml")
    return lambda: prt.precompute(scene, prt.CubemapLighting(32), plan, progress=False)


@cache
def bunny_matrix() -> Any:
    """What is compressed, saved and loaded."""
    return precomputation("bunny")()


def plan_class() -> Any:
    """``Plan``, wherever this checkout has it."""
    try:
        return import_module(PLANS[0]).Plan
    except ModuleNotFoundError:
        return import_module(PLANS[1]).Plan


if __name__ == "__main__":
    if sys.argv[1:] == [WORKER]:
        work()
    else:
        main()
