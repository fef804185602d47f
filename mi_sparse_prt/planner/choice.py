"""Which plan to carry out: predictions of time and error from measured costs, and the cheapest that is good enough."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

from mi_sparse_prt.planner.direct_costs import DirectCost
from mi_sparse_prt.planner.gather_costs import GatherCosts
from mi_sparse_prt.planner.path_costs import PathCosts
from mi_sparse_prt.planner.plan import DENSE, GATHER, Plan
from mi_sparse_prt.planner.sparse_costs import SparseCosts

TARGET = 0.02  # where none is given
MARGIN = 0.95  # of a target is aimed at: predictions are off at times
DOUBT = 2.0  # by what factor they may be off
CLOSE = 1.2  # to a target, by what factor: few held-out elements do not tell then whether it is met
WORTHWHILE = 0.9  # of an error is better
TRIAL = 0.1  # of the time of the plan to choose: what takes no more, and may be good enough, is tried first


@dataclass(frozen=True)
class Costs:
    """What was measured.

    Attributes
    ----------
    fixed : float
        Seconds that every plan takes: for the pilot, and for held-out elements.
    check : float
        Seconds that all held-out elements take once more where few of them leave in doubt whether the target is met.
    direct : dict
        ``Plan.direct`` -> its cost.
    paths, gather, sparse : PathCosts, GatherCosts, SparseCosts or None
        None where there is no indirect light, or where it cannot be found so.
    direct_share : float
        Norm of direct light relative to that of the whole matrix.
    """

    fixed: float
    direct: dict[str, DirectCost]
    paths: PathCosts | None = None
    gather: GatherCosts | None = None
    sparse: SparseCosts | None = None
    direct_share: float = 1.0
    check: float = 0.0


@dataclass(frozen=True)
class Predicted:
    """A plan, its seconds in all, and its relative L2 error."""

    plan: Plan
    seconds: float
    error: float

    def report(self, chosen: bool) -> dict[str, Any]:
        """As JSON has it."""
        return {
            **self.plan.report(),
            "predicted_seconds": self.seconds,
            "predicted_error": self.error,
            "chosen": chosen,
        }


def predictions(costs: Costs, target: float, spp: int | None = None) -> list[Predicted]:
    """All plans, the quickest first.

    Parameters
    ----------
    costs : Costs
    target : float
        Relative L2 error of the whole matrix: plans by paths get as many samples as it takes.
    spp : int, optional
        Paths per element instead.
    """
    return sorted(
        (
            Predicted(plan, costs.fixed + seconds + (costs.check if _close(error, target) else 0.0), error)
            for plan, seconds, error in _plans(costs, target, spp)
        ),
        key=lambda p: p.seconds,
    )


def _close(error: float, target: float) -> bool:
    return target / CLOSE < error < target * CLOSE


def _plans(costs: Costs, target: float, spp: int | None) -> Iterator[tuple[Plan, float, float]]:
    """All plans, with the seconds and the error of each; what all have in common is left out."""
    for name, light in costs.direct.items():
        room = math.sqrt(max((MARGIN * target) ** 2 - light.error**2, 0.0))
        for plan, seconds, error in _indirect(costs, name, room, spp):
            yield plan, light.seconds + seconds, math.hypot(light.error, error)
    if costs.sparse is not None:
        for share in DENSE:
            plan = Plan("sparse", "sparse", dense=share, spp=costs.sparse.spp)
            yield plan, costs.sparse.seconds(share), costs.sparse.error(share)


def choose(plans: list[Predicted], target: float | None) -> Predicted:
    """The quickest of the plans that meet a target, or the most exact if none does.

    Without a target, a plan that misses 2% by some factor counts as if it took the square of that longer, as more
    samples would: nobody asked for hours.
    """
    if target is None:
        return min(plans, key=lambda p: _if_it_met(TARGET, p))
    good = [p for p in plans if p.error <= MARGIN * target * (1 + 1e-9)]
    return min(good, key=lambda p: p.seconds) if good else min(plans, key=lambda p: p.error)


def choose_first(plans: list[Predicted], target: float | None) -> Predicted:
    """The plan to begin with, which held-out elements will judge.

    It is that of ``choose``; but where one that nearly meets the target takes next to no time beside it, that one: it
    may turn out to be good enough. The less time, the farther off it may seem.
    """
    best = choose(plans, target)
    if target is None:
        return best
    spare = [(p, TRIAL * best.seconds / p.seconds) for p in plans]
    trials = [p for p, factor in spare if factor >= 1 and p.error <= DOUBT * target * math.sqrt(factor)]
    return min(trials, key=lambda p: _if_it_met(target, p)) if trials else best


def _if_it_met(target: float, p: Predicted) -> float:
    """Seconds of a plan, had it as many more samples as the target takes."""
    return p.seconds * max(p.error / (MARGIN * target), 1.0) ** 2


def uncertain(costs: Costs, target: float | None, spp: int | None = None) -> str | None:
    """An approximation of direct light on whose error the choice depends: if it were twice as large, or half of it.

    It costs little to find beside all rays, and then its error is known.
    """
    for name in costs.direct:
        if name == "exact":
            continue
        choices = {
            choose(
                predictions(_with_error_times(factor, costs, name), target or TARGET, spp), target
            ).plan.direct
            for factor in (1 / DOUBT, DOUBT)
        }
        if name in choices and len(choices) > 1:
            return name
    return None


def _with_error_times(factor: float, costs: Costs, name: str) -> Costs:
    light = costs.direct[name]
    return replace(costs, direct=costs.direct | {name: replace(light, error=factor * light.error)})


def finer(
    costs: Costs, missed: Predicted, error: float, target: float, spp: int | None = None
) -> list[Predicted]:
    """Plans that are more exact than one whose error was found to be above the target, the quickest first.

    Gathering is off by a bias, which the error tells; other predictions are taken to be all as far off. Errors are
    those to expect now.
    """
    if missed.plan.indirect == "gather":
        plans = predictions(learned(costs, missed.plan, error), target, spp)
    else:
        off = error / max(missed.error, 1e-12)
        plans = [replace(p, error=off * p.error) for p in predictions(costs, target / off, spp)]
    return [p for p in plans if p.error < error and p.plan != missed.plan]


def learned(costs: Costs, plan: Plan, error: float) -> Costs:
    """Costs, after the error of a plan was found; only of gathering there is something to learn."""
    if costs.gather is None or plan.indirect != "gather":
        return costs
    indirect = math.sqrt(max(error**2 - costs.direct[plan.direct].error ** 2, 0.0))
    return replace(costs, gather=costs.gather.learned(plan.rays, plan.tolerance, indirect))


def better(plans: list[Predicted], error: float, seconds: float) -> Predicted | None:
    """The quickest plan that is clearly more exact than an error, and takes no longer than some seconds."""
    good = [p for p in plans if p.error <= WORTHWHILE * error and p.seconds <= seconds]
    return min(good, key=lambda p: p.seconds, default=None)


def _indirect(costs: Costs, direct: str, room: float, spp: int | None) -> Iterator[tuple[Plan, float, float]]:
    """Ways to find indirect light, with the seconds and the error that it adds; ``room`` is what it may add."""
    if costs.paths is None:
        yield Plan(direct, "none"), 0.0, 0.0
        return
    if costs.gather is not None:
        for rays, finest in GATHER:
            for tolerance in costs.gather.tolerances(rays, finest):
                cost = costs.gather.seconds(rays, tolerance), costs.gather.error(rays, tolerance)
                yield Plan(direct, "gather", rays, tolerance), *cost
    for resolution, seconds in costs.paths.seconds.items():
        samples = costs.paths.samples(resolution, room) if spp is None else spp
        plan = Plan(direct, "paths", resolution=resolution, spp=samples)
        yield plan, samples * seconds, costs.paths.error(resolution, samples)
