"""A matrix against Mitsuba."""

from __future__ import annotations

from typing import Any

from rich.table import Table

from mi_sparse_prt.cli.tables.layout import new_table, percent, words
from mi_sparse_prt.validation.glossy_images import CAUSES


def validation_table(report: dict[str, Any], title: str) -> Table:
    """Errors of rows, columns and image, and the reference's own noise (see ``Validation``)."""
    error, row, column = (report[name] for name in ("relative_l2", "row_worst", "column_worst"))
    matrix = [
        *((f"mesh {mesh}", percent(value)) for mesh, value in error["meshes"].items()),
        ("total", percent(error["total"])),
        ("Mitsuba's own noise, not counted above", percent(report["reference_noise"])),
    ]
    parts = [
        ("95th percentile of rows", percent(report["row_95th_percentile"])),
        (f"worst row, vertex {row['vertex']}", percent(row["relative_l2"])),
        (f"worst column, texel {column['texel']}", percent(column["relative_l2"])),
        ("direct elements that differ by over 1e-4, share", percent(report["direct_at_hits"])),
        ("Mitsuba's hit against the vertex itself", percent(report["hit_against_vertex"])),
    ]
    sections = [matrix, parts]
    if image := report.get("image"):
        relit = [
            ("relit image", percent(image["relative_l2"])),
            ("of it, interpolation between vertices", percent(image["interpolation"])),
            ("its reference's noise, not counted above", percent(image["reference_noise"])),
            ("FLIP, mean", f"{image['flip']:.4f}"),
        ]
        sections.append(relit)
    return new_table(title, ("relative L2 unless said otherwise", ""), *sections)


def glossy_images_table(report: dict[str, Any], title: str) -> Table:
    """What ``validate_glossy`` found."""
    rows = (
        (words(region), *(percent(errors[cause]) for cause in CAUSES))
        for region, errors in report["worst"].items()
    )
    return new_table(f"{title} (largest relative L2)", ("", *CAUSES), rows)
