"""Interreflected light as a product of two thin matrices per channel."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.emission.space import EmissionSpace
from mi_sparse_prt.operators.operator import Floats, Ids, Operator


@dataclass(frozen=True)
class LowRank(Operator):
    """``left @ right`` for each channel.

    Attributes
    ----------
    left : tuple of (n, rank) float32
        One per channel: 1 in a grey scene, else 3. Ranks may differ.
    right : tuple of (rank, n_directions) float32
    """

    kind: ClassVar[str] = "low_rank"
    element_block: ClassVar[int] = 1 << 15
    left: tuple[NDArray[np.float32], ...]
    right: tuple[NDArray[np.float32], ...]

    @property
    def shape(self) -> tuple[int, int, int]:
        return len(self.left[0]), self.right[0].shape[1], len(self.left)

    @property
    def ranks(self) -> tuple[int, ...]:
        """Of each channel."""
        return tuple(len(right) for right in self.right)

    @property
    def nbytes(self) -> int:
        return sum(factor.nbytes for factor in (*self.left, *self.right))

    @property
    def _factors(self) -> list[tuple[Floats, Floats]]:
        """Both factors of each channel."""
        return list(zip(self.left, self.right, strict=True))

    def rows(self, ids: Ids) -> Floats:
        channels = [a[ids] @ b for a, b in self._factors]
        return np.stack(channels, axis=-1) if len(channels) > 1 else channels[0][..., None]

    def columns(self, ids: Ids) -> Floats:
        return np.stack([a @ b[:, ids] for a, b in self._factors], axis=-1)

    def _elements(self, ids: Ids, texels: Ids) -> Floats:
        channels = [np.einsum("mr,rm->m", a[ids], b[:, texels]) for a, b in self._factors]
        return np.stack(channels, axis=1)

    def _apply(self, x: Floats) -> Floats:
        return np.stack([a @ (b @ x[:, c]) for c, (a, b) in enumerate(self._factors)], axis=1)

    def _adjoint(self, y: Floats) -> Floats:
        return np.stack([b.T @ (a.T @ y[:, c]) for c, (a, b) in enumerate(self._factors)], axis=1)

    def take(self, ids: Ids) -> LowRank:
        return replace(self, left=tuple(left[ids] for left in self.left))

    def arrays(self) -> dict[str, NDArray[Any] | Operator]:
        sides = (("left", self.left), ("right", self.right))
        return {f"{name}_{c}": factor for name, factors in sides for c, factor in enumerate(factors)}

    @classmethod
    def from_arrays(cls, arrays: dict[str, Any], lighting: EmissionSpace) -> Self:
        left, right = (
            [arrays[f"{side}_{c}"] for c in range(3) if f"{side}_{c}" in arrays] for side in ("left", "right")
        )
        pairs = list(zip(left, right, strict=True))
        if (
            len(left) not in (1, 3)
            or any(a.shape != (len(left[0]), len(b)) for a, b in pairs)
            or any(b.shape[1] != lighting.size for b in right)
        ):
            raise ValueError("factors of the indirect light do not fit together")
        return cls(tuple(left), tuple(right))
