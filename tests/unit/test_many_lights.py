"""Many lights: lights of a scene, samples, elements, estimates; small, and where possible against brute force."""

import json
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from conftest import diffuse

import mi_sparse_prt as prt
from mi_sparse_prt.benchmark.many_lights_reference import Reference
from mi_sparse_prt.core.run import Run
from mi_sparse_prt.manylights import elements as elements_module
from mi_sparse_prt.manylights import estimate as estimate_module
from mi_sparse_prt.manylights.baselines import all_lights, draw_by_power, instant_radiosity
from mi_sparse_prt.manylights.elements import Elements, ReducedColumns
from mi_sparse_prt.manylights.estimate import (
    Estimate,
    Partition,
    Representatives,
    defensive_partition,
    draw_coloured_representatives,
    draw_representatives,
    published_partition,
    sum_with_error,
)
from mi_sparse_prt.manylights.lights import LightOptions, scene_lights
from mi_sparse_prt.manylights.render import Settings
from mi_sparse_prt.manylights.samples import Samples
from mi_sparse_prt.manylights.surfaces import Surfaces

T = mi.ScalarTransform4f
ZOO = Path(__file__).parents[2] / "scenes_xml/zoo"
FLOOR = {"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90).scale(2), "bsdf": diffuse(0.6, 0.5, 0.4)}
LAMP = {
    "type": "rectangle",
    "to_world": T().translate([0, 2.5, 0]).rotate([1, 0, 0], 90).scale(0.5),
    "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [6, 5, 4]}},
}
SMALL = {"rows": 12, "columns": 20, "lights": 300, "max_depth": 3}


def camera(size: int = 16, **film: object) -> dict:
    return {
        "type": "perspective",
        "fov": 50,
        "to_world": T().look_at([0, 1, 3.2], [0, 0.8, 0], [0, 1, 0]),
        "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}, **film},
    }


def room(size: int = 16, **more: object) -> mi.Scene:
    ball = {"type": "sphere", "center": [0, 0.7, 0], "radius": 0.7, "bsdf": diffuse(0.7, 0.6, 0.2)}
    shapes = {"floor": FLOOR, "ball": ball, "lamp": LAMP} | more
    kept = {name: thing for name, thing in shapes.items() if thing is not None}
    return mi.load_dict({"type": "scene", "sensor": camera(size), **kept})


def matrix_of(scene: mi.Scene, count: int = 300, max_depth: int = 3, spp: int = 4, seed: int = 0) -> Elements:
    surfaces = Surfaces(scene)
    samples = Samples(scene, surfaces, scene.sensors()[0], spp, max_depth, seed)
    lights = scene_lights(scene, LightOptions(count, max_depth=max_depth, seed=seed))
    return Elements(scene, surfaces, samples, lights)


@pytest.fixture(scope="module")
def small_room() -> mi.Scene:
    return room()


@pytest.fixture(scope="module")
def matrix(small_room: mi.Scene) -> Elements:
    return matrix_of(small_room)


@pytest.fixture(scope="module")
def whole(matrix: Elements) -> np.ndarray:
    return matrix.rows(np.arange(matrix.shape[0])).astype(np.float64)  # [sample, light, rgb]


def reduced_from(whole: np.ndarray, rows: np.ndarray) -> ReducedColumns:
    norms = np.linalg.norm(whole[rows], axis=2).T.astype(np.float32)  # [light, row]
    channels = np.linalg.norm(whole[rows], axis=0)
    return ReducedColumns(norms, np.linalg.norm(channels, axis=1), channels)


# -- elements ---------------------------------------------------------------------------------------------------------


def test_rows_columns_blocks_and_sums_are_the_same_matrix(matrix: Elements, whole: np.ndarray) -> None:
    rows, columns = np.array([5, 0, 77]), np.array([3, 250, 17, 4])
    assert np.array_equal(matrix.block(rows, columns), whole[np.ix_(rows, columns)])
    assert np.array_equal(matrix.columns(columns), whole[:, columns])
    weights = np.random.default_rng(0).random((4, 3)).astype(np.float32)
    expected = np.einsum("ijc,jc->ic", whole[:, columns], weights)
    assert matrix.sum_columns(columns, weights) == pytest.approx(expected, rel=1e-5, abs=1e-7)
    for each, column, weight in zip(matrix.each_column(columns, weights), columns, weights, strict=True):
        assert each == pytest.approx(whole[:, column] * weight, rel=1e-5, abs=1e-7)
    ids, twos = np.array([columns, columns[::-1]]), np.array([weights, weights[::-1]])
    own = (matrix.samples.ids % 2)[:, None]
    mixed = matrix.sum_columns(ids * [[1], [0]], twos)  # the second set is four times column 0
    others = whole[:, 0] * weights.sum(axis=0)
    assert mixed == pytest.approx(np.where(own, others, expected), rel=1e-5, abs=1e-7)
    squares = matrix.squared_differences(ids, twos, np.arange(len(whole)))
    some, share = matrix.samples.rows_of_pixels(40, np.random.default_rng(0))
    squares_of_some = matrix.squared_differences(ids, twos, some)
    signs = np.where(own, -1, 1)
    pixel = matrix.samples.ids // 4
    for k, (i, j) in enumerate(((0, 1), (2, 3))):
        apart = [
            (whole[:, columns[a]] * weights[a] - whole[:, columns[b]] * weights[b]) * signs
            for a, b in ((i, j), (3 - i, 3 - j))
        ]
        means = np.zeros((256, 3))
        np.add.at(means, pixel, np.where(own, -apart[1], apart[0]) / 4)
        assert squares[k] == pytest.approx((means**2).sum(), rel=1e-4)
        chosen = np.unique(pixel[some])
        assert squares_of_some[k] == pytest.approx((means[chosen] ** 2).sum(), rel=1e-4)
    assert (
        len(chosen) == 40
        and share == len(np.unique(pixel)) / 40
        and np.isin(pixel, chosen).sum() == len(some)
    )
    assert matrix.sum_of_rows(np.arange(10, 40)) == pytest.approx(whole[10:40].sum(axis=1), rel=1e-5)


def test_reduced_columns_are_norms_of_colours_projected(matrix: Elements, whole: np.ndarray) -> None:
    rows = matrix.samples.stratified_rows(40, 0)
    projection = np.random.default_rng(0).normal(size=(40, 5)).astype(np.float32)
    found, expected = matrix.reduce_columns(rows, projection), reduced_from(whole, rows)
    assert found.projected == pytest.approx(expected.projected @ projection, rel=1e-4, abs=1e-5)
    assert found.norms == pytest.approx(expected.norms, rel=1e-5)
    assert found.channel_norms == pytest.approx(expected.channel_norms, rel=1e-5)
    assert found.seen is not None
    assert found.seen.sums[0] == pytest.approx(whole[rows].sum(axis=1), rel=1e-5)


def test_reduced_columns_of_weighted_rows_by_parts_of_the_lights(matrix: Elements, whole: np.ndarray) -> None:
    rng = np.random.default_rng(0)
    rows, weights = rng.choice(len(whole), 40, replace=False), rng.uniform(0.1, 3, 40)
    parts = rng.choice([0, 1, 3], whole.shape[1])  # none of the third
    projection = rng.normal(size=(40, 5)).astype(np.float32)
    weighted = whole.copy()
    weighted[rows] *= weights[:, None, None]
    found = matrix.reduce_columns(rows, projection, weights=weights, parts=parts)
    expected = reduced_from(weighted, rows)
    assert found.projected == pytest.approx(expected.projected @ projection, rel=1e-4, abs=1e-5)
    assert found.norms == pytest.approx(expected.norms, rel=1e-5)
    assert found.seen is not None and np.array_equal(found.seen.weights, weights)
    for part in range(4):
        own = found.of_part(part).seen
        assert own is not None
        assert own.sums[0] == pytest.approx(weighted[rows][:, parts == part].sum(axis=1), rel=1e-5, abs=1e-9)


@pytest.mark.parametrize("method", ["adaptive", "hasan2007"])
def test_the_image_is_the_same_in_any_block_size(small_room: mi.Scene, method: str, monkeypatch) -> None:
    images = []
    for lanes in (1 << 23, 5000, 20000):
        monkeypatch.setattr(elements_module, "LANES", lanes)
        images.append(prt.render_many_lights(small_room, method=method, seed=3, **SMALL).image)
    assert np.array_equal(images[0], images[1]) and np.array_equal(images[0], images[2])
    other = prt.render_many_lights(small_room, method=method, seed=4, **SMALL).image
    assert not np.array_equal(images[0], other)


def test_stratified_rows_lie_in_blocks_of_the_image(matrix: Elements) -> None:
    rows = matrix.samples.stratified_rows(30, 5)
    assert len(set(rows)) == 30
    pixel = matrix.samples.ids[rows] // matrix.samples.spp
    assert (
        len(np.unique(np.stack(np.divmod(pixel, 16)) // 4, axis=1).T) >= 10
    )  # of 16 blocks, some without rows
    every = matrix.samples.stratified_rows(10**6, 5)
    assert sorted(every) == list(range(len(matrix.samples)))


# -- estimates --------------------------------------------------------------------------------------------------------


def estimates(whole: np.ndarray, draw, count: int) -> np.ndarray:
    """Means over samples (count, 3) of estimates of all columns."""
    columns = whole.mean(axis=0)  # [light, rgb]
    found = np.zeros((count, 3))
    for k in range(count):
        chosen = draw(k)
        found[k] = (columns[chosen.ids] * chosen.weights).sum(axis=0)
    return found


def deviation(found: np.ndarray, whole: np.ndarray) -> tuple[float, float]:
    """Relative deviation of the mean of estimates, and its standard error; of the sum of the channels."""
    truth = whole.mean(axis=0).sum()
    sums = found.sum(axis=1)
    return sums.mean() / truth - 1, sums.std() / np.sqrt(len(sums)) / truth


@pytest.mark.parametrize("fixed", [True, False])
def test_the_mean_of_estimates_is_the_sum_of_all_columns(whole: np.ndarray, fixed: bool) -> None:
    """The defensive estimate is unbiased, with the same rows and with new ones.

    Rationale: six rows see only a part of the lights; representatives that were drawn without the others, or scaled by
    other weights than they were drawn by, would give a mean that is off by what those columns hold.
    Expected: within four standard errors of 1000 estimates, and these small enough to see a bias of 1%; some columns
    are seen by no row.
    """
    rng, flux = np.random.default_rng(0), np.ones(whole.shape[1])
    partitions: list[Partition] = []

    def draw(k: int):
        if not fixed or not partitions:
            rows = rng.choice(len(whole), 6, replace=False)
            reduced = reduced_from(whole, rows)
            assert not fixed or (reduced.norms == 0).any()
            partitions.append(defensive_partition(reduced, flux, 40, rng))
        sets = draw_representatives(partitions[-1], 3, rng)
        return Representatives(sets.ids[k % 3], sets.weights[k % 3])

    bias, error = deviation(estimates(whole, draw, 1000), whole)
    assert error < 0.003 and abs(bias) < 4 * error, (bias, error)


def test_what_rows_do_not_see_is_missing_in_the_published_estimate(whole: np.ndarray) -> None:
    """The paper ignores columns that no row sees, and gives representatives their cluster's colour: it is biased.

    Expected: with two rows, the mean of 1000 estimates is more than five standard errors off the sum of all columns.
    """
    rng = np.random.default_rng(0)
    reduced = reduced_from(whole, rng.choice(len(whole), 2, replace=False))
    partition = published_partition(reduced, 40, rng)
    bias, error = deviation(
        estimates(
            whole, lambda k: draw_coloured_representatives(partition, reduced.channel_norms, rng), 1000
        ),
        whole,
    )
    print(f"published: {bias:.2%} +- {error:.2%}")
    assert abs(bias) > 5 * error


def test_a_representative_without_a_channel_keeps_its_scale() -> None:
    channel_norms = np.array([[1.0, 0, 0], [0, 2.0, 0], [0, 0, 3.0]])
    partition = Partition([np.arange(3)], np.array([1.0, 2.0, 3.0]), np.zeros(1))
    for seed in range(9):
        chosen = draw_coloured_representatives(partition, channel_norms, np.random.default_rng(seed))
        scale = 6 / partition.drawing[chosen.ids[0]]
        expected = np.full(3, scale)
        expected[chosen.ids[0]] = 1.0
        assert chosen.weights[0] == pytest.approx(expected)


def test_sets_of_representatives_are_apart() -> None:
    """A cluster of equal weights: each set has a light of another quarter of it, in any order, each light as often."""
    partition = Partition([np.arange(8), np.array([8])], np.ones(9), np.zeros(2))
    found = [draw_representatives(partition, 4, np.random.default_rng(seed)) for seed in range(400)]
    first = np.array([chosen.ids[:, 0] for chosen in found])  # [seed, set]
    assert np.array_equal(np.sort(first // 2, axis=1), np.tile(np.arange(4), (400, 1)))
    often = np.array([np.bincount(first[:, k], minlength=8) for k in range(4)]) / 400
    assert often == pytest.approx(np.full((4, 8), 1 / 8), abs=4 * np.sqrt(7 / 64 / 400))
    assert all((chosen.ids[:, 1] == 8).all() for chosen in found)
    assert found[0].weights == pytest.approx(np.tile([[[8.0], [1.0]]], (4, 1, 3)))


@pytest.mark.parametrize(
    ("sets", "pixels"), [(1, 1024), pytest.param(4, 1024, marks=pytest.mark.slow), (4, 64)]
)
def test_the_predicted_error_is_that_of_the_image(
    matrix: Elements, whole: np.ndarray, sets: int, pixels: int, monkeypatch
) -> None:
    """Second representatives tell the expected error, over 200 estimates of one partition, whose mean is the truth.

    Rationale: that error is the sum of the variances of all clusters; half of them are measured, at all pixels or at
    some, drawn by cost and energy, and count by the inverse of their chance.
    Expected: root mean squares of predicted and true errors of pixels within 15%; both vary by few percent over so many
    seeds. The mean of the estimates is within four standard errors. Four sets have at most 0.7 times the error of one.
    """
    monkeypatch.setattr(estimate_module, "FEWEST_PIXELS", pixels)
    true, sums, every = {}, np.zeros(200), np.arange(len(whole))
    for count in {1, sets}:
        predicted, true[count] = np.zeros(200), np.zeros(200)
        for k, found in enumerate(estimates_with_error(matrix, whole, count)):
            off = found.values - whole.sum(axis=1)
            predicted[k] = found.squared_error
            true[count][k] = (matrix.samples.pixel_means(off.T, every) ** 2).sum()
            sums[k] = found.values.sum()
        assert abs(sums.mean() - whole.sum()) < 4 * sums.std() / np.sqrt(200) < 0.02 * whole.sum()
        assert np.sqrt(predicted.mean() / true[count].mean()) == pytest.approx(1, abs=0.15)
    if sets > 1:
        assert np.sqrt(true[sets].mean() / true[1].mean()) < 0.7


def estimates_with_error(matrix: Elements, whole: np.ndarray, sets: int) -> Iterator[Estimate]:
    """200 of one partition, of a matrix that is known."""
    columns, own = whole.astype(np.float32), matrix.samples.ids % sets
    reduced = reduced_from(whole, np.random.default_rng(1).choice(len(whole), 20, replace=False))
    partition = defensive_partition(reduced, np.ones(whole.shape[1]), 30, np.random.default_rng(1))

    def each(ids, weights):
        for k in range(ids.shape[1]):
            yield columns[np.arange(len(columns)), ids[own, k]] * weights[own, k]

    def sum_columns(ids, weights, done):
        return sum(each(ids, weights), np.zeros_like(columns[:, 0]))

    def squared_differences(ids, weights, rows):
        every = np.array(list(each(ids, weights)))[:, rows]
        apart = [matrix.samples.pixel_means(pair.T, rows) for pair in every[::2] - every[1::2]]
        return np.array([(pixels**2).sum() for pixels in apart])

    twin = SimpleNamespace(
        sum_columns=sum_columns, squared_differences=squared_differences, samples=matrix.samples
    )
    for k in range(200):
        yield sum_with_error(twin, partition, sets, np.random.default_rng(k))


@pytest.mark.slow  # more exactly than above
def test_the_predicted_error_has_no_bias(monkeypatch) -> None:
    """Of a random matrix, at half of its pixels: the mean of 4000 predictions is what all choices give.

    Expected: within four standard errors, which are below 2% together.
    """
    monkeypatch.setattr(estimate_module, "FEWEST_PIXELS", 16)
    rng = np.random.default_rng(0)
    columns, drawing = rng.uniform(0.5, 1.5, (32, 60, 3)), rng.uniform(0.8, 1.2, 60)
    partition = Partition(list(np.arange(60).reshape(20, 3)), drawing, np.ones(20))
    exact = 0.0
    for own in partition.clusters:
        share = drawing[own] / drawing[own].sum()
        exact += (np.square(columns[:, own]).sum(axis=(0, 2)) / share).sum()
        exact -= np.square(columns[:, own].sum(axis=1)).sum()
    samples = SimpleNamespace(shape=(4, 8), spp=1, ids=np.arange(32))
    samples.rows_of_pixels = lambda count, rng: Samples.rows_of_pixels(samples, count, rng)

    def squared_differences(ids, weights, rows):
        values = columns[rows][:, ids[0]] * weights[0]
        return np.square(values[:, ::2] - values[:, 1::2]).sum(axis=(0, 2))

    twin = SimpleNamespace(sum_columns=lambda *_: 0, squared_differences=squared_differences, samples=samples)
    found = [sum_with_error(twin, partition, 1, rng).squared_error for _ in range(4000)]
    error = np.std(found) / np.sqrt(len(found))
    assert abs(np.mean(found) - exact) < 4 * error < 0.02 * exact


def test_power_sampling_is_unbiased(whole: np.ndarray) -> None:
    flux, rng = np.random.default_rng(0).random(whole.shape[1]) + 0.1, np.random.default_rng(1)
    bias, error = deviation(estimates(whole, lambda k: draw_by_power(flux, 40, rng), 1000), whole)
    assert abs(bias) < 4 * error < 0.04


def test_with_as_many_clusters_as_lights_nothing_is_lost(matrix: Elements, whole: np.ndarray) -> None:
    rows = matrix.samples.stratified_rows(8, 0)
    partition = defensive_partition(
        reduced_from(whole, rows), matrix.lights.flux, 10 * whole.shape[1], np.random.default_rng(0)
    )
    found = sum_with_error(matrix, partition, 4, np.random.default_rng(1))
    assert len(partition) <= whole.shape[1]
    every = [len(own) for own in partition.clusters]
    if max(every) == 1:
        assert found.values == pytest.approx(whole.sum(axis=1), rel=1e-4) and found.squared_error == 0


# -- baselines --------------------------------------------------------------------------------------------------------


def test_all_lights_go_on_after_an_interruption(matrix: Elements, whole: np.ndarray, tmp_path) -> None:
    expected = whole.sum(axis=1)
    assert all_lights(matrix, Run(), np.arange(len(whole)), tmp_path) == pytest.approx(expected, rel=1e-5)
    before = matrix.evaluated
    assert all_lights(matrix, Run(), np.arange(len(whole)), tmp_path) == pytest.approx(expected, rel=1e-5)
    assert matrix.evaluated - before <= 64 * 64  # what the name is made of
    other = instant_radiosity(matrix, 300, LightOptions(max_depth=3, seed=9))
    assert other.mean() == pytest.approx(expected.mean(), rel=0.1)


@pytest.mark.parametrize("pixels", [60, 150])
def test_errors_at_some_pixels_are_those_of_the_image(
    small_room: mi.Scene, matrix: Elements, whole: np.ndarray, tmp_path, pixels: int
) -> None:
    """Expected: errors of pictures that are off by noise and by a factor, within 3 standard errors."""
    settings = Settings(lights=300, max_depth=3)
    some, every = (Reference(matrix, Run(), tmp_path, count) for count in (pixels, 10**6))
    assert every.is_whole and not some.is_whole and len(some.pixels) == pixels
    truth, rng = every.values(settings), np.random.default_rng(0)
    assert truth == pytest.approx(whole.sum(axis=1), rel=1e-5) and every.error(truth) == (0, 0)
    image = matrix.samples.image(truth)
    assert every.radiance.reshape(image.shape) == pytest.approx(image, rel=1e-4)  # its filter is a box
    for values in (
        truth * np.float32([1.03, 1, 0.98]),
        truth * rng.uniform(0.5, 1.5, truth.shape).astype(np.float32),
    ):
        error, uncertainty = some.error(values)
        expected = np.linalg.norm(matrix.samples.image(values) - image) / np.linalg.norm(image)
        assert every.error(values)[0] == pytest.approx(expected, rel=1e-3)
        assert 0 < uncertainty < 0.25 * expected and abs(error - expected) < 3 * uncertainty
    assert some.square() == pytest.approx(every.square(), rel=0.3)
    assert some.error(some.values(settings))[0] < 0.01


# -- lights -----------------------------------------------------------------------------------------------------------


def lights_of(max_depth: int = 2, count: int = 1000, **emitters: object):
    scene = mi.load_dict({"type": "scene", "floor": FLOOR, **emitters})
    return scene_lights(scene, LightOptions(count, max_depth=max_depth))


def test_lights_have_the_power_of_their_emitters() -> None:
    """Each kind beside its formula; of stratified samples, the sum is exact where radiance is even."""
    area = lights_of(lamp=LAMP)
    assert area.arrays.power.numpy().sum(axis=1) == pytest.approx(np.array([6, 5, 4]) * 1.0, rel=1e-4)
    assert area.flux.sum() == pytest.approx(np.pi * 5, rel=1e-4)
    sky = lights_of(sky={"type": "constant", "radiance": 0.5})
    assert sky.arrays.power.numpy().sum(axis=1) == pytest.approx(np.full(3, 4 * np.pi * 0.5), rel=1e-4)
    point = lights_of(point={"type": "point", "position": [0, 1, 0], "intensity": 2.0})
    assert len(point) == 1 and point.flux[0] == pytest.approx(8 * np.pi, rel=1e-3)
    sun = lights_of(sun={"type": "directional", "direction": [0, -1, 0], "irradiance": 3.0})
    assert len(sun) == 1 and sun.arrays.power.numpy().ravel() == pytest.approx(3)


def test_a_sun_is_one_light() -> None:
    found = lights_of(sky={"type": "sunsky", "to_world": T().rotate([1, 0, 0], -90)})
    power = np.sort(found.arrays.power.numpy().sum(axis=0))
    assert 900 < len(found) < 1100 and power[-1] > 100 * power[-2]


def test_lights_are_grouped_by_emitter_and_limited_by_depth() -> None:
    point = {"type": "point", "position": [0, 1, 0], "intensity": 2.0}
    found = lights_of(4, 2000, lamp=LAMP, point=point, wall={**FLOOR, "to_world": T().translate([0, 1, -2])})
    counts = found.counts()
    assert set(counts) == {"lamp", "point"} and counts["point"]["direct"] == 1
    assert min(own["indirect"] for own in counts.values()) > 100
    assert 1800 < len(found) < 2200 and set(found.arrays.depth.numpy()) == {2, 3, 4}


def test_what_a_floor_reflects_is_its_albedo_times_what_lands() -> None:
    """Flux of lights on a floor under a point in the middle of a half space: half of its power lands, or nearly.

    Expected: albedo times the share of the sphere that the floor covers, within four standard errors.
    """
    point = {"type": "point", "position": [0, 0.2, 0], "intensity": 1.0}
    found = lights_of(3, 40_000, point=point)
    indirect = found.arrays.depth.numpy() == 3
    grid = np.linspace(-2, 2, 801)
    x, z = np.meshgrid((grid[1:] + grid[:-1]) / 2, (grid[1:] + grid[:-1]) / 2)
    solid_angle = (0.2 / (x**2 + z**2 + 0.04) ** 1.5).sum() * (4 / 800) ** 2
    n = indirect.sum()
    error = np.sqrt((1 - solid_angle / (4 * np.pi)) / n)
    assert found.flux[indirect].sum() == pytest.approx(solid_angle * 0.5, rel=4 * error)


# -- what is refused, and what is dark -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("things", "message"),
    [
        ({"l": {"type": "rectangle", "emitter": {"type": "directionalarea"}}}, "DirectionalArea"),
        ({"fog": {"type": "cube", "interior": {"type": "homogeneous"}, "b": {"type": "null"}}}, "medium"),
    ],
)
def test_unknown_lights_and_media_are_refused(things: dict, message: str) -> None:
    with pytest.raises(prt.PrtError, match=message):
        prt.render_many_lights(room(**things), **SMALL)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"rows": 0}, "rows is 0"),
        ({"columns": -1}, "columns is -1"),
        ({"seconds": 0.0}, "seconds"),
        ({"method": "best"}, "method 'best'"),
        ({"lights": 0}, "0 lights"),
        ({"max_depth": 1}, "max_depth is 1"),
        ({"clamp": 0.0}, "clamp"),
        ({"sensor": 3}, "no sensor 3"),
        ({"spp": 0}, "spp is 0"),
        ({"samples": 4}, "samples"),
    ],
)
def test_numbers_that_make_no_sense_are_refused(small_room: mi.Scene, settings: dict, message: str) -> None:
    with pytest.raises(prt.PrtError, match=message):
        prt.render_many_lights(small_room, **settings)


