"""Figures of a comparison of methods, counterparts of those of [HR10], from its report and a few pictures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from mi_sparse_prt.benchmark.relit_reference import environments_of, path_traced
from mi_sparse_prt.benchmark.vertex_pictures import COLORMAP, vertex_picture
from mi_sparse_prt.core.metrics import relative_l2
from mi_sparse_prt.core.run import Run
from mi_sparse_prt.methods.dense_sampling import Dense, DenseSampler
from mi_sparse_prt.methods.sparse import SparseOptions
from mi_sparse_prt.operators.visibility import Visibility
from mi_sparse_prt.relighting.image import background_emitter, render
from mi_sparse_prt.sampling.angular import AngularGrid
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.problem import diffuse_problem
from mi_sparse_prt.transport import LightTransport
from mi_sparse_prt.validation.matrix_figures import panels, picture_row, tonemapped
from mi_sparse_prt.validation.mitsuba_reference import image_of_vertices

MAGNIFIED = 10  # differences
RATES = {
    "dense_vertices": "dense vertices",
    "dense_directions": "directions\nof a dense vertex",
    "sparse_directions": "directions\nof a sparse vertex",
    "elements": "all elements",
}
MARKERS = "os^Dv<>p*"


@dataclass(frozen=True)
class PictureEffort:
    """How well pictures of methods are drawn.

    Attributes
    ----------
    pixel_samples : int
    width : int
        Pixels of a picture of numbers at vertices.
    paths : int
        Per vertex, of the fully sampled side of a relit pair.
    """

    pixel_samples: int = 16
    width: int = 480
    paths: int = 1024


class MethodPictures:
    """What the figures show besides numbers of the report.

    Parameters
    ----------
    scene : Scene
        Without a sensor there are no pictures.
    direct : Visibility
        Exact bits.
    progress : bool
    effort : PictureEffort

    Attributes
    ----------
    vertex_errors : dict
        Method -> relative L2 (n_v,) of the rows of its direct part.
    relit : dict
        Method -> picture (height, width, 3), linear RGB.
    full : (height, width, 3) float32 or None
        The same view under all elements: exact direct light and path-traced indirect light of every vertex.
    dense : Dense or None
        Dense vertices and ranks.
    """

    def __init__(self, scene: Scene, direct: Visibility, progress: bool, effort: PictureEffort) -> None:
        self.scene, self.effort = scene, effort
        self.vertex_errors: dict[str, NDArray[np.float64]] = {}
        self.relit: dict[str, NDArray[np.float32]] = {}
        self.full: NDArray[np.float32] | None = None
        self.dense: Dense | None = None
        if not scene.mitsuba.sensors():
            return
        lighting, own = direct.lighting, scene.mitsuba.environment()
        sky = own if own is not None else next(iter(environments_of(scene).values()))
        self._light = light = lighting.project(sky)
        self.dense = _choose_dense(scene, direct)
        everyone = np.arange(len(scene.positions))
        indirect = path_traced(scene, lighting, light[None], everyone, effort.paths, 1, progress)[0]
        irradiance = (direct.relight(light) + indirect).astype(np.float32)
        self.full = image_of_vertices(
            scene, irradiance, background_emitter(light, lighting), effort.pixel_samples
        )

    def add(self, method: str, transport: LightTransport, vertex_errors: NDArray[np.float64]) -> None:
        """Take the pictures of a method."""
        if not self.scene.mitsuba.sensors():
            return
        self.vertex_errors[method] = vertex_errors
        self.relit[method] = render(self.scene, transport, self._light, spp=self.effort.pixel_samples)


def _choose_dense(scene: Scene, direct: Visibility) -> Dense:
    """Dense vertices as ``method="sparse"`` chooses them by rank: a few rays, so they are chosen again."""
    solver = DirectSolver(diffuse_problem(scene, direct.lighting))
    sampler = DenseSampler(solver, AngularGrid(direct.lighting), Run())
    for mesh in scene.meshes:
        sampler.choose(mesh, SparseOptions().spatial)
    return sampler.dense()


def method_figures(report: dict[str, Any], pictures: MethodPictures) -> dict[str, Figure]:
    """Figures by name.

    Parameters
    ----------
    report : dict
        Of ``measure_methods``.
    pictures : MethodPictures

    Returns
    -------
    dict
        ``rates`` (Figure 9, of methods that leave elements out), ``errors_times`` (10), ``breakdown`` (12),
        ``environments``, ``rotation``; if the scene has a sensor ``dense_vertices`` and ``ranks`` (2, 13), and per
        method ``vertex_error_METHOD`` and ``relit_METHOD`` (1, 14).
    """
    figures = {} if not any(m["sampling"] for m in report["methods"].values()) else {"rates": rates(report)}
    figures |= {
        "errors_times": errors_times(report),
        "breakdown": breakdown(report),
        "environments": environments(report),
        "rotation": rotation(report),
    }
    if pictures.dense is None:
        return figures
    scene, dense = pictures.scene, pictures.dense
    width, flat = pictures.effort.width, np.full(len(scene.positions), np.nan)
    dots = vertex_picture(scene, flat, width=width, dots=dense.ids)
    share = len(dense.ids) / len(flat)
    figures["dense_vertices"] = picture_row({f"dense vertices, {share:.1%} of all": dots})
    title = "local rank: singular values with 99% of the energy"
    figures["ranks"] = _coloured(scene, dense.ranks.astype(np.float64), title, 1.0, width)
    for method, errors in pictures.vertex_errors.items():
        title = f"{method}: relative L2 of the rows of direct light (%)"
        figures[f"vertex_error_{method}"] = _coloured(scene, errors, title, 100.0, width)
        figures[f"relit_{method}"] = relit_pair(pictures, method)
    return figures


def rates(report: dict[str, Any]) -> Figure:
    """Sampling rates per mesh and method, grouped as in Figure 9."""
    figure, axes = panels(10, 4)
    bars = {
        f"{method}, {mesh}": [100 * values[rate] for rate in RATES]
        for method, found in report["methods"].items()
        for mesh, values in found["sampling"].items()
    }
    _grouped(axes, list(RATES.values()), bars, "{:.1f}")
    axes.set(ylabel="%", title="sampling rates (compare with [HR10], Figure 9)")
    return figure


def errors_times(report: dict[str, Any]) -> Figure:
    """Relative L2 of the matrix against time, a point for every method and mesh."""
    figure, axes = panels(10, 4.5)
    brute = report["brute_force"]
    points = {"brute force": (brute["seconds"], brute["errors"])}
    points |= {m: (found["seconds"]["total"], found["errors"]) for m, found in report["methods"].items()}
    for k, (name, (seconds, errors)) in enumerate(points.items()):
        for mesh, marker in zip(errors, MARKERS, strict=False):
            error, deviation = errors[mesh]["total"], errors[mesh]["standard_error"]["total"]
            label = f"{name}, {mesh}: {seconds / brute['seconds']:.1%} of the time, {error:.2%}"
            axes.errorbar(
                seconds, 100 * error, 200 * deviation, fmt=marker, color=f"C{k}", capsize=3, label=label
            )
    axes.set(
        xlabel="seconds for the whole matrix",
        ylabel="relative L2 of the matrix (%), two standard errors",
        xscale="log",
        ylim=(0, None),
        title="error against time (compare with [HR10], Figure 10)",
    )
    _legend_beside(axes)
    return figure


def breakdown(report: dict[str, Any]) -> Figure:
    """Time of every stage as a share of the method's own, as in Figure 12."""
    figure, axes = panels(9, 1.6 + 0.7 * len(report["methods"]))
    done = dict.fromkeys(report["methods"], 0.0)
    for k, stage in enumerate(next(iter(report["methods"].values()))["stages"]):
        for method, found in report["methods"].items():
            share = 100 * found["stages"][stage] / found["seconds"]["total"]
            label = stage if method == next(iter(done)) else None
            axes.barh(method, share, left=done[method], color=f"C{k}", label=label)
            if share > 4:
                axes.text(done[method] + share / 2, method, f"{share:.0f}", ha="center", va="center")
            done[method] += share
    axes.set(xlabel="% of the method's time", xlim=(0, 100), title="compare with [HR10], Figure 12")
    axes.invert_yaxis()
    _legend_beside(axes)
    return figure


