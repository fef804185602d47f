"""How good a matrix is, from elements that it was not made of: no reference render is needed.

With T = D + S, direct and indirect light, and their true values d and s, an element's squared error is

    (D - d)^2  +  2 (D - d)(S - s) + (S - s)^2.

The first term is about visibility: often zero, sometimes large, and a ray tells. The other two need paths, and are
about an average over many small errors. So each part has its own elements (see ``chosen``), and the two estimates are
added. An element's noise is left out by its variance: if m is a mean of samples and v the estimated variance of that
mean, (S - m)^2 - v estimates (S - s)^2.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.random_keys import element_seeds, random_stream
from mi_sparse_prt.estimation.darkness import DARK, unoccluded_squares
from mi_sparse_prt.estimation.element_sampling import (
    Chosen,
    Effort,
    draw_by_energy,
    for_direct_light,
    for_indirect_light,
)
from mi_sparse_prt.measurement.camera_shares import camera_shares
from mi_sparse_prt.operators.operator import Operator
from mi_sparse_prt.operators.sparse_rows import SparseRows
from mi_sparse_prt.reflection.in_out_factors import InOutFactors
from mi_sparse_prt.scene.scene import FEW_MESHES
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.paths import PathSolver
from mi_sparse_prt.solvers.problem import Problem
from mi_sparse_prt.solvers.specular import SpecularOptions, specular_light
from mi_sparse_prt.solvers.term_paths import TermPaths, TermRays
from mi_sparse_prt.transport import LightTransport

Doubles = NDArray[np.float64]

ROUNDING = 1e-5  # relative errors below are those of float32
HELD_OUT = 1  # spawn key
PARTS = ("direct", "indirect", "specular")
BATCH = 1 << 20  # elements, evaluated together
ROUND = 0.25  # of the elements: these mostly tell whether a target is met
UNKNOWN = 0.5  # a standard error of what is seen, from which on nothing is said: next to no light is there
SMALL = 0.02  # an error that is to be known as well as a larger one
UNSURE = 0.2  # of it: a standard error that asks for paths with less noise ...
MORE = 4  # ... by so many times as many of them
KNOWN = 0.1  # of a target: an error that is known so well, and still about the target, is left at that


@dataclass(frozen=True)
class Sample:
    """Elements that stand for a mesh in one sum over it.

    Attributes
    ----------
    weights : (m,) float64
        How many elements each stands for.
    squares, norms : (m, 1 + R) float64
        Unbiased estimates of what each adds to the squared error and the squared norm, summed over channels: of
        radiance, then of each of the R incident rows of a point.
    seen : (m,) float64
        How much of what cameras see each one's vertex is.
    doubt : (m,) float64
        1; or 0 where none of those that they stand for can be wrong.
    """

    weights: NDArray[np.float64]
    squares: NDArray[np.float64]
    norms: NDArray[np.float64]
    seen: NDArray[np.float64]
    doubt: NDArray[np.float64]


Record = TypeVar("Record", Sample, Chosen)
Samples = dict[tuple[str, str], Sample]  # by the names of a mesh and of a part


@dataclass(frozen=True)
class HeldOutError:
    """Relative L2 error of a matrix, as estimated.

    Attributes
    ----------
    total : float
        Of radiance, squares averaged over views by their cosine.
    meshes : dict
        The same of each mesh, by name.
    standard_error : dict
        ``total`` and ``meshes`` again, from the spread between elements; where no element is wrong, as if an average
        one were.
    elements : int
        That were drawn.
    parts : dict
        What ``"direct"``, ``"indirect"`` and ``"specular"`` light add to `total`: their squares sum up to its square.
    terms : list of float
        Of glossy scenes: of each term's rows.
    dark : bool
        Whether next to no light arrives (``darkness``): errors relative to it do not count.
    seen : float, optional
        As `total`, of what the scene's cameras see (``camera_shares``), relative to that: a picture of a dim room is
        not told of by an error relative to the sun outside. Its standard error has the same name.
    """

    total: float
    meshes: dict[str, float]
    standard_error: dict[str, Any]
    elements: int
    parts: dict[str, float]
    terms: list[float]
    dark: bool = False
    seen: float | None = None

    @property
    def in_view(self) -> HeldOutError:
        """The same, whose total is that of what cameras see, if this is larger."""
        if self.seen is None or self.seen <= self.total:
            return self
        spread = self.standard_error | {"total": self.standard_error["seen"]}
        return replace(self, total=self.seen, standard_error=spread)

    def report(self) -> dict[str, Any]:
        """As JSON has it."""
        return {name: value for name, value in vars(self).items() if value not in ([], None)}


def held_out_error(
    problem: Problem,
    transport: LightTransport,
    seed: int | np.random.SeedSequence,
    target: float | None = None,
    effort: Effort = Effort(),  # noqa: B008  frozen
    indirect: bool = True,
    certain: bool = False,
) -> HeldOutError:
    """Estimate the relative L2 error of a matrix.

    Parameters
    ----------
    problem : Problem
    transport : LightTransport
        Rows in the order of the scene's vertices.
    seed : int or SeedSequence
        Elements and their random numbers are drawn from it, and differ from those of a matrix of the same seed.
    target : float, optional
        Relative L2 error. If given, elements are drawn by the quarter until it is clear (2 standard errors) whether the
        error is above it, or the standard error is a tenth of it.
    effort : Effort
    indirect : bool
        Whether a matrix without indirect light is judged by what it lacks. It is not if ``max_depth`` is 2; to ask for
        that depth is something else, as light that goes straight through surfaces counts them.
    certain : bool
        Whether direct light is of the very rays that judge it: a few elements find its norm, or a mistake of ours.

    Notes
    -----
    Squared errors and norms have no bias; the root of their ratio has one, which vanishes with the spread. Of a mesh
    with few elements, a few decide that have light which the matrix lacks: its estimate is mostly a little low, seldom
    much too high. Of 81 vertices and 96 texels (475 elements that 64 paths each judge), 600 seeds had a root mean
    square of 3.995 +- 0.043%, a mean of 3.88 and a median of 3.74%; true were 3.972 +- 0.005%. The standard error
    knows: the truth was within twice of it for all seeds.

    Without a target, where the noise of paths hides the error, as of light that narrow lobes of metal send on, other
    elements have four times the paths: of a sharp conductor 128 told 1.1 +- 2.2%, and 512 tell 2.9 +- 0.5%.
    """
    stream, effort = random_stream(seed, HELD_OUT), replace(effort, certain=certain)
    indirect = indirect and problem.max_depth != 2
    shares = seen_shares(problem) if target is None else np.zeros(len(problem.points))
    estimator = _Estimator(problem, transport, effort, stream, indirect, shares)
    rng = np.random.default_rng(stream)
    open_square = float(unoccluded_squares(problem.reflection.albedo, problem.emission).sum())
    if target is None:
        samples = estimator.samples(rng, 1.0)
        if _hidden_by_paths(samples):
            finer = replace(effort, spp=MORE * effort.spp)
            estimator = _Estimator(problem, transport, finer, stream, indirect, shares)
            samples |= estimator.samples(rng, 1.0, ("indirect",))
        return replace(estimate_errors(samples), dark=_squared_norm(samples) < DARK**2 * open_square)
    samples, rounds = {}, 0
    while rounds < round(1 / ROUND):
        samples, rounds = _together(samples, estimator.samples(rng, ROUND)), rounds + 1
        found = estimate_errors(samples)
        error = found.standard_error["total"]
        if abs(found.total - target) > 2 * error or error < KNOWN * target:
            break
    return replace(found, dark=_squared_norm(samples) < rounds * DARK**2 * open_square)


def _hidden_by_paths(samples: Samples) -> bool:
    """Whether an error is not known well, and most of that is the noise of indirect light's paths."""
    total, spread = _relative_of(samples)
    variances = {key: _variance(sample, total**2) for key, sample in samples.items()}
    of_paths = sum(variance for (_, part), variance in variances.items() if part == "indirect")
    return spread > UNSURE * max(total, SMALL) and of_paths > sum(variances.values()) / 2


