"""Direct light, element by element, against Mitsuba's own `path` with max_depth 2."""

import mitsuba as mi
import numpy as np
import pytest
from conftest import T, build, diffuse, mesh, problem_at
from matplotlib.figure import Figure

import mi_sparse_prt as prt
from mi_sparse_prt.measurement.vertices import VertexRays, sensor_points, vertex_rays
from mi_sparse_prt.solvers.direct_rays import DirectSolver


def mitsuba_columns(
    scene: prt.Scene, rays: VertexRays, light: dict, columns, spp: int, seed: int = 0
) -> np.ndarray:
    """Radiance (vertices, columns, 3) that `path` at max_depth 2 sees at the sensor's hits.

    ``columns`` yields what to change in the emitter for each column, as `mi.traverse` names it.
    """
    shapes = {f"shape_{k}": shape for k, shape in enumerate(scene.normalised.shapes())}
    sensor = {"type": "mesh_vertices", "vertices": len(rays.origins)}
    lit = mi.load_dict({"type": "scene", "light": light, "sensor": sensor, **shapes})
    lit.sensors()[0].bind(lit, rays)
    parameters, path = mi.traverse(lit), mi.load_dict({"type": "path", "max_depth": 2})
    result = []
    for k, (name, value) in enumerate(columns):
        parameters[f"light.{name}"] = value
        parameters.update()
        image = mi.render(lit, integrator=path, spp=spp, seed=seed + k)
        result.append(lit.sensors()[0].radiance(image))
    return np.stack(result, axis=1)


def towards(directions: np.ndarray):
    """What makes a `directional` emitter shine FROM each direction."""
    for d in directions.astype(np.float64):
        across = np.eye(3)[np.argmin(np.abs(d))]
        yield "to_world", mi.Transform4f().look_at([0, 0, 0], -d, across)


def elements(solver: DirectSolver, albedo: np.ndarray, seed: int = 0) -> np.ndarray:
    n, m = len(solver.points), solver.lighting.n_directions
    white = solver.elements(np.repeat(np.arange(n), m), np.tile(np.arange(m), n), seed=seed)
    return albedo[:, None] * white.reshape(n, m, 1)


def share_that_differs(ours: np.ndarray, reference: np.ndarray) -> float:
    """Share of elements that differ by more than 1e-4, relative to the reference."""
    return float((np.abs(ours - reference) > 1e-4 * np.abs(reference)).any(axis=2).mean())


def test_all_columns_of_a_small_scene(coloured_scene, artefact):
    """Rationale: T's direct part is what Mitsuba would render with one directional light per column.

    A bumpy ball that shadows itself and a turned box over an open ground, 313 vertices; all 96 columns of
    n = 4, `directional` emitter with the texel's solid angle as irradiance, `path` of max_depth 2, one sample (there
    is no noise). Both are evaluated at the sensor's own hit: its point, shading and geometric normal.

    Expected: within 1e-4 relative on all but 0.1% of elements (light that grazes an edge: float rounding decides);
    no vertex is missed; a reference that is 2% off, or one whose columns are shifted by one texel, differs almost
    everywhere where there is light. Moving on to the vertices themselves, visibility changes at under 2% of elements:
    reported on the figure, which shows where (the difference is Mitsuba's, not the matrix's error).

    Result: 0.013% (4 elements) differ; from hits to vertices visibility differs on 1.3% and the matrix by 9% in
    relative L2 (the ball is coarse: a hit lies in a facet, which has its own horizon).
    """
    lighting, rays = prt.CubemapLighting(4), vertex_rays(coloured_scene.normalised)
    assert rays.missed.sum() == 0
    light = {"type": "directional", "direction": [0, 0, -1], "irradiance": 1.0}
    unit = mitsuba_columns(coloured_scene, rays, light, towards(lighting.directions), spp=1)
    reference = unit * lighting.solid_angles[:, None]

    hits = DirectSolver(problem_at(coloured_scene, lighting, sensor_points(coloured_scene, rays)))
    ours = elements(hits, coloured_scene.albedo)
    print(
        f"hit against Mitsuba: {share_that_differs(ours, reference):.5%} of elements differ by more than 1e-4"
    )
    lit = (reference > 0).any(axis=2)
    assert 0.2 < lit.mean() < 0.5
    assert share_that_differs(ours, reference) < 1e-3
    assert share_that_differs(ours, 1.02 * reference) > 0.95 * lit.mean()
    assert share_that_differs(ours, np.roll(reference, 1, axis=1)) > 0.3 * lit.mean()

    vertices = DirectSolver(problem_at(coloured_scene, lighting))
    at_vertices = elements(vertices, coloured_scene.albedo)
    moved = ((at_vertices > 0) != (ours > 0)).any(axis=2)
    relative = np.linalg.norm(at_vertices - ours) / np.linalg.norm(ours)
    assert moved.mean() < 0.02
    assert relative < 0.15
    print(f"vertex against hit: visibility {moved.mean():.3%}, relative L2 {relative:.3%}")

    differs = (np.abs(ours - reference) > 1e-4 * reference).any(axis=2)
    figure = Figure(figsize=(11, 4))
    panels = ((differs, f"hit against Mitsuba: {differs.mean():.4%} differ by > 1e-4"),
              (moved, f"vertex against hit: visibility {moved.mean():.2%}, relative L2 {relative:.2%}"))  # fmt: skip
    for axes, (values, title) in zip(figure.subplots(1, 2), panels, strict=True):
        axes.imshow(values, aspect="auto", cmap="gray_r", interpolation="nearest")
        axes.set(xlabel="texel", ylabel="vertex", title=title)
    artefact(figure)


