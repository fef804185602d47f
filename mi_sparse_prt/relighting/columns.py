"""T by wavelets and columns: what moving light reads, where compression keeps rows ([NRH03], [OBRG06] equation 1).

Columns are transposed lists of ``operators.haar_rows``: the same numbers, in blocks of rows, so that the sums
of a block stay in the cache and a place within it has 16 bits.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.compression.haar_truncation import haar_lists
from mi_sparse_prt.core.threads import run_in_parts
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.operators.haar_rows import HaarRows, half_float
from mi_sparse_prt.operators.operator import Operator

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Ints = NDArray[np.int64]

BLOCK = 4096  # rows; with three channels a place still has 16 bits


@dataclass(frozen=True)
class WaveletColumns:
    """Columns of T in the Haar basis, each a list of rows.

    Attributes
    ----------
    starts : (blocks, m + 1) int64
        Where the columns of each block begin in the next two arrays.
    places : (k,) uint16
        Row within the block, times channels, plus channel; ascending in a column.
    values : (k,) float16
    scales : (rows, channels) float32
        What the sums of values are multiplied by.
    lighting : CubemapLighting
    """

    starts: Ints
    places: NDArray[np.uint16]
    values: NDArray[np.float16]
    scales: Floats
    lighting: CubemapLighting

    @property
    def nbytes(self) -> int:
        return sum(array.nbytes for array in (self.starts, self.places, self.values, self.scales))

    def norms(self) -> Floats:
        """(m,) norms of the columns over all rows and channels."""
        norms, halves = np.empty(self.starts.shape[1] - 1, np.float32), self.values.view(np.uint16)
        run_in_parts(_norms, len(norms), self.starts, self.places, halves, self.scales, norms)
        return norms


def wavelet_columns(
    operator: Operator, lighting: CubemapLighting, target_error: float = 0.05
) -> WaveletColumns:
    """Columns of any linear factor of T, a block of rows at a time.

    Parameters
    ----------
    operator : Operator
        ``HaarRows`` are transposed as they are.
    lighting : CubemapLighting
        Its emission space.
    target_error : float
        Relative L2 error of each row on the sphere, at most.
    """
    n, m, channels = operator.shape
    blocks = []
    for first in range(0, n, BLOCK):
        ids = np.arange(first, min(first + BLOCK, n))
        if isinstance(operator, HaarRows):
            blocks.append(operator.take(ids))
        else:
            blocks.append(haar_lists(operator, ids, lighting, target_error))
    transposed = [_transposed(block, m) for block in blocks]
    lengths = np.cumsum([0, *(len(places) for _, places, _ in transposed)])
    starts = [own + a for (own, _, _), a in zip(transposed, lengths, strict=False)]
    return WaveletColumns(
        np.array(starts, np.int64).reshape(len(blocks), m + 1),
        np.concatenate([places for _, places, _ in transposed] or [np.zeros(0, np.uint16)]),
        np.concatenate([values for _, _, values in transposed] or [np.zeros(0, np.float16)]),
        np.concatenate([block.scales for block in blocks] or [np.zeros((0, channels), np.float32)]),
        lighting,
    )


def _transposed(block: HaarRows, m: int) -> tuple[Ints, NDArray[np.uint16], NDArray[np.float16]]:
    """Starts (m + 1,), places and values of a block's columns."""
    lists = np.repeat(np.arange(block.scales.size, dtype=np.uint16), np.diff(block.starts))
    order = np.argsort(block.places, kind="stable")
    starts = np.searchsorted(block.places[order], np.arange(m + 1))
    return starts, lists[order], block.values[order]


@numba.njit(nogil=True, cache=True)
def _norms(
    first: int,
    last: int,
    starts: Ints,
    places: NDArray[np.uint16],
    halves: NDArray[np.uint16],
    scales: Floats,
    norms: Floats,
) -> None:
    blocks, channels = len(starts), scales.shape[1]
    for j in range(first, last):
        total = 0.0
        for block in range(blocks):
            before = block * BLOCK
            for e in range(starts[block, j], starts[block, j + 1]):
                row, channel = divmod(int(places[e]), channels)
                total += (half_float(halves[e]) * scales[before + row, channel]) ** 2
        norms[j] = np.sqrt(total)


@numba.njit(parallel=True, fastmath=True, cache=True)
def add_columns(
    starts: Ints,
    places: NDArray[np.uint16],
    halves: NDArray[np.uint16],
    channels: int,
    update: tuple[Ints, Floats, Ints, NDArray[np.bool_]],
    sums: Doubles,
    total: Doubles,
) -> None:
    """Apply an update to sums of columns, scales apart: of each group (groups, rows, 3), and of all (rows, 3).

    With one group there is no need for sums apart: they have no rows.
    """
    coefficients, changes, group_starts, resets = update
    rows, apart = len(total), sums.shape[1] > 0
    for block in numba.prange(len(starts)):
        first, last = block * BLOCK, min((block + 1) * BLOCK, rows)
        here = total[first:last]
        if not apart and resets[0]:
            here[:] = 0
        change = np.zeros_like(here) if apart else here
        for g in range(len(resets)):
            for k in range(group_starts[g], group_starts[g + 1]):
                j = coefficients[k]
                _add_column(
                    places[starts[block, j] : starts[block, j + 1]],
                    halves[starts[block, j] : starts[block, j + 1]],
                    channels,
                    changes[k],
                    change,
                )
            if apart and (resets[g] or group_starts[g] < group_starts[g + 1]):
                _join(here, sums[g, first:last], change, resets[g])


@numba.njit(fastmath=True, cache=True)
def _join(here: Doubles, own: Doubles, change: Doubles, reset: bool) -> None:
    """Add a change to a group's sum, or let it be that sum; and to that of all. The change is zero afterwards."""
    for i in range(len(here)):
        for c in range(3):
            value = change[i, c] - own[i, c] if reset else change[i, c]
            here[i, c] += value
            own[i, c] += value
            change[i, c] = 0


@numba.njit(inline="always")
def _add_column(
    places: NDArray[np.uint16], halves: NDArray[np.uint16], channels: int, colour: Floats, out: Doubles
) -> None:
    """Add a column times a colour to rows (n, 3)."""
    red, green, blue = np.float64(colour[0]), np.float64(colour[1]), np.float64(colour[2])
    if channels == 1:
        for e in range(len(places)):
            value, row = np.float64(half_float(halves[e])), places[e]
            out[row, 0] += value * red
            out[row, 1] += value * green
            out[row, 2] += value * blue
    else:
        for e in range(len(places)):
            row, channel = divmod(int(places[e]), 3)
            out[row, channel] += np.float64(half_float(halves[e])) * colour[channel]
