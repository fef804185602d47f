"""Pictures of a validation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
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


def panels(width: float, height: float, *shape: int) -> tuple[Figure, Any]:
    """A figure (inches) and its axes: an array of them if there are several, rows and columns being ``shape``."""
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots(*shape)


def rows(
    values: NDArray[np.floating], lighting: CubemapLighting, vertices: NDArray[np.integer], count: int = 4
) -> Figure:
    """A few rows of T as unfolded cubemaps: where each vertex gets its light from."""
    chosen = np.linspace(0, len(vertices) - 1, min(count, len(vertices))).astype(int)
    figure, every = panels(4 * len(chosen), 3.4, 1, len(chosen))
    for axes, k in zip(np.atleast_1d(every), chosen, strict=True):
        density = values[k].mean(axis=1) / lighting.solid_angles
        image = draw_picture(axes, unfolded(density, lighting), f"vertex {vertices[k]}", cmap="magma")
        figure.colorbar(image, ax=axes, shrink=0.7, label="T / solid angle (1/sr)")
    return figure


def errors(
    ours: NDArray[np.floating],
    reference: NDArray[np.floating],
    vertices: NDArray[np.integer],
    meshes: tuple[MeshRange, ...],
) -> Figure:
    """Relative L2 difference of every row, noise of the reference included, and element against element."""
    figure, (left, right) = panels(11, 4.2, 1, 2)
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
    figure, every = panels(max(7, 5 * len(pictures)), 4.2, 1, len(pictures))
    for axes, (title, picture) in zip(np.atleast_1d(every), pictures.items(), strict=True):
        draw_picture(axes, np.clip(picture, 0, 1), title, vmin=0, vmax=1, cmap=cmap)
    return figure


def draw_picture(
    axes: Axes, picture: NDArray[np.floating], title: str, size: float | str = "large", **options: Any
) -> AxesImage:
    """A picture under its title, of a size in points or in matplotlib's words, without axes."""
    axes.set_title(title, fontsize=size)
    axes.axis("off")
    return axes.imshow(picture, **options)


def tonemapped(image: NDArray[np.floating], brightest: float | None = None) -> NDArray[np.floating]:
    """Linear RGB as sRGB in [0, 1], 1 at ``brightest``; if not given, a tenth of a percent of the image is clipped."""
    top = float(np.percentile(image, 99.9)) if brightest is None else brightest
    scaled = np.clip(image / max(top, 1e-20), 0, 1)
    return np.where(scaled <= 0.0031308, 12.92 * scaled, 1.055 * scaled ** (1 / 2.4) - 0.055)