@pytest.mark.parametrize("kind", ["open planes", "sphere", "cube", "slivers"])
def test_no_vertex_is_missed(kind, artefact):
    """Rationale: borders, poles, corners and needle-like triangles are where rays shot at vertices miss.

    An open plane through another one's middle, a sphere with its poles, a cube with its corners, and a disk of slivers
    (1:1000), each over a ground. One vertical and one oblique light, `path` of max_depth 2.

    Expected: every ray reaches its vertex; every value is finite, and equals ours at the sensor's hit but for at most
    0.1% of elements; every vertex that faces the zenith with nothing above is lit.

    Result: none missed, none different.
    """
    grey = diffuse(0.5, 0.5, 0.5)
    angle, n = 2 * np.pi * np.arange(48) / 48, np.arange(48)
    rim = np.stack([np.cos(angle), 0 * angle + 0.5, np.sin(angle)], axis=-1)
    ring = np.concatenate([rim * [0.999, 1, 0.999], rim])
    slivers = mesh("slivers", ring, np.stack([n, 48 + np.roll(n, -1), 48 + n], axis=-1), grey)
    shapes = {
        "open planes": {
            "wall": {
                "type": "rectangle",
                "to_world": T().rotate([0, 1, 0], 17),
                "bsdf": {"type": "twosided", "bsdf": grey},
            }
        },
        "sphere": {"sphere": {"type": "sphere", "center": [0, 1.1, 0], "bsdf": grey}},
        "cube": {"cube": {"type": "cube", "to_world": T().translate([0, 1.1, 0]), "bsdf": grey}},
        "slivers": {"slivers": slivers},
    }[kind]
    floor = {"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90).scale(2), "bsdf": grey}
    scene = build(float("inf") if kind == "slivers" else 0.7, floor=floor, **shapes)
    rays = vertex_rays(scene.normalised, scene)
    assert rays.missed.sum() == 0

    lighting = prt.CubemapLighting(2)
    light = {"type": "directional", "direction": [0, 0, -1], "irradiance": 1.0}
    reference = mitsuba_columns(scene, rays, light, towards(lighting.directions), spp=1)
    reference *= lighting.solid_angles[:, None]
    ours = elements(DirectSolver(problem_at(scene, lighting, sensor_points(scene, rays))), scene.albedo)
    assert np.isfinite(reference).all()
    assert share_that_differs(ours, reference) <= 1e-3

    at_vertices = elements(DirectSolver(problem_at(scene, lighting)), scene.albedo)
    assert np.isfinite(at_vertices).all()
    top = scene.positions[:, 1] > scene.positions[:, 1].max() - 1e-3
    up = top & (scene.normals[:, 1] > 0.9)
    for values in (ours, at_vertices):
        assert (values[up][:, lighting.directions[:, 1] > 0.5].sum(axis=(1, 2)) > 0.3).all()

    figure = Figure(figsize=(6, 3))
    axes = figure.subplots()
    for values, name in (
        (reference, "Mitsuba"),
        (ours, "ours at the hits"),
        (at_vertices, "ours at the vertices"),
    ):
        axes.plot(values.sum(axis=(1, 2)) / 3, label=name, lw=1)
    axes.set(xlabel="vertex", ylabel="sum of its row")
    axes.legend()
    artefact(figure)


@pytest.mark.slow  # test_analytic.py
def test_texel_basis_against_the_cubemap_emitter(grey_scene, artefact):
    """Rationale: in the texel basis an element is the mean over the texel's area, as the `cubemap` emitter lights it.

    All 24 columns at n = 2, 4 independent renders of 128 samples, against 8 independent estimates of 6 x 6 strata.

    Expected: column by column within 4 standard errors, all together within 3; the standard error of the total is
    under 0.2%, so that one side being 2% brighter fails (checked).

    Result: all together -0.05% with a standard error of 0.03%.
    """
    lighting, rays = prt.CubemapLighting(2), vertex_rays(grey_scene.normalised)
    light = {"type": "cubemap", "resolution": 2, "texel": 0}
    texels = [("texel", j) for j in range(24)]
    theirs = [
        mitsuba_columns(grey_scene, rays, light, texels, 128, seed=100 * k).sum(axis=(0, 2)) for k in range(4)
    ]
    solver = DirectSolver(problem_at(grey_scene, lighting, sensor_points(grey_scene, rays), basis="texel"), 6)
    ours = [elements(solver, grey_scene.albedo, seed=k).sum(axis=(0, 2)) for k in range(8)]

    def mean_and_error(runs: list) -> tuple[np.ndarray, np.ndarray]:
        values = np.array(runs, np.float64)
        return values.mean(axis=0), values.std(axis=0, ddof=1) / np.sqrt(len(values))

    (a, a_error), (b, b_error) = mean_and_error(ours), mean_and_error(theirs)
    error = np.hypot(a_error, b_error)
    lit = b > 0
    assert lit.sum() >= 20
    assert (np.abs(a - b) < 4 * error + 1e-6 * b).all()
    together = np.sqrt((error**2).sum()) / b.sum()
    assert together < 0.002
    assert abs(a.sum() / b.sum() - 1) < 3 * together
    assert abs(1.02 * a.sum() / b.sum() - 1) > 3 * together

    figure = Figure(figsize=(6, 3))
    axes = figure.subplots()
    axes.errorbar(
        np.flatnonzero(lit), (a / np.where(lit, b, 1) - 1)[lit], error[lit] / b[lit], fmt="o", capsize=2
    )
    axes.axhline(0, color="k", lw=0.5)
    axes.set(xlabel="texel", ylabel="column sum, ours / Mitsuba - 1")
    axes.set_title(f"all columns {a.sum() / b.sum() - 1:+.4%} +- {together:.4%}")
    artefact(figure)
    print(f"all columns {a.sum() / b.sum() - 1:+.4%} +- {together:.4%}")
