"""Pages for a browser: their size against what their truncated clustered PCA leaves out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from tqdm.auto import tqdm

from mi_sparse_prt.benchmark.measuring import kept_memory, report_header
from mi_sparse_prt.benchmark.relit_reference import environments_of
from mi_sparse_prt.compression.compress import compress
from mi_sparse_prt.core.metrics import relative_l2
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.emission.environment import Environment
from mi_sparse_prt.emission.haar import haar_colours
from mi_sparse_prt.precompute import precompute
from mi_sparse_prt.relighting.approximations import Everything, wavelet_bands
from mi_sparse_prt.relighting.clusters import ClusterColumns, cluster_columns
from mi_sparse_prt.relighting.players import ClusteredPlayer
from mi_sparse_prt.relighting.viewer import KEPT, make_page
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.validation.matrix_figures import panels
from mi_sparse_prt.validation.validate import save_figures

SHARES = (0.01, 0.02, 0.03, KEPT, 0.1, 0.2, 1.0)  # of the wavelet coefficients that are kept
ROTATIONS = 36  # of each environment
TARGET = 0.02  # of the matrix

Floats = NDArray[np.float32]
Report = dict[str, Any]


@kept_memory()
def measure_pages(
    scene: Scene,
    lighting: CubemapLighting,
    progress: bool = True,
    figures: Path | None = None,
    rotations: int = ROTATIONS,
) -> Report:
    """Make pages of several sizes, and compare colours of vertices with those of the whole clustered PCA.

    Parameters
    ----------
    scene : Scene
    lighting : CubemapLighting
    progress : bool
    figures : path, optional
        Folder for ``pages.png``, made if needed.
    rotations : int
        Of each environment, over a full turn.

    Returns
    -------
    dict
        JSON as it is. ``machine``, ``scene``; ``compression_error`` of the matrix; ``pages``, for each share that is
        ``kept``: ``bytes``, ``errors`` (relative L2 of the colours of all vertices, mean over rotations) of each
        environment, their ``mean`` and ``worst``.
    """
    transport = compress(
        precompute(scene, lighting, target_error=TARGET, progress=progress), progress=progress
    )
    clusters = cluster_columns(transport.operators["compressed"])  # type: ignore[arg-type]
    environments = environments_of(scene)
    lights = {name: _turned(light, lighting, rotations) for name, light in environments.items()}
    exact = {name: _colours(clusters, own, transport.albedo) for name, own in lights.items()}
    pages = []
    for kept in tqdm(SHARES, desc="pages", disable=not progress):
        page = make_page(scene, transport, environments, kept=kept)
        errors = {
            name: float(np.mean([relative_l2(a, b) for a, b in zip(found, exact[name], strict=True)]))
            for name, own in lights.items()
            for found in [_colours(page.clusters, own, transport.albedo)]
        }
        mean, worst = float(np.mean([*errors.values()])), max(errors.values())
        pages.append({"kept": kept, "bytes": len(page.text), "errors": errors, "mean": mean, "worst": worst})
    if figures is not None:
        save_figures(figures, {"pages": _figure(pages)})
    error = transport.report["compression"]["error"]["total"]
    return report_header(scene, lighting) | {"compression_error": error, "pages": pages}


def _turned(environment: Environment, lighting: CubemapLighting, rotations: int) -> list[Floats]:
    """Wavelets of an environment, turned all around."""
    scale = np.sqrt(lighting.solid_angles, dtype=np.float32)
    turns = (environment.rotated(360 * k / rotations) for k in range(rotations))
    return [haar_colours(lighting.project(light), scale) for light in turns]


def _colours(clusters: ClusterColumns, lights: list[Floats], albedo: Floats) -> list[NDArray[np.float16]]:
    """Of all vertices, in half floats: they are many."""
    resolution = round((len(lights[0]) / 6) ** 0.5)
    everything, playing = Everything(wavelet_bands(resolution)), ClusteredPlayer(clusters)
    found = []
    for light in lights:
        playing.apply(everything.update(light, None))
        found.append(playing.radiance(albedo).astype(np.float16))
    return found


def _figure(pages: list[Report]) -> Figure:
    """Size against error."""
    figure, axes = panels(5.5, 4, 1, 1)
    axis = np.ravel(axes)[0]
    sizes = [page["bytes"] / 1e6 for page in pages]
    for key, words in (("mean", "mean of the environments"), ("worst", "worst environment")):
        axis.loglog(sizes, [100 * page[key] for page in pages], "o-", label=words)
    for page, size in zip(pages, sizes, strict=True):
        axis.annotate(f"{page['kept']:.0%}", (size, 100 * page["mean"]), (3, 4), textcoords="offset points")
    axis.set(xlabel="size of the page (MB)", ylabel="relative L2 of vertex colours (%)")
    axis.legend()
    return figure
