"""Methods against brute force."""

from __future__ import annotations

from typing import Any

from rich.table import Table

from mi_sparse_prt.cli.tables.layout import duration, new_table, percent


def methods_tables(report: dict[str, Any]) -> list[Table]:
    """What ``measure_methods`` found: cost and errors of brute force and of each method."""
    brute = report["brute_force"]
    table = new_table(f"Brute force: {duration(brute['seconds'])}", "", "")
    table.add_row("direct light, the whole matrix", duration(brute["direct_seconds"]))
    deviation = duration(brute["paths_seconds_standard_error"])
    table.add_row("paths, from some rows", f"{duration(brute['paths_seconds'])} +- {deviation}")
    for mesh, errors in brute["errors"].items():
        table.add_row(f"relative L2, {mesh}", percent(errors["total"]))
        table.add_row("  noise of the reference", percent(report["reference_noise"][mesh]))
    return [table, *(_method_table(method, found) for method, found in report["methods"].items())]


def _method_table(method: str, found: dict[str, Any]) -> Table:
    table = new_table(f"{method} against brute force", "", "")
    without = found["without_held_out"]
    table.add_row(
        "elements evaluated", f"{found['elements']:.2%} ({without['elements']:.2%} without held out)"
    )
    for part, share in found["elements_of_parts"].items():
        table.add_row(f"  {part}", f"{share:.2%}")
    table.add_row("time / brute force", f"{found['ratio']:.1%} ({without['ratio']:.1%} without held out)")
    table.add_row("cost of an element, brute force = 1", f"{found['seconds_per_element']:.2f}")
    overhead = found["overhead"]
    each = overhead["microseconds_per_sparse_vertex"]
    table.add_row(
        "overhead",
        f"{overhead['share']:.1%}" + ("" if each is None else f", {each:.0f} us per sparse vertex"),
    )
    for mesh, rates in found["sampling"].items():
        rows = ", ".join(f"{name.replace('_', ' ')} {value:.1%}" for name, value in rates.items())
        table.add_row(f"sampling, {mesh}", rows)
    for mesh, errors in found["errors"].items():
        table.add_section()
        _add_errors(table, mesh, errors)
        _add_relit(table, found["environments"][mesh], found["rotation"], mesh)
    table.add_section()
    for stage, seconds in found["stages"].items():
        table.add_row(f"  {stage}", f"{duration(seconds)}, {seconds / found['seconds']['total']:.1%}")
    return table


def _add_errors(table: Table, mesh: str, errors: dict[str, Any]) -> None:
    """Relative L2 of the matrix of a mesh, and its worst rows and columns."""
    for part in ("total", "direct", "indirect"):
        deviation = errors["standard_error"].get(part)
        value = f"{errors[part]:.2%}" + ("" if deviation is None else f" +- {deviation:.2%}")
        table.add_row(f"relative L2, {mesh}, {part}", value)
    for part, name in (
        ("rows", "some rows"),
        ("direct_rows", "rows, direct"),
        ("direct_columns", "columns, direct"),
    ):
        worst = errors[part]
        table.add_row(
            f"  {name}: 95th percentile, worst", f"{worst['95th_percentile']:.2%}, {worst['max']:.2%}"
        )


def _add_relit(table: Table, environments: dict[str, Any], rotation: dict[str, Any], mesh: str) -> None:
    """Relative L2 of the relit vertices of a mesh."""
    worst = max(
        (name for name in environments if name != "mean"), key=lambda n: environments[n]["relative_l2"]
    )
    table.add_row("  relit, mean over environments", f"{environments['mean']:.2%}")
    table.add_row(f"  relit, worst of them: {worst}", f"{environments[worst]['relative_l2']:.2%}")
    mean = rotation["meshes"][mesh]["mean"]
    table.add_row(f"  relit, {rotation['environment']} turning", f"{mean['error']:.2%}")
    table.add_row(
        "  change per frame: error, light", f"{mean['change_of_error']:.2%}, {mean['change_of_light']:.2%}"
    )
