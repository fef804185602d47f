"""What the parts of a precomputation cost in this scene, on this machine, tried on a few hundred vertices."""

from __future__ import annotations

import math
from dataclasses import replace

from mi_sparse_prt.estimation.darkness import DARK
from mi_sparse_prt.estimation.element_sampling import Effort
from mi_sparse_prt.estimation.held_out import ROUND
from mi_sparse_prt.estimation.pilot_elements import PilotElements, vertices_of_each
from mi_sparse_prt.methods.settings import TARGET, Settings
from mi_sparse_prt.planner.choice import MARGIN, Costs, choose, predictions
from mi_sparse_prt.planner.direct_costs import (
    adaptive_cost,
    consensus_cost,
    consensus_may_pay,
    edges_cost,
    exact_cost,
    negligible_beside,
)
from mi_sparse_prt.planner.path_costs import (
    COARSEST,
    coarse_resolutions,
    noise_of_a_path,
    path_costs,
    seconds_of_a_path,
)
from mi_sparse_prt.planner.radiosity_costs import gather_costs
from mi_sparse_prt.planner.sparse_costs import SparseCosts
from mi_sparse_prt.solvers.direct_rays import DirectSolver

VERTICES = 192  # of a pilot, in all meshes together
LEAST_VERTICES = 16  # of each
TEXELS = 16  # of each vertex, for indirect light
# for direct light: few of them are seen in part, and rays cost next to nothing
LIGHT_TEXELS = 256
LESS_NOISE = 0.3  # variance on a coarse cubemap, at the least, for as many samples per element
# times as long as in whole rows, at the most, paths of scattered elements take: 0.6 to 2.2 in eight scenes
SCATTERED = 3.0
DRAWN = 0.6e-6  # seconds per element of a check that is drawn for direct light


def measure(direct: DirectSolver, settings: Settings, indirect: bool) -> Costs:
    """Measure the costs of all plans that settings leave open.

    Parameters
    ----------
    direct : DirectSolver
        At all vertices.
    settings : Settings
        ``method`` is ``"auto"`` or ``"brute_force"``.
    indirect : bool
        Whether there is indirect light.

    Returns
    -------
    Costs
        ``fixed`` is that of held-out elements.
    """
    problem, scene = direct.problem, direct.problem.scene
    count = max(LEAST_VERTICES, vertices_of_each(scene, VERTICES))
    seed, lighting = settings.seed, direct.lighting
    held = PilotElements(problem, indirect, seed, count, TEXELS)
    rays = PilotElements(problem, False, seed, count, LIGHT_TEXELS)
    auto, exact = settings.method == "auto", exact_cost(direct, rays)
    light = {"exact": exact}
    if auto and settings.basis == "texel":
        light["edges"] = edges_cost(direct, rays)
    elif auto and consensus_may_pay(direct, exact):
        light["consensus"] = consensus_cost(direct, rays, seed)
    light = {how: cost.beside_indirect(held.direct_share) for how, cost in light.items()}
    check = _check(held)
    # light by way of mirrors and glass is not among the elements
    dark = not problem.specular_apart and held.light() <= DARK
    costs = Costs(check, light, direct_share=held.direct_share, dark=dark)
    if settings.target_error is not None:
        costs = replace(costs, fixed=(1 + ROUND) * check, check=check)
    if held.indirect is None:
        return _with_adaptive(costs, direct, rays, settings)
    path, noise = held.indirect.seconds * len(problem.points) * lighting.n_directions, noise_of_a_path(held)
    fine, asked = lighting.resolution, settings.indirect_resolution
    costs = replace(costs, paths=path_costs(problem, settings, held, path, [asked or fine]))
    if auto:
        costs = replace(costs, gather=gather_costs(direct, held, seed))
    if auto and settings.basis == "direction" and asked in (None, fine):
        sparse = SparseCosts(scene.n_vertices, exact.seconds, path, noise, settings.samples)
        costs = replace(costs, sparse=sparse)
    costs = _with_adaptive(costs, direct, rays, settings)
    least = path / SCATTERED
    if auto and _too_dear(costs.with_paths_of(least, fine), settings, least, noise):
        return costs
    path = seconds_of_a_path(problem, settings, lighting)
    costs = costs.with_paths_of(path, fine)
    if asked is None and not dark and not (auto and _too_dear(costs, settings, path, noise)):
        every = [*coarse_resolutions(fine), fine]
        costs = replace(costs, paths=path_costs(problem, settings, held, path, every))
    return costs


def _with_adaptive(costs: Costs, direct: DirectSolver, rays: PilotElements, settings: Settings) -> Costs:
    """Adaptive strata as well, where other direct light is not good enough.

    A floor below indirect light, where paths take too long, leaves nothing to gain from direct light that is clearly
    better than it.
    """
    if settings.method != "auto" or settings.basis == "direction":
        return costs
    target = MARGIN * (settings.target_error or TARGET)
    aim = target / math.sqrt(2)  # half of its square
    if costs.gather is not None and costs.paths is not None:
        floor = costs.gather.growth * costs.gather.bias
        paths = (
            costs.paths.samples(at, target)
            * each
            * (COARSEST / at) ** 2  # were the coarsest ones good enough
            for at, each in costs.paths.seconds.items()
        )
        if floor > target and min(paths) > settings.max_seconds:
            aim = max(aim, negligible_beside(floor))
    if min(cost.error for cost in costs.direct.values()) > aim:
        share = costs.direct_share
        adaptive = adaptive_cost(direct, rays, aim / max(share, 1e-30), settings.seed)
        costs = replace(costs, direct={**costs.direct, "adaptive": adaptive.beside_indirect(share)})
    return costs


def _too_dear(costs: Costs, settings: Settings, path: float, noise: float) -> bool:
    """Whether paths on a coarse cubemap, were they free of bias, would still take longer than gathering does."""
    target = MARGIN * (settings.target_error or TARGET)
    best = choose(predictions(costs, target / MARGIN, settings.spp), settings.target_error)
    samples = settings.spp or max(LESS_NOISE * (noise / target) ** 2, 1.0)
    least = samples * path * (COARSEST / settings.resolution) ** 2
    return best.plan.indirect == "gather" and best.error <= target and best.seconds - costs.fixed < least


def _check(held: PilotElements) -> float:
    """Seconds of a check by held-out elements."""
    meshes = held.problem.scene.meshes
    totals = [(mesh.vertices.stop - mesh.vertices.start) * held.lighting.n_directions for mesh in meshes]
    effort = Effort()
    drawn = DRAWN * sum(effort.rays_of(total, len(totals)) for total in totals)
    if held.indirect is None:
        return drawn
    paths = sum(effort.paths_of(total, len(totals)) for total in totals)
    return drawn + paths * effort.spp * held.indirect.seconds
