"""Clustered principal component analysis: rows near a few affine spaces of few dimensions ([SHHS03], [HR10] 6).

Plain arrays. An item (a vertex) has one row or several (colour channels, terms of a BRDF), all in one cluster.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.threads import one_blas_thread, run_in_parts

ITERATIONS = 1  # of assigning and fitting, for each basis vector
SETTLING = 4  # of them, at the beginning without basis vectors, and at the end with all
CANDIDATES = 4  # clusters that an item may go to until all are compared again ...
COMPARED = 6  # ... which is when this many basis vectors were added
SHORT = (
    1024  # elements of vectors that a compiled loop makes orthonormal sooner than calls of BLAS and LAPACK do
)
MORE = 4  # vectors that the search for principal components carries along
BLOCK = 1 << 22  # products with all clusters at a time
NEGLIGIBLE = 1e-6  # of the first singular value: what is smaller is rounding
COUNTED = 1e6  # squares of singular values within this factor of it are looked at twice

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True)
class Clusters:
    """Affine spaces, and the one of each item.

    Attributes
    ----------
    labels : (n,) int64
    means : (k, m) float32
        A point of each space; zeros where spaces pass through the origin.
    bases : (k, b, m) float32
        Orthonormal rows, the most important first; zeros where a cluster has fewer dimensions.
    """

    labels: Indices
    means: Floats
    bases: Floats

    def __len__(self) -> int:
        return len(self.means)

    def with_labels(self, labels: Indices) -> Clusters:
        """The same spaces."""
        return Clusters(labels, self.means, self.bases)


def standard_cpca(
    rows: Floats,
    weights: Floats,
    clusters: int,
    bases: int,
    centred: bool = True,
    seed: int = 0,
    exhaustive: bool = True,
) -> Clusters:
    """Clustered PCA as [SHHS03] has it: vectors are added one by one, with LBG iterations for each.

    Parameters
    ----------
    rows : (n, g, m) float32
        Of n items.
    weights : (n,) float32
        What an item's squared error counts.
    clusters, bases : int
        At most so many clusters, of so many basis vectors each.
    centred : bool
        Whether spaces pass through the clusters' means, or through the origin.
    seed : int
    exhaustive : bool
        Whether all clusters are compared each time, or, most of the time, those that were nearest the last time.

    Returns
    -------
    Clusters
        None is empty.
    """
    assignment = _Assignment(rows, 1 if exhaustive else CANDIDATES)
    found = seed_clusters(rows, weights, clusters, centred, seed)
    for b in range(bases + 1):
        for repeat in range(ITERATIONS if 0 < b < bases else SETTLING):
            labels = assignment.labels(found, exhaustive or (repeat == 0 and b % COMPARED == 0))
            found = fit_spaces(rows, weights, found.with_labels(labels), b, centred)
    return found


def two_pass_cpca(
    rows: Floats,
    weights: Floats,
    dense: Indices,
    clusters: int,
    bases: int,
    centred: bool = True,
    seed: int = 0,
) -> Clusters:
    """Clustered PCA of few items; the others then join their nearest clusters, and all settle ([HR10] 6, Figure 7).

    Parameters
    ----------
    rows : (n, g, m) float32
    weights : (n,) float32
    dense : (d,) int64
        Items of the first pass.
    clusters, bases, centred, seed
        As ``standard_cpca`` has them.

    Returns
    -------
    Clusters
        Of all items.
    """
    found = standard_cpca(rows[dense], weights[dense], clusters, bases, centred, seed, exhaustive=False)
    return lloyd_refine(rows, weights, found, bases, centred)


def lloyd_refine(rows: Floats, weights: Floats, clusters: Clusters, bases: int, centred: bool) -> Clusters:
    """All items (n, g, m) in their nearest clusters, which follow, a few times; no basis vectors are added."""
    assignment = _Assignment(rows, CANDIDATES)
    for _ in range(SETTLING):
        labels = assignment.labels(clusters)
        clusters = fit_spaces(rows, weights, clusters.with_labels(labels), bases, centred)
    return clusters


class _Assignment:
    """Items (n, g, m) to their nearest clusters, of which those that were near the last time are compared."""

    def __init__(self, rows: Floats, candidates: int) -> None:
        self._rows, self._count, self._compared = rows, candidates, 0
        self._nearest = np.zeros((len(rows), 0), np.int64)  # [item, candidate]

    def labels(self, clusters: Clusters, all_clusters: bool = False) -> Indices:
        """The nearest cluster of each item, (n,); all are compared if asked for, or if some disappeared."""
        if not all_clusters and self._compared == len(clusters):
            return reassign(self._rows, clusters, self._nearest)
        self._nearest, self._compared = nearest_clusters(self._rows, clusters, self._count), len(clusters)
        return self._nearest[:, 0]


def seed_clusters(rows: Floats, weights: Floats, clusters: int, centred: bool, seed: int) -> Clusters:
    """Clusters without basis vectors, around items that are far from each other (k-means++)."""
    rng = np.random.default_rng(seed)
    flat = rows.reshape(len(rows), -1)
    norms = np.einsum("nm,nm->n", flat, flat).astype(np.float64)
    distance = np.full(len(rows), np.inf)
    chosen: list[int] = []
    for _ in range(min(clusters, len(rows))):
        chance = weights * (distance if chosen else np.maximum(norms, 1e-30))
        if not chance.sum() > 1e-12 * (weights @ norms):  # all items are like one that was chosen
            break
        chosen.append(int(rng.choice(len(rows), p=chance / chance.sum())))
        new = norms - 2 * (flat @ flat[chosen[-1]]) + norms[chosen[-1]]
        distance = np.minimum(distance, np.maximum(new, 0))
    chosen = chosen or [0]
    centres = rows[chosen].mean(axis=1)  # [cluster, m]
    empty = np.zeros((len(chosen), 0, rows.shape[2]), np.float32)
    return Clusters(np.zeros(len(rows), np.int64), centres, empty)


def fit_spaces(rows: Floats, weights: Floats, clusters: Clusters, bases: int, centred: bool) -> Clusters:
    """Means and principal components of clusters whose labels are given; the old ones are where the search begins.

    Empty clusters are given the items that are farthest from theirs, as long as these have any error, and disappear
    otherwise.
    """
    clusters = _without_empty(rows, weights, clusters, centred)
    counts = np.bincount(clusters.labels, minlength=len(clusters))
    items = np.split(np.argsort(clusters.labels, kind="stable"), np.cumsum(counts)[:-1])
    k, g, m = len(clusters), rows.shape[1], rows.shape[2]
    start = np.ascontiguousarray(clusters.bases[:, :bases])
    random = random_mixtures(counts.max() * g, bases - start.shape[1])

    means, vectors = np.zeros((k, m), np.float32), np.zeros((k, bases, m), np.float32)

    def fit(turns: Indices) -> None:
        for c in turns:
            own = rows.take(items[c], axis=0).reshape(-1, m)  # where threads do not wait for each other
            means[c], found = affine_space(
                own, np.repeat(weights[items[c]], g), bases, start[c], centred, random
            )
            vectors[c, : len(found)] = found

    threads, sizes = numba.get_num_threads(), np.argsort(-counts, kind="stable")
    with one_blas_thread(), ThreadPoolExecutor(threads) as pool:
        list(pool.map(fit, [sizes[t::threads] for t in range(threads)]))  # large and small ones for each
    return Clusters(clusters.labels, means, vectors)


def random_mixtures(rows: int, missing: int) -> Floats:
    """Coefficients (rows, any) of the combinations of rows that a search for components begins with."""
    return np.random.default_rng(0).standard_normal((rows, max(missing, 0) + MORE), np.float32)


def affine_space(
    rows: Floats, weights: Floats, bases: int, start: Floats, centred: bool, random: Floats
) -> tuple[Floats, Floats]:
    """Mean (m,) and principal components (at most ``bases``, m) of weighted rows (n, m).

    Exact if rows are no more than these, else by a step of subspace iteration from ``start`` (any, m) and combinations
    of rows with random coefficients (>= n, any) (Halko, Martinsson and Tropp 2011, algorithm 4.4). Deviations from the
    mean are never formed.
    """
    n, m = rows.shape
    roots, mean = _centre(rows, weights, centred)
    none = np.zeros((0, m), np.float32)
    if bases == 0:
        return mean, none
    if n <= bases + MORE:
        vectors = _combined(rows, roots, mean, np.eye(n, dtype=np.float32))
    else:
        mixed = _combined(rows, roots, mean, random[:n])
        vectors = _added(np.concatenate((start, mixed)), none)
        vectors = _combined(rows, roots, mean, _weighted(roots, _along(rows, mean, vectors)))
    vectors = _added(vectors, none)
    turned = _principal(_weighted(roots, _along(rows, mean, vectors)), bases, rows)
    return mean, np.dot(turned, vectors)


def refined_space(
    rows: Floats, weights: Floats, products: Floats, centred: bool
) -> tuple[Floats, Floats, Floats]:
    """``affine_space`` by two steps, both kept (block Krylov iteration: Musco and Musco 2015, algorithm 2).

    Parameters
    ----------
    rows : (n, m) float32
    weights : (n,) float32
    products : (n, b) float32
        Of deviations with b vectors that are nearly the components, up to factors.
    centred : bool

    Returns
    -------
    mean : (m,) float32
    components : (at most b, m) float32
    coefficients : (n, at most b) float32
    """
    bases = products.shape[1]
    roots, mean = _centre(rows, weights, centred)
    none = np.zeros((0, rows.shape[1]), np.float32)
    if bases == 0:
        return mean, none, np.zeros((len(rows), 0), np.float32)
    if len(rows) <= bases + MORE:
        vectors = _added(_combined(rows, roots, mean, np.eye(len(rows), dtype=np.float32)), none)
        along = _along(rows, mean, vectors)
        turned = _principal(_weighted(roots, along), bases, rows)
        return mean, np.dot(turned, vectors), np.dot(along, turned.T)
    first = _added(_combined(rows, roots, mean, _weighted(roots, products)), none)
    along = _along(rows, mean, first)
    second = _added(_combined(rows, roots, mean, _weighted(roots, along)), first)
    more = _along(rows, mean, second)
    both = np.concatenate((along, more), axis=1)
    turned = _principal(_weighted(roots, both), bases, rows)
    one, other = np.ascontiguousarray(turned[:, : len(first)]), np.ascontiguousarray(turned[:, len(first) :])
    return mean, np.dot(one, first) + np.dot(other, second), np.dot(both, turned.T)


def _centre(rows: Floats, weights: Floats, centred: bool) -> tuple[Floats, Floats]:
    """Square roots (n,) of what rows count, of 1 together, and their mean (m,), or the origin."""
    share = weights / np.float32(max(weights.sum(), np.float32(1e-30)))
    return np.sqrt(share), np.dot(share, rows) if centred else np.zeros(rows.shape[1], np.float32)


def _along(rows: Floats, mean: Floats, vectors: Floats) -> Floats:
    """Products (n, b) of deviations with vectors (b, m)."""
    return np.dot(rows, vectors.T) - np.dot(vectors, mean)


def _weighted(roots: Floats, products: Floats) -> Floats:
    """Rows of products (n, b), times their roots."""
    return roots.reshape(-1, 1) * products


def _combined(rows: Floats, roots: Floats, mean: Floats, products: Floats) -> Floats:
    """Weighted deviations in combinations (n, b): (b, m)."""
    weighted = _weighted(roots, products)
    found = weighted.T @ rows
    found -= weighted.sum(axis=0)[:, None] * mean
    return found


def _added(vectors: Floats, basis: Floats) -> Floats:
    """What vectors (b, m) add to an orthonormal basis (any, m): orthonormal vectors (at most b, m).

    What depends on others within rounding is left out.
    """
    wide, old = vectors.astype(np.float64), basis.astype(np.float64)
    least = NEGLIGIBLE**2 * np.square(wide).sum()
    for _ in range(2 if len(old) else 0):  # the second time for what rounding left
        wide -= np.dot(np.dot(wide, old.T), old)
    if wide.shape[1] <= SHORT:
        return _orthonormalised(wide, max(least, 1e-36))
    squares, turn = np.linalg.eigh(np.dot(wide, wide.T))
    kept = (squares > max(least, 1e-36)).sum()
    turn = turn[:, len(squares) - kept :] / np.sqrt(squares[len(squares) - kept :])
    return np.dot(np.ascontiguousarray(turn.T), wide).astype(np.float32)


@numba.njit(nogil=True, fastmath=True, cache=True)
def _orthonormalised(vectors: Doubles, least: float) -> Floats:
    """Gram-Schmidt, modified, the longest of what is left first: (at most b, m) of (b, m), which are overwritten.

    Those of which no more than ``least`` is left, squared, are left out.
    """
    b, m = vectors.shape
    squares = np.empty(b)
    for i in range(b):
        squares[i] = 0.0
        for j in range(m):
            squares[i] += vectors[i, j] * vectors[i, j]
    found = np.empty((b, m), np.float32)
    for k in range(b):
        longest = k
        for i in range(k + 1, b):
            if squares[i] > squares[longest]:
                longest = i
        if squares[longest] <= least:
            return found[:k]
        scale = 1 / np.sqrt(squares[longest])
        for j in range(m):
            unit = scale * vectors[longest, j]
            vectors[longest, j] = vectors[k, j]
            vectors[k, j] = unit
            found[k, j] = unit
        squares[longest] = squares[k]
        for i in range(k + 1, b):
            along, left = 0.0, 0.0
            for j in range(m):
                along += vectors[k, j] * vectors[i, j]
            for j in range(m):
                vectors[i, j] -= along * vectors[k, j]
                left += vectors[i, j] * vectors[i, j]
            squares[i] = left
    return found


def _largest(rows: Floats) -> float:
    """The largest magnitude; that of all rows would be as much memory again."""
    return max(float(rows.max()), -float(rows.min()))


def _principal(products: Floats, bases: int, rows: Floats) -> Floats:
    """Combinations (at most ``bases``, b) of orthonormal vectors that are principal components.

    products : (n, b), of weighted deviations with the vectors; rows : (n, m), whose size tells what is rounding.
    """
    wide = products.astype(np.float64)
    values, turn = np.linalg.eigh(np.dot(wide.T, wide))
    least = NEGLIGIBLE**2 * (values.max() if len(values) else 0.0)
    if (values <= COUNTED * least).any() or len(values) < bases:  # what rounding leaves of equal rows
        least = max(least, NEGLIGIBLE**2 * _largest(rows) ** 2)
    kept = min(bases, (values > least).sum())  # the last ones
    return np.ascontiguousarray(turn[:, len(values) - kept :][:, ::-1].T.astype(np.float32))


def nearest_clusters(rows: Floats, clusters: Clusters, count: int) -> Indices:
    """The nearest clusters (n, count) of each item, the nearest first."""
    n, g, m = rows.shape
    k, b = clusters.bases.shape[:2]
    spaces = np.concatenate([clusters.means[:, None], clusters.bases], axis=1).reshape(-1, m).T
    offsets = _offsets(clusters)
    nearest = np.zeros((n, min(count, k)), np.int64)  # of rows that are NaN no distance is the least
    step = max(1, BLOCK // (g * k * (b + 1)))
    for a in range(0, n, step):
        products = (rows[a : a + step].reshape(-1, m) @ spaces).reshape(-1, g, k, b + 1)
        _closest(products, offsets, nearest[a : a + step])
    return nearest


def _offsets(clusters: Clusters) -> Floats:
    """Squared norm of each mean, then its products with the basis vectors, (k, 1 + b)."""
    squares = np.einsum("km,km->k", clusters.means, clusters.means)
    along = np.einsum("kbm,km->kb", clusters.bases, clusters.means)
    return np.concatenate([squares[:, None], along], axis=1).astype(np.float32)


@numba.njit(parallel=True, fastmath=True, cache=True)
def _closest(products: Floats, offsets: Floats, nearest: Indices) -> None:
    """Of squared distances to affine spaces, but for the squared norm of the rows, the least.

    products : (n, g, k, 1 + b), of rows with means and basis vectors; nearest : (n, count), filled in.
    """
    n, g, k, b = products.shape
    count = nearest.shape[1]
    for i in numba.prange(n):
        best = np.full(count, np.float32(np.inf), np.float32)
        for c in range(k):
            distance = np.float32(0)
            for row in range(g):
                distance += offsets[c, 0] - 2 * products[i, row, c, 0]
                for q in range(1, b):
                    along = products[i, row, c, q] - offsets[c, q]
                    distance -= along * along
            if distance < best[count - 1]:
                place = count - 1
                while place > 0 and best[place - 1] > distance:
                    best[place] = best[place - 1]
                    nearest[i, place] = nearest[i, place - 1]
                    place -= 1
                best[place] = distance
                nearest[i, place] = c


def reassign(rows: Floats, clusters: Clusters, candidates: Indices) -> Indices:
    """The nearest of each item's candidates (n, any): labels (n,)."""
    squares = squared_distances(rows, clusters, candidates)
    return np.take_along_axis(candidates, squares.argmin(axis=1)[:, None], axis=1)[:, 0]


