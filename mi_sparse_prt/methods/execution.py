"""Carries out plans: composes the methods that evaluate direct and indirect light of one scene."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path
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
from mi_sparse_prt.methods.sparse import sparse_parts
from mi_sparse_prt.operators.factored_visibility import FactoredVisibility
from mi_sparse_prt.operators.fractional_visibility import FractionalVisibility
from mi_sparse_prt.operators.upsampled import Upsampled
from mi_sparse_prt.operators.visibility import Visibility
from mi_sparse_prt.reconstruction.node_placement import choose_nodes
from mi_sparse_prt.reflection.factor_tables import incident_tables
from mi_sparse_prt.reflection.in_out_factors import InOutFactors
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.glossy_radiosity import glossy_indirect
from mi_sparse_prt.solvers.paths import PathSolver
from mi_sparse_prt.solvers.problem import Problem
from mi_sparse_prt.solvers.radiosity import Gathered, RadiositySolver
from mi_sparse_prt.solvers.term_paths import TermPaths
from mi_sparse_prt.solvers.texel_edges import fractional_visibility
from mi_sparse_prt.transport import LightTransport


class Execution:
    """Evaluates the matrix of a scene by one plan after another; direct light is kept for the next plan.

    Parameters
    ----------
    problem : Problem
    direct : DirectSolver
        At its points.
    settings : Settings
    indirect : bool
        Whether there is indirect light.
    run : Run
    """

    def __init__(
        self,
        problem: Problem,
        direct: DirectSolver,
        settings: Settings,
        indirect: bool,
        run: Run,
    ) -> None:
        self._problem, self._scene, self._solver = problem, problem.scene, direct
        self._settings, self._any_indirect = settings, indirect
        self._run, self._clock, self.progress = run, run.clock, run.progress
        self._direct: dict[str, MethodResult] = {}

    def parts(self, plan: Plan) -> MethodResult:
        """The parts of the matrix, and an account of what was evaluated for them by this call."""
        if plan.direct in TOGETHER:
            return self._together(plan)
        light = self.direct_light(plan.direct)
        if plan.indirect == "none" or not self._any_indirect:
            return light
        return self._gathered(plan, light) if plan.indirect == "gather" else self._path_traced(plan, light)

    def direct_light(self, how: str) -> MethodResult:
        """Direct light alone; it costs nothing the second time."""
        if how in self._direct:
            return replace(
                self._direct[how],
                elements_evaluated=0,
                elements={"direct": 0, "indirect": 0},
                rays={"direct": 0},
            )
        find = {"exact": self._exact, "edges": self._edges, "consensus": self._consensus}[how]
        self._direct[how] = self._with_terms(find())
        return self._direct[how]

    def matrix(self, parts: MethodResult) -> LightTransport:
        """The matrix of evaluated parts, without a report."""
        return matrix_of(self._problem, parts)

    def _with_terms(self, light: MethodResult) -> MethodResult:
        """Direct light with rows for the terms of glossy vertices; they see what their vertices see."""
        reflection = self._problem.reflection
        if not isinstance(reflection, InOutFactors):
            return light
        assert isinstance(light.direct, Visibility | FractionalVisibility)
        tables = incident_tables(reflection.factors)
        factored = FactoredVisibility(light.direct, reflection.tangents, reflection.material, tables)
        return replace(light, direct=factored)

    def _exact(self) -> MethodResult:
        return exact_direct(self._solver, self._clock, self.progress)

    def _consensus(self) -> MethodResult:
        state = by_consensus(self._scene, self._solver, self._clock)
        rays = int(count_bits(state.evaluated).sum())
        bits = Visibility(state.visible, self._scene.normals, self._solver.lighting)
        return MethodResult(bits, None, rays, {"direct": rays, "indirect": 0}, {"direct": rays})

    def _edges(self) -> MethodResult:
        """All texels' centres, and where visibility changes between these."""
        solver = DirectSolver(self._scene.normalised, self._solver.lighting, self._solver.points)
        centres = exact_direct(solver, self._clock, self.progress)
        assert isinstance(centres.direct, Visibility)
        with self._clock.phase("edges"):
            part, rays = fractional_visibility(solver, centres.direct.bits)
        return replace(centres, direct=part, rays={"direct": centres.rays["direct"] + rays})

    def _gathered(self, plan: Plan, light: MethodResult) -> MethodResult:
        """With interreflections by finite elements."""
        if isinstance(light.direct, FactoredVisibility):
            return self._gathered_terms(plan, light, light.direct)
        if self._problem.measurement.kind != "vertices":
            return self._gathered_elsewhere(plan, light)
        solver, settings = self._solver, self._settings
        with self._clock.phase("gather_rays"):
            nodes = choose_nodes(self._scene, solver.points)
            gather = RadiositySolver(
                self._scene,
                solver.lighting,
                solver.points,
                plan.rays,
                settings.max_depth,
                settings.seed,
                nodes,
            )
        with self._clock.phase("interreflection"):
            part = gather.indirect(light.direct, plan.tolerance)
        rays = light.rays | {"gather": gather.rays}
        return replace(light, indirect=part, rays=rays, skipped=_left_out(part), radiosity=_account(part))

    def _gathered_elsewhere(self, plan: Plan, light: MethodResult) -> MethodResult:
        """With interreflections at points that are no vertices: these know the light that surfaces send out."""
        problem, settings = self._problem, self._settings
        vertices = problem.at_vertices.points
        solver = DirectSolver(self._scene.normalised, self._solver.lighting, vertices)
        sources = exact_direct(solver, self._clock, self.progress)
        with self._clock.phase("gather_rays"):
            nodes = choose_nodes(self._scene, vertices)
            before = settings.max_depth if settings.max_depth < 0 else settings.max_depth - 1
            gather = RadiositySolver(
                self._scene, solver.lighting, vertices, plan.rays, before, settings.seed, nodes
            )
        with self._clock.phase("interreflection"):
            part = gather.seen_from(problem.points, sources.direct, plan.tolerance)
        rays = light.rays | {"gather": gather.rays}
        rays["direct"] += sources.rays["direct"]
        return replace(light, indirect=part, rays=rays, skipped=_left_out(part), radiosity=_account(part))

    def _gathered_terms(self, plan: Plan, light: MethodResult, direct: FactoredVisibility) -> MethodResult:
        """With interreflections among glossy surfaces."""
        with self._clock.phase("interreflection"):
            seed = self._settings.seed
            part, noise = glossy_indirect(self._problem, direct, plan.rays, plan.tolerance, seed)
        rays = light.rays | {"gather": len(self._problem.points) * plan.rays}
        account = _account(part) | {"noise_of_rays": noise}
        return replace(light, indirect=part, rays=rays, skipped=_left_out(part), radiosity=account)

    def _path_traced(self, plan: Plan, light: MethodResult) -> MethodResult:
        """With paths for all elements."""
        paths, lighting = self._paths(plan), self._solver.lighting
        part = path_traced(paths, lighting, self._clock, self.progress, self._checkpoint(plan))
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
        seed, checkpoint = self._settings.seed, self._checkpoint(plan)
        if plan.direct == "huang2010":
            return huang2010_parts(
                self._scene, self._solver, paths, seed, self._clock, self.progress, checkpoint
            )
        return sparse_parts(
            self._scene, self._solver, paths, seed, self._clock, self.progress, checkpoint, plan.dense
        )

    def _paths(self, plan: Plan) -> PathSolver:
        return indirect_solver(self._problem, self._settings.of(plan))

    def _checkpoint(self, plan: Plan) -> Path | None:
        """A file name that stands for all that the rows of the indirect light, and their order, depend on."""
        if self._run.checkpoint_folder is None:
            return None
        state = (
            f"{self._scene.hash} {self._settings.of(plan)} {plan}".encode()
            + self._solver.points.keys.tobytes()
        )
        return self._run.checkpoint_folder / f"{hashlib.sha256(state).hexdigest()[:32]}.rows"


