"""What the benchmarks measure, all but methods and choices."""

from __future__ import annotations

from typing import Any

from rich.table import Table

from mi_sparse_prt.cli.tables.layout import (
    FACTS,
    Row,
    byte_count,
    duration,
    listed,
    new_table,
    percent,
    plan_words,
    sentences_tables,
    words,
)
from mi_sparse_prt.cli.tables.validation import glossy_images_table


def benchmark_tables(report: dict[str, Any]) -> list[Table]:
    """What ``run_benchmark`` measured, and on which machine."""
    size, machine, direct, paths, relit = (
        report[part] for part in ("scene", "machine", "direct", "paths", "relight")
    )
    rays = [
        ("matrix, bits on the host", duration(direct["seconds"])),
        ("the same rays and a count", duration(direct["bare_seconds"])),
        ("ratio", f"{direct['ratio']:.3f}"),
        ("rays above the horizon", f"{direct['rays_per_second'] / 1e6:.1f} M/s"),
        ("peak memory", byte_count(direct["peak_memory_bytes"])),
        *_first_run_rows(direct, direct["blocks"]),
    ]
    walks: list[Row] = []
    for name, label in (("rows", "whole rows"), ("scattered", "scattered elements")):
        walks.append((label, f"{paths[name]['paths_per_second'] / 1e6:.2f} M paths/s"))
        walks += _first_run_rows(paths[name], paths["blocks"])
    walks.append(("whole matrix by this", duration(paths["whole_matrix_seconds"])))
    coarse = f"with indirect light, 6 x {relit['indirect_resolution']}^2, {relit['channels']} channel(s)"
    frames = [
        ("direct light", duration(relit["direct"]["seconds"])),
        (coarse, duration(relit["with_indirect"]["seconds"])),
    ]
    processor = f"{machine['cpu']}, {machine['cores']} cores, {machine['drjit_threads']} Dr.Jit threads"
    processor += f"; {machine['gpu']}" if machine["gpu"] else ""
    host = [
        ("processor", processor),
        ("load average (over the cores: disturbed)", f"{machine['load_average']:.1f}"),
        ("versions", listed(machine["versions"])),
    ]
    cost = f"Direct matrix, {size['vertices']:,} vertices x {size['directions']} directions"
    traced = f"Indirect light, max_depth {paths['max_depth']}, {paths['spp']} paths per element"
    return [
        new_table(cost, FACTS, rays),
        new_table(traced, FACTS, walks),
        new_table("Relighting all vertices", FACTS, frames),
        new_table("Machine", FACTS, host),
    ]


def _first_run_rows(part: dict[str, Any], blocks: int) -> list[Row]:
    """Kernels that the first run of a part launched, and its time."""
    kernels = part["kernels"]
    found = f"{kernels['distinct']} ({kernels['compiled']} compiled, {kernels['on_disk']} from disk)"
    return [
        (f"kernels in {blocks} blocks", found),
        ("first run, compilation included", duration(part["first_run_seconds"])),
    ]


def time_error_tables(report: dict[str, Any]) -> list[Table]:
    """What ``time_against_error`` found: every method, the quickest first."""
    bare, noise = report["bare_rays"]["seconds"], report["reference_noise"]["total"]
    points = [
        (found["label"] if "plan" not in found else f"{name}: {plan_words(found['plan'])}", found)
        for name, found in report["methods"].items()
    ]
    points += [
        (f"{words(kind)}, {point['spp']} paths per element", point)
        for kind in ("brute_force", "adjoint")
        for point in report[kind]
    ]
    rows = [
        (label, duration(point["seconds"]), f"{point['seconds'] / bare:.2f}", *_errors_at(point))
        for label, point in sorted(points, key=lambda pair: pair[1]["seconds"])
    ]
    title = f"bare occlusion rays: {duration(bare)}, noise of the reference: {percent(noise)}"
    compared = ("brute force at that error", "/ own time")
    columns = ("", "time", "/ bare rays", "relative L2", "+-", *compared)
    return [
        new_table(f"Time against error ({title})", columns, rows),
        *sentences_tables("Skipped", report["skipped"]),
    ]


def _errors_at(point: dict[str, Any]) -> Row:
    """Error of a method or of brute force, its standard error, and brute force at that error, where it is known."""
    error, equal = point["relative_l2"], point.get("equal_error", {"seconds": None})
    known = equal["seconds"] is not None
    compared = (duration(equal["seconds"]), f"{equal['speed_up']:.3g}") if known else ("", "")
    return percent(error["total"]), percent(error["standard_error"]["total"]), *compared


