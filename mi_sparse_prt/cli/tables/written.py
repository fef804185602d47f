"""What a command wrote."""

from __future__ import annotations

from pathlib import Path

from rich.table import Table

from mi_sparse_prt.cli.tables.layout import byte_count, duration, new_table


def relighting_table(title: str, seconds: dict[str, float], files: dict[Path, bytes]) -> Table:
    """How long each step took, and what was written."""
    table = new_table(title, "", "")
    for phase, taken in seconds.items():
        table.add_row(phase, duration(taken))
    for path, content in files.items():
        table.add_row(str(path), byte_count(len(content)))
    return table


def files_table(paths: list[Path]) -> Table:
    """What was written."""
    table = new_table("Written", "")
    for path in paths:
        table.add_row(str(path))
    return table
