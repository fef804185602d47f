"""Noise of gather rays averaged out along surfaces, as widely as other rays say is worth it.

Light x that rays found is known again as y, from other rays of the same vertices. Whatever smoothing S does,
|S x - y|^2 is on average the error of S x plus the noise of y, which is the same for all S: the least is the best.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.random_keys import element_seeds, random_stream
from mi_sparse_prt.core.sparse_product import Sparse, multiply_scaled
from mi_sparse_prt.reconstruction.surface_smoothing import SurfaceSmoothing, smoothing_levels
from mi_sparse_prt.solvers.form_factors import gather_matrix
from mi_sparse_prt.solvers.problem import Problem
from mi_sparse_prt.solvers.surface_nodes import Nodes

OTHERS = 64  # rays of a vertex, at most, that tell the noise of its own
STREAM = 10  # spawn key
COLUMNS = 64  # that are smoothed at a time

Floats = NDArray[np.float32]


class GatherNoise:
    """Averages out the noise of unit-albedo rows.

    Parameters
    ----------
    problem : Problem
        At the vertices.
    nodes : Nodes
        Vertices that gather light.
    rays : int
        Of each.
    seed : int

    Attributes
    ----------
    rays : int
        That were traced.
    """

    def __init__(self, problem: Problem, nodes: Nodes, rays: int, seed: int) -> None:
        scene, points, ids = problem.scene, problem.points, nodes.ids
        other = element_seeds(random_stream(seed, STREAM), 1)[0]
        rays = min(rays, OTHERS)
        self._others = gather_matrix(scene, points, rays, other, ids, problem.max_depth)
        self.rays = rays * len(ids)
        self._albedo = scene.sent_albedo.mean(axis=1)[None]
        self._smoothing = SurfaceSmoothing(smoothing_levels(scene, points, ids))
        self._chosen: NDArray[np.int8] | None = None

    def judge(self, matrix: Sparse, light: Floats) -> None:
        """Choose how many levels of smoothing each node takes.

        Parameters
        ----------
        matrix : (n, m) sparse float32
            G; of its rows and columns the first are those of nodes and vertices.
        light : (m, k) float32
            Random sums of columns of the light that surfaces receive.
        """
        rows, columns = self._others.shape
        own = matrix if matrix.shape == self._others.shape else matrix[np.arange(rows)][:, :columns]
        light = light[:columns]
        ours, others = (multiply_scaled(rays, self._albedo, light)[0] for rays in (own, self._others))

        def risk(smooth: Floats, _: int) -> Floats:
            return np.square(smooth - others).sum(axis=1, keepdims=True)

        self._chosen = self._smoothing.least(ours, risk)

    def averaged(self, light: Floats) -> Floats:
        """Light (n, k), of which the first rows are those of nodes: their noise is averaged out as was judged."""
        assert self._chosen is not None
        result, n = light.copy(), len(self._chosen)
        for a in range(0, light.shape[1], COLUMNS):
            part = np.ascontiguousarray(light[:n, a : a + COLUMNS])
            result[:n, a : a + COLUMNS] = self._smoothing.averaged(part, self._chosen)
        return result
