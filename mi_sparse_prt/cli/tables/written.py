"""What a command wrote."""

from __future__ import annotations

from pathlib import Path

from rich.table import Table

from mi_sparse_prt.cli.tables.layout import FACTS, byte_count, duration, new_table


def relighting_table(title: str, seconds: dict[str, float], files: dict[Path, int]) -> Table:
    """How long each step took, and what was written: its size in bytes."""
    steps = [(phase, duration(taken)) for phase, taken in seconds.items()]
    written = [(str(path), byte_count(size)) for path, size in files.items()]
    return new_table(title, FACTS, steps + written)
