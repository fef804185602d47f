"""How much of each texel a point sees: a few rays in all texels, and more where these disagree (Mitchell 1987).

``texel_edges`` needs fewer rays where one edge cuts a texel. Slats, twigs and leaves that are narrower than a texel
cut it more than once; there the error of strata falls as their number to the power -3/4, whatever is in the texel.
So the rays of a texel that leave the smallest squared error in all are as c^(4/5) v^(2/5): c is its weight, the cosine
times the solid angle and what the point makes of light, and v the chance that it is seen in part at all.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

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
ACROSS = (2.5, 3, 3.5, 4, 5, 6, 8)  # of those of which one beside is not seen alike
ELEMENTS = 1 << 22  # at a time
# shares that differ by less: those of four rays do by more, unless the horizon weighs them
ALIKE = FULL // 5
# of the eight texels beside one that is seen in part, so many are seen otherwise: fewer say that it seldom is, in
# proportion (of rooms, leaves and figures 0.03 to 0.4 of those with one, 0.9 to 1 of those with four)
BESIDE = 4
SINGLE = 1.2  # times the share of one ray is more than one
ADAPTIVE = 14  # spawn key
MISSED = 0.005  # of the light of a point, which may be where no ray has found any

Shares = NDArray[np.int16]
Floats: TypeAlias = NDArray[np.float32]


class Strata(NamedTuple):
    """Strata per axis of a texel, each with a ray.

    Attributes
    ----------
    first : int
        Of all texels. One is enough where what is seen in part is seldom narrower than texels.
    across : float
        Of those that are seen in part, or of which one beside is not seen alike, if their weight is the mean of those
        above the horizon, two of those beside are not seen alike, and most light arrives at points that make as much
        of it; of others as their rays are worth. Of points whose light comes through what is far finer than texels, all
        texels have so many: what no ray has found is as much as what one ray alone has found (Good 1953).
    """

    first: int = 2
    across: float = 4


def importance_of(problem: Problem) -> Floats:
    """How much light counts at points (n,), 1 where most of it counts: what they make of it, or their mesh does."""
    own = problem.raise_to_mesh_mean(problem.reflection.importance)
    whole = np.square(own, dtype=np.float64)
    return (own * (whole.sum() / max(float((whole * own).sum()), 1e-30))).astype(np.float32)


def adaptive_visibility(
    problem: Problem, strata: Strata, seed: int, importance: Floats | None = None
) -> tuple[FractionalVisibility, NDArray[np.int64]]:
    """Visible shares of all texels, from strata of these.

    Parameters
    ----------
    problem : Problem
        In the texel basis.
    strata : Strata
    seed : int
    importance : (n,) float32, optional
        ``importance_of`` the points, if not that of all of the problem's.

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
    step = max(1, ELEMENTS // lighting.n_directions)
    first, second = (
        DirectSolver(problem, strata.first, seed) for seed in element_seeds(random_stream(seed, ADAPTIVE), 2)
    )
    near = np.ascontiguousarray(np.hstack([lighting.sides.tables.beside, lighting.sides.tables.across]))
    weights = lighting.directions * (2 * lighting.solid_angles / lighting.solid_angles.mean())[:, None]
    counts_as = importance_of(problem) if importance is None else importance
    blocks, rays = [], np.zeros(len(points), np.int64)
    for a in range(0, max(len(points), 1), step):
        ids = np.arange(a, min(a + step, len(points)), dtype=np.uint32)
        shares = first.rows_of_shares(ids)
        again = np.zeros(shares.shape, np.uint8)
        worth = points.normals[ids] * counts_as[ids, None], weights.astype(np.float32), counts_as[ids]
        run_in_parts(_ask_again, len(ids), *strata, shares, near, *worth, again)
        rays[ids] = strata.first**2 * (shares >= 0).sum(axis=1) + np.square(again, dtype=np.int64).sum(axis=1)
        row, texel = (places.astype(np.uint32) for places in np.nonzero(again))
        counts = again[row, texel]
        for across in np.unique(counts).tolist():
            some = counts == across
            shares[row[some], texel[some]] = second.shares(ids[row[some]], texel[some], across)
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
def _ask_again(
    first: int,
    last: int,
    few: int,
    across: float,
    shares: Shares,
    near: NDArray[np.int32],
    normals: Floats,
    weights: Floats,
    importance: Floats,
    again: NDArray[np.uint8],
) -> None:
    """Strata per axis of texels above the horizon that are not seen as all those around them, by what rays are worth.

    All, where light is too fine; others have none. ``weights`` are vectors, whose products with a normal are weights.
    Points of which no more rays are worth it have none.
    """
    for i in range(first, last):
        if across * importance[i] ** 0.4 < few + 0.5:
            continue
        total, single = 0.0, 0
        for t in range(shares.shape[1]):
            own = least = most = shares[i, t]
            if own < 0:
                continue
            others, differing = 0, 0
            for k in range(near.shape[1]):
                if near[t, k] >= 0 and shares[i, near[t, k]] >= 0:
                    least = min(least, shares[i, near[t, k]])
                    others = max(others, shares[i, near[t, k]])
                    differing += abs(shares[i, near[t, k]] - own)
            most = max(own, others)
            if most - least > ALIKE:
                # how many beside are seen otherwise; strata, when all are known
                again[i, t] = BESIDE if 0 < own < FULL else min(max(differing // FULL, 1), BESIDE)
            total += own / FULL
            single += 0 < own * few**2 < SINGLE * FULL and others == 0
        fine = single / few**2 > MISSED * total
        for t in range(shares.shape[1]):
            if shares[i, t] >= 0 and (fine or again[i, t] > 0):
                weight = np.float32(0)  # numba counts who holds slices, which a product of vectors would take
                for k in range(3):
                    weight += normals[i, k] * weights[t, k]
                chance = max(again[i, t], 1) / (BESIDE / 2)
                strata = across * max(weight, np.float32(0)) ** 0.4 * chance**0.2
                again[i, t] = min(max(few + 1, round(strata)), 255)
