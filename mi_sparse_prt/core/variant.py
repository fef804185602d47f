"""Chooses the Mitsuba variant in which the package runs, once, before any module that uses Mitsuba's types.

Plugins and array types exist per variant, so the choice must be made first; and an unfit libLLVM ends the
whole process the first time a kernel is compiled, so it is looked at before anything runs. Both are done as soon as
Mitsuba is imported, by whomever: what needs no Mitsuba, such as the help of the command line, does not wait for it.
"""

from __future__ import annotations

import ctypes
import os
import platform
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType

from mi_sparse_prt.core.errors import PrtError

VARIANTS = ("cuda_ad_rgb", "llvm_ad_rgb")
OLDEST_LLVM = 17  # 14 to 16 cannot select fmaximum on AVX-512 and abort


def variant() -> str | None:
    """Name of the Mitsuba variant in use."""
    import mitsuba as mi

    return mi.variant()


def check_variant() -> None:
    """Refuse to go on in a variant that was set later and is not supported (PrtError)."""
    name = variant()
    if name not in VARIANTS:
        raise PrtError(f"variant {name} is not supported: use llvm_ad_rgb or cuda_ad_rgb")


def choose_variant(name: str | None = None) -> str:
    """Make sure that Mitsuba runs in a variant which the package supports.

    The first of these decides: `name`; the environment variable ``MI_SPARSE_PRT_VARIANT``; the variant that
    is already set; ``cuda_ad_rgb`` where there is a GPU; ``llvm_ad_rgb``.

    Parameters
    ----------
    name
        ``"cuda_ad_rgb"``, ``"llvm_ad_rgb"`` or None.

    Returns
    -------
    str
        The variant, now set.

    Raises
    ------
    PrtError
        The variant is not one of these two, or has no GPU, or no libLLVM that works.
    """
    import drjit as dr
    import mitsuba as mi

    name = name or os.environ.get("MI_SPARSE_PRT_VARIANT") or mi.variant()
    name = name or ("cuda_ad_rgb" if _cuda_works() else "llvm_ad_rgb")
    if name not in VARIANTS:
        raise PrtError(
            f"Mitsuba variant {name!r} is not supported: call mitsuba.set_variant('llvm_ad_rgb') or "
            "('cuda_ad_rgb') before importing mi_sparse_prt, or set MI_SPARSE_PRT_VARIANT to one of them"
        )
    if name == "llvm_ad_rgb":
        _check_llvm(dr.detail.llvm_version() if dr.has_backend(dr.JitBackend.LLVM) else None)
    elif not dr.has_backend(dr.JitBackend.CUDA):
        raise PrtError("variant cuda_ad_rgb: no CUDA driver or GPU found: use llvm_ad_rgb")
    if mi.variant() != name:
        mi.set_variant(name)
    if name == "llvm_ad_rgb":
        keep_gathers(Path(dr.__file__).parent / "libdrjit-core.so")
    # on one core Mitsuba waits for ever for a thread that reads and writes EXR files
    if dr.thread_count() < 2:
        dr.set_thread_count(2)
    return name


def point_drjit_to_llvm() -> None:
    """Name a libLLVM that works to Dr.Jit, which loads one as soon as it is imported, and for good.

    No other one is named where Dr.Jit has been imported, or ``DRJIT_LIBLLVM_PATH`` is set.
    """
    if "drjit" in sys.modules or "DRJIT_LIBLLVM_PATH" in os.environ:
        return
    path = newest_llvm()
    if path is not None:
        os.environ["DRJIT_LIBLLVM_PATH"] = str(path)


def keep_gathers(drjit_core: Path) -> bool:
    """Have LLVM compile a gather to one instruction, for which AVX2 processors have one, and not to a branch per lane.

    LLVM takes it apart where the instruction is no faster (AMD Zen 1 to 3, Intel Haswell). Kernels run as fast either
    way (Zen 3), but most of what they are made of is lookups, and compiling them takes three times as long in branches.

    Dr.Jit lets its target be chosen in C++ alone. The functions are called by their C++ names, which have the types
    of their arguments in them: where Dr.Jit has other ones, all stays as it is.

    Parameters
    ----------
    drjit_core
        Dr.Jit's library; the backend for LLVM must have been initialised.

    Returns
    -------
    bool
        Whether it was done: not for processors without AVX2, nor with AVX-512, for which LLVM keeps gathers.
    """
    if not drjit_core.exists():
        return False
    library = ctypes.CDLL(str(drjit_core))
    try:
        cpu, features = library._Z19jit_llvm_target_cpuv, library._Z24jit_llvm_target_featuresv
        width, set_target = library._Z21jit_llvm_vector_widthv, library._Z19jit_llvm_set_targetPKcS0_j
    except AttributeError:
        return False
    cpu.restype = features.restype = ctypes.c_char_p
    enabled = features().split(b",")
    if b"+avx2" not in enabled or b"+avx512f" in enabled or b"+fast-gather" in enabled:
        return False
    set_target(cpu(), b",".join([*enabled, b"+fast-gather"]), width())
    return True


