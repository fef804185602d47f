"""The first bounce G rho D as a product of thin matrices, from some combinations of its columns and from some rows.

One basis serves the columns of all channels: these see the same light by the same rays. It is spanned by random
combinations of columns (Halko, Martinsson and Tropp 2011), of few columns each, as D is dear to expand. Coefficients
of all columns then follow by least squares from some rows, which G and D give at the cost of their rays:
G rho D ~ Q (Q_S)^+ (G rho D)_S. Rows are drawn in proportion to their leverage, the squared norm of their row of Q; the
squared error is then 1 + r / (s - r) times the least, s rows and rank r (Drineas, Mahoney and Muthukrishnan 2008).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mi_sparse_prt.core.bits import BITS
from mi_sparse_prt.core.random_keys import mix
from mi_sparse_prt.core.sparse_product import multiply_scaled, multiply_sparse
from mi_sparse_prt.operators.column_blocks import ColumnBlocks, combine_randomly
from mi_sparse_prt.operators.operator import Operator
from mi_sparse_prt.solvers.stacked import StackedFormFactors

PRECISION = 1e-4  # relative, of the least vectors in a basis of float32 numbers
ROWS = 1 << 12  # of blocks of columns that are side by side at a time: a few megabytes

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]


@dataclass(frozen=True)
class RandomBasis:
    """How the random basis is drawn and used.

    Attributes
    ----------
    draws : int
        Of up to 32 combinations of columns each, that join the basis together.
    mixed : int
        Columns in a combination.
    sums : int
        Random sums of rows by which lengths and angles are known; a power of two.
    projections : int
        That tell leverage: 24 tell it within 30%.
    rows : int
        Rows for least squares, times the rank (4: the squared error is 4/3 of the least).
    few_rows : int
        At least so many.
    share : float
        Of the squared tolerance: the last of the energy takes a random basis many vectors.
    most : int
        Vectors, about: time grows as their square, and what is left is mostly noise.
    """

    draws: int = 3
    mixed: int = 24
    sums: int = 1 << 13
    projections: int = 24
    rows: int = 4
    few_rows: int = 1024
    share: float = 0.75
    most: int = 1024

    def row_count(self, rank: int, n: int) -> int:
        """How many of n rows are taken."""
        count = max(self.few_rows, self.rows * rank)
        return n if 2 * count > n else count

    def amplification(self, rank: int, n: int, sums: int) -> float:
        """Of the squared error: what least squares make worse of it, from sums of rows and from some of the rows."""
        rows = self.row_count(rank, n)
        return (1.0 if rows == n else rows / (rows - rank)) / (1.0 if sums == n else 1 - rank / sums)


USUAL = RandomBasis()


@dataclass(frozen=True)
class FirstBounce:
    """A matrix per channel, ``left @ right``.

    Attributes
    ----------
    left : tuple of (n, rank) float32
        Columns that are nearly orthonormal, rows times their weights.
    right : tuple of (rank, n_directions) float32
        Orthogonal rows, the longest first.
    left_out : float
        Estimated relative L2 error, all channels together.
    """

    left: tuple[Floats, ...]
    right: tuple[Floats, ...]
    left_out: float


class ReflectedLight(NamedTuple):
    """G rho D of all channels.

    Attributes
    ----------
    matrices : sequence of StackedFormFactors (n, n_v)
        G of each channel, or one of all.
    albedo : (channels, n_v) float32
        rho.
    lights : sequence of Operator
        D of each channel, or one of all.
    keys : (n,) uint64
        Of the rows of G: random numbers are made of them.
    weights : (n,) float32, optional
        Above 0: errors of rows count by them.
    """

    matrices: Sequence[StackedFormFactors]
    albedo: Floats
    lights: Sequence[Operator]
    keys: NDArray[np.uint64]
    weights: Floats | None = None


def first_bounce(
    light: ReflectedLight, tolerance: float, seed: int, options: RandomBasis = USUAL
) -> FirstBounce:
    """G rho D for all channels.

    Parameters
    ----------
    light : ReflectedLight
    tolerance : float
        Relative L2 error; it is larger where that would take a rank far above 1000.
    seed : int
    options : RandomBasis

    Returns
    -------
    FirstBounce
    """
    rng, weights = np.random.default_rng(seed), light.weights
    hashes = mix(light.keys ^ mix(np.array([seed & 0xFFFFFFFFFFFFFFFF], np.uint64)))
    columns, turn, missed = _basis(light, hashes, rng, tolerance, options)
    count = options.row_count(turn.shape[1], len(hashes))
    rows, probability = _chosen_rows(_leverage(columns, turn, options.projections, rng), hashes, count)
    some = np.hstack([block[rows] for block in columns]).astype(np.float64) @ turn
    weighted = some.T / probability
    fit = np.linalg.solve(weighted @ some, weighted).astype(np.float32)  # rows to coefficients in the basis
    if weights is not None:
        fit *= weights[rows]
    right = [
        fit @ known for known in _rows([m.rows(rows) for m in light.matrices], light.albedo, light.lights)
    ]
    found = _truncated(columns, turn, right, missed, tolerance)
    if weights is not None:
        for x in found.left:
            x /= weights[:, None]
    return found


def _basis(
    light: ReflectedLight,
    hashes: NDArray[np.uint64],
    rng: np.random.Generator,
    tolerance: float,
    options: RandomBasis,
) -> tuple[list[Floats], Doubles, float]:
    """Combinations Y of the columns of all channels; turn (m, r), which makes them a basis; what that misses.

    Y (n, m) comes in blocks of columns: side by side they would be as many new pages, which cost more than the numbers
    in them.

    Random combinations have, on average, the energy of all columns: each block of them measures what the basis misses
    before it joins (Halko et al. 2011, 4.3). Gram and Schmidt see random sums of rows only, by which lengths and
    angles change little (Balabanov and Grigori 2022).
    """
    shorten = _sums(hashes, options.sums)
    blocks: list[Floats] = []  # [row, combination]
    short: list[Doubles] = []  # [sum of rows, combination]
    turn, energies = np.zeros((0, 0)), []  # [combination, vector of the basis]
    draws, width = max(1, options.draws // len(light.albedo)), min(BITS, light.lights[0].shape[1])
    mixed = np.empty((light.matrices[0].shape[1], draws * width), np.float32)
    while True:
        found = _combinations(light, mixed, options.mixed, rng)
        if light.weights is not None:
            for block in found:
                block *= light.weights[:, None]
        sums = found if shorten is None else [multiply_sparse(shorten, block) for block in found]
        new = np.hstack(sums).astype(np.float64)
        products = [old.T @ new for old in (*short, new)]
        # [vector, combination]
        known = turn.T @ np.concatenate([np.zeros((0, new.shape[1])), *products[:-1]])
        rest = products[-1] - known.T @ known
        energies.append(np.trace(products[-1]))
        energy = max(float(np.mean(energies)), 1e-30)
        missed = max(float(np.trace(rest)), 0) / energy
        missed *= options.amplification(len(known), len(hashes), len(new))
        squares, vectors = np.linalg.eigh(rest)
        kept = squares > (PRECISION / 2) ** 2 * energy
        if missed <= options.share * tolerance**2 or not kept.any() or len(known) >= options.most:
            return blocks or [found[0][:, :0]], turn, missed
        steps = vectors[:, kept] / np.sqrt(squares[kept])
        turn = np.block([[turn, -turn @ (known @ steps)], [np.zeros((len(steps), turn.shape[1])), steps]])
        blocks += found
        short.append(new)


def _sums(hashes: NDArray[np.uint64], count: int) -> scipy.sparse.csr_array | None:
    """A matrix (count, n) that adds up rows at random, with signs; None where they are few enough as they are."""
    n = len(hashes)
    if n <= count:
        return None
    signs = 1 - 2 * (hashes >> np.uint64(63)).astype(np.float32)
    # 32 bits, as other matrices have them: the product is compiled once
    entries = signs, ((hashes & np.uint64(count - 1)).astype(np.int32), np.arange(n, dtype=np.int32))
    return scipy.sparse.csr_array(entries, shape=(count, n))


def _combinations(light: ReflectedLight, mixed: Floats, few: int, rng: np.random.Generator) -> list[Floats]:
    """Sums of a few random columns each, with random signs: (n, combinations) of each channel.

    ``mixed`` (n_v, combinations of a channel) is overwritten.
    """
    found, width = [], min(BITS, light.lights[0].shape[1])
    for c, rho in enumerate(light.albedo):
        for a in range(0, mixed.shape[1], width):
            combine_randomly(of_channel(light.lights, c), few, rng, mixed[:, a : a + width])
        found.append(of_channel(light.matrices, c).reflect(rho[None], mixed)[0])
    return found


def _leverage(columns: list[Floats], turn: Doubles, projections: int, rng: np.random.Generator) -> Doubles:
    """Squared norms (n,) of the rows of the basis, about: from random projections."""
    projection = turn @ rng.standard_normal((turn.shape[1], projections))
    projected = _products(columns, [projection.astype(np.float32)])[0]
    return np.square(projected).sum(axis=1, dtype=np.float64)


def _products(columns: list[Floats], factors: Sequence[Floats]) -> list[Floats]:
    """Blocks of columns, side by side, times matrices: some rows at a time."""
    n = len(columns[0])
    results = [np.empty((n, factor.shape[1]), np.float32) for factor in factors]
    for a in range(0, n, ROWS):
        rows = slice(a, a + ROWS)
        some = np.hstack([block[rows] for block in columns])
        for result, factor in zip(results, factors, strict=True):
            np.matmul(some, factor, out=result[rows])
    return results


def _chosen_rows(
    leverage: Doubles, hashes: NDArray[np.uint64], count: int
) -> tuple[NDArray[np.int64], Doubles]:
    """Some rows, (count,), drawn without replacement in proportion to their leverage, and how probable each was.

    A row of leverage w arrives after an exponential time of rate w. The first are taken: each with a probability of
    1 - exp(-w t), t the time at which the next one arrives.
    """
    n = len(leverage)
    if count == n:
        return np.arange(n), np.ones(n)
    words = mix(hashes)
    uniform = ((words >> np.uint64(11)).astype(np.float64) + 0.5) * 2.0**-53
    rate = np.maximum(leverage, 1e-30)
    arrival = -np.log(uniform) / rate
    order = np.lexsort((words, arrival))
    rows = np.sort(order[:count])
    return rows, -np.expm1(-rate[rows] * arrival[order[count]])


def _rows(matrices: Sequence[scipy.sparse.csr_array], albedo: Floats, lights: Sequence[Operator]) -> Floats:
    """G rho D (channels, s, n_directions) for some rows (s, n_v) of G, from those rows of D that they touch."""
    touched = np.unique(np.concatenate([matrix.indices for matrix in matrices]))
    local = [_at_columns(matrix, touched) for matrix in matrices]
    rho = np.ascontiguousarray(albedo[:, touched])
    result = np.empty((len(albedo), local[0].shape[0], lights[0].shape[1]), np.float32)
    if len(lights) == len(matrices) == 1:  # each row of the light is read once for all channels
        for texels, light in ColumnBlocks(lights[0].take(touched)):
            result[..., texels] = multiply_scaled(local[0], rho, light)
        return result
    for c, direct in enumerate(lights):
        for texels, light in ColumnBlocks(direct.take(touched)):
            for k in (c,) if len(lights) > 1 else range(len(albedo)):
                result[k, :, texels] = multiply_scaled(of_channel(local, k), rho[k : k + 1], light)[0]
    return result


def _at_columns(matrix: scipy.sparse.csr_array, columns: NDArray[np.integer]) -> scipy.sparse.csr_array:
    """Some columns, by ascending numbers, with all that a matrix holds."""
    places = np.searchsorted(columns, matrix.indices).astype(np.int32)
    return scipy.sparse.csr_array((matrix.data, places, matrix.indptr), shape=(matrix.shape[0], len(columns)))


def _truncated(
    columns: list[Floats], turn: Doubles, right: list[Floats], missed: float, tolerance: float
) -> FirstBounce:
    """In terms of singular vectors, the least of them left out, as far as the tolerance allows."""
    parts = [np.linalg.eigh(b.astype(np.float64) @ b.T.astype(np.float64)) for b in right]
    squares = [np.maximum(values[::-1], 0) for values, _ in parts]
    energy = sum(float(s.sum()) for s in squares)
    kept = all_but_least(squares, max(tolerance**2 - missed, 0) * energy)
    turns = [u[:, ::-1][:, k].astype(np.float32) for (_, u), k in zip(parts, kept, strict=True)]
    dropped = sum(float(s[~k].sum()) for s, k in zip(squares, kept, strict=True))
    return FirstBounce(
        tuple(_products(columns, [(turn @ u).astype(np.float32) for u in turns])),
        tuple(u.T @ b for u, b in zip(turns, right, strict=True)),
        float(np.sqrt(missed + dropped / max(energy, 1e-30))),
    )


def of_channel(each: Sequence[Any] | NDArray[Any], channel: int) -> Any:
    """That of one channel; the only one is that of all."""
    return each[min(channel, len(each) - 1)]


def all_but_least(energies: Sequence[NDArray[np.floating]], expendable: float) -> list[NDArray[np.bool_]]:
    """Which to keep of each channel, the least left out that come to no more than ``expendable`` all together."""
    every = np.sort(np.concatenate(energies))
    few = int(np.searchsorted(np.cumsum(every), expendable, side="right"))
    least = every[few] if few < len(every) else np.inf
    return [x >= least for x in energies]
