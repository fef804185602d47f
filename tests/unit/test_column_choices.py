"""Other choices of rows and columns: their parts against brute force, and all of them at one budget."""

import json

import numpy as np
import pytest
from conftest import GREY, build, problem_at, still_life
from interior_point import interior_point_fit

import mi_sparse_prt as prt
from mi_sparse_prt.benchmark.column_choice_errors import (
    FITTED,
    INTERPOLATED,
    _by_region,
    _by_vertex,
    _Local,
    _local,
    _surface,
    compare_choices,
    plot_choices,
)
from mi_sparse_prt.benchmark.column_sampling import (
    CHOICES as BY_REGION,
)
from mi_sparse_prt.benchmark.column_sampling import (
    clustered_columns,
    k_means_columns,
    random_columns,
    regions,
)
from mi_sparse_prt.benchmark.exact_rows import mesh_named, trace_visibility, unit_albedo_rows
from mi_sparse_prt.core.bits import pack, unpack
from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.core.run import Run
from mi_sparse_prt.methods.dense_sampling import DenseSampler
from mi_sparse_prt.methods.huang2010 import Huang2010Options
from mi_sparse_prt.sampling.angular import AngularGrid
from mi_sparse_prt.sampling.row_column import costs_of_cuts, draw_distinct, split_cluster
from mi_sparse_prt.solvers.direct_rays import DirectSolver

RESOLUTION, VERTICES = 8, 40
CHOICES = [random_columns, clustered_columns, k_means_columns]

LAMBDA = Huang2010Options().relative_lambda


@pytest.fixture(scope="module")
def lighting() -> prt.CubemapLighting:
    return prt.CubemapLighting(RESOLUTION)


@pytest.fixture(scope="module")
def scene() -> prt.Scene:
    return build(edge_length=0.2, **still_life())


@pytest.fixture(scope="module")
def report(scene: prt.Scene, lighting: prt.CubemapLighting) -> dict:
    return compare_choices(scene, lighting, "ground", VERTICES, progress=False)


# -- columns ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("choose", CHOICES)
@pytest.mark.parametrize("count", [1, 7, 30, 100])
def test_a_choice_has_so_many_columns_and_none_of_zeros(choose, count) -> None:
    rows = np.random.default_rng(0).random((9, 40), np.float32)
    rows[:, ::4] = 0
    chosen = choose(rows, count, np.random.default_rng(1))
    assert len(set(chosen)) == len(chosen) == min(count, 30)
    assert (np.diff(chosen) > 0).all() and rows[:, chosen].any(axis=0).all()
    assert np.array_equal(chosen, choose(rows, count, np.random.default_rng(1)))


@pytest.mark.parametrize("choose", CHOICES)
@pytest.mark.parametrize("rows", [np.zeros((3, 8)), np.zeros((0, 8)), np.zeros((3, 0))])
def test_in_the_dark_no_column_is_chosen(choose, rows) -> None:
    assert len(choose(rows.astype(np.float32), 4, np.random.default_rng(0))) == 0


@pytest.mark.parametrize("choose", CHOICES)
def test_equal_columns_still_fill_the_budget(choose) -> None:
    rows = np.ones((4, 20), np.float32)
    assert len(choose(rows, 6, np.random.default_rng(0))) == 6


@pytest.mark.parametrize("seed", range(5))
def test_clusters_are_columns_of_one_direction(seed: int) -> None:
    """Six directions, each with columns of ten lengths: one column of each is chosen."""
    rng = np.random.default_rng(seed)
    group = rng.permutation(np.repeat(np.arange(6), 10))
    rows = rng.random((20, 6))[:, group] * rng.uniform(0.1, 10, 60)
    chosen = clustered_columns(rows.astype(np.float32), 6, rng)
    assert sorted(group[chosen]) == list(range(6))


def test_a_representative_is_drawn_by_its_norm() -> None:
    lengths = np.array([1.0, 2.0, 5.0], np.float32)
    rows, rng, n = np.ones((4, 1), np.float32) * lengths, np.random.default_rng(0), 2000
    times = np.bincount([clustered_columns(rows, 1, rng)[0] for _ in range(n)], minlength=3)
    p = lengths / lengths.sum()
    assert (np.abs(times - n * p) < 4 * np.sqrt(n * p * (1 - p))).all()


def test_draws_are_those_of_a_loop() -> None:
    """Mean number of times each item comes until four are distinct, within five standard errors."""
    p, rng, n = np.array([0.5, 0.3, 0.1, 0.06, 0.04]), np.random.default_rng(0), 1000
    times = np.zeros((2, n, len(p)))
    for k in range(n):
        items, often = draw_distinct(p, 4, rng)
        times[0, k, items] = often
        while (times[1, k] > 0).sum() < 4:
            times[1, k, rng.choice(len(p), p=p)] += 1
    assert ((times > 0).sum(axis=2) == 4).all()
    error = np.sqrt(times.var(axis=1).sum(axis=0) / n)
    assert (np.abs(times[0].mean(axis=0) - times[1].mean(axis=0)) < 5 * error).all()


