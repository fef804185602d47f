"""Few columns of coloured light, such as lamps: direct light by samples, interreflections without approximation."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mi_sparse_prt.core.run import Run
from mi_sparse_prt.core.sparse_product import multiply_scaled
from mi_sparse_prt.methods.result import MethodResult
from mi_sparse_prt.operators.by_depth import ByDepth
from mi_sparse_prt.operators.dense import Dense
from mi_sparse_prt.operators.operator import Floats, Operator
from mi_sparse_prt.reconstruction.lamp_light import LampLight
from mi_sparse_prt.reconstruction.node_placement import choose_nodes
from mi_sparse_prt.reconstruction.surface_smoothing import smooth_light, smoothing_levels
from mi_sparse_prt.solvers.form_factors import gather_matrix
from mi_sparse_prt.solvers.lamps import LampRays
from mi_sparse_prt.solvers.paths import Estimate
from mi_sparse_prt.solvers.problem import Problem, told_apart
from mi_sparse_prt.solvers.radiosity import RadiositySolver
from mi_sparse_prt.solvers.specular import SpecularOptions, specular_light
from mi_sparse_prt.solvers.surface_nodes import Nodes

BLOCK = 4096  # points at a time
NOISE = 0.02  # of light that mirrors and glass bring, relative L2, of direct light together with it
FEWER = "paths of some lamps: fewer than {} of an element, as the target error asks for no more"
SPP = 64  # paths of an element, where nothing else says how many: what is left of their grain is hardly seen
# in all, where SPP of each would be more: half a minute. Noise of many lamps averages out in pictures
PATHS = 1 << 25
LEAST = 4  # paths of an element, however many these are
LIMITED = (
    "paths of lamps: {} of an element, not {}, as there are {:.0f} million elements; ask for more by spp"
)


def gathered_lamps(
    problem: Problem, run: Run, rays: int = 256, strata: int = 16, seen: bool = True
) -> MethodResult:
    """By finite elements: diffuse scenes.

    Parameters
    ----------
    problem : Problem
        With lamps.
    run : Run
    rays : int
        Per vertex and per point, that gather indirect light; a power of two.
    strata : int
        strata**2 shadow rays per point and lamp.
    seen : bool
        Whether direct light is part of the result; without, it is what surfaces reflect of it.
    """
    sources = problem.at_vertices
    direct, counts = _direct(problem, run, strata)
    indirect, traced = None, 0
    if problem.max_depth != 2:
        own = direct if sources is problem else _direct(sources, run, strata)[0]
        with run.clock.phase("gather_rays"):
            solver = RadiositySolver(sources, rays, run.seed)
        with run.clock.phase("interreflection"):
            indirect = solver.apply_coloured(own) if sources.max_depth != 2 else np.zeros_like(own)
            traced = solver.rays
            if sources is not problem:
                indirect = _seen_from(problem, own + indirect, rays, run.seed)
                traced += len(problem.points) * rays
    counts["gather"] = traced
    return _result(direct if seen else None, None if indirect is None else Dense(indirect), counts)


def path_traced_lamps(
    problem: Problem,
    run: Run,
    spp: int | None = None,
    target: float | None = None,
    strata: int = 16,
    seen: bool = True,
) -> Iterator[MethodResult]:
    """By paths and photons: any BSDF; at least ``spp`` paths of an element, or as many photons; noise is averaged out.

    Without ``spp`` these are 64, or fewer where there are many lamps and points. Indirect light is told apart by how
    many surfaces it met: where not all are diffuse, cameras' rays go on from some, and meet them as well. In scenes of
    more than 65,536 vertices light is found at nodes, between which it is interpolated. With a ``target``, lamps of
    whose indirect light fewer paths leave so little noise (relative L2) have fewer; such a result says so in
    ``skipped``, and a next one, by ``spp`` paths, follows. See ``gathered_lamps``.
    """
    direct, rays = _direct(problem, run, strata) if seen else (None, {})
    if problem.max_depth == 2:
        yield _result(direct, None, rays)
        return
    m, apart = problem.emission.size, 0 if problem.scene.diffuse else told_apart(problem.max_depth)
    with run.clock.phase("smoothing"):
        places = _places(problem)
    elements, skipped = len(places.ids) * m, []
    if spp is None:
        spp = max(LEAST, min(SPP, PATHS // max(elements, 1)))
        skipped = [] if spp == SPP else [LIMITED.format(spp, SPP, elements / 1e6)]
    with run.clock.phase("indirect"):
        light = LampLight(problem, places.ids, places.nodes, places.levels, spp, run.seed, max(apart, 1))
        # a quarter of the squared error: few paths know little of noise, smoothing and interpolation blur
        least = None if target is None else light.effort(target / 2)
    every = np.full(m, spp)
    for effort in (every,) if least is None or (least == spp).all() else (least, every):
        with run.clock.phase("indirect"), run.bar(elements, "indirect") as bar:
            found = light.estimate(effort, bar.update)
        with run.clock.phase("smoothing"):
            every_light = places.light(found, m)
        indirect = Dense(every_light) if apart == 0 else _by_depth(every_light, apart)
        result = _result(direct, indirect, rays | light.rays)
        yield replace(result, spp=spp, skipped=skipped + ([FEWER.format(spp)] if effort is least else []))


class _Places(NamedTuple):
    """Points at which light is found.

    Attributes
    ----------
    ids : (n,) int64
    nodes : Nodes, optional
        These, if they are among vertices.
    levels : list of (n, n) sparse float32
        As of ``smoothing_levels``; none where points are no vertices.
    """

    ids: NDArray[np.int64]
    nodes: Nodes | None
    levels: list[scipy.sparse.csr_array]

    def light(self, found: Estimate, m: int) -> Floats:
        """Light (points, m, k) of all points, from that of m lamps (n * m, k): smoothed, and interpolated."""
        light, variance = (x.reshape(len(self.ids), m, -1) for x in (found.mean, found.variance))
        if self.nodes is None:
            return light
        smooth = smooth_light(light, variance, self.levels).reshape(len(light), -1)
        every = self.nodes.interpolate(smooth)
        return np.maximum(every, 0).reshape(len(every), *light.shape[1:])


def _places(problem: Problem) -> _Places:
    """All points; of vertices, if they are many, nodes."""
    if problem.at_vertices is not problem:
        return _Places(np.arange(len(problem.points)), None, [])
    nodes = choose_nodes(problem.scene, problem.points)
    return _Places(nodes.ids, nodes, smoothing_levels(problem.scene, problem.points, nodes.ids))


def _direct(problem: Problem, run: Run, strata: int) -> tuple[Floats, dict[str, int]]:
    """Unit-albedo light (n, m, 3) that no diffuse surface sent on, and how many rays of each kind found it."""
    solver = LampRays(problem, strata, run.seed)
    with run.clock.phase("direct"):
        result = np.empty((len(problem.points), problem.emission.size, 3), np.float32)
        for ids in _blocks(len(result), BLOCK, "direct", run):
            result[ids] = solver.rows(ids)
    if not problem.scene.bends_light or problem.max_depth == 2:
        return result, {"direct": solver.rays, "specular": 0}
    with run.clock.phase("specular"):
        found = specular_light(problem, run.seed, SpecularOptions(error=NOISE))
    for channel in range(3):
        result[..., channel] += found.matrices[channel % len(found.matrices)].toarray()
    return result, {"direct": solver.rays, "specular": found.rays}


def _seen_from(problem: Problem, light: Floats, rays: int, seed: int) -> Floats:
    """Indirect light (n, m, 3) of points that are no vertices, from light (n_v, m, 3) that vertices receive."""
    matrix = gather_matrix(problem.scene, problem.points, rays, seed, max_depth=problem.max_depth)
    albedo = np.ascontiguousarray(problem.scene.albedo.T)
    channels = [
        multiply_scaled(matrix, albedo[c : c + 1], np.ascontiguousarray(light[..., c]))[0] for c in range(3)
    ]
    return np.stack(channels, axis=-1)


def _blocks(count: int, size: int, name: str, run: Run) -> Any:
    """Numbers of points, some at a time, with a progress bar."""
    with run.bar(count, name) as bar:
        for a in range(0, count, size):
            ids = np.arange(a, min(a + size, count))
            yield ids
            bar.update(len(ids))


def _by_depth(light: Floats, apart: int) -> ByDepth:
    """Light that met 1, 2, ... surfaces, side by side in the last axis."""
    return ByDepth(tuple(Dense(np.ascontiguousarray(one)) for one in np.split(light, apart, axis=2)))


def _result(direct: Floats | None, indirect: Operator | None, rays: dict[str, int]) -> MethodResult:
    seen = None if direct is None else Dense(direct)
    parts = {"direct": seen, "indirect": indirect}
    elements = {name: 0 if part is None else part.shape[0] * part.shape[1] for name, part in parts.items()}
    return MethodResult(seen, indirect, max(elements.values()), elements, rays)
