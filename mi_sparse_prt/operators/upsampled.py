"""Interreflected light element by element, on the lighting's cubemap or on a coarser one that is interpolated."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mi_sparse_prt.core.sparse_arrays import sparse_from_arrays, sparse_to_arrays
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.operators.interpolated import row_entries, summed_entries
from mi_sparse_prt.operators.operator import Floats, Ids, Operator, multiply_converted


@dataclass(frozen=True)
class Upsampled(Operator):
    """Unit-albedo transport per solid angle, at the lighting's directions or at fewer.

    Attributes
    ----------
    density : (n, n_coarse, channels) float16, 1/sr
        channels is 1 in a grey scene. float32 where light is focused so much that float16 overflows.
    upsampling : (n_directions, n_coarse) sparse, rows sum to 1
        Interpolates a coarse cubemap at the lighting's directions; the identity where none is coarser.
    lighting : CubemapLighting
    """

    kind: ClassVar[str] = "upsampled"
    by_row: ClassVar[tuple[str, ...]] = ("density",)
    element_block: ClassVar[int] = 1 << 15  # each has four coarse ones
    density: NDArray[np.float16]
    upsampling: scipy.sparse.csr_array
    lighting: CubemapLighting

    @property
    def shape(self) -> tuple[int, int, int]:
        return len(self.density), self.lighting.n_directions, self.density.shape[2]

    @property
    def nbytes(self) -> int:
        return self.density.nbytes

    def rows(self, ids: Ids) -> Floats:
        density = self.density[ids].astype(np.float32)  # [row, coarse, channel]
        fine = np.stack([(self.upsampling @ density[..., c].T).T for c in range(density.shape[2])], axis=-1)
        return fine * self.lighting.solid_angles[:, None]

    def columns(self, ids: Ids) -> Floats:
        weights = self.upsampling[np.asarray(ids)].multiply(self.lighting.solid_angles[ids][:, None]).tocsr()
        needed = np.unique(weights.indices)
        density = self.density[:, needed].astype(np.float32)  # [vertex, needed coarse, channel]
        return np.stack(
            [(weights[:, needed] @ density[..., c].T).T for c in range(density.shape[2])], axis=-1
        )

    def _elements(self, ids: Ids, texels: Ids) -> Floats:
        element, coarse, weights = row_entries(self.upsampling, texels)
        density = self.density[ids[element], coarse].astype(np.float32)  # [entry, channel]
        fine = summed_entries(element, weights, density, len(ids))
        return fine * self.lighting.solid_angles[texels][:, None]

    def _apply(self, x: Floats) -> Floats:
        light = x * self.lighting.solid_angles[:, None, None]
        channels = [
            multiply_converted(self.density[..., c], self.upsampling.T @ light[:, c])
            for c in range(self.density.shape[2])
        ]
        return np.stack(channels, axis=1)

    def arrays(self) -> dict[str, NDArray[Any] | Operator]:
        return {"density": self.density, **sparse_to_arrays("upsampling", self.upsampling)}

    @classmethod
    def from_arrays(cls, arrays: dict[str, Any], lighting: CubemapLighting) -> Self:
        density = arrays["density"]
        upsampling = sparse_from_arrays("upsampling", arrays, density.shape[1])
        if upsampling.shape[0] != lighting.n_directions or density.shape[2] not in (1, 3):
            raise ValueError("indirect light does not fit the lighting")
        return cls(density, upsampling, lighting)
