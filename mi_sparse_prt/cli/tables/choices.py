"""Choices of rows and columns, and radii of neighbours."""

from __future__ import annotations

from typing import Any

from rich.table import Table

from mi_sparse_prt.cli.tables.layout import new_table, percent, words


def choices_tables(report: dict[str, Any]) -> list[Table]:
    """What ``measure_choices`` found: relative L2 by choice, and by radius."""
    return [
        table
        for mesh, found in report["meshes"].items()
        for table in (_choices_table(mesh, found["choices"]), _radius_table(mesh, found["radius"]))
    ]


def _choices_table(mesh: str, choices: dict[str, Any]) -> Table:
    title = f"{mesh}: {choices['row_share']:.0%} of rows, up to {choices['column_share']:.0%} of columns"
    spread, used = choices["standard_error"], choices["directions"]
    rows = (
        (words(name), f"{error:.2%} +- {spread[name]:.2%}", percent(used.get(name, 0.0)))
        for name, error in choices["error"].items()
    )
    return new_table(title, ("", "relative L2", "directions used"), rows)


def _radius_table(mesh: str, found: dict[str, Any]) -> Table:
    columns = ("radius", *(f"{radius:g}" for radius in found["radii"]))
    neighbours = ("neighbours", *(f"{count:.0f}" for count in found["neighbours"]))
    errors = ((words(name), *map(percent, errors)) for name, errors in found["error"].items())
    return new_table(f"{mesh}: error and radius", columns, [neighbours, *errors])