def test_costs_are_sums_over_pairs() -> None:
    x = np.random.default_rng(0).random((7, 4))
    norms = np.linalg.norm(x, axis=1)
    pairs = norms[:, None] * norms - x @ x.T
    first, last = costs_of_cuts(x, norms)
    assert first == pytest.approx([pairs[:k, :k].sum() for k in range(1, 7)], abs=1e-12)
    assert last == pytest.approx([pairs[k:, k:].sum() for k in range(1, 7)], abs=1e-12)


def test_a_cluster_is_cut_at_the_best_place() -> None:
    x = np.random.default_rng(0).random((12, 3))
    norms, members = np.linalg.norm(x, axis=1), np.arange(1, 12)
    pairs = norms[:, None] * norms - x @ x.T
    left, right = split_cluster(x, norms, members, np.random.default_rng(3))
    assert sorted([*left, *right]) == list(members)
    line = np.random.default_rng(3).normal(size=3)
    order = members[np.argsort((x[members] / norms[members, None]) @ line)]
    cost = [pairs[np.ix_(a, a)].sum() + pairs[np.ix_(b, b)].sum() for a, b in _cuts(order)]
    assert pairs[np.ix_(left, left)].sum() + pairs[np.ix_(right, right)].sum() == pytest.approx(min(cost))


def test_k_means_takes_the_column_nearest_to_each_mean() -> None:
    rng = np.random.default_rng(0)
    blob = rng.permutation(np.repeat(np.arange(5), 12))
    columns = rng.normal(size=(5, 8))[blob] * 100 + rng.normal(size=(60, 8))
    chosen = k_means_columns(columns.T.astype(np.float32), 5, rng)
    expected = []
    for k in range(5):
        inside = np.flatnonzero(blob == k)
        away = np.linalg.norm(columns[inside] - columns[inside].mean(axis=0), axis=1)
        expected.append(inside[np.argmin(away)])
    assert sorted(chosen) == sorted(expected)


def _cuts(order: np.ndarray) -> list:
    return [(order[:k], order[k:]) for k in range(1, len(order))]


# -- exact direct light ----------------------------------------------------------------------------------------------


def test_exact_rows_are_those_of_brute_force(scene: prt.Scene, lighting: prt.CubemapLighting) -> None:
    ids = np.arange(0, len(scene.positions), 7)
    direct = DirectSolver(problem_at(scene, lighting))
    unit_albedo = unit_albedo_rows(trace_visibility(direct, ids), scene.normals[ids], lighting)
    matrix = prt.precompute(scene, lighting, method="brute_force", max_depth=2, progress=False)
    expected = matrix.rows(ids)[..., 0] / scene.albedo[ids, :1]
    assert GREY[0][0] == pytest.approx(scene.albedo[0, 0])
    np.testing.assert_allclose(unit_albedo, expected, rtol=1e-5, atol=1e-9)


def test_features_of_exact_rows_are_those_that_rays_find(
    scene: prt.Scene, lighting: prt.CubemapLighting
) -> None:
    inside = mesh_named(scene, "ball").vertices
    ids = np.arange(0, inside.stop - inside.start, 3)
    direct = DirectSolver(problem_at(scene, lighting))
    sampler = DenseSampler(direct, AngularGrid(lighting), Run())
    sampler.add(ids + inside.start)
    dense = sampler.dense()
    assert np.array_equal(np.sort(dense.ids), ids + inside.start)
    found = _surface(scene, lighting, "ball").features(dense.ids - inside.start)
    assert found.any() and np.array_equal(found, dense.rows.features)


# -- choices ---------------------------------------------------------------------------------------------------------


def test_every_choice_has_the_same_budget(report: dict) -> None:
    assert set(report["error"]) == set(FITTED) | set(INTERPOLATED)
    assert set(report["directions"]) == set(report["seconds"]) == set(FITTED)
    assert report["columns"] == round(0.06 * 6 * RESOLUTION**2)
    assert report["row_share"] == pytest.approx(0.25, abs=0.01)
    used = report["directions"]
    assert all(0 < used[name] <= report["column_share"] for name in FITTED)
    assert all(used[name] == pytest.approx(report["column_share"]) for name in BY_REGION)


def test_errors_are_finite_and_samples_help(report: dict) -> None:
    errors = report["error"]
    assert all(0 < errors[name] < 1 for name in errors)
    assert errors["linear"] < errors["nearest"]


def test_the_report_is_json_and_a_seed_gives_it_again(
    scene: prt.Scene, lighting: prt.CubemapLighting, report: dict
) -> None:
    assert json.loads(json.dumps(report)) == report
    again = compare_choices(scene, lighting, "ground", VERTICES, progress=False)
    assert {**again, "seconds": 0} == {**report, "seconds": 0}
    other = compare_choices(scene, lighting, "ground", VERTICES, seed=5, progress=False)
    assert all(other["error"][name] != report["error"][name] for name in report["error"])


