"""Clustered PCA on plain arrays: against singular value decompositions, brute-force distances, and degenerate rows."""

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mi_sparse_prt.compression.cpca import (
    Clusters,
    affine_space,
    fit_spaces,
    lloyd_refine,
    nearest_clusters,
    random_mixtures,
    reassign,
    refined_space,
    seed_clusters,
    squared_distances,
    standard_cpca,
    two_pass_cpca,
)


def spaces(n: int, k: int, b: int, m: int, noise: float = 0.0, g: int = 1, seed: int = 0):
    """Rows (n, g, m) in k random affine spaces of b dimensions, and the space of each."""
    rng = np.random.default_rng(seed)
    labels = rng.integers(0, k, n)
    means = 10 * rng.standard_normal((k, m))
    bases = rng.standard_normal((k, b, m))
    rows = means[labels][:, None] + np.einsum("ngb,nbm->ngm", rng.standard_normal((n, g, b)), bases[labels])
    return (rows + noise * rng.standard_normal(rows.shape)).astype(np.float32), labels


def distances(rows, clusters: Clusters) -> np.ndarray:
    """Squared distances (n, k) to all spaces, one after another."""
    found = np.zeros((len(rows), len(clusters)))
    for c in range(len(clusters)):
        away = rows.astype(np.float64) - clusters.means[c]
        away -= away @ clusters.bases[c].T.astype(np.float64) @ clusters.bases[c]
        found[:, c] = np.square(away).sum(axis=(1, 2))
    return found


def total(rows, weights, clusters: Clusters) -> float:
    own = distances(rows, clusters)[np.arange(len(rows)), clusters.labels]
    return float(weights @ own)


def relative(rows, weights, clusters: Clusters) -> float:
    return np.sqrt(total(rows, weights, clusters) / (weights @ np.square(rows).sum(axis=(1, 2))))


def equal(n: int) -> np.ndarray:
    return np.ones(n, np.float32)


@pytest.mark.parametrize("g", [1, 3])
def test_rows_in_affine_spaces_are_found(g: int) -> None:
    rows, _ = spaces(600, 5, 3, 40, g=g)
    found = standard_cpca(rows, equal(600), 5, 3)
    assert relative(rows, equal(600), found) < 1e-3
    assert len(found) == 5


@pytest.mark.parametrize("shape", [(300, 40), (30, 200), (500, 300)])
def test_principal_components_are_singular_vectors(shape: tuple[int, int]) -> None:
    """What is left out is within half a per cent of the least that is possible."""
    rows = decaying(shape)
    vectors, random = np.zeros((0, shape[1]), np.float32), random_mixtures(500, 8)
    for _ in range(6):
        _, vectors = affine_space(rows, equal(len(rows)), 8, vectors, False, random)
    np.testing.assert_allclose(vectors @ vectors.T, np.eye(8), atol=1e-5)
    left = np.square(rows - rows @ vectors.T @ vectors).sum()
    assert left <= 1.005 * np.square(np.linalg.svd(rows, compute_uv=False)[8:]).sum()


def decaying(shape: tuple[int, int]) -> np.ndarray:
    """Random rows of singular values that fall slowly."""
    noise = np.random.default_rng(1).standard_normal(shape)
    return (noise @ np.diag(0.9 ** np.arange(shape[1]))).astype(np.float32)


@pytest.mark.parametrize("centred", [True, False])
@pytest.mark.parametrize("shape", [(300, 40), (10, 200), (500, 300)])
def test_two_steps_refine_what_a_part_of_the_columns_tells(shape: tuple[int, int], centred: bool) -> None:
    """From components of a third of the columns to those of all, with weights; coefficients belong to them."""
    rows, weights = decaying(shape) + 0.3, np.random.default_rng(2).random(shape[0]).astype(np.float32)
    roots = np.sqrt(weights / weights.sum())[:, None]
    away = rows - (roots.T**2 @ rows if centred else 0)
    known = np.linalg.svd(roots * away[:, ::3], full_matrices=False)[2][:8]
    products = (away[:, ::3] @ known.T).astype(np.float32)
    mean, vectors, along = refined_space(rows, weights, products, centred)
    np.testing.assert_allclose(mean, (rows - away)[0], atol=1e-5)
    np.testing.assert_allclose(vectors @ vectors.T, np.eye(8), atol=1e-5)
    np.testing.assert_allclose(along, away @ vectors.T, atol=1e-4)
    left = np.square(roots * (away - along @ vectors)).sum()
    least = np.square(np.linalg.svd(roots * away, compute_uv=False)[8:]).sum()
    assert left <= 1.02 * least + 1e-8
    without = np.square(np.linalg.norm(roots * away)) - np.square(roots * products).sum()
    assert without > 1.2 * least or shape[0] == 10  # there was something to refine


