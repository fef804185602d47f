"""Clusters of columns: each step of the algorithm against brute force on small matrices."""

import itertools

import numpy as np
import pytest

from mi_sparse_prt.sampling import row_column
from mi_sparse_prt.sampling.row_column import (
    cluster_by_sampling,
    cluster_columns,
    cluster_costs,
    costs_beside_all,
    nearest_centre,
    random_projection,
    split_clusters,
    with_lengths,
)


def columns(n: int = 40, r: int = 6, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    x = np.random.default_rng(seed).random((n, r)) ** 3
    return x, np.linalg.norm(x, axis=1)


def distance(x: np.ndarray, y: np.ndarray) -> float:
    """[HPB07] 3.4, literally: half |x| |y| |x / |x| - y / |y||^2."""
    a, b = np.linalg.norm(x), np.linalg.norm(y)
    return 0.5 * a * b * float(np.sum((x / a - y / b) ** 2))


def total_cost(x: np.ndarray, norms: np.ndarray, clusters: list) -> float:
    return float(cluster_costs(x, norms, clusters).sum())


def test_the_cost_of_a_clustering_is_the_expected_squared_error() -> None:
    """[HPB07] Appendix A, by enumeration of all choices of representatives."""
    x, norms = columns(7)
    clusters = [np.array([0, 3, 5]), np.array([1]), np.array([2, 4, 6])]
    expected = 0.0
    for chosen in itertools.product(*clusters):
        p = np.prod([norms[j] / norms[own].sum() for j, own in zip(chosen, clusters, strict=True)])
        estimate = sum(norms[own].sum() / norms[j] * x[j] for j, own in zip(chosen, clusters, strict=True))
        expected += p * np.sum((estimate - x.sum(axis=0)) ** 2)
    assert total_cost(x, norms, clusters) == pytest.approx(expected, rel=1e-12)


def test_the_distance_is_symmetric_not_negative_and_zero_for_parallel_columns() -> None:
    x, norms = columns(12)
    for i, j in itertools.combinations(range(12), 2):
        pair = cluster_costs(x, norms, [np.array([i, j]), np.array([j, i])])
        assert (
            pair[0] == pytest.approx(2 * distance(x[i], x[j]), rel=1e-9)
            and pair[0] == pytest.approx(pair[1], abs=1e-15)
            and pair.min() >= 0
        )
    parallel = np.outer([1.0, 2.0, 0.1], x[0])
    assert cluster_costs(parallel, np.linalg.norm(parallel, axis=1), [np.arange(3)]) == pytest.approx(
        0, abs=1e-12
    )


def test_alpha_is_the_sum_of_distances() -> None:
    x, norms = columns()
    expected = [sum(distance(a, b) for b in x) for a in x]
    assert costs_beside_all(x, norms) == pytest.approx(expected, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_blocks_and_single_precision_find_the_nearest_centres(dtype, monkeypatch) -> None:
    x, norms = columns(60)
    centres, weights = np.array([3, 17, 40, 59]), np.array([1.0, 5.0, 0.5, 2.0])
    expected = [np.argmin([w * distance(a, x[c]) for c, w in zip(centres, weights, strict=True)]) for a in x]
    for size in (1 << 22, 4, 28):
        monkeypatch.setattr(row_column, "DISTANCES", size)
        assert nearest_centre(x.astype(dtype), norms, centres, weights).tolist() == expected


def test_projected_columns_keep_their_lengths_and_nearly_their_angles() -> None:
    """Mean error of cosines of 50 dimensions is about 1 / sqrt(50); none is lost where rows are few."""
    x = np.random.default_rng(0).random((200, 300)).astype(np.float32) ** 8
    norms = np.linalg.norm(x, axis=1).astype(np.float64)
    projected = with_lengths(x @ random_projection(300, 50, np.random.default_rng(1)), norms)
    assert np.linalg.norm(projected, axis=1) == pytest.approx(norms, rel=1e-5)
    exact, found = ((a / norms[:, None]) @ (a / norms[:, None]).T for a in (x, projected))
    assert np.sqrt(np.mean((exact - found) ** 2)) < 1.2 / np.sqrt(50)
    assert np.array_equal(random_projection(7, 50, np.random.default_rng(0)), np.eye(7))


@pytest.mark.parametrize("seed", range(3))
def test_clusters_are_a_partition(seed: int) -> None:
    x, norms = columns(50, 8, seed)
    for count in (1, 2, 7, 49, 50, 80):
        clusters = cluster_columns(x, norms, count, np.random.default_rng(seed))
        assert len(clusters) == min(count, 50) and all(len(own) for own in clusters)
        assert sorted(np.concatenate(clusters)) == list(range(50))


@pytest.mark.parametrize("values", [np.ones((9, 4)), np.eye(9), np.ones((9, 1)), np.ones((1, 3))])
def test_equal_columns_duplicates_and_single_rows_make_clusters(values: np.ndarray) -> None:
    norms = np.linalg.norm(values, axis=1)
    for x in (values, values.astype(np.float32)):
        clusters = cluster_columns(x, norms, 5, np.random.default_rng(0))
        assert len(clusters) == min(5, len(values))
        assert sorted(np.concatenate(clusters)) == list(range(len(values)))
    assert cluster_columns(np.zeros((0, 4)), np.zeros(0), 5, np.random.default_rng(0)) == []


def test_both_algorithms_together_are_better_than_either() -> None:
    """[HPB07] 3.5: sampling two thirds of the clusters and splitting for the rest beats both alone.

    Rationale: what lights have in common are a few smooth features, some of them rare and bright, of which each light
    has its own mixture; centres alone miss what is rare, and splitting alone is misled by its first cuts.
    Expected: the mean cost over 20 seeds is at most 0.8 times that of the better of the two.
    """
    rng = np.random.default_rng(0)
    feature = rng.random((8, 30)) ** 6
    mixture = rng.dirichlet(np.full(8, 0.3), 1500) * rng.lognormal(0, 1.5, (1500, 1))
    x = (mixture @ feature).astype(np.float32)
    norms, count = np.linalg.norm(x, axis=1).astype(np.float64), 60
    costs = np.zeros((3, 20))
    for seed in range(20):
        every = [np.arange(len(x))]
        found = (
            cluster_columns(x, norms, count, np.random.default_rng(seed)),
            cluster_by_sampling(x, norms, count, np.random.default_rng(seed)),
            split_clusters(x, norms, every, count, np.random.default_rng(seed)),
        )
        costs[:, seed] = [total_cost(x, norms, clusters) for clusters in found]
    both, sampling, splitting = costs.mean(axis=1)
    assert both < 0.8 * min(sampling, splitting), (both, sampling, splitting)
