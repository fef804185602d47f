"""Weights that make known rows right, and rows that columns suggest, of matrices that are known whole."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest

from mi_sparse_prt.core.run import Run
from mi_sparse_prt.manylights.calibration import MOST_ROWS, calibrate
from mi_sparse_prt.manylights.elements import ReducedColumns, Representatives, SeenRows
from mi_sparse_prt.manylights.estimate import defensive_partition, draw_representatives
from mi_sparse_prt.manylights.render import RowColumn, Settings, find_view, matrix_of
from mi_sparse_prt.manylights.suggested_rows import joined, suggested_rows

SCENES = Path(__file__).parents[2] / "scenes_xml/many_lights"
SAMPLES, LIGHTS = 400, 240


def smooth_matrix(seed: int, noise: float = 0.0) -> np.ndarray:
    """Elements (samples, lights, 3): lights in five rooms, each of which has samples along a line; coloured."""
    rng = np.random.default_rng(seed)
    x, y = np.linspace(0, 1, SAMPLES)[:, None], rng.random(LIGHTS)
    near = 1 / (0.02 + (x - y) ** 2)
    same = 0.2 + (np.floor(5 * x) == np.floor(5 * y))
    values = near * same * (1 + noise * rng.standard_normal((SAMPLES, LIGHTS)))
    return np.maximum(values, 0)[..., None] * rng.uniform(0.2, 1, (LIGHTS, 3))


def known(whole: np.ndarray) -> SimpleNamespace:
    """What stands for ``Elements``."""

    def stratified_rows(count: int, seed: int) -> np.ndarray:
        count = min(count, len(whole))
        u = np.random.default_rng(seed).random(count)
        return ((np.arange(count) + u) * len(whole) / count).astype(np.int64)

    class Line:
        def __len__(self) -> int:
            return len(whole)

    samples = Line()
    samples.stratified_rows = stratified_rows  # type: ignore[attr-defined]
    return SimpleNamespace(block=lambda rows, columns: whole[np.ix_(rows, columns)], samples=samples)


def seen_of(whole: np.ndarray, rows: np.ndarray, weights: np.ndarray | None = None) -> SeenRows:
    weights = np.ones(len(rows)) if weights is None else weights
    return SeenRows(rows, weights, (whole[rows].sum(axis=1) * weights[:, None])[None])


def reduced_of(whole: np.ndarray, seen: SeenRows) -> ReducedColumns:
    scaled = whole[seen.ids] * seen.weights[:, None, None]
    norms = np.linalg.norm(scaled, axis=2).T.astype(np.float32)
    return ReducedColumns(norms, np.linalg.norm(norms, axis=1).astype(float), np.zeros((len(norms), 0)))


def off(whole: np.ndarray, chosen: Representatives) -> np.ndarray:
    """Errors (samples, 3) of the mean of all sets."""
    found = np.einsum("iskc,skc->ic", whole[:, chosen.ids], chosen.weights) / len(chosen.ids)
    return found - whole.sum(axis=1)


def both(seed: int, noise: float = 0.0, rows: int = 60, sets: int = 2):
    """Errors before and after, and what of the squared error is said to be left."""
    whole = smooth_matrix(seed, noise)
    elements, rng = known(whole), np.random.default_rng(seed)
    seen = seen_of(whole, elements.samples.stratified_rows(rows, seed))
    partition = defensive_partition(reduced_of(whole, seen), np.ones(LIGHTS), 30, rng)
    drawn = draw_representatives(partition, sets, rng)
    ours, left = calibrate(elements, seen, drawn)
    assert np.array_equal(ours.ids, drawn.ids) and (ours.weights >= 0).all()
    return off(whole, drawn), off(whole, ours), left


def test_calibrated_weights_make_other_rows_right_too() -> None:
    """Of forty matrices whose elements have 30% of noise, 60 of 400 rows are known: the error of all others falls.

    Expected: the squared error is at most 0.6 times as large, without noise a thousandth; what is said to be left of
    it is within 25% (means of forty).
    """
    before, after, left = map(np.array, zip(*(both(seed, 0.3) for seed in range(40)), strict=True))
    squares = [(errors**2).sum(axis=(1, 2)) for errors in (before, after)]
    assert squares[1].sum() < 0.6 * squares[0].sum()
    assert (left * squares[0]).sum() == pytest.approx(squares[1].sum(), rel=0.25)
    smooth, ours, _ = both(0)
    assert np.square(ours).sum() < 1e-3 * np.square(smooth).sum()


def test_calibration_has_little_bias() -> None:
    """Of one matrix and 300 choices of representatives by the same rows: the mean error beside a single one.

    Expected: a bias below a fifth of the error that single estimates have, and below 1% of the light.
    """
    whole = smooth_matrix(0, 0.3)
    elements = known(whole)
    seen = seen_of(whole, elements.samples.stratified_rows(60, 0))
    partition = defensive_partition(reduced_of(whole, seen), np.ones(LIGHTS), 30, np.random.default_rng(0))
    rng = np.random.default_rng(1)
    errors = np.array(
        [
            off(whole, calibrate(elements, seen, draw_representatives(partition, 2, rng)).representatives)
            for _ in range(300)
        ]
    )
    single, bias = np.sqrt((errors**2).sum(axis=(1, 2)).mean()), np.linalg.norm(errors.mean(axis=0))
    chance = single / np.sqrt(len(errors))  # what the mean is off by, without any bias
    print(f"bias {np.sqrt(max(bias**2 - chance**2, 0)) / single:.3f} of the error")
    assert np.sqrt(max(bias**2 - chance**2, 0)) < 0.2 * single
    assert abs(errors.sum(axis=(1, 2)).mean()) < 0.01 * whole.sum()


@pytest.mark.parametrize("power", [1, 4])
def test_rows_that_tell_nothing_change_little(power: int) -> None:
    """Each element is another random number, of 4 nearly all light is in a few: what a row lacks, others do not.

    Expected: of twenty matrices, squared errors of other rows are at most 1.1 times as large.
    """
    before, after = 0.0, 0.0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        whole = rng.exponential(size=(SAMPLES, LIGHTS, 1)) ** power * np.ones(3)
        elements = known(whole)
        seen = seen_of(whole, elements.samples.stratified_rows(60, 0))
        lights = np.stack([rng.choice(LIGHTS, 60, replace=False) for _ in range(2)])
        drawn = Representatives(lights, np.full((2, 60, 3), LIGHTS / 60, np.float32))
        ours, _ = calibrate(elements, seen, drawn)
        others = np.setdiff1d(np.arange(SAMPLES), seen.ids)
        scale = np.square(whole.sum(axis=1)).sum()
        before += np.square(off(whole, drawn)[others]).sum() / scale
        after += np.square(off(whole, ours)[others]).sum() / scale
    assert after < 1.1 * before


def test_weighted_rows_are_those_of_a_matrix_that_is_weighted() -> None:
    whole, rng = smooth_matrix(3, 0.3), np.random.default_rng(3)
    rows, weights = known(whole).samples.stratified_rows(60, 3), rng.uniform(0.2, 2, 60)
    weighted = whole.copy()
    weighted[rows] *= weights[:, None, None]
    drawn = Representatives(rng.choice(LIGHTS, (1, 40)), np.full((1, 40, 3), LIGHTS / 40, np.float32))
    found = calibrate(known(whole), seen_of(whole, rows, weights), drawn)
    expected = calibrate(known(weighted), seen_of(weighted, rows), drawn)
    assert found.left == pytest.approx(expected.left) and found.left < 0.5
    assert found.representatives.weights == pytest.approx(expected.representatives.weights, rel=1e-4)


@pytest.mark.parametrize("rows", [1, 2, MOST_ROWS + 7])
def test_any_number_of_rows(rows: int) -> None:
    whole = np.tile(smooth_matrix(0), (2, 1, 1))
    elements = known(whole)
    seen = seen_of(whole, elements.samples.stratified_rows(rows, 0))
    drawn = Representatives(np.arange(0, LIGHTS, 8)[None], np.full((1, LIGHTS // 8, 3), 8.0, np.float32))
    ours, left = calibrate(elements, seen, drawn)
    assert np.isfinite(ours.weights).all() and 0 <= left <= 1


def test_black_rows_change_nothing() -> None:
    whole = np.zeros((SAMPLES, LIGHTS, 3))
    drawn = Representatives(np.arange(9)[None], np.ones((1, 9, 3), np.float32))
    ours, left = calibrate(known(whole), seen_of(whole, np.arange(10)), drawn)
    assert np.array_equal(ours.weights, drawn.weights) and left == 1


# -- rows that columns suggest ----------------------------------------------------------------------------------------


def with_a_recess() -> np.ndarray:
    """The last ten lights shine into a corner that four of 400 samples see, and nowhere else."""
    whole = smooth_matrix(0)
    whole[:, -10:] = 0
    whole[201:205, -10:] = 20 * whole.max()
    return whole


def suggest(whole: np.ndarray, seed: int, count: int = 40):
    elements = known(whole)
    first = elements.samples.stratified_rows(count // 2, seed)
    every = Representatives(np.arange(LIGHTS)[None], np.ones((1, LIGHTS, 3), np.float32))
    more, weights = suggested_rows(elements, first, every, count, seed)
    return first, more, weights


def test_rows_are_suggested_where_few_samples_are_lit() -> None:
    """Expected: 1% of the samples have rows in each of twenty choices; none is twice; about as many as asked for."""
    whole = with_a_recess()
    for seed in range(20):
        first, more, weights = suggest(whole, seed)
        assert np.isin(np.append(first, more), np.arange(201, 205)).any()
        assert len(np.unique(np.append(first, more))) == len(first) + len(more) == len(weights)
        assert 18 <= len(more) <= 20 and (weights > 0).all()


def test_norms_by_suggested_rows_have_no_bias() -> None:
    """Squared norms of columns in 2000 choices of rows: their mean.

    Expected: of ordinary columns and of those in the recess within four standard errors, which are below 4%.
    """
    whole = with_a_recess()
    true = np.square(whole).sum(axis=(0, 2)) * 40 / SAMPLES
    parts = slice(0, -10), slice(-10, None)
    found = []
    for seed in range(2000):
        first, more, weights = suggest(whole, seed)
        squares = np.square(whole[np.append(first, more)]).sum(axis=2) * np.square(weights)[:, None]
        found.append([(squares.sum(axis=0) / true)[part].mean() for part in parts])
    error = np.std(found, axis=0) / np.sqrt(len(found))
    assert (np.abs(np.mean(found, axis=0) - 1) < 4 * error).all() and (4 * error < 0.04).all()


def test_joined_columns_are_those_of_all_rows() -> None:
    whole, rng = smooth_matrix(0), np.random.default_rng(0)
    rows, weights = rng.choice(SAMPLES, 12, replace=False), rng.uniform(0.5, 2, 12)
    projection = rng.standard_normal((12, 4)).astype(np.float32)
    expected = reduced_of(whole, seen_of(whole, rows, weights))
    kept = reduced_of(whole, seen_of(whole, rows[:5]))._replace(seen=seen_of(whole, rows[:5]))
    others = reduced_of(whole, seen_of(whole, rows[5:], weights[5:]))
    others = others._replace(
        projected=others.projected @ projection[5:], seen=seen_of(whole, rows[5:], weights[5:])
    )
    found = joined(kept, weights[:5], projection[:5], others)
    assert found.projected == pytest.approx(expected.projected @ projection, rel=1e-3, abs=1e-2)
    assert found.norms == pytest.approx(expected.norms, rel=1e-5)
    assert found.seen is not None and np.array_equal(found.seen.ids, rows)
    assert found.seen.sums[0] == pytest.approx(whole[rows].sum(axis=1) * weights[:, None])


# -- pictures ---------------------------------------------------------------------------------------------------------


def test_calibration_makes_a_picture_better_and_says_by_how_much() -> None:
    """The colonnade at 48 x 36, 5000 lights, against the sum of all: root mean squares of eight seeds.

    Expected: at most 0.9 times the error of the same representatives; what is told is within 30%.
    """
    scene = mi.load_file(str(SCENES / "colonnade.xml"), parallel=False)
    film = mi.traverse(scene.sensors()[0])
    film["film.size"] = film["film.crop_size"] = mi.ScalarVector2u(48, 36)
    film.update()
    before, after, told = [], [], []
    elements = matrix_of(find_view(scene, 0), Settings(lights=5000), Run(0))
    true = elements.samples.image(elements.sum_of_rows(np.arange(len(elements.samples))))
    for seed in range(8):
        found = RowColumn(elements, Settings(rows=100, columns=60, seed=seed), Run(seed))
        reduced = found.reduced(100)
        partition = found.partition(reduced, 60)
        plain, ours = (found.summed(known, partition) for known in (reduced._replace(seen=None), reduced))
        before.append(np.square(elements.samples.image(plain.values) - true).sum())
        after.append(np.square(elements.samples.image(ours.values) - true).sum())
        told.append(ours.squared_error)
    print(
        f"{np.sqrt(np.mean(after) / np.mean(before)):.2f}, told {np.sqrt(np.mean(told) / np.mean(after)):.2f}"
    )
    assert np.sqrt(np.mean(after) / np.mean(before)) < 0.9
    assert np.sqrt(np.mean(told) / np.mean(after)) == pytest.approx(1, abs=0.3)
