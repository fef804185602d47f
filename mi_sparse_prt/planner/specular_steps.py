"""How many rays specular light is worth, beside the errors of all other light."""

from __future__ import annotations

import math
import time
from dataclasses import replace

from mi_sparse_prt.core.bits import Bits
from mi_sparse_prt.estimation.held_out import HeldOutError
from mi_sparse_prt.methods.settings import Settings
from mi_sparse_prt.planner.choice import MARGIN
from mi_sparse_prt.planner.direct_costs import negligible_beside
from mi_sparse_prt.reconstruction.specular_noise import SpecularNoise
from mi_sparse_prt.reflection.sent_light import rows_among
from mi_sparse_prt.solvers.problem import Problem
from mi_sparse_prt.solvers.specular import SpecularLight, SpecularSearch
from mi_sparse_prt.solvers.specular_terms import term_rows

# What surfaces send on of specular light reaches a point from all that it sees, by 64 rays at least: their mean has an
# eighth of the noise, at most a quarter of what is aimed at. Noise has no low rank: twice as much of it took
# a kitchen's rank from 140 to 210, half of it to 100
AS_SOURCE = 2.0


class SpecularSteps:
    """Specular light of a matrix, in two steps: as a source of other light, and with as little noise as is worth it.

    Parameters
    ----------
    problem : Problem
        With light that is ``specular_apart``.
    settings : Settings
        Whose ``specular.error`` is aimed at, beside the errors of all other light; ``specular_error`` of this light
        alone is enough, if given: its noise is then no part of the error of all.
    seed : int
    others : float
        Error of all other light, as predicted: noise that does not matter beside it need not be found out.
    seconds : float
        As a source it may take half of these: what noise is left then is told.
    """

    def __init__(
        self, problem: Problem, settings: Settings, seed: int, others: float = 0.0, seconds: float = math.inf
    ) -> None:
        begin = time.perf_counter()
        end = begin + seconds / 2
        self._aim, self._target = settings.specular.error, settings.target_error
        self._own = settings.specular_error
        averaging = None
        if problem.scene.bends_light and problem.at_vertices is problem:
            averaging = SpecularNoise(problem, seed)
        self._search = SpecularSearch(
            problem, seed, settings.specular, averaging=averaging, seconds=seconds / 4
        )
        self._enough = self._search.refine(
            AS_SOURCE * max(self._aim, negligible_beside(others)), self._own or 0.0, end - time.perf_counter()
        )
        self._spent = time.perf_counter() - begin
        self._problem, every = problem, None if problem.sent is None else problem.sent.every
        has_terms = bool(every or problem.reflection.terms)
        self._terms = term_rows(problem, seed, self._search.passed, every) if has_terms else None

    @property
    def seen(self) -> Bits | None:
        """See ``SpecularLight``."""
        return self._search.seen

    @property
    def light(self) -> SpecularLight:
        """As far as it was found, with rows for terms."""
        sent, found = self._problem.sent, self.every
        return found if sent is None else found.take(rows_among(self._problem.reflection, sent.every))

    @property
    def every(self) -> SpecularLight:
        """The same, with rows for all terms that surfaces send to each other as well (``SentLight.every``)."""
        found = self._search.light()
        return found if self._terms is None else self._terms.after(found)

    @property
    def error(self) -> float:
        """What its noise will be if other light has smaller errors, as a part of the error of all.

        What takes too long as a source is not begun again.
        """
        if self._own:
            return 0.0
        return min(self._aim, self._search.error) if self._enough else self._search.error

    @property
    def most(self) -> bool:
        """Whether most of the light that arrives, by energy, has come by way of mirrors and glass."""
        return self._search.error**2 > 0.5 * self._search.noise**2

    @property
    def ended(self) -> bool:
        """Whether time ended the search, not how little noise there is."""
        return not self._enough

    @property
    def done(self) -> bool:
        """Whether there is no more noise than is aimed at, or enough, or as much as time does not take away."""
        return not self._enough or self._search.error <= self._aim or self._search.noise <= (self._own or 0.0)

    @property
    def remaining(self) -> float:
        """Seconds that more rays take, about, until there is as much noise as is aimed at: it falls as their root."""
        return 0.0 if self.done else self._spent * max((self._search.error / self._aim) ** 2 - 1, 0.0)

    def foreseen(self, found: HeldOutError) -> HeldOutError:
        """Errors of a matrix with this light, found now, as they will be with ``error``: those that a target is for."""
        now = found.parts.get("specular", 0.0)
        after = now * self.error / max(self._search.error, 1e-300)
        total = math.sqrt(max(found.total**2 - now**2 + after**2, 0.0))
        return replace(found, total=total, parts=found.parts | {"specular": after})

    def refine(self, found: HeldOutError, seconds: float = math.inf) -> None:
        """Take the noise away that matters beside errors that are known to stay, or to a target, in so many seconds.

        It may be as large as makes the error a tenth larger, or as the target leaves room for, or as is enough.
        """
        others = math.sqrt(max(found.total**2 - found.parts.get("specular", 0.0) ** 2, 0.0))
        room = math.sqrt(max((MARGIN * (self._target or 0.0)) ** 2 - others**2, 0.0))
        self._search.refine(max(self._aim, negligible_beside(others), room), self._own or 0.0, seconds)
