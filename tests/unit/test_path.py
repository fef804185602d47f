"""Indirect elements by path tracing: the estimator's bookkeeping, statistics and reach."""

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from conftest import T, build, diffuse, problem_at
from scipy import stats

import mi_sparse_prt as prt
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.solvers import paths as path_module
from mi_sparse_prt.solvers.paths import PathSolver

pytestmark = pytest.mark.filterwarnings("ignore:.*is not diffuse")


def solver(
    scene: Scene,
    n: int = 2,
    basis: str = "direction",
    max_depth: int = 5,
    channels: int | None = None,
    **parameters: int,
) -> PathSolver:
    """Of fewer or more channels than the scene's colours ask for, if wanted."""
    problem = problem_at(scene, prt.CubemapLighting(n), basis=basis, max_depth=max_depth)
    found = PathSolver(problem, **parameters)
    found.channels = channels or found.channels
    return found


@pytest.mark.parametrize("basis", ["direction", "texel"])
def test_rows_are_their_elements(grey_scene, basis):
    path = solver(grey_scene, basis=basis, channels=1)
    some = np.array([5, 250, 5, 31])
    rows = path.rows(some)
    elements = path.elements(np.repeat(some, 24), np.tile(np.arange(24), 4))
    assert rows.mean.shape == rows.variance.shape == (4, 24, 1)
    assert rows.mean.dtype == rows.variance.dtype == np.float32
    assert np.array_equal(rows.mean.ravel(), elements.mean.ravel())
    assert np.array_equal(rows.variance.ravel(), elements.variance.ravel())
    assert np.array_equal(rows.mean[0], rows.mean[2])  # the same element, the same numbers
    assert rows.mean.max() > 0


def test_same_seed_same_estimate_other_seed_another(grey_scene):
    ids = np.arange(grey_scene.n_vertices)
    first = solver(grey_scene, seed=3).rows(ids).mean
    assert np.array_equal(first, solver(grey_scene, seed=3).rows(ids).mean)
    other = solver(grey_scene, seed=4).rows(ids).mean
    assert (first != other).mean() > 0.3
    by_argument = solver(grey_scene, seed=3).elements(
        np.repeat(ids, 24), np.tile(np.arange(24), len(ids)), seed=4
    )
    assert np.array_equal(by_argument.mean.ravel(), other.ravel())


@pytest.mark.parametrize("basis", ["direction", "texel"])
def test_reported_variance_is_that_of_the_mean(coloured_scene, basis):
    """Variance of the mean over 32 seeds against the mean of the reported variances, all elements together.

    Half of about 7500 elements are lit, each with 31 degrees of freedom: their sum is known to about 1%. A variance
    divided by n instead of n - 1, at 4 samples per element, is off by 25%.
    """
    path = solver(coloured_scene, basis=basis, spp=4, max_depth=5)
    n = coloured_scene.n_vertices
    ids = np.repeat(np.arange(n), 24), np.tile(np.arange(24), n)
    runs = [path.elements(*ids, seed=k) for k in range(32)]
    means, variances = (
        np.array([getattr(r, name) for r in runs], np.float64) for name in ("mean", "variance")
    )
    ratio = means.var(axis=0, ddof=1).sum(axis=0) / variances.mean(axis=0).sum(axis=0)  # per channel
    assert (np.abs(ratio - 1) < 0.03).all()


