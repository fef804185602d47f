"""The pipeline: from a scene and a lighting basis to a light transport matrix with a report."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, TypedDict, Unpack

import numpy as np
from tqdm.auto import tqdm

from mi_sparse_prt.core.errors import PrtError, PrtWarning
from mi_sparse_prt.core.profiling import Stopwatch, peak_memory, reset_peak_memory, versions
from mi_sparse_prt.core.random_keys import random_stream
from mi_sparse_prt.core.run import Run
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.emission.space import SampledEmission
from mi_sparse_prt.emission.unit_lamps import UnitLamps
from mi_sparse_prt.estimation.darkness import DARK
from mi_sparse_prt.estimation.held_out import HeldOutError, held_out_error
from mi_sparse_prt.estimation.held_out_lamps import held_out_lamp_error
from mi_sparse_prt.measurement.measurement import Measurement, mesh_vertices
from mi_sparse_prt.methods.brute_force import share_above_horizon
from mi_sparse_prt.methods.execution import Execution, indirect_solver, matrix_of
from mi_sparse_prt.methods.lamps import gathered_lamps, path_traced_lamps
from mi_sparse_prt.methods.plan import EFFORTS, Plan
from mi_sparse_prt.methods.result import MethodResult
from mi_sparse_prt.methods.settings import AUTO_TERMS, TARGET, Settings
from mi_sparse_prt.planner.candidates import CandidatePlans, RefinementSchedule, refinement_schedule
from mi_sparse_prt.planner.choice import WORST_FACTOR, Costs, Predicted
from mi_sparse_prt.planner.forecast import Forecast, beside_direct_light, fits, forecast
from mi_sparse_prt.planner.memory import terms_fit
from mi_sparse_prt.planner.pilot import measure
from mi_sparse_prt.planner.specular_steps import SpecularSteps
from mi_sparse_prt.reconstruction.senders import choose_senders
from mi_sparse_prt.reflection.reflection import Diffuse
from mi_sparse_prt.reflection.surfaces import ChosenReflection, chosen_reflection, vertex_reflection
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.problem import Problem, told_apart
from mi_sparse_prt.solvers.refined_mean import ENOUGH
from mi_sparse_prt.solvers.specular import SpecularLight
from mi_sparse_prt.transport import LightTransport

FACTOR_SHARE = 0.5  # of the target error, which the factors of BRDFs may have; a quarter of its square
DECISION = 5  # spawn key of held-out elements that decide something
_PILOT_RAYS = 32  # cosine-distributed rays per vertex that look for surfaces that light could bounce off


def precompute(
    scene: Scene,
    lighting: CubemapLighting | SampledEmission,
    method: str | Plan = "auto",
    basis: str = "direction",
    max_depth: int = 5,
    spp: int | None = None,
    target_error: float | None = None,
    seed: int = 0,
    progress: bool = True,
    *,
    indirect_resolution: int | None = None,
    strata: int = 2,
    checkpoint_folder: str | Path | None = None,
    measurement: Measurement | None = None,
    terms: int | str = 0,
    harmonics: int | None = None,
    max_seconds: float = 300.0,
    specular_error: float | None = None,
) -> LightTransport:
    """Compute the light transport matrix of a scene.

    Parameters
    ----------
    scene : Scene
    lighting : CubemapLighting, SceneEmitters, or another ``emission.space.SampledEmission``
        The emission space: one column per texel, or per lamp. Of lamps, ``method`` is ``"gather"`` (diffuse scenes, the
        default there) or ``"brute_force"`` (64 paths per element or as many photons, or ``spp``, or fewer if there
        are many lamps and vertices; more where they spread).
    method : {"auto", "brute_force", "sparse", "huang2010", "gather"} or Plan
        What is evaluated, and how. ``"auto"`` measures on a few hundred vertices what rays, paths and gathering cost
        in this scene on this machine, predicts time and error of all plans, and takes the quickest that meets the
        target error (``planner``). The others evaluate every element; few of them (``methods.sparse``); few as [HR10]
        does (``methods.huang2010``); or all direct ones, and interreflections by finite elements
        (``solvers.radiosity``, diffuse scenes only).
    basis : {"direction", "texel"}
        Whether a texel's light arrives from its centre alone or from its whole area.
    max_depth : int
        As Mitsuba's ``path``: 2 = direct light only, 5 = three interreflections, -1 = until Russian roulette ends it.
    spp : int, optional
        Paths per indirect element, where there are any: 16, or as many as a target error needs. If given, ``"auto"``
        does not choose another number.
    target_error : float, optional
        Relative L2 error of the whole matrix to aim at. ``"auto"`` aims at 2% if none is given. With a target,
        held-out elements judge the matrix, and a finer plan follows where it missed: of ``"auto"``, the next by its
        predictions; of ``"sparse"``, that starts with 5% of the vertices dense, twice as many; of ``"gather"``, that
        starts with 64 rays per vertex, four times as many. The report counts all that was evaluated on the way. For
        ``"brute_force"`` the pilot chooses the cheapest ``indirect_resolution`` and ``spp``, in place of those given.
        Lamps whose indirect light has little noise by fewer paths than ``spp`` have fewer. A warning says if the
        held-out error shows that the target was missed.
    seed : int
        Same seed, same matrix, whatever the block size, the thread count or the order of vertices. What ``"auto"``
        chooses depends on measured times as well.
    progress : bool
        Show a forecast of time (of methods by name: within a factor of two) and memory, and progress bars (in
        terminals and notebooks).
    indirect_resolution : int, optional
        Resolution of the cubemap on which indirect light is computed by paths; a power of two, at most that of
        ``lighting`` (the default, but for ``"auto"``, which chooses). Each coarse element is the mean over its texel
        and is interpolated; the held-out error in the report includes what that costs.
    strata : int
        Texel basis: shadow rays per element are strata^2.
    checkpoint_folder : path, optional
        Finished rows of path-traced indirect light are kept there until the matrix is complete: the same call after
        an interruption goes on where it stopped (``"huang2010"``: with the dense rows only).
    measurement : Measurement, optional
        Where rows hold: the vertices of the scene's meshes if not given, or ``camera_pixels``.
    terms : int or "auto"
        K, in-out factors of each BRDF that is not diffuse ([HR10] eq. 2), for radiance that depends on the view; with
        0, all surfaces are seen as diffuse. ``method="auto"`` then means finite elements, with ever more rays for a
        target. ``terms="auto"`` takes for each BRDF the fewest factors, 16 at most, that reflect light of an
        environment with half of the target error, and 0 where nothing is glossy. Mirrors, glass and masks have none:
        a camera's ray goes on there. What factors cannot stand for (BSDFs that vary over the surface in more than their
        diffuse part, or have lobes narrower than factors can tell) is diffuse in the matrix, and so are all
        surfaces where the method, the basis or the measurement knows no terms; one warning names what is left.
    harmonics : int, optional
        Spherical harmonics up to this order instead of each BRDF's own incident factors: (order + 1)^2 terms, which
        serve any BRDF (``LightTransport.with_bsdf``).
    max_seconds : float
        ``"auto"`` begins nothing that is predicted to take longer in all: of the plans within it the one that suits
        the target error best is carried out, and a warning says what more time would buy. Light by way of mirrors and
        glass takes half of it at most, and a warning tells the noise that stays.
    specular_error : float, optional
        Noise of light by way of mirrors and glass that is small enough, relative L2 of that light alone, even if it is
        much of all: it is sharp, and each halving of its noise takes four times the rays. If given,
        ``target_error`` is for all other light. The error in the report is of both.

    Returns
    -------
    LightTransport
        With ``report``: ``seconds`` per phase (``compile`` apart, see ``profiling.Stopwatch``), ``elements_total``,
        ``elements_evaluated``, ``rays``, ``estimated_error``, ``skipped``, ``forecast`` (``seconds``, ``bytes``),
        ``specular_noise`` (relative L2 of light by way of mirrors and glass alone, or None), ``plan`` (what was carried
        out: ``direct``, ``indirect``, ``parameters``), ``plans`` (of ``"auto"``: the same and ``predicted_seconds``,
        ``predicted_error`` and ``chosen`` of each), ``peak_memory_bytes``, ``seed``, ``parameters``, ``versions``.

    Raises
    ------
    PrtError
        If an argument makes no sense, the matrix or what a method needs for it would not fit into memory, or every
        plan of ``"auto"`` is predicted to take longer than ``max_seconds``.
    """
    where = mesh_vertices(scene) if measurement is None else _of_scene(measurement, scene)
    folder = Path(checkpoint_folder) if checkpoint_folder else None
    run = Run(seed, progress=progress, checkpoint_folder=folder)
    if not isinstance(lighting, CubemapLighting):
        given = harmonics, indirect_resolution, specular_error
        _check_sampled(lighting, method, terms, given)
    settings = Settings(
        lighting.resolution if isinstance(lighting, CubemapLighting) else 1,
        method,
        basis,
        max_depth,
        spp,
        target_error,
        seed,
        indirect_resolution,
        strata,
        terms,
        harmonics,
        where.kind,
        max_seconds,
        specular_error,
    )
    reset_peak_memory()
    if not isinstance(lighting, CubemapLighting):
        problem = Problem(scene, lighting, where, _diffuse(scene, where), basis, max_depth)
        return _lit_by_lamps(problem, settings, run)
    with run.clock.phase("setup"):
        (seen, sent), settings = _reflection(scene, where, settings)
        apart = scene.specular and max_depth != 2
        problem = Problem(scene, lighting, where, seen, basis, max_depth, apart)
        if where.kind == "vertices" and max_depth != 2:
            problem = replace(problem, sent=choose_senders(scene, problem.points, seen, sent))
        direct = DirectSolver(problem, strata, seed)
    return _Attempts(direct, settings, run).matrix()


class _Attempts:
    """One plan after another until a target error is met; the first one, where there is no target."""

    def __init__(self, direct: DirectSolver, settings: Settings, run: Run) -> None:
        self._direct, self._problem, self._settings, self._run = direct, direct.problem, settings, run
        self._dark, self._left_out = _no_indirect(direct.problem, settings, run.clock), list[str]()
        settings, costs = _measured(direct, settings, self._dark is None, run.clock)
        self._specular = None
        if self._dark is None and self._problem.specular_apart:
            others = _predicted_error(settings, costs)
            with run.clock.phase("specular"):
                self._specular = SpecularSteps(self._problem, settings, run.seed, others, self._time_left())
            costs = None if costs is None else _beside_specular(costs, self._specular)
        noise, light = (0.0, None) if self._specular is None else (self._specular.error, self._specular.every)
        self._proposals = _proposals(direct, settings, costs, noise, run.clock)
        self._execution = Execution(direct, settings, self._dark is None, run, light)

    def matrix(self) -> LightTransport:
        """The matrix of the last attempt, with its report."""
        run, problem = self._run, self._problem
        expected = self._forecast()
        if self._settings.method == "auto":
            _check_time(expected, self._settings.max_seconds)
        first = self._direct_light()
        if first:
            expected = self._forecast()
        expected = self._with_specular(expected)
        if run.progress:
            tqdm.write(_expectation(problem, expected))
        parts, plan = self._evaluated(first)
        transport = matrix_of(problem, parts)
        with run.clock.phase("held_out"):
            indirect, certain = self._dark is None, self._certain(plan)
            error = held_out_error(problem, transport, run.seed, indirect=indirect, certain=certain)
        ended = self._specular is not None and self._specular.ended
        _warn_if_missed(error, self._settings, self._proposals.too_long, ended)
        _warn_of_specular_noise(parts.specular, error, self._settings)
        transport.report.update(
            _account(parts, problem, [*_skipped(problem.scene, self._dark, error), *self._left_out])
            | {"estimated_error": error.report(), "plans": self._proposals.report()}
            | {"forecast": expected._asdict(), "plan": plan.report()}
            | _costs(transport, run.clock)
            | _inputs(problem, self._settings.of(plan))
        )
        return transport

    def _time_left(self) -> float:
        """Seconds that ``"auto"`` may still take."""
        limit = self._settings.max_seconds if self._settings.method == "auto" else math.inf
        return limit - self._run.clock.report()["total"]

    def _forecast(self) -> Forecast:
        with self._run.clock.phase("pilot"):
            proposals, indirect, plan = self._proposals, self._dark is None, self._proposals.plan
            expected = forecast(self._direct, self._settings, plan, indirect, proposals.seconds)
            if self._settings.method != "auto" or expected.seconds <= self._settings.max_seconds:
                return expected
            # rows of another kind than the plan's are not enough to refuse a scene by
            light = proposals.direct_seconds()
            if light is None:
                return expected
            return expected._replace(seconds=beside_direct_light(light, plan, indirect))

    def _with_specular(self, expected: Forecast) -> Forecast:
        """From the beginning, and with the rays that noise of specular light is still going to take."""
        seconds, specular = expected.seconds, self._specular
        if self._proposals.seconds is None:
            seconds += self._run.clock.report()["total"]
        if specular is not None:
            seconds += min(specular.remaining, self._time_left())
        return expected._replace(seconds=seconds)

    def _fits(self, plan: Plan) -> bool:
        """Whether there is memory for one more attempt; if not, the report will say so."""
        with self._run.clock.phase("plan"):
            found = fits(self._direct, self._settings, plan, self._dark is None)
        if not found:
            self._left_out.append(f"a next attempt, {plan}: more memory than is free")
        return found

    def _direct_light(self) -> list[MethodResult]:
        """Direct light that a choice between plans depends on, found and judged first; an empty list if none does."""
        proposals = self._proposals
        if isinstance(proposals, RefinementSchedule) or (how := proposals.uncertain) is None:
            return []
        parts = self._execution.direct_light(Plan(how))
        proposals.choose_again(how, self._judged(parts, Plan(how), 0, None, indirect=False).total)
        return [parts]

    def _evaluated(self, before: list[MethodResult]) -> tuple[MethodResult, Plan]:
        """The best of the attempts, and its plan.

        Each is judged by held-out elements of its own; those of the report decide nothing. What was evaluated before
        counts as well.
        """
        proposals, target, attempts = self._proposals, self._settings.target_error, list(before)
        attempts.append(self._execution.parts(proposals.plan))
        plans = [proposals.plan] * len(attempts)
        if target is None:
            return self._finished(attempts, -1, plans[-1]), plans[-1]
        judged: list[HeldOutError | None] = [None] * len(before)
        while True:
            found = proposals.weighed(self._judged(attempts[-1], plans[-1], len(attempts), target))
            judged.append(found)
            if found.total <= target or found.dark:
                break
            of_rays = attempts[-1].radiosity.get("error_of_rays", math.inf)
            if not proposals.after(found, self._run.clock.report()["total"], of_rays):
                break
            if not self._fits(proposals.plan):
                proposals.leave()
                break
            if self._run.progress:
                tqdm.write(_again(found.total, proposals.plan, proposals.seconds))
            kept = attempts[-1] if proposals.keeps_indirect else None
            attempts.append(self._execution.parts(proposals.plan, kept))
            plans.append(proposals.plan)
        best = int(np.argmin([math.inf if found is None else found.total for found in judged]))
        return self._finished(attempts, best, plans[best], judged[best]), plans[best]

    def _certain(self, plan: Plan) -> bool:
        """Whether its direct light is made of the rays that judge it: those to texels' centres."""
        return plan.direct == "exact" and self._problem.basis == "direction"

    def _judged(
        self, parts: MethodResult, plan: Plan, attempt: int, target: float | None, indirect: bool = True
    ) -> HeldOutError:
        """The error of an attempt, by elements of its own, with as little noise of specular light as there will be."""
        indirect, certain = indirect and self._dark is None, self._certain(plan)
        with self._run.clock.phase("held_out"):
            stream = random_stream(self._run.seed, DECISION, attempt)
            transport = matrix_of(self._problem, parts)
            found = held_out_error(
                self._problem, transport, stream, target, indirect=indirect, certain=certain
            )
        return found if self._specular is None else self._specular.foreseen(found)

    def _finished(
        self,
        attempts: list[MethodResult],
        which: int,
        plan: Plan,
        found: HeldOutError | None = None,
    ) -> MethodResult:
        """One of the attempts, with as many rays of specular light as are worth it beside its error."""
        parts = _with_costs_of(attempts, which)
        if self._specular is None or self._specular.done:
            return parts
        found = found or self._judged(parts, plan, len(attempts), TARGET)
        with self._run.clock.phase("specular"):
            self._specular.refine(found, self._time_left())
            light = self._specular.light
        return replace(parts, specular=light, rays=parts.rays | {"specular": light.rays})


