"""A scene, its matrix and some lights in one file: a page that relights it, in any browser, without a network."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.emission.environment import Environment
from mi_sparse_prt.emission.haar import haar_bands, haar_colours
from mi_sparse_prt.operators.clustered import Clustered
from mi_sparse_prt.reflection.reflection import Diffuse
from mi_sparse_prt.relighting.clusters import ClusterColumns, cluster_columns
from mi_sparse_prt.relighting.viewer import page_scene
from mi_sparse_prt.relighting.viewer.archive import packed
from mi_sparse_prt.relighting.viewer.colourings import colourings, in_page
from mi_sparse_prt.relighting.viewer.page_file import PageFile, page_text
from mi_sparse_prt.relighting.viewer.truncated_clusters import TruncatedClusters, truncate_clusters
from mi_sparse_prt.relighting.viewer.turning import axis_up
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.transport import LightTransport

KEPT = 0.05  # of the wavelet coefficients of all basis vectors, if not given
TURNS = 8  # azimuths of each environment, whose wavelets say how large those of light are
BLACK = 1e-30  # power of an environment that shines at all
SCRIPTS = (
    *(
        "archive",
        "shared",
        "light",
        "wavelets",
        "radiance_file",
        "camera",
        "turning",
        "webgl",
        "picture",
        "python",
    ),
    "main",
)
DIFFERENCES = frozenset({"triangles", "starts", "order", "labels"})  # are kept as such
MOST = 1 << 16  # columns, and wavelets, that the page can number

Floats = NDArray[np.float32]


@dataclass(frozen=True, repr=False)
class Page(PageFile):
    """A page, and what is in it.

    Attributes
    ----------
    text : str
        HTML.
    clusters : ClusterColumns
        What the page plays in place of the matrix's own clusters.
    notes : tuple of str
        What it shows otherwise than ``render`` does, a sentence each.

    Notes
    -----
    As the last line of a notebook's cell it is shown there.
    """

    text: str
    clusters: ClusterColumns
    notes: tuple[str, ...]


def make_page(
    scene: Scene,
    transport: LightTransport,
    environments: Mapping[str, Environment],
    *,
    kept: float = KEPT,
    sensor: int | mi.Sensor | None = None,
    title: str = "light transport",
) -> Page:
    """One HTML file that shows a scene under light that turns; it needs WebGL 2, and nothing from a network.

    Parameters
    ----------
    scene : Scene
    transport : LightTransport
        Of it, compressed by clustered PCA (``prt.compress``), without terms.
    environments : dict of name to Environment
        Lights to choose from; the first is shown first.
    kept : float
        Share of the wavelet coefficients of basis vectors that the page keeps, above 0 and up to 1: those that matter
        most for these lights.
    sensor : int or mi.Sensor, optional
        The first view; the first sensor if there is one.
    title : str

    Returns
    -------
    Page

    Raises
    ------
    PrtError
        If the matrix is another scene's or not of this kind, there is no light, or ``kept`` makes no sense.
    """
    transport = transport.for_scene(scene)
    operator, drawn = _played(transport), page_scene.draw_order(scene)
    played, arrays, header = played_part(operator, environments, kept, drawn.order)
    shown, about = shown_part(scene, transport, environments, sensor, drawn)
    text = page_text("index", SCRIPTS, title, packed(about | header, shown | arrays, DIFFERENCES))
    return Page(text, played, tuple(about["notes"]))


def played_part(
    operator: Clustered, environments: Mapping[str, Environment], kept: float, order: NDArray[np.int64]
) -> tuple[ClusterColumns, page_scene.Arrays, dict[str, Any]]:
    """What a page plays of clustered PCA, as ``make_page`` says: decoded, as arrays, and what to know of them."""
    if not environments:
        raise PrtError("a page without light shows nothing: give at least one environment")
    if not 0 < kept <= 1:
        raise PrtError(f"kept={kept}: give the share of coefficients to keep, above 0 and up to 1")
    lighting, clusters = operator.lighting, cluster_columns(operator)
    if max(clusters.columns.shape) > MOST:
        raise PrtError(
            f"{max(clusters.columns.shape)} wavelets or basis vectors are more than a page can number"
        )
    coarse_first = np.argsort(haar_bands(lighting.resolution)[0], kind="stable")
    truncated = truncate_clusters(clusters, kept, expected_sizes(environments, lighting), coarse_first)
    decoded = truncated.decoded()
    arrays = _basis_arrays(truncated) | _row_arrays(truncated, order) | {"norms": decoded.norms()}
    header = {
        "resolution": lighting.resolution,
        "clusters": len(clusters.starts) - 1,
        "vectors": clusters.sizes.shape[1],
        "channels": len(clusters.weights),
    }
    return decoded, arrays, header


def shown_part(
    scene: Scene,
    transport: LightTransport,
    environments: Mapping[str, Environment],
    sensor: int | mi.Sensor | None,
    drawn: page_scene.DrawOrder,
) -> tuple[page_scene.Arrays, dict[str, Any]]:
    """What a page shows whatever it plays: triangles, lights, a camera, colourings; as arrays, and words of these."""
    geometry, about = page_scene.geometry(scene, drawn)
    radiance, lights = page_scene.lights(environments)
    colours, words = in_page(colourings(transport), drawn.order)
    if sensor is None and scene.mitsuba.sensors():
        sensor = 0
    camera = page_scene.camera(scene, sensor)
    about |= {
        "camera": camera,
        "axis": axis_up(camera["up"]),
        "exposure": 0,
        "environments": lights,
        "notes": _notes(scene, transport.terms > 0),
    }
    return geometry | radiance | colours, about | words


def expected_sizes(environments: Mapping[str, Environment], lighting: CubemapLighting) -> Floats:
    """How large wavelet coefficients of these lights are, whichever way they are turned: (m,), the same in a band."""
    bands = haar_bands(lighting.resolution)[0]
    squares = np.zeros(bands.max() + 1)
    for environment in environments.values():
        for k in range(TURNS):
            texels = lighting.project(environment.rotated(360 * k / TURNS))
            wavelets = haar_colours(texels, np.sqrt(lighting.solid_angles, dtype=np.float32))
            power = np.square(wavelets, dtype=np.float64).sum(axis=1)
            squares += np.bincount(bands, power) / max(power.sum(), BLACK)
    if not squares.any():
        return np.ones(len(bands), np.float32)  # all are black: each wavelet is as likely as the others
    return np.sqrt(squares / np.bincount(bands)).astype(np.float32)[bands]


def _played(transport: LightTransport) -> Clustered:
    """The clusters of a matrix that a page can play."""
    if transport.measurement.kind != "vertices" or transport.emission.kind != CubemapLighting.kind:
        raise PrtError("a page shows matrices of vertices and a cubemap, no others")
    if not isinstance(transport.reflection, Diffuse):
        raise PrtError("a page without Python shows diffuse matrices: precompute this one without terms")
    operator = transport.operators.get("compressed")
    if not isinstance(operator, Clustered):
        raise PrtError("a page plays clustered PCA: compress the matrix first, prt.compress(transport)")
    return operator


def _notes(scene: Scene, shows_glossy: bool) -> tuple[str, ...]:
    """What the page draws otherwise than ``render``."""
    names = [k.name for k in scene.materials[: len(scene.fronts)] if k.single_directions]
    glossy = [k.name for k in scene.materials[: len(scene.fronts)] if k.glossy and not k.single_directions]
    notes = []
    if names:
        notes.append(f"Mirrors, glass and masks are drawn plain: {', '.join(names)}.")
    if glossy and not shows_glossy:
        notes.append(f"Glossy surfaces are drawn as diffuse ones: {', '.join(glossy)}.")
    return tuple(notes)


def _basis_arrays(truncated: TruncatedClusters) -> dict[str, NDArray[np.generic]]:
    """Columns of basis vectors: lists of wavelets as gaps, of which 255 stands for itself and more."""
    wavelets = truncated.wavelets.astype(np.int64)
    before = np.concatenate([[-1], wavelets[:-1]])
    before[truncated.starts[:-1][np.diff(truncated.starts) > 0]] = -1
    gaps = wavelets - before - 1
    more = gaps // 255
    bytes_of = np.full(int((more + 1).sum()), 255, np.uint8)
    bytes_of[np.cumsum(more + 1) - 1] = gaps % 255
    return {
        "starts": truncated.starts.astype(np.uint32),
        "gaps": bytes_of,
        "values": truncated.values,
        "scales": truncated.scales,
        "order": truncated.order_of_wavelets.astype(np.uint16),
    }


def _row_arrays(truncated: TruncatedClusters, order: NDArray[np.int64]) -> dict[str, NDArray[np.generic]]:
    """Clusters and weights of the vertices, which come in an order."""
    layout = truncated.layout
    labels = np.empty(len(order), np.uint16)
    labels[layout.order] = np.repeat(np.arange(len(layout.starts) - 1), np.diff(layout.starts))
    weights = np.empty_like(truncated.weights)
    weights[:, :, layout.order] = truncated.weights
    return {"labels": labels[order], "weights": weights[:, :, order]}
