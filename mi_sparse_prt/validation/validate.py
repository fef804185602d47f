"""Is the matrix right? Against Mitsuba's own render of it, and a relit image against ``path``."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.core.metrics import (
    flip_map,
    relative_l2,
    relative_l2_from_squares,
    relative_l2_of_rows,
    relative_l2_without_noise,
    relative_noise,
)
from mi_sparse_prt.measurement.coincident_surfaces import lie_on_others
from mi_sparse_prt.measurement.vertices import Points, VertexRays, sensor_points, vertex_points, vertex_rays
from mi_sparse_prt.relighting.image import background_emitter, check_camera, render
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.lamps import LampRays
from mi_sparse_prt.solvers.problem import diffuse_problem
from mi_sparse_prt.transport import LightTransport, MeshRange
from mi_sparse_prt.validation.mitsuba_reference import (
    image_of_vertices,
    path_image,
    posed,
    reference_vertices,
)
from mi_sparse_prt.validation.reference_matrix import ReferenceMatrix

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DPI = 110  # of figures in files
PIXELS = 1 << 14  # rows, at most, of a matrix of pixels
PIXEL_SPP = 32  # at least
COLUMNS = 32  # of a matrix of pixels at a time: it has many points
STRATA = 8  # per axis, for what the move to a hit changes
GRAZED = 1e-4  # relative difference from which an element of the direct part counts as different

Floats = NDArray[np.float32]


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
        ``interpolation`` the relative L2 of an image whose vertices Mitsuba itself computed (cubemap, vertices).
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
        figure.savefig(path, dpi=DPI, bbox_inches="tight")
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
    sensor: int | mi.Sensor = 0,
) -> Validation:
    """Compare a matrix with Mitsuba's full render of it.

    Parameters
    ----------
    scene : Scene
    transport : LightTransport
    n_rows, n_columns : int
        Vertices (drawn per mesh) and elements (drawn per stretch of the cubemap) that are rendered; all, if there are
        no more. Of pixels whole images are rendered, of which at most 16,384 pixels count.
    spp : int
        Samples per element of the reference, in two independent halves: their difference is its noise. Pixels share the
        samples of ``n_rows`` vertices, but have at least 32 each.
    seed : int
        Of the choice and of the reference.
    progress : bool
    image : bool
        Also relight and compare with ``path``: under the scene's own environment, constant over each texel (if it has
        one, and a sensor), or by all lamps.
    image_width, image_spp : int
        Size of the image (of pixels, that of the matrix); samples per pixel of its reference.
    sensor : int or mi.Sensor
        The camera of the image, and of the rows that are pixels.

    Returns
    -------
    Validation

    Raises
    ------
    PrtError
        If the matrix belongs to another scene, or its pixels to another camera; if it is of single directions, in a
        scene of mirrors, glass or masks, in which Mitsuba's directional lights do not shine as environments do; or if
        none of the vertices chosen can be seen.

    Notes
    -----
    Mitsuba sees a vertex through a ray that ends beside it, and light that grazes an edge there may miss the vertex.
    Rows take vertices for diffuse, so those of other materials are seen under a speck of paint (``diffuse_patches``).
    The matrix is compared with its direct part moved to these hits, and what the move changes is reported
    apart: ``hit_against_vertex``, in relative L2 of the matrix. ``direct_at_hits`` is our direct part there against
    Mitsuba's (without noise, in the direction basis): the share of elements that differ by more than 1e-4. Matrices of
    pixels have neither, those of lamps no ``direct_at_hits``.
    """
    from mi_sparse_prt.validation import (
        matrix_figures as draw,  # matplotlib: half a second for whoever imports us
    )

    transport = transport.for_scene(scene)
    left_out = _left_out(scene, transport)
    rng = np.random.default_rng([seed, 2])
    rows = _chosen_rows(scene, transport, n_rows, sensor, rng)
    if rows.missed:
        left_out.append(
            f"{rows.missed} rows of vertices inside of other surfaces or on these: "
            "which of the two Mitsuba sees is a matter of rounding"
        )
    elements = _stratified(transport.shape[1], n_columns, rng)
    if rows.camera is not None:
        spp = max(PIXEL_SPP, spp * n_rows // len(rows.ids))
    emission, distant = transport.emission, transport.emission.kind == "cubemap"
    own_rays = rows.rays if distant else None  # lamps are in the world's frame
    reference = ReferenceMatrix(
        scene, emission, transport.basis, transport.max_depth, rows.ids, own_rays, rows.camera
    )
    halves = [
        reference.columns(elements, max(1, spp // 2), seed=2 * seed + k, progress=progress) for k in (0, 1)
    ]
    moved, at_hits = _moved_to_hits(scene, transport, rows, elements, seed)
    names = ("vertex" if rows.camera is None else "pixel"), ("texel" if distant else "lamp")
    report = matrix_errors(moved, halves[0], halves[1], rows.ids, elements, rows.groups, names)
    report |= at_hits
    report["estimated_error"] = transport.report.get("estimated_error")
    report["left_out"] = left_out
    report["missed_vertices"] = 0 if rows.rays is None else int(rows.rays.missed.sum())
    report["parameters"] = {"rows": len(rows.ids), "columns": len(elements), "spp": spp, "seed": seed}
    figures = {"errors": draw.errors(moved, (halves[0] + halves[1]) / 2, rows.ids, rows.groups)}
    if distant:
        shown = rows.ids[np.linspace(0, len(rows.ids) - 1, 4).astype(int)]
        figures["rows"] = draw.rows(transport.rows(shown), transport.lighting, shown)
    light = scene.mitsuba.environment() if distant else 1.0
    if image and light is not None and (rows.camera or scene.mitsuba.sensors()):
        camera = rows.camera or scene.sensor(sensor)
        picture = _Picture(camera, rows.rays, image_width, image_spp, seed)
        report["image"], figures["image"] = picture.error(scene, transport, light)
    return Validation(report, figures)


@dataclass(frozen=True)
class _Rows:
    """The rows that are compared: vertices, and rays that end at all of these, or pixels of a camera.

    ``missed`` is how many were chosen, and cannot be compared.
    """

    ids: NDArray[np.int64]
    groups: tuple[MeshRange, ...]
    rays: VertexRays | None = None
    camera: mi.Sensor | None = None
    missed: int = 0


def _left_out(scene: Scene, transport: LightTransport) -> list[str]:
    """Sentences about rows that Mitsuba's renders cannot be compared with.

    Raises
    ------
    PrtError
        If that is so of all columns.
    """
    if "specular" in transport.operators and transport.basis == "direction":
        raise PrtError(
            "Mitsuba's directional lights do not shine through glass and masks, nor by way of mirrors: "
            'validate a matrix of basis="texel"'
        )
    if transport.emission.kind == "cubemap" or transport.measurement.kind != "vertices":
        return []
    names = [k.name for k in scene.materials[: len(scene.fronts)] if not k.diffuse]
    if not names:
        return []
    return [f"rows of surfaces that are not diffuse: of lamps they are not compared: {', '.join(names)}"]


def _chosen_rows(
    scene: Scene, transport: LightTransport, n_rows: int, sensor: int | mi.Sensor, rng: np.random.Generator
) -> _Rows:
    if transport.measurement.kind == "vertices":
        every = transport.emission.kind == "cubemap"
        seen = [m for m, k in zip(transport.meshes, scene.materials, strict=True) if every or k.diffuse]
        ids = _stratified_vertices(tuple(seen) or transport.meshes, n_rows, rng)
        rays = vertex_rays(scene.normalised, scene)
        missed = rays.missed[ids] | lie_on_others(scene, rays.take(ids))
        if missed.all():
            raise PrtError(
                "none of the vertices chosen can be seen: all are inside of other surfaces or on these"
            )
        return _Rows(ids[~missed], transport.meshes, rays, missed=int(missed.sum()))
    if transport.measurement.image is None:
        raise PrtError(f"validate renders vertices and pixels, not {transport.measurement.kind!r}")
    camera, pixels = scene.sensor(sensor), transport.shape[0]
    check_camera(transport, camera)
    groups = (MeshRange("image", slice(0, pixels)),)
    return _Rows(_stratified(pixels, PIXELS, rng), groups, camera=camera)


def matrix_errors(
    ours: NDArray[np.float32],
    first: NDArray[np.float32],
    second: NDArray[np.float32],
    vertices: NDArray[np.integer],
    texels: NDArray[np.integer],
    meshes: tuple[MeshRange, ...],
    names: tuple[str, str] = ("vertex", "texel"),
) -> dict[str, Any]:
    """Errors of a part of a matrix against two independent, equally noisy references.

    Parameters
    ----------
    ours, first, second : (rows, columns, 3) float32
    vertices, texels : (rows,), (columns,) integers
        Where the part lies in the matrix.
    meshes : tuple of MeshRange
        A mesh counts by its number of vertices, however many of them were chosen.
    names : (str, str)
        What a row and a column are called.

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
        "row_worst": {names[0]: int(vertices[worst_row]), "relative_l2": float(rows[worst_row])},
        "column_worst": {names[1]: int(texels[worst_column]), "relative_l2": float(columns[worst_column])},
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
    scene: Scene, transport: LightTransport, rows: _Rows, elements: NDArray[np.int64], seed: int
) -> tuple[Floats, dict[str, float]]:
    """Elements with their direct part evaluated where Mitsuba sees the vertices, and how right that part is there."""
    if rows.rays is None:
        blocks = [elements[a : a + COLUMNS] for a in range(0, len(elements), COLUMNS)]
        return np.concatenate([transport.columns(block)[rows.ids] for block in blocks], axis=1), {}
    ours, hits = transport.rows(rows.ids)[:, elements], sensor_points(scene, rows.rays)
    distant = transport.emission.kind == "cubemap"
    ids, columns = np.meshgrid(rows.ids, elements, indexing="ij")

    def direct(points: Points, basis: str) -> Floats:
        problem = diffuse_problem(scene, transport.emission, transport.max_depth)
        problem = replace(problem, basis=basis, specular_apart="specular" in transport.operators).at(points)
        listed = ids.ravel(), columns.ravel()
        if distant:
            unit_albedo = DirectSolver(problem, STRATA, seed).elements(*listed)[:, None]
        else:
            unit_albedo = LampRays(problem, STRATA, seed).elements(*listed).mean
        return transport.albedo[rows.ids][:, None] * unit_albedo.reshape(*ids.shape, -1)

    moved = ours + direct(hits, transport.basis) - direct(vertex_points(scene), transport.basis)
    report = {"hit_against_vertex": float(relative_l2(moved, ours))}
    if distant:
        reference = ReferenceMatrix(scene, transport.emission, "direction", 2, rows.ids, rows.rays)
        exact = reference.columns(elements, spp=1)
        different = np.abs(direct(hits, "direction") - exact) > GRAZED * np.abs(exact)
        report["direct_at_hits"] = float(different.any(axis=2).mean())
    return moved, report


