"""What ``import mi_sparse_prt`` does: names on first use, Mitsuba prepared as soon as it is imported."""

import ast
import subprocess
from pathlib import Path

import pytest
from test_variant import run_python

import mi_sparse_prt as prt

HEAVY = ("mitsuba", "drjit", "numba", "numpy", "scipy", "matplotlib", "zarr")
LOADED = f"print(sorted(set({HEAVY}) & set(sys.modules)))"


def printed(done: subprocess.CompletedProcess[str]) -> list[str]:
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_names_are_those_that_type_checkers_see():
    tree = ast.parse(Path(prt.__file__).read_text())
    (block,) = (node for node in tree.body if isinstance(node, ast.If))
    imported = {
        alias.name: line.module.removeprefix("mi_sparse_prt.") for line in block.body for alias in line.names
    }
    assert imported == prt._MODULES
    assert set(prt.__all__) == {*imported, "PrtError", "PrtWarning", "__version__", "variant"}
    assert set(prt.__all__) <= set(dir(prt))
    for name in imported:
        assert getattr(prt, name).__module__ == f"mi_sparse_prt.{imported[name]}"
    with pytest.raises(AttributeError, match="has no attribute 'precomptue'"):
        prt.precomptue  # noqa: B018


def test_a_module_does_not_take_the_place_of_a_name():
    """Python sets a package's attribute when it imports a submodule: `precompute` is a function and a module."""
    done = run_python("import mi_sparse_prt as prt, mi_sparse_prt.precompute\nprint(prt.precompute.__name__)")
    assert printed(done) == ["precompute"]


def test_nothing_large_is_imported_before_it_is_used():
    assert printed(run_python(f"import sys, mi_sparse_prt\n{LOADED}")) == ["[]"]


@pytest.mark.parametrize("order", ["mi_sparse_prt, mitsuba", "mitsuba, mi_sparse_prt", "mi_sparse_prt.scene"])
def test_variant_and_plugins_are_there_once_both_are_imported(order):
    done = run_python(
        f"import {order}, mitsuba as mi\n"
        "print(mi.variant(), *(type(mi.load_dict({'type': name})).__name__\n"
        "      for name in ('phong', 'ashikhmin_shirley')), mi.Float(3)[0])",
        MI_SPARSE_PRT_VARIANT="llvm_ad_rgb",
    )
    assert printed(done) == ["llvm_ad_rgb Phong AshikhminShirley 3.0"]


def test_a_refused_variant_can_be_chosen_again():
    """Expected: the import of Mitsuba says what is wrong, and works once that has been mended."""
    done = run_python(
        "import os, mi_sparse_prt as prt\n"
        "for name in 'scalar_rgb', 'scalar_rgb', 'llvm_ad_rgb':\n"
        "    os.environ['MI_SPARSE_PRT_VARIANT'] = name\n"
        "    try:\n"
        "        import mitsuba\n"
        "        print(mitsuba.variant())\n"
        "    except prt.PrtError as error:\n"
        "        print(error)"
    )
    *refused, chosen = printed(done)
    assert len(refused) == 2 and all("'scalar_rgb' is not supported" in line for line in refused)
    assert chosen == "llvm_ad_rgb"


def test_finders_are_as_before_when_mitsuba_is_there():
    done = run_python(
        "import sys\nbefore = list(sys.meta_path)\nimport mi_sparse_prt, mitsuba\n"
        "print(sys.meta_path == before, 'mi_sparse_prt' in type(mitsuba.__spec__.loader).__module__)"
    )
    assert printed(done) == ["True False"]


# ------------------------------------------------------------------------------------------------ command line


def command_line(*arguments: str, before: str = "", **environment: str) -> subprocess.CompletedProcess[str]:
    """The command line in a process of its own, after some lines of Python."""
    return run_python(
        f"{before}\nfrom mi_sparse_prt.cli import app\napp({list(arguments)}, prog_name='mi-sparse-prt')",
        **environment,
    )


@pytest.mark.parametrize(
    "command",
    ["", "precompute", "relight", "view", "validate", "info", "benchmark", "pictures", "many-lights"],
)
def test_help_imports_nothing_large(command):
    when_it_ends = f"import atexit, sys\natexit.register(lambda: {LOADED})"
    lines = printed(command_line(*filter(None, [command]), "--help", before=when_it_ends))
    assert "Usage" in lines[1] and lines[-1] == "[]"


@pytest.mark.parametrize("arguments", [["info", "x.prt"], ["precompute", "x.xml", "-o", "x.prt"]])
def test_a_refused_variant_is_one_line(arguments):
    done = command_line(*arguments, MI_SPARSE_PRT_VARIANT="scalar_rgb")
    assert done.returncode == 1 and done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert line.startswith("mi-sparse-prt: Mitsuba variant 'scalar_rgb' is not supported")


def test_the_program_runs_in_the_variant_that_is_asked_for():
    """Expected: no second start, as Mitsuba has not been imported when options are read."""
    done = run_python(
        "import os\nfrom mi_sparse_prt.cli import app\ndel os.execv\n"
        "try:\n    app(['precompute', 'none.xml', '-o', 'x.prt', '--variant', 'llvm_ad_rgb'])\n"
        "except SystemExit as end:\n    import mitsuba\n    print(end.code, mitsuba.variant())"
    )
    assert printed(done) == ["1 llvm_ad_rgb"]
    assert "none.xml" in done.stderr
