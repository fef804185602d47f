"""Which kernels Dr.Jit launched: compiling one costs as much as tracing millions of rays with it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr


@dataclass(frozen=True)
class Kernels:
    """Kernels that a call launched.

    Attributes
    ----------
    launches : int
    distinct : int
        Different kernels: 1 when a single kernel serves blocks of any offset and size.
    in_memory, on_disk, compiled : int
        Where a launch found its kernel: in this process, in ``~/.drjit``, or nowhere, so that it was compiled.
    compile_seconds : float
        Time in LLVM or PTX, and in generating code for it.
    hashes : frozenset of str
        Which kernels.
    """

    launches: int
    distinct: int
    in_memory: int
    on_disk: int
    compiled: int
    compile_seconds: float
    hashes: frozenset[str]

    def report(self) -> dict[str, Any]:
        """Everything but the hashes, for JSON."""
        return {name: value for name, value in vars(self).items() if name != "hashes"}


def launched_kernels(work: Callable[[], Any]) -> Kernels:
    """The kernels that a call launches."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        work()
        history = dr.kernel_history([dr.KernelType.JIT])
    on_disk = sum(bool(kernel["cache_disk"]) for kernel in history)  # a cache_hit, too, to Dr.Jit
    known = sum(bool(kernel["cache_hit"] or kernel["cache_disk"]) for kernel in history)
    hashes = frozenset(kernel["hash"] for kernel in history)
    return Kernels(
        len(history),
        len(hashes),
        known - on_disk,
        on_disk,
        len(history) - known,
        sum(kernel["codegen_time"] + kernel["backend_time"] for kernel in history) / 1e3,
        hashes,
    )