def _of_scene(measurement: Measurement, scene: Scene) -> Measurement:
    if measurement.normalised is None or measurement.scene_hash != scene.hash:
        raise PrtError(
            f"this measurement is of another scene than {scene.path or 'the one given'}, or came from a file; "
            "make it of this scene: camera_pixels(scene)"
        )
    return measurement


def _diffuse(scene: Scene, where: Measurement) -> Diffuse:
    return Diffuse(scene.albedo if where.albedo is None else where.albedo)


def _reflection(scene: Scene, where: Measurement, settings: Settings) -> tuple[ChosenReflection, Settings]:
    """What points do with light, and settings that say how many terms that takes."""
    if settings.terms == AUTO_TERMS:
        refusal = settings.why_no_terms
        if settings.harmonics is None and refusal is None:
            bound = FACTOR_SHARE * (settings.target_error or TARGET)
            chosen = chosen_reflection(scene, bound)
            sending = chosen.sent or chosen.seen
            apart = told_apart(settings.max_depth) if scene.specular else 0
            if sending.terms and (settings.max_depth == 2 or terms_fit(sending, apart)):
                return chosen, replace(settings, terms=sending.terms)
            if sending.terms:
                _warn_if_glossy(
                    scene, "there is no memory for the terms of so many points; cameras' rays go on there"
                )
        elif refusal is not None:
            _warn_if_glossy(scene, refusal)
        settings = replace(settings, terms=0)
    if settings.view_dependent:
        seen = vertex_reflection(scene, int(settings.terms), settings.harmonics)
        return ChosenReflection(seen, None), settings
    return ChosenReflection(_diffuse(scene, where), None), settings


