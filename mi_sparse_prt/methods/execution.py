"""Carries out plans: composes the methods that evaluate direct and indirect light of one scene."""

from __future__ import annotations

import hashlib
import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.bits import count_bits
from mi_sparse_prt.core.run import Run
from mi_sparse_prt.methods.brute_force import exact_direct, path_traced
from mi_sparse_prt.methods.consensus_visibility import by_consensus
from mi_sparse_prt.methods.huang2010 import huang2010_parts
from mi_sparse_prt.methods.plan import TOGETHER, Plan
from mi_sparse_prt.methods.result import MethodResult
from mi_sparse_prt.methods.settings import Settings
from mi_sparse_prt.methods.sparse import SparseOptions, sparse_parts
from mi_sparse_prt.operators.factored_visibility import FactoredVisibility
from mi_sparse_prt.operators.fractional_visibility import FractionalVisibility
from mi_sparse_prt.operators.operator import Operator
from mi_sparse_prt.operators.upsampled import Upsampled
from mi_sparse_prt.operators.visibility import Visibility
from mi_sparse_prt.reconstruction.gather_noise import GatherNoise
from mi_sparse_prt.reconstruction.node_placement import choose_nodes
from mi_sparse_prt.reflection.factor_tables import incident_tables
from mi_sparse_prt.reflection.in_out_factors import InOutFactors
from mi_sparse_prt.reflection.reflection import Reflection
from mi_sparse_prt.reflection.sent_light import SentLight, rows_among
from mi_sparse_prt.solvers.adaptive_strata import Strata, adaptive_visibility
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.glossy_radiosity import GatherEffort, glossy_indirect
from mi_sparse_prt.solvers.paths import PathSolver
from mi_sparse_prt.solvers.problem import Problem
from mi_sparse_prt.solvers.radiosity import Gathered, GatheredByDepth, RadiositySolver
from mi_sparse_prt.solvers.specular import SpecularLight, SpecularOptions, specular_light
from mi_sparse_prt.solvers.surface_nodes import Nodes
from mi_sparse_prt.solvers.term_paths import TermPaths
from mi_sparse_prt.solvers.texel_edges import fractional_visibility
from mi_sparse_prt.transport import LightTransport


