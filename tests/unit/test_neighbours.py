"""Dense neighbours of a vertex: against brute force, in whatever order the dense vertices come."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.measurement.neighbours import Neighbours, radius_neighbours, surface_neighbours
from mi_sparse_prt.reconstruction.interpolation_weights import inverse_distance_weights


def lattice(least: int, most: int) -> st.SearchStrategy:
    """Points on a small lattice: full of equal distances and of repeated points."""
    size = st.integers(least, most)
    return size.flatmap(lambda n: arrays(np.float32, (n, 3), elements=st.integers(-2, 2).map(float)))


def sphere(n: int, seed: int = 0) -> np.ndarray:
    x = np.random.default_rng(seed).normal(size=(n, 3))
    return (x / np.linalg.norm(x, axis=1, keepdims=True)).astype(np.float32)


def facing(n: int, *normal: float) -> np.ndarray:
    return np.tile(np.float32(normal), (n, 1))


@given(lattice(0, 5), lattice(0, 20), st.sampled_from([0, 1, 1.5, 2.5, np.inf]), st.integers(1, 25))
@settings(max_examples=200, deadline=None)
def test_radius_neighbours_against_brute_force(points, dense, radius, most):
    found = radius_neighbours(points, dense, radius, most)
    assert found.ids.shape == found.distances.shape == (len(points), most)
    assert (found.ids.dtype, found.distances.dtype) == (np.int32, np.float32)
    for point, ids, distances in zip(points, found.ids, found.distances, strict=True):
        true = np.linalg.norm(dense.astype(float) - point, axis=1)
        expected = np.sort(true[true <= radius])[:most]  # the edge of the radius belongs to it
        n = len(expected)
        assert np.allclose(distances[:n], expected) and np.isinf(distances[n:]).all()
        assert np.allclose(true[ids[:n]], expected) and (ids[n:] == -1).all()
        assert len(set(ids[:n])) == n


@given(lattice(1, 5), lattice(1, 20), st.randoms(use_true_random=False))
@settings(max_examples=100, deadline=None)
def test_order_of_dense_vertices_does_not_show(points, dense, random):
    order = np.array(random.sample(range(len(dense)), len(dense)))
    a, b = (radius_neighbours(points, d, 2, 6) for d in (dense, dense[order]))
    assert np.array_equal(a.distances, b.distances)
    assert np.array_equal(a.ids < 0, b.ids < 0)
    there = a.ids >= 0
    assert np.array_equal(dense[a.ids[there]], dense[order][b.ids[there]])


def test_order_of_points_does_not_show():
    rng = np.random.default_rng(0)
    points, dense = rng.integers(0, 5, (50, 3)).astype(np.float32), sphere(30)
    order = rng.permutation(50)
    assert np.array_equal(
        radius_neighbours(points, dense, 3, 5).ids[order], radius_neighbours(points[order], dense, 3, 5).ids
    )


def test_surface_neighbours_against_brute_force():
    dense, points = sphere(200), sphere(60, seed=1)
    found = surface_neighbours(points, points, dense, dense, 7)
    pairs = np.linalg.norm(dense[:, None].astype(float) - dense, axis=2)
    s = np.median(np.sort(pairs, axis=1)[:, 1])
    # on the unit sphere normals differ by as much as positions do
    true = np.linalg.norm(points[:, None].astype(float) - dense, axis=2) * np.sqrt(1 + s**2)
    assert np.array_equal(found.ids, np.argsort(true, axis=1)[:, :7])
    assert np.allclose(found.distances, np.sort(true, axis=1)[:, :7], rtol=1e-5)


def test_surface_neighbours_stay_on_their_side_of_a_thin_plate():
    rng = np.random.default_rng(0)
    xz = rng.random((300, 2))
    top, bottom = (np.stack([xz[:, 0], np.full(300, y), xz[:, 1]], 1) for y in (1e-4, -1e-4))
    dense = np.concatenate([top, bottom])
    normals = np.concatenate([facing(300, 0, 1, 0), facing(300, 0, -1, 0)])
    both = radius_neighbours(top, dense, np.inf, 20).ids
    assert (both >= 300).any(axis=1).all()
    found = surface_neighbours(top, normals[:300], dense, normals, 20)
    assert (found.ids >= 0).all() and (found.ids < 300).all()
    assert np.array_equal(found.ids[:, 0], np.arange(300))


def test_surface_neighbours_leave_out_normals_that_disagree():
    """Nobody faces the way of the point, not even far away: its row is empty."""
    dense = sphere(10)
    found = surface_neighbours(np.zeros((2, 3)), facing(2, 0, 1, 0), dense, facing(10, 1, 0, 0), 3)
    assert (found.ids == -1).all() and np.isinf(found.distances).all()
    tilted = facing(10, np.sqrt(1 - 0.3**2), 0.3, 0)  # a cosine of 0.3
    assert (surface_neighbours(np.zeros((2, 3)), facing(2, 0, 1, 0), dense, tilted, 3).ids >= 0).all()


@pytest.mark.parametrize("n, n_dense", [(0, 5), (5, 0), (0, 0), (5, 2), (3, 1)])
def test_few_or_no_vertices(n, n_dense):
    points, dense = sphere(n), sphere(n_dense)
    up = facing(n, 0, 1, 0), facing(n_dense, 0, 1, 0)
    for found in (
        radius_neighbours(points, dense, 10, 4),
        surface_neighbours(points, up[0], dense, up[1], 4),
    ):
        assert found.ids.shape == (n, 4) and len(found) == n
        assert ((found.ids >= 0).sum(axis=1) == min(4, n_dense)).all()
        assert inverse_distance_weights(found).shape == (n, 4)


def test_dense_vertices_at_one_place():
    """Every position twice, as at seams: their spacing is that of the places, and both are found."""
    dense = np.repeat(np.float32([[0, 0, 0], [1, 0, 0], [2, 0, 0]]), 2, axis=0)
    up = facing(6, 0, 1, 0)
    found = surface_neighbours(dense, up, dense, up, 4)
    assert np.array_equal(np.sort(found.ids[0]), [0, 1, 2, 3])
    tilted = np.float32([[0.6, 0.8, 0]])
    distance = surface_neighbours(dense[:1], tilted, dense, up, 1).distances[0, 0]
    assert distance == pytest.approx(1 * np.linalg.norm(tilted[0] - [0, 1, 0]))  # a spacing of 1, not 0


def test_what_is_not_finite_is_named():
    good, bad = sphere(4), sphere(4)
    bad[2, 1] = np.nan
    with pytest.raises(PrtError, match="^vertex 2 has the position .*nan.*: repair the mesh$"):
        radius_neighbours(bad, good, 1)
    with pytest.raises(PrtError, match="^candidate 2 has the position"):
        radius_neighbours(good, bad, 1)
    with pytest.raises(PrtError, match="^candidate 2 has the normal"):
        surface_neighbours(good, good, good, bad, 3)
    for radius in (-1, np.nan):
        with pytest.raises(PrtError, match="radius is"):
            radius_neighbours(good, good, radius)
    with pytest.raises(PrtError, match="most is 0"):
        radius_neighbours(good, good, 1, 0)
    with pytest.raises(PrtError, match="count is 0"):
        surface_neighbours(good, good, good, good, 0)


@given(arrays(np.float32, (4, 6), elements=st.floats(0, 2.0**100, width=32)), st.integers(0, 6))
@settings(deadline=None)
def test_weights_sum_to_one_and_fall_with_distance(distances, present):
    ids = np.full((4, 6), -1, np.int32)
    ids[:, :present] = np.arange(present)
    distances = np.where(ids >= 0, np.sort(distances, axis=1), np.inf).astype(np.float32)
    weights = inverse_distance_weights(Neighbours(ids, distances))
    assert weights.dtype == np.float32 and np.isfinite(weights).all()
    assert np.allclose(weights.sum(axis=1), float(present > 0), atol=1e-6)
    assert (weights[ids < 0] == 0).all()
    assert (np.diff(weights, axis=1) <= 0).all()


def test_weights_are_inverse_distances():
    distances = np.float32([[1, 2, 4], [0, 0, 1], [0.5, np.inf, np.inf]])
    ids = np.where(np.isinf(distances), -1, 0).astype(np.int32)
    weights = inverse_distance_weights(Neighbours(ids, distances))
    assert np.allclose(weights, [[4 / 7, 2 / 7, 1 / 7], [0.5, 0.5, 0], [1, 0, 0]])
