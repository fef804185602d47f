"""Direct light in the texel basis, by brute force: the mean of V max(0, n . w) over each texel."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.block_products import multiply_converted
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.operators.operator import Rows

FIXED_POINT = 65535.0  # mean cosines in [0, 1] as 16-bit fixed point: an absolute error of 8e-6


@dataclass(frozen=True)
class MeanCosine:
    """Direct light in the texel basis, by brute force: the mean of V max(0, n . w) over each texel.

    Attributes
    ----------
    fixed : (n_v, n_directions) uint16
        The mean as 16-bit fixed point, 65535 = 1.
    lighting : CubemapLighting
    """

    fixed: NDArray[np.uint16]
    lighting: CubemapLighting

    @property
    def nbytes(self) -> int:
        return self.fixed.nbytes

    def rows(self, ids: Rows) -> NDArray[np.float32]:
        return (self.fixed[ids] * self._weights())[..., None]

    def columns(self, ids: Rows) -> NDArray[np.float32]:
        return (self.fixed[:, ids] * self._weights()[ids])[..., None]

    def relight(self, lighting: NDArray[np.float32]) -> NDArray[np.float32]:
        return multiply_converted(self.fixed, lighting * self._weights()[:, None])

    def project(self, vectors: NDArray[np.float32]) -> NDArray[np.float32]:
        return multiply_converted(self.fixed, vectors * self._weights()[:, None])[..., None]

    def reordered(self, source: Rows) -> MeanCosine:
        return replace(self, fixed=self.fixed[source])

    def _weights(self) -> NDArray[np.float32]:
        return self.lighting.solid_angles / np.float32(np.pi * FIXED_POINT)
