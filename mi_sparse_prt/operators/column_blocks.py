"""D, direct transport of one channel, expanded to numbers a few columns at a time."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.operators.operator import Floats, Operator

BLOCK = 1 << 22  # elements at a time; 16 MB stay in the cache until they are used


class ColumnBlocks:
    """Columns of an operator, in memory that is used again: new pages cost more than the numbers in them.

    Parameters
    ----------
    direct : Operator
        Of one channel.
    block : int
        Elements at a time.
    """

    def __init__(self, direct: Operator, block: int = BLOCK) -> None:
        self._direct, self._block = direct, block
        self._buffer: Floats = np.empty(0, np.float32)

    def at(self, texels: NDArray[np.integer]) -> Floats:
        """(rows, k) float32, which the next call overwrites."""
        rows = self._direct.shape[0]
        if self._buffer.size < rows * len(texels):
            self._buffer = np.empty(rows * len(texels), np.float32)
        room = self._buffer[: rows * len(texels)].reshape(rows, len(texels))
        return self._direct.dense_columns(texels, room)

    def __iter__(self) -> Iterator[tuple[slice, Floats]]:
        """All texels in turn: which ones, and their columns (``at``)."""
        rows, m, _ = self._direct.shape
        size = max(1, self._block // max(rows, 1))
        for a in range(0, m, size):
            part = slice(a, min(a + size, m))
            yield part, self.at(np.arange(part.start, part.stop))


def combine_randomly(direct: Operator, few: int, rng: np.random.Generator, out: Floats) -> None:
    """Sums of few random columns each, with random signs, into ``out`` (rows, k), k being a word's bits.

    The columns of a sum are at the same place in random words of bits, so that words are read as a whole.
    """
    width = out.shape[1]
    words = rng.permutation(direct.shape[1] // width)[:few]
    signs = rng.choice(np.array([-1, 1], np.float32), (len(words), width))
    direct.combine(words, signs, out)