def environments(report: dict[str, Any]) -> Figure:
    """Relative L2 of the relit vertices under every environment."""
    figure, axes = panels(12, 4)
    bars = {
        f"{method}, {mesh}": {
            name: 100 * (value if name == "mean" else value["relative_l2"])
            for name, value in sorted(errors.items(), key=lambda item: item[0] == "mean")
        }
        for method, found in report["methods"].items()
        for mesh, errors in found["environments"].items()
    }
    names = list(next(iter(bars.values())))
    _grouped(axes, names, {label: list(values.values()) for label, values in bars.items()}, "{:.2f}")
    axes.set(ylabel="relative L2 of the relit vertices (%)", title="environments that no method was tuned to")
    return figure


def rotation(report: dict[str, Any]) -> Figure:
    """Error while an environment turns, and its change from frame to frame beside that of the light."""
    figure, (left, right) = panels(13, 4.2, 1, 2)
    for k, (method, found) in enumerate(report["methods"].items()):
        turned = found["rotation"]
        styles = ("-", "--", ":", "-.") * len(turned["meshes"])
        for style, (mesh, values) in zip(styles, turned["meshes"].items(), strict=False):
            # noise above the change makes it 0, which a logarithm cannot show
            frames = {n: [100 * v if v > 0 else np.nan for v in vs] for n, vs in values["frames"].items()}
            label = f"{method}, {mesh}"
            left.plot(turned["degrees"], frames["error"], style, color=f"C{k}", label=label)
            right.plot(turned["degrees"], frames["change_of_error"], style, color=f"C{k}", label=label)
            if k == 0:
                light = frames["change_of_light"]
                right.plot(turned["degrees"], light, style, color="grey", label=f"the light itself, {mesh}")
    name = turned["environment"]
    left.set(xlabel="degrees", ylabel="relative L2 of a frame (%)", ylim=(0, None), title=f"{name}, turning")
    right.set(xlabel="degrees", ylabel="change to the next frame (% of it)", yscale="log")
    right.set_title("change of the error")
    _legend_beside(right)
    return figure


