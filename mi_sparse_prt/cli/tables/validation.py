"""A matrix against Mitsuba."""

from __future__ import annotations

from typing import Any

from rich.table import Table

from mi_sparse_prt.cli.tables.layout import new_table, percent, words
from mi_sparse_prt.validation.glossy_images import CAUSES

# of matrices that have them, see ``validate``
AT_HITS = {
    "direct_at_hits": "direct elements that differ by over 1e-4, share",
    "hit_against_vertex": "Mitsuba's hit against the vertex itself",
}


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
        *(
            (f"worst {kind}, {name} {worst[name]}", percent(worst["relative_l2"]))
            for kind, worst in (("row", row), ("column", column))
            for name in worst.keys() - {"relative_l2"}
        ),
        *((title, percent(report[name])) for name, title in AT_HITS.items() if name in report),
    ]
    sections = [matrix, parts]
    if image := report.get("image"):
        relit = [
            ("relit image", percent(image["relative_l2"])),
            *(
                [("of it, interpolation between vertices", percent(image["interpolation"]))]
                if "interpolation" in image
                else []
            ),
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
