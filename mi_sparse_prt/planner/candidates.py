"""Which plan comes first, and which one after a plan that missed the target error."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from mi_sparse_prt.estimation.held_out import HeldOutError
from mi_sparse_prt.methods.plan import EFFORTS, Plan
from mi_sparse_prt.methods.settings import TARGET, Settings
from mi_sparse_prt.planner.choice import (
    MARGIN,
    Costs,
    Predicted,
    better,
    choose,
    choose_first,
    finer,
    learned,
    predictions,
    uncertain,
    weighed,
    with_direct,
)
from mi_sparse_prt.planner.direct_costs import MINIMUM_GAIN
from mi_sparse_prt.planner.texel_shares import HALF, TexelShares
from mi_sparse_prt.solvers.adaptive_strata import Strata
from mi_sparse_prt.solvers.direct_rays import DirectSolver

ATTEMPTS = 4
# of a target error, which edges may leave of direct light in a first attempt: 0.6 is left to the rest
FIRST_SHARE = 0.8
TIME_BUDGET = 20.0  # times what the first attempt was to take: what is to take longer is left to the user


class RefinementSchedule:
    """Plans in turn, as long as the next one can be clearly more exact, and takes sensible time.

    Parameters
    ----------
    plans : sequence of Plan
    limit : float
        Seconds, in all, that a next one is not to exceed.
    started : float
        Seconds before the first plan.
    shares : TexelShares, optional
        Chooses how direct light is found, of each plan when it is its turn.
    target : float, optional
        Relative L2 error: half of the rays of the next plan are enough where they are predicted to meet it.

    Attributes
    ----------
    plan : Plan
        The present one.
    seconds : float or None
        What it is predicted to take; where others came before, beside these.
    keeps_indirect : bool
        Whether indirect light of the attempt before is to be kept: the present plan finds direct light alone.
    too_long : None
        See ``CandidatePlans``.
    """

    seconds: float | None = None
    keeps_indirect: bool = False
    too_long: Predicted | None = None

    def __init__(
        self,
        plans: Sequence[Plan],
        limit: float = math.inf,
        started: float = 0.0,
        shares: TexelShares | None = None,
        target: float | None = None,
    ) -> None:
        first, *self._others = plans
        self._shares, self._aim = shares, MARGIN * (target or 0.0)
        self.plan = first if shares is None else shares.of(first, FIRST_SHARE)
        self._limit, self._started, self._error = limit, started, math.inf
        self._before: Plan | None = None

    def after(self, found: HeldOutError, elapsed: float, of_rays: float = math.inf) -> bool:
        """Go on to the next plan, the present one having this error after so many seconds; False if none is left.

        More rays make light more exact that is gathered, and no other; of that, what comes ``of_rays``, where it is
        known. Where finer direct light is predicted to be enough, indirect light stays as it is.
        """
        finer = self._with_finer_light(found, elapsed)
        self.keeps_indirect = finer is not None
        if finer is not None:
            self.plan, self._error = finer, math.inf  # what rays do is not known from that
            return True
        if not self._others:
            return False
        before = self.plan
        following = finest = self._with_shares(self._others[0])
        if before.indirect == following.indirect == "gather":
            half = replace(following, rays=following.rays // 2, tolerance=math.sqrt(2) * following.tolerance)
            if half.rays > before.rays and self._expected(half, found, of_rays) <= self._aim:
                following = half
            seconds = elapsed + following.rays / before.rays * (elapsed - self._started)
            left = self._expected(following, found, of_rays)
            if _light(before) == _light(following):  # they do no more than they did last time
                left = max(left, found.total / self._error * found.total, self._floor(found.total))
            if left > MINIMUM_GAIN * found.total or seconds > self._limit:
                return False
        if following is finest:
            self._others.pop(0)
        self._before = before
        self.plan, self._started, self._error = following, elapsed, found.total
        return True

    def _floor(self, error: float) -> float:
        """What any number of rays would leave of the present plan's error, as the one before it tells."""
        known = [] if self._before is None else [(self._before, self._error)]
        return error_without_noise([*known, (self.plan, error)])

    def _expected(self, following: Plan, found: HeldOutError, of_rays: float) -> float:
        """The least error that a plan of more rays may have, the present one having this one."""
        refinable = min(found.parts.get("indirect", 0.0), of_rays)
        square = found.total**2 - refinable**2 * (1 - self.plan.rays / following.rays)
        if _light(self.plan) != _light(following):  # finer direct light comes as near as the plan's tolerance
            square -= max(found.parts["direct"] ** 2 - following.tolerance**2, 0.0)
        return math.sqrt(max(square, 0.0))

    def direct_seconds(self) -> float | None:
        """What direct light of the present plan takes, if it can be measured at a few points."""
        if self._shares is None or self.plan.direct not in ("edges", "adaptive"):
            return None
        return self._shares.seconds(self.plan)

    def _with_finer_light(self, found: HeldOutError, elapsed: float) -> Plan | None:
        """The present plan with finer direct light, if that is enough for the target and there is time for it."""
        finer = self._with_shares(self.plan)
        if not self._aim or self._shares is None or _light(finer) == _light(self.plan):
            return None
        less = max(found.parts["direct"] ** 2 - (HALF * self._aim) ** 2, 0.0)
        enough = found.total**2 - less <= self._aim**2
        return finer if enough and elapsed + self._shares.seconds(finer) <= self._limit else None

    def _with_shares(self, plan: Plan) -> Plan:
        return plan if self._shares is None else self._shares.of(plan)

    def leave(self) -> None:
        """Do not carry out the present plan, after others; no report names it."""

    def weighed(self, found: HeldOutError) -> HeldOutError:
        """The error of the present plan: what was found, as nothing was predicted."""
        return found

    def report(self) -> list[dict[str, Any]]:
        """Plans that were compared."""
        return []


