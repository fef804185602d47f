"""What interreflection by finite elements costs, and how far off it is, measured on a few vertices."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mi_sparse_prt.core.random_keys import element_seeds, random_stream
from mi_sparse_prt.core.sparse_product import multiply_sparse
from mi_sparse_prt.estimation.pilot_elements import PilotElements
from mi_sparse_prt.methods.plan import Plan
from mi_sparse_prt.reconstruction.gather_noise import OTHERS
from mi_sparse_prt.reconstruction.node_placement import node_count
from mi_sparse_prt.reconstruction.surface_smoothing import nearest_weights
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.first_bounce import USUAL
from mi_sparse_prt.solvers.form_factors import gather_matrix

GATHERED = 4  # spawn key
FEW, MANY = 64, 256  # rays per vertex of a pilot
PATHS = 256  # per element that tell a bias: fewer would see one of 0.5% where there is none
TIMED = 1024  # rays per vertex, where these are timed
SAMPLE = 256  # vertices, and as many texels, that tell the rank
FINE = 0.03  # tolerance below which a sample tells little
HALVES = 4  # of that sample: what half of it tells is a mean over so many
WIDTH = 64  # vectors at a time, for a timed product
BLOCK = 1024  # rows at a time, likewise
REPEATED = 32  # times the rows of G of a pilot
EXPANSION = 40  # multiplications that expanding an element of D takes as long as
SQUARES = 6  # products of a basis with itself: orthogonal ones are made of it before each bounce
COMBINED = 30e-9  # seconds for each number of the combinations that make a basis: most of it is new pages ...
BLOCKS = 192  # ... and as many of these are begun at least
DISTINCT = 1.2  # tolerances that are closer than this factor are as good as one
LEFT = 2.0  # times the noise of rays may be left out
AVERAGED = 128  # vertices whose neighbours tell what averaging between these leaves of the noise
SMOOTHED = 20e-6  # seconds of a node to find its neighbours for that, most of it for k-d trees
AVERAGING = 64  # additions per number of left factors: three levels of 12 neighbours, their shares and sums
LATER = 2  # bounces after the first one
GROUPS = 5  # of vertices, for a bias that a few of them do not decide

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class GatherCosts:
    """Cost and error for any number of rays per vertex and any tolerance of the rank.

    Attributes
    ----------
    vertices, nodes, directions, channels : int
    ray : float
        Seconds of a gather ray, among those of its vertex.
    multiplication : float
        Seconds of one of the multiplications of dense matrices.
    addition : float
        Seconds of an entry of G times one column.
    entries : float
        Of G, per ray.
    noise_of : dict
        Rays -> relative L2 error of the whole matrix.
    averaged, alike : float
        Of the square of the noise of 64 rays, what averaging between neighbours leaves, and what it would leave if
        these received the same light.
    bias : float
        That of interpolation between vertices, which no number of rays removes; a typical one.
    first : float
        Norm of the first bounce, relative to the whole matrix.
    growth : float
        How much larger the norm of all bounces is.
    spectra : (2, k) float
        Energy that is left of the first bounce beyond each rank, relative, in half the sample and in all of it.
    depths : int
        By how many numbers of surfaces light is told apart: each has rows and bounces of its own.
    """

    vertices: int
    nodes: int
    directions: int
    channels: int
    ray: float
    multiplication: float
    addition: float
    entries: float
    noise_of: dict[int, float]
    averaged: float
    alike: float
    bias: float
    first: float
    growth: float
    spectra: NDArray[np.float64]
    depths: int = 1

    def error(self, rays: int, tolerance: float, averaged: bool = True) -> float:
        """Predicted relative L2 error of the whole matrix.

        Of the first bounce's errors only the bias is carried on into the next ones: noise, and what a low rank leaves
        out, differ from vertex to vertex and are averaged by gathering.
        """
        noise, bias = self.noise(rays, averaged), self.growth * self.bias
        return math.sqrt(noise**2 + bias**2 + (tolerance * self.first) ** 2)

    def learned(self, plan: Plan, error: float) -> GatherCosts:
        """The same, after this error was found: the bias is what a pilot knows least."""
        known = self.error(plan.rays, plan.tolerance, plan.averaged) ** 2 - (self.growth * self.bias) ** 2
        return replace(self, bias=math.sqrt(max(error**2 - known, 0.0)) / self.growth)

    def noise(self, rays: int, averaged: bool = True) -> float:
        """Relative L2 error of the whole matrix that comes from the number of rays.

        What averaging between neighbours blurs is the same for any number of rays.
        """
        few, many = (max(self.noise_of[count], 1e-12) for count in (FEW, MANY))
        fall = math.log(few / many) / math.log(MANY / FEW)
        own = self.noise_of[MANY] * (MANY / rays) ** min(max(fall, 0.5), 1.0)
        blurred = max(self.averaged - self.alike, 0.0) * self.noise_of[FEW] ** 2
        return math.sqrt(min(own**2, blurred + self.alike * own**2)) if averaged else own

    def tolerances(self, rays: int, finest: float) -> tuple[float, ...]:
        """Tolerances of the rank to consider: the finest, and those that leave out as much as there is noise, or twice.

        Noise differs from vertex to vertex, and has the full rank: to keep more than it is to keep noise. Under
        foliage, 256 rays a vertex: 8% of noise take a rank of 1056 and 21 s, 15% one of 200 and 7 s, as near to 1024
        rays. Averaged between neighbours there is less of it, and more light to be told from it.
        """
        averaged, own = (self.noise(rays, how) / max(self.first, 1e-150) for how in (True, False))
        found = [finest]
        for tolerance in (round(averaged, 2), round(own, 2), round(LEFT * own, 2)):
            if DISTINCT * found[-1] < tolerance < 1:
                found.append(tolerance)
        return tuple(found)

    def rank(self, tolerance: float) -> float:
        """Predicted rank of the first bounce.

        A sample has a lower one than the matrix: where all is smooth by little, where surfaces are fine by much. It
        grows on as it did from half the sample on, the longer the more light may be lacking. Six scenes told how long;
        the ranks of these, above 65, are met within a factor of 2.4.
        """
        seen = max(tolerance, FINE)
        half, whole = (float(np.searchsorted(-x, -(seen**2))) for x in self.spectra)
        doublings = min(3 + math.log2(seen / FINE), 4.0)
        grown = whole * max(whole / max(half, 1.0), 1.0) ** doublings * (seen / tolerance) ** 0.4
        return min(grown, self.vertices, self.directions, USUAL.most)

    def seconds(self, rays: int, tolerance: float, averaged: bool = True) -> float:
        """Predicted time of rays and interreflections: the terms are the steps of ``solvers.first_bounce``."""
        nodes, rank, entries = self.nodes, self.rank(tolerance), rays * self.entries
        rows = max(USUAL.few_rows, USUAL.rows * rank)
        expanded = self.vertices * (self.directions + USUAL.mixed * rank)
        squares = SQUARES * nodes * rank**2 * self.channels
        dense = EXPANSION * expanded + rows * rank * self.directions * self.channels + squares
        bounces = nodes * entries * rank * (1 + LATER * self.channels)
        sparse = bounces + min(rows, nodes) * entries * self.directions * self.channels
        made = nodes * rays * self.ray + COMBINED * nodes * (rank + BLOCKS)
        if averaged:
            made += nodes * (SMOOTHED + min(rays, OTHERS) * self.ray)
            sparse += nodes * AVERAGING * rank * self.channels
        return made + self.depths * (self.multiplication * dense + self.addition * sparse)


def gather_costs(
    direct: DirectSolver, held: PilotElements, seed: int | np.random.SeedSequence
) -> GatherCosts:
    """Measure at the vertices of the held-out elements; what mirrors and glass add is left out, as from the paths.

    Parameters
    ----------
    direct : DirectSolver
        At all vertices.
    held : PilotElements
        With indirect light.
    seed : int or SeedSequence
    """
    assert held.indirect is not None
    scene, stream = direct.problem.scene, random_stream(seed, GATHERED)
    pilot, seeds = _Pilot(direct, held.vertices), element_seeds(stream, 2)
    few, many = ([pilot.rays(count, k) for k in seeds] for count in (FEW, MANY))
    light = [[pilot.light(rays, held.texels) for rays in pair] for pair in (few, many)]
    noise = [held.relative_square(held.weighted((a - b) ** 2 / 2)) for a, b in light]
    first = held.paths(3, PATHS)
    sizes = [held.share(light) for light in (first, held.indirect)]
    bias = _typical(held, (light[1][0] - first.values[0]) * (light[1][1] - first.values[1]))
    multiplication, addition = _seconds_of_products(direct, many[0])
    # what does not grow with their number, an array of all vertices for one, is in both
    times = [_least_seconds(partial(pilot.rays, count, seeds[0])) for count in (FEW, TIMED)]
    ray = max(times[1] - times[0], 0.0) / ((TIMED - FEW) * len(held.vertices))
    return GatherCosts(
        scene.n_vertices,
        node_count(scene),
        direct.lighting.n_directions,
        light[0][0].shape[2],
        ray,
        multiplication,
        addition,
        len(many[0].data) / (MANY * len(held.vertices)),
        dict(zip((FEW, MANY), np.sqrt(noise).tolist(), strict=True)),
        *_averaging(direct, held, seeds, stream),
        math.sqrt(max(bias, 0.0)),
        sizes[0],
        max(sizes[1] / max(sizes[0], 1e-150), 1.0),
        pilot.spectra(stream),
        max(1, direct.problem.depths_apart),
    )


def _averaging(
    direct: DirectSolver, held: PilotElements, seeds: Sequence[int], stream: np.random.SeedSequence
) -> tuple[float, float]:
    """What averaging between neighbours leaves of the square of the noise of few rays, and if these were alike.

    As ``reconstruction.gather_noise`` has it, of whose levels of smoothing this is the first. Half of the texels say
    where it is worth it, the others how much.
    """
    rng, count = np.random.default_rng(stream), len(held.vertices)
    chosen = np.sort(
        rng.choice(count, min(count, AVERAGED), replace=False, p=held.stand_for / held.stand_for.sum())
    )
    weights, seen = nearest_weights(direct.problem.scene, direct.points, held.vertices[chosen])
    pilot, texels = _Pilot(direct, seen), np.unique(held.texels[chosen])
    texels = np.sort(rng.choice(texels, min(len(texels), held.texels.shape[1]), replace=False))
    asked = np.tile(texels, (len(seen), 1))
    x, y = (pilot.light(pilot.rays(FEW, seed), asked).reshape(len(seen), -1) for seed in seeds)
    own = np.searchsorted(seen, held.vertices[chosen])
    noise = np.square(x[own] - y[own]) / 2
    if not noise.any():
        return 1.0, 1.0
    blurred = sum(np.square(weights @ a - b[own]) for a, b in ((x, y), (y, x))) / 2 - noise
    alike = np.asarray(weights.power(2).sum(axis=1))
    left = np.zeros(2)
    for judges, judged in ((slice(0, None, 2), slice(1, None, 2)), (slice(1, None, 2), slice(0, None, 2))):
        better = blurred[:, judges].sum(axis=1) < noise[:, judges].sum(axis=1)
        rest = noise[:, judged].sum(axis=1)
        left += np.where(better, [blurred[:, judged].sum(axis=1), alike * rest], rest).sum(axis=1)
    averaged, even = np.clip(left / noise.sum(), 0.0, 1.0)
    return float(averaged), float(min(even, averaged))


def _typical(held: PilotElements, squares: NDArray[np.float64]) -> float:
    """Median, over groups of vertices, of squares (k, t, channels) of unit-albedo transport relative to the matrix.

    Interpolation errs much at few places. Where one of these is among the vertices, the mean says that no number of
    rays is enough, and a plan of hours follows. A plan that turns out to be not good enough costs seconds.
    """
    group, weighted = np.arange(len(squares))[:, None] % GROUPS, held.weighted(squares)
    shares = [held.relative_square(np.where(group == g, weighted, 0.0)) for g in range(GROUPS)]
    return GROUPS * float(np.median(shares))


def _seconds_of_products(direct: DirectSolver, rays: scipy.sparse.csr_array) -> tuple[float, float]:
    """Seconds of a multiplication and addition: of dense matrices, and of rows of G times some columns."""
    rng = np.random.default_rng(0)
    block = rng.random((BLOCK, direct.lighting.n_directions), np.float32)
    mixing = rng.random((direct.lighting.n_directions, WIDTH), np.float32)
    light = rng.random((len(direct.points), WIDTH), np.float32)
    rows = scipy.sparse.vstack([rays] * REPEATED, format="csr")
    dense = _least_seconds(lambda: block @ mixing) / (WIDTH * block.size)
    sparse = _least_seconds(lambda: multiply_sparse(rows, light)) / (WIDTH * max(rows.nnz, 1))
    return dense, sparse


def _least_seconds(work: Callable[[], object]) -> float:
    """The least of three times: what else happens on a machine only adds to it."""
    return min(_seconds(work) for _ in range(3))


def _seconds(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


class _Pilot:
    """Gathers light at some vertices of a scene."""

    def __init__(self, direct: DirectSolver, vertices: NDArray[np.integer]) -> None:
        scene = direct.problem.scene
        self._scene, self._direct, self._vertices = scene, direct, vertices
        self._albedo = scene.sent_albedo[:, : 1 if scene.grey else 3]

    def rays(self, count: int, seed: int) -> scipy.sparse.csr_array:
        """Rows of G."""
        depth = self._direct.problem.max_depth
        return gather_matrix(self._scene, self._direct.points, count, seed, self._vertices, depth)

    def light(self, rays: scipy.sparse.csr_array, texels: NDArray[np.integer]) -> NDArray[np.float64]:
        """The first bounce (k, t, channels) of unit-albedo transport at t texels (k, t) of each vertex."""
        row = np.repeat(np.arange(len(texels)), np.diff(rays.indptr))
        asked = texels[row]  # [entry, texel]
        vertices = np.repeat(rays.indices, asked.shape[1])
        seen = self._direct.elements(vertices, asked.ravel()).reshape(asked.shape)
        mean = scipy.sparse.csr_array(
            (rays.data, np.arange(len(row)), rays.indptr), shape=(len(texels), len(row))
        )
        reflected = seen[:, :, None] * self._albedo[rays.indices][:, None]  # [entry, texel, channel]
        # where rays find nothing, there are no entries to count it by
        size = texels.shape[1] * self._albedo.shape[1]
        return (mean @ reflected.reshape(len(row), size)).reshape(*texels.shape, -1).astype(np.float64)

    def spectra(self, stream: np.random.SeedSequence) -> NDArray[np.float64]:
        """Energy of the first bounce beyond each rank, relative, in half a sample and in all of it (2, k)."""
        n, rng = self._direct.lighting.n_directions, np.random.default_rng(stream)
        texels = rng.choice(n, min(n, SAMPLE), replace=False)
        vertices = rng.choice(len(self._albedo), min(len(self._albedo), SAMPLE), replace=False)
        sample = _Pilot(self._direct, vertices)
        light = sample.light(
            sample.rays(FEW, element_seeds(stream, 1)[0]), np.tile(texels, (len(vertices), 1))
        )[:, :, 0]
        halves = [np.array_split(rng.permutation(k), 2)[0] for k in light.shape * HALVES]
        some = [_beyond(light[np.ix_(*pair)]) for pair in zip(halves[::2], halves[1::2], strict=True)]
        whole = _beyond(light)
        half = np.mean(some, axis=0)
        return np.stack([np.pad(half, (0, len(whole) - len(half))), whole])


def _beyond(light: NDArray[np.float64]) -> NDArray[np.float64]:
    """Energy beyond each rank, relative; by eigenvalues, which take a quarter of the time of singular values."""
    gram = light @ light.T if len(light) < light.shape[1] else light.T @ light
    squares = np.maximum(np.linalg.eigvalsh(gram)[::-1], 0.0)
    total = float(squares.sum())
    return 1 - np.cumsum(squares) / total if total > 0 else np.zeros(len(squares))