def squared_distances(rows: Floats, clusters: Clusters, candidates: Indices) -> Floats:
    """Of each item to some clusters (n, any), summed over its rows."""
    squares = np.empty(candidates.shape, np.float32)
    near = np.ascontiguousarray(candidates)  # one layout: compiled once
    run_in_parts(_fill_squares, len(rows), rows, clusters.means, clusters.bases, near, squares)
    return squares


@numba.njit(nogil=True, fastmath=True, cache=True)
def _fill_squares(
    start: int, end: int, rows: Floats, means: Floats, bases: Floats, candidates: Indices, squares: Floats
) -> None:
    """Squared distances of items (n, g, m) to some clusters (n, any), summed over rows."""
    away = np.empty(rows.shape[2], np.float32)
    for i in range(start, end):
        for which in range(candidates.shape[1]):
            c, total = candidates[i, which], np.float32(0)
            for row in range(rows.shape[1]):
                for j in range(len(away)):
                    away[j] = rows[i, row, j] - means[c, j]
                    total += away[j] * away[j]
                for k in range(bases.shape[1]):
                    along = np.float32(0)
                    for j in range(len(away)):
                        along += away[j] * bases[c, k, j]
                    total -= along * along
            squares[i, which] = total


def _without_empty(rows: Floats, weights: Floats, clusters: Clusters, centred: bool) -> Clusters:
    counts = np.bincount(clusters.labels, minlength=len(clusters))
    empty = np.flatnonzero(counts == 0)
    if not len(empty):
        return clusters
    labels, bases = clusters.labels.copy(), clusters.bases.copy()
    own = clusters.labels[:, None]
    errors = weights * np.maximum(squared_distances(rows, clusters, own)[:, 0], 0)
    errors[errors <= 1e-10 * (weights * np.einsum("ngm,ngm->n", rows, rows)).max(initial=0)] = 0
    for c, i in zip(empty, np.argsort(-errors, kind="stable"), strict=False):
        if errors[i] > 0 and counts[labels[i]] > 1:
            counts[labels[i]] -= 1
            labels[i], bases[c] = c, 0
    kept, labels = np.unique(labels, return_inverse=True)
    return Clusters(labels.astype(np.int64), clusters.means[kept], bases[kept])
