"""What a picture by many lights took, and how good it is."""

from __future__ import annotations

from typing import Any

from rich.table import Table

from mi_sparse_prt.cli.tables.layout import FACTS, byte_count, duration, new_table, percent


def many_lights_table(scene: str, report: dict[str, Any]) -> Table:
    """Of a report of ``render_many_lights``."""
    height, width = report["parameters"]["image"]
    lights, error = report["lights"], report["estimated_error"]
    emitters = [
        (f"lights of {name}", f"{own['direct']:,} direct, {own['indirect']:,} reflected")
        for name, own in lights["emitters"].items()
    ]
    facts = [
        ("samples", f"{report['samples']:,} on surfaces, of {width} x {height} pixels"),
        ("rows, columns", f"{report['rows']:,} and {report['columns']:,}"),
        ("elements", f"{report['elements_evaluated']:,} of {report['elements_total']:,}"),
        ("estimated error", "not known" if error is None else percent(error)),
    ]
    steps = [(phase, duration(taken)) for phase, taken in report["seconds"].items()]
    memory = [("peak memory", byte_count(report["peak_memory_bytes"]))]
    title = f"{scene}: {report['parameters']['method']}, {lights['total']:,} lights"
    return new_table(title, FACTS, facts, emitters, steps, memory)