def _warn_if_glossy(scene: Scene, reason: str) -> None:
    """Say why glossy surfaces are left as diffuse, though terms are asked for where they can be had."""
    if any(material.glossy for material in scene.materials):
        warnings.warn(f"glossy surfaces are left as diffuse: {reason}", PrtWarning, stacklevel=4)


def _check_sampled(
    lighting: Any,
    method: str | Plan,
    terms: int | str,
    others: tuple[float | None, ...],
) -> None:
    """Refuse what is for light from a cubemap alone."""
    if not callable(getattr(lighting, "sample", None)):
        raise PrtError(
            f"lighting is {lighting!r}: give a CubemapLighting, SceneEmitters, or what samples its elements as these do"
        )
    if terms not in (0, AUTO_TERMS) or any(value is not None for value in others):
        raise PrtError(
            "lamps: terms, harmonics, indirect_resolution and specular_error are for light from a cubemap; "
            "leave them out"
        )
    if method not in ("auto", "gather", "brute_force"):
        raise PrtError(f'method {method!r} knows no lamps; use "gather" or "brute_force", or leave it out')


def _lit_by_lamps(problem: Problem, settings: Settings, run: Run) -> LightTransport:
    """The matrix whose columns are sampled emitters."""
    if settings.terms == AUTO_TERMS:
        _warn_if_glossy(problem.scene, "a matrix of lamps has no terms")
    settings, method = replace(settings, terms=0), settings.method
    seen = not isinstance(problem.emission, UnitLamps)  # pictures find the light that lamps send on directly
    target: float | None = settings.target_error
    attempts: Iterable[MethodResult]
    if method == "gather" or (method == "auto" and problem.scene.diffuse):
        settings, attempts = replace(settings, method="gather"), [gathered_lamps(problem, run, seen=seen)]
    else:
        settings = replace(settings, method="brute_force")
        attempts = path_traced_lamps(problem, run, settings.spp, target, seen=seen)
    for parts in attempts:
        transport = matrix_of(problem, parts)
        with run.clock.phase("held_out"):
            error = held_out_lamp_error(problem, transport, run.seed)
        worst = error.in_view
        if target is None or worst.total - 2 * worst.standard_error["total"] <= target:
            break
    if target is not None:
        _warn_if_missed(worst, settings, None)
    transport.report.update(
        _account(parts, problem, [])
        | {"estimated_error": error.report()}
        | _costs(transport, run.clock)
        | _inputs(problem, replace(settings, spp=parts.spp or settings.spp))
    )
    return transport


