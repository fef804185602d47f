"""Rows with few elements that are not 0, as a sparse matrix per channel."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.core.sparse_arrays import sparse_from_arrays, sparse_nbytes, sparse_to_arrays
from mi_sparse_prt.emission.space import EmissionSpace
from mi_sparse_prt.operators.operator import Floats, Ids, Operator


@dataclass(frozen=True)
class SparseRows(Operator):
    """Light that arrives from few directions.

    Attributes
    ----------
    matrices : tuple of (n, m) sparse float32
        One for all channels, or three.

    Raises
    ------
    PrtError
        If a value is NaN or infinite.
    """

    kind: ClassVar[str] = "sparse_rows"
    matrices: tuple[scipy.sparse.csr_array, ...]

    def __post_init__(self) -> None:
        super().__post_init__()
        if not all(np.isfinite(matrix.data).all() for matrix in self.matrices):
            raise PrtError("SparseRows: values are NaN or infinite; repair what they were computed from")

    @property
    def shape(self) -> tuple[int, int, int]:
        n, m = self.matrices[0].shape
        return n, m, len(self.matrices)

    @property
    def nbytes(self) -> int:
        return sum(sparse_nbytes(matrix) for matrix in self.matrices)

    def channel(self, number: int) -> SparseRows:
        """One of the three channels alone, which may be that of all."""
        return SparseRows((self.matrices[min(number, len(self.matrices) - 1)],))

    def rows(self, ids: Ids) -> Floats:
        return np.stack([matrix[np.asarray(ids)].toarray() for matrix in self.matrices], axis=-1)

    def columns(self, ids: Ids) -> Floats:
        return np.stack([matrix[:, np.asarray(ids)].toarray() for matrix in self.matrices], axis=-1)

    def combined(self, words: NDArray[np.integer], signs: Floats) -> Floats:
        width = signs.shape[1]
        weights = np.zeros((self.shape[1], width), np.float32)
        weights[words[:, None] * width + np.arange(width), np.arange(width)] = signs
        return np.asarray(self.matrices[0] @ weights)

    def _apply(self, x: Floats) -> Floats:
        return np.stack([matrix @ x[:, c] for c, matrix in enumerate(self.matrices)], axis=1)

    def _adjoint(self, y: Floats) -> Floats:
        return np.stack([matrix.T @ y[:, c] for c, matrix in enumerate(self.matrices)], axis=1)

    def take(self, ids: Ids) -> SparseRows:
        return replace(self, matrices=tuple(matrix[np.asarray(ids)] for matrix in self.matrices))

    def arrays(self) -> dict[str, NDArray[Any] | Operator]:
        channels = [sparse_to_arrays(f"channel_{c}", matrix) for c, matrix in enumerate(self.matrices)]
        return {name: array for channel in channels for name, array in channel.items()}

    @classmethod
    def from_arrays(cls, arrays: dict[str, Any], lighting: EmissionSpace) -> Self:
        count = sum(name.endswith("_indptr") for name in arrays)
        columns = lighting.size
        matrices = tuple(sparse_from_arrays(f"channel_{c}", arrays, columns) for c in range(count))
        if count not in (1, 3) or len({matrix.shape for matrix in matrices}) > 1:
            raise ValueError("sparse rows are neither of one channel nor of three that fit together")
        return cls(matrices)