@pytest.mark.parametrize("rank", [0, 1, 3])
def test_rows_of_few_dimensions_have_no_more_components(rank: int) -> None:
    rng = np.random.default_rng(3)
    rows = (rng.standard_normal((60, rank)) @ rng.standard_normal((rank, 90))).astype(np.float32)
    products = rng.standard_normal((60, 6)).astype(np.float32)
    _, vectors, along = refined_space(rows, equal(60), products, False)
    assert len(vectors) == along.shape[1] == rank
    np.testing.assert_allclose(along @ vectors, rows, atol=1e-5)


def test_nearest_clusters_are_those_of_all_distances() -> None:
    rows, labels = spaces(400, 6, 4, 30, noise=0.5, g=2)
    found = fit_spaces(
        rows, equal(400), seed_clusters(rows, equal(400), 6, True, 0).with_labels(labels), 4, True
    )
    away = distances(rows, found)
    nearest = nearest_clusters(rows, found, 3)
    np.testing.assert_array_equal(nearest, np.argsort(away, axis=1)[:, :3])
    np.testing.assert_array_equal(reassign(rows, found, nearest), away.argmin(axis=1))
    np.testing.assert_allclose(
        squared_distances(rows, found, nearest), np.take_along_axis(away, nearest, 1), rtol=1e-3
    )


@pytest.mark.parametrize("centred", [True, False])
def test_more_iterations_never_make_it_worse(centred: bool) -> None:
    rows, _ = spaces(500, 6, 6, 50, noise=0.3)
    found = standard_cpca(rows, equal(500), 6, 4, centred)
    before = total(rows, equal(500), found)
    assert total(rows, equal(500), lloyd_refine(rows, equal(500), found, 4, centred)) <= before * (1 + 1e-4)


@pytest.mark.parametrize("centred", [True, False])
def test_the_factored_form_is_the_explicit_one(centred: bool) -> None:
    """From the same clusters, T = A D + S in coordinates and as a matrix: the same labels, errors within 1e-4."""
    rng = np.random.default_rng(3)
    dense, _ = spaces(80, 4, 5, 300, noise=0.2)
    a = rng.random((500, 80)) * (rng.random((500, 80)) < 0.05)
    s = rng.standard_normal((500, 300)) * (rng.random((500, 300)) < 0.02)
    explicit = (a @ dense[:, 0] + s).astype(np.float32)
    span = np.linalg.qr(np.concatenate([dense[:, 0], s]).T)[0].T  # orthonormal, of all rows there are
    factored = (a @ (dense[:, 0] @ span.T) + s @ span.T).astype(np.float32)
    weights = rng.random(500).astype(np.float32)
    start = standard_cpca(explicit[:, None], weights, 8, 6, centred)
    lifted = Clusters(
        start.labels, (start.means @ span.T).astype(np.float32), (start.bases @ span.T).astype(np.float32)
    )
    one = lloyd_refine(explicit[:, None], weights, start, 6, centred)
    other = lloyd_refine(factored[:, None], weights, lifted, 6, centred)
    assert (one.labels == other.labels).mean() > 0.995  # ties
    errors = [relative(r[:, None], weights, c) for r, c in ((explicit, one), (factored, other))]
    assert abs(errors[0] - errors[1]) < 1e-4
    assert errors[0] > 0.01


