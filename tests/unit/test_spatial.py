"""Choice of dense vertices: local ranks against the SVD of unpacked rows, draws against their probabilities."""

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.stats import chisquare

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.core.random_keys import hash_rows, mix
from mi_sparse_prt.sampling.spatial import (
    SpatialSampling,
    choose_dense,
    choose_weighted,
    local_rank,
    local_ranks_at,
)


def packed(visible: np.ndarray) -> np.ndarray:
    """Words (n, ceil(m / 32)) of a 0/1 matrix (n, m)."""
    padded = np.pad(visible.astype(np.uint8), ((0, 0), (0, -visible.shape[1] % 32)))
    return np.packbits(padded, axis=1, bitorder="little").view(np.uint32)


def svd_rank(rows: np.ndarray) -> int:
    """The definition: singular values, largest first, until they hold 99% of the energy."""
    if not rows.any():
        return 0
    energy = np.linalg.svd(rows.astype(float), compute_uv=False) ** 2
    return int(np.searchsorted(np.cumsum(energy), (0.99 - 1e-9) * energy.sum()) + 1)


def grid(side: int) -> np.ndarray:
    """Positions (side^2, 3) on a square of side 1 on the ground: full of equal distances."""
    x, z = np.meshgrid(np.linspace(0, 1, side), np.linspace(0, 1, side), indexing="ij")
    return np.stack([x, 0 * x, z], axis=-1).reshape(-1, 3).astype(np.float32)


def edges(positions: np.ndarray, n: int = 32) -> np.ndarray:
    """Visibility (n_v, n^2) of half-planes whose edges turn and move smoothly over the ground."""
    t = (np.arange(n) + 0.5) / n
    angle = 0.5 * positions[:, 2, None, None]
    offset = 0.2 + 0.6 * positions[:, 0, None, None]
    return (np.cos(angle) * t[:, None] + np.sin(angle) * t < offset).reshape(len(positions), -1)


# --- Local rank -----------------------------------------------------------------------------------------------------


@given(st.data())
@settings(max_examples=100, deadline=None)
def test_rank_against_svd(data):
    n, m, k = (data.draw(st.integers(1, most)) for most in (12, 100, 10))
    visible = data.draw(arrays(np.uint8, (n, m), elements=st.integers(0, 1)))
    ids = data.draw(arrays(np.int32, (3, k), elements=st.integers(-1, n - 1)))
    expected = [svd_rank(visible[row[row >= 0]]) for row in ids]
    assert local_rank(packed(visible), ids).tolist() == expected


def test_rank_of_smooth_visibility_against_svd():
    visible = edges(grid(12))
    ids = np.random.default_rng(0).integers(0, len(visible), (8, 30)).astype(np.int32)
    assert local_rank(packed(visible), ids).tolist() == [svd_rank(visible[row]) for row in ids]


@pytest.mark.parametrize("words", [1, 2, 3, 192])
def test_identical_rows_have_rank_one(words):
    row = np.random.default_rng(0).integers(1, 1 << 32, (1, words), dtype=np.uint32)
    assert local_rank(np.repeat(row, 30, axis=0), np.arange(30)[None]).tolist() == [1]


