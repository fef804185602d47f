"""Methods against brute force."""

from __future__ import annotations

from typing import Any

from rich.table import Table

from mi_sparse_prt.cli.tables.layout import FACTS, Row, duration, listed, new_table, percent, words

PARTS = {"rows": "some rows", "direct_rows": "rows, direct", "direct_columns": "columns, direct"}


def methods_tables(report: dict[str, Any]) -> list[Table]:
    """What ``measure_methods`` found: cost and errors of brute force and of each method."""
    brute = report["brute_force"]
    deviation = duration(brute["paths_seconds_standard_error"])
    rows = [
        ("direct light, the whole matrix", duration(brute["direct_seconds"])),
        ("paths, from some rows", f"{duration(brute['paths_seconds'])} +- {deviation}"),
    ]
    for mesh, errors in brute["errors"].items():
        rows.append((f"relative L2, {mesh}", percent(errors["total"])))
        rows.append(("  noise of the reference", percent(report["reference_noise"][mesh])))
    return [
        new_table(f"Brute force: {duration(brute['seconds'])}", FACTS, rows),
        *(_method_table(method, found) for method, found in report["methods"].items()),
    ]


def _method_table(method: str, found: dict[str, Any]) -> Table:
    without, overhead = found["without_held_out"], found["overhead"]
    each = overhead["microseconds_per_sparse_vertex"]
    per_vertex = "" if each is None else f", {each:.0f} us per sparse vertex"
    cost = [
        ("elements evaluated", f"{found['elements']:.2%} ({without['elements']:.2%} without held out)"),
        *((f"  {part}", f"{share:.2%}") for part, share in found["elements_of_parts"].items()),
        ("time / brute force", f"{found['ratio']:.1%} ({without['ratio']:.1%} without held out)"),
        ("cost of an element, brute force = 1", f"{found['seconds_per_element']:.2f}"),
        ("overhead", f"{overhead['share']:.1%}{per_vertex}"),
    ]
    for mesh, rates in found["sampling"].items():
        shares = {words(name): f"{value:.1%}" for name, value in rates.items()}
        cost.append((f"sampling, {mesh}", listed(shares)))
    meshes = [
        [*_error_rows(mesh, errors), *_relit_rows(found["environments"][mesh], found["rotation"], mesh)]
        for mesh, errors in found["errors"].items()
    ]
    total = found["seconds"]["total"]
    stages = [
        (f"  {stage}", f"{duration(seconds)}, {seconds / total:.1%}")
        for stage, seconds in found["stages"].items()
    ]
    return new_table(f"{method} against brute force", FACTS, cost, *meshes, stages)


def _error_rows(mesh: str, errors: dict[str, Any]) -> list[Row]:
    """Relative L2 of the matrix of a mesh, and its worst rows and columns."""
    deviations = {part: f" +- {value:.2%}" for part, value in errors["standard_error"].items()}
    return [
        *(
            (f"relative L2, {mesh}, {part}", f"{errors[part]:.2%}{deviations.get(part, '')}")
            for part in ("total", "direct", "indirect")
        ),
        *(
            (
                f"  {name}: 95th percentile, worst",
                f"{errors[part]['95th_percentile']:.2%}, {errors[part]['max']:.2%}",
            )
            for part, name in PARTS.items()
        ),
    ]


def _relit_rows(environments: dict[str, Any], rotation: dict[str, Any], mesh: str) -> list[Row]:
    """Relative L2 of the relit vertices of a mesh."""
    errors = {name: found["relative_l2"] for name, found in environments.items() if name != "mean"}
    worst, mean = max(errors, key=lambda name: errors[name]), rotation["meshes"][mesh]["mean"]
    changes = f"{mean['change_of_error']:.2%}, {mean['change_of_light']:.2%}"
    return [
        ("  relit, mean over environments", f"{environments['mean']:.2%}"),
        (f"  relit, worst of them: {worst}", f"{errors[worst]:.2%}"),
        (f"  relit, {rotation['environment']} turning", f"{mean['error']:.2%}"),
        ("  change per frame: error, light", changes),
    ]
