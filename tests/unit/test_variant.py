"""The choice of the variant: on stand-ins for Mitsuba and Dr.Jit, and for real in processes of their own."""

import ctypes
import importlib
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from mi_sparse_prt import PrtError

variant = importlib.import_module("mi_sparse_prt.core.variant")  # the package's own `variant` is the function


@pytest.fixture
def machine(monkeypatch):
    """Returns a function that replaces Mitsuba and Dr.Jit by those of a machine with the given traits."""

    def make(current=None, cuda=False, optix=True, llvm=(19, 1, 7), forced=None):
        state = SimpleNamespace(current=current)
        mitsuba = SimpleNamespace(
            variant=lambda: state.current, set_variant=lambda name: setattr(state, "current", name)
        )
        drjit = SimpleNamespace(
            __file__="/nowhere/drjit/__init__.py",
            JitBackend=SimpleNamespace(CUDA="cuda", LLVM="llvm"),
            thread_count=lambda: 2,
            has_backend=lambda backend: cuda if backend == "cuda" else llvm is not None,
            detail=SimpleNamespace(llvm_version=lambda: llvm),
        )
        monkeypatch.setitem(sys.modules, "mitsuba", mitsuba)
        monkeypatch.setitem(sys.modules, "drjit", drjit)
        monkeypatch.setenv("DRJIT_LIBOPTIX_PATH", "libc.so.6" if optix else "/nowhere/libnvoptix.so.1")
        monkeypatch.delenv("MI_SPARSE_PRT_VARIANT", raising=False)
        monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
        if forced:
            monkeypatch.setenv("MI_SPARSE_PRT_VARIANT", forced)
        return state

    return make


@pytest.mark.parametrize(
    ("traits", "expected"),
    [
        ({}, "llvm_ad_rgb"),
        ({"cuda": True}, "cuda_ad_rgb"),
        ({"cuda": True, "llvm": None}, "cuda_ad_rgb"),
        ({"cuda": True, "optix": False}, "llvm_ad_rgb"),
        ({"cuda": True, "current": "llvm_ad_rgb"}, "llvm_ad_rgb"),
        ({"cuda": True, "forced": "llvm_ad_rgb"}, "llvm_ad_rgb"),
        ({"current": "scalar_rgb", "forced": "llvm_ad_rgb"}, "llvm_ad_rgb"),
        ({"llvm": (17, 0, 0)}, "llvm_ad_rgb"),
    ],
)
def test_choice(machine, traits, expected):
    state = machine(**traits)
    assert variant.choose_variant() == expected
    assert state.current == expected


def test_the_argument_wins(machine):
    state = machine(cuda=True, current="cuda_ad_rgb", forced="cuda_ad_rgb")
    variant.choose_variant("llvm_ad_rgb")
    assert state.current == "llvm_ad_rgb"


@pytest.mark.parametrize(
    ("traits", "message"),
    [
        ({"current": "scalar_rgb"}, r"'scalar_rgb' is not supported: .*set_variant\('llvm_ad_rgb'\)"),
        ({"current": "llvm_ad_spectral"}, "'llvm_ad_spectral' is not supported"),
        ({"forced": "cuda_ad_rgb"}, "no CUDA driver or GPU"),
        ({"llvm": (16, 0, 6)}, "libLLVM 16.0.6 makes Dr.Jit abort.*apt-get install libllvm19$"),
        ({"llvm": None}, "found no libLLVM: apt-get install libllvm19$"),
        ({"current": "llvm_ad_rgb", "llvm": (14, 0, 6)}, "libLLVM 14.0.6"),
    ],
)
def test_refusals_are_one_line(machine, monkeypatch, traits, message):
    state = machine(**traits)
    monkeypatch.setattr(variant, "newest_llvm", lambda: None)
    with pytest.raises(PrtError, match=message) as refused:
        variant.choose_variant()
    assert "\n" not in str(refused.value)
    assert state.current == traits.get("current")


def test_newest_llvm_reads_versions_and_not_letters(tmp_path):
    for name in ("libLLVM-9.so.1", "libLLVM-16.so.1", "libLLVM-C.so", "libLLVM-17.so.1", "libLLVM.so.19.1"):
        (tmp_path / name).touch()
    (tmp_path / "libLLVM-21.so").symlink_to(tmp_path / "removed")
    (tmp_path / "libLLVM.so").symlink_to("libLLVM-16.so.1")
    assert variant.newest_llvm([tmp_path, tmp_path / "absent"]) == tmp_path / "libLLVM.so.19.1"


def test_newest_llvm_refuses_those_that_abort(tmp_path):
    for name in ("libLLVM-14.0.6.so.1", "libLLVM-15.so.1", "libLLVM-16.so.1"):
        (tmp_path / name).touch()
    assert variant.newest_llvm([tmp_path]) is None


