"""Interpolation from a coarse cubemap to a finer one."""

import numpy as np
import pytest

import mi_sparse_prt as prt
from mi_sparse_prt.emission.cube_faces import FACE_FRAMES

PAIRS = [(1, 2), (1, 8), (2, 4), (2, 32), (4, 8), (8, 32), (16, 32)]


def matrix(m: int, n: int):
    return prt.CubemapLighting(n).upsampling(prt.CubemapLighting(m))


def smooth(directions: np.ndarray) -> np.ndarray:
    """A function on the sphere of second order in the directions, between about -1 and 2."""
    x, y, z = directions.astype(np.float64).T
    return x + y * z - 0.5 * z * z + 0.3 * x * y


@pytest.mark.parametrize(("m", "n"), PAIRS)
def test_weights(m, n):
    """Rows are averages: not negative, they sum to 1, and so constants stay constant."""
    weights = matrix(m, n)
    assert weights.shape == (6 * n * n, 6 * m * m)
    assert weights.data.min() >= 0
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(weights @ np.full(6 * m * m, 7.0), 7, rtol=1e-6)
    assert np.diff(weights.indptr).max() <= 4
    assert (weights.sum(axis=0) > 0).all()  # no coarse texel is lost


@pytest.mark.parametrize("n", [1, 2, 8, 32])
def test_equal_resolutions_give_the_identity(n):
    weights = matrix(n, n)
    assert (weights != weights.T).nnz == 0
    assert weights.nnz == 6 * n * n
    assert (weights.diagonal() == 1).all()
    assert weights.dtype == np.float32


@pytest.mark.parametrize(("m", "n"), [(4, 8), (4, 32), (8, 32)])
def test_linear_functions_on_a_face_are_reproduced_away_from_its_edges(m, n):
    face, row, col = np.unravel_index(np.arange(6 * n * n), (6, n, n))
    s, t = ((2 * i + 1) / n - 1 for i in (col, row))
    coarse_face, coarse_row, coarse_col = np.unravel_index(np.arange(6 * m * m), (6, m, m))
    coarse_s, coarse_t = ((2 * i + 1) / m - 1 for i in (coarse_col, coarse_row))
    for a, b, c in ((1, 0, 0), (0, 1, 0), (2, -3, 0.5)):
        values = (a * coarse_s + b * coarse_t + c) * (1 + coarse_face)
        inside = np.maximum(np.abs(s), np.abs(t)) < 1 - 1 / m
        expected = (a * s + b * t + c) * (1 + face)
        assert inside.mean() > 0.4
        np.testing.assert_allclose((matrix(m, n) @ values)[inside], expected[inside], atol=3e-6)


def test_faces_are_oriented_as_the_lighting_is():
    """The interpolated directions point to where they are interpolated at, on all faces."""
    coarse, fine = prt.CubemapLighting(8), prt.CubemapLighting(32)
    d = matrix(8, 32) @ coarse.directions
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    assert (d * fine.directions).sum(axis=1).min() > np.cos(0.06)  # a quarter of a coarse texel


@pytest.mark.parametrize(("m", "worst"), [(4, 0.15), (8, 0.05), (16, 0.02)])
def test_smooth_functions_stay_smooth_across_faces(m, worst):
    """A smooth function is followed everywhere, and steps over a face's edge are as small as those inside.

    Steps: between fine texels whose directions are neighbours, in units of what the function itself does there.
    """
    n = 64
    coarse, fine = prt.CubemapLighting(m), prt.CubemapLighting(n)
    values = matrix(m, n) @ smooth(coarse.directions)
    assert np.abs(values - smooth(fine.directions)).max() < worst

    on_edge, across = _edge_pairs(fine)
    inside = np.abs(np.diff(values.reshape(6, n, n), axis=2)).max()
    step = np.abs(values[on_edge] - values[across])
    assert step.max() < 2 * inside


def _edge_pairs(lighting: prt.CubemapLighting) -> tuple[np.ndarray, np.ndarray]:
    """Texels along the s = 1 edges of all faces and their neighbours beyond."""
    n = lighting.resolution
    face, row, col = np.unravel_index(np.arange(6 * n * n), (6, n, n))
    edge = np.flatnonzero(col == n - 1)
    t = (2 * row[edge] + 1) / n - 1
    s_axis, t_axis, centre = (FACE_FRAMES[face[edge], i] for i in range(3))
    return edge, lighting.texel_of(centre + (1 + 1 / n) * s_axis + t[:, None] * t_axis)
