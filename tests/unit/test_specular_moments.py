"""Where rays towards mirrors and glass are worth most: moments of cells, together with those beside them."""

import numpy as np
import scipy.ndimage

from mi_sparse_prt.core.random_keys import mix
from mi_sparse_prt.solvers.bent_light import _Moments
from mi_sparse_prt.solvers.specular_chains import CELLS, Cells, Strata, _bayer, draw_strata


def some_cells(rng: np.random.Generator) -> Cells:
    """Two in five of the cells of every other one of 40 points."""
    flat = np.flatnonzero(rng.random((40, CELLS**2)) * (np.arange(40)[:, None] % 2) > 0.6)
    shares = rng.random(len(flat)).astype(np.float32)
    return Cells(flat // CELLS**2, flat % CELLS**2, shares)


def test_moments_are_those_of_a_cell_and_those_beside_it():
    """Truth: sums by scipy's filter over whole hemispheres, of which what is no cell is dark."""
    rng = np.random.default_rng(1)
    cells, power = some_cells(rng), rng.random(40)
    moments, m = _Moments(cells, power), len(cells.rows)
    squares, across = rng.exponential(1, m).astype(np.float32), rng.integers(1, 4, m)
    strata = Strata(cells, np.arange(m), across, np.ones(m, np.float32))
    moments.calibrate(1.0, np.ones(m))
    for _ in range(2):  # what was known before is not kept
        moments.best_rays(1.0)
        moments.add(strata, squares)
    grids = np.zeros((2, 40, CELLS, CELLS))
    for grid, values in zip(grids, (2 * squares, 2 * across**2), strict=True):
        grid.reshape(40, -1)[cells.rows, cells.numbers] = values
    around = 9 * scipy.ndimage.uniform_filter(grids, (0, 0, 3, 3), mode="constant").reshape(2, 40, -1)
    found, traced = around[:, cells.rows, cells.numbers]
    average = squares.sum() / (across**2).sum()
    expected = np.sqrt((found + average) / (traced + 1) * power[cells.rows])
    best = moments.best_rays(1.0)
    np.testing.assert_allclose(best / best.sum(), expected / expected.sum(), rtol=1e-4)


def test_cells_are_drawn_by_their_chance():
    """Truth: Bayer's matrix turned by a random number of each point, in NumPy."""
    rng = np.random.default_rng(2)
    cells, keys = some_cells(rng), rng.integers(1 << 63, size=40, dtype=np.uint64)
    rays = rng.exponential(1, len(cells.rows))
    drawn = draw_strata(cells, keys, rays, 3, 7)
    own = mix(mix(keys ^ np.uint64(7))) * 2.0**-64
    expected = (own[cells.rows] + _bayer(CELLS)[cells.numbers]) % 1 < np.minimum(rays, 1)
    assert 0.3 < expected.mean() < 0.9
    np.testing.assert_array_equal(drawn.which, np.flatnonzero(expected))
    np.testing.assert_allclose(drawn.scale, 1 / np.minimum(rays[expected], 1), rtol=1e-6)
    assert drawn.across.max() == 3
