"""The pipeline: from a scene and a lighting basis to a light transport matrix with a report."""

from __future__ import annotations

import hashlib
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import psutil
from numpy.typing import NDArray
from tqdm.auto import tqdm

from mi_sparse_prt.checkpoint import Checkpoint
from mi_sparse_prt.cost import Stopwatch, peak_memory, reset_peak_memory, versions
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.emission.upsampling import upsampling
from mi_sparse_prt.errors import PrtError, PrtWarning
from mi_sparse_prt.matrix import Indirect, LightTransport, MeanCosine, MeshRange, Visibility
from mi_sparse_prt.measurement.vertices import Points, vertex_points
from mi_sparse_prt.methods.huang2010 import huang2010_parts
from mi_sparse_prt.methods.parts import Parts
from mi_sparse_prt.methods.sparse import sparse_parts
from mi_sparse_prt.planner import IndirectPlan, indirect_solver, plan_indirect
from mi_sparse_prt.scene import Scene
from mi_sparse_prt.settings import Settings
from mi_sparse_prt.transport.direct import DirectTransport
from mi_sparse_prt.transport.gather import GatherTransport
from mi_sparse_prt.transport.path import PathTransport
from mi_sparse_prt.validation.held_out import held_out_error

_DENSE_FRACTIONS = (0.05, 0.1, 0.2, 0.4, 0.8)  # of the vertices, tried in turn for a target error
_GATHER = (256, 0.03)  # rays per vertex, and what a low rank may cost of the first bounce
_FINER_GATHER = ((64, 0.06), (256, 0.03), (1024, 0.015), (4096, 0.008))  # tried in turn for a target error
_JUDGES = 1 << 20  # seeds of held-out elements that decide
_PILOT_RAYS = 32  # cosine-distributed rays per vertex that look for surfaces that light could bounce off
_PILOT_SHARE = 8  # a forecast traces this fraction of one wavefront


class _Share(NamedTuple):
    """What a method costs, relative to brute force: seconds of direct rays and of paths, bytes of the two parts."""

    rays: float
    paths: float
    direct_bytes: float
    indirect_bytes: float


_SHARES = {
    "brute_force": _Share(1, 1, 1, 1),
    "sparse": _Share(0.8, 0.08, 1, 0.06),
    "huang2010": _Share(2.7, 0.12, 0.22, 0.07),
    "gather": _Share(3, 0, 1, 0.05),
}


