"""What ``benchmark --relight`` measured."""

from __future__ import annotations

from typing import Any

from rich.table import Table

from mi_sparse_prt.cli.tables.layout import byte_count, new_table, percent

COLUMNS = ("", "light", "sphere", "image", "flicker")


def moving_light_tables(report: dict[str, Any]) -> list[Table]:
    """Errors of each turn, frames after its stop, and times of frames."""
    tables, cases = [], _cases(report)
    for name, case in cases.items():
        rows = [
            (label, *(percent(found[column]) for column in COLUMNS[1:]))
            for label, found in case["methods"].items()
        ]
        rows.append(("a quarter of the weights", "", "", percent(case["vectors"]["mean"]), ""))
        tables.append(new_table(f"{name} (means over the frames that change)", COLUMNS, rows))
    tables += [_stop_table(cases), _frames_table(report["frames"])]
    return tables if report["pictures"] is None else [*tables, *_picture_tables(report["pictures"])]


def _cases(report: dict[str, Any]) -> dict[str, Any]:
    """Sequences by their names."""
    turning = {
        f"{name}, {degrees} degrees": case
        for name, turns in report["turning"].items()
        for degrees, case in turns.items()
    }
    return turning | report["changing"]


def _picture_tables(pictures: dict[str, Any]) -> list[Table]:
    """Errors of what a camera sees, and what it takes."""
    rows = [
        (row, column, percent(found["relative_l2"]), f"{found['flip']:.4f}")
        for name, figure in pictures.items()
        if name != "camera"
        for row, columns in figure.items()
        for column, found in columns.items()
    ]
    camera = pictures["camera"]
    taken = [(name.replace("_", " "), f"{value:.1f} ms") for name, value in camera["milliseconds"].items()]
    taken += [("made once", f"{camera['seconds']:.1f} s"), ("memory", byte_count(camera["nbytes"]))]
    height, width = camera["size"]
    return [
        new_table("Pictures against those of the exact product", ("", "", "relative L2", "FLIP"), rows),
        new_table(f"A picture of {width} x {height}, {camera['spp']} samples per pixel", ("", ""), taken),
    ]


def _stop_table(cases: dict[str, Any]) -> Table:
    """Frames after the stop until errors are below those of others that stand still."""
    rows = [
        (name, label, *(str(frame or "never") for frame in frames.values()))
        for name, case in cases.items()
        for label, frames in case["stop"].items()
    ]
    return new_table("Frames after the stop until below", ("", "", "NWA(300)", "NWA(500)"), rows)


def _frames_table(frames: dict[str, Any]) -> Table:
    """Milliseconds of the stages."""
    ways = {name: way for name, way in frames.items() if "per_second" in way}
    stages = list(next(iter(ways.values()))["milliseconds"])
    rows = [
        (
            name,
            *(f"{way['milliseconds'][stage]:.2f}" for stage in stages),
            f"{way['per_second']:.0f}",
            byte_count(way["prepared_bytes"]),
        )
        for name, way in ways.items()
    ]
    for name, share in frames["overhead"].items():
        rows.append((f"PBI against NWA: {name}", *("" for _ in stages), percent(share), ""))
    product = frames["product"]
    if product["milliseconds"] is not None:
        whole = f"{product['milliseconds']:.0f} ms"
        rows.append(("T L by BLAS", *("" for _ in stages), whole, byte_count(product["bytes"])))
        for name, factor in product["faster"].items():
            rows.append((f"T L against {name}", *("" for _ in stages), f"{factor:.0f} x", ""))
    return new_table("Frames (ms)", ("", *stages, "per second", "memory"), rows)
