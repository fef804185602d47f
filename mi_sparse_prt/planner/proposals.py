"""Which plan comes first, and which one after a plan that missed the target error."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from mi_sparse_prt.planner.choice import TARGET, Costs, choose, choose_first, finer, predictions
from mi_sparse_prt.planner.plan import EFFORTS, Plan
from mi_sparse_prt.settings import Settings

ATTEMPTS = 4


class Ladder:
    """Plans in turn.

    Parameters
    ----------
    plans : sequence of Plan

    Attributes
    ----------
    plan : Plan
        The present one.
    seconds : float or None
        What it is predicted to take in all.
    """

    seconds: float | None = None

    def __init__(self, plans: Sequence[Plan]) -> None:
        self.plan, *self._others = plans

    def after(self, error: float) -> bool:
        """Go on to the next plan, the present one having this error; False if there is none."""
        if self._others:
            self.plan = self._others.pop(0)
            return True
        return False

    def report(self) -> list[dict[str, Any]]:
        """Plans that were compared."""
        return []


class Ranking:
    """Plans by what was measured; attributes and methods are those of ``Ladder``.

    Parameters
    ----------
    costs : Costs
    settings : Settings
    """

    def __init__(self, costs: Costs, settings: Settings) -> None:
        self._costs, self._settings = costs, settings
        self._plans = predictions(costs, settings.target_error or TARGET, settings.spp)
        # errors of paths are predicted too well for a trial to turn out better
        begin = choose_first if settings.method == "auto" else choose
        self._best = begin(self._plans, settings.target_error)
        self._tried = [self._best.plan]

    @property
    def plan(self) -> Plan:
        """The present one."""
        return self._best.plan

    @property
    def seconds(self) -> float:
        """What it is predicted to take in all."""
        return self._best.seconds

    def after(self, error: float) -> bool:
        """Go on to a finer plan, the present one having this error; False if there is none."""
        target = self._settings.target_error
        if target is None or len(self._tried) == ATTEMPTS:
            return False
        found = finer(self._costs, self._best, error, target, self._settings.spp)
        if found is None:
            return False
        self._best = found
        self._plans.append(found)
        self._tried.append(found.plan)
        return True

    def report(self) -> list[dict[str, Any]]:
        """Plans that were compared, the quickest first; those that were carried out are the chosen ones."""
        unique = {p.plan: p for p in self._plans}.values()
        return [p.report(p.plan in self._tried) for p in sorted(unique, key=lambda p: p.seconds)]


def ladder(settings: Settings) -> Ladder:
    """The plan of a method; with a target error, from the coarsest of its plans on."""
    assert settings.plan is not None
    if settings.target_error is None or isinstance(settings.method, Plan):
        return Ladder([settings.plan])
    return Ladder(EFFORTS.get(settings.method, (settings.plan,)))