class CandidatePlans:
    """Plans by what was measured; attributes and methods of the same name are those of ``RefinementSchedule``.

    Parameters
    ----------
    costs : Costs
    settings : Settings

    Attributes
    ----------
    too_long : Predicted or None
        A plan that would meet the target after all, and would take very long.

    Notes
    -----
    Of ``"auto"``, plans that are predicted to take longer than ``max_seconds`` are not carried out; if all do, the
    quickest one is the present one. Where next to no light arrives, the quickest one is good enough.
    """

    keeps_indirect = False
    too_long: Predicted | None = None

    def __init__(self, costs: Costs, settings: Settings) -> None:
        self._settings = settings
        self._limit = settings.max_seconds if settings.method == "auto" else math.inf
        self._rank(costs)

    def _rank(self, costs: Costs) -> None:
        settings, target = self._settings, self._settings.target_error
        self._costs = costs
        # as many paths as without a target, where it is one of next to nothing
        spp = settings.samples if costs.dark else settings.spp
        self._plans = predictions(costs, target or TARGET, spp)
        # errors of paths are predicted too well for a first attempt to turn out better
        begin = choose_first if settings.method == "auto" else choose
        within = [p for p in self._plans if p.seconds <= self._limit] or self._plans[:1]
        self._best = within[0] if costs.dark else begin(within, target)
        self._tried, self._found = [self._best], list[tuple[Plan, float]]()
        wished, aim = choose(self._plans, target or TARGET), target or TARGET
        self.too_long = wished if wished.error <= aim < min(p.error for p in within) else None

    @property
    def plan(self) -> Plan:
        """The present one."""
        return self._best.plan

    @property
    def seconds(self) -> float:
        """What it is predicted to take, beside what came before it."""
        return self._best.seconds

    @property
    def error(self) -> float:
        """The relative L2 error that it is predicted to have."""
        return self._best.error

    @property
    def uncertain(self) -> str | None:
        """Direct light to find and to judge before anything else, as the choice depends on it."""
        return uncertain(self._costs, self._settings.target_error, self._settings.spp)

    def choose_again(self, direct: str, error: float) -> None:
        """Choose again, now that this direct light has been found and its error, relative to all of it, is known."""
        costs = self._costs
        fixed = costs.fixed + costs.direct[direct].seconds
        self._rank(replace(with_direct(costs, direct, costs.direct_share * error), fixed=fixed))

    def after(self, found: HeldOutError, elapsed: float, of_rays: float = math.inf) -> bool:
        """Go on to a finer plan, the present one having this error; False if there is none that takes sensible time.

        Where what would meet the target takes too long, or nothing would, the next one is at least clearly more exact,
        and the quickest of those. Where more rays did not help and would not, plans that differ by these alone are
        left out.

        Parameters
        ----------
        found : HeldOutError
        elapsed : float
            Seconds since the beginning: in all, ``max_seconds`` are not to be exceeded.
        of_rays : float
            Not asked for: the costs say what rays leave.
        """
        settings, target, error = self._settings, self._settings.target_error, found.total
        if target is None or len(self._tried) == ATTEMPTS:
            return False
        self._found.append((self._best.plan, error))
        self._costs = learned(self._costs, self._best.plan, found)
        plans = finer(self._costs, self._best, error, target, settings.spp)
        if error_without_noise(self._found) > target:
            plans = [p for p in plans if (p.plan.direct, p.plan.indirect) != _kind(self._best.plan)]
        budget = min(TIME_BUDGET * self._tried[0].seconds, self._limit - elapsed)
        next_one = choose(plans, target) if plans else None
        if next_one is not None and (next_one.seconds > budget or next_one.error > target):
            self.too_long = next_one if next_one.error <= target else None
            next_one = better(plans, error, budget)
        if next_one is None:
            return False
        self._best = next_one
        self._plans.append(next_one)
        self._tried.append(next_one)
        return True

    def direct_seconds(self) -> None:
        """Not asked for: all seconds are predicted."""

    def leave(self) -> None:
        """Do not carry out the present plan, after others."""
        self._best = self._tried[-2]
        self._tried.pop()

    def weighed(self, found: HeldOutError) -> HeldOutError:
        """The error of the present plan, as far as it is known: see ``choice.weighed``."""
        return weighed(found, self._best)

    def report(self) -> list[dict[str, Any]]:
        """Plans that were compared, the quickest first; those that were carried out are the chosen ones."""
        unique = {p.plan: p for p in self._plans}.values()
        tried = [p.plan for p in self._tried]
        return [p.report(p.plan in tried) for p in sorted(unique, key=lambda p: p.seconds)]


