"""Pictures of a compressed matrix: its clusters on the surface ([OBRG06] Figure 12), and what it does to an image."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from mi_sparse_prt.operators.clustered import Clustered
from mi_sparse_prt.relighting.image import RelitIntegrator, RelitScene
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.transport import LightTransport

Floats = NDArray[np.float32]


def cluster_picture(scene: Scene, compressed: LightTransport, spp: int = 64) -> Figure:
    """The camera's view of the scene, each cluster of vertices in a colour of its own."""
    clustered = compressed.operators["compressed"]
    assert isinstance(clustered, Clustered)
    colours = np.random.default_rng(1).random((len(clustered.means), 3)).astype(np.float32)
    colours = 0.15 + 0.85 * colours / colours.max(axis=1, keepdims=True)
    shown = colours[clustered.labels[: scene.n_vertices]]  # terms have their vertex' cluster
    relit = RelitScene(scene, shown / np.maximum(scene.albedo, 1e-3), None)  # colours, not reflectance
    image = np.array(mi.render(scene.mitsuba, integrator=RelitIntegrator(relit), spp=spp))[..., :3]
    return side_by_side([image], [f"{len(colours)} clusters"])


def relit_pictures(full: Floats, compressed: Floats) -> Figure:
    """Images (height, width, 3) from the whole matrix and from the compressed one, and ten times their difference."""
    scale = 1 / np.percentile(full, 99)
    difference = 10 * np.abs(compressed - full)
    return side_by_side(
        [full * scale, compressed * scale, difference * scale], ["matrix", "compressed", "difference x 10"]
    )


def side_by_side(images: list[Floats], titles: list[str]) -> Figure:
    """Images (height, width, 3), linear, in a line; 1 is white."""
    figure = Figure(figsize=(5 * len(images), 4.2), layout="constrained")
    for axes, image, title in zip(
        np.atleast_1d(figure.subplots(1, len(images))), images, titles, strict=True
    ):
        axes.imshow(np.clip(image, 0, 1) ** (1 / 2.2))
        axes.set_title(title)
        axes.axis("off")
    return figure
