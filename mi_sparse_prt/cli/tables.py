"""Reports as tables for people; the JSON has more."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.table import Table

from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.transport import LightTransport
from mi_sparse_prt.validation.glossy_images import CAUSES


def _table(title: str, *columns: str) -> Table:
    """A table whose first column is text, the others numbers."""
    table = Table(title=title, title_justify="left", show_header=any(columns))
    for k, column in enumerate(columns):
        table.add_column(column, justify="left" if k == 0 else "right", overflow="fold")
    return table


def matrix_tables(transport: LightTransport, path: Path) -> list[Table]:
    """What was done, how long it took, how good it is, and what was skipped."""
    report = transport.report
    vertices, directions, _ = transport.shape
    done = _table(f"{path}: {vertices} vertices x {directions} directions, {transport.basis} basis", "", "")
    for name, key in (("elements", "elements_total"), ("elements evaluated", "elements_evaluated")):
        done.add_row(name, f"{report[key]:,}")
    for name, count in report["rays"].items():
        done.add_row(
            {"direct": "shadow rays", "indirect_paths": "indirect paths"}.get(name, name), f"{count:,}"
        )
    done.add_row("matrix in memory", _bytes(transport.nbytes))
    done.add_row("file", _bytes(path.stat().st_size))
    done.add_row("peak memory", _bytes(report["peak_memory_bytes"]))
    paths: tuple[str, ...] = ("spp", "indirect_resolution")
    if "plan" in report:
        plan, paths = report["plan"], ()
        done.add_row("direct light", plan["direct"])
        done.add_row("indirect light", _indirect(plan))
    for name in ("max_depth", *paths, "strata", "seed"):
        done.add_row(name, str(report["parameters"][name]))
    for name in ("path", "hash"):
        done.add_row(f"scene {name}", str(report["scene"][name]))
    done.add_row("versions", ", ".join(f"{name} {number}" for name, number in report["versions"].items()))

    phases = _table("Time", "phase", "time", "share")
    total = report["seconds"]["total"]
    for name, seconds in report["seconds"].items():
        if name not in ("total", "compile"):
            phases.add_row(name, _duration(seconds), f"{seconds / total:.0%}")
    phases.add_section()
    phases.add_row("total", _duration(total), "")
    phases.add_row("compile, apart", _duration(report["seconds"]["compile"]), "")
    phases.add_row("forecast", _duration(report["forecast"]["seconds"]), "")

    error = report["estimated_error"]
    quality = _table(
        "Estimated error (relative L2, from held-out elements)", "mesh", "vertices", "error", "+-"
    )
    for mesh in transport.meshes:
        estimate, deviation = error["meshes"][mesh.name], error["standard_error"]["meshes"][mesh.name]
        count = mesh.vertices.stop - mesh.vertices.start
        quality.add_row(mesh.name, f"{count:,}", _share(estimate), _share(deviation))
    quality.add_section()
    quality.add_row(
        "total", f"{vertices:,}", _share(error["total"]), _share(error["standard_error"]["total"])
    )
    target = report["parameters"]["target_error"]
    if target is not None:
        quality.add_row("target", "", _share(target), "")
    tables = [done, phases, quality]
    for title, sentences in (("Skipped", report["skipped"]), ("Warnings", report["scene"]["warnings"])):
        if sentences:
            tables.append(_sentences(title, sentences))
    return tables


def plan_tables(transport: LightTransport) -> list[Table]:
    """The plans that were compared, and next to the one that was carried out, what came of it; none, no table."""
    report = transport.report
    if not report["plans"]:
        return []
    table = _table("Plans", "direct light", "indirect light", "time", "error", "")
    for plan in report["plans"]:
        table.add_row(
            plan["direct"],
            _indirect(plan),
            _duration(plan["predicted_seconds"]),
            _share(plan["predicted_error"]),
            "chosen" if plan["chosen"] else "",
        )
    table.add_section()
    taken, error = report["seconds"]["total"], report["estimated_error"]["total"]
    table.add_row("result", "", _duration(taken), _share(error), "")
    return [table]


def _indirect(plan: dict[str, Any]) -> str:
    """How a plan finds indirect light: "gather rays 64 tolerance 0.06"."""
    numbers = (f"{name} {value:g}" for name, value in plan["parameters"].items() if value is not None)
    return " ".join([plan["indirect"], *numbers])


def _sentences(title: str, sentences: list[str]) -> Table:
    table = _table(title, "")
    for sentence in sentences:
        table.add_row(sentence)
    return table


def scene_tables(scene: Scene) -> list[Table]:
    """What a scene consists of, and what its matrix would take."""
    report = scene_report(scene)
    meshes = _table(
        f"{scene.path}: {report['vertices']:,} vertices", "mesh", "vertices", "triangles", "mean albedo"
    )
    for mesh in scene.meshes:
        sizes = report["meshes"][mesh.name]
        albedo = " ".join(f"{value:.3f}" for value in scene.albedo[mesh.vertices].mean(axis=0))
        meshes.add_row(mesh.name, f"{sizes['vertices']:,}", f"{sizes['triangles']:,}", albedo)
    facts = _table("Scene", "", "")
    low, high = report["box"]
    facts.add_row(
        "box", " to ".join("(" + ", ".join(f"{x:.4g}" for x in corner) + ")" for corner in (low, high))
    )
    facts.add_row("grey, so one channel of indirect light", "yes" if scene.grey else "no")
    facts.add_row("diffuse only", "yes" if scene.diffuse else "no")
    facts.add_row("direct matrix, 6 x 32 x 32 directions", _bytes(report["vertices"] * 6144 // 8))
    facts.add_row("hash", scene.hash)
    return [meshes, facts, *([_sentences("Warnings", scene.warnings)] if scene.warnings else [])]


def relighting_table(title: str, seconds: dict[str, float], files: dict[Path, bytes]) -> Table:
    """How long each step took, and what was written."""
    table = _table(title, "", "")
    for phase, duration in seconds.items():
        table.add_row(phase, _duration(duration))
    for path, content in files.items():
        table.add_row(str(path), _bytes(len(content)))
    return table


def files_table(paths: list[Path]) -> Table:
    """What was written."""
    table = _table("Written", "")
    for path in paths:
        table.add_row(str(path))
    return table


def validation_table(report: dict[str, Any], title: str) -> Table:
    """Errors of rows, columns and image, and the reference's own noise (see ``Validation``)."""
    table = _table(title, "relative L2 unless said otherwise", "")
    for mesh, error in report["relative_l2"]["meshes"].items():
        table.add_row(f"mesh {mesh}", _share(error))
    table.add_row("total", _share(report["relative_l2"]["total"]))
    table.add_row("Mitsuba's own noise, not counted above", _share(report["reference_noise"]))
    table.add_section()
    table.add_row("95th percentile of rows", _share(report["row_95th_percentile"]))
    row, column = report["row_worst"], report["column_worst"]
    table.add_row(f"worst row, vertex {row['vertex']}", _share(row["relative_l2"]))
    table.add_row(f"worst column, texel {column['texel']}", _share(column["relative_l2"]))
    table.add_row("direct elements that differ by over 1e-4, share", _share(report["direct_at_hits"]))
    table.add_row("Mitsuba's hit against the vertex itself", _share(report["hit_against_vertex"]))
    if "image" in report:
        table.add_section()
        image = report["image"]
        table.add_row("relit image", _share(image["relative_l2"]))
        table.add_row("of it, interpolation between vertices", _share(image["interpolation"]))
        table.add_row("its reference's noise, not counted above", _share(image["reference_noise"]))
        table.add_row("FLIP, mean", f"{image['flip']:.4f}")
    return table


