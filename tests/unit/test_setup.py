"""The scripts of .ci and what they must agree on with pyproject.toml; nothing is installed here."""

import hashlib
import os
import re
import shutil
import subprocess
import tomllib
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import pytest

import mi_sparse_prt

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


@pytest.fixture
def checkout(tmp_path):
    """A copy of what .ci/setup reads."""
    shutil.copytree(ROOT / ".ci", tmp_path / ".ci")
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    return tmp_path


def setup(checkout: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    inherited = {k: v for k, v in os.environ.items() if k != "PYTHON"}
    return subprocess.run(
        ["bash", str(checkout / ".ci/setup")],
        cwd="/",
        env={**inherited, "CI": "true", **environment},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=60,
    )


def fake_python(path: Path, python_version: str, exit_status: int) -> Path:
    """A script that tells a version and answers every program with the same exit status."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(
        f'#!/bin/sh\necho "$*" >>"{path}.calls"\n[ "$1" = -V ] && echo Python {python_version} && exit\n'
        f"exit {exit_status}\n"
    )
    path.chmod(0o755)
    return path


@pytest.mark.parametrize("script", ["setup", "demo", "docs", "test", "run"])
def test_scripts_parse(script):
    subprocess.run(["bash", "-n", str(ROOT / ".ci" / script)], check=True)


def test_an_old_python_is_refused_in_one_line(checkout):
    old = fake_python(checkout / "python3.10", "3.10.4", exit_status=1)
    done = setup(checkout, PYTHON=str(old))
    assert done.returncode == 1
    assert len(done.stderr.splitlines()) == 1
    assert "no Python 3.11, 3.12 or 3.13 found" in done.stderr
    assert not (checkout / ".venv").exists()


def test_a_foreign_venv_is_never_deleted(checkout):
    fake_python(checkout / ".venv/bin/python", "3.10.4", exit_status=1)
    done = setup(checkout)
    assert done.returncode == 1
    assert "move it away" in done.stderr
    assert (checkout / ".venv/bin/python").exists()


def test_a_ready_environment_is_left_alone(checkout):
    """Expected: a look at the libraries and no pip, as long as pyproject.toml and Python stay the same."""
    python = fake_python(checkout / ".venv/bin/python", "3.12.1", exit_status=0)
    (checkout / ".venv/.made-for").write_text(f"{checkout}, Python 3.12.1\n")
    digest = hashlib.sha256((checkout / "pyproject.toml").read_bytes()).hexdigest()
    (checkout / ".venv/.installed").write_text(f"{digest}  -\n")
    done = setup(checkout)
    assert done.returncode == 0, done.stderr
    assert "up to date" in done.stdout
    assert "pip" not in Path(f"{python}.calls").read_text()

    (checkout / "pyproject.toml").write_text("# changed\n")
    setup(checkout)
    assert "-m pip install" in Path(f"{python}.calls").read_text()


def test_setup_and_pyproject_want_the_same_python():
    in_setup = re.search(r"not \((\d+), (\d+)\) <= .* <= \((\d+), (\d+)\)", (ROOT / ".ci/setup").read_text())
    low, low_minor, high, high_minor = map(int, in_setup.groups())
    assert PROJECT["project"]["requires-python"] == f">={low}.{low_minor},<{high}.{high_minor + 1}"


def test_setup_and_package_want_the_same_llvm():
    from mi_sparse_prt.core.variant import OLDEST_LLVM

    assert f"llvm_version()[0] < {OLDEST_LLVM})" in (ROOT / ".ci/setup").read_text()


def test_version_has_one_source():
    assert f"\nversion: {mi_sparse_prt.__version__}\n" in (ROOT / "CITATION.cff").read_text()
    try:
        assert version("mi-sparse-prt") == mi_sparse_prt.__version__
    except PackageNotFoundError:
        pytest.skip("the package is not installed, only on the path")
