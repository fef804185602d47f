"""Adaptive sampling of directions against loops over pixels that know nothing of bits."""

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray

import mi_sparse_prt as prt
from mi_sparse_prt.core.bits import count_bits, unpack
from mi_sparse_prt.sampling.angular import AngularGrid, DenseRows

GRIDS = {n: AngularGrid(prt.CubemapLighting(n)) for n in (1, 2, 4, 8, 16)}
UP = np.float32([[0, 1, 0]])


def sampled(grid: AngularGrid) -> NDArray[np.bool_]:
    """(n_directions,) texels of the quarter, from first principles."""
    n = grid.lighting.resolution
    face = np.zeros((n, n), bool)
    face[::2, ::2] = True
    return np.tile(face.ravel(), 6)


def unit(n: int, seed: int = 0) -> NDArray[np.float32]:
    x = np.random.default_rng(seed).normal(size=(n, 3))
    return (x / np.linalg.norm(x, axis=1, keepdims=True)).astype(np.float32)


def sky(blocked: NDArray[np.bool_]):
    """A sky for ``sample`` of which these elements (n, n_directions) are hidden."""
    return lambda rows, texels: ~blocked[rows, texels]


def masks(rows: DenseRows, n_directions: int) -> tuple[NDArray[np.bool_], ...]:
    return tuple(unpack(b, n_directions) for b in (rows.visible, rows.evaluated, rows.features, rows.above))


def naive(
    grid: AngularGrid, above: NDArray, blocked: NDArray, windows: list[set[int]]
) -> tuple[NDArray, ...]:
    """Two passes over one row, texel by texel: what is visible, evaluated and a feature."""
    quarter = sampled(grid)
    visible, evaluated, features = (np.zeros(len(above), bool) for _ in range(3))
    for j in np.flatnonzero(above):
        kinds = {bool(blocked[g]) for g in windows[j] if above[g] and quarter[g]}
        features[j] = not quarter[j] and len(kinds) != 1
        evaluated[j] = quarter[j] or features[j]
        visible[j] = not blocked[j] if evaluated[j] else kinds == {False}
    return visible, evaluated, features


def window_sets(grid: AngularGrid) -> list[set[int]]:
    return [set(row[row >= 0].tolist()) for row in grid.windows]


# ------------------------------------------------------------------------------------ the grid and its windows


