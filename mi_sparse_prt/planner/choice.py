"""Which plan to carry out: predictions of time and error from measured costs, and the cheapest that is good enough."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.special import ndtr, ndtri

from mi_sparse_prt.estimation.held_out import ROUND, HeldOutError
from mi_sparse_prt.methods.plan import DENSE, GATHER, Plan
from mi_sparse_prt.methods.settings import TARGET
from mi_sparse_prt.planner.direct_costs import MINIMUM_GAIN, DirectCost
from mi_sparse_prt.planner.path_costs import PathCosts
from mi_sparse_prt.planner.radiosity_costs import GatherCosts
from mi_sparse_prt.planner.sparse_costs import SparseCosts

MARGIN = 0.95  # of a target is aimed at by paths, whose number is free
SPREAD = 0.18  # root mean square of how far predicted errors are from those found, relative; of 71 scenes of the zoo
SAFE = 1.2  # by what factor a plan for after a miss is below the target: that miss tells how far off predictions are
WORST_FACTOR = 2.0  # by what factor predictions may be off where they are worst
STANDARD_ERROR = 0.07  # relative standard error of what a round of held-out elements finds; a typical one
ALIKE = 1.03  # times as long is as quick: predictions of time tell no more, and then the most exact is taken
FIRST_SHARE = (
    0.1  # of the time of the plan to choose: what takes no more, and may be good enough, is tried first
)

_NORMAL = ndtri((np.arange(32) + 0.5) / 32)  # as likely each
_OFF = 0.1  # of predictions are off by about WORST_FACTOR
_FACTORS = np.exp(np.linspace(-3, 3, 1201))  # of a predicted error, and how likely each is
_LIKELY = sum(
    share / spread * np.exp(-0.5 * (np.log(_FACTORS) / spread) ** 2)
    for share, spread in ((1 - _OFF, SPREAD), (_OFF, math.log(WORST_FACTOR)))
)


@dataclass(frozen=True)
class Costs:
    """What was measured.

    Attributes
    ----------
    fixed : float
        Seconds that every plan takes: for the pilot, and for held-out elements.
    check : float
        Seconds that all held-out elements take which judge whether the target is met; few of them do where there is
        no doubt, and these are in ``fixed``.
    direct : dict
        ``Plan.direct`` -> its cost.
    paths, gather, sparse : PathCosts, GatherCosts, SparseCosts or None
        None where there is no indirect light, or where it cannot be found so.
    direct_share : float
        Norm of direct light relative to that of the whole matrix.
    specular : float
        Relative error that light by way of mirrors and glass adds to every plan.
    bent : bool
        Whether most light comes by way of mirrors and glass, which a pilot leaves out: ranks are not known then.
    dark : bool
        Whether next to no light arrives: errors relative to it do not count.
    """

    fixed: float
    direct: dict[str, DirectCost]
    paths: PathCosts | None = None
    gather: GatherCosts | None = None
    sparse: SparseCosts | None = None
    direct_share: float = 1.0
    check: float = 0.0
    specular: float = 0.0
    bent: bool = False
    dark: bool = False

    def with_paths_of(self, path: float, finest: int) -> Costs:
        """The same, if a path for every element at the finest resolution takes so many seconds."""
        assert self.paths is not None
        sparse = None if self.sparse is None else replace(self.sparse, path=path)
        return replace(self, paths=self.paths.priced(path, finest), sparse=sparse)


@dataclass(frozen=True)
class Predicted:
    """A plan, its seconds in all, its relative L2 error, and the seconds to expect after it in case of a miss."""

    plan: Plan
    seconds: float
    error: float
    risk: float = 0.0

    def report(self, chosen: bool) -> dict[str, Any]:
        """As JSON has it."""
        return {
            **self.plan.report(),
            "predicted_seconds": self.seconds,
            "predicted_error": self.error,
            "chosen": chosen,
        }


class _Priced(NamedTuple):
    """A plan, the seconds of its direct and its indirect light, and its error."""

    plan: Plan
    direct: float
    indirect: float
    error: float


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
    plans = list(_plans(costs, target, spp))
    safe = [p for p in plans if p.error <= target / SAFE]
    found = []
    for p in plans:
        seconds = costs.fixed + p.direct + p.indirect + costs.check * ROUND * (_rounds(p.error, target) - 1)
        then = min(
            (q.indirect + (q.direct if q.plan.direct != p.plan.direct else 0.0) for q in safe), default=0.0
        )
        found.append(Predicted(p.plan, seconds, p.error, _miss(p.error, target) * then))
    return sorted(found, key=lambda p: p.seconds)


def _miss(error: float, target: float) -> float:
    """How likely a plan of this predicted error is to miss the target."""
    return float(ndtr(math.log(max(error, 1e-150) / target) / SPREAD))


def _rounds(error: float, target: float) -> float:
    """Of held-out elements, as many as tell whether a target is met: two standard errors apart. An expected value."""
    apart = np.abs(np.log(max(error, 1e-150) / target) + SPREAD * _NORMAL)
    return float(np.clip((2 * STANDARD_ERROR / np.maximum(apart, 1e-9)) ** 2, 1.0, 1 / ROUND).mean())


def _plans(costs: Costs, target: float, spp: int | None) -> Iterator[_Priced]:
    """All plans; what all have in common is left out."""
    for name, light in costs.direct.items():
        others = math.hypot(light.error, costs.specular)
        room = math.sqrt(max((MARGIN * target) ** 2 - others**2, 0.0))
        for plan, seconds, error in _indirect(costs, name, room, spp):
            yield _Priced(
                replace(plan, strata=light.strata), light.seconds, seconds, math.hypot(others, error)
            )
    if costs.sparse is not None:
        for share in DENSE:
            plan = Plan("sparse", "sparse", dense=share, spp=costs.sparse.spp)
            yield _Priced(plan, costs.sparse.seconds(share), 0.0, costs.sparse.error(share))


def choose(plans: list[Predicted], target: float | None) -> Predicted:
    """Of the plans that meet a target, the one that is expected to take the least time.

    If none does, it is the quickest of those that are about as exact as the most exact one: where errors have a floor,
    more rays buy next to nothing. A plan that may miss the target after all counts as if it took longer, by what would
    follow. Without a target, a plan that misses 2% by some factor counts as if it took the square of that longer, as
    more samples would: nobody asked for hours.
    """
    if target is None:
        return _quickest(plans, lambda p: _if_it_met(TARGET, p))
    good = [p for p in plans if p.error <= target]
    if good:
        return _quickest(good, lambda p: p.seconds + p.risk)
    least = min(p.error for p in plans)
    return min((p for p in plans if MINIMUM_GAIN * p.error <= least), key=lambda p: p.seconds)


def _quickest(plans: list[Predicted], cost: Callable[[Predicted], float]) -> Predicted:
    """The quickest, or the most exact that finds light in the same ways and takes about as long."""
    best = min(plans, key=cost)
    ways = best.plan.direct, best.plan.indirect
    same = (p for p in plans if (p.plan.direct, p.plan.indirect) == ways and cost(p) <= ALIKE * cost(best))
    return min(same, key=lambda p: (p.error, cost(p)))


def choose_first(plans: list[Predicted], target: float | None) -> Predicted:
    """The plan to begin with, which held-out elements will judge.

    It is that of ``choose``; but where one that nearly meets the target takes next to no time beside it, that one: it
    may turn out to be good enough. The less time, the farther off it may seem.
    """
    best = choose(plans, target)
    if target is None:
        return best
    spare = [(p, FIRST_SHARE * best.seconds / p.seconds) for p in plans]
    first = [p for p, factor in spare if factor >= 1 and p.error <= WORST_FACTOR * target * math.sqrt(factor)]
    return min(first, key=lambda p: _if_it_met(target, p)) if first else best


def _if_it_met(target: float, p: Predicted) -> float:
    """Seconds of a plan, had it as many more samples as the target takes."""
    return p.seconds * max(p.error / (MARGIN * target), 1.0) ** 2


def uncertain(costs: Costs, target: float | None, spp: int | None = None) -> str | None:
    """An approximation of direct light on whose error the choice depends: if it were twice as large, or half of it.

    Then its error is known. In half of the cases it was in vain, so it is to take no longer than it may save.
    """
    if costs.dark:
        return None
    for name in costs.direct:
        if name in ("exact", "adaptive"):
            continue
        chosen = [
            choose(predictions(_with_error_times(factor, costs, name), target or TARGET, spp), target)
            for factor in (1 / WORST_FACTOR, WORST_FACTOR)
        ]
        seconds = {plan.plan.direct: plan.seconds for plan in chosen}
        if len(seconds) > 1 and name in seconds:
            saved = max(seconds.values()) - seconds[name]
            if costs.direct[name].seconds <= saved:
                return name
    return None


def _with_error_times(factor: float, costs: Costs, name: str) -> Costs:
    light = costs.direct[name]
    return replace(costs, direct=costs.direct | {name: replace(light, error=factor * light.error)})


def finer(
    costs: Costs, missed: Predicted, error: float, target: float, spp: int | None = None
) -> list[Predicted]:
    """Plans that are more exact than one whose error was found to be above the target, the quickest first.

    Parameters
    ----------
    costs : Costs
        As ``learned`` after it.
    missed : Predicted
        Unless it gathered, other predictions are taken to be as far off as it was.
    error, target : float
    spp : int, optional
    """
    off = 1.0 if missed.plan.indirect == "gather" else error / max(missed.error, 1e-12)
    plans = [replace(p, error=off * p.error) for p in predictions(costs, target / off, spp)]
    return [p for p in plans if p.error < error and p.plan != missed.plan]


def weighed(found: HeldOutError, predicted: Predicted) -> HeldOutError:
    """What was found of a plan's error, together with what was predicted: each counts by how well it is known.

    A few held-out elements may hold most of the squared error: then it is as good as unknown, and a plan that meets
    the target is not given up for what two of them say. Where the two are far apart, the prediction is taken to be one
    of those that are off.
    """
    error = predicted.error * _FACTORS  # as it may be
    own = max(found.standard_error["total"], 1e-3 * found.total, 1e-150)
    chance = _LIKELY * np.exp(-0.5 * ((error - found.total) / own) ** 2)
    if not chance.sum() > 0:
        return found
    total = float(chance @ error / chance.sum())
    # direct light is known best, by whole rays
    part = "indirect" if "indirect" in found.parts else "direct"
    square = found.parts.get(part, 0.0) ** 2 + total**2 - found.total**2
    return replace(found, total=total, parts=found.parts | {part: math.sqrt(max(square, 0.0))})


def learned(costs: Costs, plan: Plan, found: HeldOutError) -> Costs:
    """Costs of what may follow a plan, its error being known; what was found once costs nothing again.

    Gathering is off by a bias, which the error of indirect light tells.
    """
    costs = replace(costs, fixed=(1 + ROUND) * costs.check)
    if costs.gather is None or plan.indirect != "gather":
        return costs
    gather = costs.gather.learned(plan, found.parts["indirect"])
    costs = with_direct(costs, plan.direct, found.parts["direct"])
    return replace(costs, gather=gather, specular=found.parts.get("specular", 0.0))


def with_direct(costs: Costs, name: str, error: float) -> Costs:
    """Costs after one kind of direct light was found, with this error, relative to the whole matrix.

    A pilot judges all kinds by the same elements: if these were harder than others, they were so for all.
    """
    expected = costs.direct[name].error
    off = error / expected if expected > 0 else 1.0
    others = {kind: replace(light, error=off * light.error) for kind, light in costs.direct.items()}
    return replace(costs, direct=others | {name: replace(costs.direct[name], seconds=0.0, error=error)})


def better(plans: list[Predicted], error: float, seconds: float) -> Predicted | None:
    """The quickest plan that is clearly more exact than an error, and takes no longer than some seconds."""
    good = [p for p in plans if p.error <= MINIMUM_GAIN * error and p.seconds <= seconds]
    return min(good, key=lambda p: p.seconds, default=None)


def _indirect(costs: Costs, direct: str, room: float, spp: int | None) -> Iterator[tuple[Plan, float, float]]:
    """Ways to find indirect light, with the seconds and the error that it adds; ``room`` is what it may add."""
    if costs.paths is None:
        yield Plan(direct, "none"), 0.0, 0.0
        return
    if costs.gather is not None:
        for rays, finest in GATHER:
            for tolerance in (finest,) if costs.bent else costs.gather.tolerances(rays, finest):
                for averaged in (True, False):
                    how = rays, tolerance, averaged
                    yield Plan(direct, "gather", *how), costs.gather.seconds(*how), costs.gather.error(*how)
    for resolution, seconds in costs.paths.seconds.items():
        samples = costs.paths.samples(resolution, room) if spp is None else spp
        plan = Plan(direct, "paths", resolution=resolution, spp=samples)
        yield plan, samples * seconds, costs.paths.error(resolution, samples)
