"""Interreflection by finite elements against path tracing, and where it is known in closed form."""

import numpy as np
import pytest
from conftest import COLOURS, T, build, diffuse, mesh, problem_at, still_life
from matplotlib.figure import Figure

import mi_sparse_prt as prt
from mi_sparse_prt.measurement.vertices import vertex_points
from mi_sparse_prt.operators.mean_cosine import MeanCosine
from mi_sparse_prt.reconstruction.node_placement import choose_nodes
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.solvers import form_factors
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.form_factors import gather_matrix
from mi_sparse_prt.solvers.paths import PathSolver
from mi_sparse_prt.solvers.radiosity import RadiositySolver


def test_still_life(artefact):
    """Rationale: path tracing knows nothing of vertices, finite elements nothing of paths. They share the
    scene alone.

    A coloured bumpy ball and box on a ground, 4009 vertices; texel basis at n = 2 (24 texels, 4 x 4 strata for the
    direct light). 100 random vertices: exact rows of 1024 gather rays, and 2 x 512 paths per element.

    Expected: relative L2 of the rows under 3% (the paths' noise is taken out by two independent halves): light is
    interpolated on edges of 0.1, across the folds of the box and under the ball's shadow. The mean over all rows and
    texels, per channel: within 3 standard errors of the paths and 1% (a bias of 2% fails); one bounce too few is
    10% or more.

    Result: rows 0.8% apart; means of the channels +0.2%, +0.3% and +0.9%, with standard errors of 0.3%.
    """
    scene, lighting = build(0.1, **still_life(COLOURS)), prt.CubemapLighting(2)
    points = vertex_points(scene)
    solver = DirectSolver(problem_at(scene, lighting, points, basis="texel"), 4)
    direct = MeanCosine(solver.rows(np.arange(len(points))), lighting)
    chosen = np.sort(np.random.default_rng(0).choice(len(points), 100, replace=False))
    found = RadiositySolver(problem_at(scene, lighting, points), 1024).rows(direct, chosen)
    halves = [
        PathSolver(problem_at(scene, lighting, points, basis="texel"), 512, seed=seed).rows(chosen)
        for seed in (0, 1)
    ]
    power = lighting.solid_angles[:, None]
    a, b = (half.mean * power for half in halves)
    known = ((a + b) / 2).mean(axis=(0, 1))
    error = np.sqrt(sum((half.variance * power**2).sum(axis=(0, 1)) for half in halves)) / 2 / (100 * 24)
    value = found.mean(axis=(0, 1))
    distance = float(np.vdot(found - a, found - b) / np.vdot(a, b))
    print(
        f"rows {np.sqrt(max(distance, 0)):.2%}, sums {np.round(value / known - 1, 4).tolist()}, "
        f"standard errors {np.round(error / known, 4).tolist()}"
    )
    figure = Figure(figsize=(5, 4))
    axes = figure.subplots()
    for c, colour in enumerate("rgb"):
        axes.loglog(((a + b) / 2)[..., c].ravel(), found[..., c].ravel(), ".", color=colour, ms=2)
    axes.plot([1e-4, 1e-1], [1e-4, 1e-1], "k", lw=0.5)
    axes.set(
        xlabel="paths",
        ylabel="gathered",
        title="white indirect transport",
        xlim=(1e-6, 0.2),
        ylim=(1e-6, 0.2),
    )
    artefact(figure)
    assert distance < 0.03**2
    assert (3 * error < 0.01 * known).all()
    assert (np.abs(value - known) < 3 * error + 0.01 * known).all()


def tile_before_a_wall(albedo: float) -> Scene:
    """A tile 1 mm before a wall, with triangles of 10 cm."""
    grey = diffuse(albedo, albedo, albedo)
    tile = T().translate([0.03, 0.02, 0.021]).scale([0.23, 0.23, 0.02])
    return build(
        0.1, wall={"type": "rectangle", "bsdf": grey}, tile={"type": "cube", "to_world": tile, "bsdf": grey}
    )


def back_of_the_tile(scene: Scene) -> np.ndarray:
    return np.flatnonzero((scene.normals[:, 2] < -0.9) & (np.abs(scene.positions[:, 2] - 0.001) < 1e-4))


