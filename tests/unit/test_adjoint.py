"""Rows of indirect light from shared paths: the estimator's bookkeeping, statistics and reach."""

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from conftest import T, build, bumpy_ball, diffuse, mesh, problem_at, still_life
from scipy import stats

import mi_sparse_prt as prt
from mi_sparse_prt.benchmark.kernels import launched_kernels
from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.solvers import adjoint_paths as adjoint_module
from mi_sparse_prt.solvers.adjoint_paths import AdjointSolver
from mi_sparse_prt.solvers.paths import PathSolver
from mi_sparse_prt.solvers.problem import Problem

pytestmark = pytest.mark.filterwarnings("ignore:.*is not diffuse")


def made(kind: type, problem: Problem, max_depth: int = 5, channels: int | None = None, **parameters: int):
    """A solver, of fewer or more channels than the scene's colours ask for."""
    found = kind(replace(problem, max_depth=max_depth), **parameters)
    found.channels = channels or found.channels
    return found


def solver(scene: Scene, n: int = 2, basis: str = "direction", **parameters: int) -> AdjointSolver:
    return made(AdjointSolver, problem_at(scene, prt.CubemapLighting(n), basis=basis), **parameters)


def paths(scene: Scene, n: int = 2, basis: str = "direction", **parameters: int) -> PathSolver:
    return made(PathSolver, problem_at(scene, prt.CubemapLighting(n), basis=basis), **parameters)


