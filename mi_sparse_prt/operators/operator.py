"""The contract of every linear factor of T: what can be asked of it, whatever it keeps.

Rows belong to points, columns to elements of the emission space. An operator of one channel stands for three that are
alike. A new representation is a dataclass with ``shape`` and ``rows`` that says which of its fields are stored, and
which of these have a row for each point; the rest follows, and is overridden where it knows a quicker way.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.bits import BITS, Bits, bits_at
from mi_sparse_prt.core.halves import as_floats
from mi_sparse_prt.core.read_only import read_only
from mi_sparse_prt.core.threads import run_overlapped

Ids = NDArray[np.integer]
Floats = NDArray[np.float32]

ROWS = 2048  # expanded at a time
MANY = 64  # vectors of which a product takes longer than to copy some columns of a matrix
CACHED_ROWS = 256  # expanded at a time where some of them stay in the cache until they are used


@dataclass(frozen=True)
class Operator(ABC):
    """A linear factor of T, (rows, n_directions, channels).

    Attributes
    ----------
    kind : str
        Its name in files.
    stored : tuple of str
        Fields that files keep, arrays or operators; all but ``lighting``, the emission space.
    file_names : dict of str to str
        Names of fields in files, where these are others.
    by_row : tuple of str
        Stored fields that have an entry for each row.
    dark_below_horizon : bool
        Whether no element below the horizon of its point can be other than 0.
    element_block : int
        Elements that are looked up at a time.
    """

    kind: ClassVar[str]
    stored: ClassVar[tuple[str, ...]] = ()
    file_names: ClassVar[dict[str, str]] = {}
    by_row: ClassVar[tuple[str, ...]] = ()
    dark_below_horizon: ClassVar[bool] = False
    element_block: ClassVar[int] = ROWS

    def __post_init__(self) -> None:
        self.__setstate__(self.__dict__)

    def __setstate__(self, state: dict[str, Any]) -> None:
        """See all arrays read-only: a kernel is compiled once, whether they were computed, read or unpickled."""
        own = {field.name: state[field.name] for field in fields(self)}
        kept = {name: read_only(value) for name, value in own.items() if isinstance(value, np.ndarray)}
        self.__dict__.update(state | kept)

    @property
    @abstractmethod
    def shape(self) -> tuple[int, int, int]:
        """(rows, n_directions, channels); channels is 1 or 3."""

    @abstractmethod
    def rows(self, ids: Ids) -> Floats:
        """Rows (len(ids), n_directions, channels)."""

    @property
    def nbytes(self) -> int:
        """Bytes that it keeps in memory."""
        return sum(getattr(self, name).nbytes for name in self.stored)

    def take(self, ids: Ids) -> Operator:
        """The operator of some rows, in this order."""
        return replace(self, **{name: getattr(self, name)[ids] for name in self.by_row})

    def arrays(self) -> dict[str, NDArray[Any] | Operator]:
        """All that it is made of but the emission space; operators may be nested."""
        return {self.file_names.get(name, name): getattr(self, name) for name in self.stored}

    @classmethod
    def from_arrays(cls, arrays: dict[str, Any], lighting: Any) -> Self:
        """From what ``arrays`` gave.

        Raises
        ------
        ValueError, KeyError
            If these do not fit together.
        """
        own = {name: arrays[cls.file_names.get(name, name)] for name in cls.stored}
        if any(field.name == "lighting" for field in fields(cls)):
            own["lighting"] = lighting
        operator = cls(**own)
        operator.check()
        return operator

    def check(self) -> None:  # noqa: B027 - most have something to check, not all
        """Raise ValueError if what came from a file does not fit together."""

    @property
    def edges(self) -> Bits | None:
        """Bits (rows, words) of the texels' centres that are seen, if it has any: errors lie along their edges."""
        return None

    @property
    def by_depth(self) -> tuple[Operator, ...]:
        """Of light that met 1, 2, ... surfaces before it arrived, where it is told apart; the sum is this one."""
        return ()

    def columns(self, ids: Ids) -> Floats:
        """Columns (rows, len(ids), channels)."""
        ids = np.asarray(ids)
        blocks = [self.rows(some)[:, ids] for some in self._blocks(ROWS)]
        return np.concatenate(blocks) if blocks else np.zeros((0, len(ids), self.shape[2]), np.float32)

    def elements(self, ids: Ids, texels: Ids) -> Floats:
        """Elements (k, channels) at rows and texels, (k,) each."""
        size = self.element_block
        blocks = [slice(a, a + size) for a in range(0, max(len(ids), 1), size)]
        return np.concatenate([self._elements(ids[b], texels[b]) for b in blocks])

    def _elements(self, ids: Ids, texels: Ids) -> Floats:
        """``elements`` of one block."""
        return self.rows(ids)[np.arange(len(ids)), texels]

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
        return self._by_channel(self._apply, x)

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
        return self._by_channel(self._adjoint, y)

    def _by_channel(self, multiply: Callable[[Floats], Floats], vectors: Floats) -> Floats:
        """Products (..., channels, k) by a function that takes each channel's own vectors (..., channels, k)."""
        vectors = np.asarray(vectors, np.float32)
        channels = self.shape[2]
        if vectors.ndim == 2:
            n, k = vectors.shape
            return multiply(np.broadcast_to(vectors[:, None], (n, channels, k)))
        if channels == 1:  # three channels that are alike: all vectors side by side
            n, colours, k = vectors.shape
            return multiply(vectors.reshape(n, 1, colours * k)).reshape(-1, colours, k)
        return multiply(vectors)

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

    def combine(self, words: NDArray[np.integer], signs: Floats, out: Floats) -> None:
        """What ``combined`` returns, into part of a larger array."""
        out[:] = self.combined(words, signs)

    def _apply(self, x: Floats) -> Floats:
        """Products (rows, channels, k) with vectors (n_directions, channels, k), by blocks of rows."""
        result = np.empty((self.shape[0], *x.shape[1:]), np.float32)

        def multiply(some: NDArray[np.int64], made: Floats) -> None:
            for c in range(x.shape[1]):
                result[some[0] : some[-1] + 1, c] = made[..., c] @ x[:, c]

        for _ in run_overlapped(
            partial(multiply, some, self.rows(some)) for some in self._blocks(CACHED_ROWS)
        ):
            pass
        return result

    def _adjoint(self, y: Floats) -> Floats:
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
    stored: ClassVar[tuple[str, ...]] = ("operator", "points", "open")
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

    def check(self) -> None:
        n, m, _ = self.operator.shape
        ascending = (np.diff(self.points, prepend=-1, append=n) > 0).all()
        if self.open.shape != (len(self.points), -(-m // BITS)) or not ascending:
            raise ValueError("masks and the rows that they are of do not fit together")

    def _kept(self, rows: Ids, texels: Ids) -> NDArray[np.bool_]:
        """Whether elements at rows and texels, (m,) each, are kept."""
        result, some = np.ones(len(rows), np.bool_), np.isin(rows, self.points)
        result[some] = bits_at(self.open, np.searchsorted(self.points, rows[some]), texels[some])
        return result


def multiply_converted(matrix: NDArray[Any], vectors: Floats) -> Floats:
    """``matrix @ vectors``; the matrix (n, m) holds small numbers, converted to float32 on the way.

    Of many vectors, what is zero in all of them is left out, such as the ground under skies.
    """
    product = np.empty((len(matrix), vectors.shape[1]), dtype=np.float32)
    lit = vectors.any(axis=1) if vectors.shape[1] >= MANY else np.ones(len(vectors), bool)
    columns = slice(None) if lit.all() else np.flatnonzero(lit)
    vectors = vectors[columns]
    block = 2048  # rows at a time
    for a in range(0, len(matrix), block):
        product[a : a + block] = as_floats(matrix[a : a + block][:, columns]) @ vectors
    return product
