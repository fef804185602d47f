"""The contract of every linear factor of T: what can be asked of it, whatever it keeps.

Rows belong to points, columns to elements of the emission space. An operator of one channel stands for three that are
alike. A new representation is a subclass with ``shape``, ``nbytes``, ``rows``, ``take``, ``arrays`` and
``from_arrays``; the rest follows, and is overridden where a representation knows a quicker way.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.bits import BITS, Bits, bits_at
from mi_sparse_prt.core.threads import run_overlapped

Ids = NDArray[np.integer]
Floats = NDArray[np.float32]

ROWS = 2048  # expanded at a time
CACHED_ROWS = 256  # expanded at a time where some of them stay in the cache until they are used


class Operator(ABC):
    """A linear factor of T, (rows, n_directions, channels).

    Attributes
    ----------
    kind : str
        Its name in files.
    dark_below_horizon : bool
        Whether no element below the horizon of its point can be other than 0.
    """

    kind: ClassVar[str]
    dark_below_horizon: ClassVar[bool] = False

    @property
    @abstractmethod
    def shape(self) -> tuple[int, int, int]:
        """(rows, n_directions, channels); channels is 1 or 3."""

    @property
    @abstractmethod
    def nbytes(self) -> int:
        """Bytes that it keeps in memory."""

    @abstractmethod
    def rows(self, ids: Ids) -> Floats:
        """Rows (len(ids), n_directions, channels)."""

    @abstractmethod
    def take(self, ids: Ids) -> Operator:
        """The operator of some rows, in this order."""

    @abstractmethod
    def arrays(self) -> dict[str, NDArray[Any] | Operator]:
        """All that it is made of but the emission space; operators may be nested."""

    @classmethod
    @abstractmethod
    def from_arrays(cls, arrays: dict[str, Any], lighting: Any) -> Self:
        """From what ``arrays`` gave.

        Raises
        ------
        ValueError, KeyError
            If these do not fit together.
        """

    @property
    def edges(self) -> Bits | None:
        """Bits (rows, words) of the texels' centres that are seen, if it has any: errors lie along their edges."""
        return None

    def columns(self, ids: Ids) -> Floats:
        """Columns (rows, len(ids), channels)."""
        ids = np.asarray(ids)
        blocks = [self.rows(some)[:, ids] for some in self._blocks(ROWS)]
        return np.concatenate(blocks) if blocks else np.zeros((0, len(ids), self.shape[2]), np.float32)

    def elements(self, ids: Ids, texels: Ids) -> Floats:
        """Elements (k, channels) at rows and texels, (k,) each."""
        blocks = [slice(a, a + ROWS) for a in range(0, max(len(ids), 1), ROWS)]
        return np.concatenate([self.rows(ids[b])[np.arange(len(ids[b])), texels[b]] for b in blocks])

    def apply(self, x: Floats) -> Floats:
        """Products with vectors.

        Parameters
        ----------
        x : (n_directions, k) or (n_directions, 3, k) float
            The same vectors for all channels, or each channel's own.

        Returns
        -------
        (rows, channels, k) or (rows, 3, k) float32
        """
        x = np.asarray(x, np.float32)
        if x.ndim == 2:
            return self._apply_same(x)
        if self.shape[2] == 1:  # three channels that are alike: all vectors side by side
            m, channels, k = x.shape
            return self._apply_same(x.reshape(m, channels * k)).reshape(-1, channels, k)
        return self._apply_each(x)

    def adjoint(self, y: Floats) -> Floats:
        """Products of the transpose with vectors.

        Parameters
        ----------
        y : (rows, k) or (rows, 3, k) float
            The same vectors for all channels, or each channel's own.

        Returns
        -------
        (n_directions, channels, k) or (n_directions, 3, k) float32
        """
        y = np.asarray(y, np.float32)
        if y.ndim == 2:
            return self._adjoint_same(y)
        if self.shape[2] == 1:
            n, channels, k = y.shape
            return self._adjoint_same(y.reshape(n, channels * k)).reshape(-1, channels, k)
        return self._adjoint_each(y)

    def relight(self, lighting: Floats) -> Floats:
        """Products (rows, 3) with a lighting L (n_directions, 3)."""
        return self.apply(lighting[:, :, None])[..., 0]

    def masked(self, points: NDArray[np.int64], open: Bits) -> Operator:
        """The operator without some elements.

        Parameters
        ----------
        points : (k,) int64
            Rows that lose elements, ascending.
        open : (k, words) uint32 bits
            The texels that they keep.
        """
        return Masked(self, points, open)

    def dense_columns(self, texels: Ids, out: Floats) -> Floats:
        """Columns (rows, len(texels)) of the only channel; ``out`` (that shape) may be written to and returned."""
        return self.columns(texels)[..., 0]

    def combined(self, words: NDArray[np.integer], signs: Floats) -> Floats:
        """Sums of columns of the only channel that are at the same place in some words of bits.

        Parameters
        ----------
        words : (g,) integers
        signs : (g, width) float32
            What the columns are multiplied with.

        Returns
        -------
        (rows, width) float32
        """
        texels = words[:, None] * signs.shape[1] + np.arange(signs.shape[1])
        room = np.empty((self.shape[0], signs.shape[1]), np.float32)
        total = self.dense_columns(texels[0], room) * signs[0]
        for some, sign in zip(texels[1:], signs[1:], strict=True):
            total += self.dense_columns(some, room) * sign
        return total

    def _apply_same(self, x: Floats) -> Floats:
        """Products (rows, channels, k) with vectors (n_directions, k), by blocks of rows."""
        rows, _, channels = self.shape
        result = np.empty((rows, channels, x.shape[1]), np.float32)

        def multiply(some: NDArray[np.int64], made: Floats) -> None:
            for c in range(channels):
                result[some[0] : some[-1] + 1, c] = made[..., c] @ x

        for _ in run_overlapped(
            partial(multiply, some, self.rows(some)) for some in self._blocks(CACHED_ROWS)
        ):
            pass
        return result

    def _apply_each(self, x: Floats) -> Floats:
        """Products (rows, 3, k) with vectors (n_directions, 3, k) of each channel."""
        result = np.empty((self.shape[0], 3, x.shape[2]), np.float32)
        for some in self._blocks(CACHED_ROWS):
            made = self.rows(some)
            for c in range(3):
                result[some, c] = made[..., c] @ x[:, c]
        return result

    def _adjoint_same(self, y: Floats) -> Floats:
        return self._adjoint_by_rows(np.broadcast_to(y[:, None], (len(y), self.shape[2], y.shape[1])))

    def _adjoint_each(self, y: Floats) -> Floats:
        return self._adjoint_by_rows(y)

    def _adjoint_by_rows(self, y: Floats) -> Floats:
        """Products (n_directions, channels, k) of the transpose with vectors (rows, channels, k)."""
        result = np.zeros((self.shape[1], *y.shape[1:]), np.float32)
        for some in self._blocks(ROWS):
            made = self.rows(some)
            for c in range(y.shape[1]):
                result[:, c] += made[..., c].T @ y[some, c]
        return result

    def _blocks(self, size: int) -> list[NDArray[np.int64]]:
        """Numbers of all rows, some at a time."""
        return [np.arange(a, min(a + size, self.shape[0])) for a in range(0, self.shape[0], size)]