def test_elements_are_independent_of_each_other(grey_scene):
    """Correlations over 256 seeds between elements that share a vertex or a texel.

    Expected: products of standardised deviations average to zero within 4 standard errors, over some 1000 pairs of
    either kind; random numbers shared along a row or a column would show as correlations of 0.1 to 1.
    """
    path = solver(grey_scene, spp=4, channels=1)
    ids = np.arange(0, grey_scene.n_vertices, 3)
    flat = np.repeat(ids, 24), np.tile(np.arange(24), len(ids))
    runs = np.array([path.elements(*flat, seed=k).mean[:, 0] for k in range(256)], np.float64)
    spread = runs.std(axis=0)
    z = np.where(spread > 0, (runs - runs.mean(axis=0)) / np.where(spread > 0, spread, 1), 0)
    z = z.reshape(256, len(ids), 24)
    for a, b in ((z[:, :, :-1], z[:, :, 1:]), (z[:, :-1], z[:, 1:])):  # along rows, along columns
        correlation = (a * b).mean(axis=0).ravel()
        correlation = correlation[correlation != 0]
        assert len(correlation) > 500
        # known to about 1/16 each; vertices far apart have the same texel's light and nothing else in common
        assert abs(correlation.mean()) < 4 * correlation.std() / np.sqrt(len(correlation))
        assert correlation.std() < 0.08


def test_depth_two_has_no_indirect_light_and_each_bounce_adds(grey_scene):
    ids = np.arange(grey_scene.n_vertices)
    sums, errors = [], []
    for depth in (2, 3, 4, 5, -1):
        estimate = solver(grey_scene, spp=64, max_depth=depth, channels=1).rows(ids)
        sums.append(estimate.mean.sum(dtype=np.float64))
        errors.append(np.sqrt(estimate.variance.sum(dtype=np.float64)))
    assert sums[0] == 0
    gains, error = np.diff(sums), np.hypot(errors[1:], errors[:-1])
    assert (gains > 3 * error)[:2].all()
    # a bounce brings less than the one before, by the albedos of 0.5 to 0.7 and by what escapes
    assert (gains[1:3] < 0.7 * gains[:2] + 3 * error[1:3]).all()
    assert gains[3] > -3 * error[3]


def test_one_channel_stands_for_three_in_a_grey_scene(grey_scene):
    ids = np.arange(0, grey_scene.n_vertices, 10)
    one, three = (solver(grey_scene, channels=c).rows(ids).mean for c in (1, 3))
    assert one.shape[-1] == 1
    assert np.array_equal(np.repeat(one, 3, axis=-1), three)


def test_coloured_surfaces_colour_the_light(coloured_scene):
    """Light that reaches the ground by way of the blue ball and the green box has little red."""
    ground = np.arange(coloured_scene.meshes[0].vertices.stop)
    red, green, blue = solver(coloured_scene, spp=64).rows(ground).mean.sum(axis=(0, 1))
    assert red < 0.6 * blue
    assert red < 0.6 * green


def test_whether_surfaces_see_each_other(grey_scene):
    assert solver(grey_scene).any_hit(32)
    alone = build(0.5, ball={"type": "sphere", "bsdf": diffuse(1, 1, 1)})
    assert not solver(alone).any_hit(32)


