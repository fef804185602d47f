"""A matrix as it is: for few columns, such as the lamps of a scene."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.operators.operator import Floats, Ids, Operator


@dataclass(frozen=True)
class Dense(Operator):
    """All elements.

    Attributes
    ----------
    values : (n, m, channels) float32
        channels is 1 or 3.

    Raises
    ------
    PrtError
        If a value is NaN or infinite, or the shape is another one.
    """

    kind: ClassVar[str] = "dense"
    stored: ClassVar[tuple[str, ...]] = ("values",)
    by_row: ClassVar[tuple[str, ...]] = ("values",)
    values: NDArray[np.float32]

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.values.ndim != 3 or self.values.shape[2] not in (1, 3):
            raise PrtError(f"Dense: values must be (rows, columns, 1 or 3), not {self.values.shape}")
        if not np.isfinite(self.values).all():
            raise PrtError("Dense: values are NaN or infinite; repair what they were computed from")

    @property
    def shape(self) -> tuple[int, int, int]:
        n, m, channels = self.values.shape
        return n, m, channels

    def rows(self, ids: Ids) -> Floats:
        return self.values[ids]

    def columns(self, ids: Ids) -> Floats:
        return self.values[:, ids]

    def elements(self, ids: Ids, texels: Ids) -> Floats:
        return self.values[ids, texels]
