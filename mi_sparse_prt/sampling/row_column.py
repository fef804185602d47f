"""Clusters of columns of a matrix by what a few of its rows say of them: matrix row-column sampling [HPB07].

The columns of these rows are the paper's reduced columns. Here they are rows of an array (n, r), one for each light.
What a pair of them costs in one cluster is ``d(x, y) = |x| |y| (1 - cos(x, y))``: not negative, symmetric, and 0 where
one is a multiple of the other; not a metric. Columns of zeros have no direction, cost nothing, and are left out by the
callers. Where rounding makes a cost negative it counts as 0.

[HPB07] Hasan, Pellacini, Bala: Matrix Row-Column Sampling for the Many-Light Problem, 2007.
"""

from __future__ import annotations

import heapq
from typing import Any

import numpy as np
from numpy.typing import NDArray

Ids = NDArray[np.int64]
Columns = NDArray[Any]  # float32 or float64
Doubles = NDArray[np.float64]

BY_SAMPLING = 2 / 3  # of the clusters; the others are made by splitting ([HPB07] 3.5)
DISTANCES = 1 << 18  # at a time, so that they stay in the cache


def random_projection(rows: int, dimensions: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Gaussian projection (rows, dimensions) that keeps lengths and angles, about ([HPB07] 4).

    With no more rows than dimensions it is the identity: nothing is lost.
    """
    if rows <= dimensions:
        return np.eye(rows, dtype=np.float32)
    found: NDArray[np.float32] = rng.standard_normal((rows, dimensions), np.float32)
    return found / np.float32(np.sqrt(dimensions))


def with_lengths(x: Columns, norms: Doubles) -> Columns:
    """Columns (n, r) of other lengths (n,): projected ones, so that no column costs anything beside itself."""
    own = np.linalg.norm(x, axis=1)
    scale = np.divide(norms, own, out=np.zeros(len(x)), where=own > 0)
    return x * scale[:, None].astype(x.dtype)


def cluster_columns(x: Columns, norms: Doubles, count: int, rng: np.random.Generator) -> list[Ids]:
    """Partition columns into clusters of little cost: by sampling, then by splitting ([HPB07] 3.5).

    Parameters
    ----------
    x : (n, r) float32 or float64
        Columns, none of which is zero.
    norms : (n,) float
        Their lengths.
    count : int
        Clusters.
    rng : np.random.Generator

    Returns
    -------
    list of (size,) int64
        ``min(count, n)`` clusters, none of which is empty.
    """
    count = min(count, len(x))
    if not count:
        return []
    clusters = cluster_by_sampling(x, norms, min(count, max(1, round(BY_SAMPLING * count))), rng)
    return split_clusters(x, norms, clusters, count, rng)


def cluster_by_sampling(x: Columns, norms: Doubles, count: int, rng: np.random.Generator) -> list[Ids]:
    """Columns with the nearest of ``count`` centres, whose lengths are scaled by how unlikely they were drawn.

    Parameters are those of ``cluster_columns``. Where rounding, or a parallel centre, would leave a cluster empty, its
    centre stays in it. There are fewer clusters where fewer columns cost anything.
    """
    alpha = costs_beside_all(x, norms)
    p = alpha / alpha.sum() if alpha.any() else np.full(len(x), 1 / len(x))
    centres, times = draw_distinct(p, count, rng)
    owner = nearest_centre(x, norms, centres, times / p[centres])
    owner[centres] = np.arange(len(centres))
    order = np.argsort(owner, kind="stable")
    return np.split(order, np.cumsum(np.bincount(owner, minlength=len(centres)))[:-1])


def costs_beside_all(x: Columns, norms: Doubles) -> Doubles:
    """Alpha (n,): cost of each column beside all others ([HPB07] 3.5), by ``(n_R^T n_R - R^T R) 1``."""
    return np.asarray(np.maximum(norms * norms.sum() - x @ x.sum(axis=0), 0), np.float64)


def draw_distinct(p: Doubles, count: int, rng: np.random.Generator) -> tuple[Ids, Ids]:
    """Items drawn with probabilities p, with replacement, until `count` are distinct; and how often each came.

    In continuous time, at rates p: when an item first comes is an exponential number, and how often it comes again
    before the last one does is a Poisson number.
    """
    first = np.full(len(p), np.inf)
    np.divide(rng.exponential(size=len(p)), p, out=first, where=p > 0)
    items = np.argsort(first, kind="stable")[: min(count, int((p > 0).sum()))]
    return items, 1 + rng.poisson(p[items] * (first[items[-1]] - first[items]))


def nearest_centre(x: Columns, norms: Doubles, centres: Ids, weights: Doubles) -> Ids:
    """Which centre (n,) each column is nearest to; distances are ``n_K^T n_R - K^T R`` times weights, in blocks."""
    owner, own, scale = np.empty(len(x), np.int64), norms.astype(x.dtype), weights.astype(x.dtype)
    directions, lengths = (x[centres] * scale[:, None]).T, own[centres] * scale
    step = max(1, DISTANCES // max(len(centres), 1))
    for a in range(0, len(x), step):
        part = slice(a, a + step)
        distance = own[part, None] * lengths  # [column, centre]
        distance -= x[part] @ directions
        np.maximum(distance, 0, out=distance)
        owner[part] = np.argmin(distance, axis=1)
    return owner


def split_clusters(
    x: Columns, norms: Doubles, clusters: list[Ids], count: int, rng: np.random.Generator
) -> list[Ids]:
    """Split the dearest cluster until there are ``count``, or as many as columns."""
    known = cluster_costs(x, norms, clusters)
    heap = [(-cost if len(clusters[k]) > 1 else 1.0, k) for k, cost in enumerate(known.tolist())]
    found, count = dict(enumerate(clusters)), min(count, sum(map(len, clusters)))
    heapq.heapify(heap)
    new = len(clusters)
    while len(found) < count:
        _, dearest = heapq.heappop(heap)
        pieces, costs = _cut(x, norms, found.pop(dearest), rng)
        for members, cost in zip(pieces, costs, strict=True):
            found[new] = members
            heapq.heappush(heap, (-cost if len(members) > 1 else 1.0, new))
            new += 1
    return list(found.values())


def cluster_costs(x: Columns, norms: Doubles, clusters: list[Ids]) -> Doubles:
    """Costs (c,) of clusters, none of which is empty: of each, the sum over its pairs."""
    if not clusters:
        return np.zeros(0)
    order, sizes = np.concatenate(clusters), [len(members) for members in clusters]
    first = np.cumsum([0, *sizes[:-1]])
    sums = np.add.reduceat(x[order], first, axis=0, dtype=np.float64)
    lengths = np.add.reduceat(norms[order], first, dtype=np.float64)
    found: Doubles = np.maximum(lengths**2 - (sums**2).sum(axis=1), 0)
    return found


def costs_of_cuts(x: Columns, norms: Doubles) -> tuple[Doubles, Doubles]:
    """Costs (n - 1,) of the clusters of the first 1, 2, ... of n columns, and of those of all others."""
    sums, lengths = np.cumsum(x, axis=0, dtype=np.float64), np.cumsum(norms, dtype=np.float64)
    squares = np.einsum("ij,ij->i", sums, sums)
    others = squares[-1] - 2 * (sums @ sums[-1]) + squares
    first, last = lengths**2 - squares, (lengths[-1] - lengths) ** 2 - others
    return np.maximum(first, 0)[:-1], np.maximum(last, 0)[:-1]


def split_cluster(x: Columns, norms: Doubles, members: Ids, rng: np.random.Generator) -> tuple[Ids, Ids]:
    """A cluster of two or more, cut at the best place along a random line of directions."""
    return _cut(x, norms, members, rng)[0]


def _cut(
    x: Columns, norms: Doubles, members: Ids, rng: np.random.Generator
) -> tuple[tuple[Ids, Ids], tuple[float, float]]:
    """``split_cluster``, and the costs of both pieces."""
    own, lengths = x[members], norms[members]
    along = own @ rng.normal(size=(x.shape[1],)).astype(x.dtype)
    np.divide(along, lengths, out=along, where=lengths > 0)  # where some are zero, for all that matters
    order = np.argsort(along, kind="stable")
    own, lengths = own[order], lengths[order]
    before, after = costs_of_cuts(own, lengths)
    best = int(np.argmin(before + after))
    ordered = members[order]
    return (ordered[: best + 1], ordered[best + 1 :]), (float(before[best]), float(after[best]))
