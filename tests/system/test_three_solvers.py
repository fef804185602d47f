"""Solvers that share no estimator find the same indirect light.

Rows by tracing importance (adjoint), elements by path tracing, finite elements (gather), and Mitsuba's own `path` under
whole environments.
Rows are independent of each other, elements of an adjoint row are not: standard errors of sums are taken over rows.
"""

import mitsuba as mi
import numpy as np
import pytest
from conftest import COLOURS, T, build, bumpy_ball, diffuse, mesh, problem_at, still_life
from matplotlib.figure import Figure

import mi_sparse_prt as prt
from mi_sparse_prt.measurement.vertices import sensor_points, vertex_points, vertex_rays
from mi_sparse_prt.operators.mean_cosine import MeanCosine
from mi_sparse_prt.reconstruction.node_placement import choose_nodes
from mi_sparse_prt.solvers.adjoint_paths import AdjointSolver
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.paths import Estimate, PathSolver
from mi_sparse_prt.solvers.radiosity import RadiositySolver

pytestmark = pytest.mark.filterwarnings("ignore:.*is not diffuse")


def glossy_scene() -> prt.Scene:
    """A diffuse ground among a glass ball, a tilted mirror box, rough metal and a half-open mask."""
    shapes = still_life(COLOURS)
    vertices, triangles = bumpy_ball()
    mirror = {"type": "conductor", "specular_reflectance": {"type": "rgb", "value": [0.9, 0.8, 0.7]}}
    sheet = {"type": "mask", "opacity": 0.5, "bsdf": {"type": "twosided", "bsdf": diffuse(0.8, 0.8, 0.8)}}
    metal = {"type": "roughconductor", "alpha": 0.3}
    return build(
        0.5,
        ground=shapes["ground"],
        glass=mesh("glass", vertices + [-0.4, 0.7, 0], triangles, {"type": "dielectric"}),
        box={**shapes["box"], "bsdf": mirror},
        metal=mesh("metal", 0.4 * vertices + [0.3, 0.3, 0.9], triangles, metal),
        sheet={"type": "rectangle", "to_world": T().translate([0.3, 0.9, -0.9]).scale(0.4), "bsdf": sheet},
    )


def column_z(ours: Estimate, theirs: Estimate) -> np.ndarray:
    """z-scores of the sums of columns (columns, channels): over independent rows."""
    difference = (ours.mean.astype(np.float64) - theirs.mean).sum(axis=0)
    variance = (ours.variance.astype(np.float64) + theirs.variance).sum(axis=0)
    return difference / np.sqrt(np.maximum(variance, 1e-30))


def totals(ours: Estimate, theirs: Estimate) -> tuple[np.ndarray, np.ndarray]:
    """z-score of each channel's total, and its standard error relative to the total."""
    difference = (ours.mean.astype(np.float64) - theirs.mean).sum(axis=1)  # [row, channel]
    error = np.sqrt((difference**2).sum(axis=0))
    return difference.sum(axis=0) / error, error / theirs.mean.sum(axis=(0, 1), dtype=np.float64)


def assert_agree(ours: Estimate, theirs: Estimate, bias: float = 0.02) -> None:
    """Totals of channels within 3 standard errors, columns as normal deviates; such a bias is 3.5 of them or more."""
    z, error = totals(ours, theirs)
    columns = column_z(ours, theirs)
    print(
        f"total z {z.round(2)}, standard error {error.max():.2%}; columns: std {columns.std():.2f}, "
        f"largest {np.abs(columns).max():.1f}"
    )
    assert (np.abs(z) < 3).all()
    assert np.abs(columns).max() < 4.5
    assert columns.std() < 1.35
    assert 3.5 * error.min() < bias


def draw(ours: Estimate, theirs: Estimate) -> Figure:
    """Elements against each other, and the z-scores of columns."""
    figure = Figure(figsize=(9, 4))
    left, right = figure.subplots(1, 2)
    left.plot(theirs.mean.ravel(), ours.mean.ravel(), ".", ms=2)
    top = float(theirs.mean.max())
    left.plot([0, top], [0, top], "k", lw=0.5)
    left.set(xlabel="path tracing", ylabel="adjoint", title="elements, 1/sr")
    for z, colour in zip(column_z(ours, theirs).T, ("tab:red", "tab:green", "tab:blue"), strict=True):
        right.plot(z, ".", color=colour)
    right.axhline(0, color="k", lw=0.5)
    right.set(xlabel="column", title="z-score of the column's sum, by channel", ylim=(-5, 5))
    return figure


