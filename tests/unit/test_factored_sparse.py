"""Sparse matrices that are kept as a product, against the same ones as dense numbers."""

from __future__ import annotations

import numba
import numpy as np
import pytest
import scipy.sparse

from mi_sparse_prt.core import factored_sparse
from mi_sparse_prt.core.factored_sparse import FactoredSparse
from mi_sparse_prt.core.sparse_product import add_scaled, multiply_scaled, multiply_sparse

N, M, GROUPS, TERMS = 90, 70, 13, 5


def random_sparse(shape: tuple[int, int], density: float, rng: np.random.Generator) -> scipy.sparse.csr_array:
    return scipy.sparse.random_array(shape, density=density, rng=rng, dtype=np.float32).tocsr()


def factored(seed: int = 0, groups: int = GROUPS) -> tuple[FactoredSparse, np.ndarray]:
    """Groups of 0 to 11 rays, some without a row; rays that find nothing, one thing, or several, twice the same too."""
    rng = np.random.default_rng(seed)
    inner = np.concatenate([[0], np.cumsum(rng.integers(0, 12, groups))])
    rows = rng.permutation(N)[: groups * TERMS].reshape(groups, TERMS)
    rows[rng.random(rows.shape) < 0.2] = -1
    weights = rng.normal(size=(inner[-1], TERMS)).astype(np.float32)
    lengths = rng.integers(0, 10, inner[-1])
    columns = rng.integers(0, M, lengths.sum()).astype(np.int32)
    values = rng.normal(size=lengths.sum()).astype(np.float32)
    starts = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int32)
    right = scipy.sparse.csr_array((values, columns, starts), shape=(inner[-1], M))
    rest = random_sparse((N, M), 0.1, rng)
    dense = rest.toarray().astype(np.float64)
    for g in range(groups):
        found = right.toarray()[inner[g] : inner[g + 1]].astype(np.float64)
        for k in np.flatnonzero(rows[g] >= 0):
            dense[rows[g, k]] += weights[inner[g] : inner[g + 1], k] @ found
    return FactoredSparse(rows, inner, weights, right, rest), dense


@pytest.mark.parametrize("width", [1, 3, 16, 45])
def test_products(width, monkeypatch):
    """Of several albedos and one light, in slabs of columns too; into some rows of a result, and added to these."""
    monkeypatch.setattr(factored_sparse, "SLAB", 16)
    matrix, dense = factored()
    rng = np.random.default_rng(1)
    albedo, light = rng.random((3, M), np.float32), rng.normal(size=(M, width)).astype(np.float32)
    known = np.stack([dense @ (rho[:, None] * light) for rho in albedo])
    bound = 1e-6 * np.abs(known).max()
    assert np.abs(multiply_scaled(matrix, albedo, light) - known).max() < bound
    sums = np.ones((3, N + 10, width + 5), np.float32)
    add_scaled(matrix, albedo, light, sums, 7)
    assert np.abs(sums[:, 7 : N + 7, :width] - 1 - known).max() < bound
    assert (sums[:, :7] == 1).all() and (sums[:, N + 7 :] == 1).all() and (sums[..., width:] == 1).all()


def test_rows_and_sums():
    matrix, dense = factored()
    ids, more = np.array([3, 17, 18, 88]), random_sparse((N, M), 0.1, np.random.default_rng(2))
    assert matrix.shape == dense.shape
    assert np.allclose(matrix[ids].toarray(), dense[ids], atol=1e-5)
    assert np.allclose(matrix.tocsr().toarray(), dense, atol=1e-5)
    assert np.allclose((matrix + more).tocsr().toarray(), dense + more.toarray(), atol=1e-5)
    assert matrix[ids[:0]].shape == (0, M)


def test_the_same_for_any_number_of_threads():
    matrix, _ = factored()
    light, threads = np.random.default_rng(3).normal(size=(M, 20)).astype(np.float32), numba.get_num_threads()
    found = multiply_sparse(matrix, light)
    try:
        numba.set_num_threads(1)
        assert np.array_equal(multiply_sparse(matrix, light), found)
    finally:
        numba.set_num_threads(threads)


def test_without_groups():
    """A scene whose glossy vertices are none of those that are asked for."""
    matrix, dense = factored(groups=0)
    light = np.random.default_rng(4).normal(size=(M, 9)).astype(np.float32)
    assert np.allclose(multiply_sparse(matrix, light), dense @ light, atol=1e-5)
    assert np.allclose(matrix.tocsr().toarray(), dense)


def test_far_fewer_numbers_than_multiplied_out():
    """16 terms that meet 16 terms: rays have 17 + 17 numbers each, not 17 x 17."""
    rays, terms, n = 64, 17, 2000
    rng = np.random.default_rng(5)
    columns = rng.permutation(n)[: rays * terms].astype(np.int32)
    starts = np.arange(0, rays * terms + 1, terms, dtype=np.int32)
    right = scipy.sparse.csr_array((np.ones(rays * terms, np.float32), columns, starts), shape=(rays, n))
    none = scipy.sparse.csr_array((n, n), dtype=np.float32)
    matrix = FactoredSparse(
        np.arange(terms)[None], np.array([0, rays]), np.ones((rays, terms), np.float32), right, none
    )
    assert matrix.nnz == 2 * rays * terms
    assert matrix.tocsr().nnz == rays * terms**2