def _no_indirect(problem: Problem, settings: Settings, clock: Stopwatch) -> str | None:
    """Why there is no indirect light, or None."""
    if settings.max_depth == 2:
        return "max_depth 2 asks for direct light only"
    if problem.sent is None and not problem.reflection.importance.any():
        return "every surface is black, or sends all light on as mirrors and glass do"
    with clock.phase("pilot"):
        surfaces_meet = indirect_solver(problem, settings).any_hit(_PILOT_RAYS)
    return None if surfaces_meet else "no surface sees another one"


def _skipped(scene: Scene, reason: str | None, error: HeldOutError) -> list[str]:
    """What of the indirect light, and of what would make the matrix more exact, is left out."""
    left_out = []
    if reason is not None:
        left_out.append(f"indirect light: {reason}")
    elif scene.grey:
        left_out.append("two of three channels of the indirect light: every surface is grey")
    if error.dark:
        left_out.append(
            f"a more exact matrix: next to no light arrives, less than {DARK:.0%} of an unoccluded scene's"
        )
    return left_out


def _measured(
    direct: DirectSolver, settings: Settings, indirect: bool, clock: Stopwatch
) -> tuple[Settings, Costs | None]:
    """What plans cost, where the method leaves these open, and the settings that then hold."""
    if settings.method == "brute_force" and settings.target_error is not None and indirect:
        settings = replace(settings, spp=None, indirect_resolution=None)
    elif settings.method != "auto" or settings.view_dependent or settings.measurement != "vertices":
        return settings, None
    with clock.phase("plan"):
        return settings, measure(direct, settings, indirect)