@pytest.mark.parametrize("n", GRIDS)
def test_a_quarter_of_the_texels(n):
    grid = GRIDS[n]
    assert np.array_equal(grid.texels, np.flatnonzero(sampled(grid)))
    assert len(grid.texels) == (6 if n == 1 else 6 * n * n // 4)


@pytest.mark.parametrize("n", [8, 16])
def test_windows_inside_a_face_are_7_by_7(n):
    grid = GRIDS[n]
    windows = window_sets(grid)
    quarter = sampled(grid)
    for f, row, col in itertools.product(range(6), range(3, n - 3), range(3, n - 3)):
        square = {
            (f * n + r) * n + c for r in range(row - 3, row + 4) for c in range(col - 3, col + 4)
        }  # texels
        assert windows[(f * n + row) * n + col] == {j for j in square if quarter[j]}


@pytest.mark.parametrize("n", GRIDS)
def test_tables_of_windows(n):
    """At most 16 of the 49 texels are on the grid; no place is listed twice; -1 comes last."""
    grid = GRIDS[n]
    assert grid.windows.shape[0] == 6 * n * n
    assert grid.windows.shape[1] <= 16
    for row in grid.windows:
        present = row[row >= 0]
        assert len(set(present)) == len(present)
        assert (row[len(present) :] == -1).all()
        assert sampled(grid)[present].all()
    if n > 1:
        assert (grid.windows >= 0).any(axis=1).all()


@pytest.mark.parametrize("n", [4, 8])
def test_windows_are_symmetric_as_the_cube_is(n):
    """All 48 turns and mirrorings map texels onto texels; if the whole window (before the grid thins it) of a texel is
    mapped, it is the window of the mapped texel. A face whose axes are mistaken would not do so.
    """
    grid = AngularGrid(prt.CubemapLighting(n))
    grid._sampled[:] = True
    places = [grid.lighting.beside(dx, dy) for dy in range(-3, 4) for dx in range(-3, 4)]
    windows = [frozenset(int(t[j]) for t in places if t[j] >= 0) for j in range(grid.lighting.n_directions)]
    for axes in itertools.permutations(range(3)):
        for signs in itertools.product((-1, 1), repeat=3):
            to = grid.lighting.texel_of(grid.lighting.directions[:, axes] * np.float32(signs))
            assert len(set(to)) == len(to)
            for j, window in enumerate(windows):
                assert {int(to[k]) for k in window} == windows[to[j]]


@pytest.mark.parametrize("n", [8, 16])
def test_windows_continue_over_edges(n):
    """Windows are near in angle: no further than 7 x 7 texels reach on a face's plane, and beside an edge they hold
    texels of both faces; in a corner of three.
    """
    grid = GRIDS[n]
    d = grid.lighting.directions.astype(np.float64)
    face = np.arange(6 * n * n) // (n * n)
    reach = 3 * np.sqrt(2) * 2 / n  # on the plane at distance 1; the angle is smaller
    faces = np.zeros((6, n, n), int)
    for j, window in enumerate(window_sets(grid)):
        assert all(np.arccos(min(1, d[j] @ d[k])) < reach for k in window)
        faces.ravel()[j] = len({int(face[k]) for k in window} | {int(face[j])})
    assert (faces[:, 1, 1] == 3).all()
    assert (faces[:, n // 2, 0] == 2).all()
    assert (faces[:, n // 2 - 1 : n // 2 + 1, n // 2 - 1 : n // 2 + 1] == 1).all()


# ------------------------------------------------------------------------------------ two passes


@pytest.mark.parametrize("n", GRIDS)
@pytest.mark.parametrize("density", [0, 0.02, 0.5, 1])
def test_two_passes_against_loops(n, density):
    """Random skies, in blobs and in single texels, under random horizons."""
    grid = GRIDS[n]
    rng = np.random.default_rng(n)
    normals = unit(12, n)
    blocked = rng.random((12, 6 * n * n)) < density
    blocked[:6] = (grid.lighting.directions @ unit(6, 99).T > 1 - 2 * density).T  # caps
    rows = masks(grid.sample(normals, sky(blocked)), 6 * n * n)
    above = normals @ grid.lighting.directions.T > 0
    assert np.array_equal(rows[3], above)
    windows = window_sets(grid)
    for i in range(12):
        expected = naive(grid, above[i], blocked[i], windows)
        for ours, theirs in zip(rows[:3], expected, strict=True):
            assert np.array_equal(ours[i], theirs)


def test_each_element_is_asked_once_and_only_above_the_horizon():
    grid = GRIDS[8]
    normals = unit(20)
    blocked = np.random.default_rng(0).random((20, 384)) < 0.3
    asked = []

    def visible(rows: NDArray, texels: NDArray) -> NDArray:
        asked.append(np.stack([rows, texels]))
        return ~blocked[rows, texels]

    rows = grid.sample(normals, visible)
    assert len(asked) == 2
    i, j = np.concatenate(asked, axis=1).astype(int)
    assert len(set(zip(i, j, strict=True))) == len(i) == count_bits(rows.evaluated).sum()
    assert (np.einsum("ix,ix->i", normals[i], grid.lighting.directions[j]) > 0).all()
    assert sampled(grid)[asked[0][1]].all()
    assert not sampled(grid)[asked[1][1]].any()


@pytest.mark.parametrize("hidden", [False, True])
def test_a_sky_of_one_kind_costs_the_quarter_grid(hidden):
    """Rationale: the horizon is not an edge. An open sky, or none at all, above a tilted horizon at resolution 16.

    Expected: the grid above the horizon is evaluated and nothing else, but for directions so close to the horizon that
    no grid direction of their window is above it; all of the sky is right.
    """
    grid = GRIDS[16]
    normals = np.concatenate([UP, unit(50)])
    blocked = np.full((51, 1536), hidden)
    visible, evaluated, features, above = masks(grid.sample(normals, sky(blocked)), 1536)
    assert np.array_equal(visible, above & ~hidden)
    windows = window_sets(grid)
    lonely = np.array(
        [[above[i, j] and not any(above[i, k] for k in windows[j]) for j in range(1536)] for i in range(51)]
    )
    assert np.array_equal(features, lonely & ~sampled(grid))
    assert np.array_equal(evaluated, (above & sampled(grid)) | features)
    assert features.sum() < 0.002 * above.sum()
    assert features[0].sum() == 0
    assert evaluated[0].sum() == (above[0] & sampled(grid)).sum() == 1536 // 8


def test_half_a_sky():
    """A wall hides all with x < 0: exact everywhere, and only a band of 3 texels at its edge costs anything."""
    grid = GRIDS[16]
    d = grid.lighting.directions
    blocked = (d[:, 0] < 0)[None]
    visible, evaluated, features, above = masks(grid.sample(UP, sky(blocked)), 1536)
    assert np.array_equal(visible, above & ~blocked)
    # a band of three texels of 2/16 on either side, on the plane of the top face
    x = np.abs(d[:, 0]) / np.maximum(d[:, 1], np.abs(d[:, 2])).clip(1e-6)
    assert features.sum() > 0
    assert (x[features[0]] < 3 * 2 / 16 + 1e-5).all()
    assert evaluated.sum() < 0.75 * above.sum()


def test_what_the_grid_misses_is_missed():
    """The documented limit: an occluder of one texel between the grid's is not seen; one on the grid is, with all that
    is around it.
    """
    grid = GRIDS[16]
    top = 2 * 256 + 7 * 16  # face +Y, row 7
    thin = np.zeros((1, 1536), bool)
    thin[0, [top + 5, top + 7]] = True
    visible, evaluated, features, above = masks(grid.sample(UP, sky(thin)), 1536)
    assert np.array_equal(visible, above)
    assert not features.any()

    met = thin.copy()
    met[0, top - 16 + 6] = True  # row 6, column 6: on the grid
    visible, _, features, above = masks(grid.sample(UP, sky(met)), 1536)
    assert np.array_equal(visible, above & ~met)
    assert features.sum() == 49 - 16 + (
        16 - 9
    )  # 7 x 7 without the grid's own 3 x 3 (row 6 is even: 3, 5, 6, 7, 9)


@pytest.mark.parametrize("n", [1, 2])
def test_tiny_cubemaps_are_exact(n):
    """There nothing can be borrowed that is not there: with a texel per face all is sampled."""
    grid = GRIDS[n]
    rng = np.random.default_rng(4)
    normals, blocked = unit(30), rng.random((30, 6 * n * n)) < 0.5
    visible, evaluated, _, above = masks(grid.sample(normals, sky(blocked)), 6 * n * n)
    assert np.array_equal(visible[evaluated], ~blocked[evaluated])
    if n == 1:
        assert np.array_equal(evaluated, above)


def test_no_rows():
    rows = GRIDS[4].sample(np.zeros((0, 3), np.float32), lambda r, t: np.zeros(len(r), bool))
    assert [len(x) for x in (rows.visible, rows.evaluated, rows.features, rows.above)] == [0] * 4


# ------------------------------------------------------------------------------------ upsampling


@pytest.mark.parametrize("n", GRIDS)
def test_rows_of_the_upsampling_sum_to_one(n):
    matrix = GRIDS[n].upsampling
    assert matrix.dtype == np.float32
    assert matrix.shape == (6 * n * n, len(GRIDS[n].texels))
    assert np.allclose(matrix.sum(axis=1), 1, atol=1e-6)
    assert (matrix.data > 0).all()


@pytest.mark.parametrize("n", [4, 8, 16])
def test_linear_functions_are_exact_inside_of_a_face(n):
    """Between grid texels of one face (rows and columns 1 to n - 2), each face with a linear function of its own."""
    grid = GRIDS[n]
    face, row, col = np.unravel_index(np.arange(6 * n * n), (6, n, n))
    a, b, c = np.random.default_rng(0).normal(size=(3, 6))
    values = a[face] + b[face] * row + c[face] * col
    fine = grid.upsampling @ values[grid.texels].astype(np.float32)
    inside = (np.minimum(row, col) >= 1) & (np.maximum(row, col) <= n - 2)
    assert np.allclose(fine[inside], values[inside], atol=1e-4)


@pytest.mark.parametrize("n", [4, 8, 16])
def test_grid_texels_inside_of_a_face_keep_their_values(n):
    grid = GRIDS[n]
    _, row, col = np.unravel_index(grid.texels, (6, n, n))
    inside = np.flatnonzero((row > 0) & (col > 0))
    kept = grid.upsampling[grid.texels[inside]].toarray()
    assert np.array_equal(kept, np.eye(len(grid.texels))[inside])


def test_a_grid_texel_counts_most_at_itself():
    for n, grid in GRIDS.items():
        own = grid.upsampling[grid.texels].toarray()
        assert np.array_equal(own.argmax(axis=1), np.arange(len(grid.texels))), n


def test_smooth_functions_are_continuous_across_edges():
    """A linear function of direction at resolutions 8 and 16: neighbours over an edge differ by little more than the
    function itself does there, and the error falls as the grid gets finer.
    """
    errors = {}
    for n in (8, 16):
        grid = GRIDS[n]
        d = grid.lighting.directions.astype(np.float64)
        true = d @ [0.3, 0.5, -0.8]
        fine = grid.upsampling @ true[grid.texels]
        cosine = np.clip(d @ d.T, -1, 1)
        face = np.arange(len(d)) // n**2
        i, j = np.nonzero((np.arccos(cosine) < 2.2 / n) & (face[:, None] != face))
        assert len(i) >= 12 * n
        assert np.abs((fine[i] - fine[j]) - (true[i] - true[j])).max() < 4 / n
        errors[n] = np.sqrt(np.mean((fine - true) ** 2))
    assert errors[8] < 0.08
    assert errors[16] < 0.6 * errors[8]


def test_a_constant_stays_constant():
    for grid in GRIDS.values():
        assert np.allclose(grid.upsampling @ np.full(len(grid.texels), 3.5, np.float32), 3.5, rtol=1e-6)