def seen_shares(problem: Problem) -> Doubles:
    """How much of what cameras see each point (n,) is, on average 1; 0 without cameras, and of what is no vertex."""
    n, known = len(problem.points), problem.measurement.kind == "vertices" and problem.scene.cameras
    return n * camera_shares(problem.scene).astype(np.float64) if known else np.zeros(n)


def _together(first: Samples, second: Samples) -> Samples:
    """Samples of which each stands for its mesh as one; weights matter relative to each other only."""
    return {key: _joined([first[key], more]) if key in first else more for key, more in second.items()}


def _joined(records: list[Record]) -> Record:
    """One record of the elements of several."""
    parts = zip(*(vars(record).values() for record in records), strict=True)
    return type(records[0])(*map(np.concatenate, parts))


def estimate_errors(samples: Samples, seen: Sequence[Sample] = ()) -> HeldOutError:
    """Relative L2 errors and standard errors; of what cameras see by elements of its own, if there are any."""
    of_meshes: dict[str, Samples] = {}
    for key, sample in samples.items():
        of_meshes.setdefault(key[0], {})[key] = sample
    meshes = {name: _relative_of(some) for name, some in of_meshes.items()}
    total = _relative_of(samples)
    own = {("seen", str(k)): sample for k, sample in enumerate(seen)} or samples
    in_view = {key: replace(s, weights=s.weights * s.seen) for key, s in own.items()}
    of_view = _relative_of(in_view) if _squared_norm(in_view) > 0 else None
    if of_view is not None and of_view[1] > UNKNOWN:
        of_view = None
    rows = max(sample.squares.shape[1] for sample in samples.values())
    glossy = [sample for sample in samples.values() if sample.squares.shape[1] == rows]
    return HeldOutError(
        total[0],
        {name: value for name, (value, _) in meshes.items()},
        {"total": total[1], "meshes": {name: error for name, (_, error) in meshes.items()}}
        | ({} if of_view is None else {"seen": of_view[1]}),
        sum(len(sample.weights) for sample in samples.values()),
        _shares(samples),
        [relative(glossy, row)[0] for row in range(2, rows)],
        seen=None if of_view is None else of_view[0],
    )


