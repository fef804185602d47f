"""Rows that columns suggest: where lights shine whose light few samples see ([HPB07] 5, as further work).

Rows at even distances miss what is lit in small places, as of a lamp in a recess: its columns seem dark, and are in
clusters of others. Half of the rows are at even distances here. What these say of the columns is enough to choose some;
those are looked at where many more samples are, and the other half of the rows are drawn where they are bright.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.manylights.elements import (
    Done,
    Elements,
    Floats,
    ReducedColumns,
    Representatives,
    SeenRows,
)

FIRST_SHARE = 0.5  # of the rows are at even distances,
MOST_FIRST = 250  # but no more: their elements are kept until it is known what each row counts for
MOST_COLUMNS = 300  # that suggest rows
LOOKED_AT = 1 / 64  # of the samples: as many elements as a 64th of all columns,
MOST_LOOKED_AT = 20_000  # so that these are in memory

Ids = NDArray[np.int64]
Doubles = NDArray[np.float64]


def reduce_columns(
    elements: Elements,
    projection: Floats,
    choose: Callable[[ReducedColumns], Representatives],
    seed: int,
    done: Done = lambda _: None,
    parts: Ids | None = None,
) -> ReducedColumns:
    """Columns at rows of which half are suggested by some columns.

    Parameters
    ----------
    elements : Elements
    projection : (r, r') float32
        For r rows in all.
    choose : callable
        Is given the columns at the first rows; returns one set of representatives.
    seed : int
    done, parts
        See ``Elements.reduce_columns``.
    """
    count = len(projection)
    first = elements.samples.stratified_rows(max(1, min(round(FIRST_SHARE * count), MOST_FIRST)), seed)
    k = len(first)
    kept = elements.reduce_columns(first, np.eye(k, dtype=np.float32), done, parts=parts)
    columns = choose(kept._replace(projected=kept.projected @ projection[:k]))
    more, weights = suggested_rows(elements, first, columns, count, seed)
    others = elements.reduce_columns(more, projection[k : k + len(more)], done, weights[k:], parts)
    return joined(kept, weights[:k], projection[:k], others)


def joined(
    kept: ReducedColumns, weights: Doubles, projection: Floats, others: ReducedColumns
) -> ReducedColumns:
    """Columns at some rows (n, k), which are weighted and projected now, and at others; norms of colours alone."""
    assert kept.seen is not None and others.seen is not None
    own = np.square(kept.projected) @ np.square(weights).astype(np.float32)
    squares = own + np.square(others.norms)
    first = SeenRows(kept.seen.ids, weights, kept.seen.sums * weights[:, None])
    return ReducedColumns(
        kept.projected @ (weights[:, None].astype(np.float32) * projection) + others.projected,
        np.sqrt(squares),
        np.zeros((len(squares), 0)),
        first.and_others(others.seen),
    )


def suggested_rows(
    elements: Elements, first: Ids, columns: Representatives, count: int, seed: int
) -> tuple[Ids, Doubles]:
    """Rows beside the first ones, and what all rows count for.

    Parameters
    ----------
    elements : Elements
    first : (k,) int64
        Rows at even distances.
    columns : Representatives
        One set, which stands for all of them.
    count : int
        Rows in all.
    seed : int

    Returns
    -------
    rows : (about count - k,) int64
    weights : (k + len(rows),) float64
        Of the first ones, then of these: elements of a row are multiplied with it. Its square is ``count / m`` by how
        many rows one may expect there, so that squared norms of columns are those of as many rows at even distances.

    Notes
    -----
    The norm of a column, the root of a sum of squares, is known best by rows drawn in proportion to these. Of several
    columns, whose errors add up, it is the root of the sum of their squared shares, each times the column's energy.
    """
    samples = elements.samples
    looked_at = max(min(max(round(LOOKED_AT * len(samples)), 4 * count), MOST_LOOKED_AT), 2 * count)
    others = np.setdiff1d(samples.stratified_rows(looked_at, seed), first)
    every = np.append(first, others)
    wanted = bright_places(elements, every, columns)
    even = np.full(len(every), len(first) / len(samples))  # how many of the first are expected at a row
    rate = _rate(wanted[len(first) :], count - len(first))
    chance = np.minimum(wanted * rate, 1)  # the first ones', had they been among the others
    edges = np.floor(np.cumsum(chance[len(first) :]) + np.random.default_rng(seed).random())
    drawn = len(first) + np.flatnonzero(np.diff(edges, prepend=0.0) > 0)[: count - len(first)]
    chosen = np.append(np.arange(len(first)), drawn)
    expected = even + chance * (len(others) / len(samples))
    return every[drawn], np.sqrt(count / len(samples) / expected[chosen])


def bright_places(elements: Elements, rows: Ids, columns: Representatives) -> Doubles:
    """How much each row (k,) tells of the norms of columns, in any unit."""
    values = elements.block(rows, columns.ids[0])
    squares = np.square(values).sum(axis=2) * np.square(columns.weights[0, :, 0], dtype=np.float64)
    energy = squares.sum(axis=0)
    shares = np.divide(squares, energy, out=np.zeros_like(squares), where=energy > 0)
    found: Doubles = np.sqrt(np.square(shares) @ energy)
    return found


def _rate(wanted: Doubles, count: int) -> float:
    """By which what is wanted is multiplied, and is 1 at most then, so that the sum is ``count`` or near it."""
    descending = np.sort(wanted[wanted > 0])[::-1]
    rest = np.cumsum(descending[::-1])[::-1]  # of each and all smaller ones
    rates = np.maximum(count - np.arange(len(descending)), 0) / rest
    fits = np.flatnonzero(rates * descending <= 1)  # as many are certain as are before the first of these
    return float(rates[fits[0]]) if len(fits) else 1 / max(float(wanted.min(initial=1)), 1e-300)
