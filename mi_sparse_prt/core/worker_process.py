"""A process beside this one: what takes too long there is ended with it, and what takes it down takes nothing else."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any

from mi_sparse_prt.core.errors import PrtError

DONE, REFUSED, ERROR, TOO_LONG = "done", "refused", "error", "too long"
START = "import sys; from mi_sparse_prt.core.worker_process import serve; serve(int(sys.argv[1]))"
GRACE = 5.0  # seconds in which an idle process may end by itself


class WorkerProcess:
    """A process that does one thing after the other; ended when one takes too long, and started again.

    Used as a context; what it has loaded and compiled stays from one thing to the next.
    """

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._connection: Connection | None = None

    def __enter__(self) -> WorkerProcess:
        return self

    def __exit__(self, *reasons: object) -> None:
        if self._connection is not None and self._process is not None:
            self._connection.close()
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(GRACE)
        self._end()

    def call(
        self, work: Callable[..., Any], *arguments: Any, seconds: float | None = None
    ) -> tuple[str, Any]:
        """Do something in the process: ``"done"`` and its result, or how it failed and a sentence.

        ``"refused"`` by a ``PrtError``, ``"error"`` by any other exception or by the end of the process,
        ``"too long"`` after ``seconds``.
        """
        process, connection = self._started()
        try:
            connection.send((work, arguments))
            if not connection.poll(seconds):
                self._end()
                return TOO_LONG, f"ended after {seconds:g} s"
            return connection.recv()
        except (EOFError, OSError):
            code = process.wait()
            self._end()
            return ERROR, f"the process ended with exit code {code}"

    def kill(self) -> None:
        """End it at once, from whichever thread; a ``call`` that waits is answered with ``"error"``."""
        if self._process is not None:
            self._process.kill()

    def _started(self) -> tuple[subprocess.Popen[bytes], Connection]:
        if self._process is None or self._connection is None:
            ours, theirs = socket.socketpair()
            with ours, theirs:  # closed here, so that the end of the process is that of the connection
                self._process = subprocess.Popen(
                    [sys.executable, "-P", "-c", START, str(theirs.fileno())],
                    stdin=subprocess.PIPE,  # never written to: it ends with this process
                    env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
                    pass_fds=[theirs.fileno()],
                )
                self._connection = Connection(ours.detach())
        return self._process, self._connection

    def _end(self) -> None:
        if self._process is not None and self._connection is not None:
            self._process.kill()  # gently would not do: a kernel that runs listens to nothing else
            self._process.wait()
            assert self._process.stdin is not None
            self._process.stdin.close()
            self._connection.close()
            self._process = self._connection = None


def serve(number: int) -> None:
    """Do what is asked for until nobody asks any more: what the process does.

    Parameters
    ----------
    number : int
        Of the file that is its end of the connection.
    """
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C ends it at once and without a word
    threading.Thread(target=_end_with_parent, daemon=True).start()
    connection = Connection(number)
    while True:
        try:
            work, arguments = connection.recv()
        except EOFError:
            return
        try:
            answer = DONE, work(*arguments)
        except Exception as error:  # whatever it is belongs into the answer
            answer = _explained(error)
        connection.send(answer)


def _end_with_parent() -> None:
    """End this process when the one that started it is gone: nobody waits for the answer any more."""
    sys.stdin.read()
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
