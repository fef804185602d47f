"""What a matrix is, how it was made and how good it is."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.table import Table

import mi_sparse_prt as prt
from mi_sparse_prt.cli.tables.layout import (
    FACTS,
    byte_count,
    duration,
    listed,
    new_table,
    percent,
    sentences_tables,
)


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
    report, (outputs, elements, _) = transport.report, transport.shape
    labels = {"direct": "shadow rays", "indirect_paths": "indirect paths"}
    rows = [
        ("elements", f"{report['elements_total']:,}"),
        ("elements evaluated", f"{report['elements_evaluated']:,}"),
        *((labels.get(name, name), f"{count:,}") for name, count in report["rays"].items()),
        ("matrix in memory", byte_count(transport.nbytes)),
        ("file", byte_count(path.stat().st_size)),
        ("peak memory", byte_count(report["peak_memory_bytes"])),
    ]
    if transport.terms:
        glossy = f"{len(transport.reflection.glossy):,}, {transport.terms} terms each"
        rows.insert(0, ("glossy vertices", glossy))
    paths: tuple[str, ...] = ("spp", "indirect_resolution")
    if "plan" in report:
        plan, paths = report["plan"], ()
        rows += [("direct light", plan["direct"]), ("indirect light", _indirect(plan))]
    rows += [
        *((name, str(report["parameters"][name])) for name in ("max_depth", *paths, "strata", "seed")),
        *((f"scene {name}", str(report["scene"][name])) for name in ("path", "hash")),
        ("versions", listed(report["versions"])),
    ]
    rows_of, columns = transport.measurement.kind, f"{elements} lamps"
    if transport.emission.kind == "cubemap":
        columns = f"{elements} directions, {transport.basis} basis"
    title = f"{path}: {outputs} {rows_of} x {columns}"
    return new_table(title, FACTS, rows)


def _time_table(report: dict[str, Any]) -> Table:
    """How long each phase took."""
    seconds = report["seconds"]
    phases = (
        (name, duration(taken), f"{taken / seconds['total']:.0%}")
        for name, taken in seconds.items()
        if name not in ("total", "compile")
    )
    sums = [
        ("total", duration(seconds["total"]), ""),
        ("compile, apart", duration(seconds["compile"]), ""),
    ]
    if "forecast" in report:
        sums.append(("forecast", duration(report["forecast"]["seconds"]), ""))
    return new_table("Time", ("phase", "time", "share"), phases, sums)


def _error_table(transport: prt.LightTransport) -> Table:
    """How good the matrix is, for each mesh and in total."""
    error, target = transport.report["estimated_error"], transport.report["parameters"]["target_error"]
    deviations = error["standard_error"]
    meshes = []
    for mesh in transport.meshes:
        errors = error["meshes"][mesh.name], deviations["meshes"][mesh.name]
        meshes.append((mesh.name, f"{mesh.vertices.stop - mesh.vertices.start:,}", *map(percent, errors)))
    total = [("total", f"{transport.shape[0]:,}", percent(error["total"]), percent(deviations["total"]))]
    if "seen" in error:
        total.append(("seen by cameras", "", percent(error["seen"]), percent(deviations["seen"])))
    if target is not None:
        total.append(("target", "", percent(target), ""))
    title = "Estimated error (relative L2, from held-out elements)"
    return new_table(title, ("mesh", "vertices", "error", "+-"), meshes, total)


def _plan_tables(report: dict[str, Any]) -> list[Table]:
    """The plans that were compared, and next to the one that was carried out, what came of it; none, no table."""
    if not report["plans"]:
        return []
    plans = (
        (
            plan["direct"],
            _indirect(plan),
            duration(plan["predicted_seconds"]),
            percent(plan["predicted_error"]),
            "chosen" if plan["chosen"] else "",
        )
        for plan in report["plans"]
    )
    taken, error = report["seconds"]["total"], report["estimated_error"]["total"]
    result = ("result", "", duration(taken), percent(error), "")
    return [new_table("Plans", ("direct light", "indirect light", "time", "error", ""), plans, [result])]


def _indirect(plan: dict[str, Any]) -> str:
    """How a plan finds indirect light: "gather rays 64 tolerance 0.06"."""
    numbers = (f"{name} {value:g}" for name, value in plan["parameters"].items() if value is not None)
    return " ".join([plan["indirect"], *numbers])
