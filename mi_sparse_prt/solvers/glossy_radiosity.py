"""Interreflection among glossy surfaces by finite elements: terms of BRDFs are elements as vertices are.

Light that leaves vertex y towards w_o is ``rho_y B_y + sum_l g_l(w_o) B_yl``: a diffuse part and the coefficients B_yl
that incident factors f_l have found ([HR10] eq. 2-3, [Leh07] 2.5). What rays from x find of it, weighted by 1 (white
light) and by f_k(w) pi / cos (its own terms), is one sparse matrix over all of these.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mi_sparse_prt.core.factored_sparse import FactoredSparse
from mi_sparse_prt.core.random_keys import mix
from mi_sparse_prt.core.sparse_product import Sparse
from mi_sparse_prt.operators.by_depth import ByDepth
from mi_sparse_prt.operators.factored_visibility import FactoredVisibility
from mi_sparse_prt.operators.operator import Operator
from mi_sparse_prt.operators.sparse_rows import SparseRows
from mi_sparse_prt.reflection.factor_tables import outgoing_tables
from mi_sparse_prt.reflection.in_out_factors import InOutFactors
from mi_sparse_prt.solvers.glossy_rays import Noise, gather_matrices, gather_rays
from mi_sparse_prt.solvers.problem import Problem
from mi_sparse_prt.solvers.radiosity import (
    NEGLIGIBLE,
    Averaging,
    FiniteElements,
    Gathered,
    GatheredByDepth,
)
from mi_sparse_prt.solvers.specular_chains import specular_form_factors
from mi_sparse_prt.solvers.surface_nodes import Nodes

MOST_BOUNCES = 64  # where there is no limit
BESIDE_NOISE = 0.5  # of its square may a low rank leave out: the rank of noise is full
MOST_NOISE = 0.5  # of the first bounce: a tolerance beyond would leave it out
LEAST_WEIGHT = 0.05  # of the largest: what hardly matters is not left to chance
EVEN = 1e-6  # relative difference of channels that is none

Floats = NDArray[np.float32]


class GlossyGather(FiniteElements):
    """Indirect light at the vertices of a scene and of the terms of its glossy ones.

    Rows are numbered as in ``FactoredVisibility``.

    Parameters
    ----------
    matrices : sequence of sequences of (n_nodes, n) sparse float32
        As for ``FiniteElements``.
    albedo : (channels, n) float32
        Of the diffuse part of each vertex; 1 for terms.
    problem : Problem
    direct : FactoredVisibility
    nodes : Nodes
        See ``nodes_and_terms``.
    weights : (n,) float32
        What errors of rows count by.
    seed : int
    """

    def __init__(
        self,
        matrices: Sequence[Sequence[Sparse]],
        albedo: Floats,
        problem: Problem,
        direct: FactoredVisibility,
        nodes: Nodes,
        weights: Floats,
        seed: int,
    ) -> None:
        points = problem.points
        term = np.tile(np.arange(1, direct.terms + 1), len(direct.glossy)).astype(np.uint64)
        keys = [points.keys, mix(np.repeat(points.keys[direct.glossy], direct.terms) + term)]
        super().__init__(matrices, albedo, np.concatenate(keys), nodes, problem.max_depth, seed)
        self._visibility = direct.visibility
        self.weights = np.maximum(weights[nodes.ids], LEAST_WEIGHT * weights.max())

    def _count_for(self, direct: Operator) -> int:
        """By the direct light of white surfaces: that of terms is dear, and joins with the first bounce."""
        unit_albedo = self._visibility.relight(np.ones((direct.shape[1], 3), np.float32))[:, 0]
        return self.bounces(
            np.concatenate([unit_albedo, np.zeros(direct.shape[0] - len(unit_albedo), np.float32)])
        )

    def bounces(self, even: Floats) -> int:
        """How many interreflections count for anything; terms may be negative, so that this is no strict bound."""
        total, count, light = 0.0, 0, self._gathered(even[:, None])
        while count < (self.max_depth - 2 if self.max_depth >= 0 else MOST_BOUNCES):
            peak = max(float(np.abs(x).max(initial=0)) for x in light)
            if peak <= NEGLIGIBLE * total or peak == 0:
                break
            count, total, light = count + 1, total + peak, self._reflected(light)
        return count


def nodes_and_terms(nodes: Nodes, direct: FactoredVisibility) -> Nodes:
    """Rows that gather light: those of some vertices, between which others interpolate theirs, and of all terms."""
    n, rows = len(direct.material), direct.shape[0]
    weights = nodes.weights
    if weights is not None:
        weights = scipy.sparse.block_diag([weights, scipy.sparse.eye_array(rows - n)], "csr", np.float32)
    return Nodes(np.concatenate([nodes.ids, np.arange(n, rows)]), weights)


class GatherEffort(NamedTuple):
    """How much is done for light among surfaces.

    Attributes
    ----------
    rays_per_vertex : int
        A power of two.
    tolerance : float
        As for ``RadiositySolver.indirect``, of radiance; no less than most of the noise of the rays.
    seed : int
    """

    rays_per_vertex: int
    tolerance: float
    seed: int


def glossy_indirect(
    problem: Problem,
    direct: FactoredVisibility,
    nodes: Nodes,
    effort: GatherEffort,
    specular: SparseRows | ByDepth | None = None,
    averaging: Averaging | None = None,
) -> tuple[Gathered | GatheredByDepth, Noise]:
    """Indirect light of all rows of ``direct``, factored per channel, and the noise of the rays.

    Parameters
    ----------
    problem : Problem
        What it sends has the factors of ``direct``.
    direct : FactoredVisibility
    nodes : Nodes
        Vertices that gather unit-albedo light, others interpolate theirs; terms are gathered at all glossy ones.
    effort : GatherEffort
    specular : SparseRows or ByDepth, optional
        Light from the sky by way of mirrors and glass, which surfaces send on as well. What they send on by way of
        mirrors and glass reaches unit-albedo rows, and of glossy surfaces as far as these are diffuse.
    averaging : Averaging, optional
        Of the noise of unit-albedo rows.
    """
    assert isinstance(problem.sending, InOutFactors)
    albedo, outgoing = _channels(problem)
    rays_per_vertex, tolerance, seed = effort
    first, noise = _form_factors(problem, direct, nodes, outgoing, effort)
    tolerance = max(tolerance, math.sqrt(BESIDE_NOISE) * min(noise.bounce, MOST_NOISE))
    rows = nodes_and_terms(nodes, direct)
    after_mirrors = _after_mirrors(problem, nodes.ids, (len(rows), direct.shape[0]), rays_per_vertex, seed)
    matrices = [[matrix, *after_mirrors] for matrix in first]
    of_terms = np.ones((len(albedo), direct.shape[0] - albedo.shape[1]), np.float32)
    every, weights = np.hstack([albedo, of_terms]), _row_weights(problem, problem.sending, len(nodes))
    solver = GlossyGather(matrices, every, problem, direct, rows, weights, seed)
    solver.averaging = averaging
    return solver.indirect(direct, tolerance, specular), noise


def _form_factors(
    problem: Problem, direct: FactoredVisibility, nodes: Nodes, outgoing: Floats, effort: GatherEffort
) -> tuple[list[FactoredSparse], Noise]:
    """G_0 of each channel, and the noise of its rays, which are not kept: they take as much memory."""
    points = np.union1d(nodes.ids, direct.glossy)
    rays = gather_rays(problem, outgoing, effort.rays_per_vertex, effort.seed, points)
    noise = rays.noise(direct, problem, effort.seed)
    return gather_matrices(direct, rays, len(outgoing), nodes.ids), noise


def _row_weights(problem: Problem, sending: InOutFactors, nodes: int) -> Floats:
    """What errors of rows count by: radiance, and for how many vertices a row stands."""
    weights, n = sending.row_weights.mean(axis=1), len(sending.albedo)
    if problem.sent is not None:
        stands_for = np.bincount(problem.sent.senders[problem.reflection.glossy], minlength=n)
        share = np.maximum(stands_for[sending.glossy], 1) * nodes / n
        weights[n:] *= np.repeat(np.sqrt(share), sending.terms)
    return weights


def _after_mirrors(
    problem: Problem, ids: NDArray[np.integer], shape: tuple[int, int], rays: int, seed: int
) -> list[scipy.sparse.csr_array]:
    """G_1, G_2, ... of unit-albedo rows, the first ones of this shape; none where there are no specular surfaces."""
    if not problem.specular_apart:
        return []
    matrices = specular_form_factors(problem, ids, rays, seed)
    for matrix in matrices:
        matrix.resize(shape)
    return matrices


def _channels(problem: Problem) -> tuple[Floats, Floats]:
    """Albedos (channels, n_v) and g_k (channels, ...); one channel where all are alike."""
    reflection = problem.sending
    assert isinstance(reflection, InOutFactors)
    albedo = np.minimum(reflection.albedo + problem.scene.transmitted, 1)
    outgoing = outgoing_tables(reflection.factors)
    grey = np.ptp(albedo, axis=1).max() <= EVEN and np.ptp(outgoing, axis=4).max() <= EVEN * outgoing.max()
    count = 1 if grey else 3
    return np.ascontiguousarray(albedo.T[:count]), np.ascontiguousarray(np.moveaxis(outgoing, 4, 0)[:count])