class Execution:
    """Evaluates the matrix of a scene by one plan after another; direct light is kept for the next plan.

    Parameters
    ----------
    direct : DirectSolver
        Of the problem.
    settings : Settings
    indirect : bool
        Whether there is indirect light.
    run : Run
    specular : SpecularLight, optional
        Where it is an operator of its own; with rows for all terms that are seen or sent (``SentLight.every``).
    """

    def __init__(
        self,
        direct: DirectSolver,
        settings: Settings,
        indirect: bool,
        run: Run,
        specular: SpecularLight | None = None,
    ) -> None:
        self._problem, self._solver = direct.problem, direct
        self._settings, self._any_indirect, self._run = settings, indirect, run
        self._direct: dict[tuple[str, Strata | None], MethodResult] = {}
        self._specular, self._specular_rays = specular, 0 if specular is None else specular.rays
        self._sent, sent = specular, self._problem.sent
        if specular is not None and sent is not None:
            self._specular = specular.take(rows_among(self._problem.reflection, sent.every))
            self._sent = specular.take(rows_among(sent.reflection, sent.every))

    def parts(self, plan: Plan, kept: MethodResult | None = None) -> MethodResult:
        """The parts of the matrix, and an account of what was evaluated for them by this call.

        Parameters
        ----------
        plan : Plan
        kept : MethodResult, optional
            Whose indirect light is taken, in place of that of the plan.
        """
        if plan.direct in TOGETHER:
            return self._with_specular(self._together(plan))
        light = self._with_specular(self.direct_light(plan))
        if plan.indirect == "none" or not self._any_indirect:
            return light
        if kept is not None:
            return replace(light, indirect=kept.indirect, skipped=kept.skipped, radiosity=kept.radiosity)
        return self._gathered(plan, light) if plan.indirect == "gather" else self._path_traced(plan, light)

    def _with_specular(self, light: MethodResult) -> MethodResult:
        """With what arrives by way of mirrors and glass; that costs nothing the second time."""
        if self._specular is None:
            return light
        rays, self._specular_rays = self._specular_rays, 0
        return replace(light, specular=self._specular, rays=light.rays | {"specular": rays})

    def direct_light(self, plan: Plan) -> MethodResult:
        """Direct light of a plan alone; it costs nothing the second time."""
        how = plan.direct, plan.strata
        if how in self._direct:
            return replace(
                self._direct[how],
                elements_evaluated=0,
                elements={"direct": 0, "indirect": 0},
                rays={"direct": 0},
            )
        self._direct[how] = self._with_terms(self._found_directly(plan))
        return self._direct[how]

    def _found_directly(self, plan: Plan) -> MethodResult:
        match plan.direct:
            case "exact":
                return self._exact()
            case "edges":
                return self._edges()
            case "adaptive":
                return self._adaptive(plan.strata or Strata())
        return self._consensus()

    def _with_terms(self, light: MethodResult) -> MethodResult:
        """Direct light with rows for the terms of glossy vertices; they see what their vertices see."""
        reflection = self._problem.reflection
        if not isinstance(reflection, InOutFactors):
            return light
        return replace(light, direct=self._factored(light.direct, reflection))

    def _factored(self, seen: Operator | None, reflection: InOutFactors) -> FactoredVisibility:
        """Direct light of all vertices with rows for terms."""
        assert isinstance(seen, Visibility | FractionalVisibility)
        texels = self._problem.emission.n_directions if self._problem.basis == "texel" else None
        tables = incident_tables(reflection.factors, texels=texels)
        return FactoredVisibility(seen, reflection.tangents, reflection.material, tables)

    def _exact(self) -> MethodResult:
        if self._problem.basis == "direction":
            return self._centres(self._solver)
        return exact_direct(self._solver, self._run)

    def _consensus(self) -> MethodResult:
        state = by_consensus(self._solver, self._run)
        rays = int(count_bits(state.evaluated).sum())
        bits = Visibility(state.visible, self._problem.points.normals, self._solver.lighting)
        account = {"direct": rays, "indirect": 0}
        return MethodResult(bits, None, rays, account, {"direct": rays}, dense=state.sampled_themselves)

    def _edges(self) -> MethodResult:
        """All texels' centres, and where visibility changes between these."""
        solver = DirectSolver(replace(self._problem, basis="direction"))
        centres = self._centres(solver)
        assert isinstance(centres.direct, Visibility)
        with self._run.clock.phase("edges"):
            part, rays = fractional_visibility(solver, centres.direct.bits)
        return replace(centres, direct=part, rays={"direct": centres.rays["direct"] + rays})

    def _adaptive(self, strata: Strata) -> MethodResult:
        """Strata of all texels, more of those that are seen in part."""
        elements = len(self._solver.points) * self._solver.lighting.n_directions
        with self._run.clock.phase("direct"):
            part, traced = adaptive_visibility(self._problem, strata, self._run.seed)
        return MethodResult(
            part, None, elements, {"direct": elements, "indirect": 0}, {"direct": int(traced.sum())}
        )

    def _centres(self, solver: DirectSolver) -> MethodResult:
        """Which texels' centres are seen; rays that looked for light that surfaces let through may know."""
        if self._specular is None or self._specular.seen is None:
            return exact_direct(solver, self._run)
        bits = Visibility(self._specular.seen, solver.points.normals, solver.lighting)
        elements = len(solver.points) * solver.lighting.n_directions
        return MethodResult(bits, None, elements, {"direct": elements, "indirect": 0}, {"direct": 0})

    def _gathered(self, plan: Plan, light: MethodResult) -> MethodResult:
        """With interreflections by finite elements."""
        if isinstance(self._problem.sending, InOutFactors):
            return self._gathered_terms(plan, light, self._problem.sending)
        problem, clock = self._problem, self._run.clock
        sources, known = problem.at_vertices, light
        if sources is not problem:  # vertices know the light that surfaces send out
            known = self._direct_of(sources)
        assert known.direct is not None  # it is the first light that bounces
        with clock.phase("gather_rays"):
            nodes = choose_nodes(problem.scene, sources.points)
            noise = self._averaging(plan, sources, nodes)
            gather = RadiositySolver(sources, plan.rays, self._run.seed, nodes, averaging=noise)
        with clock.phase("interreflection"):
            specular = None if known.specular is None else known.specular.operator
            if sources is problem:
                part = gather.indirect(known.direct, plan.tolerance, specular)
            else:
                part = gather.seen_from(problem, known.direct, plan.tolerance, specular)
        rays = light.rays | {"gather": gather.rays} | _rays_of(noise)
        if known is not light:
            rays["direct"] += known.rays["direct"]
        return replace(light, indirect=part, rays=rays, skipped=_left_out(part), radiosity=_account(part))

    def _averaging(self, plan: Plan, sources: Problem, nodes: Nodes) -> GatherNoise | None:
        """What averages out the noise of rays, if the plan asks for it."""
        return GatherNoise(sources, nodes, plan.rays, self._run.seed) if plan.averaged else None

    def _direct_of(self, sources: Problem) -> MethodResult:
        """Direct and specular light of the vertices, which send it on to other points."""
        known = exact_direct(DirectSolver(replace(sources, basis="direction")), self._run)
        if not sources.specular_apart:
            return known
        # noise of single vertices does not matter: points see many, whose mean has little of it
        few = SpecularOptions(4, 4)
        return replace(known, specular=specular_light(sources, self._run.seed, few))

    def _gathered_terms(self, plan: Plan, light: MethodResult, sending: InOutFactors) -> MethodResult:
        """With interreflections among glossy surfaces."""
        with self._run.clock.phase("interreflection"):
            problem, seed, seen = self._problem, self._run.seed, light.direct
            direct = self._factored(
                seen.visibility if isinstance(seen, FactoredVisibility) else seen, sending
            )
            nodes = choose_nodes(problem.scene, problem.points)
            specular = None if self._sent is None else self._sent.operator
            averaging = self._averaging(plan, problem, nodes)
            effort = GatherEffort(plan.rays, plan.tolerance, seed)
            part, noise = glossy_indirect(problem, direct, nodes, effort, specular, averaging)
            if problem.sent is not None:
                part = _seen(part, problem.sent, problem.reflection)
        starts = len(np.union1d(nodes.ids, direct.glossy))
        rays = light.rays | {"gather": starts * plan.rays} | _rays_of(averaging)
        # the rank that leaves this out grows with the rays, too
        refinable = math.hypot(noise.bounce, part.left_out) * noise.share
        account = _account(part) | {"noise_of_rays": noise.bounce, "error_of_rays": refinable}
        return replace(light, indirect=part, rays=rays, skipped=_left_out(part), radiosity=account)

    def _path_traced(self, plan: Plan, light: MethodResult) -> MethodResult:
        """With paths for all elements."""
        paths = self._paths(plan)
        part = path_traced(paths, self._solver.lighting, self._run_of(plan))
        if isinstance(paths, TermPaths):
            part = _rows_of_terms(part, paths.colours, self._problem.reflection.glossy)
        elements = len(paths.points) * paths.lighting.n_directions
        return replace(
            light,
            indirect=part,
            elements_evaluated=max(light.elements_evaluated, elements),
            elements=light.elements | {"indirect": elements},
            rays=light.rays | {"indirect_paths": elements * paths.spp},
        )

    def _together(self, plan: Plan) -> MethodResult:
        """Both parts by a method that evaluates them at the same elements."""
        paths = self._paths(plan) if self._any_indirect else None
        if plan.direct == "huang2010":
            return huang2010_parts(self._solver, paths, self._run_of(plan))
        options = SparseOptions()
        if plan.dense is not None:
            options = replace(options, spatial=replace(options.spatial, fraction=plan.dense))
        return sparse_parts(self._solver, paths, self._run_of(plan), options)

    def _paths(self, plan: Plan) -> PathSolver:
        return indirect_solver(self._problem, self._settings.of(plan))

    def _run_of(self, plan: Plan) -> Run:
        """With what the rows of the indirect light, and their order, depend on."""
        state = f"{self._problem.scene.hash} {self._settings.of(plan)} {plan}".encode()
        state += self._problem.points.keys.tobytes()
        return replace(self._run, state=hashlib.sha256(state).hexdigest()[:32])