def benchmark_tables(report: dict[str, Any]) -> list[Table]:
    """What ``run_benchmark`` measured, and on which machine."""
    machine, direct, paths, relit = (report[part] for part in ("machine", "direct", "paths", "relight"))
    rays = _table(
        f"Direct matrix, {report['scene']['vertices']:,} vertices x {report['scene']['directions']} directions",
        "",
        "",
    )
    rays.add_row("matrix, bits on the host", _duration(direct["seconds"]))
    rays.add_row("the same rays and a count", _duration(direct["bare_seconds"]))
    rays.add_row("ratio", f"{direct['ratio']:.3f}")
    rays.add_row("rays above the horizon", f"{direct['rays_per_second'] / 1e6:.1f} M/s")
    rays.add_row("peak memory", _bytes(direct["peak_memory_bytes"]))
    rays.add_row(*_kernel_row(direct["kernels"], direct["blocks"]))
    rays.add_row("first run, compilation included", _duration(direct["first_run_seconds"]))

    walks = _table(
        f"Indirect light, max_depth {paths['max_depth']}, {paths['spp']} paths per element", "", ""
    )
    for name, label in (("rows", "whole rows"), ("scattered", "scattered elements")):
        walks.add_row(label, f"{paths[name]['paths_per_second'] / 1e6:.2f} M paths/s")
        walks.add_row(*_kernel_row(paths[name]["kernels"], paths["blocks"]))
        walks.add_row("first run, compilation included", _duration(paths[name]["first_run_seconds"]))
    walks.add_row("whole matrix by this", _duration(paths["whole_matrix_seconds"]))

    frames = _table("Relighting all vertices", "", "")
    frames.add_row("direct light", _duration(relit["direct"]["seconds"]))
    label = f"with indirect light, 6 x {relit['indirect_resolution']}^2, {relit['channels']} channel(s)"
    frames.add_row(label, _duration(relit["with_indirect"]["seconds"]))

    host = _table("Machine", "", "")
    host.add_row(
        "processor", f"{machine['cpu']}, {machine['cores']} cores, {machine['drjit_threads']} Dr.Jit threads"
    )
    host.add_row("load average (over the cores: disturbed)", f"{machine['load_average']:.1f}")
    host.add_row("versions", ", ".join(f"{name} {number}" for name, number in machine["versions"].items()))
    return [rays, walks, frames, host]