def precompute(
    scene: Scene,
    lighting: CubemapLighting,
    method: str = "brute_force",
    basis: str = "direction",
    max_depth: int = 5,
    spp: int = 16,
    target_error: float | None = None,
    seed: int = 0,
    progress: bool = True,
    *,
    indirect_resolution: int | None = None,
    strata: int = 2,
    checkpoint_folder: str | Path | None = None,
) -> LightTransport:
    """Compute the light transport matrix of a scene.

    Parameters
    ----------
    scene : Scene
    lighting : CubemapLighting
        The emission space: one column per texel.
    method : {"brute_force", "sparse", "huang2010", "gather"}
        Evaluate every element; few of them (``methods.sparse``); few as [HR10] does (``methods.huang2010``); or all
        direct ones, and interreflections by finite elements (``transport.gather``, diffuse scenes only).
    basis : {"direction", "texel"}
        Whether a texel's light arrives from its centre alone or from its whole area.
    max_depth : int
        As Mitsuba's ``path``: 2 = direct light only, 5 = three interreflections, -1 = until Russian roulette ends it.
    spp : int
        Paths per indirect element.
    target_error : float, optional
        Relative L2 error of the whole matrix to aim at. For brute force, a pilot on a few vertices then chooses the
        cheapest ``indirect_resolution`` and ``spp`` (see ``planner``), in place of those given. ``"sparse"`` starts
        with 5% of the vertices dense and doubles them until held-out elements meet it, ``"gather"`` with 64 rays per
        vertex, then four times as many; the report counts all that was evaluated on the way. A warning says if the
        held-out error shows that the target was missed.
    seed : int
        Same seed, same matrix, whatever the block size, the thread count or the order of vertices.
    progress : bool
        Show a forecast of time (of the sparse methods: within a factor of two) and memory, and progress bars (in
        terminals and notebooks).
    indirect_resolution : int, optional
        Resolution of the cubemap on which indirect light is computed; a power of two, at most that of ``lighting``
        (the default). Each coarse element is the mean over its texel and is interpolated; the held-out error in the
        report includes what that costs.
    strata : int
        Texel basis: shadow rays per element are strata^2.
    checkpoint_folder : path, optional
        Finished rows of the indirect light are kept there until the matrix is complete: the same call after an
        interruption goes on where it stopped (``"huang2010"``: with the dense rows only).

    Returns
    -------
    LightTransport
        With ``report``: ``seconds`` per phase (``compile`` apart, see ``cost.Stopwatch``), ``elements_total``,
        ``elements_evaluated``, ``rays``, ``estimated_error``, ``skipped``, ``forecast`` (``seconds``, ``bytes``),
        ``peak_memory_bytes``, ``seed``, ``parameters``, ``versions``.

    Raises
    ------
    PrtError
        If an argument makes no sense, or the matrix or what a method needs for it would not fit into memory.
    """
    settings = Settings(
        lighting.resolution, method, basis, max_depth, spp, target_error, seed, indirect_resolution, strata
    )
    reset_peak_memory()
    clock = Stopwatch()
    with clock.phase("setup"):
        points = vertex_points(scene)
        direct = DirectTransport(scene.normalised, lighting, points, basis, strata, seed)
    settings, plans = _planned(scene, lighting, settings, clock)
    indirect, skipped = _indirect_if_any(scene, settings, clock)
    forecast = _forecast(direct, indirect, settings.method, clock, progress)
    checkpoint = _checkpoint_path(checkpoint_folder, scene, points, settings)
    compute = {"brute_force": _brute_force, "gather": _gather}.get(settings.method, _sparse)
    parts = compute(direct, indirect, scene, settings, clock, progress, checkpoint)
    transport = _matrix(scene, points, lighting, basis, parts)
    with clock.phase("held_out"):
        error = _held_out_error(scene, transport, settings)
    _warn_if_missed(error, settings.target_error)
    transport.report.update(
        _evaluated(parts, points, lighting, skipped)
        | {"estimated_error": error}
        | _costs(transport, clock, forecast)
        | _inputs(scene, settings, plans)
    )
    return transport


def _matrix(
    scene: Scene, points: Points, lighting: CubemapLighting, basis: str, parts: Parts
) -> LightTransport:
    """The matrix of evaluated parts, without a report."""
    return LightTransport(
        lighting=lighting,
        basis=basis,
        albedo=scene.albedo,
        direct=parts.direct,
        indirect=parts.indirect,
        meshes=tuple(MeshRange(mesh.name, mesh.vertices) for mesh in scene.meshes),
        vertex_keys=points.keys,
        scene_hash=scene.hash,
    )


def _sparse(
    direct: DirectTransport,
    indirect: PathTransport | None,
    scene: Scene,
    settings: Settings,
    clock: Stopwatch,
    progress: bool,
    checkpoint: Path | None,
) -> Parts:
    """Evaluate few elements: with a target error, twice as many dense vertices each time until it is met."""
    if settings.method == "huang2010":
        return huang2010_parts(scene, direct, indirect, settings.seed, clock, progress, checkpoint)

    def attempt(fraction: float | None) -> Parts:
        return sparse_parts(scene, direct, indirect, settings.seed, clock, progress, checkpoint, fraction)

    return _refined(attempt, _DENSE_FRACTIONS, direct, scene, settings, clock)


