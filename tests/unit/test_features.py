"""Which directions of sparse vertices are evaluated, against loops over bools and sorts."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from mi_sparse_prt.core.bits import Bits, pack, unpack
from mi_sparse_prt.sampling.features import choose_features, copy_agreed, find_contested

M = 40  # directions: a word and part of a second


def near(rows: list[list[int]]) -> NDArray[np.int32]:
    """Neighbours padded with -1."""
    width = max(map(len, rows), default=0)
    return np.array([[*row, *[-1] * (width - len(row))] for row in rows], np.int32).reshape(len(rows), width)


def some_neighbours(n: int, n_dense: int, rng: np.random.Generator) -> NDArray[np.int32]:
    """From none to five different dense vertices for each of n."""
    return near([rng.choice(n_dense, min(rng.integers(0, 6), n_dense), False).tolist() for _ in range(n)])


# ------------------------------------------------------------------------------------ contested


def judged(neighbours: NDArray[np.int32], visible: Bits, known: Bits, above: Bits) -> tuple[Bits, Bits]:
    """What is contested, and what is agreed on, of vertices of which nothing was sampled."""
    vertices, agreed = np.arange(len(above)), np.full_like(above, 0xABCDEF)
    copy_agreed(neighbours, visible, known, vertices, above, agreed)
    return find_contested(neighbours, visible, known, vertices, above, np.zeros_like(above)), agreed


@given(st.integers(0, 6), st.integers(1, 8), st.sampled_from([1, 31, 32, 33, 96]), st.integers(0, 10**6))
@settings(deadline=None)
def test_contested_against_loops(n, n_dense, m, seed):
    rng = np.random.default_rng(seed)
    neighbours = some_neighbours(n, n_dense, rng)
    known = rng.random((n_dense, m)) < rng.random()
    visible = known & (rng.random((n_dense, m)) < rng.random())
    above = rng.random((n, m)) < 0.7
    differ, agreed = judged(neighbours, pack(visible), pack(known), pack(above))
    assert differ.shape == agreed.shape == (n, -(-m // 32))
    for i in range(n):
        for j in range(32 * differ.shape[1]):
            found = [(int(b[i, j // 32]) >> (j % 32)) & 1 for b in (differ, agreed)]
            if j >= m or not above[i, j]:
                assert found == [0, 0]
                continue
            answers = {bool(visible[k, j]) for k in neighbours[i] if k >= 0 and known[k, j]}
            assert found == [len(answers) != 1, answers == {True}]


def test_where_all_agree_nothing_is_traced():
    """Neighbours with one and the same row: it is taken over as it is, above the vertex's own horizon."""
    rng = np.random.default_rng(0)
    row, above = rng.random(M) < 0.5, rng.random((1, M)) < 0.5
    everywhere = np.ones((4, M), bool)
    differ, agreed = judged(near([[0, 1, 2, 3]]), pack(np.tile(row, (4, 1))), pack(everywhere), pack(above))
    assert not differ.any()
    assert np.array_equal(unpack(agreed, M), above & row)


def test_what_is_below_every_neighbours_horizon_is_traced():
    """The vertex sees further around than any neighbour: nobody can tell."""
    known, above = np.zeros((2, M), bool), np.ones((1, M), bool)
    known[0, :10], known[1, 5:20] = True, True
    differ, agreed = judged(near([[0, 1]]), pack(known), pack(known), pack(above))
    assert np.array_equal(np.flatnonzero(unpack(differ, M)), np.arange(20, M))
    assert np.array_equal(np.flatnonzero(unpack(agreed, M)), np.arange(20))


def test_ignorance_is_no_vote():
    """A neighbour below whose horizon a direction is does not say that it is dark."""
    known = np.zeros((2, M), bool)
    known[0] = True
    differ, agreed = judged(near([[0, 1]]), pack(known), pack(known), pack(np.ones((1, M), bool)))
    assert not differ.any()
    assert unpack(agreed, M).all()


def test_one_dissenter_is_enough():
    visible = np.ones((40, M), bool)
    visible[17, 33] = False
    everywhere = np.ones((40, M), bool)
    differ, agreed = judged(near([list(range(40))]), pack(visible), pack(everywhere), pack(everywhere[:1]))
    assert np.flatnonzero(unpack(differ, M)).tolist() == [33]
    assert unpack(agreed, M).sum() == M - 1


def test_without_neighbours_all_is_traced():
    above = np.random.default_rng(1).random((3, M)) < 0.5
    nobody = np.full((3, 2), -1, np.int32)
    differ, agreed = judged(nobody, pack(above), pack(above), pack(above))
    assert np.array_equal(differ, pack(above))
    assert not agreed.any()