def test_light_in_a_gap_is_reflected_as_surfaces_do(monkeypatch):
    """Rationale: rays that go on in a gap are absorbed by chance; too many or too few would be a wrong albedo.

    Form factors of the back of the tile, 4096 rays each. Of white surfaces, rays that met at most k more surfaces
    in the gap are those at `max_depth` 3 + k; so how many met k is known, and of albedo 0.7 there are 0.7^k of these.

    Expected: the sum within 4 standard errors, which are small enough to see an albedo that is 2% off; without a limit
        of depth white surfaces lose nothing to gaps, exactly.
    Result: off by 0.02%, with a standard error of 0.11%.
    """
    white, grey = tile_before_a_wall(1.0), tile_before_a_wall(0.7)
    back = back_of_the_tile(white)

    def sums(scene: Scene, max_depth: int) -> np.ndarray:
        points = vertex_points(scene)
        return gather_matrix(scene, points, 4096, max_depth, back, max_depth).sum(axis=1)

    most = [sums(white, 3 + k) for k in range(10)]
    met = np.diff(most, axis=0, prepend=0)  # [surfaces more, vertex]
    assert (met.sum(axis=1)[1:4] > 0.01 * met[0].sum()).all()
    expected, found = (0.7 ** np.arange(10) @ met), sums(grey, 12)
    difference = found - expected
    error = difference.std(ddof=1) * np.sqrt(len(back))
    print(f"{found.sum() / expected.sum() - 1:+.2%}, standard error {error / expected.sum():.2%}")
    assert error < 0.005 * expected.sum()
    assert abs(difference.sum()) < 4 * error
    kept = sums(white, -1)
    monkeypatch.setattr(form_factors, "NARROW", 0)
    np.testing.assert_array_equal(kept, sums(white, -1))


def test_a_gap_narrower_than_triangles(monkeypatch):
    """Rationale: a tile that is 1 mm before a wall hides nearly all light from the wall behind it, and triangles of
    10 cm have vertices beside the tile that see it all.

    The back of the tile under an even sky, `max_depth` 5, against 2 x 256 paths per element (24 texels).

    Expected: the relative L2 error of its light is less than half of what plain interpolation gives.
    Result: 17%, and 49% by plain interpolation. Without asking whether vertices are open themselves, 46%.
    """
    scene, lighting = tile_before_a_wall(0.6), prt.CubemapLighting(2)
    points, every = vertex_points(scene), np.arange(scene.n_vertices)
    problem = problem_at(scene, lighting, points, basis="texel")
    direct = MeanCosine(DirectSolver(problem, 4).rows(every), lighting)
    back, power = back_of_the_tile(scene), lighting.solid_angles[:, None]
    a, b = ((PathSolver(problem, 256, seed=seed).rows(back).mean * power).sum(axis=(1, 2)) for seed in (0, 1))
    errors = []
    for narrow in (form_factors.NARROW, 0):
        monkeypatch.setattr(form_factors, "NARROW", narrow)
        found = RadiositySolver(problem, 1024).rows(direct, back).sum(axis=(1, 2))
        errors.append(np.sqrt(max(np.vdot(found - a, found - b), 0) / np.vdot(a, b)))
    print("{:.1%}, {:.1%} by plain interpolation".format(*errors))
    assert errors[0] < errors[1] / 2


@pytest.mark.filterwarnings("ignore:.*faces point inwards")
def test_an_integrating_sphere(artefact):
    """Rationale: inside a sphere every point sees every area alike, so every bounce is known in closed form.

    A hollow sphere of albedo r = 0.8, open above a polar angle of 60 degrees: the opening is the share f = 0.25 of the
    area, and of the view from every wall point. For k interreflections irradiance / pi is f (1 + q + ... + q^k) under
    constant light, q = r (1 - f); f / (1 - q) without a limit. Tessellation as fine as 3 degrees; rays 256.

    Expected: mean over the vertices away from the rim within 0.5% (chords of 3 degrees lie 0.14% inside of the circle
    at most, areas are off by twice that, a standard error over 1000 vertices of 256 rays is far below); one bounce
    more or less is 3% at least.

    With a fifth of the vertices as nodes, the light of all of them is the same.

    Result: off by -0.03%, 0.00%, -0.01% and -0.08% (max_depth 2, 3, 5, -1).
    """
    albedo, f = 0.8, 0.25
    scene = build(float("inf"), sphere=bowl(np.radians(np.arange(180, 59, -3)), 120, diffuse(*(albedo,) * 3)))
    lighting, points = prt.CubemapLighting(8), vertex_points(scene)
    wall = scene.positions[:, 1] < np.cos(np.radians(65))
    solver = DirectSolver(problem_at(scene, lighting, points, basis="texel"), 2)
    direct = MeanCosine(solver.rows(np.arange(len(points))), lighting)
    even = direct.relight(np.ones((lighting.n_directions, 3), np.float32))[:, :1]
    print(f"direct {even[wall].mean():.5f}, known {f}")
    q = albedo * (1 - f)
    gather = RadiositySolver(problem_at(scene, lighting, points), 256)
    figure = Figure(figsize=(6, 3))
    axes = figure.subplots()
    for max_depth, known in ((2, f), (3, f * (1 + q)), (5, f * (1 - q**4) / (1 - q)), (-1, f / (1 - q))):
        gather.max_depth = max_depth
        value = even[:, 0] + gather.apply(even)[:, 0, 0]
        print(f"max_depth {max_depth}: {value[wall].mean():.5f}, known {known:.5f}")
        assert value[wall].mean() == pytest.approx(known, rel=5e-3)
        axes.plot(scene.positions[wall, 1], value[wall], ".", ms=1, label=f"max_depth {max_depth}")
        axes.axhline(known, color="k", lw=0.5)
    axes.set(xlabel="height", ylabel="irradiance / pi")
    axes.legend()
    artefact(figure)
    nodes = choose_nodes(scene, points, 1000, small=1000)
    some = RadiositySolver(problem_at(scene, lighting, points, max_depth=-1), 256, nodes=nodes)
    value = even[:, 0] + some.apply(even)[:, 0, 0]
    print(
        f"{len(some.nodes)} nodes of {len(points)} vertices: {value[wall].mean():.5f}, known {f / (1 - q):.5f}"
    )
    assert len(some.nodes) == 1000
    assert value[wall].mean() == pytest.approx(f / (1 - q), rel=5e-3)
    assert np.abs(value[wall] / (f / (1 - q)) - 1).max() < 0.1


