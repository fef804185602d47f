"""What a matrix is, how it was made and how good it is."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.table import Table

import mi_sparse_prt as prt
from mi_sparse_prt.cli.tables.layout import byte_count, duration, new_table, percent, sentences_tables


def matrix_tables(transport: prt.LightTransport, path: Path, explain: bool = False) -> list[Table]:
    """Tables of a matrix in a file; to ``explain`` is to list the plans that were compared, where there are any."""
    report = transport.report
    return [
        *(_plan_tables(report) if explain else []),
        _done_table(transport, path),
        _time_table(report),
        _error_table(transport),
        *sentences_tables("Skipped", report["skipped"]),
        *sentences_tables("Warnings", report["scene"]["warnings"]),
    ]


def _done_table(transport: prt.LightTransport, path: Path) -> Table:
    """What was done."""
    report = transport.report
    vertices, directions, _ = transport.shape
    table = new_table(
        f"{path}: {vertices} vertices x {directions} directions, {transport.basis} basis", "", ""
    )
    if transport.terms:
        table.add_row(
            "glossy vertices", f"{len(transport.reflection.glossy):,}, {transport.terms} terms each"
        )
    for name, key in (("elements", "elements_total"), ("elements evaluated", "elements_evaluated")):
        table.add_row(name, f"{report[key]:,}")
    for name, count in report["rays"].items():
        label = {"direct": "shadow rays", "indirect_paths": "indirect paths"}.get(name, name)
        table.add_row(label, f"{count:,}")
    _add_sizes(table, transport, path)
    paths: tuple[str, ...] = ("spp", "indirect_resolution")
    if "plan" in report:
        plan, paths = report["plan"], ()
        table.add_row("direct light", plan["direct"])
        table.add_row("indirect light", _indirect(plan))
    for name in ("max_depth", *paths, "strata", "seed"):
        table.add_row(name, str(report["parameters"][name]))
    _add_origin(table, report)
    return table


def _add_sizes(table: Table, transport: prt.LightTransport, path: Path) -> None:
    table.add_row("matrix in memory", byte_count(transport.nbytes))
    table.add_row("file", byte_count(path.stat().st_size))
    table.add_row("peak memory", byte_count(transport.report["peak_memory_bytes"]))


def _add_origin(table: Table, report: dict[str, Any]) -> None:
    """Of which scene a matrix is, and which versions made it."""
    for name in ("path", "hash"):
        table.add_row(f"scene {name}", str(report["scene"][name]))
    table.add_row("versions", ", ".join(f"{name} {number}" for name, number in report["versions"].items()))


def _time_table(report: dict[str, Any]) -> Table:
    """How long each phase took."""
    table = new_table("Time", "phase", "time", "share")
    total = report["seconds"]["total"]
    for name, seconds in report["seconds"].items():
        if name not in ("total", "compile"):
            table.add_row(name, duration(seconds), f"{seconds / total:.0%}")
    table.add_section()
    table.add_row("total", duration(total), "")
    table.add_row("compile, apart", duration(report["seconds"]["compile"]), "")
    table.add_row("forecast", duration(report["forecast"]["seconds"]), "")
    return table


def _error_table(transport: prt.LightTransport) -> Table:
    """How good the matrix is, for each mesh and in total."""
    error, target = transport.report["estimated_error"], transport.report["parameters"]["target_error"]
    deviations = error["standard_error"]
    table = new_table(
        "Estimated error (relative L2, from held-out elements)", "mesh", "vertices", "error", "+-"
    )
    for mesh in transport.meshes:
        count = mesh.vertices.stop - mesh.vertices.start
        errors = error["meshes"][mesh.name], deviations["meshes"][mesh.name]
        table.add_row(mesh.name, f"{count:,}", *map(percent, errors))
    table.add_section()
    table.add_row("total", f"{transport.shape[0]:,}", percent(error["total"]), percent(deviations["total"]))
    if target is not None:
        table.add_row("target", "", percent(target), "")
    return table


def _plan_tables(report: dict[str, Any]) -> list[Table]:
    """The plans that were compared, and next to the one that was carried out, what came of it; none, no table."""
    if not report["plans"]:
        return []
    table = new_table("Plans", "direct light", "indirect light", "time", "error", "")
    for plan in report["plans"]:
        table.add_row(
            plan["direct"],
            _indirect(plan),
            duration(plan["predicted_seconds"]),
            percent(plan["predicted_error"]),
            "chosen" if plan["chosen"] else "",
        )
    table.add_section()
    taken, error = report["seconds"]["total"], report["estimated_error"]["total"]
    table.add_row("result", "", duration(taken), percent(error), "")
    return [table]


def _indirect(plan: dict[str, Any]) -> str:
    """How a plan finds indirect light: "gather rays 64 tolerance 0.06"."""
    numbers = (f"{name} {value:g}" for name, value in plan["parameters"].items() if value is not None)
    return " ".join([plan["indirect"], *numbers])
