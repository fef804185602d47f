"""What the benchmark of many lights draws: [HPB07] Figures 3 to 7, by scene."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from mi_sparse_prt.validation.matrix_figures import panels

COLOURS = {
    "hasan2007": "C0",
    "adaptive": "C3",
    "instant radiosity": "C2",
    "power sampling": "C4",
    "lightcuts": "C1",
}
STYLES = {"1:1": "-", "1:2": "--", "1:3": "-.", "3:1": ":"}


def many_lights_figures(
    report: dict[str, Any],
    pictures: dict[str, NDArray[np.float32]],
    equal_time: dict[str, NDArray[np.float32]],
) -> dict[str, Figure]:
    """Figures of a report of ``measure_many_lights``, by the names of their files."""
    reference = pictures["reference"]
    took = {point["name"]: point for point in report["equal_time"]}
    beside = {
        f"{name}: {took[name]['seconds']:.1f} s, {100 * took[name]['error']:.1f}% off": image
        for name, image in equal_time.items()
    }
    return {
        "many_lights": _time_against_error(report),
        "singular_values": _singular_values(report),
        "pictures": _pictures(pictures),
        "equal_time": _pictures({"reference": reference, **beside}),
    }


def _time_against_error(report: dict[str, Any]) -> Figure:
    figure, axes = panels(9, 5.5)
    for name, points in report["curves"].items():
        method, _, ratio = name.rpartition(" ") if name[-1].isdigit() else (name, "", "")
        seconds, errors = ([point[key] for point in points] for key in ("seconds", "error"))
        spread = [100 * point["spread"] for point in points]
        style = STYLES.get(ratio, "-")
        axes.errorbar(
            seconds, 100 * np.array(errors), spread, fmt="o", linestyle=style, color=COLOURS[method],
            markersize=3, capsize=2, label=name,
        )  # fmt: skip
    path = report["path"]
    noise = [100 * point["error"] for point in path]
    axes.plot([p["seconds"] for p in path], noise, "s-", color="0.4", label="path (noise, no clamp)")
    axes.axvline(report["all_lights"]["seconds"], color="black", linestyle=":", label="all lights")
    size = report["scene"]
    axes.set(
        xscale="log", yscale="log", xlabel="seconds (samples and lights not counted)",
        ylabel="relative 2-norm error of pixels (%)",
        title=f"{Path(size['path']).stem}: {size['samples']:,} samples, {size['lights']:,} lights",
    )  # fmt: skip
    axes.grid(which="both", alpha=0.25)
    axes.legend(loc="upper left", bbox_to_anchor=(1, 1), fontsize="small")
    return figure


def _singular_values(report: dict[str, Any]) -> Figure:
    figure, axes = panels(6, 4)
    axes.semilogy(np.maximum(report["singular_values"], 1e-9))
    axes.set(xlabel="number", ylabel="singular value / largest", title=Path(report["scene"]["path"]).stem)
    axes.grid(alpha=0.25)
    return figure


def _pictures(pictures: dict[str, NDArray[np.float32]]) -> Figure:
    """All images with one exposure: the reference's 95th percentile is nearly white."""
    columns = 3
    rows = -(-len(pictures) // columns)
    figure = Figure(figsize=(4.2 * columns, 3.4 * rows), layout="constrained")
    white = max(float(np.percentile(pictures["reference"], 95)), 1e-12)
    for k, (name, image) in enumerate(pictures.items()):
        axes = figure.add_subplot(rows, columns, k + 1)
        bitmap = mi.Bitmap(np.ascontiguousarray(image * np.float32(0.85 / white)))
        axes.imshow(np.array(bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, True)))
        axes.set_title(name)
        axes.set_axis_off()
    return figure