@pytest.mark.parametrize(
    ("max_depth", "basis"),
    [
        pytest.param(3, "direction", marks=pytest.mark.slow),
        (5, "direction"),
        (-1, "direction"),
        (4, "texel"),
    ],
)
def test_adjoint_rows_are_path_traced_elements(coloured_scene, artefact, max_depth, basis):
    """Rationale: one interreflection, three, any number; both bases; coloured surfaces.

    The coloured still life, all vertices, n = 2; 128 samples of adjoint rows, 256 paths per element.

    Expected: totals of the three channels and sums of the columns agree within their standard errors, of 0.5% for the
    totals; a bias of 2% would be found.

    Result: total z within 2.4 (400 seeds together: within 0.7 of a standard error of 0.1%); columns' z-scores with a
    spread of 0.9 to 1.1.
    """
    ids = np.arange(coloured_scene.n_vertices)
    problem = problem_at(coloured_scene, prt.CubemapLighting(2), basis=basis, max_depth=max_depth)
    ours = AdjointSolver(problem, spp=128, seed=1).rows(ids)
    theirs = PathSolver(problem, spp=256, seed=2).rows(ids)
    artefact(draw(ours, theirs))
    assert_agree(ours, theirs)


@pytest.mark.parametrize(("basis", "n"), [("direction", 2), ("texel", 1)])
def test_glass_metal_and_mirrors(artefact, basis, n):
    """Rationale: paths meet any BSDF; light in mirrors and through glass is found by the paths that run into it.

    A diffuse ground among a glass ball, a mirror box, rough metal and a mask of half opacity; ground vertices,
    max_depth 5; large texels, as single directions and light that glass focuses are found by few paths.

    Expected: as between diffuse surfaces; a bias of 5% would be found in spite of those few.

    Result: total z within 1.4, standard errors of 1.1%.
    """
    scene = glossy_scene()
    ids = np.arange(scene.meshes[0].vertices.stop)
    problem = problem_at(scene, prt.CubemapLighting(n), basis=basis, max_depth=5)
    ours = AdjointSolver(problem, spp=1024, seed=1).rows(ids)
    theirs = PathSolver(problem, spp=1024, seed=2).rows(ids)
    artefact(draw(ours, theirs))
    assert_agree(ours, theirs, 0.05)


class Mitsuba:
    """Indirect light that leaves the vertices under an environment: `path` at two depths."""

    def __init__(self, scene: prt.Scene, light: dict, max_depth: int) -> None:
        rays = vertex_rays(scene.normalised, scene)
        shapes = {f"shape_{k}": shape for k, shape in enumerate(scene.normalised.shapes())}
        sensor = {"type": "mesh_vertices", "vertices": len(rays.origins)}
        self.lit = mi.load_dict({"type": "scene", "light": light, "sensor": sensor, **shapes})
        self.lit.sensors()[0].bind(self.lit, rays)
        self.parameters = mi.traverse(self.lit)
        self.paths = [mi.load_dict({"type": "path", "max_depth": depth}) for depth in (max_depth, 2)]

    def renders(self, n: int, spp: int) -> np.ndarray:
        """Independent estimates (n, n_v, 3). The same seed at both depths: direct parts cancel."""
        sensor, result = self.lit.sensors()[0], []
        for k in range(n):
            images = (mi.render(self.lit, integrator=path, spp=spp, seed=k) for path in self.paths)
            whole, direct = (sensor.radiance(image).astype(np.float64) for image in images)
            result.append(whole - direct)
        return np.array(result)