@pytest.mark.parametrize("k", [1, 2, 10, 99, 100, 101, 200])
def test_orthogonal_rows_have_full_rank(k):
    """Energy is spread evenly: 99 of 100 equal singular values hold 99%, which rounding must not make 100."""
    for repeats in (1, 5, 7):
        visible = np.repeat(np.eye(k, dtype=np.uint8), repeats, axis=1)
        assert local_rank(packed(visible), np.arange(k)[None]).tolist() == [-(-99 * k // 100)]


def test_padding_and_rows_of_zeros():
    visible = np.zeros((4, 64), np.uint8)
    visible[1, :10], visible[2, 10:20] = 1, 1
    ids = np.array([[-1, -1, -1], [0, -1, -1], [0, 3, 0], [1, -1, -1], [1, 0, 3], [1, 2, -1], [-1, 2, 1]])
    assert local_rank(packed(visible), ids).tolist() == [0, 0, 0, 1, 1, 2, 2]
    assert local_rank(packed(visible), ids[:0]).shape == (0,)
    assert local_rank(packed(visible)[:0], np.full((2, 3), -1)).tolist() == [0, 0]


def test_rank_does_not_saturate_where_visibility_is_smooth():
    """The rank tells how complex a place is, not how many neighbours were looked at."""
    p = grid(40)
    smooth = packed(edges(p))
    noise = np.random.default_rng(0).integers(0, 1 << 32, smooth.shape, dtype=np.uint32)
    ranks = {k: local_ranks_at(p, smooth, p, 0.1, k) for k in (20, 30)}
    assert ranks[30].max() <= 15
    assert np.median(ranks[30]) - np.median(ranks[20]) <= 1
    assert np.median(local_ranks_at(p, noise, p, 0.1, 30)) >= 28


def test_ranks_are_those_of_the_dense_rows_within_the_radius():
    rng = np.random.default_rng(0)
    dense, centres = rng.random((20, 3)), rng.random((7, 3))
    visible = rng.random((20, 70)) < 0.3
    expected = []
    for row in np.linalg.norm(centres[:, None] - dense, axis=2):
        near = np.argsort(row)[:6]
        expected.append(svd_rank(visible[near[row[near] <= 0.3]]))
    assert local_ranks_at(centres, packed(visible), dense, 0.3, 6).tolist() == expected
    assert (local_ranks_at(centres, packed(visible)[:0], dense[:0], 0.3, 6) == 0).all()
    with pytest.raises(PrtError, match="20 dense vertices have 19 rows"):
        local_ranks_at(centres, packed(visible)[:-1], dense, 0.3, 6)


# --- Weighted choice ------------------------------------------------------------------------------------------------


def test_single_draws_are_in_proportion_to_the_weights():
    weights, keys = np.array([1.0, 2, 3, 4]), np.arange(4, dtype=np.uint64)
    drawn = [int(choose_weighted(weights, keys, 1, seed)[0]) for seed in range(4000)]
    assert chisquare(np.bincount(drawn), 4000 * weights / weights.sum()).pvalue > 1e-3


def test_draws_without_replacement_have_their_probabilities():
    """Pairs: one first in proportion to its weight, the other out of what is left."""
    weights, keys = np.array([1.0, 2, 5, 0.5]), mix(np.arange(4, dtype=np.uint64))
    total = weights.sum()
    pairs = list(combinations(range(4), 2))
    p = [
        weights[i] / total * weights[j] / (total - weights[i])
        + weights[j] / total * weights[i] / (total - weights[j])
        for i, j in pairs
    ]
    drawn = [pairs.index(tuple(choose_weighted(weights, keys, 2, seed))) for seed in range(6000)]
    assert chisquare(np.bincount(drawn, minlength=6), 6000 * np.array(p)).pvalue > 1e-3


def test_keys_draw_independently():
    """One seed, many keys: within four standard errors of an even draw, in every corner of the keys."""
    n, count = 20000, 5000
    chosen = choose_weighted(np.ones(n), np.arange(n, dtype=np.uint64), count, 3)
    share = np.bincount(chosen // 2000, minlength=10) / 2000
    assert np.abs(share - 0.25).max() < 4 * np.sqrt(0.25 * 0.75 / 2000)


@given(
    arrays(np.float32, st.integers(0, 30), elements=st.sampled_from([0, 0.5, 1, 7, 1e-30, 1e30])),
    st.integers(-1, 40),
    st.integers(-(2**70), 2**70),
    st.randoms(use_true_random=False),
)
@settings(deadline=None)
def test_choice_in_any_order(weights, count, seed, random):
    n = len(weights)
    keys = mix(np.arange(n, dtype=np.uint64))
    chosen = choose_weighted(weights, keys, count, seed)
    assert len(chosen) == len(set(chosen)) == min(max(count, 0), n)
    assert (np.diff(chosen) > 0).all()
    order = np.array(random.sample(range(n), n), int)
    again = choose_weighted(weights[order], keys[order], count, seed)
    assert np.array_equal(np.sort(keys[chosen]), np.sort(keys[order][again]))
    # weight 0 only when nothing else is left
    assert (weights[chosen] > 0).sum() == min(len(chosen), (weights > 0).sum())


def test_zero_weights_are_drawn_at_random():
    keys = np.arange(3, dtype=np.uint64)
    drawn = [int(choose_weighted(np.zeros(3), keys, 1, seed)[0]) for seed in range(3000)]
    assert chisquare(np.bincount(drawn, minlength=3)).pvalue > 1e-3


@pytest.mark.parametrize("bad", [-1, np.nan, np.inf])
def test_impossible_weights(bad):
    with pytest.raises(PrtError, match="vertex 1 has the weight"):
        choose_weighted(np.array([1, bad]), np.arange(2, dtype=np.uint64), 1, 0)


# --- Choice of dense vertices -----------------------------------------------------------------------------------------


class Asked:
    """Rows on demand; remembers who was asked for."""

    def __init__(self, bits: np.ndarray) -> None:
        self.bits, self.calls = bits, []

    def __call__(self, ids: np.ndarray) -> np.ndarray:
        self.calls.append(ids)
        return self.bits[ids]


def test_iterations_add_up():
    p = grid(20)
    asked = Asked(packed(edges(p)))
    samples = choose_dense(p, hash_rows(p), asked, SpatialSampling(0.22, step=0.05, sharing=5))
    assert [len(ids) for ids in samples.iterations] == [20, 20, 20, 20, 8]
    assert np.array_equal(samples.ids, np.sort(np.concatenate(samples.iterations)))
    assert len(set(samples.ids)) == 88
    # each row once, in the iteration that chose it
    assert [sorted(ids) for ids in asked.calls] == [ids.tolist() for ids in samples.iterations]
    assert samples.ranks.shape == (400,) and (samples.ranks >= 1).all()
    before, first = np.concatenate(samples.iterations[:-1]), samples.iterations[0]
    first = first[np.argsort(hash_rows(p)[first])][::5]  # centres of local matrices
    owner = np.argmin(np.linalg.norm(p[:, None] - p[first], axis=2), axis=1)
    apart = np.sort(np.linalg.norm(p[:, None] - p[first], axis=2), axis=1)
    clear = apart[:, 1] - apart[:, 0] > 1e-6  # of equally near ones either may be taken
    expected = local_ranks_at(p[first], asked.bits[before], p[before], 0.1, 30)[owner]
    assert clear.mean() > 0.5 and np.array_equal(samples.ranks[clear], expected[clear])
    assert set(samples.seconds) == {"rank", "choice"}


def test_order_of_vertices_does_not_show():
    """The same vertices to the last bit, on a grid (equal distances) with seams (equal positions, other rows)."""
    rng = np.random.default_rng(0)
    p = np.concatenate([grid(15), grid(15)])
    keys = mix(np.arange(len(p), dtype=np.uint64))
    bits = rng.integers(0, 1 << 32, (len(p), 6), dtype=np.uint32)
    bits[: len(p) // 2] = bits[0]
    order = rng.permutation(len(p))
    # so few neighbours that a local matrix often has only one side of a seam
    shared = SpatialSampling(0.5, step=0.1, rows=2), 5
    a = choose_dense(p, keys, lambda ids: bits[ids], *shared)
    b = choose_dense(p[order], keys[order], lambda ids: bits[order][ids], *shared)
    assert np.array_equal(np.sort(keys[a.ids]), np.sort(keys[order][b.ids]))
    assert np.array_equal(a.ranks[order], b.ranks)
    for one, other in zip(a.iterations, b.iterations, strict=True):
        assert np.array_equal(np.sort(keys[one]), np.sort(keys[order][other]))


def test_seeds_differ():
    p = grid(20)
    bits = packed(edges(p))
    a, b = (
        choose_dense(p, hash_rows(p), lambda i: bits[i], SpatialSampling(0.2), seed).ids for seed in (0, 1)
    )
    assert not np.array_equal(a, b)


def test_complex_places_get_more_vertices():
    """Half of the ground sees an open sky, the other half noise: after the first draw, rank decides."""
    p = grid(50)
    noisy = p[:, 0] > 0.5
    bits = np.random.default_rng(0).integers(0, 1 << 32, (len(p), 8), dtype=np.uint32)
    bits[~noisy] = 0xFFFFFFFF
    samples = choose_dense(p, hash_rows(p), lambda ids: bits[ids], SpatialSampling(0.25, radius=0.15))
    first, later = samples.iterations[0], np.concatenate(samples.iterations[1:])
    assert abs(noisy[first].mean() - 0.5) < 4 * np.sqrt(0.25 / len(first))
    assert noisy[later].sum() > 3 * (~noisy[later]).sum()
    assert np.median(samples.ranks[noisy]) > 15 and np.median(samples.ranks[~noisy]) == 1


def test_where_nothing_is_seen_vertices_are_still_chosen():
    p = grid(10)
    dark = np.zeros((len(p), 3), np.uint32)
    samples = choose_dense(p, hash_rows(p), lambda ids: dark[ids], SpatialSampling(0.3))
    assert len(samples.ids) == 30 and (samples.ranks == 0).all()


@pytest.mark.parametrize("n, expected", [(0, 0), (1, 1), (2, 2), (3, 2), (39, 2), (100, 10)])
def test_small_meshes(n, expected):
    p = np.zeros((n, 3), np.float32)  # a mesh without size has a radius of 0
    p[:, 0] = np.arange(n) if n < 50 else 0
    keys = mix(np.arange(n, dtype=np.uint64))
    sampling = SpatialSampling(0.1 if n > 39 else 0.05)
    samples = choose_dense(p, keys, lambda ids: np.ones((len(ids), 1), np.uint32), sampling)
    assert len(samples.ids) == expected
    drawn_by_rank = len(samples.iterations) > 1
    assert (samples.ranks == drawn_by_rank).all() and samples.ranks.shape == (n,)


def test_every_vertex():
    p = grid(6)
    lit = np.ones((len(p), 1), np.uint32)
    samples = choose_dense(p, hash_rows(p), lambda ids: lit[ids], SpatialSampling(1, step=0.4))
    assert np.array_equal(samples.ids, np.arange(36))


def test_impossible_choices():
    p = grid(4)

    def choose(positions, **parameters):
        ones = np.ones((len(positions), 1), np.uint32)
        sampling = SpatialSampling(**{"fraction": 0.5, **parameters})
        return choose_dense(positions, hash_rows(p), lambda ids: ones[ids], sampling)

    for name in ("fraction", "step"):
        for value in (0, 1.5, -1, np.nan):
            with pytest.raises(PrtError, match=f"{name} is {value}"):
                choose(p, **{name: value})
    broken = p.copy()
    broken[5] = np.nan
    with pytest.raises(PrtError, match="^vertex 5 has the position"):
        choose(broken)
    with pytest.raises(PrtError, match="radius is -1"):
        choose(p, radius=-1)
