"""The pipeline: from a scene and a lighting basis to a light transport matrix with a report."""

from __future__ import annotations

import platform
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import psutil
from numpy.typing import NDArray
from tqdm.auto import tqdm

from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.emission.upsampling import upsampling
from mi_sparse_prt.errors import PrtError, PrtWarning
from mi_sparse_prt.matrix import Indirect, LightTransport, MeanCosine, MeshRange, Visibility
from mi_sparse_prt.measurement.vertices import vertex_points
from mi_sparse_prt.planner import IndirectPlan, plan_indirect
from mi_sparse_prt.scene import Scene
from mi_sparse_prt.transport.direct import DirectTransport
from mi_sparse_prt.transport.path import PathTransport
from mi_sparse_prt.validation.held_out import HeldOut

METHODS = ("brute_force",)
_PILOT_RAYS = 32  # cosine-distributed rays per vertex that look for surfaces that light could bounce off
_PILOT_SHARE = 8  # a forecast traces this fraction of one wavefront


@dataclass(frozen=True)
class Settings:
    """Checked arguments of ``precompute``; what the matrix depends on besides the scene and the lighting."""

    method: str
    basis: str
    max_depth: int
    spp: int
    strata: int
    indirect_resolution: int
    seed: int


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
) -> LightTransport:
    """Compute the light transport matrix of a scene.

    Parameters
    ----------
    scene : Scene
    lighting : CubemapLighting
        The emission space: one column per texel.
    method : {"brute_force"}
        Every element is evaluated.
    basis : {"direction", "texel"}
        Whether a texel's light arrives from its centre alone or from its whole area.
    max_depth : int
        As Mitsuba's ``path``: 2 = direct light only, 5 = three interreflections, -1 = until Russian roulette ends it.
    spp : int
        Paths per indirect element.
    target_error : float, optional
        Relative L2 error of the whole matrix to aim at. A pilot on a few vertices then chooses the cheapest
        ``indirect_resolution`` and ``spp`` (see ``planner``), in place of those given; a warning says if the
        held-out error shows that the target was missed.
    seed : int
        Same seed, same matrix, whatever the block size, the thread count or the order of vertices.
    progress : bool
        Show a forecast of time and memory, and progress bars (in terminals and notebooks).
    indirect_resolution : int, optional
        Resolution of the cubemap on which indirect light is computed; a power of two, at most that of ``lighting``
        (the default). Each coarse element is the mean over its texel and is interpolated; the held-out error in the
        report includes what that costs.
    strata : int
        Texel basis: shadow rays per element are strata^2.

    Returns
    -------
    LightTransport
        With ``report``: ``seconds`` per phase (``compile`` apart), ``elements_total``, ``elements_evaluated``,
        ``rays``, ``estimated_error``, ``skipped``, ``peak_memory_bytes``, ``seed``, ``parameters``, ``versions``.

    Raises
    ------
    PrtError
        If an argument makes no sense, or the matrix would not fit into memory.
    """
    settings = checked_settings(
        lighting,
        method=method,
        basis=basis,
        max_depth=max_depth,
        spp=spp,
        target_error=target_error,
        seed=seed,
        indirect_resolution=indirect_resolution,
        strata=strata,
    )
    _reset_peak_memory()
    clock = Stopwatch()
    points = vertex_points(scene)
    plans: list[IndirectPlan] = []
    if target_error is not None and _may_be_indirect(scene, settings) is None:
        with clock.phase("plan"):
            plans = plan_indirect(
                scene, lighting, basis, max_depth, settings.strata, settings.seed, target_error
            )
        settings = replace(settings, spp=plans[0].spp, indirect_resolution=plans[0].resolution)
    direct = DirectTransport(scene.normalised, lighting, points, basis, settings.strata, settings.seed)
    indirect, skipped = _indirect_solver(scene, lighting, settings)
    if indirect:
        with clock.phase("pilot"):
            surfaces_meet = indirect.any_hit(_PILOT_RAYS)
        if not surfaces_meet:
            indirect, skipped = None, ["indirect light: no surface sees another one"]
    forecast = _forecast(direct, indirect, clock, progress)

    with clock.phase("direct"):
        stored = _trace(
            direct, direct.row_storage(len(points)), lambda ids: direct.rows(ids), "direct", progress
        )
    transport = LightTransport(
        lighting=lighting,
        basis=basis,
        albedo=scene.albedo,
        direct=Visibility(stored, scene.normals, lighting)
        if basis == "direction"
        else MeanCosine(stored, lighting),
        indirect=_indirect_part(indirect, lighting, clock, progress) if indirect else None,
        meshes=tuple(MeshRange(mesh.name, mesh.vertices) for mesh in scene.meshes),
        vertex_keys=points.keys,
        scene_hash=scene.hash,
    )
    with clock.phase("held_out"):
        held = HeldOut(scene, lighting, basis, max_depth, indirect is not None, settings.seed)
        elements = np.take_along_axis(transport.rows(held.vertices), held.texels[..., None], axis=1)
        error = held.error(elements)
    if target_error is not None and error["total"] - 2 * error["standard_error"]["total"] > target_error:
        warnings.warn(
            f"the target error {target_error:g} was not met: the estimate is {error['total']:.3g}",
            PrtWarning,
            stacklevel=2,
        )

    above = _share_above_horizon(scene.normals, lighting)
    skipped.append(f"direct rays below the horizon: {1 - above:.0%} of the elements")
    rays = {"direct": int(above * len(points) * lighting.n_directions) * direct.rays_per_element}
    if indirect:
        rays["indirect_paths"] = len(points) * indirect.lighting.n_directions * indirect.spp
    transport.report.update(
        {
            "seconds": clock.report(),
            "elements_total": len(points) * lighting.n_directions,
            "elements_evaluated": len(points) * lighting.n_directions,
            "rays": rays,
            "estimated_error": error,
            "target_error": target_error,
            "plans": [plan.report() for plan in plans],
            "skipped": skipped,
            "stored_bytes": transport.nbytes,
            "peak_memory_bytes": _peak_memory(),
            "forecast": forecast,
            "seed": settings.seed,
            "parameters": {"resolution": lighting.resolution, **asdict(settings)},
            "scene": {
                "path": scene.path,
                "hash": scene.hash,
                "vertices": len(points),
                "warnings": scene.warnings,
            },
            "versions": _versions(),
        }
    )
    return transport


