"""Clustered PCA of a light transport matrix, of its factors: the matrix itself is never formed ([HR10] 6).

Rows of white transport t_j are taken as functions on the sphere: t_j / sqrt(d_omega_j) has their L2 norm, as T has the
solid angle in it. Rows weigh by their vertices' area.

What makes it quick: inner products of rows are those of their coordinates in the space that a sample of rows spans, a
few hundred numbers in place of thousands; for T = A D + S these are A times those of D, plus those of S. A fifth of the
rows finds the clusters, the others join them. Only the bases at the end are made of the rows themselves.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Protocol

import numba
import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from mi_sparse_prt.compression.cpca import Clusters, affine_space, random_mixtures, two_pass_cpca
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.glossy import GlossyTransport
from mi_sparse_prt.hashing import mix
from mi_sparse_prt.matrix import LightTransport, MeshRange

COORDINATES = 192  # at most
SAMPLE = 1024  # rows that span their space
DENSE = 5  # one row in so many finds the clusters
EXPANDED = 64  # vertices at a time whose rows stay in the cache
FITTED = 4096  # rows of a cluster that its basis is made of, at most
FINAL_PASSES = 2
WORKERS = 2  # threads that fit clusters while another expands the rows of the next

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Indices = NDArray[np.int64]


class Rows(Protocol):
    """White transport by rows; ``LightTransport`` and ``GlossyTransport`` have it."""

    @property
    def lighting(self) -> CubemapLighting: ...

    def white_rows(self, ids: NDArray[np.integer]) -> Floats:
        """(k, n_directions, channels)."""

    def project_white(self, vectors: Floats, ids: NDArray[np.integer]) -> Floats:
        """Some rows times vectors (n_directions, r): (k, r, channels)."""


@dataclass(frozen=True)
class Items:
    """Vertices of one mesh, whose rows share a cluster ([Leh07] 3.3).

    Attributes
    ----------
    rows : (n, r) int64
        Numbers of each vertex's rows: one, or more for the terms of a BRDF.
    areas : (n,) float32
    shades : (n, r * channels) float32
        What the rows are multiplied with in T, squared, all three channels together.
    keys : (n,) uint64
        Of the vertices.
    """

    rows: Indices
    areas: Floats
    shades: Floats
    keys: NDArray[np.uint64]


class SphereRows:
    """White transport of some vertices, rows scaled to the L2 norm on the sphere.

    Parameters
    ----------
    transport : Rows
    items : Items
    """

    def __init__(self, transport: Rows, items: Items) -> None:
        self._transport, self.items = transport, items
        self.scale = np.sqrt(transport.lighting.solid_angles).astype(np.float32)
        self.weights = items.areas if items.areas.any() else np.ones_like(items.areas)
        self._order = np.argsort(mix(items.keys), kind="stable")

    def __len__(self) -> int:
        return len(self.items.rows)

    def sample(self, count: int) -> Indices:
        """Some vertices, chosen by their keys: the same ones in any order of vertices."""
        return np.sort(self._order[:count])

    def rows(self, ids: Indices) -> Floats:
        """(k, r * channels, n_directions)."""
        result = np.empty((len(ids), self.items.shades.shape[1], len(self.scale)), np.float32)
        per_item = self.items.rows.shape[1]
        for a in range(0, len(ids), EXPANDED):
            some = ids[a : a + EXPANDED]
            white = self._transport.white_rows(self.items.rows[some].ravel())  # [row, direction, channel]
            by_channel = np.moveaxis(white, 2, 1).reshape(len(some), per_item, -1, len(self.scale))
            into = result[a : a + EXPANDED].reshape(by_channel.shape)
            np.divide(by_channel, self.scale, out=into)
        return result

    def span(self) -> Floats:
        """Orthonormal vectors (at most COORDINATES, n_directions) that a sample of rows nearly lies in."""
        ids = self.sample(SAMPLE)
        some = self.rows(ids).reshape(-1, len(self.scale))
        weights = np.repeat(self.weights[ids], len(some) // len(ids))
        random = random_mixtures(len(some), COORDINATES)
        found: Floats = affine_space(some, weights, COORDINATES, some[:0], False, 1, random)[1]
        return found if len(found) else np.eye(1, some.shape[1], dtype=np.float32)  # all is black

    def coordinates(self, span: Floats) -> Floats:
        """Of all vertices, (n, r * channels, q) for q vectors."""
        vectors = span.T / self.scale[:, None]
        found = self._transport.project_white(vectors, self.items.rows.ravel())  # [row, vector, channel]
        found = np.ascontiguousarray(np.moveaxis(found, 2, 1))
        return found.reshape(len(self), self.items.shades.shape[1], len(span))


def mesh_rows(transport: LightTransport | GlossyTransport, mesh: MeshRange) -> SphereRows:
    """The rows of one mesh; a glossy vertex has those of its terms, too.

    Terms count in T as their outgoing factors do on average over views, which are orthogonal to each other.
    """
    own = mesh.vertices
    rows, shades = np.arange(own.start, own.stop)[:, None], np.square(transport.albedo[own])[:, None]
    if isinstance(transport, GlossyTransport):
        numbers, factors = transport.term_numbers(own)
        rows = np.concatenate([rows, numbers], axis=1)
        shades = np.concatenate([shades, np.broadcast_to(factors, (len(rows), *factors.shape))], axis=1)
    if transport.white_rows(rows[:1, 0]).shape[2] == 1:  # it stands for three
        shades = shades.sum(axis=2, keepdims=True)
    shades = shades.reshape(len(rows), -1).astype(np.float32)
    return SphereRows(transport, Items(rows, transport.areas[own], shades, transport.vertex_keys[own]))


@dataclass(frozen=True)
class MeshClusters:
    """One mesh, compressed, and what that left out.

    Attributes
    ----------
    labels : (n,) int64
    coefficients : (n, r * channels, b) float16
    means : (k, n_directions) float16
    bases : (k, b, n_directions) float16
    left : (b + 1,) float64
        Squared error on the sphere, weighted by area, with 0 to b vectors.
    energy : float
        Squared norm of the rows, weighted so.
    squares, norms : float
        Squared error and squared norm of T's rows: not weighted, albedo and solid angles included.
    """

    labels: Indices
    coefficients: NDArray[np.float16]
    means: NDArray[np.float16]
    bases: NDArray[np.float16]
    left: NDArray[np.float64]
    energy: float
    squares: float
    norms: float

    def first(self, count: int) -> MeshClusters:
        """With fewer basis vectors; ``squares`` are those of all."""
        return replace(
            self,
            coefficients=self.coefficients[:, :, :count],
            bases=self.bases[:, :count],
            left=self.left[: count + 1],
        )


def clustered_mesh(
    rows: SphereRows, clusters: int, bases: int, centred: bool = True, seed: int = 0
) -> MeshClusters:
    """Clustered PCA of one mesh in two passes.

    Parameters
    ----------
    rows : SphereRows
    clusters, bases : int
        At most.
    centred : bool
        Whether a cluster's space passes through its mean, or through the origin.
    seed : int
    """
    span = rows.span()
    coordinates = rows.coordinates(span)
    dense = rows.sample(max(-(-len(rows) // DENSE), min(len(rows), clusters * bases)))
    found = two_pass_cpca(coordinates, rows.weights, dense, clusters, bases, centred, seed)
    return finished(rows, found, span, centred)


def finished(rows: SphereRows, found: Clusters, span: Floats, centred: bool = True) -> MeshClusters:
    """Spaces made of the rows themselves, coefficients of all rows, and their errors; all rounded to 16 bits.

    Parameters
    ----------
    rows : SphereRows
    found : Clusters
        In coordinates.
    span : (q, n_directions) float32
        What these are coordinates of.
    centred : bool
    """
    spaces, sums = _Spaces(rows, found, span, centred), np.zeros(found.bases.shape[1] + 4)
    with threadpool_limits(1, user_api="blas"), _one_thread(), ThreadPoolExecutor(WORKERS) as pool:
        pending: deque[Future[Doubles]] = deque()
        for c, ids, some, is_first in _blocks(rows, found):
            while len(pending) > (WORKERS if is_first else 0):  # later blocks need the space of the first
                sums += pending.popleft().result()  # in order: the same sums in each run
            pending.append(pool.submit(spaces.fill, c, ids, some, is_first))
        for future in pending:
            sums += future.result()
    left, rest = np.maximum(sums[:-3], 0), sums[-3:]
    return MeshClusters(found.labels, spaces.coefficients, spaces.means, spaces.bases, left, *rest.tolist())


class _Spaces:
    """The spaces of all clusters and the coefficients of all vertices, filled in block by block."""

    def __init__(self, rows: SphereRows, found: Clusters, span: Floats, centred: bool) -> None:
        self._rows, self._found, self._span, self._centred = rows, found, span, centred
        k, b, m, lines = *found.bases.shape[:2], span.shape[1], rows.items.shades.shape[1]
        self.means, self.bases = np.zeros((k, m), np.float16), np.zeros((k, b, m), np.float16)
        self.coefficients = np.zeros((len(rows), lines, b), np.float16)
        self._random = random_mixtures(FITTED * lines, 0)
        self._squared_scale = np.square(rows.scale)

    def fill(self, c: int, ids: Indices, some: Floats, is_first: bool) -> Doubles:
        """Take rows (n, r * channels, m) of one cluster, which are lost: what they add to ``left`` and other sums."""
        if is_first:
            self._fit(c, ids, some.reshape(-1, some.shape[2]))
        mean, basis = self.means[c].astype(np.float32), self.bases[c].astype(np.float32)
        shades, weights = self._rows.items.shades[ids], self._rows.weights[ids].astype(np.float64)
        squares, norms = _squares(some, self._squared_scale)
        self.coefficients[ids] = some @ basis.T - mean @ basis.T
        along = self.coefficients[ids].astype(np.float32)
        one = np.ones((*along.shape[:2], 1), np.float32)
        some -= np.concatenate([along, one], axis=2) @ np.concatenate([basis, mean[None]])
        errors, left_out = _squares(some, self._squared_scale)
        kept = np.square(along, dtype=np.float64).sum(axis=1)[:, ::-1]  # [vertex, vector], the last one first
        parts = np.column_stack([errors.sum(axis=1), kept])
        more = np.cumsum(parts, axis=1)[:, ::-1]  # [vertex, vectors that count]
        rest = weights @ squares.sum(axis=1), (shades * left_out).sum(), (shades * norms).sum()
        return np.concatenate([weights @ more, rest])

    def _fit(self, c: int, ids: Indices, rows: Floats) -> None:
        weights = np.repeat(self._rows.weights[ids], len(rows) // len(ids))
        start, b = self._found.bases[c] @ self._span, self.bases.shape[1]
        mean, basis = affine_space(rows, weights, b, start, self._centred, FINAL_PASSES, self._random)
        self.means[c], self.bases[c, : len(basis)] = mean, basis


@contextmanager
def _one_thread() -> Iterator[None]:
    """Let kernels that this thread calls use no others: theirs would wait busily for the next one."""
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        yield
    finally:
        numba.set_num_threads(threads)


@numba.njit(fastmath=True, nogil=True, cache=True)
def _squares(rows: Floats, weights: Floats) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Sums (n, channels) of squares along rows (n, channels, m), and of squares times weights (m,)."""
    n, channels, m = rows.shape
    plain, weighted = np.empty((n, channels)), np.empty((n, channels))
    for i in range(n):
        for c in range(channels):
            a, b = np.float32(0), np.float32(0)
            for j in range(m):
                square = rows[i, c, j] * rows[i, c, j]
                a += square
                b += square * weights[j]
            plain[i, c], weighted[i, c] = a, b
    return plain, weighted


def _blocks(rows: SphereRows, found: Clusters) -> Iterator[tuple[int, Indices, Floats, bool]]:
    """Clusters, the largest first, in blocks of rows; the first block of each is a fair sample."""
    members = [np.flatnonzero(found.labels == c) for c in range(len(found))]
    for c in np.argsort([-len(some) for some in members], kind="stable"):
        ids = members[c]
        if len(ids) > FITTED:
            ids = np.random.default_rng(0).permutation(ids)
        for a in range(0, len(ids), FITTED):
            some = ids[a : a + FITTED]
            yield int(c), some, rows.rows(some), a == 0
