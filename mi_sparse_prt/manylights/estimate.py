"""The sum of all columns from a column of each cluster, and how far off that is ([HPB07] 3.3, 4, Appendix A)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.manylights.elements import Done, Elements, Floats, ReducedColumns
from mi_sparse_prt.sampling.row_column import cluster_columns, cluster_costs, split_clusters, with_lengths

DEFENSIVE = 0.1  # of the mean norm, added to all of them: columns may be brighter than rows say
EVERYWHERE = 0.5  # of the weights of a slice's own rows, those of all rows count as well: its rows are few
UNSEEN = 0.1  # of the clusters, at most, are for columns that no row sees
SECOND = 0.1  # of the clusters have a second representative, which tells the error

Ids = NDArray[np.int64]
Doubles = NDArray[np.float64]


@dataclass(frozen=True)
class Partition:
    """Clusters of columns.

    Attributes
    ----------
    clusters : list of (size,) int64
        Lights of each; no light is in two.
    drawing : (n,) float64
        In proportion to which a light represents its cluster, above 0 for lights in clusters.
    costs : (c,) float64
        Of each cluster, as rows see it.
    """

    clusters: list[Ids]
    drawing: Doubles
    costs: Doubles

    def __len__(self) -> int:
        return len(self.clusters)

    def numbered(self, ids: Ids, lights: int) -> Partition:
        """Of some of ``lights`` columns, by their numbers among all."""
        drawing = np.zeros(lights)
        drawing[ids] = self.drawing
        return Partition([ids[own] for own in self.clusters], drawing, self.costs)


class Representatives(NamedTuple):
    """A column of each cluster: (c,) int64, and what it is multiplied with: (c, 3) float32."""

    ids: Ids
    weights: Floats


class Estimate(NamedTuple):
    """The sum of all columns.

    Attributes
    ----------
    values : (m, 3) float32
        Radiance of samples.
    squared_error : float
        Expected, over pixels and channels, where a pixel is the mean of its samples; NaN where it was not estimated.
    """

    values: Floats
    squared_error: float


def published_partition(reduced: ReducedColumns, count: int, rng: np.random.Generator) -> Partition:
    """As [HPB07] has it: columns that no row sees are ignored, representatives are drawn by their reduced norms.

    Parameters
    ----------
    reduced : ReducedColumns
    count : int
        Clusters.
    rng : np.random.Generator
    """
    return _partition(reduced, np.flatnonzero(reduced.norms > 0), reduced.norms, count, rng)


def defensive_partition(
    reduced: ReducedColumns, flux: Doubles, count: int, rng: np.random.Generator
) -> Partition:
    """All columns in clusters: no norm counts as less than a share of the mean one, so that no weight is huge.

    Columns that no row sees have clusters of their own, of neighbours, and are drawn by their flux.

    Parameters
    ----------
    reduced : ReducedColumns
    flux : (n,) float64
        Of the lights, none of them 0.
    count : int
        Clusters; one more where that is 1, and rows see some columns but not all.
    rng : np.random.Generator
    """
    seen = reduced.norms > 0
    lit, unseen = np.flatnonzero(seen), np.flatnonzero(~seen)
    dark = min(len(unseen), count)
    if len(lit) and len(unseen):
        share = flux[unseen].sum() / flux.sum()
        dark = min(dark, max(1, round(UNSEEN * count * share)))
    drawing = reduced.norms + (DEFENSIVE * reduced.norms[lit].mean() if len(lit) else 0)
    found = _partition(reduced, lit, drawing, max(count - dark, 1 if len(lit) else 0), rng)
    if not dark:
        return found
    drawing[unseen] = flux[unseen]
    middle = np.cumsum(flux[unseen]) - flux[unseen] / 2
    piece = np.minimum((middle / flux[unseen].sum() * dark).astype(np.int64), dark - 1)
    others = [unseen[piece == k] for k in range(dark) if (piece == k).any()]
    return Partition([*found.clusters, *others], drawing, np.append(found.costs, np.zeros(len(others))))


@dataclass(frozen=True)
class LocalPartitions:
    """Clusters of columns for each slice of samples (Ou and Pellacini: LightSlice, 2011), equally many of each.

    Attributes
    ----------
    slices : (m,) int64
        To which slice each sample belongs.
    partitions : list of Partition
    """

    slices: Ids
    partitions: list[Partition]

    def __len__(self) -> int:
        return max(map(len, self.partitions), default=0)

    def numbered(self, ids: Ids, lights: int) -> LocalPartitions:
        """See ``Partition``."""
        return LocalPartitions(
            self.slices, [partition.numbered(ids, lights) for partition in self.partitions]
        )


def refined(
    partition: Partition,
    reduced: ReducedColumns,
    slices: Ids,
    rows_of: list[Ids],
    count: int,
    rng: np.random.Generator,
) -> LocalPartitions:
    """Split clusters further for each slice of samples, those that cost most at the rows near it.

    Parameters
    ----------
    partition : Partition
        Of all samples.
    reduced : ReducedColumns
    slices : (m,) int64
        To which slice each sample belongs.
    rows_of : list of (k,) int64
        Rows that tell about each slice, by their places among ``reduced.rows``.
    count : int
        Clusters of each slice.
    rng : np.random.Generator
    """
    unseen = reduced.norms <= 0
    found = []
    for own in rows_of:
        x = (reduced.kept[own].astype(np.float32) * reduced.scales[own, None]).T  # [light, row]
        norms = np.linalg.norm(x, axis=1).astype(np.float64)
        every = partition.drawing / max(partition.drawing[~unseen].sum(), 1e-300)
        drawing = norms + norms.sum() * (EVERYWHERE * every + DEFENSIVE / len(norms))
        drawing[unseen] = partition.drawing[unseen]
        drawing = drawing if norms.any() else partition.drawing
        clusters = split_clusters(np.ascontiguousarray(x), norms, partition.clusters, count, rng)
        found.append(Partition(clusters, drawing, cluster_costs(x, norms, clusters)))
    return LocalPartitions(slices, found)


def _partition(
    reduced: ReducedColumns, ids: Ids, drawing: Doubles, count: int, rng: np.random.Generator
) -> Partition:
    norms = reduced.norms[ids]
    x = with_lengths(reduced.projected[ids], norms)
    clusters = cluster_columns(x, norms, count, rng)
    return Partition([ids[own] for own in clusters], drawing, cluster_costs(x, norms, clusters))


def draw_representatives(partition: Partition, rng: np.random.Generator) -> Representatives:
    """A light of each cluster, drawn in proportion to its weight w, times sum(w) / w: unbiased ([HPB07] 3.3)."""
    ids, scale = _drawn(partition, rng)
    return Representatives(ids, np.repeat(scale[:, None], 3, axis=1).astype(np.float32))


def draw_coloured_representatives(
    partition: Partition, channel_norms: Doubles, rng: np.random.Generator
) -> Representatives:
    """The same, but that the representative is given the cluster's total colour ([HPB07] 4): biased.

    Channels that a representative does not have keep the scale of the others.

    Parameters
    ----------
    partition : Partition
    channel_norms : (n, 3) float64
        Norms of the reduced columns, by channel.
    rng : np.random.Generator
    """
    ids, scale = _drawn(partition, rng)
    total = np.array([channel_norms[own].sum(axis=0) for own in partition.clusters]).reshape(-1, 3)
    own = channel_norms[ids]
    weights = np.divide(total, own, out=np.repeat(scale[:, None], 3, axis=1), where=own > 0)
    return Representatives(ids, weights.astype(np.float32))


def _drawn(partition: Partition, rng: np.random.Generator) -> tuple[Ids, Doubles]:
    ids, scale = np.zeros(len(partition), np.int64), np.zeros(len(partition))
    for k, (own, u) in enumerate(zip(partition.clusters, rng.random(len(partition)), strict=True)):
        weights = partition.drawing[own]
        sums = np.cumsum(weights)
        place = min(int(np.searchsorted(sums, u * sums[-1], side="right")), len(own) - 1)
        ids[k], scale[k] = own[place], sums[-1] / weights[place]
    return ids, scale


def sum_with_error(
    elements: Elements, local: LocalPartitions, rng: np.random.Generator, done: Done = lambda _: None
) -> Estimate:
    """The sum of all columns by one representative of each cluster, two of some, which tell the expected error.

    For independent X and X' alike, E|X - E X|^2 = E|X - X'|^2 / 2 ([HPB07] Appendix A): here of whole columns, as the
    image shows them. Those clusters are drawn by cost and by energy, and count by the mean of their two.

    Parameters
    ----------
    elements : Elements
    local : LocalPartitions
        The clusters of each slice, the dearest first: the k-th of all slices are one column.
    rng : np.random.Generator
    done : callable
        Is told how many columns more are done.
    """
    ordered = [_dearest_first(partition) for partition in local.partitions]
    first, second = _padded(ordered, rng), _padded(ordered, rng)
    chance = _chances(ordered)
    twice = np.flatnonzero(_systematic(chance, rng))
    once = np.setdiff1d(np.arange(len(chance)), twice)
    values = elements.sum_columns(first.ids[:, once], first.weights[:, once], done, local.slices)
    ids = np.stack([first.ids[:, twice], second.ids[:, twice]], axis=2).reshape(len(ordered), -1)
    weights = np.stack([first.weights[:, twice], second.weights[:, twice]], axis=2)
    means, squares = elements.sum_pairs(ids, weights.reshape(len(ordered), -1, 3), done, local.slices)
    squared = float((squares / 2 * (1 / chance[twice] - 1 / 2)).sum())
    values += means
    return Estimate(values, squared if len(twice) else (0.0 if not chance.any() else float("nan")))


def everywhere(partition: Partition, samples: int) -> LocalPartitions:
    """The same clusters for all samples."""
    return LocalPartitions(np.zeros(samples, np.int64), [partition])


def _dearest_first(partition: Partition) -> Partition:
    order = np.argsort(-_sizes(partition), kind="stable")
    return Partition([partition.clusters[k] for k in order], partition.drawing, partition.costs[order])


def _padded(partitions: list[Partition], rng: np.random.Generator) -> Representatives:
    """Representatives (slices, c) of all slices; where a slice has fewer clusters, columns that count nothing."""
    found = [draw_representatives(partition, rng) for partition in partitions]
    count = max(len(some.ids) for some in found)
    ids, weights = np.zeros((len(found), count), np.int64), np.zeros((len(found), count, 3), np.float32)
    for k, some in enumerate(found):
        ids[k, : len(some.ids)], weights[k, : len(some.ids)] = some
    return Representatives(ids, weights)


def _sizes(partition: Partition) -> Doubles:
    """How much clusters may be off, by their cost and by their energy; 0 of single lights."""
    several = np.array([len(own) > 1 for own in partition.clusters], bool)
    energy = np.array([partition.drawing[own].sum() for own in partition.clusters]) ** 2 * several
    cost = partition.costs * several
    size: Doubles = np.sqrt(cost / max(cost.sum(), 1e-300)) + np.sqrt(energy / max(energy.sum(), 1e-300))
    return size


def _chances(partitions: list[Partition]) -> Doubles:
    """Of each column of clusters to have second representatives; 0 where there is but one light in each."""
    size = np.zeros(max(map(len, partitions)))
    for partition in partitions:
        size[: len(partition)] += _sizes(partition)
    wanted = min(max(SECOND * len(size), 2), int((size > 0).sum()))
    total = size.sum()
    return np.minimum(size * (wanted / total), 1) if total > 0 else size


def _systematic(chance: Doubles, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Items with these chances, about as many as their sum."""
    edges = np.floor(np.cumsum(chance) + rng.random())
    return np.diff(edges, prepend=0.0) > 0 if len(edges) else np.zeros(0, bool)
