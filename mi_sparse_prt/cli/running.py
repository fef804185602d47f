"""What all commands share: one-line errors and warnings, exit codes, Ctrl-C, files that appear whole or not at all."""

from __future__ import annotations

import errno
import json
import os
import signal
import sys
import tempfile
import threading
import traceback
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, nullcontext, redirect_stdout
from pathlib import Path
from typing import Any

import typer
from rich.console import Console
from rich.table import Table
from tqdm.auto import tqdm

from mi_sparse_prt.core.errors import PrtError, PrtWarning

FAILED, INTERRUPTED = 1, 130  # exit codes
FILE_WIDTH = 150  # characters of a table's line where there is no terminal
GRACE = 1.0  # seconds that Ctrl-C gives a kernel to end by itself


class Command:
    """What a running command has to say and has written."""

    def __init__(self, quiet: bool) -> None:
        self.report: dict[str, Any] = {}
        self.written: list[Path] = []
        self.hint = ""  # what to do after an interruption
        wide = not sys.stdout.isatty() and "COLUMNS" not in os.environ  # a file or a pipe: rich would take 80
        width = FILE_WIDTH if wide else None
        self._console = Console(quiet=quiet, markup=False, emoji=False, highlight=False, width=width)

    def show(self, *tables: Table) -> None:
        for table in tables:
            self._console.print(table)

    def write_all(self, files: Mapping[Path, bytes]) -> dict[Path, int]:
        """Write some files, see ``write``; their sizes."""
        for path, content in files.items():
            self.write(path, content)
        return {path: len(content) for path, content in files.items()}

    def write(self, path: Path, content: bytes, part_of: Path | None = None) -> None:
        """Write a file under a temporary name beside it, and rename it when it is complete.

        Parameters
        ----------
        path : Path
        content : bytes
        part_of : Path, optional
            The folder that counts as written, if the file is one of many.

        Raises
        ------
        PrtError
            If that fails (full disk, permissions); nothing is left behind.
        """
        temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
        try:
            temporary.write_bytes(content)
            os.replace(temporary, path)
        except OSError as error:
            raise PrtError(
                f"cannot write {path}: {_reason(error)}; free some space or choose another folder"
            ) from None
        finally:
            temporary.unlink(missing_ok=True)
        if (part_of or path) not in self.written:
            self.written.append(part_of or path)

    def interrupted(self) -> str:
        """What Ctrl-C left behind, in a line."""
        done = ", ".join(map(str, self.written))
        return f"interrupted; {done or 'nothing'} was written{self.hint}"

    @contextmanager
    def prompt_interrupts(self) -> Iterator[None]:
        """End the process soon after Ctrl-C, inside a kernel too: Python alone would wait until that has ended.

        Only for work during which no result is written: a thread ends the process without asking the main one.
        """
        reader, writer = os.pipe()
        os.set_blocking(writer, False)
        usual = signal.set_wakeup_fd(writer)  # one byte per signal, its number, at once
        finished = threading.Event()

        def watch() -> None:
            while not finished.is_set():
                if os.read(reader, 1)[0] == signal.SIGINT and not finished.wait(GRACE):
                    print(file=sys.stderr)  # a progress bar or the terminal's ^C stands in the line
                    _complain(self.interrupted())
                    os._exit(INTERRUPTED)

        watcher = threading.Thread(target=watch, daemon=True)
        watcher.start()
        try:
            with _quiet_callbacks():
                yield
        finally:
            finished.set()
            signal.set_wakeup_fd(usual)
            os.write(writer, b"\0")
            watcher.join()
            os.close(reader)
            os.close(writer)

    @contextmanager
    def patient_interrupts(self) -> Iterator[Callable[[], None]]:
        """Let Ctrl-C wait for a call of the function that is given: it raises it where nothing is half done.

        A second Ctrl-C does not wait.
        """
        usual, asked = signal.getsignal(signal.SIGINT), threading.Event()

        def wait(*_: object) -> None:
            asked.set()
            signal.signal(signal.SIGINT, usual)

        def let_interrupt() -> None:
            if asked.is_set():
                raise KeyboardInterrupt

        heard = callable(usual)  # in the background of a shell, it may be ignored
        if heard:
            signal.signal(signal.SIGINT, wait)
        try:
            yield let_interrupt
        finally:
            if heard:
                signal.signal(signal.SIGINT, usual)


