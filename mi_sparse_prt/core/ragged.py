"""Rows of unequal lengths, stored one after another: row i is at ``starts[i]`` to ``starts[i + 1]``."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Ids = NDArray[np.integer]


def row_starts(lengths: Ids) -> NDArray[np.int64]:
    """Where rows of these lengths (n,) begin, and where the last one ends: (n + 1,)."""
    return np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)


def concatenate_ranges(first: Ids, lengths: Ids) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The members ``first[i], ..., first[i] + lengths[i] - 1`` of each range, range after range.

    Parameters
    ----------
    first, lengths : (n,) integers

    Returns
    -------
    owner, member : (m,) int64
        i, and the member; m is the sum of all lengths.
    """
    owner = np.repeat(np.arange(len(lengths)), lengths)
    before = np.cumsum(lengths) - lengths  # members of the ranges in front of each
    return owner, np.arange(len(owner)) + (np.asarray(first, np.int64) - before)[owner]


def select_rows(starts: Ids, ids: Ids) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Some rows, one after another in the order asked for.

    Parameters
    ----------
    starts : (n + 1,) integers
        Of all rows.
    ids : (k,) integers

    Returns
    -------
    starts : (k + 1,) int64
        Of these rows.
    owner, entries : (m,) int64
        For each entry of these rows the place of its row in ``ids``, and its own place among the entries of all rows.
    """
    lengths = np.diff(starts)[ids]
    return row_starts(lengths), *concatenate_ranges(np.asarray(starts)[:-1][ids], lengths)
