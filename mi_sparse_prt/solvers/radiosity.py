"""S_i by finite elements: light that surfaces gather from each other ([Leh07] 2.5, eq. 18-21).

Diffuse light is known at the vertices and interpolated on the triangles between. One bounce is then a sparse matrix G:
its row i is the mean over cosine-distributed rays from vertex i of what they find at their other end. The indirect part
of unit-albedo transport is the Neumann series X = G rho D + G rho G rho D + ..., D the direct part and rho the albedo.

Indirect light is smooth. Where a scene has more vertices than it needs, G has rows at some of them only, the nodes, and
others take their light from these: X = W (G rho D + G rho W G rho D + ...). D and rho stay those of all vertices.

Where surfaces are seen by way of mirrors or glass, light is told apart by how many surfaces it met, as ``max_depth``
counts them all: X_s = sum over k < s of G_k rho (E_(s-1-k) + X_(s-1-k)), G_k being the form factors after k of those,
and E_t the light that arrives after t of them (E_0 = D). The first bounces of all s are rows of one matrix.

G also blurs the shadows' edges in D: what is left has a low rank, and ``RadiositySolver.indirect`` computes few of its
columns and rows (``first_bounce``). Later bounces are those of its singular vectors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mi_sparse_prt.core.bits import BITS
from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.core.random_keys import mix
from mi_sparse_prt.core.sparse_product import Sparse, add_scaled, multiply_scaled, multiply_sparse
from mi_sparse_prt.operators.by_depth import ByDepth
from mi_sparse_prt.operators.column_blocks import ColumnBlocks, combine_randomly
from mi_sparse_prt.operators.low_rank import LowRank
from mi_sparse_prt.operators.operator import Operator
from mi_sparse_prt.operators.sparse_rows import SparseRows
from mi_sparse_prt.operators.sum import Sum
from mi_sparse_prt.solvers.first_bounce import (
    FirstBounce,
    RandomBasis,
    ReflectedLight,
    all_but_least,
    first_bounce,
    of_channel,
)
from mi_sparse_prt.solvers.form_factors import gather_matrix
from mi_sparse_prt.solvers.problem import Problem
from mi_sparse_prt.solvers.specular_chains import specular_form_factors
from mi_sparse_prt.solvers.stacked import Stacked, StackedFormFactors
from mi_sparse_prt.solvers.surface_nodes import Nodes

COLUMNS = 256  # of a dense matrix that G is applied to at a time
NEGLIGIBLE = 1e-3  # light, relative to all, that later bounces may lack at any vertex
JUDGED = 2  # times 32 sums of columns tell the noise of rays
LONGEST = 1024  # bounces after which light is taken not to end
ROWS = 1 << 10  # whose squares are summed up at a time

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]


@dataclass(frozen=True)
class Gathered(LowRank):
    """Indirect light, and how it was found.

    Attributes
    ----------
    left_out : float
        Estimated relative L2 error of the first bounce, for its low rank alone.
    bounces : int
        Interreflections that were added up.
    """

    left_out: float
    bounces: int


@dataclass(frozen=True)
class LowRankOptions:
    """How indirect light for all texels is factored.

    Attributes
    ----------
    basis : RandomBasis
        Of the first bounce.
    later : float
        Of the squared tolerance: what a later bounce may leave out of the light that it starts from.
    """

    basis: RandomBasis = RandomBasis()
    later: float = 0.25


@dataclass(frozen=True)
class GatheredByDepth(ByDepth):
    """Indirect light told apart by how many surfaces it met, and how it was found.

    Attributes
    ----------
    left_out : float
        Estimated relative L2 error of first bounces, for their low rank alone.
    """

    terms: tuple[LowRank, ...]
    left_out: float

    @property
    def ranks(self) -> tuple[int, ...]:
        """Of each channel, the largest of all depths."""
        return tuple(max(some) for some in zip(*(term.ranks for term in self.terms), strict=True))

    @property
    def bounces(self) -> int:
        """Surfaces that light may have met."""
        return len(self.terms)


class Averaging(Protocol):
    """Averages out noise of rays between neighbouring nodes (``reconstruction.gather_noise``)."""

    def judge(self, matrix: Sparse, light: Floats) -> None: ...

    def averaged(self, light: Floats) -> Floats: ...


class FiniteElements:
    """Interreflections between vertices, or whatever else rows of light stand for.

    Parameters
    ----------
    matrices : sequence of sequences of (n_nodes, n) sparse float32, the first ones may be kept as products
        G_0, G_1, ... of each channel, or of all: form factors after so many specular surfaces; where light is not told
        apart by depth, only their sum counts.
    albedo : (channels, n) float32
    keys : (n,) uint64
        Random numbers are made of them.
    nodes : Nodes
        Those that gather light, others interpolate theirs.
    max_depth : int
        As Mitsuba's ``path`` counts it: 3 = one interreflection, -1 = no limit. Bounces that add next to
        nothing are left out.
    seed : int

    Attributes
    ----------
    matrix : (n_nodes, n) sparse float32
        G, the sum of all; of the first channel, if each has its own.
    options : LowRankOptions
    weights : (n_nodes,) float32 or None
        What errors of rows count by in a low rank, above 0; None where all are alike.
    averaging : Averaging or None
        Of the noise of rays in indirect light for all texels, of which the first rows are vertices.
    """

    weights: Floats | None = None
    averaging: Averaging | None = None

    def __init__(
        self,
        matrices: Sequence[Sequence[Sparse]],
        albedo: Floats,
        keys: NDArray[np.uint64],
        nodes: Nodes,
        max_depth: int,
        seed: int,
    ) -> None:
        self._matrices, self._albedo, self._keys, self.nodes = matrices, albedo, keys, nodes
        self.max_depth, self.seed = max_depth, seed
        self.channels, self.options = len(albedo), LowRankOptions()

    @property
    def matrix(self) -> Sparse:
        return self._sums[0]

    @cached_property
    def _sums(self) -> list[Sparse]:
        """G of each channel, or of all."""
        return [sum(others, first) for first, *others in self._matrices]

    def apply(self, columns: Floats) -> Floats:
        """Indirect light under a few lights, without approximation.

        Parameters
        ----------
        columns : (n_v, k) float32
            Unit-albedo direct transport of each light.

        Returns
        -------
        (n_v, k, channels) float32
            Unit-albedo indirect transport.
        """
        result = np.zeros((*columns.shape, self.channels), np.float32)
        count = self.bounces(columns.sum(axis=1))
        for a in range(0, columns.shape[1] if count else 0, COLUMNS):
            part = slice(a, a + COLUMNS)
            light = self._gathered(columns[:, part])
            totals = light
            for _ in range(count - 1):
                light = self._reflected(light)
                totals = [total + x for total, x in zip(totals, light, strict=True)]
            result[:, part] = np.stack([self.nodes.interpolate(total) for total in totals], axis=-1)
        return result

    def apply_coloured(self, columns: Floats) -> Floats:
        """Indirect light (n_v, k, 3) under a few coloured lights (n_v, k, 3), without approximation."""
        result = np.zeros_like(columns)
        count = self.bounces(columns.sum(axis=1).max(axis=1))
        for c in range(3 if count else 0):
            light = self._reflect_one(c, np.ascontiguousarray(columns[..., c]))
            total = light.copy()
            for _ in range(count - 1):
                light = self._reflect_one(c, self.nodes.interpolate(light))
                total += light
            result[..., c] = self.nodes.interpolate(total)
        return result

    def rows(self, direct: Operator, ids: NDArray[np.integer]) -> Floats:
        """Indirect light of a few vertices, without approximation: bounces in reverse ([Leh07] 2.6).

        Parameters
        ----------
        direct : Operator
            The direct part of the matrix, with a row for each vertex.
        ids : (k,) integers

        Returns
        -------
        (k, n_directions, channels) float32
            Unit-albedo indirect transport.
        """
        count = self._count_for(direct)
        totals = [self._adjoint(c, np.asarray(ids), count) for c in range(self.channels)]
        result = np.empty((len(ids), direct.shape[1], self.channels), np.float32)
        for texels, light in ColumnBlocks(direct):
            for c, weights in enumerate(totals):
                result[:, texels, c] = weights.T @ light
        return result

    def _adjoint(self, channel: int, ids: NDArray[np.integer], count: int) -> Floats:
        """Weights (n_v, k) of all vertices' direct light in the indirect light of some."""
        rho, transposed = self._albedo[channel], of_channel(self._transposed, channel)
        weights = np.zeros((len(rho), len(ids)), np.float32)
        weights[ids, np.arange(len(ids))] = 1
        total = np.zeros_like(weights)
        for _ in range(count):
            weights = rho[:, None] * multiply_sparse(transposed, self.nodes.interpolate_adjoint(weights))
            total += weights
        return total

    @cached_property
    def _transposed(self) -> list[scipy.sparse.csr_array]:
        return [matrix.tocsr().T.tocsr() for matrix in self._sums]

    def indirect(
        self, direct: Operator, tolerance: float = 0.03, specular: Operator | None = None
    ) -> Gathered | GatheredByDepth:
        """Indirect light for all texels, factored.

        Parameters
        ----------
        direct : Operator
            The direct part of the matrix, with a row for each vertex.
        tolerance : float
            Relative L2 error of the first bounce that a low rank may cost; later bounces are smoother and lose less.
        specular : Operator, optional
            Light by way of mirrors and glass, which surfaces reflect as well; no horizon hides it.

        Returns
        -------
        Gathered or GatheredByDepth
            The latter if ``specular`` is told apart by depth.
        """
        if specular is not None and specular.by_depth:
            return self._by_depth((direct, *specular.by_depth[:-1]), tolerance)
        count = self._count_for(direct if specular is None else Sum((direct, specular)))
        if count == 0:
            left = np.zeros((self._albedo.shape[1], 0), np.float32)
            right = np.zeros((0, direct.shape[1]), np.float32)
            return Gathered((left,) * self.channels, (right,) * self.channels, 0.0, 0)
        lights = [direct] if specular is None else _with_specular(direct, specular)
        reflected = ReflectedLight(
            [StackedFormFactors([matrix]) for matrix in self._sums],
            self._coloured(len(lights)),
            lights,
            self._keys[self.nodes.ids],
            self.weights,
        )
        first = first_bounce(reflected, tolerance, self.seed, self.options.basis)
        totals = self._all_bounces(first, count, self.options.later * tolerance**2)
        self._judge_noise([of_channel(lights, 1)], count)
        spread = tuple(self._spread(total) for total in totals)
        return Gathered(spread, first.right, first.left_out, count)

    def _judge_noise(self, lights: Sequence[Operator], count: int) -> None:
        """By random sums of columns, of one channel: of light that arrives, and of what surfaces send on of it."""
        if self.averaging is None:
            return
        light, rng = Sum(tuple(lights)), np.random.default_rng(self.seed)
        sums = [np.empty((light.shape[0], min(BITS, light.shape[1])), np.float32) for _ in range(JUDGED)]
        for some in sums:
            combine_randomly(light, self.options.basis.mixed, rng, some)
        # G_0 alone: what is sent on by way of mirrors is spread as widely, and the sum of all is large
        matrix, rho = of_channel(self._matrices, 1)[0], of_channel(self._albedo, 1)[None]
        total = sent = np.hstack(sums)
        for _ in range(count - 1):
            sent = self.nodes.interpolate(multiply_scaled(matrix, rho, sent)[0])
            total = total + sent
        self.averaging.judge(matrix, total)

    def _spread(self, light: Floats) -> Floats:
        """Light (n_nodes, k) of the nodes, with less noise, at all vertices."""
        return self.nodes.interpolate(light if self.averaging is None else self.averaging.averaged(light))

    def _coloured(self, colours: int) -> Floats:
        """Albedos (channels, n), of each of three colours if light has so many."""
        return self._albedo[np.minimum(np.arange(max(colours, self.channels)), self.channels - 1)]

    def _by_depth(self, lights: Sequence[Operator], tolerance: float) -> GatheredByDepth:
        """Indirect light that met 1, 2, ... surfaces, from light E_0, E_1, ... that met as many specular ones."""
        count, colours = len(lights), max(light.shape[2] for light in lights)
        lit = [t for t, light in enumerate(lights) if t == 0 or not _is_dark(light)]
        albedo = self._coloured(colours)
        stacks = [Stacked(tuple(_channel(lights[t], c) for t in lit)) for c in range(colours)]
        keys = self._keys[self.nodes.ids]
        reflected = ReflectedLight(
            [StackedFormFactors(own, lit, count) for own in self._matrices],
            np.tile(albedo, len(lit)),
            stacks,
            np.concatenate([mix(keys + np.uint64(s)) if s else keys for s in range(count)]),
            None if self.weights is None else np.tile(self.weights, count),
        )
        first = first_bounce(reflected, tolerance, self.seed, self.options.basis)
        light = [np.split(x, count) for x in first.left]  # [channel][depth]
        sizes = [np.square(right).sum(axis=1, dtype=np.float64) for right in first.right]
        energies = [sum(map(self._energies, x)) * size for x, size in zip(light, sizes, strict=True)]
        least = self.options.later * tolerance**2 * sum(float(e.sum()) for e in energies)
        for s in range(1, count):
            for k in range(s):
                self._reflect(light, s - 1 - k, k, albedo, sizes, least / count)
        self._judge_noise([_channel(light, 1) for light in lights], count)
        return GatheredByDepth(self._terms(light, sizes, first.right, least), first.left_out)

    def _energies(self, x: Floats) -> NDArray[np.float64]:
        """Of each column. Some rows at a time: new pages would take longer than the sums."""
        total = np.zeros(x.shape[1])
        for a in range(0, len(x), ROWS):
            own = x[a : a + ROWS]
            if self.weights is not None:
                own = own * self.weights[a : a + ROWS, None]
            total += np.square(own).sum(axis=0, dtype=np.float64)
        return total

    def _reflect(
        self,
        light: list[list[Floats]],
        depth: int,
        met: int,
        albedo: Floats,
        sizes: list[Doubles],
        least: float,
    ) -> None:
        """Add what light of a depth, the first being 0, becomes by one bounce and some specular surfaces after it."""
        energies = [self._energies(x[depth]) * size for x, size in zip(light, sizes, strict=True)]
        for c, (x, rho, kept) in enumerate(zip(light, albedo, all_but_least(energies, least), strict=True)):
            matrix, after = of_channel(self._matrices, c)[met], x[depth + 1 + met]
            # the longest come first: all up to the last one that is kept, which is faster than to pick some
            if width := int(np.flatnonzero(kept)[-1]) + 1 if kept.any() else 0:
                some = self.nodes.interpolate(np.ascontiguousarray(x[depth][:, :width]))
                add_scaled(matrix, rho[None], some, after[None], 0)

    def _terms(
        self, light: list[list[Floats]], sizes: list[Doubles], right: Sequence[Floats], least: float
    ) -> tuple[LowRank, ...]:
        """Low ranks of each depth: singular vectors are left out of which it has next to nothing."""
        every = [self._energies(x) * size for own, size in zip(light, sizes, strict=True) for x in own]
        kept = iter(all_but_least(every, least))
        channels = []
        for own, b in zip(light, right, strict=True):
            some = [(x, next(kept)) for x in own]
            channels.append([(self._spread(np.ascontiguousarray(x[:, k])), b[k]) for x, k in some])
        depths = zip(*channels, strict=True)
        return tuple(LowRank(tuple(a for a, _ in some), tuple(b for _, b in some)) for some in depths)

    def _all_bounces(self, first: FirstBounce, count: int, expendable: float) -> list[Floats]:
        """The left factors after ``count`` bounces.

        Later ones need fewer singular vectors: before each, those are left out of which all together had this share
        of the first one's energy.
        """
        sizes = [np.square(right).sum(axis=1, dtype=np.float64) for right in first.right]
        least = expendable * sum(self._energies(x) @ size for x, size in zip(first.left, sizes, strict=True))
        totals, light = [x.copy() for x in first.left], list(first.left)
        at = [np.arange(len(size)) for size in sizes]
        for _ in range(count - 1):
            energies = [self._energies(x) * size[i] for x, size, i in zip(light, sizes, at, strict=True)]
            kept = all_but_least(energies, least)
            at = [i[k] for i, k in zip(at, kept, strict=True)]
            light = self._reflected([x[:, k] for x, k in zip(light, kept, strict=True)])
            for total, i, x in zip(totals, at, light, strict=True):
                total[:, i] += x
        return totals

    def _count_for(self, direct: Operator) -> int:
        return self.bounces(direct.relight(np.ones((direct.shape[1], 3), np.float32))[:, 0])

    def bounces(self, even: Floats) -> int:
        """How many interreflections count for anything.

        No light is negative: what a bounce adds under all lights together bounds what it adds under each.

        Parameters
        ----------
        even : (n_v,) float32
            Direct light for all lights together: the sums of D's rows.

        Raises
        ------
        PrtError
            If ``max_depth`` is -1 and light does not end, between white surfaces that let none escape.
        """
        total, count = 0.0, 0
        light = self._gathered(even[:, None])
        while self.max_depth < 0 or count < self.max_depth - 2:
            peak = max(float(x.max(initial=0)) for x in light)
            if peak == 0:
                break
            count, total = count + 1, total + peak
            if peak * self._reach <= NEGLIGIBLE * total:
                break
            if self.max_depth < 0 and np.isinf(self._reach):
                raise PrtError(
                    "max_depth -1: light between white surfaces does not end; give a max_depth or lower the albedo"
                )
            light = self._reflected(light)
        return count

    @cached_property
    def _reach(self) -> float:
        """Bound of G rho + (G rho)^2 + ... in the maximum norm, by the albedo and by what escapes."""
        light = [np.ones((len(self.nodes), 1), np.float32)] * self.channels
        total = 0.0
        for _ in range(LONGEST):
            light = self._reflected(light)
            peak = max(float(x.max(initial=0)) for x in light)
            total += peak
            if peak <= 0.5:  # as many bounces more add at most this share of these, and so on
                return total / (1 - peak)
        return np.inf

    def _reflected(self, light: list[Floats]) -> list[Floats]:
        """One bounce: G rho W x for arrays x (n_nodes, any), one per channel."""
        return [self._reflect_one(c, self.nodes.interpolate(x)) for c, x in enumerate(light)]

    def _reflect_one(self, channel: int, light: Floats) -> Floats:
        """G rho x of one channel, for light x (n, any)."""
        rho = of_channel(self._albedo, channel)[None]
        return multiply_scaled(of_channel(self._sums, channel), rho, light)[0]

    def _gathered(self, light: Floats) -> list[Floats]:
        """G rho x of each channel, for the same light x (n, any)."""
        if len(self._sums) == 1:
            return list(multiply_scaled(self.matrix, self._albedo, light))
        return [self._reflect_one(c, light) for c in range(self.channels)]