def test_a_bsdf_that_is_not_finite_is_named_with_shape_and_light(small_room: mi.Scene) -> None:
    bad = mi.load_dict(diffuse(0.5, 0.5, 0.5))
    parameters = mi.traverse(bad)
    parameters["reflectance.value"] = mi.Color3f(float("nan"))
    scene = room(ball={"type": "sphere", "center": [0, 0.7, 0], "radius": 0.7, "bsdf": bad})
    with pytest.raises(prt.PrtError, match=r"shape 'ball' .*light \d+ of emitter 'lamp'"):
        prt.render_many_lights(scene, **{**SMALL, "max_depth": 2})


@pytest.mark.parametrize("method", ["adaptive", "hasan2007"])
def test_scenes_with_little_in_them_have_images(small_room: mi.Scene, method: str) -> None:
    """No light, nothing seen, an environment alone, a lamp behind a wall, a lamp of 1e-6 of the power of another."""
    weak = {**LAMP, "emitter": {"type": "area", "radiance": 6e-6}}
    wall = {**LAMP, "to_world": T().translate([0, 2.4, 0]).rotate([1, 0, 0], -90).scale(3)}
    wall["bsdf"] = wall.pop("emitter") and diffuse(0.5, 0.5, 0.5)
    sky = {"type": "constant", "radiance": 0.25}
    for scene, mean in (
        (room(lamp=None), 0.0),
        (mi.load_dict({"type": "scene", "sensor": camera(), "sky": sky}), 0.25),
        (room(wall={**wall, "bsdf": {"type": "twosided", "bsdf": wall["bsdf"]}}), None),
        (room(weak={**weak, "to_world": T().translate([1, 2, 0]).rotate([1, 0, 0], 90)}), None),
    ):
        found = prt.render_many_lights(scene, method=method, **SMALL)
        assert np.isfinite(found.image).all() and found.image.shape == (16, 16, 3)
        assert mean is None or found.image.mean() == pytest.approx(mean)
        json.dumps(found.report)


