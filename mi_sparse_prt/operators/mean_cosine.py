"""Direct light in the texel basis, by brute force: the mean of V max(0, n . w) over each texel."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numba
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.bits import Bits, unpack
from mi_sparse_prt.core.threads import run_in_parts
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.operators.operator import Floats, Ids, Operator, multiply_converted

FIXED_POINT = 65535.0  # mean cosines in [0, 1] as 16-bit fixed point: an absolute error of 8e-6


@dataclass(frozen=True)
class MeanCosine(Operator):
    """Unit-albedo direct transport, the mean cosine of each texel times ``d_omega / pi``.

    Attributes
    ----------
    fixed : (n, n_directions) uint16
        The mean as 16-bit fixed point, 65535 = 1.
    lighting : CubemapLighting
    """

    kind: ClassVar[str] = "mean_cosine"
    stored: ClassVar[tuple[str, ...]] = ("fixed",)
    file_names: ClassVar[dict[str, str]] = {"fixed": "mean_cosine"}
    by_row: ClassVar[tuple[str, ...]] = ("fixed",)
    fixed: NDArray[np.uint16]
    lighting: CubemapLighting

    @property
    def shape(self) -> tuple[int, int, int]:
        return len(self.fixed), self.lighting.n_directions, 1

    def rows(self, ids: Ids) -> Floats:
        return (self.fixed[ids] * self._weights())[..., None]

    def columns(self, ids: Ids) -> Floats:
        return (self.fixed[:, ids] * self._weights()[ids])[..., None]

    def dense_columns(self, texels: Ids, out: Floats) -> Floats:
        power = self.lighting.solid_angles[texels] / np.float32(np.pi)
        units = power / np.float32(FIXED_POINT)
        run_in_parts(_convert, len(out), self.fixed, np.asarray(texels, np.int64), units, out)
        return out

    def elements(self, ids: Ids, texels: Ids) -> Floats:
        return (self.fixed[ids, texels] * self._weights()[texels])[:, None]

    def _apply(self, x: Floats) -> Floats:
        return multiply_converted(self.fixed, x[:, 0] * self._weights()[:, None])[:, None]

    def masked(self, points: NDArray[np.int64], open: Bits) -> MeanCosine:
        fixed = self.fixed.copy()
        fixed[points] *= unpack(open, fixed.shape[1])
        return replace(self, fixed=fixed)

    def check(self) -> None:
        if self.fixed.shape[1:] != (self.lighting.n_directions,):
            raise ValueError(f"mean cosines {self.fixed.shape} do not fit the lighting")

    def _weights(self) -> Floats:
        return self.lighting.solid_angles / np.float32(np.pi * FIXED_POINT)


@numba.njit(nogil=True, cache=True)
def _convert(
    first: int, last: int, fixed: NDArray[np.uint16], texels: NDArray[np.int64], units: Floats, result: Floats
) -> None:
    """Elements (n, m): multiples of the units (m,)."""
    for i in range(first, last):
        for j in range(len(texels)):
            result[i, j] = np.float32(fixed[i, texels[j]]) * units[j]