def _gather(
    direct: DirectTransport,
    indirect: PathTransport | None,
    scene: Scene,
    settings: Settings,
    clock: Stopwatch,
    progress: bool,
    checkpoint: Path | None,
) -> Parts:
    """All direct light, and interreflections by finite elements: with a target error, finer ones until it is met."""
    exact = _brute_force(direct, None, scene, settings, clock, progress, None)
    if indirect is None:
        return exact

    def attempt(effort: tuple[int, float] | None) -> Parts:
        rays, tolerance = effort or _GATHER
        with clock.phase("gather_rays"):
            solver = GatherTransport(
                scene, direct.lighting, direct.points, rays, settings.max_depth, settings.seed
            )
        with clock.phase("interreflection"):
            part = solver.indirect(exact.direct, tolerance)
        skipped = [
            f"interreflections after {part.bounces}: next to no light",
            f"singular values of the first bounce below {part.left_out:.1%} of its energy's root",
        ]
        return replace(exact, indirect=part, rays={"gather": len(direct.points) * rays}, skipped=skipped)

    parts = _refined(attempt, _FINER_GATHER, direct, scene, settings, clock)
    return replace(
        parts,
        elements_evaluated=exact.elements_evaluated,
        elements=exact.elements,
        rays=exact.rays | parts.rays,
    )


def _refined(
    attempt: Callable[[Any], Parts],
    efforts: Sequence[Any],
    direct: DirectTransport,
    scene: Scene,
    settings: Settings,
    clock: Stopwatch,
) -> Parts:
    """The first of some attempts that meets the target error, or the last; where there is no target, the default one.

    Each attempt is judged by held-out elements of its own; those of the report decide nothing.
    """
    if settings.target_error is None:
        return attempt(None)
    attempts: list[Parts] = []
    for number, effort in enumerate(efforts):
        attempts.append(attempt(effort))
        transport = _matrix(scene, direct.points, direct.lighting, settings.basis, attempts[-1])
        with clock.phase("held_out"):
            judge = replace(settings, seed=settings.seed + _JUDGES + number)
            error = _held_out_error(scene, transport, judge)["total"]
        if error <= settings.target_error:
            break
    return _with_costs_of(attempts)


def _with_costs_of(attempts: list[Parts]) -> Parts:
    """The last attempt, with what all of them evaluated; repeated elements count again."""
    return replace(
        attempts[-1],
        elements_evaluated=sum(parts.elements_evaluated for parts in attempts),
        elements={name: sum(parts.elements[name] for parts in attempts) for name in attempts[-1].elements},
        rays={name: sum(parts.rays[name] for parts in attempts) for name in attempts[-1].rays},
    )


def _planned(
    scene: Scene, lighting: CubemapLighting, settings: Settings, clock: Stopwatch
) -> tuple[Settings, list[IndirectPlan]]:
    """Settings with the resolution and samples of the indirect light that a target error needs."""
    if settings.target_error is None or settings.method != "brute_force" or _no_indirect(scene, settings):
        return settings, []
    with clock.phase("plan"):
        plans = plan_indirect(scene, lighting, settings)
    return replace(settings, spp=plans[0].spp, indirect_resolution=plans[0].resolution), plans


def _no_indirect(scene: Scene, settings: Settings) -> str | None:
    """Why there is no indirect light for sure, or None."""
    if settings.max_depth == 2:
        return "max_depth 2 asks for direct light only"
    if scene.diffuse and not scene.albedo.any():
        return "every surface is black"
    return None


def _indirect_if_any(
    scene: Scene, settings: Settings, clock: Stopwatch
) -> tuple[PathTransport | None, list[str]]:
    """The solver for indirect light if any can arrive, and what is skipped."""
    reason = _no_indirect(scene, settings)
    if reason is None:
        with clock.phase("pilot"):
            solver = indirect_solver(scene, settings)
            surfaces_meet = solver.any_hit(_PILOT_RAYS)
        if surfaces_meet:
            grey = ["two of three channels of the indirect light: every surface is grey"]
            return solver, grey if scene.grey else []
        reason = "no surface sees another one"
    return None, [f"indirect light: {reason}"]


