"""Is the matrix right? Against Mitsuba's own render of it, and a relit image against ``path``."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.metrics import (
    flip_map,
    relative_l2,
    relative_l2_from_squares,
    relative_l2_of_rows,
    relative_l2_without_noise,
)
from mi_sparse_prt.measurement.vertices import Points, VertexRays, sensor_points, vertex_points, vertex_rays
from mi_sparse_prt.relighting.image import background_emitter, render
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.problem import diffuse_problem
from mi_sparse_prt.transport import LightTransport, MeshRange
from mi_sparse_prt.validation.mitsuba_reference import (
    ReferenceMatrix,
    image_of_vertices,
    posed,
    reference_image,
    reference_vertices,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

GRAZED = 1e-4  # relative difference from which an element of the direct part counts as different


@dataclass(frozen=True)
class Validation:
    """Outcome of ``validate``.

    Attributes
    ----------
    report : dict
        JSON as it is. ``relative_l2`` (``total``, ``meshes``): error with the reference's noise taken out;
        ``reference_noise``; ``with_noise``: the plain difference; ``row_95th_percentile``, ``row_worst``,
        ``column_worst``; ``estimated_error``: what the matrix said of itself; ``direct_at_hits`` and
        ``hit_against_vertex``: see ``validate``; ``image``: relative L2 (noise taken out), FLIP, and in
        ``interpolation`` the relative L2 of an image whose vertices Mitsuba itself computed.
    figures : dict of matplotlib Figure
        ``image``, ``errors``, ``rows``.
    """

    report: dict[str, Any]
    figures: dict[str, Figure]

    def save(self, folder: str | Path) -> None:
        """Write ``report.json`` and a PNG of every figure into a folder (made if needed)."""
        save_figures(Path(folder), self.figures)
        (Path(folder) / "report.json").write_text(json.dumps(self.report, indent=1))


def save_figures(folder: Path, figures: dict[str, Figure]) -> list[Path]:
    """Write each figure as ``<name>.png`` into a folder (made if needed); where they are."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{name}.png" for name in figures]
    for path, figure in zip(paths, figures.values(), strict=True):
        figure.savefig(path, dpi=110, bbox_inches="tight")
    return paths


