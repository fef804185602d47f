"""How much of each texel a point sees: a few rays in all texels, and more where these disagree (Mitchell 1987).

``texel_edges`` needs fewer rays where one edge cuts a texel. Slats, twigs and leaves that are narrower than a texel
cut it more than once; there the error of strata falls as their number to the power -3/4, whatever is in the texel.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.bits import Bits, pack
from mi_sparse_prt.core.ragged import row_starts
from mi_sparse_prt.core.random_keys import element_seeds, random_stream
from mi_sparse_prt.core.threads import run_in_parts
from mi_sparse_prt.operators.fractional_visibility import FULL, FractionalVisibility
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.problem import Problem

FIRST = (1, 2)  # strata per axis of every texel: those of a pilot
ACROSS = (3, 4, 6, 8)  # of those of which one beside is not seen alike
ELEMENTS = 1 << 22  # at a time
# shares that differ by less: those of four rays do by more, unless the horizon weighs them
ALIKE = FULL // 5
SINGLE = 1.2  # times the share of one ray is more than one
ADAPTIVE = 14  # spawn key
MISSED = 0.005  # of the light of a point, which may be where no ray has found any

Shares = NDArray[np.int16]


class Strata(NamedTuple):
    """Strata per axis of a texel, each with a ray.

    Attributes
    ----------
    first : int
        Of all texels. One is enough where what is seen in part is seldom narrower than texels.
    across : int
        Of those that are seen in part, or of which one beside is not seen alike. Of points whose light comes through
        what is far finer than texels, all texels have so many: what no ray has found is as much as what one ray alone
        has found (Good 1953).
    """

    first: int = 2
    across: int = 4


def adaptive_visibility(
    problem: Problem, strata: Strata, seed: int
) -> tuple[FractionalVisibility, NDArray[np.int64]]:
    """Visible shares of all texels, from strata of these.

    Parameters
    ----------
    problem : Problem
        In the texel basis.
    strata : Strata
    seed : int

    Returns
    -------
    FractionalVisibility
    (n,) int64
        Rays of each point that were traced, or would have been but for the horizon.

    Notes
    -----
    Where a texel is asked again, the second rays alone count: that the first ones disagreed says something about them.
    """
    lighting, points = problem.emission, problem.points
    size, step = lighting.n_directions, max(1, ELEMENTS // lighting.n_directions)
    seeds = element_seeds(random_stream(seed, ADAPTIVE), 2)
    first, second = (DirectSolver(problem, *one) for one in zip(strata, seeds, strict=True))
    near = np.ascontiguousarray(np.hstack([lighting.sides.tables.beside, lighting.sides.tables.across]))
    blocks, rays = [], np.zeros(len(points), np.int64)
    for a in range(0, max(len(points), 1), step):
        ids = np.arange(a, min(a + step, len(points)), dtype=np.uint32)
        shares = first.shares(np.repeat(ids, size), np.tile(np.arange(size, dtype=np.uint32), len(ids)))
        shares = shares.reshape(len(ids), size)
        mixed = np.zeros(shares.shape, np.bool_)
        run_in_parts(_mark_mixed, len(ids), strata.first, shares, near, mixed)
        row, texel = np.nonzero(mixed)
        rays[ids] = strata.first**2 * (shares >= 0).sum(axis=1) + strata.across**2 * mixed.sum(axis=1)
        shares[row, texel] = second.shares(ids[row], texel.astype(np.uint32))
        blocks.append(_listed(shares))
    seen, number, texels, parts = (np.concatenate(column) for column in zip(*blocks, strict=True))
    return FractionalVisibility(seen, row_starts(number), texels, parts, points.normals, lighting), rays


def _listed(
    shares: Shares,
) -> tuple[Bits, NDArray[np.int64], NDArray[np.unsignedinteger], NDArray[np.uint8]]:
    """Bits, and for each point how many texels are seen in part, which, and their shares."""
    row, texel = np.nonzero((shares > 0) & (shares < FULL))
    # 16 bits at least: one compiled kernel for most
    kind = np.result_type(np.uint16, np.min_scalar_type(shares.shape[1] - 1))
    number = np.bincount(row, minlength=len(shares))
    return pack(2 * shares > FULL), number, texel.astype(kind), shares[row, texel].astype(np.uint8)


@numba.njit(nogil=True, cache=True)
def _mark_mixed(
    first: int,
    last: int,
    across: int,
    shares: Shares,
    near: NDArray[np.int32],
    mixed: NDArray[np.bool_],
) -> None:
    """Texels above the horizon that are not seen as all those around them; all, where light is too fine."""
    for i in range(first, last):
        total, single = 0.0, 0
        for t in range(shares.shape[1]):
            own = least = most = shares[i, t]
            if own < 0:
                continue
            others = 0
            for k in range(near.shape[1]):
                if near[t, k] >= 0 and shares[i, near[t, k]] >= 0:
                    least = min(least, shares[i, near[t, k]])
                    others = max(others, shares[i, near[t, k]])
            most = max(own, others)
            mixed[i, t] = most - least > ALIKE
            total += own / FULL
            single += 0 < own * across**2 < SINGLE * FULL and others == 0
        if single / across**2 > MISSED * total:
            for t in range(shares.shape[1]):
                mixed[i, t] = shares[i, t] >= 0
