"""Random elements of T on which ways to compute a matrix are tried before there is one."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.random_keys import element_seeds, random_stream
from mi_sparse_prt.estimation.darkness import unoccluded_squares
from mi_sparse_prt.operators.fractional_visibility import FractionalVisibility
from mi_sparse_prt.scene.scene import TOGETHER, Scene
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.paths import PathSolver
from mi_sparse_prt.solvers.problem import Problem

PILOT = 2  # spawn key
SPP = 64
STRATA = 4  # shadow rays per axis of a texel
DIM = 0.1  # of unoccluded light, below which elements may miss most: a hole in a wall is a texel or two of a row

Values = NDArray[np.floating]


def vertices_of_each(scene: Scene, count: int) -> int:
    """How many vertices of each mesh are about so many in all; of many meshes, of each of ``TOGETHER``."""
    parts = len(scene.sampled_together)
    return max(1, count // (parts if parts == len(scene.meshes) else parts * TOGETHER))


@dataclass(frozen=True)
class Halves:
    """A part of unit-albedo transport at some elements, twice, independently of each other.

    Attributes
    ----------
    values : (2, k, t, channels) float64
        At t texels of k vertices.
    variance : (k, t, channels) float64
        Of one sample: a path, or what a pixel of it would be. 0 where a ray tells all.
    seconds : float
        What a sample costs, among scattered elements.
    """

    values: NDArray[np.float64]
    variance: NDArray[np.float64]
    seconds: float = 0.0


class PilotElements:
    """Random elements of T, evaluated twice, independently of each other and of any matrix.

    With the two values X and Y, the mean of (T - X)(T - Y) estimates the squared error of a matrix T without the
    noise of X and Y, and that of X Y the squared norm.

    Parameters
    ----------
    problem : Problem
        At vertices; at other points, these are drawn from all together, as are the vertices of a mesh.
    indirect : bool
        Whether there is indirect light.
    seed : int or SeedSequence
        Elements and their random numbers are drawn from it, and differ from those of a matrix of the same seed.
    vertices_per_mesh, texels_per_vertex : int
        Of many meshes, as many vertices as of ``TOGETHER``, drawn from all together.

    Attributes
    ----------
    vertices : (k,) integers
        Sorted; of all meshes.
    stand_for : (k,) float64
        How many vertices of the scene each stands for.
    texels : (k, t) integers
        Texels held out at each vertex.
    direct : Halves
        One channel.
    indirect : Halves or None
    """

    def __init__(
        self,
        problem: Problem,
        indirect: bool,
        seed: int | np.random.SeedSequence,
        vertices_per_mesh: int = 256,
        texels_per_vertex: int = 32,
    ) -> None:
        self.problem, self.lighting, scene, lighting = (
            problem,
            problem.emission,
            problem.scene,
            problem.emission,
        )
        stream = random_stream(seed, PILOT)
        self._seeds, rng = element_seeds(stream, 4), np.random.default_rng(stream)
        apart = problem.measurement.kind == "vertices"
        strata = scene.sampled_together if apart else (slice(0, len(problem.points)),)
        most = vertices_per_mesh * (TOGETHER if apart and len(strata) < len(scene.meshes) else 1)
        sizes = [part.stop - part.start for part in strata]
        chosen = [
            part.start + np.sort(rng.choice(size, min(size, most), replace=False))
            for part, size in zip(strata, sizes, strict=True)
        ]
        counts = [len(ids) for ids in chosen]
        self.vertices = np.concatenate(chosen)
        self.stand_for = np.repeat(np.divide(sizes, counts), counts)
        n, t = lighting.n_directions, min(lighting.n_directions, texels_per_vertex)
        self.texels = np.stack([rng.choice(n, t, replace=False) for _ in self.vertices])
        albedo = (
            scene.albedo if apart else problem.reflection.albedo
        )  # of glossy vertices all that they reflect
        self._albedo = albedo[self.vertices][:, None].astype(np.float64)  # [vertex, 1, rgb]
        self.direct = self._direct()
        self.indirect = self.paths(problem.max_depth) if indirect else None
        whole = self.direct.values + (self.indirect.values if self.indirect else 0)
        self._norm = self._total(self._squares(*whole))
        self._direct_norm = self._total(self._squares(*self.direct.values))
        if self.light() < DIM:
            exact = self._direct_norm_of_rows()
            self._norm += exact - self._direct_norm
            self._direct_norm = exact

    def shares_of(self, count: int) -> NDArray[np.int64]:
        """How often each vertex (k,) is among so many that stand for all vertices alike."""
        ends = np.rint(np.cumsum(self.stand_for) / self.stand_for.sum() * count).astype(np.int64)
        return np.diff(ends, prepend=0)

    def paths(self, max_depth: int, spp: int = SPP) -> Halves:
        """Indirect light at these elements, up to some depth."""
        solver, seeds = PathSolver(replace(self.problem, max_depth=max_depth), spp), self._seeds[2:]
        power = self.lighting.solid_angles[self.texels][..., None].astype(np.float64)
        values, variance = [], np.zeros(())
        for seed in seeds:
            start = time.perf_counter()  # that of the second time: the first one may have had to compile
            found = solver.elements(*self._flat, seed)
            seconds = (time.perf_counter() - start) / (self.texels.size * spp)
            mean, square = (x.reshape(*self.texels.shape, -1) for x in (found.mean, found.variance))
            values.append(mean * power)
            variance = variance + square * power**2 * spp / len(seeds)
        return Halves(np.stack(values), variance, seconds)

    def relative_square(self, values: Values) -> float:
        """Sum over the whole matrix of a quantity known at the held-out elements, (k, t), over its squared norm."""
        return self._total(values) / max(self._norm, 1e-300)

    def share(self, part: Halves) -> float:
        """Norm of a part relative to that of the whole matrix."""
        return math.sqrt(max(self.relative_square(self._squares(*part.values)), 0.0))

    def squared_error(self, elements: Values) -> NDArray[np.float64]:
        """Unbiased squared errors (k, t) of single elements (k, t, 3), summed over channels."""
        x, y = self._albedo * (self.direct.values + (self.indirect.values if self.indirect else 0))
        return ((elements - x) * (elements - y)).sum(axis=2)

    def light(self) -> float:
        """Norm of the matrix relative to what it would be if nothing was in the way."""
        rows = unoccluded_squares(self._albedo[:, 0], self.lighting) / self.lighting.n_directions
        return math.sqrt(max(self._norm, 0.0) / max(float(self.stand_for @ rows), 1e-300))

    @property
    def direct_share(self) -> float:
        """Norm of direct light relative to that of the whole matrix."""
        return math.sqrt(max(self._direct_norm, 0.0) / max(self._norm, 1e-300))

    def error_of(self, part: Halves, unit_albedo: Values) -> NDArray[np.float64]:
        """What a part's unit-albedo transport (k, t, channels) adds to the squared errors (k, t), without bias."""
        return self._squares(*(unit_albedo - part.values))

    def errors_of_shares(self, part: FractionalVisibility) -> NDArray[np.float64]:
        """Squared errors (k, t) of direct light by what the pilot's points see of texels."""
        places = np.repeat(np.arange(len(self.vertices)), self.texels.shape[1])
        ours = part.elements(places, self.texels.ravel()).reshape(*self.texels.shape, 1)
        return self.error_of(self.direct, ours)

    def squared_error_of_shares(self, part: FractionalVisibility) -> float:
        """That of direct light, over the squared norm of the matrix."""
        return max(self.relative_square(self.errors_of_shares(part)), 0.0)

    def weighted(self, squares: Values) -> NDArray[np.float64]:
        """Squares (k, t, channels) of unit-albedo transport as those of T, (k, t), summed over channels."""
        return (self._albedo**2 * squares).sum(axis=2)

    def _squares(self, x: Values, y: Values) -> NDArray[np.float64]:
        return self.weighted(x * y)

    def _direct(self) -> Halves:
        """Direct light; in the direction basis a ray tells all."""
        solver = DirectSolver(self.problem, STRATA)
        first, second = (
            solver.elements(*self._flat, seed).reshape(*self.texels.shape, 1) for seed in self._seeds[:2]
        )
        values = np.stack([first, second]).astype(np.float64)
        return Halves(values, np.zeros_like(values[0]))

    def _direct_norm_of_rows(self) -> float:
        """As of the elements, but from all texels."""
        count = self.lighting.n_directions
        asked = np.repeat(self.vertices, count), np.tile(np.arange(count), len(self.vertices))
        rows = DirectSolver(self.problem).elements(*asked).reshape(-1, count, 1)
        return self._total(self._squares(rows, rows))

    @property
    def _flat(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        return np.repeat(self.vertices, self.texels.shape[1]), self.texels.ravel()

    def _total(self, values: Values) -> float:
        """Of a quantity known at the held-out elements, (k, t), the sum over all vertices of its mean over texels."""
        return float(self.stand_for @ values.mean(axis=1))
