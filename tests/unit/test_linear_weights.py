"""Moving least squares along a surface: what is linear in position and normal is reproduced."""

from __future__ import annotations

import numpy as np
import pytest

from mi_sparse_prt.measurement.neighbours import surface_neighbours
from mi_sparse_prt.reconstruction.interpolation_weights import linear_weights


def _plane(n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    positions = np.column_stack([rng.random(n), np.zeros(n), rng.random(n)]).astype(np.float32)
    return positions, np.tile(np.float32([0, 1, 0]), (n, 1))


def test_rows_sum_to_one_and_are_bounded() -> None:
    dense_p, dense_n = _plane(200, 0)
    p, n = _plane(500, 1)
    near = surface_neighbours(p, n, dense_p, dense_n, 12)
    weights = linear_weights(near, p, n, dense_p, dense_n)
    assert np.allclose(weights.sum(axis=1), 1, atol=1e-5)
    assert np.abs(weights).max() < 2


def test_linear_functions_are_met_better_than_by_the_mean() -> None:
    dense_p, dense_n = _plane(400, 0)
    p, n = _plane(300, 1)
    near = surface_neighbours(p, n, dense_p, dense_n, 12)
    weights = linear_weights(near, p, n, dense_p, dense_n)
    value, truth = 3 * dense_p[:, 0] - 2 * dense_p[:, 2], 3 * p[:, 0] - 2 * p[:, 2]
    inside = (np.abs(p[:, [0, 2]] - 0.5) < 0.4).all(axis=1)  # at the border the ridge shows
    error = ((weights * value[near.ids]).sum(axis=1) - truth)[inside]
    plain = (value[near.ids].mean(axis=1) - truth)[inside]
    assert np.sqrt((error**2).mean()) < 0.4 * np.sqrt((plain**2).mean())


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_weights_do_not_depend_on_the_unit_of_length(scale: float) -> None:
    dense_p, dense_n = _plane(100, 0)
    p, n = _plane(50, 1)
    plain = linear_weights(surface_neighbours(p, n, dense_p, dense_n, 8), p, n, dense_p, dense_n)
    dense_p, p = dense_p * np.float32(scale), p * np.float32(scale)
    scaled = linear_weights(surface_neighbours(p, n, dense_p, dense_n, 8), p, n, dense_p, dense_n)
    assert np.allclose(plain, scaled, atol=1e-4)


@pytest.mark.parametrize("count", [1, 3, 12])
def test_neighbours_all_in_one_place_give_their_mean(count: int) -> None:
    dense_p, dense_n = np.zeros((count, 3), np.float32), np.tile(np.float32([0, 1, 0]), (count, 1))
    p, n = np.zeros((4, 3), np.float32), np.tile(np.float32([0, 1, 0]), (4, 1))
    weights = linear_weights(surface_neighbours(p, n, dense_p, dense_n, 12), p, n, dense_p, dense_n)
    assert np.isfinite(weights).all()
    assert np.allclose(weights[:, :count], 1 / count, atol=1e-5)


def test_no_neighbours_give_no_weights() -> None:
    p, n = _plane(5, 0)
    near = surface_neighbours(p, n, p, -n, 4)  # all of them face the other way
    assert (near.ids < 0).all()
    weights = linear_weights(near, p, n, p, -n)
    assert np.array_equal(weights, np.zeros((5, 4), np.float32))