@pytest.fixture(scope="module")
def mirrored() -> Scene:
    """A floor before a mirror that faces it, and a ball."""
    vertices, triangles = bumpy_ball()
    mirror = {"type": "rectangle", "to_world": T().translate([0, 1, -1.02])}
    return build(
        0.5,
        floor={"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90), "bsdf": diffuse(0.5, 0.5, 0.5)},
        mirror={**mirror, "bsdf": {"type": "conductor", "material": "none"}},
        ball=mesh("ball", 0.5 * vertices + [0.3, 0.5, 0.2], triangles, diffuse(0.2, 0.5, 0.8)),
    )


@pytest.mark.parametrize("basis", ["direction", "texel"])
def test_a_row_does_not_depend_on_the_rows_beside_it(mirrored, basis, monkeypatch):
    """Other orders, and blocks of 3 rows and of one pair of samples each: the same bits."""
    adjoint = solver(mirrored, 4, basis, spp=10)
    ids = np.arange(mirrored.n_vertices)
    every = adjoint.rows(ids)
    assert every.mean.shape == every.variance.shape == (len(ids), 96, 3)
    assert every.mean.dtype == every.variance.dtype == np.float32
    assert every.mean.max() > 0
    some = np.array([70, 3, 3, 20, 41])
    monkeypatch.setattr(adjoint_module, "CELLS", 2 * 3 * 96)
    assert adjoint.block_size == 3
    for name in ("mean", "variance"):
        assert np.array_equal(getattr(every, name)[some], getattr(adjoint.rows(some), name))


def test_same_seed_same_estimate_other_seed_another(grey_scene):
    ids = np.arange(grey_scene.n_vertices)
    first = solver(grey_scene, seed=3).rows(ids).mean
    assert np.array_equal(first, solver(grey_scene, seed=3).rows(ids).mean)
    other = solver(grey_scene, seed=4).rows(ids).mean
    assert (first != other).mean() > 0.3
    assert np.array_equal(solver(grey_scene, seed=3).rows(ids, seed=4).mean, other)


@pytest.mark.parametrize("n", [1, 2, 8, 32, 128])
def test_texels_are_dealt_out_evenly(grey_scene, n):
    """Each texel belongs to one path of a row, and every path has equally many; other points deal differently."""
    adjoint = solver(grey_scene, n, spp=2)
    samples = adjoint_module._Samples(adjoint, np.arange(5, dtype=np.uint32), range(1), 0)
    factor, shift = (x.numpy().astype(np.uint64)[:5, None] for x in (samples.factor, samples.shift))
    texels = (factor * np.arange(6 * n * n, dtype=np.uint64) + shift) % np.uint64(6 * n * n)
    assert np.array_equal(np.sort(texels, axis=1), np.tile(np.arange(6 * n * n), (5, 1)))
    assert 6 * n * n % adjoint.paths_per_sample == 0
    if n > 2:
        assert len(np.unique(texels, axis=0)) == 5


def test_every_element_of_a_large_cubemap_is_reached():
    """Two white plates that face each other, far apart: light from nearly all texels above, at n = 64.

    Expected: the lower plate's centre sees the upper one in 1.2% of its view or less; what lights the upper plate's
    lower side comes from below. So texels below the horizon light the row, those above cannot, and of those below
    that the lower plate does not hide, all are found at 4096 paths.
    """
    plate = {"type": "rectangle", "bsdf": diffuse(1, 1, 1)}
    scene = build(
        float("inf"),
        below={**plate, "to_world": T().rotate([1, 0, 0], -90).scale(0.01)},
        above={**plate, "to_world": T().translate([0, 1, 0]).rotate([1, 0, 0], 90)},
    )
    adjoint = solver(scene, 64, spp=1024, max_depth=3, channels=1)
    row = adjoint.rows(np.zeros(1, int)).mean[0, :, 0]
    below = adjoint.lighting.directions[:, 1] < -1e-3
    assert (row[~below & (adjoint.lighting.directions[:, 1] > 1e-3)] == 0).all()
    assert (row[below] > 0).mean() > 0.999


@pytest.mark.parametrize("basis", ["direction", "texel"])
def test_reported_variance_is_that_of_the_mean(coloured_scene, basis):
    """Variance over 16 seeds against the mean of the reported variances, all elements together.

    The standard error of their ratio is computed from the rows, which are independent: about 1.5%. Taking the samples
    as independent, their strata forgotten, would be wrong by a third.
    """
    adjoint = solver(coloured_scene, 2, basis, spp=16, max_depth=5)
    runs = [adjoint.rows(np.arange(coloured_scene.n_vertices), seed=k) for k in range(16)]
    observed = np.var([r.mean.astype(np.float64) for r in runs], axis=0, ddof=1).sum(axis=(1, 2))  # [row]
    reported = np.mean([r.variance.astype(np.float64) for r in runs], axis=0).sum(axis=(1, 2))
    ratio = observed.sum() / reported.sum()
    error = (observed - ratio * reported).std() * np.sqrt(len(observed)) / reported.sum()
    print(f"ratio {ratio:.4f} +- {error:.4f}")
    assert error < 0.03
    assert abs(ratio - 1) < 3.5 * error
    independent = paths(coloured_scene, 2, basis, spp=16, max_depth=5).rows(
        np.arange(coloured_scene.n_vertices)
    )
    assert reported.sum() < 0.85 * independent.variance.sum()


@pytest.mark.parametrize("spp", [1, 5, 14, 130])
def test_any_number_of_samples_is_unbiased(grey_scene, spp):
    """Strata that do not divide the number of paths (16 at n = 4), or are more: one bounce, against paths.

    Expected: the total of all rows, over as many seeds as make 128 samples or more, within 3.5 standard errors (from
    the seeds and from the paths) and these below 0.7%.
    """
    ids = np.arange(grey_scene.n_vertices)
    theirs = paths(grey_scene, 4, spp=64, max_depth=3, channels=1).rows(ids)
    adjoint = solver(grey_scene, 4, spp=spp, max_depth=3, channels=1)
    assert adjoint.spp in (spp, spp + 1)
    seeds = max(8, 128 // adjoint.spp)
    totals = [adjoint.rows(ids, seed=k).mean.sum(dtype=np.float64) for k in range(seeds)]
    error = np.hypot(np.std(totals, ddof=1) / np.sqrt(seeds), np.sqrt(theirs.variance.sum(dtype=np.float64)))
    expected = theirs.mean.sum(dtype=np.float64)
    print(f"z {(np.mean(totals) - expected) / error:+.2f}, standard error {error / expected:.2%}")
    assert error < 0.007 * expected
    assert abs(np.mean(totals) - expected) < 3.5 * error


@pytest.mark.parametrize("basis", ["direction", "texel"])
def test_z_scores_against_paths_are_normal(coloured_scene, basis):
    """Element by element: shares beyond 2 and 3, and their spread; a bias of 5% fails.

    Of elements whose errors are themselves known: about half of the paths or more find light.
    """
    ids = np.arange(coloured_scene.n_vertices)
    ours = solver(coloured_scene, 4, basis, spp=128, max_depth=4).rows(ids)
    theirs = paths(coloured_scene, 4, basis, spp=128, max_depth=4).rows(ids)
    a, b = (e.mean[..., 1].astype(np.float64) for e in (ours, theirs))  # channels share their paths
    error = np.sqrt((ours.variance + theirs.variance)[..., 1].astype(np.float64))
    known = np.sqrt(theirs.variance[..., 1]) < 0.1 * theirs.mean[..., 1]
    assert known.sum() > 500
    for factor in (1, 1.05, 0.95):
        z = (factor * a[known] - b[known]) / error[known]
        print(factor, f"mean {z.mean():+.3f} std {z.std():.3f} beyond 2: {(np.abs(z) > 2).mean():.2%}")
        fits = 0.94 < z.std() < 1.06 and 0.03 < (np.abs(z) > 2).mean() < 0.06 and abs(z.mean()) < 0.2
        assert fits == (factor == 1)


def test_rows_are_independent_of_each_other(grey_scene):
    """Correlations over 64 seeds of the sums of neighbouring rows average to zero within 4 standard errors."""
    adjoint = solver(grey_scene, spp=2, max_depth=3, channels=1)
    ids = np.arange(0, grey_scene.n_vertices, 2)
    sums = np.array([adjoint.rows(ids, seed=k).mean.sum(axis=(1, 2)) for k in range(64)], np.float64)
    lit = sums.std(axis=0) > 0
    z = stats.zscore(sums[:, lit], axis=0)
    correlation = (z[:, :-1] * z[:, 1:]).mean(axis=0)
    assert len(correlation) > 50
    assert abs(correlation.mean()) < 4 * correlation.std() / np.sqrt(len(correlation))
    assert correlation.std() < 0.16  # 1 / sqrt(64) = 0.125


def test_depth_two_has_no_indirect_light(grey_scene):
    estimate = solver(grey_scene, max_depth=2).rows(np.arange(50))
    assert not estimate.mean.any()
    assert not estimate.variance.any()


def test_one_channel_stands_for_three_in_a_grey_scene(grey_scene):
    ids = np.arange(0, grey_scene.n_vertices, 10)
    one, three = (solver(grey_scene, channels=c).rows(ids).mean for c in (1, 3))
    assert one.shape[-1] == 1
    assert np.array_equal(np.repeat(one, 3, axis=-1), three)


def test_light_found_in_a_mirror(mirrored):
    """Only paths that run into the light find it in a mirror: texel basis; one direction is never met by chance."""
    ids = np.arange(0, mirrored.meshes[0].vertices.stop)
    ours, theirs = (
        make(mirrored, 2, "texel", spp=spp, max_depth=4, channels=1).rows(ids)
        for make, spp in ((solver, 2048), (paths, 2048))
    )
    blind = solver(mirrored, 2, "direction", spp=64, max_depth=4, channels=1).rows(ids)
    total, expected = (e.mean.sum(dtype=np.float64) for e in (ours, theirs))
    assert blind.mean.sum() < 0.5 * expected
    # rows are independent; elements of ours are not, so the error comes from the rows' differences
    difference = (ours.mean - theirs.mean).astype(np.float64).sum(axis=(1, 2))
    error = np.sqrt((difference**2).sum())
    print(f"z {difference.sum() / error:+.2f}, standard error {error / expected:.2%}")
    assert error < 0.006 * expected
    assert abs(total - expected) < 3 * error


def test_values_that_are_not_finite_are_refused():
    scene = build(**still_life())
    ids = np.arange(scene.n_vertices)
    whole = solver(scene, channels=1).rows(ids).mean
    parameters = mi.traverse(scene.normalised.mitsuba)
    (name,) = (k for k in parameters.keys() if "ball" in k and k.endswith("reflectance.value"))
    parameters[name] = mi.Color3f(float("nan"))
    parameters.update()
    with pytest.raises(PrtError, match=r"vertex \d+ gets indirect light that is not finite from texel \d+"):
        solver(scene, channels=1).rows(ids)
    assert np.isfinite(whole).all()


def test_one_set_of_kernels_for_blocks_of_any_size(grey_scene, monkeypatch):
    """Numbers of rows, blocks, seeds, strata and depths compile nothing new after the first call."""
    monkeypatch.setattr(adjoint_module, "CELLS", 24 * 50)

    def largest() -> None:
        solver(grey_scene, spp=16, max_depth=5, channels=1).rows(np.arange(100))

    def others() -> None:
        for rows, spp, depth, seed in ((1, 2, 3, 0), (7, 16, 5, 9), (61, 6, 7, 1), (3, 4, -1, 0)):
            solver(grey_scene, spp=spp, max_depth=depth, channels=1, seed=seed).rows(np.arange(rows))

    first, later = launched_kernels(largest), launched_kernels(others)
    assert later.launches > 50
    assert later.hashes <= first.hashes
