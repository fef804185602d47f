"""Pictures of a light that moves and of its approximations: counterparts of [OBRG06] Figures 2, 4, 5, 7 and 9."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pywt
from matplotlib.figure import Figure
from numpy.typing import NDArray

from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.emission.haar import haar_bands, haar_colours, inverse_haar
from mi_sparse_prt.relighting.approximations import (
    Approximation,
    Incremental,
    NonIncremental,
    PerBand,
    wavelet_bands,
)
from mi_sparse_prt.relighting.light import TurningLight
from mi_sparse_prt.relighting.sequences import turning
from mi_sparse_prt.validation.matrix_figures import draw_picture, panels, tonemapped, unfolded

DEGREES, FRAMES, STILL = 180, 100, 301  # of the sequence that is drawn
SHOWN = (30, 75, 125, 400)  # frames, as in [OBRG06] Figures 2 and 3
INTERVAL = 5  # frames of a histogram of what is updated (Figure 4)
PERIOD = 128  # frames of the energy of temporal bands (Figure 5)

Floats = NDArray[np.float32]
Report = dict[str, Any]


def moving_light_figures(report: Report, light: TurningLight, name: str) -> dict[str, Figure]:
    """Figures by name, of one environment that turns by 180 degrees.

    Parameters
    ----------
    report : dict
        Of ``measure_moving_light``.
    light : TurningLight
    name : str
        Of the environment, in the report.
    """
    frames = list(turning(light, DEGREES, FRAMES, STILL))
    scale = np.sqrt(light.lighting.solid_angles, dtype=np.float32)
    wavelets = [haar_colours(texels, scale) for texels in frames]
    methods = report["turning"][name]
    shown = methods.get(f"{DEGREES}", next(iter(methods.values())))["methods"]
    return {
        "moving_lights": lights_figure(light, frames, wavelets),
        "moving_coverage": coverage_figure(wavelets),
        "moving_energy": energy_figure(light),
        "moving_errors": errors_figure(shown),
        "moving_bands": bands_figure(wavelets),
    }


def lights_figure(light: TurningLight, frames: Sequence[Floats], wavelets: Sequence[Floats]) -> Figure:
    """The light and what 30 wavelets of each method make of it, at four frames ([OBRG06] Figure 2)."""
    bands = wavelet_bands(light.lighting.resolution)
    methods = {"NWA(30)": NonIncremental(bands), "BI(30)": Incremental(bands), "PBI(30)": PerBand(bands)}
    applied = {label: _applied(method, wavelets) for label, method in methods.items()}
    scale = np.sqrt(light.lighting.solid_angles)[:, None]
    figure, axes = panels(15, 11.5, 1 + len(methods), len(SHOWN))
    for column, frame in enumerate(SHOWN):
        rows = {"exact": frames[frame]} | {
            label: inverse_haar(kept[frame].T).T / scale for label, kept in applied.items()
        }
        brightest = float(np.percentile(frames[frame], 99))
        for row, (label, texels) in enumerate(rows.items()):
            picture = unfolded(np.maximum(texels, 0), light.lighting)
            draw_picture(axes[row, column], tonemapped(picture, brightest), f"{label}, frame {frame}")
    return figure


def _applied(method: Approximation, wavelets: Sequence[Floats], budget: int = 30) -> dict[int, Floats]:
    """L~ at the frames that are shown."""
    kept = {}
    for frame, coefficients in enumerate(wavelets):
        method.update(coefficients, budget if frame else None)
        if frame in SHOWN:
            kept[frame] = method.applied.copy()
    return kept


def coverage_figure(wavelets: Sequence[Floats], budget: int = 30) -> Figure:
    """How many levels are updated where in a frame, and per band over five frames ([OBRG06] Figure 4)."""
    n = round((len(wavelets[0]) / 6) ** 0.5)
    bands, methods = wavelet_bands(n), {"NWA": NonIncremental, "BI": Incremental}
    figure, axes = panels(12, 9, 1 + len(methods), len(SHOWN[:3]))
    for row, (label, kind) in enumerate(methods.items()):
        method, counts = kind(bands), dict[int, NDArray[np.int64]]()
        for frame, coefficients in enumerate(wavelets):
            update = method.update(coefficients, budget if frame else None)
            start = max((f for f in SHOWN[:3] if f <= frame), default=None)
            if start is None or frame >= start + INTERVAL:
                continue
            if frame == start:
                column = SHOWN.index(start)
                picture = coverage(update.coefficients, n)
                draw_picture(axes[row, column], picture, f"{label}, frame {frame}")
            counts[start] = counts.get(start, 0) + np.bincount(
                bands.number[update.coefficients], minlength=bands.count
            )
        for column, start in enumerate(SHOWN[:3]):
            places = np.arange(bands.count) + 0.4 * (row - 0.5)
            axes[-1, column].bar(places, counts[start], 0.4, label=label)
            axes[-1, column].set(xlabel="band, coarse to fine", ylabel="updates in 5 frames")
            axes[-1, column].legend()
    return figure


def coverage(chosen: NDArray[np.int64], n: int) -> NDArray[np.floating]:
    """How many of some wavelets overlap each texel: an unfolded cubemap."""
    levels, count = haar_bands(n)[0], np.zeros((6, n, n))
    faces, rows, columns = np.unravel_index(chosen, (6, n, n))
    for face, row, column, level in zip(faces, rows, columns, levels[chosen], strict=True):
        side, squares = n >> level, 1 << level
        i, j = (row % squares) * side, (column % squares) * side
        count[face, i : i + side, j : j + side] += 1
    return unfolded(np.repeat(count.reshape(-1, 1), 3, axis=1), CubemapLighting(n))[..., 0]


def energy_figure(light: TurningLight) -> Figure:
    """Energy of spatial and temporal bands of a turn, whatever the method ([OBRG06] Figure 5)."""
    energy = spatio_temporal_energy(light)
    figure, axes = panels(4.5, 4.0, 1, 1)
    axis = np.ravel(axes)[0]
    axis.imshow(-np.log10(np.maximum(energy, energy.max() * 1e-6)), cmap="gray", aspect="auto")
    axis.set(xlabel="spatial band, coarse to fine", ylabel="temporal band, slow to quick")
    axis.set_title("energy (darker is more)")
    return figure


def spatio_temporal_energy(light: TurningLight, period: int = PERIOD) -> NDArray[np.float64]:
    """Energy (temporal bands, spatial bands) of the first frames of a turn: Haar in space, then in time."""
    number = haar_bands(light.lighting.resolution)[0]
    scale = np.sqrt(light.lighting.solid_angles, dtype=np.float32)
    frames = turning(light, DEGREES, FRAMES, max(period - FRAMES, 0))
    history = np.stack(
        [haar_colours(texels, scale) for _, texels in zip(range(period), frames, strict=False)]
    )
    levels = pywt.wavedec(history, "haar", mode="periodization", axis=0)
    return np.stack(
        [np.bincount(number, np.square(values, dtype=np.float64).sum(axis=(0, 2))) for values in levels]
    )


def errors_figure(methods: Report) -> Figure:
    """Error of light and of vertex colours over the frames ([OBRG06] Figure 7; its inset compares the two tests)."""
    figure, axes = panels(12, 4.5, 1, 2)
    lines = ("NWA(30)", "NWA(60)", "NWA(100)", "BI(30)", "PBI(30)", "by image(30)")
    for axis, key, first, words in zip(
        np.ravel(axes),
        ("frames", "images"),
        (0, 1),
        ("weighted L1 of the light", "relative L2 of colours"),
        strict=True,
    ):
        for label in lines:
            values = methods[label][key]
            axis.plot(np.arange(first, first + len(values)), 100 * np.array(values), label=label)
        axis.set(xlabel="frame", ylabel=f"{words} (%)")
        axis.set_ylim(bottom=0)
        axis.legend(loc="upper left")
    inset = np.ravel(axes)[0].inset_axes((0.72, 0.6, 0.26, 0.3))
    for label in ("PBI(30)", "PBI(30) by band"):
        inset.plot(100 * np.array(methods[label]["frames"]), label=label)
    inset.legend(fontsize=6)
    return figure


def bands_figure(wavelets: Sequence[Floats], budget: int = 30) -> Figure:
    """Error of each band under PBI; lines are frames in which it started anew ([OBRG06] Figure 9)."""
    bands = wavelet_bands(round((len(wavelets[0]) / 6) ** 0.5))
    method, errors, resets = PerBand(bands), [], []
    for frame, coefficients in enumerate(wavelets[: FRAMES + 50]):
        method.update(coefficients, budget if frame else None)
        left = bands.weights * np.linalg.norm(coefficients - method.applied, axis=1)
        whole = bands.weights * np.linalg.norm(coefficients, axis=1)
        errors.append(np.bincount(bands.number, left) / np.maximum(np.bincount(bands.number, whole), 1e-30))
        resets.append(method.resets.copy())
    figure, axes = panels(8, 1.6 * bands.count, bands.count, 1)
    for band, axis in enumerate(np.ravel(axes)):
        axis.vlines(np.flatnonzero(np.array(resets)[:, band]), 0, 1, color="0.8")
        axis.plot(np.array(errors)[:, band])
        axis.set(ylabel=f"band {band}", ylim=(0, 1.05))
    np.ravel(axes)[-1].set_xlabel("frame")
    return figure