@pytest.fixture(scope="module")
def mirrored() -> Scene:
    """A floor before a mirror that faces it."""
    turn = T().translate([0, 1, -1.02])
    return build(
        1.0,
        floor={"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90), "bsdf": diffuse(0.5, 0.5, 0.5)},
        mirror={"type": "rectangle", "to_world": turn, "bsdf": {"type": "conductor", "material": "none"}},
    )


def test_light_found_in_a_mirror(mirrored, monkeypatch):
    """A floor vertex sees a texel a second time, in the mirror: one bounce, a closed form.

    The mirrored light's irradiance over pi is the integral of the cosine over the directions of the texel's mirror
    image that pass through the mirror. Mirrored at the plane z = const: (x, y, z) -> (x, y, -z). Quadrature with
    256 x 256 points per texel (its edges cut texels: 0.2%). Expected: all elements of 5 vertices at n = 2 within
    4.5 standard errors and their sum within 3, where one is under 0.5%. Without the mirror's paths the sum is zero.
    """
    path = solver(mirrored, basis="texel", spp=1 << 16, max_depth=3, channels=1)
    floor = np.arange(mirrored.meshes[0].vertices.stop)
    interior = floor[(np.abs(mirrored.positions[floor][:, [0, 2]]) < 0.9).all(axis=1)]
    estimate = path.rows(interior)
    directions, weights = path.lighting.subdirections(256)
    towards = directions * [1, 1, -1]  # what the eye follows to end in the texel
    exact = np.zeros((len(interior), 24))
    for i, vertex in enumerate(interior):
        x = mirrored.positions[vertex].astype(np.float64)
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (-1.02 - x[2]) / towards[..., 2]
            hit = x + distance[..., None] * towards
            through = (distance > 0) & (np.abs(hit[..., 0]) < 1) & (np.abs(hit[..., 1] - 1) < 1)
        exact[i] = (through * np.maximum(towards[..., 1], 0) * weights).sum(axis=1) / np.pi
    solid = path.lighting.solid_angles
    ours, error = estimate.mean[..., 0] * solid, np.sqrt(estimate.variance[..., 0]) * solid
    lit = exact > 0.01
    assert lit.sum() > 10
    assert (np.abs(ours - exact)[lit] < 4.5 * error[lit] + 1e-3 * exact[lit]).all()
    together = np.sqrt((error**2).sum())
    assert together < 0.005 * exact.sum()
    assert abs(ours.sum() - exact.sum()) < 3 * together + 0.002 * exact.sum()

    monkeypatch.setattr(path_module, "has_mirrors", lambda scene: False)
    assert path.rows(interior).mean.max() == 0
    # light from one direction alone cannot be found by chance
    assert solver(mirrored, spp=64, max_depth=5, channels=1).rows(interior).mean.max() == 0


def test_a_path_through_glass_keeps_its_depth():
    """A vertex under a pane: the sky is two interfaces away, so it is lit from max_depth 4 on and not at 3."""
    pane = {"type": "cube", "to_world": T().translate([0, 0.5, 0]).scale([4, 0.05, 4])}
    scene = build(
        float("inf"),
        floor={"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90), "bsdf": diffuse(0.5, 0.5, 0.5)},
        pane={**pane, "bsdf": {"type": "dielectric"}},
    )
    top = prt.CubemapLighting(2).texel_of([[0.1, 1, 0.1]])
    lit = {
        depth: solver(scene, basis="texel", spp=4096, max_depth=depth, channels=1)
        .elements(np.zeros(1, int), top)
        .mean.item()
        for depth in (3, 4, 6)
    }
    assert lit[3] == 0
    assert lit[4] > 0
    assert lit[6] > lit[4]  # inner reflections


def test_variance_of_a_single_sample_is_finite(grey_scene):
    estimate = solver(grey_scene, spp=1).rows(np.arange(10))
    assert np.isfinite(estimate.variance).all()


def test_z_scores_of_two_runs_are_normal(grey_scene):
    """Two solvers with other seeds and sample counts: their rows differ by what their variances say (KS test)."""
    ids = np.arange(grey_scene.n_vertices)
    a = solver(grey_scene, spp=256, seed=1, channels=1).rows(ids)
    b = solver(grey_scene, spp=64, seed=2, channels=1).rows(ids)
    spread = np.sqrt((a.variance + b.variance).sum(axis=(1, 2), dtype=np.float64))
    difference = (a.mean - b.mean).sum(axis=(1, 2), dtype=np.float64)
    lit = spread > 0
    assert lit.mean() > 0.9
    assert stats.kstest(difference[lit] / spread[lit], "norm").pvalue > 0.01
    biased = difference + 0.1 * a.mean.sum(axis=(1, 2))
    assert stats.kstest(biased[lit] / spread[lit], "norm").pvalue < 1e-3


def test_delta_flags_are_read_from_wrapped_bsdfs():
    """A mirror inside a twosided or a mask BSDF is still a mirror."""
    for bsdf, mirror in (
        (diffuse(1, 1, 1), False),
        ({"type": "roughconductor"}, False),
        ({"type": "conductor"}, True),
        ({"type": "twosided", "bsdf": {"type": "conductor"}}, True),
        ({"type": "mask", "opacity": 0.5, "bsdf": diffuse(1, 1, 1)}, True),
    ):
        scene = mi.load_dict({"type": "scene", "shape": {"type": "rectangle", "bsdf": bsdf}})
        assert path_module.has_mirrors(scene) == mirror


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("depth", [*(pytest.param(depth, marks=pytest.mark.slow) for depth in (3, 5)), 4, -1])
def test_shadow_rays_tell_what_passes_straight(depth, monkeypatch):
    """
    Scenario: a floor and a wall that see the sky past a thin pane, a half-open sheet, a ``null`` box and, but for depth
        4, a mirror.
    Expected: as much light of each sixth of the sky at each depth as by paths that leave through these by chance, as
        Mitsuba's ``path`` finds it, within four standard errors; in all these are below 0.4%, so that 2% would show;
        without the mirror, elements with a fifth of the variance at most.
    """
    half = {"type": "mask", "opacity": 0.5, "bsdf": {"type": "twosided", "bsdf": diffuse(0.3, 0.3, 0.3)}}
    upright = T().rotate([1, 0, 0], -90)
    scene = build(
        0.4,
        floor={"type": "rectangle", "to_world": upright, "bsdf": diffuse(0.6, 0.6, 0.6)},
        wall={"type": "rectangle", "to_world": T().translate([0, 1, -1]), "bsdf": diffuse(0.6, 0.6, 0.6)},
        pane={
            "type": "rectangle",
            "to_world": T().translate([0, 1, 1]),
            "bsdf": {"type": "thindielectric", "int_ior": 2.0},
        },
        sheet={"type": "rectangle", "to_world": T().translate([0, 2, 0]).rotate([1, 0, 0], 90), "bsdf": half},
        box={"type": "cube", "to_world": T().translate([0.3, 0.4, 0.2]).scale(0.2), "bsdf": {"type": "null"}},
        mirror={
            "type": "rectangle",
            "to_world": T().translate([-1, 1, 0]).rotate([0, 1, 0], 90),
            "bsdf": {"type": "conductor"} if depth != 4 else diffuse(0.6, 0.6, 0.6),
        },
    )
    problem = problem_at(scene, prt.CubemapLighting(1), basis="texel", max_depth=depth)
    fine = problem_at(scene, prt.CubemapLighting(4), basis="texel", max_depth=depth)
    problem, fine = (replace(one, specular_apart=True) for one in (problem, fine))
    ids, power = np.arange(0, 2 * 36, 6), problem.emission.solid_angles[:, None]

    def found(first: int) -> tuple[np.ndarray, float]:
        """Light of each face by 20 seeds (20, 6), on all of these vertices; the mean variance of a small element."""
        rows = [PathSolver(problem, 4096, seed).rows(ids).mean for seed in range(first, first + 20)]
        light = [(row * power).sum(axis=(0, 2), dtype=np.float64) for row in rows]
        return np.array(light), float(PathSolver(fine, 512, first).rows(ids).variance.mean())

    ours, variance = found(0)
    monkeypatch.setattr(type(scene), "passes_straight", False)
    theirs, other = found(100)
    means, gain = [np.mean(x, axis=0) for x in (ours, theirs)], other / variance
    error = np.sqrt(sum(np.var(x, axis=0, ddof=1) / len(x) for x in (ours, theirs)))
    assert np.all(np.abs(means[0] - means[1]) <= 4 * error)
    totals = [np.sum(x, axis=1) for x in (ours, theirs)]
    whole = float(np.sqrt(sum(x.var(ddof=1) / len(x) for x in totals))) / means[1].sum()
    print(f"{means[0].sum() / means[1].sum() - 1:.2%} +- {whole:.2%} in all; {gain:.1f} times")
    assert whole < 0.004 and means[0].sum() == pytest.approx(means[1].sum(), rel=4 * whole)
    assert depth != 4 or gain > 5