def _light(plan: Plan) -> tuple[str, Strata | None]:
    """How direct light is found."""
    return plan.direct, plan.strata


def _kind(plan: Plan) -> tuple[str, str]:
    return plan.direct, plan.indirect


def error_without_noise(found: Sequence[tuple[Plan, float]]) -> float:
    """What more rays would leave of the error of gathered light: from the last two plans of its kind; 0 of others.

    The square of noise is in inverse proportion to rays, and the rest remains.
    """
    (plan, error), alike = (
        found[-1],
        [other for other in found[:-1] if _kind(other[0]) == _kind(found[-1][0])],
    )
    if plan.indirect != "gather" or not alike or alike[-1][0].rays >= plan.rays:
        return 0.0
    before, its_error = alike[-1]
    rest = (plan.rays * error**2 - before.rays * its_error**2) / (plan.rays - before.rays)
    return math.sqrt(max(rest, 0.0))


def refinement_schedule(
    settings: Settings, started: float, direct: DirectSolver, specular: float = 0.0
) -> RefinementSchedule:
    """The plan of a method; with a target error, from the coarsest of its plans on, after so many seconds.

    ``specular`` is the error of light by way of mirrors and glass, as there will be.
    """
    shares = None if isinstance(settings.method, Plan) else TexelShares(direct, settings, started, specular)
    plans: Sequence[Plan]
    if settings.plan is None:  # "auto" with terms of glossy surfaces or at pixels, whose costs no pilot knows
        plans = [settings.with_shares(plan) for plan in EFFORTS["gather"]]
    elif settings.target_error is None or isinstance(settings.method, Plan):
        plans = [settings.plan]
    else:
        plans = [settings.with_shares(plan) for plan in EFFORTS.get(settings.method, (settings.plan,))]
    limit = settings.max_seconds if settings.method == "auto" else math.inf
    return RefinementSchedule(plans, limit, started, shares, settings.target_error)