class RadiositySolver(FiniteElements):
    """Indirect light at the vertices of a scene.

    Parameters
    ----------
    problem : Problem
        At the vertices. Bounces that add next to nothing are left out. Where surfaces touch, the texels of a cubemap
        are looked at; lamps are not.
    rays_per_vertex : int
        A power of two: Sobol points, scrambled for each vertex by its key.
    seed : int
    nodes : Nodes, optional
        The vertices that gather light, others interpolate theirs; all if not given.
    options : LowRankOptions, optional
    averaging : Averaging, optional
        As for ``FiniteElements``.

    Attributes
    ----------
    nodes : Nodes
    matrix : (n_nodes, n_v) sparse float32
        G. Rows sum to the share of the hemisphere, by cosine, in which sheets of surfaces are seen that have vertices.
    channels : {1, 3}
        1 in a grey scene.
    rays : int
        That were traced.

    Notes
    -----
    Surfaces that scatter light into single directions are followed; others that are not diffuse count as diffuse, of
    the same albedo.
    """

    def __init__(
        self,
        problem: Problem,
        rays_per_vertex: int = 256,
        seed: int = 0,
        nodes: Nodes | None = None,
        options: LowRankOptions | None = None,
        averaging: Averaging | None = None,
    ) -> None:
        scene, points = problem.scene, problem.points
        nodes = nodes or Nodes(np.arange(len(points)), None)
        super().__init__(
            [form_factors(problem, rays_per_vertex, seed, nodes.ids)],
            np.ascontiguousarray(scene.sent_albedo.T[: problem.channels]),
            points.keys,
            nodes,
            problem.max_depth,
            seed,
        )
        self.options, self.averaging = options or self.options, averaging
        self.rays = len(nodes) * rays_per_vertex
        self._scene, self._rays_per_vertex = scene, rays_per_vertex

    def seen_from(
        self, problem: Problem, direct: Operator, tolerance: float, specular: Operator | None = None
    ) -> Gathered:
        """Indirect light at points that are no vertices, from direct light of the vertices: F (V_p + G_p ...).

        Parameters
        ----------
        problem : Problem
            At these points; ``max_depth`` counts from them.
        direct : Operator
            Of the vertices.
        tolerance, specular
            As for ``indirect``; light is not told apart by depth.
        """
        points, every = problem.points, np.arange(len(problem.points))
        found = form_factors(problem, self._rays_per_vertex, self.seed, every)
        matrix = scipy.sparse.csr_array(sum(found[1:], found[0]))
        self.rays += len(points) * self._rays_per_vertex
        lights = [direct] if specular is None else _with_specular(direct, specular)
        albedo = self._coloured(len(lights))
        reflected = ReflectedLight([StackedFormFactors([matrix])], albedo, lights, points.keys)
        first = first_bounce(reflected, tolerance, self.seed, self.options.basis)
        specular = Sum(specular.by_depth) if specular is not None and specular.by_depth else specular
        before = self.indirect(direct, tolerance, specular)  # what vertices receive, one bounce before
        assert isinstance(before, Gathered)
        again = [
            multiply_scaled(matrix, of_channel(self._albedo, c)[None], x)[0]
            for c, x in enumerate(before.left)
        ]
        return Gathered(
            tuple(np.hstack(pair) for pair in zip(first.left, again, strict=True)),
            tuple(np.vstack(pair) for pair in zip(first.right, before.right, strict=True)),
            first.left_out,
            before.bounces + 1,
        )


def _with_specular(direct: Operator, specular: Operator) -> list[Operator]:
    """Direct and specular light together, of each channel, or of all."""
    return [Sum((direct, _channel(specular, c))) for c in range(specular.shape[2])]


def _channel(light: Operator, number: int) -> Operator:
    """One channel alone, of light that may have one for all."""
    return light.channel(number) if isinstance(light, SparseRows) else light


def _is_dark(light: Operator) -> bool:
    return isinstance(light, SparseRows) and not any(matrix.nnz for matrix in light.matrices)


def form_factors(
    problem: Problem, rays: int, seed: int, ids: NDArray[np.integer]
) -> list[scipy.sparse.csr_array]:
    """G_0, G_1, ... (n, n_v) of some of a problem's points, after as many specular surfaces (``FiniteElements``)."""
    matrix = gather_matrix(problem.scene, problem.points, rays, seed, ids, problem.max_depth)
    if not problem.specular_apart:
        return [matrix]
    return [matrix, *specular_form_factors(problem, ids, rays, seed)]