def _seen(
    part: Gathered | GatheredByDepth, sent: SentLight, reflection: Reflection
) -> Gathered | GatheredByDepth:
    """Light of the rows of a matrix, from that of vertices and of senders' terms."""
    if isinstance(part, GatheredByDepth):
        depths = (
            replace(term, left=tuple(sent.interpolated(left, reflection) for left in term.left))
            for term in part.terms
        )
        return replace(part, terms=tuple(depths))
    return replace(part, left=tuple(sent.interpolated(left, reflection) for left in part.left))


def _rays_of(averaging: GatherNoise | None) -> dict[str, int]:
    return {} if averaging is None else {"averaging": averaging.rays}


def _account(part: Gathered | GatheredByDepth) -> dict[str, Any]:
    return {"ranks": list(part.ranks), "bounces": part.bounces}


def _left_out(part: Gathered | GatheredByDepth) -> list[str]:
    return [
        f"interreflections after {part.bounces}: next to no light",
        f"singular values of the first bounce below {part.left_out:.1%} of its energy's root",
    ]


def matrix_of(problem: Problem, parts: MethodResult) -> LightTransport:
    """The matrix of parts that were evaluated, without a report."""
    specular = None if parts.specular is None else parts.specular.operator
    every = {"direct": parts.direct, "indirect": parts.indirect, "specular": specular}
    operators = {name: operator for name, operator in every.items() if operator is not None}
    return LightTransport(
        problem.emission,
        problem.basis,
        problem.max_depth,
        problem.measurement,
        problem.reflection,
        operators,
        problem.scene.hash,
        dense_vertices=parts.dense,
    )


def _rows_of_terms(part: Upsampled, colours: int, glossy: NDArray[np.int64]) -> Upsampled:
    """Terms as rows of their own, after the unit-albedo rows, in place of channels (n, m, (1 + K) * colours)."""
    n, m, channels = part.density.shape
    by_row = part.density.reshape(n, m, channels // colours, colours)
    terms = np.moveaxis(by_row[glossy, :, 1:], 2, 1).reshape(-1, m, colours)
    return replace(part, density=np.concatenate([by_row[:, :, 0], terms]))


def indirect_solver(problem: Problem, settings: Settings) -> PathSolver:
    """The path tracer that settings ask for, at the problem's points."""
    kind = TermPaths if isinstance(problem.reflection, InOutFactors) else PathSolver
    return kind(problem.on(settings.element_resolution), settings.samples, settings.seed)