def _brute_force(
    direct: DirectTransport,
    indirect: PathTransport | None,
    scene: Scene,
    settings: Settings,
    clock: Stopwatch,
    progress: bool,
    checkpoint: Path | None,
) -> Parts:
    """Evaluate every element."""
    n, lighting = len(direct.points), direct.lighting
    elements = n * lighting.n_directions
    above = _share_above_horizon(direct.points, lighting)
    rays = {"direct": int(above * elements) * direct.rays_per_element}
    if indirect:
        rays["indirect_paths"] = n * indirect.lighting.n_directions * indirect.spp
    return Parts(
        _direct_part(direct, scene, clock, progress),
        _indirect_part(indirect, lighting, clock, progress, checkpoint) if indirect else None,
        elements,
        {"direct": elements, "indirect": n * indirect.lighting.n_directions if indirect else 0},
        rays,
    )


def _direct_part(
    solver: DirectTransport, scene: Scene, clock: Stopwatch, progress: bool
) -> Visibility | MeanCosine:
    with clock.phase("direct"):
        stored = solver.row_storage(len(solver.points))
        _trace(solver, stored, solver.rows, "direct", progress)
    if solver.basis == "direction":
        return Visibility(stored.astype(np.uint32, copy=False), scene.normals, solver.lighting)
    return MeanCosine(stored.astype(np.uint16, copy=False), solver.lighting)


def _indirect_part(
    solver: PathTransport,
    lighting: CubemapLighting,
    clock: Stopwatch,
    progress: bool,
    checkpoint: Path | None,
) -> Indirect:
    with clock.phase("indirect"):
        shape = (len(solver.points), solver.lighting.n_directions, solver.channels)
        density = np.zeros(shape, dtype=np.float16)
        kept = Checkpoint(checkpoint, density) if checkpoint else None
        _trace(solver, density, lambda ids: solver.rows(ids).mean, "indirect", progress, kept)
    return Indirect(density, upsampling(solver.lighting, lighting), lighting)


def _trace(
    solver: DirectTransport | PathTransport,
    stored: NDArray[Any],
    rows: Callable[[NDArray[np.uint32]], NDArray[Any]],
    name: str,
    progress: bool,
    kept: Checkpoint | None = None,
) -> None:
    """Fill an array with all rows of a solver, one wavefront at a time."""
    first = kept.rows_done if kept else 0
    with tqdm(total=len(stored), initial=first, desc=name, unit=" rows", disable=not progress) as bar:
        for a in range(first, len(stored), solver.block_size):
            ids = np.arange(a, min(a + solver.block_size, len(stored)), dtype=np.uint32)
            stored[a : a + len(ids)] = rows(ids)
            if kept:
                kept.append(stored[a : a + len(ids)])
            bar.update(len(ids))
    if kept:
        kept.remove()


def _checkpoint_path(
    folder: str | Path | None, scene: Scene, points: Points, settings: Settings
) -> Path | None:
    """A file name that stands for all that the rows of the indirect light, and their order, depend on."""
    if folder is None:
        return None
    state = hashlib.sha256(f"{scene.hash} {settings}".encode() + points.keys.tobytes())
    return Path(folder) / f"{state.hexdigest()[:32]}.rows"


def _held_out_error(scene: Scene, transport: LightTransport, settings: Settings) -> dict[str, Any]:
    """The matrix's error from held-out elements."""
    return held_out_error(scene, transport, settings.max_depth, settings.seed)


def _warn_if_missed(error: dict[str, Any], target: float | None) -> None:
    if target is not None and error["total"] - 2 * error["standard_error"]["total"] > target:
        warnings.warn(
            f"the target error {target:g} was not met: the estimate is {error['total']:.3g}",
            PrtWarning,
            stacklevel=3,
        )


