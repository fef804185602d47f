"""Noise of light by way of mirrors and glass, averaged out among the nearest vertices where that is worth it.

Light is known twice, as a and b, from rays of their own. Whatever smoothing S does, |S a - b|^2 is on average the error
of S a plus the noise of b, which |a - b|^2 tells; |S a - S b|^2 tells what noise S leaves. So the squared error of
S (a + b) / 2 is |S a - b|^2 - |a - b|^2 / 2 - |S a - S b|^2 / 4; it is |a - b|^2 / 4 without S. Edges of caustics,
where the first is larger, stay as they are.
"""

from __future__ import annotations

from typing import TypeAlias

import numba
import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mi_sparse_prt.core.random_keys import random_stream
from mi_sparse_prt.core.sparse_product import multiply_sparse
from mi_sparse_prt.core.threads import run_in_parts
from mi_sparse_prt.reconstruction.surface_smoothing import STRIDES, SurfaceSmoothing, smoothing_levels
from mi_sparse_prt.solvers.problem import Problem

SUMS = 64  # of columns, by which norms of rows are told apart
STREAM = 11  # spawn key

Floats = NDArray[np.float32]
Sparse: TypeAlias = scipy.sparse.csr_array


class SpecularNoise:
    """Averages out the noise of sparse rows of vertices. One level of smoothing: more make rows dense.

    Parameters
    ----------
    problem : Problem
        At the vertices.
    seed : int
    """

    def __init__(self, problem: Problem, seed: int) -> None:
        levels = smoothing_levels(problem.scene, problem.points, strides=STRIDES[:1])
        self._smoothing, self._near, self._seed = SurfaceSmoothing(levels), levels[0], seed
        self._share = np.zeros((len(problem.points), 1), np.float32)

    def judge(self, halves: list[list[Sparse]], power: NDArray[np.float64]) -> float:
        """Choose where light is smoothed; what squared noise and blur is left in the mean of the halves.

        Parameters
        ----------
        halves : two of a few sparse (n, m) float32
            Of the same channels.
        power : (n, channels) float64
            What the squares of each row count.
        """
        signs = np.random.default_rng(random_stream(self._seed, STREAM)).integers(
            0, 2, (halves[0][0].shape[1], SUMS)
        )
        columns = (2 * signs - 1).astype(np.float32)
        before, after = np.zeros((2, len(power), 1))
        for channel, pair in enumerate(zip(*halves, strict=True)):
            a, b = (multiply_sparse(half, columns) for half in pair)
            smooth_a, smooth_b = (multiply_sparse(self._near, x) for x in (a, b))
            noise, own = _squared_distances(a, b), power[:, channel : channel + 1] / SUMS
            error = (_squared_distances(smooth_a, b) + _squared_distances(smooth_b, a)) / 2
            before += own * noise / 4
            after += own * (error - noise / 2 - _squared_distances(smooth_a, smooth_b) / 4)
        pooled = [self._smoothing.pooled(x.astype(np.float32)) for x in (before, after)]
        chosen = pooled[1] < pooled[0]
        self._share = self._smoothing.pooled(chosen.astype(np.float32))
        return float(np.where(chosen, pooled[1], pooled[0]).sum(dtype=np.float64))

    def averaged(self, light: Sparse) -> Sparse:
        """Light (n, m), smoothed where that was chosen; no seams where neighbours differ.

        What a vertex gives is what others take: where the choice follows noise, none of the light gets lost.
        """
        n, pointers = len(self._share), self._near.indptr
        row = np.repeat(np.arange(n), np.diff(pointers))
        share = (self._share[row, 0] + self._share[self._near.indices, 0]) / 2
        given = scipy.sparse.csr_array((share * self._near.data, self._near.indices, pointers), shape=(n, n))
        kept = scipy.sparse.diags_array(1 - given.sum(axis=1), format="csr")
        return scipy.sparse.csr_array((kept + given).astype(np.float32) @ light)


def _squared_distances(x: Floats, y: Floats) -> NDArray[np.float64]:
    """Between rows of the same numbers (n, 1)."""
    squares = np.empty((len(x), 1))
    run_in_parts(_fill_distances, len(x), x, y, squares)
    return squares


@numba.njit(nogil=True, cache=True)
def _fill_distances(first: int, last: int, x: Floats, y: Floats, squares: NDArray[np.float64]) -> None:
    for i in range(first, last):
        total = 0.0
        for k in range(x.shape[1]):
            total += (x[i, k] - y[i, k]) ** 2
        squares[i, 0] = total