def _beside_specular(costs: Costs, light: SpecularSteps) -> Costs:
    """Costs, where light by way of mirrors and glass is known."""
    direct = costs.direct
    if light.seen is not None:
        direct = {how: cost.with_known_centres for how, cost in direct.items()}
    return replace(costs, direct=direct, bent=light.most)


def _predicted_error(settings: Settings, costs: Costs | None) -> float:
    """Of all light but that by way of mirrors and glass; 0 where nothing tells."""
    if costs is not None:
        return CandidatePlans(costs, settings).error
    if settings.method == "auto" and settings.target_error is None:
        return EFFORTS["gather"][0].tolerance  # of its first and only plan
    return 0.0


def _proposals(
    direct: DirectSolver, settings: Settings, costs: Costs | None, specular: float, clock: Stopwatch
) -> RefinementSchedule | CandidatePlans:
    """The plans to try, ranked by what was measured, if anything was; ``specular`` is an error of all."""
    elapsed = clock.report()["total"]
    if costs is None:
        with clock.phase("plan"):
            return refinement_schedule(settings, elapsed, direct, specular)
    costs = replace(costs, fixed=costs.fixed + elapsed, specular=specular)
    return CandidatePlans(costs, settings)


def _with_costs_of(attempts: list[MethodResult], which: int) -> MethodResult:
    """One of the attempts, with what all of them evaluated; repeated elements count again."""

    def total(name: str) -> dict[str, int]:
        accounts = [getattr(parts, name) for parts in attempts]
        return {
            key: sum(account.get(key, 0) for account in accounts) for account in accounts for key in account
        }

    return replace(
        attempts[which],
        elements_evaluated=sum(parts.elements_evaluated for parts in attempts),
        elements=total("elements"),
        rays=total("rays"),
    )


