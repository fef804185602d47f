"""Time against error: every method on one scene, against one converged reference and brute force at equal error."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from mi_sparse_prt.benchmark.brute_force_time import RowsTime
from mi_sparse_prt.benchmark.column_methods import CHOICES, precompute_with_columns
from mi_sparse_prt.benchmark.converged_reference import MAX_DEPTH, SPP, Reference
from mi_sparse_prt.benchmark.direct_speed import measure_direct
from mi_sparse_prt.benchmark.equal_error import BruteForce
from mi_sparse_prt.benchmark.machine import kept_memory, report_header
from mi_sparse_prt.benchmark.time_error_figure import save_figures
from mi_sparse_prt.core.errors import PrtError, PrtWarning
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.methods.plan import Plan
from mi_sparse_prt.precompute import precompute
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.transport import LightTransport

SPPS = (1, 4, 16, 64)  # of brute force
ADJOINT_SPPS = (2, 8, 32)
TARGETS = (0.05, 0.02, 0.01, 0.005)  # of method="auto"
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

Run = Callable[[Scene, CubemapLighting, int, bool], LightTransport]  # the integer is spp


@kept_memory()
def time_against_error(
    scene: Scene,
    lighting: CubemapLighting,
    progress: bool = True,
    figures: Path | None = None,
    only: Sequence[str] | None = None,
    reference_spp: int | None = None,
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
        Paths per element of each of the reference's two halves, 6144 if not given.

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
    runs = _chosen(only)
    reference = Reference(scene, lighting, progress, reference_spp)
    rays, _ = measure_direct(scene, lighting, RAY_REPEATS)
    brute = [_all_paths(reference, spp, rays["seconds"]) for spp in SPPS]
    adjoint = [_all_rows(reference, spp, rays["seconds"]) for spp in ADJOINT_SPPS]
    curve = _curve(brute, rays["seconds"])
    report: dict[str, Any] = {
        **report_header(scene, lighting),
        "parameters": {"max_depth": MAX_DEPTH, "spp": SPP},
        "bare_rays": {
            "rays": rays["rays"],
            "seconds": rays["bare_seconds"],
            "direct_seconds": rays["seconds"],
        },
        "reference_noise": {"total": reference.total_noise(), "meshes": reference.noise()},
        "brute_force": brute,
        "noise_of_one_path": curve.noise,
        "adjoint": adjoint,
        "methods": {},
        "skipped": [],
    }
    for name, run in runs.items():
        try:
            transport = _after_warm_up(name, run, scene, lighting, progress)
        except PrtError as error:  # not for this scene: the others can still be compared
            report["skipped"].append(f"{name}: {error}")
            continue
        report["methods"][name] = _found(name, transport, reference, curve, rays["bare_seconds"])
    if figures is not None:
        save_figures(figures, report)
    return report


def methods() -> dict[str, Run]:
    """What is run, by name: everything but brute force and the adjoint solver, which are timed in parts."""
    return {
        "huang2010": partial(_by_name, "huang2010"),
        **{choice: partial(_by_columns, choice) for choice in CHOICES},
        "sparse": partial(_by_name, "sparse"),
        "gather": partial(_by_name, "gather"),
        "consensus_gather": partial(_by_name, Plan("consensus", "gather")),
        **{f"auto {target:g}": partial(_by_target, target) for target in TARGETS},
    }


def _by_name(
    method: str | Plan, scene: Scene, lighting: CubemapLighting, spp: int, progress: bool
) -> LightTransport:
    return precompute(scene, lighting, method, max_depth=MAX_DEPTH, spp=spp, progress=progress)


def _by_columns(
    choice: str, scene: Scene, lighting: CubemapLighting, spp: int, progress: bool
) -> LightTransport:
    return precompute_with_columns(scene, lighting, choice, MAX_DEPTH, spp, progress=progress)


def _by_target(
    target: float, scene: Scene, lighting: CubemapLighting, spp: int, progress: bool
) -> LightTransport:
    """How many paths an element gets is for the planner to say."""
    return precompute(scene, lighting, "auto", max_depth=MAX_DEPTH, target_error=target, progress=progress)


def _chosen(only: Sequence[str] | None) -> dict[str, Run]:
    known = methods()
    unknown = [name for name in only or () if name not in known]
    if unknown:
        raise PrtError(f"no method {unknown[0]!r} to time: choose from {', '.join(known)}")
    return known if only is None else {name: known[name] for name in only}


def _after_warm_up(
    name: str, run: Run, scene: Scene, lighting: CubemapLighting, progress: bool
) -> LightTransport:
    """The matrix of a method that was run before: what an installation compiles once is not the method's time.

    ``"auto"`` is made of the others, and may work hard for a target at any resolution.
    """
    with warnings.catch_warnings():  # targets that are missed: the report tells by how much
        warnings.simplefilter("ignore", PrtWarning)
        if not name.startswith("auto"):
            run(scene, CubemapLighting(min(WARM_UP, lighting.resolution)), 1, False)
        return run(scene, lighting, SPP, progress)


def _all_paths(reference: Reference, spp: int, direct_seconds: float) -> dict[str, Any]:
    """Brute force with so many paths per element."""
    return _point(spp, reference.time_paths(spp), direct_seconds, reference.relative_l2_of_paths(spp))


def _all_rows(reference: Reference, spp: int, direct_seconds: float) -> dict[str, Any]:
    """All rows by the adjoint solver, with so many samples of each."""
    return _point(spp, reference.time_adjoint(spp), direct_seconds, reference.relative_l2_of_adjoint(spp))


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


def _found(
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
