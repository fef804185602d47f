"""Interreflected light element by element, on the lighting's cubemap or on a coarser one that is interpolated."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mi_sparse_prt.core.block_products import multiply_converted
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.operators.operator import Rows


@dataclass(frozen=True)
class Upsampled:
    """Interreflected light: white transport per solid angle, at the lighting's directions or at fewer.

    Attributes
    ----------
    density : (n_v, n_coarse, channels) float16, 1/sr
        channels is 1 in a grey scene.
    upsampling : (n_directions, n_coarse) sparse, rows sum to 1
        Interpolates a coarse cubemap at the lighting's directions; the identity where none is coarser.
    lighting : CubemapLighting
    """

    density: NDArray[np.float16]
    upsampling: scipy.sparse.csr_array
    lighting: CubemapLighting

    @property
    def nbytes(self) -> int:
        return self.density.nbytes

    def rows(self, ids: Rows) -> NDArray[np.float32]:
        density = self.density[ids].astype(np.float32)  # [row, coarse, channel]
        fine = np.stack([(self.upsampling @ density[..., c].T).T for c in range(density.shape[2])], axis=-1)
        return fine * self.lighting.solid_angles[:, None]

    def columns(self, ids: Rows) -> NDArray[np.float32]:
        weights = self.upsampling[np.asarray(ids)].multiply(self.lighting.solid_angles[ids][:, None]).tocsr()
        needed = np.unique(weights.indices)
        density = self.density[:, needed].astype(np.float32)  # [vertex, needed coarse, channel]
        return np.stack(
            [(weights[:, needed] @ density[..., c].T).T for c in range(density.shape[2])], axis=-1
        )

    def relight(self, lighting: NDArray[np.float32]) -> NDArray[np.float32]:
        coarse = self.upsampling.T @ (lighting * self.lighting.solid_angles[:, None])  # [coarse, rgb]
        if self.density.shape[2] == 1:
            return multiply_converted(self.density[..., 0], coarse)
        channels = [multiply_converted(self.density[..., c], coarse[:, c : c + 1]) for c in range(3)]
        return np.concatenate(channels, axis=1)

    def project(self, vectors: NDArray[np.float32]) -> NDArray[np.float32]:
        coarse = self.upsampling.T @ (vectors * self.lighting.solid_angles[:, None])  # [coarse, vector]
        channels = [multiply_converted(self.density[..., c], coarse) for c in range(self.density.shape[2])]
        return np.stack(channels, axis=-1)

    def reordered(self, source: Rows) -> Upsampled:
        return replace(self, density=self.density[source])