def _check_time(expected: Forecast, max_seconds: float) -> None:
    if expected.seconds > max_seconds:
        raise PrtError(
            f"the matrix would take about {expected.seconds:.0f} s, more than max_seconds={max_seconds:g}: allow more, "
            "or use fewer texels (resolution) or vertices (edge_length, simpler meshes)"
        )


def _warn_if_missed(
    error: HeldOutError, settings: Settings, too_long: Predicted | None, ended: bool = False
) -> None:
    """Say that an error is above the target; or, where ``"auto"`` aimed at 2% unasked, that it is far above.

    And what would help; ``ended`` is the search for light by way of mirrors and glass, if it took too long.
    """
    target, asked = settings.target_error, settings.target_error is not None
    if settings.method == "auto" and target is None and not settings.view_dependent:
        target = WORST_FACTOR * TARGET
    specular = error.parts.get("specular", 0.0) if settings.specular_error else 0.0
    estimate = math.sqrt(max(error.total**2 - specular**2, 0.0))
    if target is None or error.dark or estimate - 2 * error.standard_error["total"] <= target:
        return
    more = ""
    if too_long is not None:
        method = {"paths": "brute_force"}.get(too_long.plan.indirect, too_long.plan.indirect)
        seconds = too_long.seconds
        time = f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"
        more = f'; method="{method}" would meet it in about {time}'
        if settings.method == "auto" and seconds > settings.max_seconds:
            more += f", max_seconds={settings.max_seconds:g} rules it out"
    if ended:
        noise = error.parts.get("specular", 0.0)
        more += f"; {noise:.3g} is noise of light by way of mirrors and glass, max_seconds={settings.max_seconds:g}"
        more += " ended the search for it"
    missed = (
        f"the target error {target:g} was not met" if asked else "no target error was given, 2% was aimed at"
    )
    warnings.warn(f"{missed}: the estimate is {estimate:.3g}{more}", PrtWarning, stacklevel=4)


