"""Which directions of a densely sampled vertex are evaluated ([HR10] 4.2): a quarter first, then the features.

The test for features and the borrowing of values act on the binary visibility alone. The cosine, the solid angle and
the BRDF are applied analytically afterwards, and the horizon is not an edge: what lies below it is not compared.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numba
import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mi_sparse_prt.core.bits import BITS, Bits, above_horizon, list_bits, lowest_bit, pack, scatter_bits
from mi_sparse_prt.emission.cubemap import CubemapLighting


@dataclass(frozen=True)
class DenseRows:
    """Visibility of densely sampled vertices, each (n, ceil(n_directions / 32)) uint32 bits.

    Attributes
    ----------
    visible : bits
        All directions: sampled where ``evaluated``, borrowed elsewhere; 0 below the horizon.
    evaluated : bits
        Elements for which a ray was traced: the quarter grid above the horizon, and the features.
    features : bits
        Directions whose window of sampled directions is not of one kind ([HR10] Figure 3, red).
    above : bits
        Directions above the horizon: where ``visible`` knows anything.
    """

    visible: Bits
    evaluated: Bits
    features: Bits
    above: Bits


class AngularGrid:
    """The quarter of a cubemap's texels that is sampled first, and the windows around all others.

    Parameters
    ----------
    lighting : CubemapLighting
    radius : int
        Of the windows, in texels; 3 are the 7 x 7 of [HR10] Figure 3.

    Attributes
    ----------
    texels : (n_grid,) int
        Every second texel per axis, n_directions / 4 of them (all at resolution 1).
    bits : bits
        The same, one bit per direction.
    """

    def __init__(self, lighting: CubemapLighting, radius: int = 3) -> None:
        self.lighting, self._radius = lighting, radius
        n = lighting.resolution
        _, row, column = np.unravel_index(np.arange(lighting.n_directions), (6, n, n))
        self._sampled = (row % 2 == 0) & (column % 2 == 0)
        self.texels, self.bits = np.flatnonzero(self._sampled), pack(self._sampled)

    def sample(
        self,
        normals: NDArray[np.float32],
        visible: Callable[[NDArray[np.uint32], NDArray[np.uint32]], NDArray[np.bool_]],
    ) -> DenseRows:
        """Sample rows in two passes.

        Parameters
        ----------
        normals : (n, 3) float32
            Of the vertices, in the frame of the lighting.
        visible : callable
            ``visible(rows, texels)``, both (m,): whether these vertices see the sky there, (m,) bool. Called twice.
        """
        above = above_horizon(normals, self.lighting.directions)
        first = above & pack(self._sampled)
        seen = scatter_bits(first, visible(*list_bits(first)))
        features, borrowed = np.empty_like(first), np.empty_like(first)
        _second_pass(first, seen, above, *self._stamps, features, borrowed)
        seen |= borrowed | scatter_bits(features, visible(*list_bits(features)))
        return DenseRows(seen, first | features, features, above)

    @cached_property
    def windows(self) -> NDArray[np.int32]:
        """Grid texels in the window around every texel, (n_directions, at most 16), -1 where there are fewer.

        Windows continue across the edges of the cube on the plane of the texel's own face.
        """
        columns = []
        steps = range(-self._radius, self._radius + 1)
        for dy in steps:
            for dx in steps:
                texels = self.lighting.beside(dx, dy)
                columns.append(np.where(self._sampled[texels], texels, -1))
        table = np.sort(np.stack(columns, axis=1), axis=1)[:, ::-1]  # [texel, place], -1 last
        table[:, 1:][table[:, 1:] == table[:, :-1]] = -1  # beyond an edge two places can meet one texel
        table = np.sort(table, axis=1)[:, ::-1]
        return np.ascontiguousarray(table[:, : max(1, int((table >= 0).sum(axis=1).max()))], dtype=np.int32)

    @cached_property
    def _stamps(self) -> tuple[NDArray[np.int64], NDArray[np.int32], Bits]:
        """The windows seen from the grid texels in them: a texel stamps its kind on words of bits.

        Those of texel g are at ``starts[g]`` to ``starts[g + 1]``: (n_directions + 1,) starts, (m,) words and masks.
        """
        direction, place = np.nonzero(self.windows >= 0)
        n_words = self.lighting.n_directions // BITS + 1
        pairs, pair = np.unique(
            self.windows[direction, place].astype(np.int64) * n_words + direction // BITS, return_inverse=True
        )
        masks = np.zeros(len(pairs), np.uint32)
        np.bitwise_or.at(masks, pair, np.uint32(1) << (direction % BITS).astype(np.uint32))
        texel, words = np.divmod(pairs, n_words)
        starts = np.searchsorted(texel, np.arange(self.lighting.n_directions + 1))
        return starts, words.astype(np.int32), masks

    @cached_property
    def upsampling(self) -> scipy.sparse.csr_array:
        """Bilinear interpolation of values at ``texels`` to all directions, (n_directions, n_grid), rows sum to 1.

        Inside of a face it is exact for linear functions of the face coordinates; near an edge the tent reaches the
        grid texels of the next face.
        """
        index = np.full(self.lighting.n_directions, -1)
        index[self.texels] = np.arange(len(self.texels))
        rows, columns, weights = [], [], []
        for dy in (-1, 0, 1):
            for dx in (-1, 0, 1):
                texels = self.lighting.beside(dx, dy)
                # a sampled texel keeps its own value
                wanted = ~self._sampled if dx or dy else np.ones_like(self._sampled)
                good = np.flatnonzero(self._sampled[texels] & (texels >= 0) & wanted)
                rows.append(good)
                columns.append(index[texels[good]])
                weights.append(np.full(len(good), (1 - abs(dx) / 2) * (1 - abs(dy) / 2)))
        entries = (np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns)))
        matrix = scipy.sparse.coo_array(entries, shape=(self.lighting.n_directions, len(self.texels))).tocsr()
        total = matrix.sum(axis=1)
        return scipy.sparse.csr_array(scipy.sparse.diags_array(1 / total) @ matrix, dtype=np.float32)


@numba.njit(parallel=True, cache=True)
def _second_pass(
    first: Bits,
    seen: Bits,
    above: Bits,
    starts: NDArray[np.int64],
    stamp_words: NDArray[np.int32],
    stamp_masks: Bits,
    features: Bits,
    borrowed: Bits,
) -> None:
    """Find features (to be sampled) and borrowed visibility of the directions that the first pass left out.

    A window with no sampled direction above the horizon says nothing: its direction is sampled as well.
    """
    words = first.shape[1]
    for i in numba.prange(len(first)):
        near = np.zeros((2, words), np.uint32)  # [dark or lit, word]
        for w in range(words):
            left = first[i, w]
            while left:
                bit = np.uint32(lowest_bit(left))  # type: ignore[call-arg]  # numba gives the context
                left &= left - np.uint32(1)
                kind = (seen[i, w] >> bit) & np.uint32(1)
                texel = w * BITS + np.int64(bit)
                for q in range(starts[texel], starts[texel + 1]):
                    near[kind, stamp_words[q]] |= stamp_masks[q]
        for w in range(words):
            dark, lit, asked = near[0, w], near[1, w], above[i, w] & ~first[i, w]
            features[i, w] = asked & ~(dark ^ lit)
            borrowed[i, w] = asked & lit & ~dark
