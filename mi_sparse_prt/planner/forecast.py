"""How long a matrix will take and how large it will be, said before it is begun."""

from __future__ import annotations

from typing import NamedTuple

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.methods.execution import indirect_solver
from mi_sparse_prt.methods.plan import Plan
from mi_sparse_prt.methods.settings import Settings
from mi_sparse_prt.planner.memory import free_bytes, peak_bytes
from mi_sparse_prt.planner.row_timing import seconds_per_row
from mi_sparse_prt.solvers.direct_rays import DirectSolver


class _Share(NamedTuple):
    """Seconds of direct rays and of paths that a part costs, relative to brute force."""

    rays: float
    paths: float


# as measured at 6144 directions on scenes of 40,000 and 64,000 vertices: right within a factor of two there
_DIRECT = {
    "exact": _Share(1, 0),
    "consensus": _Share(0.35, 0),
    "edges": _Share(0.5, 0),
    "adaptive": _Share(2.0, 0),
    "sparse": _Share(0.8, 0),
    "huang2010": _Share(2.7, 0),
}
_INDIRECT = {
    "none": _Share(0, 0),
    "paths": _Share(0, 1),
    "gather": _Share(0.55, 0),
    "sparse": _Share(0, 0.08),
    "huang2010": _Share(0, 0.12),
}


class Forecast(NamedTuple):
    """Seconds that a matrix takes, and bytes beside those that the process has, at their peak."""

    seconds: float
    bytes: float


def forecast(
    direct: DirectSolver, settings: Settings, plan: Plan, indirect: bool, seconds: float | None = None
) -> Forecast:
    """Predict what a matrix takes, and refuse what cannot fit into memory.

    Parameters
    ----------
    direct : DirectSolver
        At all vertices.
    settings : Settings
    plan : Plan
    indirect : bool
        Whether there is indirect light.
    seconds : float, optional
        What it will take, if a pilot has told. If not, a few random rows tell what brute force costs, without the
        held-out elements, and other plans get shares of that. Small scenes take some seconds more, and a target error
        as long as its attempts do.

    Raises
    ------
    PrtError
        If there is not enough memory.
    """
    light, more = _DIRECT[plan.direct], _INDIRECT[plan.indirect if indirect else "none"]
    paths = indirect_solver(direct.problem, settings.of(plan))
    needed, available = peak_bytes(direct, paths, plan, indirect), free_bytes()
    if needed > available:
        raise PrtError(
            f"the matrix needs {needed / 1e9:.1f} GB but {available / 1e9:.1f} GB are free; "
            "lower the resolution of the lighting or of the indirect light"
        )
    if seconds is None:
        row = (light.rays + more.rays) * seconds_per_row(direct)
        row += more.paths * seconds_per_row(paths) if more.paths else 0.0
        seconds = len(direct.points) * row
    return Forecast(seconds, float(needed))


def beside_direct_light(seconds: float, plan: Plan, indirect: bool) -> float:
    """Seconds of a matrix whose direct light takes so many, the rest in the same proportion as in ``forecast``."""
    light, more = _DIRECT[plan.direct], _INDIRECT[plan.indirect if indirect else "none"]
    return seconds * (light.rays + more.rays) / light.rays


def fits(direct: DirectSolver, settings: Settings, plan: Plan, indirect: bool) -> bool:
    """Whether there is memory for one more plan, beside what is known of those before; arguments as of ``forecast``."""
    paths = indirect_solver(direct.problem, settings.of(plan))
    return peak_bytes(direct, paths, plan, indirect) <= free_bytes()
