"""How well ``method="auto"`` chooses: its plan beside all others that may be as quick, each carried out."""

from __future__ import annotations

import warnings
from typing import Any

from mi_sparse_prt.benchmark.converged_reference import MAX_DEPTH
from mi_sparse_prt.benchmark.measuring import kept_memory, report_header
from mi_sparse_prt.core.errors import PrtWarning
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.methods.plan import Plan
from mi_sparse_prt.precompute import precompute
from mi_sparse_prt.scene.scene import Scene

TARGETS = (0.02, 0.01)
SLOWER = 1.5  # plans predicted to take up to so many times what the chosen one takes are carried out, too
FIXED = ("setup", "pilot", "plan", "held_out")  # phases that every plan has

Report = dict[str, Any]


@kept_memory()
def measure_plans(
    scene: Scene, lighting: CubemapLighting, progress: bool = True, targets: tuple[float, ...] = TARGETS
) -> Report:
    """Let ``"auto"`` choose for some target errors, and carry out whatever else it might have chosen.

    Parameters
    ----------
    scene : Scene
    lighting : CubemapLighting
    progress : bool
    targets : tuple of float
        Relative L2 errors.

    Returns
    -------
    dict
        JSON as it is.

        - ``targets``: an entry each. ``target_error``; ``seconds``, ``phases``, ``estimated_error`` and its
          ``standard_error`` of ``"auto"``, all attempts, its pilot and held-out elements included; ``met``: whether it
          says that the target is met; ``attempts``, and the last one's ``plan``. ``best``: the quickest plan carried
          out here whose error is within the target, None if there is none; ``choice``: how many times its time the
          chosen plan takes, and ``whole``: the same with all that ``"auto"`` does besides.
        - ``plans``: what was carried out, the quickest first. ``seconds``, without held-out elements; with these and
          the pilot, as ``"auto"`` takes them, ``seconds_in_all``, beside ``predicted_seconds``; ``estimated_error`` and
          its ``standard_error`` beside ``predicted_error``.
        - ``left_out``: how many plans were predicted to take over 1.5 times as long as those chosen.
    """
    made = [_auto(scene, lighting, target, progress) for target in targets]
    every = [(p, auto) for auto in made for p in auto["plans"]]
    # predictions differ from run to run: those count that a plan was chosen by
    found = {_plan(p): (p, auto) for p, auto in sorted(every, key=lambda pair: pair[0]["chosen"])}
    longest = SLOWER * max(p["predicted_seconds"] for p, _ in found.values() if p["chosen"])
    plans = [
        _carried_out(scene, lighting, plan, p, auto, progress)
        for plan, (p, auto) in found.items()
        if p["chosen"] or p["predicted_seconds"] <= longest
    ]
    plans.sort(key=lambda p: p["seconds"])
    return {
        **report_header(scene, lighting),
        "targets": [_against_best(target, auto, plans) for target, auto in zip(targets, made, strict=True)],
        "plans": plans,
        "left_out": len(found) - len(plans),
    }


def _auto(scene: Scene, lighting: CubemapLighting, target: float, progress: bool) -> Report:
    """The report of a matrix for a target error."""
    with warnings.catch_warnings():  # a target that is missed: the report tells
        warnings.simplefilter("ignore", PrtWarning)
        return precompute(scene, lighting, max_depth=MAX_DEPTH, target_error=target, progress=progress).report


def _plan(report: Report) -> Plan:
    return Plan(report["direct"], report["indirect"], **report["parameters"])


def _carried_out(
    scene: Scene, lighting: CubemapLighting, plan: Plan, predicted: Report, auto: Report, progress: bool
) -> Report:
    """Time and error of a plan by itself, beside what was predicted along with that ``auto``."""
    made = precompute(scene, lighting, plan, max_depth=MAX_DEPTH, progress=progress).report
    own = made["seconds"]["total"] - made["seconds"]["held_out"]
    error = made["estimated_error"]
    return {
        **plan.report(),
        "seconds": own,
        "seconds_in_all": own - made["seconds"]["setup"] + _fixed(auto),
        "predicted_seconds": predicted["predicted_seconds"],
        "estimated_error": error["total"],
        "standard_error": error["standard_error"]["total"],
        "predicted_error": predicted["predicted_error"],
    }


def _fixed(auto: Report) -> float:
    """Seconds that ``"auto"`` takes for one attempt, whatever the plan: the last estimate is the report's."""
    seconds = {name: auto["seconds"].get(name, 0.0) for name in FIXED}
    seconds["held_out"] *= 2 / (_attempts(auto) + 1)
    return sum(seconds.values())


def _attempts(auto: Report) -> int:
    return sum(p["chosen"] for p in auto["plans"])


def _against_best(target: float, auto: Report, plans: list[Report]) -> Report:
    """What ``"auto"`` made of a target, against the best of the plans."""
    error = auto["estimated_error"]
    total, deviation = error["total"], error["standard_error"]["total"]
    good = [p for p in plans if p["estimated_error"] <= target]
    best = min(good, key=lambda p: p["seconds"], default=None)
    own = next(p["seconds"] for p in plans if _plan(p) == _plan(auto["plan"]))
    return {
        "target_error": target,
        "seconds": auto["seconds"]["total"],
        "phases": auto["seconds"],
        "estimated_error": total,
        "standard_error": deviation,
        "met": total - 2 * deviation <= target,
        "attempts": _attempts(auto),
        "plan": auto["plan"],
        "best": best,
        "choice": best and own / best["seconds"],
        "whole": best and auto["seconds"]["total"] / best["seconds_in_all"],
    }