def _warn_of_specular_noise(light: SpecularLight | None, error: HeldOutError, settings: Settings) -> None:
    """Say that light by way of mirrors and glass has more noise than was asked for, and that it matters."""
    wanted, target = settings.specular_error, settings.target_error or TARGET
    if light is None or wanted is None or error.parts.get("specular", 0.0) <= target:
        return
    if light.noise > math.sqrt(ENOUGH) * wanted:
        warnings.warn(
            f"specular_error {wanted:g} was not met: light by way of mirrors and glass has {light.noise:.3g}",
            PrtWarning,
            stacklevel=4,
        )


def _expectation(problem: Problem, expected: Forecast) -> str:
    return (
        f"{problem.scene.n_vertices} vertices x {problem.emission.n_directions} directions: "
        f"about {expected.seconds:.0f} s and {expected.bytes / 1e6:.0f} MB of memory"
    )


def _again(error: float, plan: Plan, seconds: float | None) -> str:
    values = ", ".join(f"{name} {value}" for name, value in plan.parameters.items())
    how = f"{plan.direct} direct light, {plan.indirect}" + (f" ({values})" if values else "")
    time = "" if seconds is None else f": about {seconds:.0f} s more"
    return f"the error is {error:.2%}, above the target; next, {how}{time}"


def _costs(transport: LightTransport, clock: Stopwatch) -> dict[str, Any]:
    """Time and memory until now, for the report."""
    return {
        "seconds": clock.report(),
        "stored_bytes": transport.nbytes,
        "peak_memory_bytes": peak_memory(),
    }