def run_python(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    inherited = {
        k: v for k, v in os.environ.items() if k not in ("DRJIT_LIBLLVM_PATH", "MI_SPARSE_PRT_VARIANT")
    }
    root = str(Path(__file__).parents[2])
    return subprocess.run(
        [sys.executable, "-c", code],
        env={**inherited, "PYTHONPATH": root, **environment},
        capture_output=True,
        text=True,
        timeout=120,
    )


def test_the_chosen_llvm_compiles_the_kernel_that_aborts_old_ones():
    done = run_python(
        "import mi_sparse_prt as prt, mitsuba as mi, drjit as dr\n"
        "print(prt.variant(), dr.max(mi.Float([1, 3, 2]))[0])",
        MI_SPARSE_PRT_VARIANT="llvm_ad_rgb",
    )
    assert done.stdout.split() == ["llvm_ad_rgb", "3.0"], done.stderr


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="the system cannot give a process one core")
def test_gathers_are_kept_where_llvm_takes_them_apart():
    """A variant that was chosen has compiled with gathers ever since, on AVX2; nothing to do on other processors."""
    import drjit as dr

    core = Path(dr.__file__).parent / "libdrjit-core.so"
    if not core.exists():
        assert sys.platform != "linux"
        return
    library = ctypes.CDLL(str(core))
    library._Z24jit_llvm_target_featuresv.restype = ctypes.c_char_p
    features = library._Z24jit_llvm_target_featuresv().split(b",")
    assert b"+avx2" not in features or b"+avx512f" in features or features.count(b"+fast-gather") == 1
    assert not variant.keep_gathers(core)


def test_a_drjit_with_other_functions_is_left_as_it_is():
    assert not variant.keep_gathers(Path("libc.so.6"))
    assert not variant.keep_gathers(Path(importlib.import_module("_ctypes").__file__))


def test_environments_are_read_on_one_core(tmp_path):
    """
    Rationale: Mitsuba's OpenEXR waits for threads of Dr.Jit's pool, of which one core has none: it never returned.
    Expected: a picture is written and read within two minutes, which are the limit of the process.
    """
    done = run_python(
        "import os; os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})\n"
        "import numpy as np, mitsuba as mi, mi_sparse_prt as prt\n"
        f"path = {str(tmp_path / 'sky.exr')!r}\n"
        "mi.Bitmap(np.ones((64, 128, 3), np.float32)).write(path)\n"
        "print(prt.CubemapLighting(1).project(prt.load_environment(path)).shape)",
        MI_SPARSE_PRT_VARIANT="llvm_ad_rgb",
    )
    assert done.stdout == "(6, 3)\n", done.stderr


def test_an_llvm_that_aborts_is_refused_before_it_can():
    """Expected: an exception with the remedy and exit status 1, where Dr.Jit alone ends by SIGABRT."""
    old = [p for p in Path("/usr/lib").glob("*-linux-gnu/libLLVM-1[456].so.1")]
    if not old:
        pytest.skip("no libLLVM 14, 15 or 16 on this machine")
    done = run_python(
        "import mi_sparse_prt, mitsuba as mi, drjit as dr\ndr.max(mi.Float([1, 3, 2]))[0]",
        DRJIT_LIBLLVM_PATH=str(old[0]),
        MI_SPARSE_PRT_VARIANT="llvm_ad_rgb",
    )
    assert done.returncode == 1
    last = done.stderr.splitlines()[-1]
    assert last.startswith("mi_sparse_prt.core.errors.PrtError: libLLVM 1")
    assert str(old[0]) in last
    assert "export DRJIT_LIBLLVM_PATH" in last or "apt-get install libllvm19" in last


@pytest.mark.parametrize(
    "other", ["scalar_rgb", pytest.param("llvm_ad_mono", marks=pytest.mark.slow), "llvm_ad_spectral"]
)
def test_variants_that_are_set_later_are_refused_by_name(other, tmp_path):
    """A file is not loaded there, and the integrator says where it works instead of not being found."""
    scene = tmp_path / "scene.xml"
    scene.write_text('<scene version="3.0.0"><integrator type="sparse_prt"/></scene>')
    done = run_python(
        "import mi_sparse_prt as prt, mitsuba as mi\n"
        f"mi.set_variant({other!r})\n"
        f"for load in prt.load_scene, mi.load_file:\n    try:\n        load({str(scene)!r})\n"
        "    except Exception as error:\n        print(str(error).splitlines()[-1])\n"
        "mi.set_variant('llvm_ad_rgb')\nprint(type(mi.load_dict({'type': 'sparse_prt'})).__name__)",
        MI_SPARSE_PRT_VARIANT="llvm_ad_rgb",
    )
    assert done.stdout.splitlines() == [
        f"variant {other} is not supported: use llvm_ad_rgb or cuda_ad_rgb",
        f"PrtError: plugins of mi_sparse_prt are those of llvm_ad_rgb, not of {other}: "
        "call mitsuba.set_variant('llvm_ad_rgb')",
        "SparsePRT",
    ]
