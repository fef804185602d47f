"""S_i by finite elements: light that surfaces gather from each other ([Leh07] 2.5, eq. 18-21).

Diffuse light is known at the vertices and interpolated on the triangles between. One bounce is then a sparse matrix G:
its row i is the mean over cosine-distributed rays from vertex i of what they find at their other end. The indirect part
of white transport is the Neumann series X = G rho D + G rho G rho D + ..., D the direct part and rho the albedo.

G blurs the shadows' edges in D: what is left has a low rank. ``GatherTransport.indirect`` therefore finds a basis of
the first bounce with a randomised range finder (Halko, Martinsson and Tropp 2011), works on the few vectors of the
basis from there on, and leaves the result factored.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numba
import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.errors import PrtError
from mi_sparse_prt.matrix import Factored, Interpolated, MeanCosine, Visibility
from mi_sparse_prt.measurement.vertices import Points
from mi_sparse_prt.scene import Scene
from mi_sparse_prt.transport.direct import BITS
from mi_sparse_prt.transport.gather_matrix import gather_matrix

BLOCK = 1 << 24  # elements of D at a time
BASES = 0.75  # of the squared tolerance: the last of the energy takes a random basis many vectors
SKETCH = 64  # random combinations of a quarter of D's columns at a time
FEW_TEXELS = 512  # of which no quarter is taken
FEW = 8  # columns that are not worth a second thread
COLUMNS = 256  # of a dense matrix that G is applied to at a time
NEGLIGIBLE = 1e-3  # light, relative to all, that later bounces may lack at any vertex
PRECISION = 3e-6  # of float32, relative, after some products
LONGEST = 1024  # bounces after which light is taken not to end

Floats = NDArray[np.float32]
Direct = Visibility | MeanCosine | Interpolated


@dataclass(frozen=True)
class Gathered(Factored):
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


class GatherTransport:
    """Indirect light at the vertices of a diffuse scene.

    Parameters
    ----------
    scene : Scene
    lighting : CubemapLighting
    points : Points
        Of all vertices (``vertex_points``).
    rays_per_vertex : int
        A power of two: Sobol points, scrambled for each vertex by its key.
    max_depth : int
        As Mitsuba's ``path`` counts it: 3 = one interreflection, -1 = no limit. Bounces that add next to
        nothing are left out.
    seed : int

    Attributes
    ----------
    matrix : (n_v, n_v) sparse float32
        G. Rows sum to the share of the hemisphere, by cosine, in which fronts of surfaces are seen.
    channels : {1, 3}
        1 in a grey scene.

    Raises
    ------
    PrtError
        If a surface is not diffuse, or if vertices often see the backs of surfaces that reflect on both sides: light
        is known at their fronts only.
    """

    def __init__(
        self,
        scene: Scene,
        lighting: CubemapLighting,
        points: Points,
        rays_per_vertex: int = 256,
        max_depth: int = 5,
        seed: int = 0,
    ) -> None:
        _check_diffuse(scene)
        self.lighting, self.max_depth, self.seed = lighting, max_depth, seed
        self.rays_per_vertex = rays_per_vertex
        self.channels = 1 if scene.grey else 3
        self._albedo = np.ascontiguousarray(scene.albedo.T[: self.channels])  # [channel, vertex]
        self.matrix = gather_matrix(scene, points, rays_per_vertex, seed)

    def apply(self, columns: Floats) -> Floats:
        """Indirect light under a few lights, without approximation.

        Parameters
        ----------
        columns : (n_v, k) float32
            White direct transport of each light.

        Returns
        -------
        (n_v, k, channels) float32
            White indirect transport.
        """
        result = np.empty((*columns.shape, self.channels), np.float32)
        size = max(1, COLUMNS // self.channels)
        count = self.bounces(columns.sum(axis=1))
        for a in range(0, columns.shape[1], size):
            part = slice(a, a + size)
            first = self._reflected([columns[:, part]] * self.channels)
            result[:, part] = np.stack(self._all_bounces(first, count), axis=-1)
        return result

    def rows(self, direct: Direct, ids: NDArray[np.integer]) -> Floats:
        """Indirect light of a few vertices, without approximation: bounces in reverse ([Leh07] 2.6).

        Parameters
        ----------
        direct : Part
            The direct part of the matrix, with a row for each vertex.
        ids : (k,) integers

        Returns
        -------
        (k, n_directions, channels) float32
            White indirect transport.
        """
        count = self._count_for(direct)
        light, found = _Columns(direct, np.arange(self.lighting.n_directions)), []
        for rho in self._albedo:
            weights = np.zeros((len(rho), len(ids)), np.float32)
            weights[ids, np.arange(len(ids))] = 1
            total = np.zeros_like(weights)
            for _ in range(count):
                weights = rho[:, None] * product(self._transposed, weights)
                total += weights
            found.append(light.transposed(total))
        return np.stack(found, axis=-1)

    def indirect(self, direct: Direct, tolerance: float = 0.03) -> Gathered:
        """Indirect light for all texels, factored.

        Parameters
        ----------
        direct : Part
            The direct part of the matrix, with a row for each vertex.
        tolerance : float
            Relative L2 error of the first bounce that a low rank may cost; later bounces are smoother and lose less.

        Returns
        -------
        Gathered
        """
        count = self._count_for(direct)
        bases, missed = self._bases(direct, tolerance if count else np.inf)
        light = _Columns(direct, np.arange(self.lighting.n_directions))
        left, right, dropped = self._truncated(light, bases, tolerance**2 - missed)
        totals = tuple(np.ascontiguousarray(x) for x in self._all_bounces(left, count))
        return Gathered(totals, tuple(right), float(np.sqrt(missed + dropped)), count)

    def _count_for(self, direct: Direct) -> int:
        return self.bounces(direct.relight(np.ones((self.lighting.n_directions, 3), np.float32))[:, 0])

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
        light, total, count = [even[:, None]] * self.channels, 0.0, 0
        while self.max_depth < 0 or count < self.max_depth - 2:
            light = self._reflected(light)
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
        return count

    @cached_property
    def _reach(self) -> float:
        """Bound of G rho + (G rho)^2 + ... in the maximum norm, by the albedo and by what escapes."""
        light = [np.ones((self._albedo.shape[1], 1), np.float32)] * self.channels
        total = 0.0
        for _ in range(LONGEST):
            light = self._reflected(light)
            peak = max(float(x.max(initial=0)) for x in light)
            total += peak
            if peak <= 0.5:  # as many bounces more add at most this share of these, and so on
                return total / (1 - peak)
        return np.inf

    def _reflected(self, light: list[Floats]) -> list[Floats]:
        """One bounce: G rho x for arrays x (n_v, any), one per channel."""
        lit = [rho[:, None] * x for rho, x in zip(self._albedo, light, strict=True)]
        ends = np.cumsum([x.shape[1] for x in lit])
        return np.split(product(self.matrix, np.concatenate(lit, axis=1)), ends[:-1], axis=1)

    def _all_bounces(self, first: list[Floats], count: int) -> list[Floats]:
        """The first bounce and those after it, ``count`` altogether."""
        totals, light = [x if count else 0 * x for x in first], first
        for _ in range(count - 1):
            light = self._reflected(light)
            totals = [total + x for total, x in zip(totals, light, strict=True)]
        return totals

    def _bases(self, direct: Direct, tolerance: float) -> tuple[list[Floats], float]:
        """Orthonormal bases of the first bounce, one (n_v, r) per channel, and the share of its energy that they miss.

        Random combinations of random columns have, on average, the energy of all of them: each block of these measures
        what the bases miss before it joins them (Halko et al. 2011, 4.3), without bias.
        """
        rng, n = np.random.default_rng(self.seed), self.lighting.n_directions
        bases = [np.zeros((self._albedo.shape[1], 0), np.float32)] * self.channels
        energies: list[float] = []
        while np.isfinite(tolerance):
            some = _Columns(direct, np.sort(rng.choice(n, min(n, max(n // 4, FEW_TEXELS)), replace=False)))
            mixing = rng.standard_normal((some.n_columns, SKETCH), dtype=np.float32)
            sketch = self._reflected([some.combined(mixing)] * self.channels)
            energies.append(sum(_energy(y) for y in sketch) / SKETCH)
            sketch = [y - q @ (q.T @ y) for q, y in zip(bases, sketch, strict=True)]
            missed, energy = sum(_energy(y) for y in sketch) / SKETCH, float(np.mean(energies))
            if missed <= max(BASES * tolerance**2, PRECISION**2) * energy:
                return bases, missed / max(energy, 1e-30)
            least = (
                PRECISION / 2 * np.sqrt(energy)
            )  # half, so that three channels of rounding errors end the loop
            bases = [_extended(q, y, least) for q, y in zip(bases, sketch, strict=True)]
        return bases, 0.0

    def _truncated(
        self, light: _Columns, bases: list[Floats], expendable: float
    ) -> tuple[list[Floats], list[Floats], float]:
        """Factors (n_v, rank) and (rank, n_columns) of the first bounce, its least singular values left out.

        Returns also their share of the energy, at most ``expendable`` for all channels together.
        """
        back = [
            rho[:, None] * product(self._transposed, q) for rho, q in zip(self._albedo, bases, strict=True)
        ]
        ends = np.cumsum([q.shape[1] for q in bases])
        rows = np.split(light.transposed(np.concatenate(back, axis=1)), ends[:-1])
        parts = [np.linalg.eigh(b.astype(np.float64) @ b.T.astype(np.float64)) for b in rows]
        squares = [np.maximum(values, 0) for values, _ in parts]  # of singular values, ascending
        every = np.sort(np.concatenate(squares))
        sums = np.cumsum(every)
        few = int(np.searchsorted(sums, max(expendable, 0) * every.sum(), side="right"))
        least = every[few] if few < len(every) else np.inf
        turns = [
            u[:, values >= least].astype(np.float32) for values, (_, u) in zip(squares, parts, strict=True)
        ]
        left = [q @ u for q, u in zip(bases, turns, strict=True)]
        right = [u.T @ b for b, u in zip(rows, turns, strict=True)]
        return left, right, float(sums[few - 1] / max(sums[-1], 1e-30)) if few else 0.0

    @cached_property
    def _transposed(self) -> scipy.sparse.csr_array:
        return self.matrix.T.tocsr()


def _extended(basis: Floats, vectors: Floats, least: float) -> Floats:
    """An orthonormal basis (n, r) and the directions of vectors (n, k), but for those shorter than ``least``."""
    new = _orthonormal(vectors, least)
    # what was short is not orthogonal to the basis, or not new at all, once its rounding errors are normalised
    return np.hstack([basis, _orthonormal(new - basis @ (basis.T @ new), 0.1)])


def _orthonormal(vectors: Floats, least: float) -> Floats:
    """Principal directions of vectors (n, k), those of singular values above ``least``."""
    exact = vectors.astype(np.float64)  # squares of float32 fit
    squares, rotation = np.linalg.eigh(exact.T @ exact)
    kept = squares > least**2
    return (exact @ (rotation[:, kept] / np.sqrt(squares[kept]))).astype(np.float32)


def _energy(x: Floats) -> float:
    return float(np.vdot(x, x))


class _Columns:
    """Some columns of D, expanded to numbers one block of rows at a time.

    Where D interpolates a few dense rows, these are the rows.
    """

    def __init__(self, direct: Direct, texels: NDArray[np.integer]) -> None:
        self._weights: scipy.sparse.csr_array | None = None
        self._rows: Visibility | MeanCosine
        if isinstance(direct, Interpolated):
            assert isinstance(direct.dense, Visibility)  # an indirect part is none of direct light
            self._weights, self._rows = direct.weights, direct.dense
        else:
            self._rows = direct
        self._texels, self.n_columns = texels, len(texels)

    def combined(self, mixing: Floats) -> Floats:
        """D times (n_columns, k): (n_v, k)."""
        result = np.concatenate([block @ mixing for _, block in self._blocks()])
        return result if self._weights is None else product(self._weights, result)

    def transposed(self, mixing: Floats) -> Floats:
        """The transpose of (n_v, k) times D: (k, n_columns)."""
        if self._weights is not None:
            mixing = product(self._weights.T.tocsr(), mixing)
        result = np.zeros((mixing.shape[1], self.n_columns), np.float32)
        for part, block in self._blocks():
            result += mixing[part].T @ block
        return result

    def _blocks(self) -> Iterator[tuple[slice, Floats]]:
        """Rows, and their elements (at most BLOCK together), which the next block overwrites."""
        if isinstance(self._rows, MeanCosine):
            for part in self._slices(len(self._rows.fixed)):
                yield part, replace(self._rows, fixed=self._rows.fixed[part]).columns(self._texels)[..., 0]
            return
        lighting, texels = self._rows.lighting, self._texels.astype(np.uint32)
        power = lighting.solid_angles[texels] / np.float32(np.pi)
        beams = np.ascontiguousarray((lighting.directions[texels] * power[:, None]).T)
        words, shifts = texels // np.uint32(BITS), texels % np.uint32(BITS)
        # one buffer for all blocks: new pages cost more than the sums
        buffer = np.empty((self._size, len(texels)), np.float32)
        for part in self._slices(len(self._rows.bits)):
            bits, normals = self._rows.bits[part], self._rows.normals[part]
            block = buffer[: len(bits)]
            _expand(bits, normals, words, shifts, beams, block)
            yield part, block

    def _slices(self, count: int) -> Iterator[slice]:
        return (slice(a, min(a + self._size, count)) for a in range(0, count, self._size))

    @property
    def _size(self) -> int:
        return max(1, BLOCK // self.n_columns)


@numba.njit(parallel=True, cache=True)
def _expand(
    bits: NDArray[np.uint32],
    normals: Floats,
    words: NDArray[np.uint32],
    shifts: NDArray[np.uint32],
    beams: Floats,
    result: Floats,
) -> None:
    """Elements of ``Visibility`` (n, m) at bits ``shifts`` of ``words``; beams (3, m) are directions times power."""
    for i in numba.prange(len(bits)):
        nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
        for j in range(len(words)):
            light = nx * beams[0, j] + ny * beams[1, j] + nz * beams[2, j]
            seen = (bits[i, words[j]] >> shifts[j]) & np.uint32(1)
            result[i, j] = max(light, np.float32(0)) * np.float32(seen)


def product(matrix: scipy.sparse.csr_array, dense: Floats) -> Floats:
    """A sparse matrix (n, m) times a dense one (m, k), float32, on all threads; the same for any number of them."""
    if dense.shape[1] < FEW:
        return matrix @ dense
    shares = np.linspace(0, matrix.nnz, numba.get_num_threads() + 1)
    bounds = np.searchsorted(matrix.indptr, shares)  # equal numbers of entries, not of rows
    bounds[0], bounds[-1] = 0, matrix.shape[0]
    dense = np.ascontiguousarray(dense, np.float32)
    return _product(bounds, matrix.indptr, matrix.indices, matrix.data, dense)


@numba.njit(parallel=True, fastmath={"contract"}, cache=True)
def _product(
    bounds: NDArray[np.int64],
    starts: NDArray[np.int32],
    columns: NDArray[np.int32],
    values: Floats,
    dense: Floats,
) -> Floats:
    """Rows bounds[t] to bounds[t + 1] by thread t; four entries at a time, so that sums stay in registers."""
    width = dense.shape[1]
    result = np.zeros((len(starts) - 1, width), np.float32)
    for t in numba.prange(len(bounds) - 1):
        for i in range(bounds[t], bounds[t + 1]):
            end = starts[i + 1]
            e = np.int64(starts[i])
            while e + 4 <= end:
                a, b, c, d = columns[e], columns[e + 1], columns[e + 2], columns[e + 3]
                p, q, r, s = values[e], values[e + 1], values[e + 2], values[e + 3]
                for k in range(width):
                    result[i, k] += p * dense[a, k] + q * dense[b, k] + r * dense[c, k] + s * dense[d, k]
                e += 4
            while e < end:
                a, p = columns[e], values[e]
                for k in range(width):
                    result[i, k] += p * dense[a, k]
                e += 1
    return result


def _check_diffuse(scene: Scene) -> None:
    for material in scene._materials:
        if not material.diffuse:
            raise PrtError(
                f"shape '{material.name}' is not diffuse: light is gathered from diffuse surfaces only; "
                "use path tracing instead"
            )