def _account(part: Gathered) -> dict[str, Any]:
    return {"ranks": list(part.ranks), "bounces": part.bounces}


def _left_out(part: Gathered) -> list[str]:
    return [
        f"interreflections after {part.bounces}: next to no light",
        f"singular values of the first bounce below {part.left_out:.1%} of its energy's root",
    ]


def matrix_of(problem: Problem, parts: MethodResult) -> LightTransport:
    """The matrix of parts that were evaluated, without a report."""
    operators = {"direct": parts.direct} | ({} if parts.indirect is None else {"indirect": parts.indirect})
    return LightTransport(
        problem.emission,
        problem.basis,
        problem.measurement,
        problem.reflection,
        operators,
        problem.scene.hash,
    )


def _rows_of_terms(part: Upsampled, colours: int, glossy: NDArray[np.int64]) -> Upsampled:
    """Terms as rows of their own, after the unit-albedo rows, in place of channels (n, m, (1 + K) * colours)."""
    n, m, channels = part.density.shape
    by_row = part.density.reshape(n, m, channels // colours, colours)
    terms = np.moveaxis(by_row[glossy, :, 1:], 2, 1).reshape(-1, m, colours)
    return replace(part, density=np.concatenate([by_row[:, :, 0], terms]))


def indirect_solver(problem: Problem, settings: Settings) -> PathSolver:
    """The path tracer that settings ask for, at the scene's vertices."""
    if isinstance(problem.reflection, InOutFactors):
        coarser = settings.coarse if settings.coarse.resolution != settings.resolution else None
        return TermPaths(problem, settings.samples, settings.seed, coarser)
    return PathSolver(
        problem.scene.normalised,
        settings.coarse,
        problem.points,
        settings.indirect_basis,
        settings.max_depth,
        settings.samples,
        problem.channels,
        settings.seed,
    )