def test_nothing_is_sampled_twice_and_other_rows_are_left_alone():
    """Vertices 4 and 1 of six, with neighbours that know nothing: all above that was not sampled before."""
    rng = np.random.default_rng(2)
    above, before = rng.random((6, M)) < 0.5, rng.random((6, M)) < 0.3
    nobody, vertices = np.full((2, 3), -1, np.int32), np.array([4, 1])
    nothing = pack(np.zeros((1, M), bool))
    differ = find_contested(nobody, nothing, nothing, vertices, pack(above), pack(before))
    assert np.array_equal(unpack(differ, M), (above & ~before)[vertices])
    result = pack(before)
    copy_agreed(nobody, nothing, nothing, vertices, pack(above), result)
    assert not result[vertices].any()
    assert np.array_equal(unpack(result, M)[[0, 2, 3, 5]], before[[0, 2, 3, 5]])


# ------------------------------------------------------------------------------------ best features


def naive_best(neighbours: NDArray, rows: NDArray, features: NDArray, count: int) -> NDArray[np.int64]:
    """Variance x count, sorted stably: of equal weights the lower directions are taken."""
    chosen = np.full((len(neighbours), count), -1)
    for i, row in enumerate(neighbours):
        ids = row[row >= 0]
        if len(ids):
            weight = rows[ids].astype(np.float64).var(axis=0) * features[ids].sum(axis=0)
            order = [j for j in np.argsort(-weight, kind="stable") if weight[j] > 0][:count]
            chosen[i, : len(order)] = sorted(order)
    return chosen


@given(st.integers(0, 5), st.integers(1, 6), st.integers(0, 60), st.integers(0, 10**6))
@settings(deadline=None, max_examples=150)
def test_best_features_against_a_sort(n, n_dense, count, seed):
    """Values 0, 4, 8, ... and at most 4 neighbours: sums and their squares are exact, and there are many ties."""
    rng = np.random.default_rng(seed)
    neighbours = near(
        [rng.choice(n_dense, min(2 ** rng.integers(0, 3), n_dense), False).tolist() for _ in range(n)]
    )
    neighbours[(neighbours >= 0).sum(axis=1) == 3] = -1  # thirds are not exact
    rows = (4 * rng.integers(0, 3, (n_dense, M))).astype(np.float32)
    features = rng.random((n_dense, M)) < 0.5
    chosen = choose_features(neighbours, rows, pack(features), count)
    assert chosen.dtype == np.int32
    assert np.array_equal(chosen, naive_best(neighbours, rows, features, count))


def test_real_numbers():
    """No ties, weights apart by more than rounding: the choice is that of the definition."""
    rng = np.random.default_rng(3)
    rows = rng.random((30, 200)).astype(np.float32)
    features = rng.random((30, 200)) < 0.3
    neighbours = some_neighbours(40, 30, rng)
    for count in (1, 20, 199, 200, 350):
        chosen = choose_features(neighbours, rows, pack(features), count)
        expected = naive_best(neighbours, rows, features, count)
        lonely = (neighbours >= 0).sum(axis=1) == 1  # their variance is 0, but for rounding
        assert np.array_equal(chosen[~lonely], expected[~lonely])


def test_the_weight_is_variance_times_the_number_of_features():
    """Two neighbours; variances 1, 4, 9 and feature counts 2, 2, 1, 0 make weights 2, 8, 9, 0."""
    rows = np.float32([[0, 0, 0, 0], [2, 4, 6, 100]])
    features = np.array([[1, 1, 1, 0], [1, 1, 0, 0]], bool)
    ask = lambda count: choose_features(near([[0, 1]]), rows, pack(features), count)[0].tolist()  # noqa: E731
    assert ask(1) == [2]
    assert ask(2) == [1, 2]
    assert ask(3) == [0, 1, 2]
    assert ask(5) == [0, 1, 2, -1, -1]


def test_the_padding_is_no_neighbour():
    """Row -1 would be the last one; it differs in everything."""
    rng = np.random.default_rng(0)
    rows = np.concatenate([rng.random((2, M)), 1000 * rng.random((1, M))]).astype(np.float32)
    features = np.ones((3, M), bool)
    padded = np.int32([[0, 1, -1, -1]])
    assert np.array_equal(
        choose_features(padded, rows, pack(features), 7),
        choose_features(padded[:, :2], rows, pack(features), 7),
    )


@pytest.mark.parametrize("kind", ["no feature", "no variance", "no neighbour"])
def test_nothing_to_choose(kind):
    rows = np.arange(M, dtype=np.float32) + np.float32([[0], [1 if kind != "no variance" else 0]])
    features = np.full((2, M), kind != "no feature")
    neighbours = np.int32([[-1, -1]]) if kind == "no neighbour" else np.int32([[0, 1]])
    assert (choose_features(neighbours, rows, pack(features), 5) == -1).all()