def test_row_sums_under_even_light(coloured_scene):
    """Rationale: a row's sum over texels, times their solid angles, is the light under radiance 1 from everywhere.

    Coloured still life, texel basis, max_depth 4, n = 4, against Mitsuba's `constant` emitter at the sensor's own
    hits. Shared paths make elements of a row correlated, so the standard errors come from 8 seeds and 8 renders.

    Expected: the totals of the channels within 3.5 standard errors, these under 0.5%.

    Result: total z within 1.9, standard errors of 0.4%.
    """
    scene, lighting = coloured_scene, prt.CubemapLighting(4)
    adjoint = AdjointSolver(problem_at(scene, lighting, sensor_points(scene), basis="texel", max_depth=4), 16)
    ids = np.arange(scene.n_vertices)
    sums = [
        np.einsum("ijc,j,ic->c", adjoint.rows(ids, seed=k).mean, lighting.solid_angles, scene.albedo)
        for k in range(8)
    ]
    theirs = Mitsuba(scene, {"type": "constant", "radiance": 1.0}, 4).renders(8, 256).sum(axis=1)
    error = np.hypot(*(np.std(x, axis=0, ddof=1) / np.sqrt(8) for x in (sums, theirs)))
    expected = theirs.mean(axis=0)
    z = (np.mean(sums, axis=0) - expected) / error
    print(f"z {z.round(2)}, standard error {(error / expected).max():.2%}")
    assert (error < 0.005 * expected).all()
    assert (np.abs(z) < 3.5).all()


def test_inner_product(coloured_scene):
    """Rationale: <m, S V E> = <(S V)* m, E> for any measurement m and any light E: what defines the adjoint.

    Four random pairs: m of both signs over the vertices, E positive over 24 texels and three channels. The left
    side is Mitsuba's `path` under the `cubemap` emitter of E, its direct part taken out; the right side applies the
    sum of adjoint rows, weighted by m, to E. Max_depth 5, texel basis.

    Expected: each pair within 4 standard errors (from 8 seeds and 8 renders), these under 1.2% of <|m|, S V E>; with
    the texels of E in another order some pair is off by more than 6.

    Result: z within 2.5, standard errors of 0.3 to 0.6%; up to 13 with the texels in another order.
    """
    scene, lighting = coloured_scene, prt.CubemapLighting(2)
    rng = np.random.default_rng(3)
    adjoint = AdjointSolver(problem_at(scene, lighting, sensor_points(scene), basis="texel"), 64)
    ids = np.arange(scene.n_vertices)
    # T[seed, row, texel, channel]
    rows = np.array([adjoint.rows(ids, seed=k).mean.astype(np.float64) for k in range(8)])
    rows *= (lighting.solid_angles[:, None] * scene.albedo[:, None, :]).astype(np.float64)
    forward = Mitsuba(scene, {"type": "cubemap", "data": mi.TensorXf(np.ones((24, 3), np.float32))}, 5)
    off_in_another_order = []
    for _ in range(4):
        m = rng.normal(size=scene.n_vertices)
        light = rng.random((24, 3)) ** 4
        forward.parameters["light.data"] = mi.TensorXf(light.astype(np.float32))
        forward.parameters.update()
        radiance = forward.renders(8, 128)  # [render, row, channel]
        left = np.einsum("i,kic->k", m, radiance)
        adjoint_solution = np.einsum("i,kijc->kjc", m, rows)
        right, wrong = (np.einsum("kjc,jc->k", adjoint_solution, e) for e in (light, light[::-1]))
        error = np.sqrt(sum(x.var(ddof=1) / len(x) for x in (left, right)))
        size = np.einsum("i,ic->", np.abs(m), radiance.mean(axis=0))
        z, z_wrong = ((left.mean() - x.mean()) / error for x in (right, wrong))
        print(f"z {z:+.2f}, error {error / size:.2%}, texels in another order {z_wrong:+.1f}")
        assert error < 0.012 * size
        assert abs(z) < 4
        off_in_another_order.append(abs(z_wrong))
    assert max(off_in_another_order) > 6


def direct_part(scene: prt.Scene, lighting: prt.CubemapLighting) -> MeanCosine:
    points = vertex_points(scene)
    solver = DirectSolver(problem_at(scene, lighting, points, basis="texel"), 4)
    return MeanCosine(solver.rows(np.arange(len(points))), lighting)


