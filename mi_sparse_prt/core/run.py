"""One run of a computation: its clock, its progress, its seed, and where it keeps what is finished."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from mi_sparse_prt.core.profiling import Stopwatch


@dataclass(frozen=True)
class Run:
    """What stages share, and what no result depends on but for the seed.

    Attributes
    ----------
    seed : int
    clock : Stopwatch
    progress : bool
        Whether progress bars are shown.
    checkpoint_folder : Path, optional
        Where finished rows are kept until all are.
    """

    seed: int = 0
    clock: Stopwatch = field(default_factory=Stopwatch)
    progress: bool = False
    checkpoint_folder: Path | None = None