@dataclass(frozen=True)
class Masked(Operator):
    """Any operator without some elements; kept in memory only.

    Attributes
    ----------
    operator : Operator
    points : (k,) int64
        Rows that lose elements, ascending.
    open : (k, words) uint32 bits
        The texels that they keep.
    """

    kind: ClassVar[str] = "masked"
    operator: Operator
    points: NDArray[np.int64]
    open: Bits

    @property
    def shape(self) -> tuple[int, int, int]:
        return self.operator.shape

    @property
    def nbytes(self) -> int:
        return self.operator.nbytes + self.open.nbytes

    def rows(self, ids: Ids) -> Floats:
        every = np.arange(self.shape[1])
        kept = self._kept(np.repeat(ids, len(every)), np.tile(every, len(ids)))
        return self.operator.rows(ids) * kept.reshape(len(ids), len(every), 1)

    def columns(self, ids: Ids) -> Floats:
        result = self.operator.columns(ids)
        kept = self._kept(np.repeat(self.points, len(ids)), np.tile(ids, len(self.points)))
        result[self.points] *= kept.reshape(len(self.points), len(ids), 1)
        return result

    def relight(self, lighting: Floats) -> Floats:
        result = self.operator.relight(lighting)
        result[self.points] = np.einsum("pmc,mc->pc", self.rows(self.points), lighting)
        return result

    def take(self, ids: Ids) -> Masked:
        here = np.flatnonzero(np.isin(ids, self.points))
        open = self.open[np.searchsorted(self.points, np.asarray(ids)[here])]
        return replace(self, operator=self.operator.take(ids), points=here, open=open)

    def arrays(self) -> dict[str, NDArray[Any] | Operator]:
        return {"operator": self.operator, "points": self.points, "open": self.open}

    @classmethod
    def from_arrays(cls, arrays: dict[str, Any], lighting: Any) -> Self:
        operator, points, open = (arrays[name] for name in ("operator", "points", "open"))
        n, m, _ = operator.shape
        if open.shape != (len(points), -(-m // BITS)) or (np.diff(points, prepend=-1, append=n) <= 0).any():
            raise ValueError("masks and the rows that they are of do not fit together")
        return cls(operator, points, open)

    def _kept(self, rows: Ids, texels: Ids) -> NDArray[np.bool_]:
        """Whether elements at rows and texels, (m,) each, are kept."""
        result, some = np.ones(len(rows), np.bool_), np.isin(rows, self.points)
        result[some] = bits_at(self.open, np.searchsorted(self.points, rows[some]), texels[some])
        return result
