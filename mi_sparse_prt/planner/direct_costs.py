"""What direct light costs and how far off it is: by all rays, and by consensus on a few patches of surface."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mi_sparse_prt.core.bits import Bits, count_bits, list_bits, unpack
from mi_sparse_prt.core.random_keys import random_stream
from mi_sparse_prt.estimation.pilot_elements import PilotElements
from mi_sparse_prt.measurement.vertices import Points
from mi_sparse_prt.planner.row_timing import seconds_per_row
from mi_sparse_prt.sampling.angular import AngularGrid
from mi_sparse_prt.sampling.consensus import Consensus, Surface, sample_by_levels
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.solvers.adaptive_strata import ACROSS, FIRST, Strata, adaptive_visibility, importance_of
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.problem import Problem
from mi_sparse_prt.solvers.texel_edges import fractional_visibility
from mi_sparse_prt.solvers.walls import Walls

MINIMUM_GAIN = 0.9  # of an error is better
PATCH = 512  # vertices, next to each other
PATCHES = 8  # in all, or one for each mesh
INNER = 4  # one in so many vertices of a patch is judged: the middle ones, which have all their neighbours
PATCHES_DRAWN = 3  # spawn key
EDGES_TIMED = 16  # times the points of a pilot
COMPILED = 16  # points for which kernels are compiled, before others are timed
OVERHEAD = 12e-6  # seconds per vertex that consensus takes beside its rays
SAVED = 0.5  # of all rays, as consensus is taken to do before it is measured
BEGUN = 0.4  # seconds of a pilot's consensus beside its rays


def negligible_beside(others: float) -> float:
    """How large an error may be beside others, so that it makes all of them larger by a tenth."""
    return others * math.sqrt(MINIMUM_GAIN**-2 - 1)


@dataclass(frozen=True)
class DirectCost:
    """Seconds of all direct light, and its error relative to that of a pilot's elements, or to the whole matrix, L2.

    ``centres`` are those seconds that rays to texels' centres take, ``strata`` those of an adaptive plan.
    """

    seconds: float
    error: float
    centres: float = 0.0
    strata: Strata | None = None

    @property
    def with_known_centres(self) -> DirectCost:
        """Where these rays have been traced for something else."""
        return replace(self, seconds=self.seconds - self.centres, centres=0.0)

    def beside_indirect(self, share: float) -> DirectCost:
        """With an error relative to the whole matrix, if relative to direct light, which is a share of it."""
        return replace(self, error=share * self.error)


def exact_cost(direct: DirectSolver, held: PilotElements) -> DirectCost:
    """All rays. In the texel basis there is an error, by the number of strata."""
    seconds = len(direct.points) * seconds_per_row(direct)
    if direct.basis == "direction":
        return DirectCost(seconds, 0.0, seconds)
    ours = direct.elements(np.repeat(held.vertices, held.texels.shape[1]), held.texels.ravel())
    square = held.relative_square(held.error_of(held.direct, ours.reshape(*held.texels.shape, 1)))
    return DirectCost(seconds, math.sqrt(max(square, 0.0)))


def edges_cost(direct: DirectSolver, held: PilotElements) -> DirectCost:
    """Texels' centres, and rays along edges of visibility, in the texel basis."""
    problem = replace(direct.problem, basis="direction")
    centres = len(direct.points) * seconds_per_row(DirectSolver(problem))
    # as often that one launch of a kernel is next to nothing, as it is for all points
    ids = np.repeat(held.vertices, held.shares_of(EDGES_TIMED * len(held.vertices)))
    timed = DirectSolver(problem.at(points_at(direct.points, ids)))
    bits = timed.rows(np.arange(len(ids))).astype(np.uint32, copy=False)
    error = edges_error(direct, held)  # compiles, too
    start = time.perf_counter()
    fractional_visibility(timed, bits)
    edges = (time.perf_counter() - start) * len(direct.points) / len(ids)
    return DirectCost(centres + edges, error, centres)


def edges_error(direct: DirectSolver, held: PilotElements) -> float:
    """That of ``edges_cost``, which takes a small part of its time."""
    some = DirectSolver(replace(_few(direct, held), basis="direction"))
    bits = some.rows(np.arange(len(held.vertices))).astype(np.uint32, copy=False)
    return math.sqrt(held.squared_error_of_shares(fractional_visibility(some, bits)[0]))


def adaptive_cost(direct: DirectSolver, held: PilotElements, aim: float, seed: int) -> DirectCost:
    """Strata that an error takes, with the fewest rays; of about the most exact ones, if none are enough.

    Lobes that change within texels leave an error that no strata take away.

    The squared error is that of texels that seem to be seen as a whole, and one that falls as ``across**-3``; rays grow
    as ``across**2``. Two numbers of strata tell both.
    """
    few = _few(direct, held)
    importance = importance_of(direct.problem)[held.vertices]
    compiled = few.at(points_at(few.points, np.arange(min(COMPILED, len(held.vertices)))))
    adaptive_visibility(compiled, Strata(), seed, importance[:COMPILED])
    costs = [cost for first in FIRST for cost in _strata_costs(few, importance, held, first, seed)]
    good = max(aim, min(cost.error for cost in costs) / MINIMUM_GAIN)
    return min((cost for cost in costs if cost.error <= good), key=lambda cost: cost.seconds)