def plans_tables(report: dict[str, Any]) -> list[Table]:
    """What ``measure_plans`` found: target errors, and all plans that were carried out, the quickest first."""
    targets = [
        (
            percent(found["target_error"]),
            f"{plan_words(found['plan'])} ({found['attempts']})",
            duration(found["seconds"]),
            percent(found["estimated_error"]),
            percent(found["standard_error"]),
            "yes" if found["met"] else "no",
            *("-" if found[name] is None else f"{found[name]:.2f}" for name in ("choice", "whole")),
        )
        for found in report["targets"]
    ]
    plans = [
        (
            plan_words(plan),
            *(duration(plan[name]) for name in ("seconds", "seconds_in_all", "predicted_seconds")),
            *(percent(plan[name]) for name in ("estimated_error", "standard_error", "predicted_error")),
        )
        for plan in report["plans"]
    ]
    title = f"Plans carried out ({report['left_out']} slower ones were not)"
    ratios = ("choice / best", "all / best")
    return [
        new_table("Auto", ("target", "plan", "time", "error", "+-", "met", *ratios), targets),
        new_table(title, ("", "time", "in all", "predicted", "error", "+-", "predicted"), plans),
    ]


def sizes_tables(report: dict[str, Any]) -> list[Table]:
    """What ``cost_against_size`` found, for each series of sizes."""
    columns = ("", "n", "direct alone", "whole", "peak memory", "error")
    series = {name: map(_size_row, report[name]) for name in ("by_vertices", "by_resolution")}
    return [
        *(new_table(words(name).capitalize(), columns, rows) for name, rows in series.items()),
        *sentences_tables("Skipped", report["skipped"]),
    ]


def _size_row(found: dict[str, Any]) -> Row:
    whole = found["whole"]
    return (
        f"{found['vertices']:,} vertices, {plan_words(whole['plan'])}",
        str(found["resolution"]),
        duration(found["direct"]["seconds"]),
        duration(whole["seconds"]),
        byte_count(whole["peak_memory_bytes"]),
        percent(whole["estimated_error"]),
    )


def cpca_tables(report: dict[str, Any]) -> list[Table]:
    """What ``measure_cpca`` found."""
    meshes = [
        (
            f"{name}, {found['vertices']:,} vertices",
            f"{found['clusters']} x {found['bases']}",
            duration(found["standard"]["seconds"]),
            duration(found["two_pass"]["seconds"]),
            f"{found['faster']:.1f} x",
            percent(found["standard"]["error"]),
            f"{percent(found['two_pass']['error'])} ({found['error_increase']:+.1%})",
        )
        for name, found in report["meshes"].items()
    ]
    total, compressed = report["total"], report["compressed"]
    times = (duration(total["standard"]), duration(total["two_pass"]), f"{total['faster']:.1f} x")
    whole = [
        ("size", f"{byte_count(compressed['nbytes'])}, 1/{compressed['ratio']:.1f} of float32"),
        ("time", duration(compressed["seconds"]["total"])),
        ("relative L2 of the matrix", percent(compressed["error"]["total"])),
    ]
    if report["image"] is not None:
        whole.append(("of a relit image", percent(report["image"])))
    columns = ("mesh", "clusters", "standard", "two passes", "faster", "error", "error, two passes")
    return [
        new_table("Clustered PCA", columns, meshes, [("all", "", *times, "", "")]),
        new_table("Compressed matrix", FACTS, whole),
    ]


def glossy_tables(report: dict[str, Any]) -> list[Table]:
    """What ``measure_glossy`` found."""
    ratios, terms = report["ratios"], report["parameters"]["terms"]
    seconds = {name: duration(value) for name, value in report["seconds"].items()}
    times = [
        ("diffuse matrix", seconds["diffuse"], ""),
        (f"glossy, {terms} terms", seconds["glossy"], f"{ratios['glossy_over_diffuse']:.2f} x diffuse"),
        ("brute force", seconds["brute_force"], f"{ratios['brute_force_over_glossy']:.0f} x glossy"),
    ]
    factors = [
        (
            f"{found['mesh']}, {found['terms']} terms",
            *(percent(found[name][-1]) for name in ("whole", "grazing", "peak")),
        )
        for found in report["factors"]
    ]
    title = "Factors of BRDFs (relative L2, held out)"
    return [
        new_table("Time", ("", "time", "ratio"), times),
        new_table(title, ("", "all pairs", "grazing", "peak"), factors),
        glossy_images_table(report["images"], "Images"),
    ]


def pages_tables(report: dict[str, Any]) -> list[Table]:
    """Sizes of pages, and what they leave out."""
    rows = [
        (f"{page['kept']:.0%}", byte_count(page["bytes"]), percent(page["mean"]), percent(page["worst"]))
        for page in report["pages"]
    ]
    title = f"Pages; clustered PCA itself is {percent(report['compression_error'])} off"
    return [new_table(title, ("coefficients kept", "size", "mean error", "worst environment"), rows)]
