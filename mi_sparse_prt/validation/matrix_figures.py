"""Pictures of a validation."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from mi_sparse_prt.core.metrics import relative_l2
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.transport import MeshRange

# Where the faces +X, -X, +Y, -Y, +Z, -Z lie in an unfolded cube: (row, column)
_CROSS = ((1, 2), (1, 0), (0, 1), (2, 1), (1, 1), (1, 3))


def unfolded(texels: NDArray[np.floating], lighting: CubemapLighting) -> NDArray[np.floating]:
    """Texel values (6 n^2,) or (6 n^2, 3) as a picture of the unfolded cube, (3 n, 4 n[, 3]); NaN outside."""
    n = lighting.resolution
    picture = np.full((3 * n, 4 * n, *texels.shape[1:]), np.nan)
    for face, (row, column) in zip(texels.reshape(6, n, n, *texels.shape[1:]), _CROSS, strict=True):
        picture[row * n : (row + 1) * n, column * n : (column + 1) * n] = face
    return picture


def rows(
    values: NDArray[np.floating], lighting: CubemapLighting, vertices: NDArray[np.integer], count: int = 4
) -> Figure:
    """A few rows of T as unfolded cubemaps: where each vertex gets its light from."""
    chosen = np.linspace(0, len(vertices) - 1, min(count, len(vertices))).astype(int)
    figure = Figure(figsize=(4 * len(chosen), 3.4), layout="constrained")
    for axes, k in zip(np.atleast_1d(figure.subplots(1, len(chosen))), chosen, strict=True):
        density = values[k].mean(axis=1) / lighting.solid_angles
        image = axes.imshow(unfolded(density, lighting), cmap="magma")
        axes.set_title(f"vertex {vertices[k]}")
        axes.axis("off")
        figure.colorbar(image, ax=axes, shrink=0.7, label="T / solid angle (1/sr)")
    return figure


def errors(
    ours: NDArray[np.floating],
    reference: NDArray[np.floating],
    vertices: NDArray[np.integer],
    meshes: tuple[MeshRange, ...],
) -> Figure:
    """Relative L2 difference of every row, noise of the reference included, and element against element."""
    figure = Figure(figsize=(11, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    relative = relative_l2(ours, reference, axis=(1, 2))
    for mesh in meshes:
        inside = (vertices >= mesh.vertices.start) & (vertices < mesh.vertices.stop)
        left.plot(vertices[inside], relative[inside], ".", label=mesh.name)
    left.set(
        xlabel="vertex",
        ylabel="relative L2 of its row",
        yscale="log",
        title="rows, with the reference's noise",
    )
    left.legend()
    right.plot(reference.ravel(), ours.ravel(), ".", markersize=1, rasterized=True)
    top = float(reference.max(initial=0)) or 1.0
    right.plot([0, top], [0, top], "k-", linewidth=0.5)
    right.set(xlabel="Mitsuba", ylabel="matrix", title="elements")
    return figure


def images(
    ours: NDArray[np.floating],
    reference: NDArray[np.floating],
    flip: NDArray[np.floating],
    report: dict[str, float],
) -> Figure:
    """Relit image, Mitsuba's image and their FLIP difference."""
    error = f"FLIP {report['flip']:.4f}, relative L2 {report['relative_l2']:.2%}"
    return picture_row(
        {"matrix, relit": tonemapped(ours), "Mitsuba path": tonemapped(reference), error: flip}, "magma"
    )


def picture_row(pictures: Mapping[str, NDArray[np.floating]], cmap: str = "viridis") -> Figure:
    """Pictures (height, width, 3), or numbers (height, width) as colours, in [0, 1], side by side with their titles."""
    figure = Figure(figsize=(max(7, 5 * len(pictures)), 4.2), layout="constrained")
    panels = np.atleast_1d(figure.subplots(1, len(pictures)))
    for axes, (title, picture) in zip(panels, pictures.items(), strict=True):
        axes.imshow(np.clip(picture, 0, 1), vmin=0, vmax=1, cmap=cmap)
        axes.set_title(title)
        axes.axis("off")
    return figure


def tonemapped(image: NDArray[np.floating], brightest: float | None = None) -> NDArray[np.floating]:
    """Linear RGB as sRGB in [0, 1], 1 at ``brightest``; if not given, a tenth of a percent of the image is clipped."""
    top = float(np.percentile(image, 99.9)) if brightest is None else brightest
    scaled = np.clip(image / max(top, 1e-20), 0, 1)
    return np.where(scaled <= 0.0031308, 12.92 * scaled, 1.055 * scaled ** (1 / 2.4) - 0.055)
