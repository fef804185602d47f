"""Light that moves: wavelets chosen, sums that follow them; each method beside a slow and obvious one."""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

import mi_sparse_prt as prt
from mi_sparse_prt.compression.haar_truncation import haar_lists
from mi_sparse_prt.core.metrics import relative_l2
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.emission.haar import haar, haar_bands, haar_colours, haar_columns
from mi_sparse_prt.operators.clustered import Clustered
from mi_sparse_prt.operators.dense import Dense
from mi_sparse_prt.relighting.approximations import (
    Everything,
    Incremental,
    NonIncremental,
    PerBand,
    wavelet_bands,
    weighted_error,
)
from mi_sparse_prt.relighting.clusters import cluster_columns
from mi_sparse_prt.relighting.columns import wavelet_columns
from mi_sparse_prt.relighting.players import ClusteredPlayer, ColumnsPlayer, ProductPlayer, player
from mi_sparse_prt.relighting.sequences import moving_disc

LIGHTING = CubemapLighting(4)
M = LIGHTING.n_directions
SCALE = np.sqrt(LIGHTING.solid_angles)[:, None]
ALL = 99  # basis vectors of each cluster in a frame, more than there are
METHODS = {
    "nwa": NonIncremental,
    "bi": Incremental,
    "pbi": PerBand,
    "pbi_simple": lambda bands: PerBand(bands, exhaustive=False),
    "all": Everything,
}


def random_light(rng, m=M):
    """Coefficients that fall off, of both signs."""
    return (rng.normal(size=(m, 3)) * np.exp(-4 * rng.random((m, 1)))).astype(np.float32)


def wavelets_of(texels):
    return haar_colours((texels * SCALE).astype(np.float32))


def clustered(rng, rows=70, clusters=5, bases=6, channels=1, lighting=LIGHTING):
    m = lighting.n_directions
    return Clustered(
        rng.integers(0, clusters, rows).astype(np.uint16),
        rng.normal(size=(rows, channels, bases)).astype(np.float16),
        rng.random((clusters, m)).astype(np.float16),
        rng.normal(size=(clusters, bases, m)).astype(np.float16),
        lighting,
    )


def haar_rows(rng, rows=70, channels=1, lighting=LIGHTING, target=1e-3):
    dense = Dense(rng.random((rows, lighting.n_directions, channels)).astype(np.float32) ** 6)
    return haar_lists(dense, np.arange(rows), lighting, target)


@pytest.mark.parametrize("n", [1, 2, 8, 32])
def test_compiled_transform_is_that_of_the_library(n):
    values = np.random.default_rng(n).normal(size=(6 * n * n, 3)).astype(np.float32)
    assert_allclose(haar_colours(values), haar(values.T).T, atol=1e-5)


def test_bands_are_those_of_the_paper():
    number, sides = haar_bands(64)
    assert_array_equal(np.bincount(number), [24, 72, 288, 1152, 4608, 18432])  # [OBRG06] 5.1
    assert [set(sides[number == b]) for b in range(6)] == [{64}, {32}, {16}, {8}, {4}, {2}]


# --- approximations


def slow_update(name, applied, light, bands, budget):
    """L~ after a frame, by loops over all coefficients and all combinations of bands."""
    size = bands.weights * np.linalg.norm(light, axis=1)
    difference = bands.weights * np.linalg.norm(light - applied, axis=1)

    def after(resets):
        key = np.where(resets[bands.number], size, difference)
        new = np.where(resets[bands.number][:, None], 0, applied).astype(np.float32)
        for j in sorted(range(len(key)), key=lambda j: -key[j])[:budget]:
            new[j] = light[j]
        left = (bands.weights * np.linalg.norm(light - new, axis=1)).sum(dtype=np.float64)
        return left, new

    count = bands.count
    if name == "nwa":
        return after(np.ones(count, bool))[1]
    if name == "bi":
        return after(np.zeros(count, bool))[1]
    if name == "pbi_simple":
        sums = [
            [x[bands.number == b].sum(dtype=np.float64) for b in range(count)] for x in (size, difference)
        ]
        return after(np.array(sums[1]) > np.array(sums[0]))[1]
    return min(
        (after(np.array(c, bool)) for c in itertools.product((False, True), repeat=count)), key=lambda x: x[0]
    )[1]


