"""Pictures of a scene beside Mitsuba's, as [HR10] Figures 15 to 19 and 21 show them, its clusters and its factors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from mi_sparse_prt.benchmark.converged_reference import MAX_DEPTH
from mi_sparse_prt.compression.compress import compress
from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.operators.clustered import Clustered
from mi_sparse_prt.precompute import precompute, precompute_glossy
from mi_sparse_prt.reflection.brdf_factors import BrdfFactors
from mi_sparse_prt.relighting.image import render
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.transport import LightTransport
from mi_sparse_prt.validation.matrix_figures import draw_picture, panels, picture_row, tonemapped
from mi_sparse_prt.validation.mitsuba_reference import image_of_vertices, path_image
from mi_sparse_prt.validation.validate import save_figures

SPP, REFERENCE_SPP = 64, 256
DIFFERENCE = 5  # times as bright
FACTOR_SIZE = 160  # pixels of a hemisphere

Floats = NDArray[np.float32]


def draw_gallery(scene: Scene, lighting: CubemapLighting, progress: bool = True) -> dict[str, Figure]:
    """Precompute a scene, relight it, and draw it.

    Parameters
    ----------
    scene : Scene
        With an environment and a sensor. Where surfaces are glossy, its transport has the factors of their BRDFs.
    lighting : CubemapLighting
    progress : bool

    Returns
    -------
    dict of matplotlib Figure
        ``relit``: Mitsuba's ``path`` under the same cubemap, the matrix, the compressed matrix, and the difference of
        the first two. ``clusters``: of the compressed matrix ([OBRG06] Figure 12). ``factors_0``, ...: of each glossy
        BRDF.

    Raises
    ------
    PrtError
        If the scene has no environment or no sensor.
    """
    if scene.mitsuba.environment() is None or not scene.mitsuba.sensors():
        raise PrtError(
            f"{scene.path or 'the scene'} has no environment or no sensor: there is nothing to draw"
        )
    compute = precompute if scene.diffuse else precompute_glossy
    transport = compute(scene, lighting, max_depth=MAX_DEPTH, progress=progress)
    return _draw(scene, transport, progress) | factor_pictures(transport)


def save_gallery(figures: dict[str, Figure], folder: Path, name: str) -> list[Path]:
    """Write figures as ``name_*.png`` into a folder (made if needed); where they are."""
    return save_figures(folder, {f"{name}_{kind}": figure for kind, figure in figures.items()})


def _draw(scene: Scene, transport: LightTransport, progress: bool) -> dict[str, Figure]:
    light = transport.lighting.project(scene.mitsuba.environment())
    compressed = compress(transport, progress=progress)
    ours, small = (render(scene, t, light, spp=SPP, progress=progress) for t in (transport, compressed))
    with transport.emission.scene_lit_by(light, scene) as lit:
        truth = path_image(lit, scene.sensor(0), MAX_DEPTH, REFERENCE_SPP, seed=0)
    images = {
        "Mitsuba path": truth,
        f"relit, {f'{transport.terms} terms' if transport.terms else 'matrix'}": ours,
        f"compressed, 1/{compressed.report['compression']['ratio']:.0f}": small,
        f"difference x {DIFFERENCE}": DIFFERENCE * np.abs(ours - truth),
    }
    return {"relit": images_beside(images, truth), "clusters": cluster_picture(scene, compressed)}


def cluster_picture(scene: Scene, compressed: LightTransport, spp: int = 64) -> Figure:
    """The camera's view of the scene, each cluster of vertices in a colour of its own."""
    clustered = compressed.operators["compressed"]
    assert isinstance(clustered, Clustered)
    colours = np.random.default_rng(1).random((len(clustered.means), 3)).astype(np.float32)
    colours = 0.15 + 0.85 * colours / colours.max(axis=1, keepdims=True)
    shown = colours[clustered.labels[: scene.n_vertices]]  # terms have their vertex' cluster
    image = image_of_vertices(
        scene, shown / np.maximum(scene.albedo, 1e-3), None, spp
    )  # colours, not reflectance
    return picture_row({f"{len(colours)} clusters": tonemapped(image, 1.0)})


def relit_pictures(full: Floats, compressed: Floats) -> Figure:
    """Images (height, width, 3) from the whole matrix and from the compressed one, and ten times their difference."""
    images = {"matrix": full, "compressed": compressed, "difference x 10": 10 * np.abs(compressed - full)}
    return images_beside(images, full)


def images_beside(images: dict[str, Floats], reference: Floats) -> Figure:
    """Linear images (height, width, 3) by title in one tone curve, in which a hundredth of the reference is clipped."""
    return picture_row(
        {title: tonemapped(i, float(np.percentile(reference, 99))) for title, i in images.items()}
    )


def factor_pictures(transport: LightTransport) -> dict[str, Figure]:
    """``factors_0``, ...: of each glossy BRDF, where there are any."""
    factors = getattr(transport.reflection, "factors", ())
    return {f"factors_{k}": factor_picture(of_brdf) for k, of_brdf in enumerate(factors)}


def factor_picture(factors: BrdfFactors) -> Figure:
    """Incident factors f_k above, outgoing ones g_k (mean of their channels) below; blue is negative.

    A direction is at its x and y, so that the rim is the horizon; each picture has its own scale.
    """
    axis = np.linspace(-1, 1, FACTOR_SIZE)
    x, y = np.meshgrid(axis, -axis)
    inside = x**2 + y**2 < 1
    z = np.sqrt(np.maximum(1 - x**2 - y**2, 1e-6))
    every = np.stack([x, y, z], axis=-1).reshape(-1, 3).astype(np.float32)
    rows = factors.incident, factors.outgoing.mean(axis=1)
    figure, lines = panels(2.1 * factors.terms, 4.6, 2, factors.terms)
    for side, (line, tables) in enumerate(zip(lines, rows, strict=True)):
        for k, axes in enumerate(np.atleast_1d(line)):
            values = factors.grid.interpolate(tables[k], every).reshape(FACTOR_SIZE, FACTOR_SIZE)
            largest = max(float(np.abs(values[inside]).max()), 1e-12)
            shown = np.where(inside, values, np.nan)
            title = f"{'fg'[side]}{k + 1}, up to {largest:.2g}"
            draw_picture(axes, shown, title, 9, cmap="RdBu_r", vmin=-largest, vmax=largest)
    return figure