def with_mitsuba(then: Callable[[], object]) -> None:
    """Call a function once, as soon as Mitsuba is imported: now, if it has been, or at the end of its import.

    What the function raises is raised by the import, which can be tried again.
    """
    if "mitsuba" in sys.modules:
        then()
    else:
        sys.meta_path.insert(0, _MitsubaAndThen(then))


class _MitsubaAndThen(MetaPathFinder, Loader):
    """Finds and loads Mitsuba as it would be without this, and calls a function when that is done."""

    def __init__(self, then: Callable[[], object]) -> None:
        self._then = then
        self._mitsuba: ModuleType | None = None

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if name != "mitsuba":
            return None
        others = (finder for finder in sys.meta_path if finder is not self)
        spec = next(filter(None, (finder.find_spec(name, path, target) for finder in others)), None)
        if spec is not None and spec.loader is not None:
            self._loader, spec.loader = spec.loader, self
        return spec

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        return self._loader.create_module(spec)

    def exec_module(self, module: ModuleType) -> None:
        module.__loader__ = self._loader
        if module.__spec__ is not None:
            module.__spec__.loader = self._loader
        if self._mitsuba is None:
            self._loader.exec_module(module)  # Mitsuba puts another module into its place, and only once
            self._mitsuba = sys.modules["mitsuba"]
        sys.modules["mitsuba"] = self._mitsuba
        self._then()
        sys.meta_path.remove(self)


def newest_llvm(folders: Iterable[Path] | None = None) -> Path | None:
    """Newest libLLVM of at least version 17 in `folders` (default: where systems keep them), or None."""
    found: list[tuple[list[int], Path]] = []
    for folder in _library_folders() if folders is None else folders:
        for path in folder.glob("libLLVM*.so*"):
            # libLLVM.so.19.1, libLLVM-17.so.1; a plain libLLVM.so is a link to one of them
            match = re.match(r"libLLVM(?:-|\.so\.)(\d+(?:\.\d+)*)", path.resolve().name)
            if match and path.exists():
                found.append(([int(part) for part in match[1].split(".")], path.resolve()))
    version, newest = max(found, default=([0], None))
    return newest if version[0] >= OLDEST_LLVM else None


def _library_folders() -> list[Path]:
    named = [Path(entry) for entry in os.environ.get("LD_LIBRARY_PATH", "").split(":") if entry]
    usual = [f"/usr/lib/{platform.machine()}-linux-gnu", "/usr/lib64", "/usr/lib", "/usr/local/lib"]
    own = sorted(Path("/usr/lib").glob("llvm-*/lib"))  # llvm-19/lib and its like
    return [*named, Path(sys.prefix, "lib"), *map(Path, usual), *own]


def _check_llvm(version: tuple[int, int, int] | None) -> None:
    """Refuse a libLLVM `version` (None: not found) that would abort the process later."""
    if version is not None and version[0] >= OLDEST_LLVM:
        return
    if version is None:
        what = "Dr.Jit found no libLLVM"
    else:
        what = f"libLLVM {'.'.join(map(str, version))} makes Dr.Jit abort, {OLDEST_LLVM} or newer is needed"
    asked = os.environ.get("DRJIT_LIBLLVM_PATH")
    where = f" (DRJIT_LIBLLVM_PATH={asked})" if asked else ""
    better = newest_llvm()
    if better is not None:
        remedy = f"export DRJIT_LIBLLVM_PATH={better} and start Python again"
    else:
        remedy = "apt-get install libllvm19" + (" and unset DRJIT_LIBLLVM_PATH" if asked else "")
    raise PrtError(f"{what}{where}: {remedy}")


def _cuda_works() -> bool:
    """Whether there are a CUDA driver, a device, and the OptiX library that Mitsuba traces rays with."""
    import drjit as dr

    # has_backend waits for the driver's start-up and answers quietly
    if not dr.has_backend(dr.JitBackend.CUDA):
        return False
    try:
        ctypes.CDLL(os.environ.get("DRJIT_LIBOPTIX_PATH", "libnvoptix.so.1"))
    except OSError:  # containers often carry the driver without it
        return False
    return True