@pytest.mark.parametrize(("rows", "columns"), [(1, 1), (1, 50), (50, 1), (10**6, 10**6)])
def test_any_number_of_rows_and_columns_has_an_image(
    small_room, matrix, whole, rows: int, columns: int
) -> None:
    asked = {**SMALL, "rows": rows, "columns": columns}
    for method in ("adaptive", "hasan2007"):
        found = prt.render_many_lights(small_room, method=method, **asked)
        assert np.isfinite(found.image).all()
    if columns == 10**6:
        exact = matrix.samples.image(whole.sum(axis=1).astype(np.float32))
        assert found.image == pytest.approx(exact, rel=1e-3, abs=1e-5)


# -- what comes out ---------------------------------------------------------------------------------------------------


def test_a_crop_is_a_part_of_the_picture() -> None:
    """The sky alone, through a film and a crop of it: the same directions, other samples.

    Expected: within 2% on average.
    """
    sky = {
        "type": "envmap",
        "bitmap": mi.Bitmap(np.random.default_rng(0).random((8, 16, 3)).astype(np.float32)),
    }
    whole, part = (
        mi.load_dict({"type": "scene", "sky": sky, "sensor": camera(24, **film)})
        for film in ({}, {"crop_width": 10, "crop_height": 8, "crop_offset_x": 3, "crop_offset_y": 12})
    )
    images = [prt.render_many_lights(scene, spp=16, **SMALL).image for scene in (whole, part)]
    assert images[1].shape == (8, 10, 3)
    assert images[1] == pytest.approx(images[0][12:20, 3:13], abs=0.02)