def _forecast(
    direct: DirectTransport, indirect: PathTransport | None, method: str, clock: Stopwatch, progress: bool
) -> dict[str, float]:
    """Predict seconds (without the held-out elements) and bytes of the matrix, and refuse what cannot fit into memory.

    A few random rows tell what brute force costs; it is right but for what their choice and other programs change.
    The other methods get shares of that, as measured at 6144 directions on scenes of 40,000 and 64,000 vertices: right
    within a factor of two there. Small scenes take some seconds more, and a target error as long as its attempts do.
    """
    n, n_directions, share = len(direct.points), direct.lighting.n_directions, _SHARES[method]
    needed = share.direct_bytes * n * direct.row_storage(1).nbytes
    if indirect:
        needed += share.indirect_bytes * n * 2 * indirect.lighting.n_directions * indirect.channels
    available = psutil.virtual_memory().available
    if needed > available:
        raise PrtError(
            f"the matrix needs {needed / 1e9:.1f} GB but {available / 1e9:.1f} GB are free; "
            "lower the resolution of the lighting or of the indirect light"
        )
    with clock.phase("pilot"):
        seconds = n * share.rays * _seconds_per_row(direct)
        if indirect and share.paths:
            seconds += n * share.paths * _seconds_per_row(indirect)
    if progress:
        tqdm.write(
            f"{n} vertices x {n_directions} directions: about {seconds:.0f} s and {needed / 1e6:.0f} MB"
        )
    return {"seconds": seconds, "bytes": float(needed)}


def _seconds_per_row(solver: DirectTransport | PathTransport) -> float:
    """Time a few random rows, the second time: the first time, their kernel may have to be compiled."""
    n = len(solver.points)
    count = min(n, max(1, solver.block_size // _PILOT_SHARE))
    ids = np.sort(np.random.default_rng(0).choice(n, count, replace=False)).astype(np.uint32)
    solver.rows(ids)
    start = time.perf_counter()
    solver.rows(ids)
    return (time.perf_counter() - start) / count


def _costs(transport: LightTransport, clock: Stopwatch, forecast: dict[str, float]) -> dict[str, Any]:
    """Time and memory until now, for the report."""
    return {
        "seconds": clock.report(),
        "stored_bytes": transport.nbytes,
        "peak_memory_bytes": peak_memory(),
        "forecast": forecast,
    }


def _inputs(scene: Scene, settings: Settings, plans: list[IndirectPlan]) -> dict[str, Any]:
    """What the matrix was made from, for the report."""
    return {
        "plans": [plan.report() for plan in plans],
        "seed": settings.seed,
        "parameters": asdict(replace(settings, indirect_resolution=settings.coarse.resolution)),
        "scene": {
            "path": scene.path,
            "hash": scene.hash,
            "vertices": len(scene.positions),
            "warnings": scene.warnings,
        },
        "versions": versions(),
    }


def _evaluated(parts: Parts, points: Points, lighting: CubemapLighting, skipped: list[str]) -> dict[str, Any]:
    """What was evaluated and what was not, for the report."""
    above = _share_above_horizon(points, lighting)
    return {
        "elements_total": len(points) * lighting.n_directions,
        "elements_evaluated": parts.elements_evaluated,
        "elements": parts.elements,
        "rays": parts.rays,
        "sampling": parts.sampling,
        "skipped": [
            *skipped,
            *parts.skipped,
            f"direct rays below the horizon: {1 - above:.0%} of the elements",
        ],
    }


def _share_above_horizon(points: Points, lighting: CubemapLighting) -> float:
    """Share of elements above the horizon, from a thousand vertices."""
    some = points.normals[:: max(1, len(points) // 1000)]
    return float((some @ lighting.directions.T > 0).mean())
