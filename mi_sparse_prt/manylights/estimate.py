"""The sum of all columns from a column of each cluster, and how far off that is ([HPB07] 3.3, 4, Appendix A)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.manylights.calibration import calibrate
from mi_sparse_prt.manylights.elements import (
    Done,
    Elements,
    Floats,
    ReducedColumns,
    Representatives,
    SeenRows,
)
from mi_sparse_prt.sampling.row_column import cluster_columns, cluster_costs, with_lengths

DEFENSIVE = 0.1  # of the mean norm, added to all of them: columns may be brighter than rows say
SECOND = 0.5  # of the clusters have second representatives, which tell the error,
PIXELS = 1 / 32  # at so many of the pixels: clusters differ more from each other than pixels do
FEWEST_PIXELS = 1024

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

    Columns that no row sees have clusters of their own, as many as is their share of the flux, of neighbours, and are
    drawn by their flux.

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
        dark = min(dark, max(1, round(count * share)))
    drawing = reduced.norms + (DEFENSIVE * reduced.norms[lit].mean() if len(lit) else 0)
    found = _partition(reduced, lit, drawing, max(count - dark, 1 if len(lit) else 0), rng)
    if not dark:
        return found
    drawing[unseen] = flux[unseen]
    middle = np.cumsum(flux[unseen]) - flux[unseen] / 2
    piece = np.minimum((middle / flux[unseen].sum() * dark).astype(np.int64), dark - 1)
    others = [unseen[piece == k] for k in range(dark) if (piece == k).any()]
    return Partition([*found.clusters, *others], drawing, np.append(found.costs, np.zeros(len(others))))


def _partition(
    reduced: ReducedColumns, ids: Ids, drawing: Doubles, count: int, rng: np.random.Generator
) -> Partition:
    norms = reduced.norms[ids]
    x = with_lengths(np.ascontiguousarray(reduced.projected[ids]), norms)
    clusters = cluster_columns(x, norms, count, rng)
    return Partition([ids[own] for own in clusters], drawing, cluster_costs(x, norms, clusters))


def draw_representatives(partition: Partition, sets: int, rng: np.random.Generator) -> Representatives:
    """Sets of lights, one of each cluster, drawn in proportion to their weights w, times sum(w) / w ([HPB07] 3.3).

    Each set alone is unbiased. Those of a cluster are apart: its members, in their order, are cut into as many pieces
    of equal weight, and each set has one of another piece.
    """
    shape = sets, len(partition)
    ids, scale = np.zeros(shape, np.int64), np.zeros(shape)
    pieces = rng.permuted(np.repeat(np.arange(sets)[:, None], len(partition), axis=1), axis=0)
    u = (pieces + rng.random(len(partition))) / sets
    for k, own in enumerate(partition.clusters):
        ids[:, k], scale[:, k] = _drawn(partition.drawing[own], own, u[:, k])
    return Representatives(ids, np.repeat(scale[..., None], 3, axis=2).astype(np.float32))


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
    drawn = draw_representatives(partition, 1, rng)
    ids, weights = drawn.ids[0], drawn.weights[0]
    total = np.array([channel_norms[own].sum(axis=0) for own in partition.clusters]).reshape(-1, 3)
    own = channel_norms[ids]
    return Representatives(ids, np.divide(total, own, out=weights, where=own > 0, casting="same_kind"))


def _drawn(weights: Doubles, members: Ids, u: Doubles) -> tuple[Ids, Doubles]:
    """Members at these places along their weights, of 0 to 1, and by what each is scaled."""
    sums = np.cumsum(weights)
    place = np.minimum(np.searchsorted(sums, u * sums[-1], side="right"), len(members) - 1)
    return members[place], sums[-1] / weights[place]


def sum_with_error(
    elements: Elements,
    partition: Partition,
    sets: int,
    rng: np.random.Generator,
    done: Done = lambda _: None,
    seen: SeenRows | None = None,
) -> Estimate:
    """The sum of all columns by representatives of each cluster, and the expected error.

    Parameters
    ----------
    elements : Elements
    partition : Partition
    sets : int
        Of representatives, in turn for the samples of a pixel: what one set has too much of, others lack.
    rng : np.random.Generator
    done : callable
        Is told how many columns more are done.
    seen : SeenRows, optional
        Whose first sums are those of all lights of the partition: weights are calibrated by them. Without, the
        estimate has no bias.
    """
    first, second = (draw_representatives(partition, sets, rng) for _ in range(2))
    ours, left = calibrate(elements, seen, first) if seen is not None else (first, 1.0)
    values = elements.sum_columns(ours.ids, ours.weights, done)
    return Estimate(values, left * _squared_error(elements, partition, first, second, rng))


def _squared_error(
    elements: Elements,
    partition: Partition,
    first: Representatives,
    second: Representatives,
    rng: np.random.Generator,
) -> float:
    """Expected, by second representatives of some clusters at some pixels; NaN where none has any.

    For independent X and X' alike, E|X - E X|^2 = E|X - X'|^2 / 2 ([HPB07] Appendix A): here of whole columns, as the
    image shows them. Clusters are drawn by cost and by energy, and count by the inverse of their chance.
    """
    chance = _chances(partition)
    twice = np.flatnonzero(_systematic(chance, rng))
    if not len(twice):
        return float("nan") if chance.any() else 0.0
    count = max(round(PIXELS * math.prod(elements.samples.shape)), FEWEST_PIXELS)
    rows, pixels = elements.samples.rows_of_pixels(count, rng)
    ids = np.stack([first.ids[:, twice], second.ids[:, twice]], axis=2).reshape(len(first.ids), -1)
    weights = np.stack([first.weights[:, twice], second.weights[:, twice]], axis=2).reshape(*ids.shape, 3)
    squares = elements.squared_differences(ids, weights, rows)
    return float((squares / 2 / chance[twice]).sum() * pixels)


def _chances(partition: Partition) -> Doubles:
    """Of each cluster to have second representatives, by its cost and by its energy; 0 where there is but one light."""
    several = np.array([len(own) > 1 for own in partition.clusters], bool)
    energy = np.array([partition.drawing[own].sum() for own in partition.clusters]) ** 2 * several
    cost = partition.costs * several
    size = np.sqrt(cost / max(cost.sum(), 1e-300)) + np.sqrt(energy / max(energy.sum(), 1e-300))
    wanted, total = min(max(SECOND * len(size), 2), int((size > 0).sum())), size.sum()
    chance: Doubles = np.minimum(size * (wanted / total), 1) if total > 0 else size
    return chance


def _systematic(chance: Doubles, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Items with these chances, about as many as their sum."""
    edges = np.floor(np.cumsum(chance) + rng.random())
    return np.diff(edges, prepend=0.0) > 0 if len(edges) else np.zeros(0, bool)