def test_two_passes_are_nearly_as_good() -> None:
    """[HR10] 6: clusters found by a fifth of the items; at most 5% more error than by all."""
    rng = np.random.default_rng(5)
    place = rng.random((4000, 2))
    centres = rng.random((60, 2))
    smooth = np.exp(-np.square(place[:, None] - centres).sum(axis=2) / 0.02).astype(np.float32)
    rows = (smooth @ rng.standard_normal((60, 120)).astype(np.float32))[:, None]
    weights = rng.random(4000).astype(np.float32) + 0.5
    all_items = standard_cpca(rows, weights, 16, 6)
    found = two_pass_cpca(rows, weights, np.sort(rng.permutation(4000)[:1000]), 16, 6)
    assert relative(rows, weights, found) < 1.05 * relative(rows, weights, all_items)


def test_weights_are_those_of_squared_errors() -> None:
    """Items of weight 0 do not move their cluster; of weight 2 they count as two."""
    rows, _ = spaces(60, 1, 5, 20, noise=0.5)
    weights = np.repeat([0, 1, 2], 20).astype(np.float32)
    doubled = np.concatenate([rows[20:], rows[40:]])
    one = standard_cpca(rows, weights, 1, 2)
    other = standard_cpca(doubled, equal(60), 1, 2)
    np.testing.assert_allclose(one.means, other.means, atol=1e-5)
    products = np.abs(np.linalg.det(one.bases[0] @ other.bases[0].T))
    assert products == pytest.approx(1, abs=1e-4)  # they span the same plane


def test_clusters_that_become_empty_are_given_the_farthest_items() -> None:
    rows, labels = spaces(300, 3, 0, 10, noise=0.1)
    start = seed_clusters(rows, equal(300), 6, True, 0)
    found = fit_spaces(rows, equal(300), start.with_labels(np.zeros(300, np.int64)), 0, True)
    assert len(found) == 6
    assert np.bincount(found.labels, minlength=6).min() >= 1


@settings(max_examples=25, deadline=None)
@given(
    n=st.integers(1, 40),
    distinct=st.integers(1, 4),
    rank=st.integers(0, 3),
    k=st.integers(1, 8),
    b=st.integers(0, 6),
    centred=st.booleans(),
)
def test_degenerate_rows(n: int, distinct: int, rank: int, k: int, b: int, centred: bool) -> None:
    """Few, equal, dark and rank-deficient rows: no NaN, no empty cluster, orthonormal or zero vectors."""
    rng = np.random.default_rng(n * 100 + distinct * 10 + rank)
    some = rng.standard_normal((distinct, rank)) @ rng.standard_normal((rank, 12))
    rows = some[rng.integers(0, distinct, n)].astype(np.float32)[:, None]
    for found in (
        standard_cpca(rows, equal(n), k, b, centred),
        two_pass_cpca(rows, equal(n), np.arange(0, n, 2), k, b, centred),
    ):
        assert np.isfinite(found.means).all() and np.isfinite(found.bases).all()
        assert np.bincount(found.labels, minlength=len(found)).min() >= 1
        gram = found.bases @ np.moveaxis(found.bases, 1, 2)
        off = gram - np.eye(b) * np.round(np.einsum("kbb->kb", gram))[:, None]
        assert np.abs(off).max(initial=0) < 1e-4
        if b >= rank or (centred and b + 1 >= min(distinct, n)):
            assert total(rows, equal(n), found) < 1e-6 * max(np.square(rows).sum(), 1e-30)


def test_a_row_that_is_no_number_stays_among_the_clusters() -> None:
    rows, _ = spaces(40, 2, 1, 6)
    found = standard_cpca(rows, equal(40), 2, 1)
    rows[3] = np.nan
    assert set(nearest_clusters(rows, found, 2)[3]) <= {0, 1}


def test_the_same_seed_gives_the_same_clusters() -> None:
    """Whatever the number of threads."""
    rows, _ = spaces(400, 5, 4, 30, noise=0.3)
    threads, found = numba.get_num_threads(), []
    for count in (threads, 1):
        numba.set_num_threads(count)
        found.append(two_pass_cpca(rows, equal(400), np.arange(0, 400, 4), 5, 4, seed=1))
    numba.set_num_threads(threads)
    np.testing.assert_array_equal(found[0].labels, found[1].labels)
    np.testing.assert_array_equal(found[0].bases, found[1].bases)