@pytest.mark.parametrize("name", ["nwa", "bi", "pbi_simple", "pbi"])
@pytest.mark.parametrize("budget", [1, 7, 30])
def test_each_choice_is_that_of_loops(name, budget):
    rng = np.random.default_rng(budget)
    bands = wavelet_bands(4)
    method, light, applied = METHODS[name](bands), random_light(rng), np.zeros((M, 3), np.float32)
    method.update(light, None)
    applied = light.copy()
    for frame in range(12):
        light = random_light(rng) if frame % 4 == 3 else light + 0.2 * random_light(rng)
        applied = slow_update(name, applied, light, bands, budget)
        method.update(light, budget)
        assert_array_equal(method.applied, applied)


def test_bands_that_jump_start_anew_and_others_do_not():
    bands, rng = wavelet_bands(4), np.random.default_rng(0)
    for exhaustive in (False, True):
        method, light = PerBand(bands, exhaustive), random_light(rng)
        method.update(light, None)
        changed = light.copy()
        changed[bands.number == 1] *= -1  # farther from what was applied than from 0
        update = method.update(changed, 12)
        assert_array_equal(update.resets, [False, True])
        assert_array_equal(method.resets, update.resets)


@pytest.mark.parametrize("name", METHODS)
def test_a_light_that_stands_still_is_reached_and_stays(name):
    rng = np.random.default_rng(3)
    method, light = METHODS[name](wavelet_bands(4)), random_light(rng)
    method.update(random_light(rng), None)
    for _ in range(M // 10 + 1):
        method.update(light, 10)
    if name == "nwa":  # which never gets nearer ([OBRG06] 3)
        assert np.count_nonzero(method.applied.any(axis=1)) == 10
        return
    assert_array_equal(method.applied, light)
    update = method.update(light, 10)
    assert len(update.coefficients) == 0 and not update.resets.any()


@pytest.mark.parametrize("name", ["bi", "pbi"])
def test_a_lamp_that_moves_is_exact_after_a_frame(name):
    """As long as no more wavelets change than the budget allows ([OBRG06] 3)."""
    lighting = CubemapLighting(16)
    scale = np.sqrt(lighting.solid_angles)
    method = METHODS[name](wavelet_bands(16))
    frames = [haar_colours(x, scale) for x in moving_disc(lighting, degrees=(4, 6), frames=12)]
    method.update(frames[0], None)
    for before, light in itertools.pairwise(frames):
        changed = np.count_nonzero((light != before).any(axis=1))
        assert 0 < changed < 200
        method.update(light, changed)
        assert_array_equal(method.applied, light)


def test_columns_are_transformed_like_rows():
    values = np.random.default_rng(6).normal(size=(6 * 64, 7)).astype(np.float32)
    assert_allclose(haar_columns(values), haar(values.T).T, atol=1e-5)


def test_error_is_a_share_of_the_light():
    bands = wavelet_bands(4)
    method, light = NonIncremental(bands), random_light(np.random.default_rng(5))
    assert weighted_error(method.applied, light, method.bands) == 1
    method.update(light, 20)
    sizes = np.sort(bands.weights * np.linalg.norm(light, axis=1))
    assert_allclose(
        weighted_error(method.applied, light, method.bands), sizes[:-20].sum() / sizes.sum(), rtol=1e-5
    )


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("name", METHODS)
def test_a_frame_that_is_not_finite_is_left_out(name, bad):
    method, light = METHODS[name](wavelet_bands(4)), random_light(np.random.default_rng(4))
    method.update(light, 12)
    before, wrong = method.applied.copy(), light.copy()
    wrong[17, 1] = bad
    with pytest.raises(prt.PrtError, match="NaN or infinite"):
        method.update(wrong, 12)
    assert_array_equal(method.applied, before)


def test_wrong_arguments_are_refused():
    method = PerBand(wavelet_bands(4))
    with pytest.raises(prt.PrtError, match="shape"):
        method.update(np.zeros((6 * 64, 3), np.float32), 3)
    with pytest.raises(prt.PrtError, match="budget"):
        method.update(np.zeros((M, 3), np.float32), -1)


# --- players


def operators(rng):
    return {
        "columns": haar_rows(rng),
        "columns_rgb": haar_rows(rng, channels=3),
        "clustered": clustered(rng),
        "clustered_rgb": clustered(rng, channels=3),
        "product": Dense(rng.random((40, M, 1)).astype(np.float32)),
    }


@pytest.mark.parametrize("kind", ["columns", "columns_rgb", "clustered", "clustered_rgb", "product"])
@pytest.mark.parametrize("name", METHODS)
def test_rows_show_what_was_applied(kind, name):
    rng = np.random.default_rng(7)
    operator, method = operators(rng)[kind], METHODS[name](wavelet_bands(4))
    playing = player(operator, LIGHTING, method.groups, ALL)
    for frame in range(20):
        light = wavelets_of(rng.random((M, 3)) ** 8 if frame % 5 == 0 else rng.random((M, 3)))
        playing.apply(method.update(light, None if frame in (0, 11) else 9))
        texels = haar_inverse(method.applied)
        assert relative_l2(playing.incident, operator.relight(texels)) < 2e-6
    playing.reset()
    method.reset()
    playing.apply(method.update(light, None))
    assert relative_l2(playing.incident, operator.relight(haar_inverse(light))) < 2e-6


def haar_inverse(coefficients):
    from mi_sparse_prt.emission.haar import inverse_haar

    return np.ascontiguousarray(inverse_haar(coefficients.T).T / SCALE, np.float32)


@settings(max_examples=25, deadline=None)
@given(
    st.integers(0, 10**6),
    st.integers(1, 30),
    st.integers(1, 4),
    st.integers(0, 4),
    st.sampled_from([1, 3]),
    st.lists(st.integers(0, 100), min_size=1, max_size=12),
)
def test_any_sequence_of_budgets(seed, rows, clusters, bases, channels, budgets):
    """One row, clusters without any, no basis vector, budgets of 0 and above the basis: sums of what was applied."""
    rng = np.random.default_rng(seed)
    for operator in (clustered(rng, rows, clusters, bases, channels), haar_rows(rng, rows, channels)):
        method = PerBand(wavelet_bands(4))
        playing = player(operator, LIGHTING, method.groups, ALL)
        for budget in budgets:
            playing.apply(method.update(wavelets_of(rng.random((M, 3)) - 0.3), budget))
            truth = operator.relight(haar_inverse(method.applied))
            assert np.abs(playing.incident - truth).max() <= 1e-5 * max(np.abs(truth).max(), 1)


def test_some_vectors_a_frame_reach_all_of_them():
    """The changes that matter most are applied first, in whichever clusters they are."""
    rng = np.random.default_rng(9)
    operator = clustered(rng, clusters=5, bases=12)
    playing, method = ClusteredPlayer(cluster_columns(operator), 1, vectors=3), Everything(wavelet_bands(4))
    playing.apply(method.update(wavelets_of(rng.random((M, 3))), None))
    light = rng.random((M, 3)).astype(np.float32)
    truth, errors = operator.relight(light), []
    for _ in range(5):
        playing.apply(method.update(wavelets_of(light), None))
        errors.append(relative_l2(playing.incident, truth))
    assert errors[-1] < 2e-6 < errors[1] < errors[0]


@pytest.mark.parametrize("channels", [1, 3])
def test_columns_are_the_rows_transposed(channels):
    rng = np.random.default_rng(11)
    rows = haar_rows(rng, 5000, channels, CubemapLighting(2))  # more than a block
    columns = wavelet_columns(rows, rows.lighting)
    assert columns.nbytes <= 1.5 * rows.nbytes
    dense = haar(np.moveaxis(rows.rows(np.arange(5000)), 2, 1) / np.sqrt(rows.lighting.solid_angles))
    for j in (0, 3, 17):
        one = np.zeros((24, 3), np.float32)
        one[j] = 1, 2, 3
        playing = ColumnsPlayer(columns)
        playing.apply(Everything(wavelet_bands(2)).update(one, None))
        assert_allclose(playing.incident, dense[:, :, j] * [1, 2, 3], atol=2e-6)
    assert_allclose(columns.norms(), np.linalg.norm(dense, axis=(0, 1)), rtol=1e-4, atol=1e-5)


def test_columns_of_any_operator_are_its_own():
    rng = np.random.default_rng(12)
    operator = Dense(rng.random((300, M, 3)).astype(np.float32))
    playing = ColumnsPlayer(wavelet_columns(operator, LIGHTING, 1e-3))
    light = rng.random((M, 3)).astype(np.float32)
    playing.apply(Everything(wavelet_bands(4)).update(wavelets_of(light), None))
    assert relative_l2(playing.incident, operator.relight(light)) < 1e-3


def test_norms_of_clusters_are_those_of_columns():
    operator = clustered(np.random.default_rng(13), channels=3)
    dense = haar(np.moveaxis(operator.rows(np.arange(70)), 2, 1) / np.sqrt(LIGHTING.solid_angles))
    assert_allclose(cluster_columns(operator).norms(), np.linalg.norm(dense, axis=(0, 1)), rtol=1e-3)
    assert ProductPlayer(operator, LIGHTING).column_norms() is None


@pytest.mark.parametrize("kind", ["columns", "clustered"])
@pytest.mark.parametrize("frames", [1000, pytest.param(10_000, marks=pytest.mark.slow)])
def test_sums_do_not_drift(kind, frames):
    """Thousands of frames of a light that turns, then one that stands still: no further off than after one frame."""
    lighting, rng = CubemapLighting(8), np.random.default_rng(14)
    operator = (
        clustered(rng, 500, 4, 8, lighting=lighting)
        if kind == "clustered"
        else haar_rows(rng, 500, 1, lighting)
    )
    method = PerBand(wavelet_bands(8))
    playing = player(operator, lighting, method.groups, 2)
    scale, texels = np.sqrt(lighting.solid_angles)[:, None], rng.random((lighting.n_directions, 3)) ** 8
    for frame in range(frames):
        light = np.roll(texels, frame, axis=0).astype(np.float32)
        playing.apply(method.update(haar_colours((light * scale).astype(np.float32)), 30))
    for _ in range(20):
        playing.apply(method.update(haar_colours((light * scale).astype(np.float32)), 100))
    assert relative_l2(playing.incident, operator.relight(light)) < 1e-5


@pytest.mark.parametrize("peak", [0.0, -3.0, 1e6])
def test_lights_that_are_black_negative_or_a_single_texel(peak):
    rng = np.random.default_rng(15)
    texels = np.zeros((M, 3), np.float32)
    texels[37] = peak
    for operator in operators(rng).values():
        method = PerBand(wavelet_bands(4))
        playing = player(operator, LIGHTING, method.groups, ALL)
        playing.apply(method.update(wavelets_of(rng.random((M, 3))), None))
        for _ in range(12):
            playing.apply(method.update(wavelets_of(texels), 20))
        truth = operator.relight(texels)
        assert np.abs(playing.incident - truth).max() <= 1e-5 * max(abs(peak), 1)


# --- relighter


def transport_of(operator, albedo=(0.5, 0.6, 0.7)):
    from mi_sparse_prt.reflection.reflection import Diffuse

    n = operator.shape[0]
    measurement = SimpleNamespace(weights=None, outputs=n, kind="vertices", combined=lambda x: x)
    reflection = Diffuse(np.tile(np.float32(albedo), (n, 1)))
    return prt.LightTransport(LIGHTING, "texel", 5, measurement, reflection, {"compressed": operator}, "", {})


@pytest.mark.parametrize("approximation", ["per_band", "incremental", "everything"])
def test_relighter_ends_where_relight_does(approximation):
    rng = np.random.default_rng(16)
    transport = transport_of(clustered(rng, channels=3))
    relighter = prt.Relighter(transport, approximation, budget=20)
    first, light = rng.random((2, M, 3)).astype(np.float32)
    assert relative_l2(relighter.relight(first), transport.relight(first)) < 2e-6
    for _ in range(12):
        colours = relighter.relight(light)
    assert relative_l2(colours, transport.relight(light)) < 2e-6
    relighter.reset()
    assert relative_l2(relighter.relight(first), transport.relight(first)) < 2e-6


def test_budget_follows_the_frame_rate():
    transport = transport_of(clustered(np.random.default_rng(17)))
    light = np.ones((M, 3), np.float32)
    slow, quick = (prt.Relighter(transport, budget=50, rate=rate) for rate in (1e7, 1e-3))
    for frame in range(30):
        for relighter in (slow, quick):
            relighter.relight(light * (1 + frame % 2))
    assert slow.budget == 8 and quick.budget == M


def test_relighter_refuses_what_it_cannot_do():
    transport = transport_of(clustered(np.random.default_rng(18)))
    for match, arguments in {
        "none of": {"approximation": "best"},
        "budget": {"budget": -1},
        "frames per second": {"rate": 0},
        "basis vectors": {"vectors": 0},
    }.items():
        with pytest.raises(prt.PrtError, match=match):
            prt.Relighter(transport, **arguments)
    relighter = prt.Relighter(transport)
    before = relighter.relight(np.ones((M, 3), np.float32)).copy()
    with pytest.raises(prt.PrtError, match="shape"):
        relighter.relight(np.ones((6 * 64, 3), np.float32))
    with pytest.raises(prt.PrtError, match="NaN"):
        relighter.relight(np.full((M, 3), np.nan, np.float32))
    assert_array_equal(relighter.colours(), before)