@pytest.mark.parametrize("pixel_format", ["rgb", "rgba", "luminance"])
def test_the_integrator_fills_films_of_any_format(pixel_format: str) -> None:
    scene = mi.load_dict(
        {
            "type": "scene",
            "floor": FLOOR,
            "lamp": LAMP,
            "sensor": camera(pixel_format=pixel_format, crop_width=10, crop_height=12),
            "integrator": {"type": "row_column", "rows": 12, "columns": 20, "lights": 300, "max_depth": 3},
        }
    )
    image = np.array(mi.render(scene, spp=4))
    found = prt.render_many_lights(scene, **SMALL)
    expected = {
        "rgb": found.image,
        "rgba": np.dstack([found.image, found.alpha]),
        "luminance": np.array(mi.luminance(mi.Color3f(found.image.reshape(-1, 3).T))).reshape(12, 10, 1),
    }[pixel_format]
    assert image == pytest.approx(expected, abs=1e-5)


def test_the_integrator_complains_when_it_is_made() -> None:
    with pytest.raises(Exception, match="rows is -1"):
        mi.load_dict({"type": "row_column", "rows": -1})


def test_the_integrator_refuses_to_be_inside_of_another(small_room: mi.Scene) -> None:
    around = {"type": "aov", "aovs": "d:depth", "inner": {"type": "row_column", "lights": 100}}
    with pytest.raises(RuntimeError) as caught:
        mi.render(small_room, integrator=mi.load_dict(around), spp=1)
    assert "row_column makes whole pictures" in f"{caught.value} {caught.value.__cause__}"