def _relative_of(samples: Samples) -> tuple[float, float]:
    """Relative L2 and its standard error, of all parts."""
    specular = {key: sample for key, sample in samples.items() if key[1] == "specular"}
    others = {key: sample for key, sample in samples.items() if key not in specular}
    return relative(_pooled(others), apart=_pooled(specular))


def _shares(samples: Samples) -> dict[str, float]:
    """Relative L2 error that each part adds; 0 where its square is noise about 0."""
    norm = _squared_norm(samples)
    squares = dict.fromkeys((part for _, part in samples), 0.0)
    for (_, part), s in samples.items():
        squares[part] += float(s.weights @ s.squares[:, 0])
    return {part: float(np.sqrt(max(square, 0.0) / max(norm, 1e-300))) for part, square in squares.items()}


def _squared_norm(samples: Samples) -> float:
    """Of the matrix's radiance, times how often the samples stand for all of it."""
    return sum(float(s.weights @ s.norms[:, 0]) for s in samples.values())


def _pooled(samples: Samples) -> list[Sample]:
    """Those of all meshes; of many in as few samples as can be: something is added to the spread of each."""
    if len({name for name, _ in samples}) <= FEW_MESHES:
        return list(samples.values())
    kinds: dict[tuple[str, int], list[Sample]] = {}
    for (_, part), sample in samples.items():
        kinds.setdefault((part, sample.squares.shape[1]), []).append(sample)
    return [_joined(some) for some in kinds.values()]


