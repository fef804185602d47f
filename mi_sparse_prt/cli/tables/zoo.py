"""Which scenes of a zoo came out right."""

from __future__ import annotations

from itertools import groupby
from typing import Any

from rich.table import Table

from mi_sparse_prt.cli.tables.layout import Row, duration, new_table, percent

COLUMNS = ("scene", "verdict", "error", "noise may show", "its estimate", "time")


def zoo_tables(report: dict[str, Any]) -> list[Table]:
    """What ``measure_zoo`` found: the scenes, kind by kind, and what was said of those that do not agree."""
    kinds = groupby(report["scenes"], key=lambda found: found["name"].partition("_")[0])
    sections = [[_row(found) for found in scenes] for _, scenes in kinds]
    counts = ", ".join(f"{count} {verdict}" for verdict, count in report["counts"].items())
    machine = report["machine"]
    title = (
        f"{len(report['scenes'])} scenes: {counts}\nErrors are relative L2 of images beyond noise; "
        f"load average {machine['load_average']:.1f} (over {machine['cores']}: disturbed, times are too long)"
    )
    said = [(sentence, ", ".join(names)) for sentence, names in scenes_by_sentence(report).items()]
    tables = [new_table(title, COLUMNS, *sections)]
    return tables + ([new_table("What was said of the others", ("", "scenes"), said)] if said else [])


def scenes_by_sentence(report: dict[str, Any]) -> dict[str, list[str]]:
    """Names of scenes that do not agree by the sentences that the package said of them."""
    found: dict[str, list[str]] = {}
    for scene in report["scenes"]:
        if scene["verdict"] != "agrees":
            for sentence in scene["sentences"]:
                found.setdefault(sentence, []).append(scene["name"])
    return found


def verdict_words(found: dict[str, Any]) -> str:
    """The verdict on a scene, and who told."""
    by = " and ".join(found["told_by"])
    return f"{found['verdict']} ({by})" if by else str(found["verdict"])


def _row(found: dict[str, Any]) -> Row:
    shares = (found[name] for name in ("error", "uncertainty", "estimated_error"))
    seconds = "" if found["seconds"] is None else duration(found["seconds"])
    return found["name"], verdict_words(found), *("" if s is None else percent(s) for s in shares), seconds