def validate(
    scene: Scene,
    transport: LightTransport,
    n_rows: int = 64,
    n_columns: int = 256,
    spp: int = 1024,
    seed: int = 0,
    progress: bool = True,
    *,
    image: bool = True,
    image_width: int = 320,
    image_spp: int = 256,
) -> Validation:
    """Compare a matrix with Mitsuba's full render of it.

    Parameters
    ----------
    scene : Scene
    transport : LightTransport
    n_rows, n_columns : int
        Vertices (drawn per mesh) and texels (drawn per stretch of the cubemap) that are rendered; all, if there are
        no more.
    spp : int
        Samples per element of the reference, in two independent halves: their difference is its noise.
    seed : int
        Of the choice and of the reference.
    progress : bool
    image : bool
        Also relight under the scene's own environment and compare with ``path`` under the same cubemap (if the scene
        has a sensor and an environment).
    image_width, image_spp : int
        Size of the image; samples per pixel of its reference.

    Returns
    -------
    Validation

    Notes
    -----
    Mitsuba sees a vertex through a ray that ends beside it, and light that grazes an edge there may miss the vertex.
    So the matrix is compared with its direct part moved to these hits, and what the move changes is reported
    apart: ``hit_against_vertex``, in relative L2 of the matrix. ``direct_at_hits`` is our direct part there against
    Mitsuba's (without noise, in the direction basis): the share of elements that differ by more than 1e-4.
    """
    from mi_sparse_prt.validation import (
        matrix_figures as draw,  # matplotlib: half a second for whoever imports us
    )

    transport = transport.for_scene(scene)
    rng = np.random.default_rng([seed, 2])
    vertices = _stratified_vertices(transport.meshes, n_rows, rng)
    texels = _stratified(transport.lighting.n_directions, n_columns, rng)
    rays = vertex_rays(scene.normalised)
    max_depth = transport.report["parameters"]["max_depth"]

    reference = ReferenceMatrix(scene, transport.lighting, transport.basis, max_depth, vertices, rays)
    halves = [
        reference.columns(texels, max(1, spp // 2), seed=2 * seed + k, progress=progress) for k in (0, 1)
    ]
    ours = transport.rows(vertices)
    moved, at_hits = _moved_to_hits(scene, transport, ours[:, texels], rays, vertices, texels)
    report = matrix_errors(moved, halves[0], halves[1], vertices, texels, transport.meshes)
    report |= at_hits
    report["estimated_error"] = transport.report.get("estimated_error")
    report["missed_vertices"] = int(rays.missed.sum())
    report["parameters"] = {"rows": len(vertices), "columns": len(texels), "spp": spp, "seed": seed}
    figures = {
        "errors": draw.errors(moved, (halves[0] + halves[1]) / 2, vertices, transport.meshes),
        "rows": draw.rows(ours, transport.lighting, vertices),
    }
    environment = scene.mitsuba.environment()
    if image and environment is not None and scene.mitsuba.sensors():
        report["image"], figures["image"] = _image_error(
            scene, transport, environment, rays, image_width, image_spp, seed
        )
    return Validation(report, figures)


def matrix_errors(
    ours: NDArray[np.float32],
    first: NDArray[np.float32],
    second: NDArray[np.float32],
    vertices: NDArray[np.integer],
    texels: NDArray[np.integer],
    meshes: tuple[MeshRange, ...],
) -> dict[str, Any]:
    """Errors of a part of a matrix against two independent, equally noisy references.

    Parameters
    ----------
    ours, first, second : (rows, columns, 3) float32
    vertices, texels : (rows,), (columns,) integers
        Where the part lies in the matrix.
    meshes : tuple of MeshRange
        A mesh counts by its number of vertices, however many of them were chosen.

    Returns
    -------
    dict
        See ``Validation.report``. The mean of (T - X)(T - Y) over elements is free of the noise of X and Y.
    """
    t, x, y = (a.astype(np.float64) for a in (ours, first, second))
    square = ((t - x) * (t - y)).sum(axis=2)  # [row, column]
    norm = (x * y).sum(axis=2)
    noise = ((x - y) ** 2).sum(axis=2) / 4  # of the mean of the two
    plain = ((t - (x + y) / 2) ** 2).sum(axis=2)
    weight = np.zeros(len(vertices))  # of a row in the whole matrix
    inside = {}
    for mesh in meshes:
        inside[mesh.name] = (vertices >= mesh.vertices.start) & (vertices < mesh.vertices.stop)
        size = mesh.vertices.stop - mesh.vertices.start
        weight[inside[mesh.name]] = size / max(1, inside[mesh.name].sum())
    rows = relative_l2_of_rows(square.sum(axis=1), norm.sum(axis=1))
    columns = relative_l2_of_rows(weight @ square, weight @ norm)
    worst_row, worst_column = int(np.argmax(rows)), int(np.argmax(columns))

    def total(values: NDArray[np.float64]) -> float:
        return float(relative_l2_from_squares(weight @ values.sum(axis=1), weight @ norm.sum(axis=1)))

    return {
        "relative_l2": {
            "total": total(square),
            "meshes": {
                name: float(relative_l2_from_squares(square[own].sum(), norm[own].sum()))
                for name, own in inside.items()
                if own.any()
            },
        },
        "reference_noise": total(noise),
        "with_noise": total(plain),
        "row_95th_percentile": float(np.percentile(rows, 95)),
        "row_worst": {"vertex": int(vertices[worst_row]), "relative_l2": float(rows[worst_row])},
        "column_worst": {"texel": int(texels[worst_column]), "relative_l2": float(columns[worst_column])},
    }


def _stratified(count: int, wanted: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Sorted indices below ``count``, one at random from each of ``wanted`` stretches of equal length."""
    if wanted >= count:
        return np.arange(count)
    edges = np.linspace(0, count, wanted + 1)
    return np.floor(edges[:-1] + rng.random(wanted) * np.diff(edges)).astype(np.int64)


def _stratified_vertices(
    meshes: tuple[MeshRange, ...], wanted: int, rng: np.random.Generator
) -> NDArray[np.int64]:
    """Vertices of every mesh, about in proportion to its size, 4 at least."""
    total = sum(m.vertices.stop - m.vertices.start for m in meshes)
    chosen = []
    for mesh in meshes:
        size = mesh.vertices.stop - mesh.vertices.start
        chosen.append(mesh.vertices.start + _stratified(size, max(4, round(wanted * size / total)), rng))
    return np.concatenate(chosen)


def _moved_to_hits(
    scene: Scene,
    transport: LightTransport,
    ours: NDArray[np.float32],
    rays: VertexRays,
    vertices: NDArray[np.int64],
    texels: NDArray[np.int64],
) -> tuple[NDArray[np.float32], dict[str, float]]:
    """Elements with their direct part evaluated where Mitsuba sees the vertices, and how right that part is there."""
    lighting, parameters = transport.lighting, transport.report["parameters"]
    flat = np.repeat(vertices, len(texels)), np.tile(texels, len(vertices))
    hits = sensor_points(scene, rays)

    def direct(points: Points, basis: str) -> NDArray[np.float32]:
        problem = replace(diffuse_problem(scene, lighting), basis=basis).at(points)
        solver = DirectSolver(problem, parameters["strata"], parameters["seed"])
        unit_albedo = solver.elements(*flat).reshape(len(vertices), -1, 1)
        return transport.albedo[vertices][:, None] * unit_albedo

    step = direct(hits, transport.basis) - direct(vertex_points(scene), transport.basis)
    reference = ReferenceMatrix(scene, lighting, "direction", 2, vertices, rays).columns(texels, spp=1)
    difference = np.abs(direct(hits, "direction") - reference)
    different = (difference > GRAZED * np.abs(reference)).any(axis=2)
    return ours + step, {
        "direct_at_hits": float(different.mean()),
        "hit_against_vertex": float(relative_l2(ours + step, ours)),
    }


def _image_error(
    scene: Scene,
    transport: LightTransport,
    environment: mi.Emitter,
    rays: VertexRays,
    width: int,
    spp: int,
    seed: int,
) -> tuple[dict[str, float], Figure]:
    """A relit image against ``path`` under the same cubemap, in two halves, and what interpolation alone costs."""
    from mi_sparse_prt.validation import matrix_figures as draw

    lighting = transport.lighting.project(environment)
    background = background_emitter(lighting, transport.lighting)
    max_depth = transport.report["parameters"]["max_depth"]
    sensor = scene.mitsuba.sensors()[0]
    seeds = (2 * seed + 10, 2 * seed + 11)
    with posed(sensor, width):
        ours = render(scene, transport, lighting, sensor, spp=max(16, spp // 8), seed=seed)
        halves = [reference_image(scene, background, sensor, max_depth, spp // 2, seed=k) for k in seeds]
        exact = []  # images of Mitsuba's own vertices, interpolated as ours are
        for k in seeds:
            radiance = reference_vertices(scene, background, rays, max_depth, max(1, spp // 8), seed=k)
            # a black albedo hides the irradiance from Mitsuba's radiance: there ours stands in
            irradiance = np.divide(
                radiance, scene.albedo, out=transport.irradiance(lighting), where=scene.albedo > 0.01
            )
            exact.append(
                image_of_vertices(scene, irradiance, background, max(16, spp // 8), sensor, seed + 20)
            )
    reference = (halves[0] + halves[1]) / 2
    x, y = (half.astype(np.float64) for half in halves)
    flip = flip_map(reference, ours)
    report = {
        "relative_l2": relative_l2_without_noise(ours, x, y)[0],
        "interpolation": relative_l2_without_noise(exact[0], x, y, exact[1])[0],
        "reference_noise": float(relative_l2_from_squares(((x - y) ** 2).sum() / 4, (x * y).sum())),
        "flip": float(flip.mean()),
    }
    return report, draw.images(ours, reference, flip, report)