def checked_settings(
    lighting: CubemapLighting,
    *,
    method: str = "brute_force",
    basis: str = "direction",
    max_depth: int = 5,
    spp: int = 16,
    target_error: float | None = None,
    seed: int = 0,
    indirect_resolution: int | None = None,
    strata: int = 2,
) -> Settings:
    """Check the arguments of ``precompute`` (see there for the meaning and the errors)."""
    if method not in METHODS:
        raise PrtError(f"unknown method {method!r}; choose one of: {', '.join(METHODS)}")
    if basis not in ("direction", "texel"):
        raise PrtError(f"unknown basis {basis!r}; choose 'direction' or 'texel'")
    if max_depth < 2 and max_depth != -1:
        raise PrtError(f"max_depth is {max_depth}; 2 is direct light only, -1 is no limit")
    if target_error is not None and not target_error > 0:
        raise PrtError(f"target_error is {target_error}; it must be positive, 0.02 for 2%")
    for name, value in (("spp", spp), ("strata", strata)):
        if value < 1 or value != int(value):
            raise PrtError(f"{name} is {value}; it must be a whole number of at least 1")
    coarse = CubemapLighting(lighting.resolution if indirect_resolution is None else indirect_resolution)
    if coarse.resolution > lighting.resolution:
        raise PrtError(
            f"indirect_resolution {coarse.resolution} is finer than the lighting's; use at most {lighting.resolution}"
        )
    return Settings(method, basis, int(max_depth), int(spp), int(strata), coarse.resolution, int(seed))