def test_errors_are_those_of_vertices_one_at_a_time(scene: prt.Scene, lighting: prt.CubemapLighting) -> None:
    """Neighbours, feature directions and the fit of each vertex by the definition; the solver is the reference one."""
    surface = _surface(scene, lighting, "ball")
    dense, sample = np.arange(0, len(surface.keys), 4), np.arange(1, len(surface.keys), 9)
    local = _local(surface, sample, dense)
    rows, features = surface.rows(dense).astype(float), unpack(surface.features(dense), 6 * RESOLUTION**2)
    squared = 0.0
    for vertex, exact in zip(local.sparse, surface.rows(local.sparse).astype(float), strict=True):
        away = np.linalg.norm(surface.positions[dense] - surface.positions[vertex], axis=1)
        order = np.argsort(away)
        near = order[: max(10, min(40, int((away <= 0.05).sum())))]
        weight = rows[near].var(axis=0) * features[near].sum(axis=0)
        best = [j for j in np.argsort(-weight, kind="stable")[:23] if weight[j] > 0]
        A, y = rows[near][:, best].T, exact[best]
        products = (A.T @ A)[None], (A.T @ y)[None], (y @ y)[None]
        a = interior_point_fit(*products, LAMBDA).weights[0]
        squared += ((a @ rows[near] - exact) ** 2).sum()
    assert np.sqrt(_by_vertex(local, 23, 1).squared.sum()) == pytest.approx(np.sqrt(squared), rel=1e-3)


@pytest.mark.parametrize("name", ["features", *BY_REGION])
def test_rows_of_rank_one_are_known_but_for_the_shrinkage(name: str) -> None:
    """All rows are multiples of one: any direction says which, and the penalty takes its hundredth of the weight."""
    rng, m = np.random.default_rng(0), 64
    row = rng.uniform(0.5, 1, m) * (np.arange(m) % 3 > 0)
    rows, exact = (np.outer(rng.uniform(0.5, 2, n), row).astype(np.float32) for n in (6, 9))
    features = pack(np.ones((6, m), bool))
    near = np.array([rng.permutation(6)[:4] for _ in range(9)], np.int32)
    local = _Local(exact, np.arange(9), np.arange(6), rows, features, near)
    region = np.array([0, 0, 1, 1, 1, 0])
    result = (
        _by_vertex(local, 5, 9)
        if name == "features"
        else _by_region(local, region, BY_REGION[name], 5, seed=0)
    )
    assert result.directions == 5
    assert np.sqrt(result.squared) == pytest.approx(LAMBDA * np.linalg.norm(exact, axis=1), rel=1e-3)


def test_where_nothing_is_sampled_neighbours_have_their_mean() -> None:
    rows = np.full((4, 32), 2, np.float32)  # no variance, no features
    local = _Local(
        rows[:1] + 1, np.arange(1), np.arange(4), rows, pack(rows < 0), np.array([[0, 2, -1]], np.int32)
    )
    result = _by_vertex(local, 3, 1)
    assert result.directions == 0 and result.squared == pytest.approx([32])


def test_regions_are_numbered_without_gaps_and_compact() -> None:
    rng = np.random.default_rng(0)
    p = np.concatenate([rng.random((60, 3)) + 50 * k for k in range(3)]).astype(np.float32)
    labels = regions(p, 8000, seed=0)
    assert sorted(set(labels)) == list(range(labels.max() + 1)) and labels.max() < 8
    assert len(regions(p[:1], 10**6, seed=0)) == 1
    assert np.array_equal(labels, regions(p, 8000, seed=0))


def test_the_plot_has_a_bar_for_each_choice(report: dict, artefact) -> None:
    figure = plot_choices(report)
    axes = figure.axes[0]
    assert [round(bar.get_width(), 9) for bar in axes.patches] == [
        round(100 * report["error"][name], 9) for name in (*FITTED, *INTERPOLATED)
    ]
    artefact(figure)


@pytest.mark.parametrize(
    ("mesh", "n_vertices", "message"),
    [("moon", 5, "no mesh 'moon'"), ("ground", 0, "n_vertices is 0")],
)
def test_senseless_arguments_are_refused(
    scene: prt.Scene, lighting: prt.CubemapLighting, mesh: str, n_vertices: int, message: str
) -> None:
    with pytest.raises(PrtError, match=message):
        compare_choices(scene, lighting, mesh, n_vertices, progress=False)


def test_a_sample_that_is_dense_is_refused(scene: prt.Scene, lighting: prt.CubemapLighting) -> None:
    surface = _surface(scene, lighting, "box")
    with pytest.raises(PrtError, match="sample are dense"):
        _local(surface, np.array([3]), np.array([1, 3]))
