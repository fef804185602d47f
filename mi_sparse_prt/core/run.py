"""One run of a computation: its clock, its progress, its seed, and where it keeps what is finished."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from tqdm.auto import tqdm

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
    state : str
        Stands for all that these rows and their order depend on; their files' names begin with it.
    """

    seed: int = 0
    clock: Stopwatch = field(default_factory=Stopwatch)
    progress: bool = False
    checkpoint_folder: Path | None = None
    state: str = ""

    def checkpoint(self, name: str = "") -> Path | None:
        """The file in which finished rows are kept, None if they are not."""
        return self.checkpoint_folder and self.checkpoint_folder / f"{self.state}{name}.rows"

    def bar(self, total: int, name: str, unit: str = " rows", done: int = 0) -> tqdm:
        """A progress bar, hidden where none is wanted."""
        return tqdm(total=total, initial=done, desc=name, unit=unit, disable=not self.progress)
