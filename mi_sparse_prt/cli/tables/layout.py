"""How tables, and numbers in them, look."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from rich.table import Table

Row = Sequence[str]

FACTS = ("", "")  # columns of a table of facts: what it is, and how much; no header


def new_table(title: str, columns: Row, *sections: Iterable[Row]) -> Table:
    """A table whose first column is text, the others numbers, with a line between its sections."""
    table = Table(title=title, title_justify="left", show_header=any(columns))
    for k, column in enumerate(columns):
        table.add_column(column, justify="left" if k == 0 else "right", overflow="fold")
    for section in sections:
        table.add_section()
        for row in section:
            table.add_row(*row)
    return table


def sentences_tables(title: str, sentences: list[str]) -> list[Table]:
    """A table with a sentence in each row; without any, none."""
    return [new_table(title, [""], [[sentence] for sentence in sentences])] if sentences else []


def plan_words(plan: dict[str, Any]) -> str:
    """A plan in a few words."""
    parameters = " ".join(
        f"{name} {value}" for name, value in plan["parameters"].items() if value is not None
    )
    return f"{plan['direct']}, {plan['indirect']} {parameters}".strip()


def words(key: str) -> str:
    """A key of a report as it is said."""
    return key.replace("_", " ")


def listed(numbers: dict[str, str]) -> str:
    """Names with their values, in one line."""
    return ", ".join(f"{name} {value}" for name, value in numbers.items())


def percent(share: float) -> str:
    """A share as "1.23%", a tiny one as "1.2e-05"."""
    return f"{share:.2%}" if share >= 1e-3 or share == 0 else f"{share:.1e}"


def duration(seconds: float) -> str:
    """Seconds in the unit in which people would say them."""
    if seconds < 0.1:
        return f"{seconds * 1e3:.1f} ms"
    return f"{seconds:.2f} s" if seconds < 600 else f"{seconds / 60:.0f} min"


def byte_count(count: float) -> str:
    """Bytes in the largest unit of which there is a whole one."""
    for unit, size in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= size:
            return f"{count / size:.1f} {unit}"
    return f"{count:.0f} B"
