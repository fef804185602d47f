"""How much memory a matrix takes while it is made: the arrays of each way to find light, at their peak.

Sizes follow from the scene and the plan, but for what a few hundred vertices tell: how many rays meet a surface. Six
scenes of 17,000 to 101,000 vertices told what is taken beside arrays, and what rank a tolerance leads to.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import psutil

from mi_sparse_prt.methods.plan import Plan
from mi_sparse_prt.reconstruction.node_placement import node_count
from mi_sparse_prt.reflection.in_out_factors import InOutFactors
from mi_sparse_prt.reflection.reflection import Reflection
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.first_bounce import USUAL
from mi_sparse_prt.solvers.form_factors import gather_matrix
from mi_sparse_prt.solvers.paths import PathSolver

KERNELS = 270e6  # compiled code and wavefronts of rays: 90 to 560 MB, the middle of seven runs in ratio
PILOT = 512  # vertices whose rays are counted
RANK = 5.0  # of a first bounce, times its tolerance: 3 to 11 in scenes of few and of many colours and shapes
COMBINATIONS = 1.3  # vectors of a random basis for each of the rank, as the last of the energy takes many ...
FIRST_COMBINATIONS = 96  # ... and so many are drawn at once
EDGES = 4.0  # texels that a vertex sees in part, times the resolution
IN_PART = 0.25  # of all texels, where what is seen is so fine that strata are adaptive
ENTRY = 8  # bytes of an entry of a sparse matrix
DENSE, HUANG_DENSE = 0.22, 0.3  # share of the vertices whose rows are known, where nothing else is asked for


class _Gathered(NamedTuple):
    """Rays of all vertices that meet a surface, what these find, and what those of glossy vertices weigh in terms."""

    hits: float
    entries: float
    weights: float = 0.0


def free_bytes() -> int:
    """Of memory, beside what the process has."""
    return int(psutil.virtual_memory().available)


def terms_fit(reflection: Reflection, depths_apart: int) -> bool:
    """Whether there is memory for what glossy points send to each other, by whatever plan."""
    rows = reflection.row_count * max(1, depths_apart)
    return _drawn(rows) + _basis(rows, 0.0) <= free_bytes()


def _drawn(rows: int) -> float:
    """Bytes of columns of D that are added up, in pieces and in one, and times G."""
    return 3.0 * 4 * rows * FIRST_COMBINATIONS


def _basis(rows: int, rank: float) -> float:
    """Bytes of a random basis."""
    return 4 * rows * max(COMBINATIONS * rank, FIRST_COMBINATIONS)


def peak_bytes(direct: DirectSolver, paths: PathSolver, plan: Plan, indirect: bool) -> float:
    """Bytes that a plan takes at its peak, beside what the process has.

    Parameters
    ----------
    direct : DirectSolver
        At all points.
    paths : PathSolver
        With the resolution of the indirect light.
    plan : Plan
    indirect : bool
        Whether there is indirect light.
    """
    known, working = _direct(direct, plan)
    if not indirect or plan.indirect == "none":
        return KERNELS + known + working
    if plan.indirect == "gather":
        return KERNELS + known + max(working, _gathered(direct, paths.channels, plan))
    elements = len(direct.points) * paths.lighting.n_directions * paths.channels
    if plan.indirect == "paths":
        return KERNELS + known + working + 2.0 * elements
    share = (plan.dense or DENSE) if plan.indirect == "sparse" else HUANG_DENSE
    # mean and variance, and copies, of a quarter of the texels
    return KERNELS + known + max(working, share * elements / 4 * 24)


def _direct(direct: DirectSolver, plan: Plan) -> tuple[float, float]:
    """Bytes of direct light, and of what it takes beside these while it is found."""
    n, texels = len(direct.points), direct.lighting.n_directions
    bits = n * -(-texels // 32) * 4.0
    if plan.direct == "edges":
        parts = n * EDGES * direct.lighting.resolution * 3
        return bits + parts, bits + parts
    if plan.direct == "adaptive":
        parts = n * IN_PART * texels * 3
        return bits + parts, bits + parts
    if direct.basis == "texel":
        return 2.0 * n * texels, 0.0
    # what was evaluated, and what is above the horizon
    return bits, 0.0 if plan.direct == "exact" else 2 * bits


def _gathered(direct: DirectSolver, channels: int, plan: Plan) -> float:
    """Bytes of form factors and of the low rank that is made with them."""
    n, texels, reflection = len(direct.points), direct.lighting.n_directions, direct.problem.sending
    terms, nodes = reflection.terms, node_count(direct.problem.scene)
    rows = reflection.row_count * max(1, direct.problem.depths_apart)  # each depth has rows of its own
    found = _rays_that_meet(direct, plan.rays)
    rank = min(RANK / plan.tolerance, USUAL.most, texels)
    basis, drawn = _basis(rows, rank), _drawn(rows)
    if terms:
        colours = channels if channels == 1 else 3
        of_rays = found.hits * 4 * (6 + 1 + terms + colours * terms)
        matrix = 4 * (found.weights + (1 + colours) * found.entries)  # channels share columns
        low_rank = 4 * rows * rank * (3 + colours - 1)
        return max(2 * of_rays, of_rays + matrix + drawn + basis + low_rank)
    low_rank = 4 * channels * rank * (2 * nodes + n)
    return 2 * ENTRY * found.entries * nodes / n + drawn / channels + basis * nodes / n + low_rank


def _rays_that_meet(direct: DirectSolver, rays: int) -> _Gathered:
    """From the rays of a few vertices."""
    problem, n = direct.problem.at_vertices, len(direct.problem.at_vertices.points)
    some = np.sort(np.random.default_rng(0).choice(n, min(n, PILOT), replace=False))
    found, scale = gather_matrix(problem.scene, problem.points, rays, 0, some), n / len(some)
    if not isinstance(problem.sending, InOutFactors):
        return _Gathered(scale * rays * float(found.sum()), scale * found.nnz)
    rows = np.ones(n)
    rows[problem.sending.glossy] += problem.sending.terms
    hits = rays * found
    own = np.where(rows > 1, rows, 0)[some]
    return _Gathered(
        scale * float(hits.sum()), scale * float((hits @ rows).sum()), scale * float(own @ hits.sum(axis=1))
    )