@pytest.mark.filterwarnings("ignore::mi_sparse_prt.PrtWarning")
def test_scenes_come_as_files_and_as_this_package_loads_them() -> None:
    """Expected: the same image of the same file; of shapes as this package has them within 10%, by other samples."""
    path, asked = str(ZOO / "emitter_point.xml"), {**SMALL, "rows": 60, "columns": 300}
    first, again = (mi.load_file(path, optimize=False) for _ in range(2))
    image = prt.render_many_lights(first, **asked).image
    assert np.array_equal(image, prt.render_many_lights(again, **asked).image)
    assert np.array_equal(image, prt.render_many_lights(path, **asked).image)
    other = prt.render_many_lights(prt.load_scene(path, float("inf")), **asked).image
    assert other.mean() == pytest.approx(image.mean(), rel=0.1)


def test_a_time_budget_chooses_rows_and_columns(small_room: mi.Scene) -> None:
    early = []
    found = prt.render_many_lights(
        small_room, seconds=0.5, lights=300, max_depth=3, preview=lambda image: early.append(image)
    )
    assert found.report["rows"] >= 16 and found.report["columns"] >= 48
    assert len(early) == 1 and early[0].shape == found.image.shape
    assert found.report["seconds"]["total"] < 5


@pytest.mark.parametrize(("lights", "columns"), [(100, 50), (3000, 150)])
def test_rows_that_are_cheap_are_many(small_room: mi.Scene, lights: int, columns: int) -> None:
    """
    Rationale: a row has an element of each light, a column one of each sample, of which there are 509.
    Expected: 50 rows first; of few lights, as many columns, of many, three for each row.
    """
    found = prt.render_many_lights(small_room, error=1e-9, seconds=1e-6, lights=lights, max_depth=2)
    (tried,) = found.report["tries"]
    assert (tried["rows"], tried["columns"]) == (50, columns)