def _strata_costs(
    few: Problem, importance: NDArray[np.float32], held: PilotElements, first: int, seed: int
) -> list[DirectCost]:
    """Of all that a pilot's points stand for. Points take some time, and rays some more.

    Many rays come first: sums over any number of strata are kernels of their own, which few rays need as well.
    """
    timed, rays, squares = [], [], []
    for across in (ACROSS[-1], ACROSS[0]):
        start = time.perf_counter()
        part, traced = adaptive_visibility(few, Strata(first, across), seed, importance)
        timed.append((time.perf_counter() - start, int(traced.sum())))
        rays.append(float(held.stand_for @ traced))
        squares.append(held.squared_error_of_shares(part))
    (whole, most), (begun, fewest) = timed
    each = min(max(whole - begun, 0.0) / max(most - fewest, 1), whole / max(most, 1))
    fixed = max(begun - each * fewest, 0.0) * float(held.stand_for.sum()) / len(held.vertices)
    falls, grows = np.array(ACROSS) ** -3.0, np.array(ACROSS) ** 2.0
    fall = max(squares[1] - squares[0], 0.0) / (falls[0] - falls[-1])
    rise = (rays[0] - rays[1]) / (grows[-1] - grows[0])
    costs = []
    for across, falling, growing in zip(ACROSS, falls, grows, strict=True):
        square = fall * falling + max(squares[0] - fall * falls[-1], 0.0)
        seconds = fixed + each * (rays[1] + float(rise * (growing - grows[0])))
        costs.append(DirectCost(seconds, math.sqrt(square), strata=Strata(first, across)))
    return costs


def _few(direct: DirectSolver, held: PilotElements) -> Problem:
    """The problem at the points of a pilot."""
    return direct.problem.at(points_at(direct.points, held.vertices))


def points_at(points: Points, ids: NDArray[np.integer]) -> Points:
    """Some of the points."""
    return Points(*(x[ids] for x in (points.positions, points.normals, points.offset_normals, points.keys)))


def consensus_may_pay(direct: DirectSolver, exact: DirectCost) -> bool:
    """Whether consensus may save more than it takes to find out, by rays of patches, and all of those inside them."""
    patches = max(PATCHES, len(direct.problem.scene.sampled_together))
    measured = patches * PATCH * (1 - SAVED + 1 / INNER) / len(direct.points)
    return exact.seconds * (SAVED - measured) > BEGUN


def consensus_cost(
    direct: DirectSolver, held: PilotElements, seed: int | np.random.SeedSequence
) -> DirectCost:
    """Consensus in the direction basis, from patches inside of which all rays are traced as well."""
    scene = direct.problem.scene
    patches, inner, stands_for = _patches(scene, np.random.default_rng(random_stream(seed, PATCHES_DRAWN)))
    ids = np.concatenate(patches)
    state = Consensus(
        direct.points.normals[ids],
        AngularGrid(direct.lighting),
        lambda vertices, texels: direct.visible(ids[vertices].astype(np.uint32), texels),
    )
    first, walls = 0, Walls(scene, points_at(direct.points, ids))
    for patch in patches:
        p = scene.normalised_positions[patch]
        surface = Surface(first, p, scene.normals[patch], direct.points.keys[patch])
        sample_by_levels(state, surface, walls.leave_fewer)
        first += len(patch)
    asked, seen, ids = state.evaluated[inner], state.visible[inner], ids[inner]
    rays = float(stands_for @ count_bits(asked))
    seconds = rays * _seconds_per_ray(direct, ids, asked) + OVERHEAD * len(direct.points)
    power = (scene.albedo[ids] ** 2).sum(axis=1) * stands_for
    exact = direct.rows(ids.astype(np.uint32)).astype(np.uint32, copy=False)
    wrong, all_of_it = (float(power @ _energy(direct, ids, bits)) for bits in (exact ^ seen, exact))
    return DirectCost(seconds, held.direct_share * math.sqrt(wrong / max(all_of_it, 1e-300)))


def _patches(
    scene: Scene, rng: np.random.Generator
) -> tuple[list[NDArray[np.int64]], NDArray[np.int64], NDArray[np.float64]]:
    """Neighbouring vertices around random ones of each mesh.

    Returns also the places of those inside, that have all their neighbours, in the patches one after the other, and
    how many vertices of the scene each of them stands for.
    """
    patches, inner, stands_for, first = [], [], [], 0
    for part in scene.sampled_together:
        p = scene.normalised_positions[part]
        centres = p[rng.choice(len(p), max(1, round(PATCHES * len(p) / scene.n_vertices)), replace=False)]
        tree = cKDTree(p)
        patch, core = (
            np.unique(tree.query(centres, min(count, len(p)))[1])
            for count in (PATCH, PATCH // INNER if len(p) > PATCH else PATCH)
        )
        patches.append(part.start + patch)
        inner.append(first + np.searchsorted(patch, core))
        stands_for.append(np.full(len(core), len(p) / len(core)))
        first += len(patch)
    return patches, np.concatenate(inner), np.concatenate(stands_for)


def _seconds_per_ray(direct: DirectSolver, ids: NDArray[np.int64], asked: Bits) -> float:
    """Of rays that consensus asks for, with others of the same vertices around them."""
    rows, texels = list_bits(asked)
    vertices = ids[rows].astype(np.uint32)
    start = time.perf_counter()
    direct.visible(vertices, texels)
    return (time.perf_counter() - start) / max(len(rows), 1)


def _energy(direct: DirectSolver, ids: NDArray[np.int64], bits: Bits) -> NDArray[np.float64]:
    """Squared norms (n,) of unit-albedo direct light where bits (n, words) are set."""
    lighting, total = direct.lighting, np.zeros(len(ids))
    for a in range(0, len(ids), PATCH):
        part = slice(a, a + PATCH)
        seen = unpack(bits[part], lighting.n_directions)
        cosine = np.maximum(direct.points.normals[ids[part]] @ lighting.directions.T, 0)
        total[part] = ((cosine * lighting.solid_angles) ** 2 * seen).sum(axis=1, dtype=np.float64)
    return total
