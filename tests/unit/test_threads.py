"""How libraries share the cores: order, errors and limits of overlapped tasks; what importing the package sets."""

import json
import os
import subprocess
import sys
import threading
import time

import numba
import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from mi_sparse_prt.core.threads import run_in_parts, run_overlapped


def test_results_come_in_the_order_of_their_tasks() -> None:
    def late_first(i: int) -> int:
        time.sleep(0.02 * (i % 3 == 0))
        return i

    assert list(run_overlapped(lambda i=i: late_first(i) for i in range(20))) == list(range(20))


def test_tasks_run_beside_the_thread_that_prepares_the_next() -> None:
    """The first one waits for what happens when the second one is made."""
    second_is_made = threading.Event()

    def tasks():
        yield lambda: second_is_made.wait(10)
        second_is_made.set()
        yield lambda: True

    assert list(run_overlapped(tasks())) == [True, True]


def test_an_error_in_a_task_is_raised_and_threads_are_given_back() -> None:
    before = numba.get_num_threads(), [p["num_threads"] for p in threadpool_info()]

    def tasks():
        for i in range(6):
            yield lambda i=i: 1 // (i - 2)

    with pytest.raises(ZeroDivisionError):
        list(run_overlapped(tasks()))
    assert (numba.get_num_threads(), [p["num_threads"] for p in threadpool_info()]) == before


def test_products_and_kernels_use_one_thread_meanwhile() -> None:
    def limits() -> list[int]:
        return [p["num_threads"] for p in threadpool_info() if p["user_api"] == "blas"]

    def tasks():
        yield limits
        assert numba.get_num_threads() == 1

    with threadpool_limits(2, user_api="blas"):
        (found,) = run_overlapped(tasks())
    assert found and set(found) == {1}


@pytest.mark.parametrize(("given", "expected"), [(None, "passive"), ("active", "active")])
def test_waiting_threads_sleep_unless_they_are_told_otherwise(given: str | None, expected: str) -> None:
    environment = {key: value for key, value in os.environ.items() if key != "OMP_WAIT_POLICY"}
    if given:
        environment["OMP_WAIT_POLICY"] = given
    code = "import os, mi_sparse_prt; print(os.environ['OMP_WAIT_POLICY'])"
    run = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    assert run.stdout.split() == [expected], run.stderr


LATE_LIBRARY = """
import numpy as np, numba
from threadpoolctl import threadpool_info
from mi_sparse_prt.core.threads import one_blas_thread

product = numba.njit(lambda a: np.dot(a, a))
with one_blas_thread():
    product(np.ones((8, 8)))
    print([p["num_threads"] for p in threadpool_info() if p["user_api"] == "blas"])
"""


def test_libraries_that_numba_loads_later_are_limited_too() -> None:
    """numba's products are those of SciPy's BLAS, which is loaded with the first of them."""
    run = subprocess.run(
        [sys.executable, "-c", LATE_LIBRARY], capture_output=True, text=True, check=True, timeout=120
    )
    limits = json.loads(run.stdout)
    assert len(limits) >= 2
    assert set(limits) == {1}


@pytest.mark.parametrize("count", [0, 1, 3, 700, 5000])
@pytest.mark.parametrize("threads", [1, 2])
def test_parts_are_the_whole_once(count: int, threads: int) -> None:
    """Expected: every number of the range is in one part, however long it is; errors of any thread come out."""
    before, visits = numba.get_num_threads(), np.zeros(count, int)
    numba.set_num_threads(min(threads, before))
    try:

        def visit(start: int, end: int, into: np.ndarray) -> None:
            into[start:end] += 1

        run_in_parts(visit, count, visits)
        assert np.all(visits == 1)

        def fail(start: int, end: int) -> None:
            if start <= count - 1 < end:
                raise ValueError("the last one")

        if count:
            with pytest.raises(ValueError, match="the last one"):
                run_in_parts(fail, count)
    finally:
        numba.set_num_threads(before)
