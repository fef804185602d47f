"""How direct light of texels is found where no plan is predicted: along edges of visibility, or by adaptive strata."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from functools import cached_property

from mi_sparse_prt.estimation.pilot_elements import PilotElements, vertices_of_each
from mi_sparse_prt.estimation.term_pilot import TermPilot
from mi_sparse_prt.methods.plan import Plan
from mi_sparse_prt.methods.settings import Settings
from mi_sparse_prt.planner.choice import MARGIN
from mi_sparse_prt.planner.direct_costs import (
    MINIMUM_GAIN,
    DirectCost,
    adaptive_cost,
    edges_error,
    negligible_beside,
)
from mi_sparse_prt.reflection.in_out_factors import InOutFactors
from mi_sparse_prt.solvers.direct_rays import DirectSolver

POINTS = 1024  # of a pilot, all together
TEXELS = 64  # of each
HALF = math.sqrt(0.5)  # of a target error, whose square is half of its own


class TexelShares:
    """Chooses for plans of finite elements, so that direct light is no farther off than the first bounce, or a target.

    Shares of texels along edges of visibility are quick, but miss what is narrower than texels: under slats and leaves
    a tenth of the light. Their error is found at some of the points.

    Strata that would take more than half of what is left of ``max_seconds`` are left.

    Parameters
    ----------
    direct : DirectSolver
        In the texel basis.
    settings : Settings
    elapsed : float
        Seconds since the beginning.
    others : float
        Error of light that is known already: what does not matter beside it is left as well.
    """

    def __init__(
        self, direct: DirectSolver, settings: Settings, elapsed: float = 0.0, others: float = 0.0
    ) -> None:
        self._direct, self._settings = direct, settings
        self._seconds, self._least = settings.max_seconds - elapsed, negligible_beside(others)
        self._costs: dict[float, DirectCost] = {}  # by what was aimed at

    def of(self, plan: Plan, share: float = HALF) -> Plan:
        """The plan, with adaptive strata if edges miss what a target has room for, or its tolerance, and these do less.

        Clearly less: lobes that change within texels have errors that no strata take away.

        Parameters
        ----------
        plan : Plan
        share : float
            Of the target error, which edges may have; strata take as many rays as half of its square needs.
        """
        settings = self._settings
        target = settings.target_error
        enough, aim = (
            max(plan.tolerance if target is None else MARGIN * part * target, self._least)
            for part in (share, HALF)
        )
        if plan.direct != "edges" or plan.indirect != "gather" or self._of_edges <= enough:
            return plan
        if aim not in self._costs:
            self._costs[aim] = adaptive_cost(self._direct, self._held, aim, settings.seed)
        cost = self._costs[aim]
        better = cost.error <= MINIMUM_GAIN * self._of_edges and cost.seconds < self._seconds / 2
        return replace(plan, direct="adaptive", strata=cost.strata) if better else plan

    def seconds(self, plan: Plan) -> float:
        """What direct light of a plan takes, measured at some of the points."""
        if plan.direct == "adaptive":
            return min(cost.seconds for cost in self._costs.values() if cost.strata == plan.strata)
        _ = self._of_edges  # compiles
        start = time.perf_counter()
        edges_error(self._direct, self._held)
        each = (time.perf_counter() - start) / len(self._held.vertices)
        return each * len(self._direct.points)

    @cached_property
    def _held(self) -> PilotElements:
        problem = self._direct.problem
        at_vertices = problem.measurement.kind == "vertices"
        count = vertices_of_each(problem.scene, POINTS) if at_vertices else POINTS
        if isinstance(problem.reflection, InOutFactors):
            return TermPilot(problem, self._settings.seed, count, TEXELS)
        return PilotElements(problem, False, self._settings.seed, count, TEXELS)

    @cached_property
    def _of_edges(self) -> float:
        """Their error, relative to direct light; of glossy surfaces, in what these make of it."""
        return edges_error(self._direct, self._held)
