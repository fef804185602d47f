"""What every linear factor of T can do, and what its rows and columns are."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray


class Part(Protocol):
    """One additive part of white transport."""

    def rows(self, ids: Rows) -> NDArray[np.float32]:
        """White rows (len(ids), n_directions, channels), float32."""

    def columns(self, ids: Rows) -> NDArray[np.float32]:
        """White columns (n_v, len(ids), channels), float32."""

    def relight(self, lighting: NDArray[np.float32]) -> NDArray[np.float32]:
        """White radiance (n_v, 3) under L (n_directions, 3)."""

    @property
    def nbytes(self) -> int:
        """Bytes that the part keeps in memory."""


class StoredPart(Part, Protocol):
    """A part that a matrix keeps."""

    def reordered(self, source: Rows) -> StoredPart:
        """Some rows, in this order."""

    def project(self, vectors: NDArray[np.float32]) -> NDArray[np.float32]:
        """Products (n_v, k, channels) with vectors (n_directions, k), the same for all channels."""


Rows = NDArray[np.integer]