@contextmanager
def _quiet_callbacks() -> Iterator[None]:
    """No traceback where Ctrl-C meets a callback, which cannot raise it: numba's compiler has some."""
    usual = sys.unraisablehook

    def hook(found: sys.UnraisableHookArgs) -> None:
        if not issubclass(found.exc_type, KeyboardInterrupt):
            usual(found)

    sys.unraisablehook = hook
    try:
        yield
    finally:
        sys.unraisablehook = usual


@contextmanager
def running(json_file: str | None, quiet: bool, outputs: Iterable[Path | None] = ()) -> Iterator[Command]:
    """Run a command's body: check its outputs first, turn trouble into one line and an exit code, write the JSON."""
    command = Command(quiet)
    to_stdout = json_file == "-"
    try:
        for path in [*outputs, None if to_stdout or json_file is None else Path(json_file)]:
            if path is not None:
                _check_writable(path)
        with _one_line_warnings(), _stdout_is_stderr() if to_stdout else nullcontext():
            yield command
        if json_file is not None:
            text = json.dumps(command.report, indent=1)
            if to_stdout:
                print(text)
            else:
                command.write(Path(json_file), text.encode())
    except KeyboardInterrupt as interrupt:
        traceback.clear_frames(interrupt.__traceback__)  # ends progress bars, so that the message comes last
        _complain(command.interrupted())
        # Where Ctrl-C met source code that a library (numba, dataclasses) ran with `exec`, CPython 3.11's `-m` keeps in
        # mind to end by the signal, whatever the exit code; the next such source makes it forget.
        exec("")
        raise typer.Exit(INTERRUPTED) from None
    except PrtError as error:
        _complain(str(error))
        raise typer.Exit(FAILED) from None
    except OSError as error:
        if error.errno == errno.EPIPE:  # a reader such as `head` has enough
            raise
        _complain(f"{error.filename}: {_reason(error)}" if error.filename else _reason(error))
        raise typer.Exit(FAILED) from None
    except MemoryError as error:
        _complain(f"out of memory ({error}); lower --resolution or --indirect-resolution")
        raise typer.Exit(FAILED) from None


@contextmanager
def _one_line_warnings() -> Iterator[None]:
    """Show the package's warnings as 'warning: ...' between progress bars."""
    with warnings.catch_warnings():
        warnings.simplefilter("always", PrtWarning)
        usual = warnings.showwarning

        def show(message: Warning | str, category: type[Warning], *rest: Any, **more: Any) -> None:
            if issubclass(category, PrtWarning):
                tqdm.write(f"warning: {message}", file=sys.stderr)
            else:
                usual(message, category, *rest, **more)

        warnings.showwarning = show
        yield


@contextmanager
def _stdout_is_stderr() -> Iterator[None]:
    """Send what is printed, by Mitsuba's C++ side too, to standard error."""
    sys.stdout.flush()
    kept = os.dup(1)
    os.dup2(2, 1)
    try:
        with redirect_stdout(sys.stderr):
            yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)


def _complain(message: str) -> None:
    print(f"mi-sparse-prt: {' '.join(message.split())}", file=sys.stderr, flush=True)


def _reason(error: OSError) -> str:
    return error.strerror or str(error) or type(error).__name__


def _check_writable(path: Path) -> None:
    """Find out before an hour of work whether its result can be written."""
    if path.is_dir():
        raise PrtError(f"cannot write {path}: it is a folder; give a file name")
    if path.exists() and not path.is_file():  # /dev/null: the new file would take its place
        raise PrtError(f"cannot write {path}: it is a device or a pipe; give a file name")
    try:
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise PrtError(
            f"cannot write {path}: {path.parent}: {_reason(error)}; choose another folder"
        ) from None


def check_folder(path: Path) -> None:
    """Find out before the work whether files can be written into a folder, which may still have to be made.

    Raises
    ------
    PrtError
        If they cannot.
    """
    _check_writable(next(p for p in (path, *path.absolute().parents) if p.exists()) / "report.json")
