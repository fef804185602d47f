"""How the threads of Dr.Jit, numba and BLAS share the cores: each library has its own, and believes to be alone."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from typing import Any, TypeVar

from threadpoolctl import ThreadpoolController

Result = TypeVar("Result")

PARTS = 8  # for each thread ...
LONG = 64  # ... if they are at least so long


def wait_passively() -> None:
    """Let threads of OpenMP that have nothing to do sleep, unless the environment has another wish.

    As they come, they ask for work all the time, for some milliseconds, on a core that BLAS wants: compression took
    1.4 times as long. They read the variable once, when the first compiled function runs in parallel.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")


@cache
def _libraries() -> ThreadpoolController:
    """Those whose threads can be limited; to look for them takes 3 ms."""
    import scipy.linalg.cython_blas  # noqa: F401 - numba's BLAS: not found here, it would never be limited

    return ThreadpoolController()


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Products of matrices stay in the threads that ask for them."""
    with _libraries().limit(limits=1, user_api="blas"):
        yield


@contextmanager
def one_thread() -> Iterator[None]:
    """Products, and compiled functions that this thread calls, use no others."""
    import numba  # 0.3 s, and ``import mi_sparse_prt`` comes by here

    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        with one_blas_thread():
            yield
    finally:
        numba.set_num_threads(threads)


def run_in_parts(kernel: Callable[..., None], count: int, *arguments: Any) -> None:
    """Call ``kernel(start, end, *arguments)`` for parts of ``range(count)``, in as many threads as numba would use.

    For compiled functions that let go of the interpreter (``nogil=True``) and whose parts write to places of their
    own. numba compiles a loop of ``prange`` several times over: these compile in a half to a third of the time. Threads
    take part after part, as some take longer than others.
    """
    import numba  # as above

    threads = max(min(numba.get_num_threads(), count), 1)
    parts = threads * (PARTS if threads > 1 and count >= PARTS * threads * LONG else 1)
    bounds = [count * part // parts for part in range(parts + 1)]
    remaining = iter(list(zip(bounds, bounds[1:], strict=False)))

    def work() -> None:
        for part in remaining:
            kernel(*part, *arguments)

    others = [_pool().submit(work) for _ in range(threads - 1)]
    work()
    for future in others:
        future.result()


@cache
def _pool() -> ThreadPoolExecutor:
    """Threads that stay: to start them takes as long as some kernels."""
    return ThreadPoolExecutor(os.cpu_count(), "mi_sparse_prt")


def run_overlapped(tasks: Iterable[Callable[[], Result]]) -> Iterator[Result]:
    """Results of tasks, in their order; some are worked on while the next ones are prepared."""
    workers = 2  # beside the thread that prepares their tasks
    with one_thread(), ThreadPoolExecutor(workers) as pool:
        pending: deque[Future[Result]] = deque()
        for task in tasks:
            while len(pending) > workers:
                yield pending.popleft().result()
            pending.append(pool.submit(task))
        for future in pending:
            yield future.result()
