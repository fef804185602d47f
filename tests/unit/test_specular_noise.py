"""Noise of specular light averaged among neighbours: as much as two halves say is worth it, and no light is lost."""

import numpy as np
import pytest
import scipy.sparse
from conftest import T, build, diffuse, problem_at

import mi_sparse_prt as prt
from mi_sparse_prt.reconstruction.specular_noise import SpecularNoise
from mi_sparse_prt.solvers.specular_chains import CELLS, Cells, draw_strata

FLOOR = {
    "type": "rectangle",
    "to_world": T().rotate([1, 0, 0], -90).scale(2),
    "bsdf": diffuse(0.5, 0.5, 0.5),
}


@pytest.fixture(scope="module")
def floor():
    """Vertices of a floor, and how far right each is."""
    scene = build(0.08, floor=FLOOR)
    return problem_at(scene, prt.CubemapLighting(2)), scene.positions[:, 0]


def halves(light, spread):
    """Two estimates of it, with noise."""
    rng = np.random.default_rng(3)
    return [
        [scipy.sparse.csr_array((light + spread * rng.standard_normal(light.shape)).astype(np.float32))]
        for _ in "ab"
    ]


@pytest.mark.parametrize("spread", [0.05, 1.0])
def test_less_error_and_as_much_as_told(floor, spread):
    """
    Scenario: light that changes slowly along a floor, with a sharp edge across it; each half with so much noise.
    Expected: little noise is left far from the edge, none of the sharpness is lost where noise is small; what is told
        is what is there.
    """
    problem, x = floor
    light = np.where(x[:, None] > 0.3, 1 + 0.1 * x[:, None], 0.2) * np.linspace(0.5, 1, 24)
    pair = halves(light, spread)
    mean = (pair[0][0] + pair[1][0]) * np.float32(0.5)
    noise = SpecularNoise(problem, 1)
    told = noise.judge(pair, np.ones((len(x), 1)))
    smooth = noise.averaged(mean).toarray()
    before, after = (np.square(found - light).sum() for found in (mean.toarray(), smooth))
    print(f"{before:.1f} before, {after:.1f} after, told {told:.1f}")
    assert after < 0.4 * before
    assert told == pytest.approx(after, rel=0.15)
    if spread < 0.1:
        edge = np.abs(x - 0.3) < 0.08
        kept = [np.square(found - light)[edge].sum() for found in (mean.toarray(), smooth)]
        assert edge.sum() > 40
        assert kept[1] < 1.3 * kept[0]


def test_even_light_stays_even_and_none_is_lost(floor):
    problem, x = floor
    pair = halves(np.ones((len(x), 24)), 0.5)
    noise = SpecularNoise(problem, 1)
    noise.judge(pair, np.ones((len(x), 1)))
    even = scipy.sparse.csr_array(np.ones((len(x), 3), np.float32))
    assert noise.averaged(even).toarray() == pytest.approx(1, abs=1e-5)
    inside = np.flatnonzero((np.abs(x) < 1.5) & (np.abs(problem.scene.positions[:, 2]) < 1.5))[::50]
    spots = np.zeros((len(x), len(inside)), np.float32)
    spots[inside, np.arange(len(inside))] = 1
    given = noise.averaged(scipy.sparse.csr_array(spots)).toarray()
    assert given.max(axis=0).mean() < 0.5  # it is spread
    assert given.sum(axis=0).mean() == pytest.approx(1, abs=0.02)


def test_cells_are_drawn_as_often_as_wanted():
    """Expected: of cells worth a quarter of a ray, one of each two by two, about; strata where they are worth more."""
    rows = np.repeat(np.arange(300), CELLS**2)
    cells = Cells(rows, np.tile(np.arange(CELLS**2), 300), np.ones(len(rows), np.float32))
    keys = np.arange(300, dtype=np.uint64)
    few = draw_strata(cells, keys, np.full(len(rows), 0.25), 8, 5)
    assert np.bincount(few.cells.rows).tolist() == [CELLS**2 // 4] * 300
    assert np.all(few.scale == 4) and np.all(few.across == 1)
    of_four = np.zeros((300, CELLS, CELLS), int)
    of_four[few.cells.rows, few.cells.numbers // CELLS, few.cells.numbers % CELLS] = 1
    of_four = of_four.reshape(300, CELLS // 2, 2, CELLS // 2, 2).sum(axis=(2, 4))
    assert of_four.max() <= 2 and (of_four == 0).mean() < 0.3
    often = np.zeros(len(rows))
    for seed in range(64):
        often[draw_strata(cells, keys, np.full(len(rows), 0.25), 8, seed).which] += 1 / 64
    assert often.mean() == 0.25
    assert often.std() == pytest.approx(np.sqrt(0.25 * 0.75 / 64), rel=0.1)
    many = draw_strata(cells, keys, np.full(len(rows), 9.4), 8, 5)
    assert len(many.which) == len(rows) and np.all(many.across == 3)
    assert many.shares.sum() * 9 == pytest.approx(300)
