"""What the benchmarks measure, all but methods and choices."""

from __future__ import annotations

from typing import Any

from rich.table import Table

from mi_sparse_prt.cli.tables.layout import (
    byte_count,
    duration,
    new_table,
    percent,
    plan_words,
    sentences_tables,
)
from mi_sparse_prt.cli.tables.validation import glossy_images_table


def benchmark_tables(report: dict[str, Any]) -> list[Table]:
    """What ``run_benchmark`` measured, and on which machine."""
    machine, direct, paths, relit = (report[part] for part in ("machine", "direct", "paths", "relight"))
    rays = new_table(
        f"Direct matrix, {report['scene']['vertices']:,} vertices x {report['scene']['directions']} directions",
        "",
        "",
    )
    rays.add_row("matrix, bits on the host", duration(direct["seconds"]))
    rays.add_row("the same rays and a count", duration(direct["bare_seconds"]))
    rays.add_row("ratio", f"{direct['ratio']:.3f}")
    rays.add_row("rays above the horizon", f"{direct['rays_per_second'] / 1e6:.1f} M/s")
    rays.add_row("peak memory", byte_count(direct["peak_memory_bytes"]))
    rays.add_row(*_kernel_row(direct["kernels"], direct["blocks"]))
    rays.add_row("first run, compilation included", duration(direct["first_run_seconds"]))

    walks = new_table(
        f"Indirect light, max_depth {paths['max_depth']}, {paths['spp']} paths per element", "", ""
    )
    for name, label in (("rows", "whole rows"), ("scattered", "scattered elements")):
        walks.add_row(label, f"{paths[name]['paths_per_second'] / 1e6:.2f} M paths/s")
        walks.add_row(*_kernel_row(paths[name]["kernels"], paths["blocks"]))
        walks.add_row("first run, compilation included", duration(paths[name]["first_run_seconds"]))
    walks.add_row("whole matrix by this", duration(paths["whole_matrix_seconds"]))

    frames = new_table("Relighting all vertices", "", "")
    frames.add_row("direct light", duration(relit["direct"]["seconds"]))
    label = f"with indirect light, 6 x {relit['indirect_resolution']}^2, {relit['channels']} channel(s)"
    frames.add_row(label, duration(relit["with_indirect"]["seconds"]))

    host = new_table("Machine", "", "")
    host.add_row(
        "processor", f"{machine['cpu']}, {machine['cores']} cores, {machine['drjit_threads']} Dr.Jit threads"
    )
    host.add_row("load average (over the cores: disturbed)", f"{machine['load_average']:.1f}")
    host.add_row("versions", ", ".join(f"{name} {number}" for name, number in machine["versions"].items()))
    return [rays, walks, frames, host]


def _kernel_row(kernels: dict[str, Any], blocks: int) -> tuple[str, str]:
    found = ", ".join(
        f"{kernels[k]} {label}" for k, label in (("compiled", "compiled"), ("on_disk", "from disk"))
    )
    return f"kernels in {blocks} blocks", f"{kernels['distinct']} ({found})"


def time_error_tables(report: dict[str, Any]) -> list[Table]:
    """What ``time_against_error`` found: every method, the quickest first."""
    bare, noise = report["bare_rays"], report["reference_noise"]["total"]
    table = new_table(
        f"Time against error (bare occlusion rays: {duration(bare['seconds'])}, noise of the reference: "
        f"{percent(noise)})",
        "",
        "time",
        "/ bare rays",
        "relative L2",
        "+-",
        "brute force at that error",
        "/ own time",
    )
    lines = []
    for name, found in report["methods"].items():
        error, equal = found["relative_l2"], found["equal_error"]
        lines.append(
            (
                found["seconds"],
                found["label"] if "plan" not in found else f"{name}: {plan_words(found['plan'])}",
                f"{found['over_bare_rays']:.2f}",
                error["total"],
                error["standard_error"]["total"],
                "" if equal["seconds"] is None else duration(equal["seconds"]),
                "" if equal["speed_up"] is None else f"{equal['speed_up']:.3g}",
            )
        )
    for kind in ("brute_force", "adjoint"):
        for point in report[kind]:
            label = f"{kind.replace('_', ' ')}, {point['spp']} paths per element"
            error, over = point["relative_l2"], point["seconds"] / bare["seconds"]
            deviation = error["standard_error"]["total"]
            lines.append((point["seconds"], label, f"{over:.2f}", error["total"], deviation, "", ""))
    for seconds, label, over, error, deviation, equal, speed_up in sorted(lines):
        table.add_row(label, duration(seconds), over, percent(error), percent(deviation), equal, speed_up)
    return [table, *sentences_tables("Skipped", report["skipped"])]