@dataclass(frozen=True)
class _Picture:
    """The image that is compared: ``rays`` are those of vertices, None where rows are pixels (its width is theirs)."""

    camera: mi.Sensor
    rays: VertexRays | None
    width: int
    spp: int
    seed: int

    def error(self, scene: Scene, transport: LightTransport, light: Any) -> tuple[dict[str, float], Figure]:
        """Against ``path`` under the same light, in two halves, and what interpolation alone costs."""
        from mi_sparse_prt.validation import matrix_figures as draw

        lighting, seeds = transport.emission.project(light), (2 * self.seed + 10, 2 * self.seed + 11)
        camera, spp = self.camera, max(16, self.spp // 8)
        exact = []  # images of Mitsuba's own vertices, interpolated as ours are
        with posed(camera, int(camera.film().size().x) if self.rays is None else self.width):
            ours = [render(scene, transport, lighting, camera, spp, seed=k) for k in seeds]
            with transport.emission.scene_lit_by(lighting, scene) as lit:
                halves = [path_image(lit, camera, transport.max_depth, self.spp // 2, seed=k) for k in seeds]
            if self.rays is not None and transport.emission.kind == "cubemap":
                exact = [self._interpolated(scene, transport, lighting, seed=k) for k in seeds]
        x, y = (half.astype(np.float64) for half in halves)
        image, truth = (ours[0] + ours[1]) / 2, (halves[0] + halves[1]) / 2
        flip = flip_map(truth, image)
        report = {
            "relative_l2": relative_l2_without_noise(ours[0], x, y, ours[1])[0],
            "reference_noise": relative_noise(x, y),
            "flip": float(flip.mean()),
        }
        if exact:
            report["interpolation"] = relative_l2_without_noise(exact[0], x, y, exact[1])[0]
        return report, draw.images(image, truth, flip, report)

    def _interpolated(self, scene: Scene, transport: LightTransport, lighting: Floats, seed: int) -> Floats:
        """An image of the radiance that Mitsuba itself finds at the vertices, interpolated as ours is."""
        assert self.rays is not None
        background, spp = background_emitter(lighting, transport.lighting), max(1, self.spp // 8)
        radiance = reference_vertices(scene, background, self.rays, transport.max_depth, spp, seed)
        # a black albedo hides the irradiance from Mitsuba's radiance: there ours stands in
        irradiance = np.divide(
            radiance, scene.albedo, out=transport.irradiance(lighting), where=scene.albedo > 0.01
        )
        return image_of_vertices(scene, irradiance, background, max(16, spp), self.camera, self.seed + 20)