def bowl(polar: np.ndarray, segments: int, bsdf: dict) -> object:
    """A part of the unit sphere that faces inwards; the pole at its bottom is closed by thin triangles."""
    polar = np.concatenate([[polar[0] - 1e-3], polar[1:]])
    phi = 2 * np.pi * np.arange(segments) / segments
    rings = [
        np.stack([np.sin(a) * np.cos(phi), 0 * phi + np.cos(a), np.sin(a) * np.sin(phi)], -1) for a in polar
    ]
    index = np.arange(len(polar) * segments).reshape(len(polar), segments)
    right = np.roll(index, -1, axis=1)
    a, b, c, d = (x.ravel() for x in (index[:-1], right[:-1], index[1:], right[1:]))
    triangles = np.concatenate([np.stack([a, b, c], -1), np.stack([b, d, c], -1)])
    return mesh("sphere", np.concatenate(rings), triangles, bsdf)


def test_a_room_of_one_radiance(artefact):
    """Rationale: a furnace. What a vertex sees of the walls and what it sees of the sky make up its hemisphere.

    A turned box with one side open, constant light. Direct light comes by Mitsuba's rays through texels, the gather
    matrix by cosine-distributed ones: the sums of a row of each add up to 1.

    Expected: 1 for every vertex, within 2% (64 x 64 x 6 rays through texels, 1024 gather rays), 0.5% rms, and within
    0.1% on average.

    Result: the worst vertex is off by 1.2%, 0.2% rms, 0.01% on average.
    """
    turn = T().rotate([0, 1, 0], 20).rotate([1, 0, 0], 35)
    walls = {
        f"wall_{k}": {
            "type": "rectangle",
            "to_world": turn @ T().rotate(axis, angle).translate([0, 0, -1]),
            "bsdf": diffuse(1, 1, 1),
        }
        for k, (axis, angle) in enumerate(
            [([0, 1, 0], 0), ([0, 1, 0], 90), ([0, 1, 0], 270), ([1, 0, 0], 90), ([1, 0, 0], -90)]
        )
    }
    scene, lighting = build(0.25, **walls), prt.CubemapLighting(16)
    points = vertex_points(scene)
    solver = DirectSolver(problem_at(scene, lighting, points, basis="texel"), 4)
    direct = MeanCosine(solver.rows(np.arange(len(points))), lighting)
    sky = direct.relight(np.ones((lighting.n_directions, 3), np.float32))[:, 0]
    walls_seen = RadiositySolver(problem_at(scene, lighting, points), 1024).matrix.sum(axis=1)
    off = sky + walls_seen - 1
    print(f"worst vertex {np.abs(off).max():.2%}, rms {np.sqrt((off**2).mean()):.2%}, mean {off.mean():+.3%}")
    figure = Figure(figsize=(6, 3))
    axes = figure.subplots()
    axes.plot(sky, label="sky")
    axes.plot(walls_seen, label="walls")
    axes.plot(sky + walls_seen, "k", lw=0.7, label="together")
    axes.set(xlabel="vertex", ylabel="share of the view")
    axes.legend()
    artefact(figure)
    assert 0.1 < sky.mean() < 0.3
    assert np.abs(off).max() < 0.02
    assert np.sqrt((off**2).mean()) < 0.005
    assert abs(off.mean()) < 1e-3