def plans_tables(report: dict[str, Any]) -> list[Table]:
    """What ``measure_plans`` found: target errors, and all plans that were carried out, the quickest first."""
    targets = new_table("Auto", "target", "plan", "time", "error", "+-", "met", "choice / best", "all / best")
    for found in report["targets"]:
        ratios = ("-" if found[name] is None else f"{found[name]:.2f}" for name in ("choice", "whole"))
        targets.add_row(
            percent(found["target_error"]),
            f"{plan_words(found['plan'])} ({found['attempts']})",
            duration(found["seconds"]),
            percent(found["estimated_error"]),
            percent(found["standard_error"]),
            "yes" if found["met"] else "no",
            *ratios,
        )
    title = f"Plans carried out ({report['left_out']} slower ones were not)"
    plans = new_table(title, "", "time", "in all", "predicted", "error", "+-", "predicted")
    for plan in report["plans"]:
        seconds = (plan[name] for name in ("seconds", "seconds_in_all", "predicted_seconds"))
        errors = (plan[name] for name in ("estimated_error", "standard_error", "predicted_error"))
        plans.add_row(plan_words(plan), *map(duration, seconds), *map(percent, errors))
    return [targets, plans]


def sizes_tables(report: dict[str, Any]) -> list[Table]:
    """What ``cost_against_size`` found, for each series of sizes."""
    tables = []
    for series in ("by_vertices", "by_resolution"):
        table = new_table(
            series.replace("_", " ").capitalize(), "", "n", "direct alone", "whole", "peak memory", "error"
        )
        for found in report[series]:
            direct, whole = found["direct"], found["whole"]
            table.add_row(
                f"{found['vertices']:,} vertices, {plan_words(whole['plan'])}",
                str(found["resolution"]),
                duration(direct["seconds"]),
                duration(whole["seconds"]),
                byte_count(whole["peak_memory_bytes"]),
                percent(whole["estimated_error"]),
            )
        tables.append(table)
    return [*tables, *sentences_tables("Skipped", report["skipped"])]


def cpca_tables(report: dict[str, Any]) -> list[Table]:
    """What ``measure_cpca`` found."""
    table = new_table(
        "Clustered PCA", "mesh", "clusters", "standard", "two passes", "faster", "error", "error, two passes"
    )
    for name, found in report["meshes"].items():
        table.add_row(
            f"{name}, {found['vertices']:,} vertices",
            f"{found['clusters']} x {found['bases']}",
            duration(found["standard"]["seconds"]),
            duration(found["two_pass"]["seconds"]),
            f"{found['faster']:.1f} x",
            percent(found["standard"]["error"]),
            f"{percent(found['two_pass']['error'])} ({found['error_increase']:+.1%})",
        )
    total = report["total"]
    table.add_section()
    table.add_row(
        "all",
        "",
        duration(total["standard"]),
        duration(total["two_pass"]),
        f"{total['faster']:.1f} x",
        "",
        "",
    )
    whole = new_table("Compressed matrix", "", "")
    compressed = report["compressed"]
    whole.add_row("size", f"{byte_count(compressed['nbytes'])}, 1/{compressed['ratio']:.1f} of float32")
    whole.add_row("time", duration(compressed["seconds"]["total"]))
    whole.add_row("relative L2 of the matrix", percent(compressed["error"]["total"]))
    if report["image"] is not None:
        whole.add_row("of a relit image", percent(report["image"]))
    return [table, whole]


def glossy_tables(report: dict[str, Any]) -> list[Table]:
    """What ``measure_glossy`` found."""
    times = new_table("Time", "", "time", "ratio")
    seconds, ratios = report["seconds"], report["ratios"]
    times.add_row("diffuse matrix", duration(seconds["diffuse"]), "")
    times.add_row(
        f"glossy, {report['parameters']['terms']} terms",
        duration(seconds["glossy"]),
        f"{ratios['glossy_over_diffuse']:.2f} x diffuse",
    )
    times.add_row(
        "brute force",
        duration(seconds["brute_force"]),
        f"{ratios['brute_force_over_glossy']:.0f} x glossy",
    )
    factors = new_table("Factors of BRDFs (relative L2, held out)", "", "all pairs", "grazing", "peak")
    for found in report["factors"]:
        last = [percent(found[name][-1]) for name in ("whole", "grazing", "peak")]
        factors.add_row(f"{found['mesh']}, {found['terms']} terms", *last)
    return [times, factors, glossy_images_table(report["images"], "Images")]