class Stopwatch:
    """Seconds of named phases; what belongs to none is ``other``, so that they add up to the total."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._start = time.perf_counter()

    @contextmanager
    def phase(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.add(name, time.perf_counter() - start)

    def add(self, name: str, seconds: float) -> None:
        self.seconds[name] = self.seconds.get(name, 0.0) + seconds

    def report(self) -> dict[str, float]:
        """Phases, ``total`` (their sum), and apart from these ``compile``."""
        elapsed = time.perf_counter() - self._start
        phases = {**self.seconds, "other": elapsed - sum(self.seconds.values())}
        compiling = phases.pop("compile", 0.0)
        return {**phases, "total": elapsed - compiling, "compile": compiling}


def _may_be_indirect(scene: Scene, settings: Settings) -> str | None:
    """Why there is no indirect light for sure, or None."""
    if settings.max_depth == 2:
        return "max_depth 2 asks for direct light only"
    if scene.diffuse and not scene.albedo.any():
        return "every surface is black"
    return None


def _indirect_solver(
    scene: Scene, lighting: CubemapLighting, settings: Settings
) -> tuple[PathTransport | None, list[str]]:
    """The solver for indirect light if any can arrive, and what is skipped."""
    reason = _may_be_indirect(scene, settings)
    if reason:
        return None, [f"indirect light: {reason}"]
    solver = PathTransport(
        scene.normalised,
        CubemapLighting(settings.indirect_resolution),
        vertex_points(scene),
        # a coarse element stands for all directions in its texel
        settings.basis if settings.indirect_resolution == lighting.resolution else "texel",
        settings.max_depth,
        settings.spp,
        1 if scene.grey else 3,
        settings.seed,
    )
    return solver, [
        "two of three channels of the indirect light: every surface is grey"
    ] if scene.grey else []


def _indirect_part(
    solver: PathTransport, lighting: CubemapLighting, clock: Stopwatch, progress: bool
) -> Indirect:
    n = len(solver.points)
    with clock.phase("indirect"):
        density = _trace(
            solver,
            np.zeros((n, solver.lighting.n_directions, solver.channels), dtype=np.float16),
            lambda ids: solver.rows(ids).mean,
            "indirect",
            progress,
        )
    return Indirect(density, upsampling(solver.lighting, lighting), lighting)


def _trace(
    solver: DirectTransport | PathTransport, stored: NDArray[Any], rows: Any, name: str, progress: bool
) -> NDArray[Any]:
    """Fill an array with all rows of a solver, one wavefront at a time."""
    with tqdm(total=len(stored), desc=name, unit=" rows", disable=not progress) as bar:
        for a in range(0, len(stored), solver.block_size):
            ids = np.arange(a, min(a + solver.block_size, len(stored)), dtype=np.uint32)
            stored[a : a + len(ids)] = rows(ids)
            bar.update(len(ids))
    return stored


def _forecast(
    direct: DirectTransport, indirect: PathTransport | None, clock: Stopwatch, progress: bool
) -> dict[str, float]:
    """Predict bytes and seconds from a few random rows, and refuse what cannot fit into memory."""
    n, n_directions = len(direct.points), direct.lighting.n_directions
    row = direct.row_storage(1).nbytes
    if indirect:
        row += 2 * indirect.lighting.n_directions * indirect.channels
    available = psutil.virtual_memory().available
    if n * row > available:
        raise PrtError(
            f"the matrix needs {n * row / 1e9:.1f} GB but {available / 1e9:.1f} GB are free; "
            "lower the resolution of the lighting or of the indirect light"
        )
    solvers: list[DirectTransport | PathTransport] = [direct, indirect] if indirect else [direct]
    seconds = n * sum(_seconds_per_row(solver, clock) for solver in solvers)
    if progress:
        tqdm.write(
            f"{n} vertices x {n_directions} directions: about {seconds:.0f} s and {n * row / 1e6:.0f} MB"
        )
    return {"seconds": seconds, "bytes": float(n * row)}


def _seconds_per_row(solver: DirectTransport | PathTransport, clock: Stopwatch) -> float:
    """Time a few random rows twice: the first time, their kernel may have to be compiled."""
    n = len(solver.points)
    count = min(n, max(1, solver.block_size // _PILOT_SHARE))
    ids = np.sort(np.random.default_rng(0).choice(n, count, replace=False)).astype(np.uint32)
    start = time.perf_counter()
    solver.rows(ids)
    middle = time.perf_counter()
    solver.rows(ids)
    second = time.perf_counter() - middle
    clock.add("compile", max(0.0, middle - start - second))
    clock.add("pilot", second + min(second, middle - start))
    return second / count


def _share_above_horizon(normals: NDArray[np.float32], lighting: CubemapLighting) -> float:
    """Share of all elements whose texel centre is above the vertex's horizon, from up to 1000 vertices."""
    some = normals[:: max(1, len(normals) // 1000)]
    return float((some @ lighting.directions.T > 0).mean())


def _reset_peak_memory() -> None:
    """Let the kernel forget the peak so far; where it cannot (not Linux), the report has that of the process."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        pass


def _peak_memory() -> int:
    """Peak resident bytes of the process."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) * 1024
    return 0


def _versions() -> dict[str, str]:
    names = ("mi-sparse-prt", "mitsuba", "drjit", "numpy")
    return {name: version(name) for name in names} | {
        "python": platform.python_version(),
        "variant": mi.variant(),
    }