def relit_pair(pictures: MethodPictures, method: str) -> Figure:
    """Relit with all elements and with a method, and how they differ, as in Figures 1 and 14."""
    full, ours = pictures.full, pictures.relit[method]
    assert full is not None
    top = max(float(np.percentile(full, 99.9)), 1e-20)
    difference = f"difference x {MAGNIFIED}; relative L2 of the image {relative_l2(ours, full):.2%}"
    return picture_row(
        {
            f"all elements ({pictures.effort.paths} indirect paths per vertex)": tonemapped(full, top),
            method: tonemapped(ours, top),
            difference: 0.5 + MAGNIFIED * (ours - full).mean(axis=2) / (2 * top),
        },
        "RdBu_r",
    )


def _grouped(axes: Axes, groups: list[str], bars: dict[str, list[float]], form: str) -> None:
    """A bar of every series in every group, with its value on top."""
    width = 0.8 / len(bars)
    for k, (label, values) in enumerate(bars.items()):
        place = np.arange(len(groups)) + (k + 0.5) * width - 0.4
        labels = [form.format(value) for value in values]
        axes.bar_label(
            axes.bar(place, values, width, label=label), labels, fontsize="x-small", rotation=90, padding=2
        )
    axes.set_xticks(np.arange(len(groups)), groups)
    axes.margins(y=0.15)
    _legend_beside(axes)


def _legend_beside(axes: Axes) -> None:
    """Scenes may have many meshes: their names would cover the data."""
    axes.legend(loc="upper left", bbox_to_anchor=(1, 1), fontsize="small")


def _coloured(scene: Scene, values: NDArray[np.float64], title: str, scale: float, width: int) -> Figure:
    """Numbers at vertices with their colours, the highest hundredth in one colour."""
    top = max(float(np.percentile(values, 99)), 1e-12)
    figure = picture_row({title: vertex_picture(scene, values, width=width, vmin=0.0, vmax=top)})
    figure.colorbar(ScalarMappable(Normalize(0, scale * top), COLORMAP), ax=figure.axes[0], shrink=0.7)
    return figure