def test_finite_elements_among_the_others(artefact):
    """Rationale: paths to each element, importance from each vertex, and light between finite elements share nothing
    but the scene.

    Coloured still life with edges of 0.1, max_depth 5, texel basis at n = 2, 200 random vertices: 128 samples of
    adjoint rows, 256 paths per element, exact rows of 512 gather rays.

    Expected: paths and adjoint rows agree within their standard errors. Finite elements f are interpolated: their
    squared distance, <f - paths, f - adjoint> without the noise of either, is under 3% of the rows, and totals of
    channels are within 3 standard errors and 1% of both others.
    """
    scene, lighting = build(0.1, **still_life(COLOURS)), prt.CubemapLighting(2)
    ids = np.sort(np.random.default_rng(4).choice(scene.n_vertices, 200, replace=False))
    problem = problem_at(scene, lighting, basis="texel", max_depth=5)
    adjoint = AdjointSolver(problem, spp=128, seed=1).rows(ids)
    paths = PathSolver(problem, spp=256, seed=2).rows(ids)
    gather = RadiositySolver(problem_at(scene, lighting), 512)
    found = gather.rows(direct_part(scene, lighting), ids) / lighting.solid_angles[:, None]
    artefact(draw(adjoint, paths))
    assert_agree(adjoint, paths, bias=0.05)
    square = np.vdot(found - adjoint.mean, found - paths.mean) / np.vdot(adjoint.mean, paths.mean)
    print(f"finite elements: rows {np.sqrt(max(square, 0)):.2%} off")
    assert square < 0.03**2
    for other in (adjoint, paths):
        total = other.mean.sum(axis=(0, 1), dtype=np.float64)
        z, error = totals(Estimate(found, np.zeros_like(found)), other)
        off = found.sum(axis=(0, 1), dtype=np.float64) / total - 1
        print(f"totals off by {np.round(off, 4).tolist()}, standard error {error.max():.2%}")
        assert (np.abs(off) < 3 * error + 0.01).all()


@pytest.mark.parametrize("most_nodes", [1000, 150])
def test_inner_product_of_finite_elements(coloured_scene, most_nodes):
    """Rationale: <m, S V E> = <(S V)* m, E>: bounces forward from a light, and in reverse from the vertices.

    Coloured still life, light gathered at all 313 vertices or at half of them; three random pairs, m of both signs.

    Expected: equal but for rounding, 1e-5 of the same sum over |m|.
    """
    lighting, rng = prt.CubemapLighting(4), np.random.default_rng(3)
    points = vertex_points(coloured_scene)
    nodes = choose_nodes(coloured_scene, points, most_nodes, small=50)
    gather = RadiositySolver(problem_at(coloured_scene, lighting, points), 64, nodes=nodes)
    assert (len(gather.nodes) < 200) == (most_nodes == 150)
    direct = direct_part(coloured_scene, lighting)
    rows = gather.rows(direct, np.arange(coloured_scene.n_vertices)).astype(np.float64)
    off_in_another_order = []
    for _ in range(3):
        m, light = rng.normal(size=coloured_scene.n_vertices), rng.random((96, 3), dtype=np.float32) ** 4
        bounced = gather.apply(direct.relight(light))  # [vertex, light of a channel, channel]
        forward = np.einsum("i,icc->", m, bounced, dtype=np.float64)
        solution = np.einsum("i,ijc->jc", m, rows)
        adjoint, wrong = (np.vdot(solution, some) for some in (light, light[::-1]))
        size = np.einsum("i,icc->", np.abs(m), bounced, dtype=np.float64)
        assert abs(forward - adjoint) < 1e-5 * size
        off_in_another_order.append(abs(forward - wrong) / size)
    assert max(off_in_another_order) > 1e-3


@pytest.mark.filterwarnings("ignore:.*faces point inwards")
@pytest.mark.parametrize("basis", ["direction", "texel"])
def test_a_closed_box_is_dark(basis):
    """Rationale: importance that starts in a closed box stays in it.

    A ball in a turned cube of albedo 0.8 that faces inwards, corners included; n = 4, max_depth 6.

    Expected: every element is exactly zero.
    """
    vertices, triangles = bumpy_ball()
    place = T().rotate([0, 1, 0], 17).rotate([1, 0, 0], 29)
    box = {"type": "cube", "flip_normals": True, "to_world": place, "bsdf": diffuse(0.8, 0.8, 0.8)}
    scene = build(0.5, ball=mesh("ball", vertices, triangles, diffuse(0.5, 0.5, 0.5)), box=box)
    problem = problem_at(scene, prt.CubemapLighting(4), basis=basis, max_depth=6)
    estimate = AdjointSolver(problem, spp=4).rows(np.arange(scene.n_vertices))
    assert not estimate.mean.any()
    assert not estimate.variance.any()