@pytest.mark.parametrize("method", ["adaptive", "hasan2007"])
def test_layers_of_emitters_add_up_to_the_image(method: str) -> None:
    """A room with a lamp, a point and a sky: a layer for each, with what is seen of it.

    Rationale: no cluster has lights of two emitters, so that a layer is what its emitter alone would give.
    Expected: the sum of the layers is the image; with all columns, the layer of the point is the image of a room that
    has no other light, within 2% (particles are others).
    """
    point = {"type": "point", "position": [1, 2, 1], "intensity": 3.0}
    sky = {"type": "constant", "radiance": 0.1}
    scene = room(point=point, sky=sky)
    asked = {**SMALL, "lights": 1500, "columns": 10**6, "rows": 40}
    found = prt.render_many_lights(scene, method=method, groups=True, **asked)
    assert set(found.layers) == {"lamp", "point", "sky"}
    assert sum(found.layers.values()) == pytest.approx(found.image, abs=1e-5)
    alone = prt.render_many_lights(room(lamp=None, point=point), method=method, **asked)
    assert found.layers["point"].mean() == pytest.approx(alone.image.mean(), rel=0.02)
    assert not prt.render_many_lights(scene, method=method, **SMALL).layers


def test_what_is_seen_of_each_emitter_adds_up(matrix: Elements) -> None:
    """Two lamps and a sky, seen at once, through glass and in a coat; a point that nobody sees."""
    glass = {"type": "sphere", "center": [0.8, 0.6, 1], "radius": 0.5, "bsdf": {"type": "dielectric"}}
    coated = FLOOR | {"bsdf": {"type": "plastic"}}
    lamp, other = (LAMP | {"to_world": T().translate([x, 1, -0.5]).scale(0.3)} for x in (-0.9, 0.9))
    more = {"sky": {"type": "constant", "radiance": 0.1}, "point": {"type": "point", "position": [1, 2, 1]}}
    scene = room(glass=glass, floor=coated, lamp=lamp, other=other, **more)
    samples = Samples(scene, Surfaces(scene), scene.sensors()[0], 4, 5, 0, apart=True)
    names = [emitter.class_name() for emitter in scene.emitters()]
    assert sorted(names[k] for k in samples.seen_of) == [
        "AreaLight",
        "AreaLight",
        "ConstantBackgroundEmitter",
    ]
    assert sum(samples.seen_of.values()) == pytest.approx(samples.seen, abs=1e-5)
    assert not matrix.samples.seen_of


