"""A matrix against Mitsuba."""

from __future__ import annotations

from typing import Any

from rich.table import Table

from mi_sparse_prt.cli.tables.layout import new_table, percent
from mi_sparse_prt.validation.glossy_images import CAUSES


def validation_table(report: dict[str, Any], title: str) -> Table:
    """Errors of rows, columns and image, and the reference's own noise (see ``Validation``)."""
    table = new_table(title, "relative L2 unless said otherwise", "")
    for mesh, error in report["relative_l2"]["meshes"].items():
        table.add_row(f"mesh {mesh}", percent(error))
    table.add_row("total", percent(report["relative_l2"]["total"]))
    table.add_row("Mitsuba's own noise, not counted above", percent(report["reference_noise"]))
    table.add_section()
    table.add_row("95th percentile of rows", percent(report["row_95th_percentile"]))
    row, column = report["row_worst"], report["column_worst"]
    table.add_row(f"worst row, vertex {row['vertex']}", percent(row["relative_l2"]))
    table.add_row(f"worst column, texel {column['texel']}", percent(column["relative_l2"]))
    table.add_row("direct elements that differ by over 1e-4, share", percent(report["direct_at_hits"]))
    table.add_row("Mitsuba's hit against the vertex itself", percent(report["hit_against_vertex"]))
    if "image" in report:
        table.add_section()
        image = report["image"]
        table.add_row("relit image", percent(image["relative_l2"]))
        table.add_row("of it, interpolation between vertices", percent(image["interpolation"]))
        table.add_row("its reference's noise, not counted above", percent(image["reference_noise"]))
        table.add_row("FLIP, mean", f"{image['flip']:.4f}")
    return table


def glossy_images_table(report: dict[str, Any], title: str) -> Table:
    """What ``validate_glossy`` found."""
    images = new_table(f"{title} (largest relative L2)", "", *CAUSES)
    for region, errors in report["worst"].items():
        images.add_row(region.replace("_", " "), *(percent(errors[cause]) for cause in CAUSES))
    return images
