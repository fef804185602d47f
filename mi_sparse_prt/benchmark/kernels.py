"""Which kernels Dr.Jit launched: compiling one costs as much as tracing millions of rays with it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import drjit as dr


@dataclass
class Kernels:
    """Kernels launched in a block of code.

    Attributes
    ----------
    launches : int
    distinct : int
        Different kernels: 1 when a single kernel serves blocks of any offset and size.
    in_memory, on_disk, compiled : int
        Where a launch found its kernel: in this process, in ``~/.drjit``, or nowhere, so that it was compiled.
    compile_seconds : float
        Time in LLVM or PTX, and in generating code for it.
    """

    launches: int = 0
    distinct: int = 0
    in_memory: int = 0
    on_disk: int = 0
    compiled: int = 0
    compile_seconds: float = 0.0
    hashes: set[str] = field(default_factory=set, repr=False)

    def report(self) -> dict[str, Any]:
        """Everything but the hashes, for JSON."""
        return {name: value for name, value in vars(self).items() if name != "hashes"}


@contextmanager
def recorded_kernels() -> Iterator[Kernels]:
    """Count the kernels that are launched inside a ``with`` block; the counts are filled in at its end."""
    found = Kernels()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        yield found
        history = dr.kernel_history([dr.KernelType.JIT])
    for kernel in history:
        found.launches += 1
        found.hashes.add(kernel["hash"])
        found.compile_seconds += (kernel["codegen_time"] + kernel["backend_time"]) / 1e3
        if kernel["cache_disk"]:  # this too is a cache_hit to Dr.Jit
            found.on_disk += 1
        elif kernel["cache_hit"]:
            found.in_memory += 1
        else:
            found.compiled += 1
    found.distinct = len(found.hashes)


def kernels_of(work: Callable[[], Any]) -> Kernels:
    """The kernels that a call launches."""
    with recorded_kernels() as found:
        work()
    return found