def methods_tables(report: dict[str, Any]) -> list[Table]:
    """What ``measure_methods`` found: cost and errors of brute force and of each method."""
    brute = report["brute_force"]
    table = _table(f"Brute force: {_duration(brute['seconds'])}", "", "")
    table.add_row("direct light, the whole matrix", _duration(brute["direct_seconds"]))
    deviation = _duration(brute["paths_seconds_standard_error"])
    table.add_row("paths, from some rows", f"{_duration(brute['paths_seconds'])} +- {deviation}")
    for mesh, errors in brute["errors"].items():
        table.add_row(f"relative L2, {mesh}", _share(errors["total"]))
        table.add_row("  noise of the reference", _share(report["reference_noise"][mesh]))
    return [table, *(_method_table(method, found) for method, found in report["methods"].items())]


def time_error_tables(report: dict[str, Any]) -> list[Table]:
    """What ``time_against_error`` found: every method, the quickest first."""
    bare, noise = report["bare_rays"], report["reference_noise"]["total"]
    table = _table(
        f"Time against error (bare occlusion rays: {_duration(bare['seconds'])}, noise of the reference: "
        f"{_share(noise)})",
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
                found["label"] if "plan" not in found else f"{name}: {_plan(found['plan'])}",
                f"{found['over_bare_rays']:.2f}",
                error["total"],
                error["standard_error"]["total"],
                "" if equal["seconds"] is None else _duration(equal["seconds"]),
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
        table.add_row(label, _duration(seconds), over, _share(error), _share(deviation), equal, speed_up)
    return [table, *([_sentences("Skipped", report["skipped"])] if report["skipped"] else [])]


def plans_tables(report: dict[str, Any]) -> list[Table]:
    """What ``measure_plans`` found: target errors, and all plans that were carried out, the quickest first."""
    targets = _table("Auto", "target", "plan", "time", "error", "+-", "met", "choice / best", "all / best")
    for found in report["targets"]:
        ratios = ("-" if found[name] is None else f"{found[name]:.2f}" for name in ("choice", "whole"))
        targets.add_row(
            _share(found["target_error"]),
            f"{_plan(found['plan'])} ({found['attempts']})",
            _duration(found["seconds"]),
            _share(found["estimated_error"]),
            _share(found["standard_error"]),
            "yes" if found["met"] else "no",
            *ratios,
        )
    title = f"Plans carried out ({report['left_out']} slower ones were not)"
    plans = _table(title, "", "time", "in all", "predicted", "error", "+-", "predicted")
    for plan in report["plans"]:
        seconds = (plan[name] for name in ("seconds", "seconds_in_all", "predicted_seconds"))
        errors = (plan[name] for name in ("estimated_error", "standard_error", "predicted_error"))
        plans.add_row(_plan(plan), *map(_duration, seconds), *map(_share, errors))
    return [targets, plans]


def sizes_tables(report: dict[str, Any]) -> list[Table]:
    """What ``cost_against_size`` found, for each series of sizes."""
    tables = []
    for series in ("by_vertices", "by_resolution"):
        table = _table(
            series.replace("_", " ").capitalize(), "", "n", "direct alone", "whole", "peak memory", "error"
        )
        for found in report[series]:
            direct, whole = found["direct"], found["whole"]
            table.add_row(
                f"{found['vertices']:,} vertices, {_plan(whole['plan'])}",
                str(found["resolution"]),
                _duration(direct["seconds"]),
                _duration(whole["seconds"]),
                _bytes(whole["peak_memory_bytes"]),
                _share(whole["estimated_error"]),
            )
        tables.append(table)
    return [*tables, *([_sentences("Skipped", report["skipped"])] if report["skipped"] else [])]


def cpca_tables(report: dict[str, Any]) -> list[Table]:
    """What ``measure_cpca`` found."""
    table = _table(
        "Clustered PCA", "mesh", "clusters", "standard", "two passes", "faster", "error", "error, two passes"
    )
    for name, found in report["meshes"].items():
        table.add_row(
            f"{name}, {found['vertices']:,} vertices",
            f"{found['clusters']} x {found['bases']}",
            _duration(found["standard"]["seconds"]),
            _duration(found["two_pass"]["seconds"]),
            f"{found['faster']:.1f} x",
            _share(found["standard"]["error"]),
            f"{_share(found['two_pass']['error'])} ({found['error_increase']:+.1%})",
        )
    total = report["total"]
    table.add_section()
    table.add_row(
        "all",
        "",
        _duration(total["standard"]),
        _duration(total["two_pass"]),
        f"{total['faster']:.1f} x",
        "",
        "",
    )
    whole = _table("Compressed matrix", "", "")
    compressed = report["compressed"]
    whole.add_row("size", f"{_bytes(compressed['nbytes'])}, 1/{compressed['ratio']:.1f} of float32")
    whole.add_row("time", _duration(compressed["seconds"]["total"]))
    whole.add_row("relative L2 of the matrix", _share(compressed["error"]["total"]))
    if report["image"] is not None:
        whole.add_row("of a relit image", _share(report["image"]))
    return [table, whole]


def glossy_tables(report: dict[str, Any]) -> list[Table]:
    """What ``measure_glossy`` found."""
    times = _table("Time", "", "time", "ratio")
    seconds, ratios = report["seconds"], report["ratios"]
    times.add_row("diffuse matrix", _duration(seconds["diffuse"]), "")
    times.add_row(
        f"glossy, {report['parameters']['terms']} terms",
        _duration(seconds["glossy"]),
        f"{ratios['glossy_over_diffuse']:.2f} x diffuse",
    )
    times.add_row(
        "brute force",
        _duration(seconds["brute_force"]),
        f"{ratios['brute_force_over_glossy']:.0f} x glossy",
    )
    factors = _table("Factors of BRDFs (relative L2, held out)", "", "all pairs", "grazing", "peak")
    for found in report["factors"]:
        last = [_share(found[name][-1]) for name in ("whole", "grazing", "peak")]
        factors.add_row(f"{found['mesh']}, {found['terms']} terms", *last)
    return [times, factors, glossy_images_table(report["images"], "Images")]


def glossy_images_table(report: dict[str, Any], title: str) -> Table:
    """What ``validate_glossy`` found."""
    images = _table(f"{title} (largest relative L2)", "", *CAUSES)
    for region, errors in report["worst"].items():
        images.add_row(region.replace("_", " "), *(_share(errors[cause]) for cause in CAUSES))
    return images


def glossy_matrix_tables(transport: LightTransport, path: Path) -> list[Table]:
    """What was done, how long it took and how large it is."""
    report, (n, directions) = transport.report, (len(transport.albedo), transport.lighting.n_directions)
    done = _table(f"{path}: {n} vertices x {directions} directions, view-dependent", "", "")
    done.add_row("glossy vertices", f"{len(transport.reflection.glossy):,}")
    for name, count in report["rays"].items():
        done.add_row({"direct": "shadow rays"}.get(name, f"{name} rays"), f"{count:,}")
    done.add_row("matrix in memory", _bytes(transport.nbytes))
    done.add_row("file", _bytes(path.stat().st_size))
    done.add_row("peak memory", _bytes(report["peak_memory_bytes"]))
    for name in ("terms", "harmonics", "max_depth", "rays", "tolerance"):
        done.add_row(name, str(report["parameters"][name]))
    done.add_row("seed", str(report["seed"]))
    for name in ("path", "hash"):
        done.add_row(f"scene {name}", str(report["scene"][name]))
    done.add_row("versions", ", ".join(f"{name} {number}" for name, number in report["versions"].items()))
    phases = _table("Time", "phase", "time")
    for name, seconds in report["seconds"].items():
        phases.add_row(name, _duration(seconds))
    warned = report["scene"]["warnings"]
    return [done, phases, *([_sentences("Warnings", warned)] if warned else [])]


def _plan(plan: dict[str, Any]) -> str:
    """A plan in a few words."""
    parameters = " ".join(
        f"{name} {value}" for name, value in plan["parameters"].items() if value is not None
    )
    return f"{plan['direct']}, {plan['indirect']} {parameters}".strip()


def choices_tables(report: dict[str, Any]) -> list[Table]:
    """What ``measure_choices`` found: relative L2 by choice, and by radius."""
    return [
        table
        for mesh, found in report["meshes"].items()
        for table in (_choices_table(mesh, found["choices"]), _radius_table(mesh, found["radius"]))
    ]


def _choices_table(mesh: str, choices: dict[str, Any]) -> Table:
    title = f"{mesh}: {choices['row_share']:.0%} of rows, up to {choices['column_share']:.0%} of columns"
    table = _table(title, "", "relative L2", "directions used")
    for name, error in choices["error"].items():
        table.add_row(
            name.replace("_", " "),
            f"{error:.2%} +- {choices['standard_error'][name]:.2%}",
            _share(choices["directions"].get(name, 0.0)),
        )
    return table


def _radius_table(mesh: str, found: dict[str, Any]) -> Table:
    table = _table(f"{mesh}: error and radius", "radius", *(f"{radius:g}" for radius in found["radii"]))
    table.add_row("neighbours", *(f"{count:.0f}" for count in found["neighbours"]))
    for name, errors in found["error"].items():
        table.add_row(name.replace("_", " "), *(_share(error) for error in errors))
    return table


def _method_table(method: str, found: dict[str, Any]) -> Table:
    table = _table(f"{method} against brute force", "", "")
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
        table.add_row(f"  {stage}", f"{_duration(seconds)}, {seconds / found['seconds']['total']:.1%}")
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


def _kernel_row(kernels: dict[str, Any], blocks: int) -> tuple[str, str]:
    found = ", ".join(
        f"{kernels[k]} {label}" for k, label in (("compiled", "compiled"), ("on_disk", "from disk"))
    )
    return f"kernels in {blocks} blocks", f"{kernels['distinct']} ({found})"


def _share(value: float) -> str:
    return f"{value:.2%}" if value >= 1e-3 or value == 0 else f"{value:.1e}"


def _duration(seconds: float) -> str:
    if seconds < 0.1:
        return f"{seconds * 1e3:.1f} ms"
    return f"{seconds:.2f} s" if seconds < 600 else f"{seconds / 60:.0f} min"


def _bytes(count: float) -> str:
    for unit, size in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= size:
            return f"{count / size:.1f} {unit}"
    return f"{count:.0f} B"


def scene_report(scene: Scene) -> dict[str, Any]:
    """A scene's facts, JSON as it is."""
    return {
        "path": scene.path,
        "hash": scene.hash,
        "vertices": len(scene.positions),
        "meshes": {
            mesh.name: {
                "vertices": mesh.vertices.stop - mesh.vertices.start,
                "triangles": len(mesh.triangles),
            }
            for mesh in scene.meshes
        },
        "box": [scene.positions.min(axis=0).tolist(), scene.positions.max(axis=0).tolist()],
        "grey": scene.grey,
        "diffuse": scene.diffuse,
        "warnings": scene.warnings,
    }