class _Estimator:
    """Compares elements of a matrix with true ones."""

    def __init__(
        self,
        problem: Problem,
        transport: LightTransport,
        effort: Effort,
        stream: np.random.SeedSequence,
        any_indirect: bool,
        shares: Doubles,
    ) -> None:
        self._problem, self._transport, self._effort = problem, transport, effort
        self._any_indirect = any_indirect
        self._direct, self._indirect = transport.operators["direct"], transport.operators.get("indirect")
        self._seeds = element_seeds(stream, 4)
        self._shares = shares
        self._rays = DirectSolver(problem, effort.strata, self._seeds[0])
        self._paths = PathSolver(problem, effort.spp, self._seeds[2])
        if isinstance(problem.reflection, InOutFactors):
            self._term_rays = TermRays(self._rays, problem.reflection)
            self._term_paths = TermPaths(problem, effort.spp // 2, self._seeds[2])

    def samples(self, rng: np.random.Generator, share: float, parts: Sequence[str] = PARTS) -> Samples:
        """Such a share of the elements of each mesh, for parts of light; drawn by mesh, evaluated together."""
        chosen, normals = {}, self._problem.points.normals
        for mesh in self._transport.meshes:
            place = mesh.vertices, rng, self._effort, share
            if "direct" in parts:
                chosen[mesh.name, "direct"] = for_direct_light(self._transport, normals, *place)
            if self._any_indirect and "indirect" in parts:
                chosen[mesh.name, "indirect"] = for_indirect_light(self._transport, *place)
        found: Samples = {}
        for keys in self._batches(chosen):
            some = [chosen[key] for key in keys]
            whole = (self.direct if keys[0][1] == "direct" else self.indirect)(_joined(some))
            ends = np.cumsum([len(each.weights) for each in some])[:-1]
            columns = zip(*(np.split(column, ends) for column in vars(whole).values()), strict=True)
            found |= {key: Sample(*own) for key, own in zip(keys, columns, strict=True)}
        found = {key: found[key] for key in chosen}
        if "specular" in parts and "specular" in self._transport.operators:
            found |= self._specular(rng, share)
        return found

    def _specular(self, rng: np.random.Generator, part: float) -> Samples:
        """Light by way of mirrors and glass: whole rows, against two independent estimates of these."""
        energy, count = self._specular_energy, round(part * self._effort.specular)
        draws = [draw_by_energy(energy, mesh.vertices, count, 1, rng) for mesh in self._transport.meshes]
        ids, weights = (np.concatenate(drawn) for drawn in zip(*draws, strict=True))
        once = SpecularOptions(self._effort.specular_strata, self._effort.specular_strata)
        ours = self._transport.operators["specular"].rows(ids).astype(np.float64)
        seeds = rng.integers(1 << 32, size=2)
        x, y = (
            specular_light(self._problem, int(s), once, ids).operator.rows(np.arange(len(ids))) for s in seeds
        )
        power = np.square(self._problem.reflection.albedo[ids].astype(np.float64))
        sums = [np.broadcast_to((a * b).sum(axis=1), power.shape) for a, b in ((ours - x, ours - y), (x, y))]
        columns = [np.stack([(power * s).sum(axis=1), s.sum(axis=1)], axis=1) for s in sums]
        columns += [self._shares[ids], np.ones(len(ids))]
        ends = np.cumsum([len(rows) for rows, _ in draws])[:-1]
        parts = zip(*(np.split(array, ends) for array in (weights, *columns)), strict=True)
        return {
            (mesh.name, "specular"): Sample(*one)
            for mesh, one in zip(self._transport.meshes, parts, strict=True)
        }

    @cached_property
    def _specular_energy(self) -> Doubles:
        """Of light by way of mirrors and glass, as this matrix has it, that vertices send on (n,), by depth."""
        operator, albedo = self._transport.operators["specular"], self._problem.reflection.albedo
        power, total = np.square(albedo.astype(np.float64)), np.zeros(len(albedo))
        for some in operator.by_depth or (operator,):
            assert isinstance(some, SparseRows)
            alike = 1 if len(some.matrices) == 3 else 3  # channels of a matrix
            for channel, matrix in enumerate(some.matrices):
                end = matrix.indptr[len(albedo)]
                rows = np.repeat(np.arange(len(albedo)), np.diff(matrix.indptr[: len(albedo) + 1]))
                squares = np.bincount(rows, np.square(matrix.data[:end], dtype=np.float64), len(albedo))
                total += squares * power[:, channel : channel + alike].sum(axis=1)
        return total

    def _batches(self, chosen: dict[tuple[str, str], Chosen]) -> Iterator[list[tuple[str, str]]]:
        """Those to evaluate together: of one part, with as many rows per point, and not too many."""
        begun: dict[tuple[str, int], list[tuple[str, str]]] = {}
        sizes: dict[tuple[str, int], int] = {}
        for key, some in chosen.items():
            kind, size = (key[1], self._rows_per_point(some)), len(some.weights)
            if kind in begun and sizes[kind] + size > BATCH:
                yield begun.pop(kind)
                sizes[kind] = 0
            begun.setdefault(kind, []).append(key)
            sizes[kind] = sizes.get(kind, 0) + size
        yield from begun.values()

    def direct(self, chosen: Chosen) -> Sample:
        """Squared errors and norms of direct light alone."""
        x, y = self._halves(chosen)
        ours = self._ours(self._direct, chosen)
        found = self._sample(chosen, (ours - x, ours - y), (x, y))
        return replace(found, doubt=np.zeros_like(found.doubt)) if self._effort.certain else found

    def indirect(self, chosen: Chosen) -> Sample:
        """What indirect light adds to both: its square and twice its product with direct light."""
        first, second, variance = self._true_indirect(chosen)
        direct = np.mean(self._halves(chosen), axis=0)
        ours, direct_error = self._ours(self._indirect, chosen), self._ours(self._direct, chosen) - direct
        errors = ours - first, ours - second + 2 * direct_error
        return self._sample(chosen, errors, (first, second + 2 * direct), variance)

    def _true_indirect(self, chosen: Chosen) -> tuple[Doubles, Doubles, Doubles]:
        """Indirect light (m, rows, channels) twice, and what the product of the two has of variance.

        Where there is one row, that is the mean of all paths and its variance. Rows of a glossy point have noise in
        common, since paths are: two halves of the paths tell them apart.
        """
        asked, rows = (chosen.vertices, chosen.texels), self._rows_per_point(chosen)
        power = self._problem.emission.solid_angles[chosen.texels].astype(np.float64)[:, None, None]
        shape = len(chosen.vertices), rows, self._problem.channels
        if rows == 1:
            estimate = self._paths.elements(*asked)
            mean = estimate.mean.reshape(shape) * power
            return mean, mean, estimate.variance.reshape(shape) * power**2
        first, second = (
            self._term_paths.elements(*asked, seed).mean.reshape(shape) * power for seed in self._seeds[2:]
        )
        return first, second, np.zeros_like(first)

    def _sample(
        self,
        chosen: Chosen,
        errors: tuple[Doubles, Doubles],
        values: tuple[Doubles, Doubles],
        variance: Doubles | float = 0.0,
    ) -> Sample:
        """From two estimates (m, rows, channels) each of the error and of the value, and the variance of products."""
        gram = self._problem.reflection.gram(chosen.vertices).astype(np.float64)
        found = []
        for first, second in (errors, values):
            own = first * second - variance  # [element, row, channel]
            colours = np.broadcast_to(own, (*own.shape[:2], 3))  # one channel stands for three
            of_rows = np.einsum("mrc->mr", colours)
            found.append(np.column_stack([_quadratic(gram, first, second, own), of_rows]))
        squares, norms = found
        shares = self._shares[chosen.vertices]
        return Sample(chosen.weights, squares, norms, shares, np.ones(len(shares)))

    def _halves(self, chosen: Chosen) -> tuple[Doubles, Doubles]:
        """Direct light (m, rows, 1) twice, independently; it is the same where one ray tells all."""
        first = self._true_direct(chosen, self._seeds[0])
        if self._problem.basis == "direction":
            return first, first
        return first, self._true_direct(chosen, self._seeds[1])

    def _true_direct(self, chosen: Chosen, seed: int) -> Doubles:
        asked = chosen.vertices, chosen.texels, seed
        if self._rows_per_point(chosen) == 1:
            return self._rays.elements(*asked).astype(np.float64)[:, None, None]
        return self._term_rays.elements(*asked).astype(np.float64)[..., None]

    def _rows_per_point(self, chosen: Chosen) -> int:
        """R: chosen elements are of one mesh, and so of one BRDF."""
        glossy = self._problem.reflection.glossy
        is_glossy = len(glossy) and len(chosen.vertices) and np.isin(chosen.vertices[0], glossy)
        return 1 + self._problem.reflection.terms if is_glossy else 1

    def _ours(self, operator: Operator | None, chosen: Chosen) -> Doubles:
        """Elements (m, rows, channels) of a part of the matrix, zero if it is left out."""
        if operator is None:
            return np.zeros((len(chosen.vertices), self._rows_per_point(chosen), 1))
        rows = self._problem.reflection.rows_of_each(chosen.vertices, self._rows_per_point(chosen))
        texels = np.repeat(chosen.texels, rows.shape[1])
        found = operator.elements(rows.ravel(), texels)
        return found.reshape(*rows.shape, -1).astype(np.float64)


def _quadratic(gram: Doubles, first: Doubles, second: Doubles, products: Doubles) -> Doubles:
    """``first^T gram second`` summed over colours, (m,); of one row from its product. One channel stands for three."""
    colours = (*gram.shape[:2], 3)
    if gram.shape[1] == 1:
        return np.einsum("mac,mac->m", gram[:, 0], np.broadcast_to(products, colours))
    pair = np.broadcast_to(first, colours), np.broadcast_to(second, colours)
    return np.einsum("mabc,mac,mbc->m", gram, *pair, optimize=True)


def relative(samples: list[Sample], row: int = 0, apart: Sequence[Sample] = ()) -> tuple[float, float]:
    """Relative L2 and its standard error, from samples whose sums are added.

    The squared error of ``apart`` is not below 0, as little as that of the others: what noise takes from one does not
    hide the other.

    Its square R^2 is a ratio of two sums; to first order it spreads as the sum of e - R^2 n does, e and n being the
    squared error and norm of an element (Cochran 1977, "Sampling Techniques", 6.11).
    """
    every = [*samples, *apart]
    norm = sum(float((s.weights * s.norms[:, row]).sum()) for s in every)
    square = sum(
        max(
            sum(float((s.weights * s.squares[:, row]).sum()) for s in part), 0.0
        )  # below zero is noise about zero
        for part in (samples, apart)
    )
    if norm <= 0:  # a black mesh
        return (0.0 if square <= 0 else 1.0), 0.0
    ratio = square / norm
    found, spread = (
        float(np.sqrt(ratio)),
        float(np.sqrt(sum(_variance(s, ratio, row) for s in every))) / norm,
    )
    # d sqrt(e) = de / (2 sqrt(e)); near zero the bound is that of sqrt(spread)
    return found, spread / (2 * found) if ratio > spread else float(np.sqrt(spread))


def _variance(sample: Sample, ratio: float, row: int = 0) -> float:
    """Variance of the sum of e - R^2 n, elements having been drawn independently of each other.

    A few wrong elements may hold most of the squared error. Samples with few of them see too little spread as well,
    so the worst element is counted once more; where none is wrong, one average element may be, if any can.
    """
    squares, norms = sample.weights * sample.squares[:, row], sample.weights * sample.norms[:, row]
    size = float(np.abs(norms).sum())
    if np.abs(squares).sum() <= ROUNDING**2 * size:
        return (float((sample.doubt * norms**2).sum()) / max(size, 1e-300)) ** 2
    left = (squares - ratio * norms) ** 2
    return float(left.sum() + left.max())