# -- rows and columns by the error ------------------------------------------------------------------------------------


def test_rows_and_columns_grow_until_the_error_is_small(small_room: mi.Scene) -> None:
    """Expected: no try but the last tells an error that is small enough; the last one's is reported, and about true."""
    settings = {"lights": 2000, "max_depth": 3, "seed": 3}
    found = prt.render_many_lights(small_room, error=0.02, **settings)
    tries = found.report["tries"]
    assert [t["estimated_error"] <= 0.02 for t in tries] == [False] * (len(tries) - 1) + [True]
    assert all(
        a["rows"] < b["rows"] and a["columns"] < b["columns"] for a, b in zip(tries, tries[1:], strict=False)
    )
    assert found.report["estimated_error"] == pytest.approx(tries[-1]["estimated_error"])
    assert (found.report["rows"], found.report["columns"]) == (tries[-1]["rows"], tries[-1]["columns"])
    exact = prt.render_many_lights(small_room, rows=20, columns=2000, **settings).image
    assert np.linalg.norm(found.image - exact) < 0.06 * np.linalg.norm(exact)


def test_an_error_that_is_out_of_reach(small_room: mi.Scene) -> None:
    """Expected: all lights, and no error; or what fits into a time, of which the first try takes the rest."""
    every = prt.render_many_lights(small_room, error=1e-9, lights=300, max_depth=3)
    assert every.report["estimated_error"] < 1e-9 and len(every.report["tries"]) > 1
    short = prt.render_many_lights(small_room, error=1e-9, seconds=1e-6, lights=2000, max_depth=3)
    assert len(short.report["tries"]) == 1 and short.report["estimated_error"] > 1e-9


@pytest.mark.parametrize(
    "options, message",
    [
        ({"error": 0}, "error is 0: give a number above 0"),
        ({"method": "hasan2007"}, "does not know its error"),
    ],
)
def test_errors_that_make_no_sense(small_room: mi.Scene, options: dict, message: str) -> None:
    with pytest.raises(prt.PrtError, match=message):
        prt.render_many_lights(small_room, **{"error": 0.1, **options})
