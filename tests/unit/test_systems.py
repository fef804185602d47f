"""Linear systems of sparse vertices against NumPy."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from mi_sparse_prt.reconstruction.normal_equations import normal_equations


@given(st.integers(0, 4), st.integers(1, 5), st.integers(1, 6), st.integers(0, 9), st.integers(0, 10**6))
@settings(deadline=None)
def test_normal_equations_against_numpy(n, n_dense, k, s, seed):
    """With -1 anywhere: what is missing is left out, and its unknowns are 0."""
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(n_dense, 12)).astype(np.float32)
    neighbours = rng.integers(-1, n_dense, (n, k)).astype(np.int32)
    directions = rng.integers(-1, 12, (n, s)).astype(np.int32)
    values = rng.normal(size=(n, s)).astype(np.float32)  # also where there is no direction
    gram, correlation, squared_norm = normal_equations(rows, neighbours, directions, values)
    assert gram.dtype == correlation.dtype == squared_norm.dtype == np.float64
    assert (gram.shape, correlation.shape, squared_norm.shape) == ((n, k, k), (n, k), (n,))
    for i in range(n):
        there, asked = neighbours[i] >= 0, directions[i] >= 0
        a = rows[neighbours[i][there]][:, directions[i][asked]].astype(np.float64).T
        y = values[i][asked].astype(np.float64)
        expected = np.zeros((k, k))
        expected[np.ix_(there, there)] = a.T @ a
        right = np.zeros(k)
        right[there] = a.T @ y
        assert np.allclose(gram[i], expected, rtol=1e-6, atol=1e-6)
        assert np.allclose(correlation[i], right, rtol=1e-6, atol=1e-6)
        assert np.isclose(squared_norm[i], y @ y, rtol=1e-6)


def test_a_direction_asked_twice_counts_twice():
    rows = np.float32([[1, 2], [3, 4]])
    gram, correlation, squared_norm = normal_equations(
        rows, np.int32([[0, 1]]), np.int32([[1, 1]]), np.float32([[5, 6]])
    )
    assert gram[0].tolist() == [[8, 16], [16, 32]]
    assert correlation[0].tolist() == [22, 44]
    assert squared_norm[0] == 61


def test_sums_are_in_float64():
    """1e4 equations of which float32 sums would lose the small ones."""
    rows = np.full((1, 10001), 1e-2, np.float32)
    rows[0, 0] = 1e2
    everything = np.arange(10001, dtype=np.int32)[None]
    gram, correlation, squared_norm = normal_equations(rows, np.int32([[0]]), everything, rows)
    expected = (rows.astype(np.float64) ** 2).sum()
    for value in (gram[0, 0, 0], correlation[0, 0], squared_norm[0]):
        assert abs(value / expected - 1) < 1e-7


def test_the_solution_is_that_of_least_squares():
    """The normal equations say the same as the equations themselves."""
    rng = np.random.default_rng(0)
    rows = rng.random((10, 300)).astype(np.float32)
    directions = rng.choice(300, (3, 50)).astype(np.int32)
    weights = rng.normal(size=10)
    values = np.stack([rows[:, d].T @ weights for d in directions]).astype(np.float32)
    neighbours = np.tile(np.arange(10, dtype=np.int32), (3, 1))
    gram, correlation, squared_norm = normal_equations(rows, neighbours, directions, values)
    for i in range(3):
        assert np.allclose(np.linalg.solve(gram[i].astype(float), correlation[i]), weights, atol=1e-3)
        left = weights @ gram[i] @ weights - 2 * weights @ correlation[i] + squared_norm[i]
        assert abs(left) < 1e-5 * squared_norm[i]
