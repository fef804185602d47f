"""Time against error: every method on one scene, against one converged reference and brute force at equal error."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from mi_sparse_prt.benchmark.brute_force import BruteForce, RowsTime
from mi_sparse_prt.benchmark.column_sampling import precompute_with_columns
from mi_sparse_prt.benchmark.converged_reference import MAX_DEPTH, SPP, Reference, ReferenceEffort
from mi_sparse_prt.benchmark.direct_speed import measure_direct
from mi_sparse_prt.benchmark.measuring import kept_memory, report_header
from mi_sparse_prt.benchmark.time_error_figure import time_error_figures
from mi_sparse_prt.core.errors import PrtError, PrtWarning
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.methods.plan import Plan
from mi_sparse_prt.precompute import precompute
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.transport import LightTransport
from mi_sparse_prt.validation.validate import save_figures

RAY_REPEATS = 3
WARM_UP = 4  # texels per edge of a face

LABELS = {
    "huang2010": "huang2010, as published",
    "clustered_columns": "clustered columns [HPB07], else huang2010",
    "k_means_columns": "k-means columns [WDT09], else huang2010",
    "sparse": "sparse: consensus + sparse path-traced indirect",
    "gather": "gather: exact direct + finite elements",
    "consensus_gather": "consensus + finite elements",
}

Run = Callable[..., LightTransport]  # of a scene and a lighting, with max_depth, spp and progress by name


@dataclass(frozen=True)
class TimeErrorEffort:
    """Which points a plot of time against error has, and how well the truth is known.

    Attributes
    ----------
    spp : int
        Paths per element of methods that trace them.
    brute_force_spps, adjoint_spps : tuple of int
        Of brute force and of rows by the adjoint solver, ascending.
    targets : tuple of float
        Relative L2 errors asked of ``method="auto"``.
    reference : ReferenceEffort
    """

    spp: int = SPP
    brute_force_spps: tuple[int, ...] = (1, 4, 16, 64)
    adjoint_spps: tuple[int, ...] = (2, 8, 32)
    targets: tuple[float, ...] = (0.05, 0.02, 0.01, 0.005)
    reference: ReferenceEffort = field(default_factory=ReferenceEffort)


FULL = TimeErrorEffort()


@kept_memory()
def time_against_error(
    scene: Scene,
    lighting: CubemapLighting,
    progress: bool = True,
    figures: Path | None = None,
    only: Sequence[str] | None = None,
    reference_spp: int | None = None,
    effort: TimeErrorEffort = FULL,
) -> dict[str, Any]:
    """Run every method on a scene: direct light and three interreflections.

    Parameters
    ----------
    scene : Scene
    lighting : CubemapLighting
    progress : bool
    figures : path, optional
        Folder for ``time_against_error.png``, all meshes together, and ``time_against_error_MESH.png`` for each; made
        if needed.
    only : sequence of str, optional
        Names of ``methods()`` to run, beside brute force and the adjoint solver; all if not given.
    reference_spp : int, optional
        Paths per element of each of the reference's two halves, those of ``effort`` (6144) if not given.
    effort : TimeErrorEffort, optional

    Returns
    -------
    dict
        JSON as it is. Errors, ``relative_l2``, are those of the whole matrix against a converged one, in ``total`` and
        for all ``meshes``, with their ``standard_error``.

        - ``bare_rays``: the occlusion rays of the whole matrix, ``rays``, and the ``seconds`` that a loop takes which
          traces them and does nothing else; ``direct_seconds``, our own direct light by all rays.
        - ``reference_noise``: relative L2 of the noise of the reference, ``total`` and ``meshes``.
        - ``brute_force``: a list, one entry per number of paths ``spp``: ``seconds`` of the whole matrix (direct light,
          and paths from timed wavefronts) and its ``seconds_standard_error``, ``relative_l2``. ``adjoint``: the same
          for rows by the adjoint solver. ``noise_of_one_path``: brute force has this error divided by sqrt(spp).
        - ``methods``: name -> ``label``, ``seconds`` (held-out elements included, compilation not), ``phases``,
          ``relative_l2``, ``estimated_error`` (its own, if it has one), ``elements`` (share of all),
          ``stored_bytes``, ``over_bare_rays`` (its time as a multiple of theirs), ``equal_error`` (see
          ``BruteForce.compared``), and ``without_held_out``: ``seconds``, ``over_bare_rays`` and ``speed_up`` if the
          time of its own estimate of its error does not count, which brute force here is without. Those of ``"auto"``
          have a ``target_error`` and the ``plan``.
        - ``skipped``: sentences about methods that refuse the scene.

    Raises
    ------
    PrtError
        If there is no method of a name in ``only``.
    """
    runs, known = _select(methods(effort.targets), only), effort.reference
    if reference_spp is not None:
        known = replace(known, element_spp=reference_spp)
    reference = Reference(scene, lighting, progress, known)
    rays, _ = measure_direct(scene, lighting, RAY_REPEATS)
    noise = reference.noise()
    direct_seconds = rays["seconds"]
    ways = {
        "brute_force": (effort.brute_force_spps, reference.time_paths, reference.relative_l2_of_paths),
        "adjoint": (effort.adjoint_spps, reference.time_adjoint, reference.relative_l2_of_adjoint),
    }
    points = {
        way: [_point(spp, seconds_at(spp), direct_seconds, error_at(spp)) for spp in spps]
        for way, (spps, seconds_at, error_at) in ways.items()
    }
    curve = _curve(points["brute_force"], direct_seconds)
    report: dict[str, Any] = {
        **report_header(scene, lighting),
        "parameters": {"max_depth": MAX_DEPTH, "spp": effort.spp},
        "bare_rays": {
            "rays": rays["rays"],
            "seconds": rays["bare_seconds"],
            "direct_seconds": direct_seconds,
        },
        "reference_noise": {name: noise[name] for name in ("total", "meshes")},
        **points,
        "noise_of_one_path": curve.noise,
        "methods": {},
        "skipped": [],
    }
    for name, outcome in run_methods(runs, scene, lighting, effort.spp, progress):
        if isinstance(outcome, PrtError):
            report["skipped"].append(f"{name}: {outcome}")
        else:
            report["methods"][name] = _measure(name, outcome, reference, curve, rays["bare_seconds"])
    if figures is not None:
        save_figures(figures, time_error_figures(report))
    return report


def methods(targets: Sequence[float] = FULL.targets) -> dict[str, Run]:
    """What is run, by name: everything but brute force and the adjoint solver, which are timed in parts."""
    return {
        "huang2010": partial(precompute, method="huang2010"),
        "clustered_columns": partial(precompute_with_columns, choice="clustered_columns"),
        "k_means_columns": partial(precompute_with_columns, choice="k_means_columns"),
        "sparse": partial(precompute, method="sparse"),
        "gather": partial(precompute, method="gather"),
        "consensus_gather": partial(precompute, method=Plan("consensus", "gather")),
        **{f"auto {target:g}": partial(precompute, target_error=target) for target in targets},
    }


def _select(known: dict[str, Run], only: Sequence[str] | None) -> dict[str, Run]:
    unknown = [name for name in only or () if name not in known]
    if unknown:
        raise PrtError(f"no method {unknown[0]!r} to time: choose from {', '.join(known)}")
    return known if only is None else {name: known[name] for name in only}


def run_methods(
    runs: Mapping[str, Run], scene: Scene, lighting: CubemapLighting, spp: int, progress: bool
) -> Iterator[tuple[str, LightTransport | PrtError]]:
    """The matrix of each method, or why it refuses this scene: the others can still be compared.

    Each is run before: what an installation compiles once is not the method's time. ``"auto"`` is made of the others,
    and may work hard for a target at any resolution.
    """
    for name, run in runs.items():
        try:
            with warnings.catch_warnings():  # targets that are missed: the report tells by how much
                warnings.simplefilter("ignore", PrtWarning)
                if name.startswith("auto"):  # how many paths an element gets is for the planner to say
                    transport = run(scene, lighting, max_depth=MAX_DEPTH, progress=progress)
                else:
                    coarse = CubemapLighting(min(WARM_UP, lighting.resolution))
                    run(scene, coarse, max_depth=MAX_DEPTH, spp=1, progress=False)
                    transport = run(scene, lighting, max_depth=MAX_DEPTH, spp=spp, progress=progress)
        except PrtError as error:
            yield name, error
        else:
            yield name, transport


def _point(spp: int, rows: RowsTime, direct_seconds: float, error: dict[str, Any]) -> dict[str, Any]:
    return {
        "spp": spp,
        "seconds": direct_seconds + rows.seconds,
        "seconds_standard_error": rows.standard_error,
        "relative_l2": error,
    }


def _curve(points: list[dict[str, Any]], direct_seconds: float) -> BruteForce:
    return BruteForce(
        direct_seconds,
        tuple(point["spp"] for point in points),
        tuple(point["seconds"] - direct_seconds for point in points),
        tuple(point["relative_l2"]["total"] for point in points),
        tuple(point["relative_l2"]["standard_error"]["total"] for point in points),
    )


def _measure(
    name: str, transport: LightTransport, reference: Reference, curve: BruteForce, bare_seconds: float
) -> dict[str, Any]:
    """Cost and errors of a method's matrix."""
    made, error = transport.report, reference.relative_l2(transport)
    seconds = made["seconds"]["total"]
    own = seconds - made["seconds"].get("held_out", 0.0)
    found = {
        "label": LABELS.get(name, name),
        "seconds": seconds,
        "phases": made["seconds"],
        "relative_l2": error,
        "estimated_error": made.get("estimated_error"),
        "elements": made["elements_evaluated"] / made["elements_total"],
        "stored_bytes": transport.nbytes,
        "over_bare_rays": seconds / bare_seconds,
        "equal_error": curve.compared(seconds, error["total"]),
        "without_held_out": {
            "seconds": own,
            "over_bare_rays": own / bare_seconds,
            "speed_up": curve.compared(own, error["total"])["speed_up"],
        },
    }
    if name.startswith("auto"):
        found["target_error"] = made["parameters"]["target_error"]
        found["plan"] = made["plan"]
    return found
