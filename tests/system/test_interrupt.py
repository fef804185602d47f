"""Ctrl-C on the real program, in the middle of its work."""

import ctypes
import signal
import subprocess
import sys
import time

import pytest

from mi_sparse_prt.cli.running import Command

# Light that bounces in a nearly white box until the paths are long: a wavefront takes seconds.
SCENE = """<scene version="3.0.0">
    <emitter type="constant"/>
    <shape type="cube" id="room">
        <boolean name="flip_normals" value="true"/>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.999, 0.998, 0.997"/></bsdf>
    </shape>
    <shape type="cube" id="box">
        <transform name="to_world"><scale value="0.2"/></transform>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.999"/></bsdf>
    </shape>
</scene>
"""
WORK = [
    "--method",
    "brute_force",
    "--resolution",
    "16",
    "--indirect-resolution",
    "16",
    "--max-depth",
    "400",
    "--spp",
    "64",
    "--edge-length",
    "0.05",
]


@pytest.mark.parametrize("phase", ["about to start", "in a kernel"])
def test_ctrl_c_leaves_nothing(tmp_path, phase):
    """
    Rationale: a user who stops a long run wants the prompt back at once, and no file that looks like a result. Python
        alone would wait for the kernel to end.
    Expected: exit code 130 within 2 s, one line that says so, and only the scene in the folder; before the first
        kernel and inside one.
    Result: 1.0 to 1.1 s in a kernel, which is the second that it is given to end by itself.
    """
    (tmp_path / "scene.xml").write_text(SCENE)
    process = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "mi_sparse_prt",
            "precompute",
            "scene.xml",
            "-o",
            "x.prt",
            "--json",
            "x.json",
            *WORK,
        ],
        cwd=tmp_path,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        # a shell that runs the tests in the background has SIGINT ignored, and programs inherit that
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    try:
        # The scene has a warning, which comes when it is loaded: from there on, the forecast traces.
        first = process.stderr.readline()
        assert first.startswith("warning: "), first
        if phase == "in a kernel":  # the progress bar stands there, unfinished, while the first kernel works
            while "rows/s]" not in first:
                first += process.stderr.read(1)
            time.sleep(1.0)
        assert process.poll() is None, "it was done too soon to be interrupted"
        start = time.perf_counter()
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=30)
        waited = time.perf_counter() - start
    finally:
        process.kill()
    assert process.returncode == 130
    assert errors.splitlines()[-1] == "mi-sparse-prt: interrupted; nothing was written"
    assert "Traceback" not in errors
    assert [p.name for p in tmp_path.iterdir()] == ["scene.xml"]
    assert waited < 2.0


def test_ctrl_c_in_source_that_a_library_runs(tmp_path):
    """
    Rationale: numba and dataclasses run source code with `exec`. Where Ctrl-C met it, CPython ended by the signal (-2),
        not with the exit code, whoever had caught the exception.
    Expected: the exit code of any other interruption.
    """
    program = """
from mi_sparse_prt.cli import app
from mi_sparse_prt.cli.running import running

@app.command()
def work():
    with running(None, quiet=True):
        exec("raise KeyboardInterrupt")

app(["work"])
"""
    (tmp_path / "work.py").write_text(program)
    command = [sys.executable, "-m", "work"]  # as `python -m mi_sparse_prt`
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 130
    assert done.stderr == "mi-sparse-prt: interrupted; nothing was written\n"


def test_ctrl_c_in_a_callback(monkeypatch):
    """One that cannot raise shows nothing; other trouble there does, and so does Ctrl-C once no command runs."""
    shown: list[type] = []
    monkeypatch.setattr(sys, "unraisablehook", lambda found: shown.append(found.exc_type))

    def called_back(error: BaseException) -> None:
        def work() -> int:
            raise error

        ctypes.PYFUNCTYPE(ctypes.c_int)(work)()

    with Command(quiet=True).prompt_interrupts():
        called_back(KeyboardInterrupt())
        called_back(ValueError("trouble"))
    assert shown == [ValueError]
    called_back(KeyboardInterrupt())
    assert shown == [ValueError, KeyboardInterrupt]