def _inputs(problem: Problem, settings: Settings) -> dict[str, Any]:
    """What the matrix was made from, for the report."""
    of_cubemap = isinstance(problem.emission, CubemapLighting)
    sizes = {"resolution": settings.resolution, "indirect_resolution": settings.element_resolution}
    return {
        "seed": settings.seed,
        "parameters": asdict(settings)
        | {name: size if of_cubemap else None for name, size in sizes.items()}
        | {"terms": problem.reflection.terms},
        "scene": problem.scene.summary,
        "versions": versions(),
    }


def _account(parts: MethodResult, problem: Problem, skipped: list[str]) -> dict[str, Any]:
    """What was evaluated and what was not, for the report."""
    skipped = [*skipped, *parts.skipped]
    if problem.scene.dark_backs:
        names = ", ".join(problem.scene.dark_backs[:5]) + (
            ", ..." if len(problem.scene.dark_backs) > 5 else ""
        )
        skipped.append(
            f"backs that no light reaches, of {len(problem.scene.dark_backs)} two-sided shapes: {names}"
        )
    if isinstance(problem.emission, CubemapLighting):
        above = share_above_horizon(problem.points, problem.emission)
        skipped.append(f"direct rays below the horizon: {1 - above:.0%} of the elements")
    return {
        "elements_total": len(problem.points) * problem.emission.size,
        "elements_evaluated": parts.elements_evaluated,
        "elements": parts.elements,
        "rays": parts.rays,
        "sampling": parts.sampling,
        "radiosity": parts.radiosity,
        "skipped": skipped,
        "specular_noise": None if parts.specular is None else parts.specular.noise,
    }


class GlossyOptions(TypedDict, total=False):
    """What ``precompute_glossy`` hands on to ``precompute`` as it is; defaults are there."""

    max_depth: int
    seed: int
    progress: bool


def precompute_glossy(
    scene: Scene,
    lighting: CubemapLighting,
    terms: int = 4,
    harmonics: int | None = None,
    direct: str = "exact",
    *,
    rays: int = 64,
    tolerance: float = 0.06,
    **options: Unpack[GlossyOptions],
) -> LightTransport:
    """``precompute`` with in-out factors of glossy BRDFs, by one plan: visibility once for all terms, finite elements.

    Parameters
    ----------
    scene : Scene
        BSDFs are diffuse or can be factored (``reflection.brdf_factors``).
    lighting : CubemapLighting
    terms, harmonics
        As for ``precompute``.
    direct : {"exact", "consensus"}
        How visibility is found, once for all terms.
    rays : int
        Per vertex, that gather indirect light; a power of two.
    tolerance : float
        Relative L2 error that a low rank may cost the first bounce; at least as much as the rays have noise.
    **options
        ``max_depth`` (5), ``seed`` (0) and ``progress`` (true), as for ``precompute``.

    Raises
    ------
    PrtError
        If an argument makes no sense, no surface is glossy, or a BSDF cannot be factored, by name.
    """
    if terms < 1:
        raise PrtError(f"terms must be at least 1, not {terms}")
    if direct not in ("exact", "consensus"):
        raise PrtError(f"direct {direct!r} is neither 'exact' nor 'consensus'")
    plan = Plan(direct, "gather", rays, tolerance)
    return precompute(scene, lighting, plan, terms=terms, harmonics=harmonics, **options)
