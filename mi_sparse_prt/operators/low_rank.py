"""Interreflected light as a product of two thin matrices per channel."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.operators.operator import Rows


@dataclass(frozen=True)
class LowRank:
    """Interreflected light as a product of two thin matrices per channel: it has a low rank.

    Attributes
    ----------
    left : tuple of (n_v, rank) float32
        One per channel: 1 in a grey scene, else 3. Ranks may differ.
    right : tuple of (rank, n_directions) float32
    """

    left: tuple[NDArray[np.float32], ...]
    right: tuple[NDArray[np.float32], ...]

    @property
    def ranks(self) -> tuple[int, ...]:
        """Of each channel."""
        return tuple(len(right) for right in self.right)

    @property
    def nbytes(self) -> int:
        return sum(factor.nbytes for factor in (*self.left, *self.right))

    def rows(self, ids: Rows) -> NDArray[np.float32]:
        channels = [a[ids] @ b for a, b in zip(self.left, self.right, strict=True)]
        return np.stack(channels, axis=-1) if len(channels) > 1 else channels[0][..., None]

    def columns(self, ids: Rows) -> NDArray[np.float32]:
        return np.stack([a @ b[:, ids] for a, b in zip(self.left, self.right, strict=True)], axis=-1)

    def relight(self, lighting: NDArray[np.float32]) -> NDArray[np.float32]:
        if len(self.left) == 1:
            return self.left[0] @ (self.right[0] @ lighting)
        channels = zip(self.left, self.right, lighting.T, strict=True)
        return np.stack([a @ (b @ light) for a, b, light in channels], axis=-1)

    def project(self, vectors: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.stack([a @ (b @ vectors) for a, b in zip(self.left, self.right, strict=True)], axis=-1)

    def reordered(self, source: Rows) -> LowRank:
        return replace(self, left=tuple(left[source] for left in self.left))
