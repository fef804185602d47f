"""Which vertices become dense: more of them where light transport is locally complex ([HR10] 4.1)."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.bits import count_ones
from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.core.random_keys import mix
from mi_sparse_prt.core.threads import run_in_parts
from mi_sparse_prt.measurement.neighbours import check_finite_rows, radius_neighbours


@dataclass(frozen=True)
class SpatialSampling:
    """How many vertices become dense, and by what ([HR10] 4.1).

    Attributes
    ----------
    fraction : float
        Of the vertices, in (0, 1]; at least two vertices are chosen, if the mesh has so many.
    step : float
        Of the vertices, in (0, 1], that one iteration adds; the last one may be smaller.
    radius : float, optional
        Of a local matrix; a tenth of the longest side of the mesh's box if not given.
    rows : int
        Of a local matrix, at most.
    energy : float
        Of a local matrix (sum of squared singular values) that its rank accounts for.
    power : float
        Vertices are drawn in proportion to their ranks to this power.
    sharing : int
        One in so many of the first iteration's vertices is the centre of a local matrix, whose rank is that of all
        vertices to which it is the nearest.
    """

    fraction: float
    step: float = 0.05
    radius: float | None = None
    rows: int = 30
    energy: float = 0.99
    power: float = 1.0
    sharing: int = 8

    def __post_init__(self) -> None:
        for name, value in (("fraction", self.fraction), ("step", self.step)):
            if not 0 < value <= 1:
                raise PrtError(f"{name} is {value}: give a share of the vertices in (0, 1]")


@dataclass(frozen=True)
class SpatialSamples:
    """Dense vertices of a mesh, and how they were chosen.

    Attributes
    ----------
    ids : (n_dense,) int64
        Dense vertices, sorted.
    ranks : (n,) float32
        Local rank of every vertex, by which the last iteration was drawn; 0 where all were drawn at random.
    iterations : list of (n_i,) int64
        Vertices chosen in each iteration, sorted; together they are ``ids``.
    seconds : dict
        Time in local ranks ("rank") and in the weighted choice ("choice"); that of visibility is the caller's.
    """

    ids: NDArray[np.int64]
    ranks: NDArray[np.float32]
    iterations: list[NDArray[np.int64]]
    seconds: dict[str, float]


def choose_dense(
    positions: NDArray[np.floating],
    keys: NDArray[np.uint64],
    visibility: Callable[[NDArray[np.int64]], NDArray[np.uint32]],
    sampling: SpatialSampling,
    seed: int = 0,
) -> SpatialSamples:
    """Choose the dense vertices of one mesh in iterations, by the local rank of what is known so far ([HR10] 4.1).

    The first iteration takes a step's share of the vertices at random; one in eight of them is the centre of a local
    matrix. Each later one computes the ranks of these and draws as many more by rank, until there are enough.

    Parameters
    ----------
    positions : (n, 3) float, any frame
    keys : (n,) uint64
        Of the vertices (``Points.keys``); random numbers are made of them.
    visibility : callable
        Vertex ids (n_i,) to packed visibility rows (n_i, words) uint32: bit ``j % 32`` of word ``j // 32``. Called once
        per iteration, with the vertices that are new.
    sampling : SpatialSampling
    seed : int

    Returns
    -------
    SpatialSamples
        The same vertices, by position and key, in whatever order they are given.

    Raises
    ------
    PrtError
        If a position is not finite.
    """
    n = len(positions)
    # all below is in the order of keys: ties of every kind then fall the same way in whatever order vertices come
    by_key = np.argsort(keys, kind="stable")
    p, sorted_keys = check_finite_rows(positions, "vertex", "position")[by_key], np.asarray(keys)[by_key]
    radius = sampling.radius
    if radius is None:
        radius = 0.1 * float(np.ptp(p, axis=0).max()) if n else 0.0
    total = _share(sampling.fraction, n)
    ranks = np.zeros(n, np.float32)
    free = np.ones(n, dtype=bool)
    dense: list[NDArray[np.int64]] = []  # [iteration][vertex], in the order of keys
    bits: list[NDArray[np.uint32]] = []  # [iteration][vertex, word]
    seconds = {"rank": 0.0, "choice": 0.0}
    while True:
        start = time.perf_counter()
        if len(dense) == 1:  # shared matrices: a vertex takes the rank around the nearest of the first ones
            centres = p[dense[0][:: sampling.sharing]]
            owner = radius_neighbours(p, centres, np.inf, 1).ids[:, 0]
        if len(dense):
            known, chosen = np.concatenate(bits), np.concatenate(dense)
            found = local_ranks_at(centres, known, p[chosen], radius, sampling.rows, sampling.energy)
            ranks = found[owner].astype(np.float32)
        seconds["rank"] += time.perf_counter() - start

        start = time.perf_counter()
        left = np.flatnonzero(free)
        wanted = min(_share(sampling.step, n), total - (n - len(left)))
        weights = ranks[left] ** sampling.power if len(dense) else np.ones(len(left), np.float32)
        new = left[choose_weighted(weights, sorted_keys[left], wanted, _nth_seed(seed, len(dense)))]
        free[new] = False
        dense.append(new)
        seconds["choice"] += time.perf_counter() - start

        if len(new):
            bits.append(visibility(by_key[new]))

        by_vertex = np.empty(n, np.float32)
        by_vertex[by_key] = ranks
        iterations = [np.sort(by_key[ids]) for ids in dense]
        samples = SpatialSamples(np.sort(by_key[~free]), by_vertex, iterations, dict(seconds))
        if len(samples.ids) >= total:
            return samples


def choose_weighted(
    weights: NDArray[np.floating], keys: NDArray[np.uint64], count: int, seed: int
) -> NDArray[np.int64]:
    """Draw without replacement, each draw in proportion to the weights of what is left (Efraimidis and Spirakis 2006).

    Every item arrives after an exponential time of rate w, ``-log(u) / w``; the first `count` are chosen. ``u`` is made
    of the item's key and the seed: the same items are chosen in whatever order they are given.

    Parameters
    ----------
    weights : (n,) float
        Finite, not negative. Items of weight 0 are chosen only when no others are left, and then at random.
    keys : (n,) uint64
    count : int
        All n are chosen if there are fewer.
    seed : int

    Returns
    -------
    (min(count, n),) int64
        Indices of the chosen items, sorted.

    Raises
    ------
    PrtError
        If a weight is negative or not finite.
    """
    w: NDArray[np.float64] = np.asarray(weights, np.float64)
    bad = np.flatnonzero(~(np.isfinite(w) & (w >= 0)))
    if len(bad):
        raise PrtError(f"vertex {bad[0]} has the weight {w[bad[0]]}: weights are finite and not negative")
    words = mix(np.asarray(keys, np.uint64) ^ mix(_word(seed)))
    u = ((words >> np.uint64(11)).astype(np.float64) + 0.5) * 2.0**-53  # in (0, 1)
    time_at_rate_one = -np.log(u)
    arrival = np.full(len(w), np.inf)
    np.divide(time_at_rate_one, w, out=arrival, where=w > 0)
    order = np.lexsort((words, time_at_rate_one, arrival))
    return np.sort(order[: max(count, 0)])


def local_ranks_at(
    centres: NDArray[np.floating],
    bits: NDArray[np.uint32],
    dense_positions: NDArray[np.floating],
    radius: float,
    k: int,
    energy: float = 0.99,
) -> NDArray[np.int64]:
    """Local rank around some places: that of the up to k nearest dense rows within the radius ([HR10] 4.1).

    Parameters
    ----------
    centres : (m, 3) float, any frame
    bits : (n_dense, words) uint32
        Visibility rows of the dense vertices: bit ``j % 32`` of word ``j // 32``.
    dense_positions : (n_dense, 3) float, same frame
    radius : float
    k : int
    energy : float
        Of a local matrix that its rank accounts for.

    Returns
    -------
    (m,) int64

    Raises
    ------
    PrtError
        As in ``radius_neighbours``, or if bits and positions of dense vertices differ in number.
    """
    if len(bits) != len(dense_positions):
        raise PrtError(f"{len(dense_positions)} dense vertices have {len(bits)} rows of bits: give one each")
    return local_rank(bits, radius_neighbours(centres, dense_positions, radius, k).ids, energy)


def local_rank(
    bits: NDArray[np.uint32], neighbours_ids: NDArray[np.integer], energy: float = 0.99
) -> NDArray[np.int64]:
    """Rank of local light transport matrices: how many singular values hold 99% of their energy ([HR10] 4.1).

    A matrix has the visibility rows, entries 0 and 1, of some dense vertices: neither the cosine nor the noise of
    indirect light adds to its rank. Its energy is the sum of its squared singular values, the eigenvalues of its Gram
    matrix; that one is exact, since products of visibility rows are counts.

    Parameters
    ----------
    bits : (n_dense, words) uint32
        Bit ``j % 32`` of word ``j // 32``.
    neighbours_ids : (m, k) int
        Rows of each matrix; -1 where there are fewer.
    energy : float
        The share of the energy.

    Returns
    -------
    (m,) int64
        0 where a matrix is all zero or has no rows.

    Notes
    -----
    O(m k^2 (words + k)).
    """
    ids = np.ascontiguousarray(neighbours_ids, np.int64)
    if not ids.size or not len(bits):
        return np.zeros(len(ids), np.int64)
    odd = bits.shape[1] % 2
    words = np.ascontiguousarray(np.pad(bits, ((0, 0), (0, odd))) if odd else bits, np.uint32)
    rounding = 1e-9  # 99 of 100 equal singular values hold 0.99, whatever their last bits
    ranks = np.zeros(len(ids), np.int64)
    run_in_parts(_rank_all, len(ids), words.view(np.uint64), ids, energy - rounding, ranks)
    return ranks


@numba.njit(nogil=True, cache=True)
def _rank_all(
    start: int,
    end: int,
    words: NDArray[np.uint64],
    ids: NDArray[np.int64],
    energy: float,
    ranks: NDArray[np.int64],
) -> None:
    """Ranks (m,) of the matrices with rows `ids` (m, k) of `words` (n_dense, w)."""
    for v in range(start, end):
        rows = ids[v][ids[v] >= 0]
        if len(rows):
            ranks[v] = _count_largest(np.linalg.eigvalsh(_gram(words, rows)), energy)


@numba.njit(cache=True)
def _gram(words: NDArray[np.uint64], rows: NDArray[np.int64]) -> NDArray[np.float64]:
    """Products (k, k) of 0/1 rows: how many bits they share."""
    k = len(rows)
    gram = np.empty((k, k))
    for i in range(k):
        a = words[rows[i]]
        for j in range(i + 1):
            b = words[rows[j]]
            shared = np.uint64(0)
            for w in range(len(a)):
                shared += count_ones(a[w] & b[w])  # type: ignore[call-arg]  # numba gives the context
            gram[i, j] = gram[j, i] = shared
    return gram


@numba.njit(cache=True)
def _count_largest(ascending: NDArray[np.floating], energy: float) -> int:
    """How many of the largest values hold this share of their sum; 0 if they are all 0."""
    missing = ascending.sum() * energy
    count = 0
    while missing > 0.0 and count < len(ascending):
        count += 1
        missing -= ascending[-count]
    return count


def _share(fraction: float, n: int) -> int:
    """A share of n vertices, of which there are at least two."""
    return min(n, max(2, round(fraction * n)))


def _word(value: int) -> NDArray[np.uint64]:
    """Any integer as one 64-bit word, negative ones included."""
    return np.array([value & 0xFFFFFFFFFFFFFFFF], dtype=np.uint64)


def _nth_seed(seed: int, iteration: int) -> int:
    """Seeds that share no random numbers between iterations."""
    return int(mix(mix(_word(seed)) + np.uint64(iteration))[0])
