"""What pictures by many lights took, and how good they are."""

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
    facts += _left_out(report["left_out"])
    steps = [(phase, duration(taken)) for phase, taken in report["seconds"].items()]
    memory = [("peak memory", byte_count(report["peak_memory_bytes"]))]
    title = f"{scene}: {report['parameters']['method']}, {lights['total']:,} lights"
    return new_table(title, FACTS, facts, emitters, steps, memory)


def film_table(report: dict[str, Any]) -> Table:
    """Of frames by ``render_many_lights_frames``."""
    frames, film = report["frames"], report["film"]
    known = [one["estimated_error"] for one in frames if one["estimated_error"] is not None]
    moves = [(name, f"{first:g} to {last:g}") for name, (first, last) in report["animate"].items()]
    facts = [
        ("rows of all frames, columns", f"{frames[0]['parameters']['rows']:,} and {frames[0]['columns']:,}"),
        ("estimated error", f"{percent(min(known))} to {percent(max(known))}" if known else "not known"),
        (
            "time",
            f"{duration(report['seconds'])}, {duration(report['seconds'] / len(frames))} for each frame",
        ),
        ("peak memory", byte_count(max(one["peak_memory_bytes"] for one in frames))),
        (film["path"], byte_count(film["bytes"])),
    ]
    title = f"{report['scene']}: {film['frames']} frames, {frames[0]['lights']['total']:,} lights"
    return new_table(title, FACTS, facts, moves)


def _left_out(report: dict[str, Any]) -> list[tuple[str, str]]:
    """Light that the matrix does not have, as shares of the mean radiance."""
    kinds = {"clamped": "by the clamp", "specular": "by mirrors, glass"}
    return [
        (
            f"{'added, left out' if report['added'] else 'left out'} {how}",
            f"{percent(report[kind]['share'])} +- {percent(report[kind]['standard_error'])}",
        )
        for kind, how in kinds.items()
    ]


def _size(point: dict[str, Any]) -> str:
    """Of a point of a curve."""
    if "rows" in point:
        return f"{point['rows']}/{point['columns']}"
    return f"{point['lights']} lights" if "lights" in point else f"up to {percent(point['threshold'])}"


def many_lights_tables(report: dict[str, Any]) -> list[Table]:
    """What ``measure_many_lights`` found: time against error, and a table as [HPB07] has it."""
    size, machine, whole = report["scene"], report["machine"], report["all_lights"]["seconds"]
    title = (
        f"{size['path']}: {size['samples']:,} samples, {size['lights']:,} lights; all of them take {duration(whole)}\n"
        f"load average {machine['load_average']:.1f} (over {machine['cores']}: disturbed, times are too long)"
    )
    sections = [
        [
            (
                name if k == 0 else "",
                _size(p),
                duration(p["seconds"]),
                percent(p["error"]),
                percent(p["spread"]),
                percent(p["predicted"]) if p.get("predicted") is not None else "",
            )
            for k, p in enumerate(points)
        ]
        for name, points in report["curves"].items()
    ]
    sections.append(
        [
            ("path" if k == 0 else "", f"{p['spp']} spp", duration(p["seconds"]), percent(p["error"]), "", "")
            for k, p in enumerate(report["path"])
        ]
    )
    columns = ("", "rows/columns", "time", "error", "over seeds", "predicted")
    return [new_table(title, columns, *sections), _phases(report), _at_equal_time(report)]


def _phases(report: dict[str, Any]) -> Table:
    names = ("rows", "clustering", "columns")
    rows = [
        (
            f"{row['method']} {row['rows']}/{row['columns']}",
            duration(row["seconds"]["total"]),
            *(duration(row["seconds"][name]) for name in names),
            f"{report['all_lights']['seconds'] / row['seconds']['total']:.0f} x",
            percent(row["error"]),
            "" if row["predicted"] is None else percent(row["predicted"]),
            percent(row["spread"]),
            f"{row['flip']:.3f}",
            byte_count(row["peak_memory_bytes"]),
        )
        for row in report["table"]
    ]
    known = report["reference"]
    title = (
        f"By phase; occlusion rays in place of shadow maps. Errors at {known['pixels']:,} pixels; "
        f"FLIP against {known['picture']}, {percent(known['picture_error'])} off"
    )
    columns = ("", "total", *names, "all lights", "error", "predicted", "over seeds", "FLIP", "memory")
    return new_table(title, columns, rows)


def _at_equal_time(report: dict[str, Any]) -> Table:
    rows = [
        (
            point["name"],
            duration(point["seconds"]),
            percent(point["error"]),
            "" if point["flip"] is None else f"{point['flip']:.3f}",
        )
        for point in report["equal_time"]
    ]
    return new_table("At equal time; the error of path is its noise", ("", "time", "error", "FLIP"), rows)
