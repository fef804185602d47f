"""Clustered PCA of a light transport matrix, of its factors: the matrix itself is never formed ([HR10] 6).

Rows of unit-albedo transport t_j are taken as functions on the sphere: t_j / sqrt(d_omega_j) has their L2 norm, as T
has the solid angle in it. Rows weigh by their vertices' area.

What makes it quick: inner products of rows are those of their coordinates in the space that a sample of rows spans, a
few hundred numbers in place of thousands; for T = A D + S these are A times those of D, plus those of S. A fifth of the
rows finds the clusters, the others join them. Only the bases at the end are made of the rows themselves.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from threading import Event

import numba
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.compression.cpca import (
    Clusters,
    affine_space,
    random_mixtures,
    refined_space,
    two_pass_cpca,
)
from mi_sparse_prt.core.random_keys import mix
from mi_sparse_prt.core.threads import run_overlapped
from mi_sparse_prt.measurement.measurement import MeshRange
from mi_sparse_prt.transport import LightTransport

COORDINATES = 192  # at most
SAMPLE = 1024  # rows that span their space
DENSE = 5  # one row in so many finds the clusters
CACHED = 64  # rows at a time that stay in the cache
EXPANDED = 64  # vertices at a time whose rows stay in the cache
FITTED = 4096  # rows of a cluster that its basis is made of, at most

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True)
class Items:
    """Vertices of one mesh, whose rows share a cluster ([Leh07] 3.3).

    Attributes
    ----------
    rows : (n, r) int64
        Numbers of each vertex's rows: one, or more for the terms of a BRDF.
    areas : (n,) float32
    output_weights : (n, r * channels) float32
        What the rows are multiplied with in T, squared, all three channels together.
    keys : (n,) uint64
        Of the vertices.
    """

    rows: Indices
    areas: Floats
    output_weights: Floats
    keys: NDArray[np.uint64]


class SphereRows:
    """Unit-albedo transport of some vertices, rows scaled to the L2 norm on the sphere.

    Parameters
    ----------
    transport : LightTransport
    items : Items
    """

    def __init__(self, transport: LightTransport, items: Items) -> None:
        self._incident, self.items = transport.incident, items
        self.scale = np.sqrt(transport.emission.weights).astype(np.float32)
        self._inverse = np.float32(1) / self.scale
        self.weights = items.areas if items.areas.any() else np.ones_like(items.areas)
        self._order = np.argsort(mix(items.keys), kind="stable")

    def __len__(self) -> int:
        return len(self.items.rows)

    def sample(self, count: int) -> Indices:
        """Some vertices, chosen by their keys: the same ones in any order of vertices."""
        return np.sort(self._order[:count])

    def rows(self, ids: Indices) -> Floats:
        """(k, r * channels, n_directions)."""
        result = np.empty((len(ids), self.items.output_weights.shape[1], len(self.scale)), np.float32)
        per_item = self.items.rows.shape[1]
        for a in range(0, len(ids), EXPANDED):
            some = ids[a : a + EXPANDED]
            unit_albedo = self._incident.rows(self.items.rows[some].ravel())  # [row, direction, channel]
            by_channel = np.moveaxis(unit_albedo, 2, 1).reshape(len(some), per_item, -1, len(self.scale))
            into = result[a : a + EXPANDED].reshape(by_channel.shape)
            np.multiply(by_channel, self._inverse, out=into)
        return result

    def span(self) -> Floats:
        """Orthonormal vectors (at most COORDINATES, n_directions) that a sample of rows nearly lies in."""
        ids = self.sample(SAMPLE)
        some = self.rows(ids).reshape(-1, len(self.scale))
        weights = np.repeat(self.weights[ids], len(some) // len(ids))
        random = random_mixtures(len(some), COORDINATES)
        found: Floats = affine_space(some, weights, COORDINATES, some[:0], False, random)[1]
        return found if len(found) else np.eye(1, some.shape[1], dtype=np.float32)  # all is black

    def coordinates(self, span: Floats) -> Floats:
        """Of all vertices, (n, r * channels, q) for q vectors."""
        vectors: Floats = span.T * self._inverse[:, None]
        found = self._incident.take(self.items.rows.ravel()).apply(vectors)  # [row, channel, vector]
        return found.reshape(len(self), self.items.output_weights.shape[1], len(span))


def mesh_rows(transport: LightTransport, mesh: MeshRange) -> SphereRows:
    """The rows of one mesh; a glossy vertex has those of its terms, too.

    Terms count in T as their outgoing factors do on average over views, which are orthogonal to each other.
    """
    own, measurement = mesh.vertices, transport.measurement
    rows, output_weights = transport.reflection.squares(own)
    if transport.incident.shape[2] == 1:  # it stands for three
        output_weights = output_weights.sum(axis=2, keepdims=True)
    output_weights = output_weights.reshape(len(rows), -1).astype(np.float32)
    return SphereRows(transport, Items(rows, measurement.areas[own], output_weights, measurement.keys[own]))


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
    return finalise(rows, found, coordinates, centred)


def finalise(rows: SphereRows, found: Clusters, coordinates: Floats, centred: bool = True) -> MeshClusters:
    """Spaces made of the rows themselves, coefficients of all rows, and their errors; all rounded to 16 bits.

    Parameters
    ----------
    rows : SphereRows
    found : Clusters
        In coordinates.
    coordinates : (n, r * channels, q) float32
        Of all vertices.
    centred : bool
    """
    spaces, sums = _Spaces(rows, found, coordinates, centred), np.zeros(found.bases.shape[1] + 4)
    for more in run_overlapped(partial(spaces.fill, *block) for block in _blocks(rows, found)):
        sums += more
    left, rest = np.maximum(sums[:-3], 0), sums[-3:]
    return MeshClusters(found.labels, spaces.coefficients, spaces.means, spaces.bases, left, *rest.tolist())


class _Spaces:
    """The spaces of all clusters and the coefficients of all vertices, filled in block by block."""

    def __init__(self, rows: SphereRows, found: Clusters, coordinates: Floats, centred: bool) -> None:
        self._rows, self._found, self._coordinates, self._centred = rows, found, coordinates, centred
        k, b, m, lines = *found.bases.shape[:2], len(rows.scale), rows.items.output_weights.shape[1]
        self.means, self.bases = np.zeros((k, m), np.float16), np.zeros((k, b, m), np.float16)
        self.coefficients = np.zeros((len(rows), lines, b), np.float16)
        self._random = random_mixtures(min(len(rows), FITTED) * lines, b)
        self._squared_scale = np.square(rows.scale)
        self._fitted = [Event() for _ in range(k)]

    def fill(self, c: int, ids: Indices, some: Floats, is_first: bool) -> Doubles:
        """Take rows (n, r * channels, m) of one cluster: what they add to ``left`` and the other sums."""
        if is_first:
            try:
                self._fit(c, ids, some)
            finally:
                self._fitted[c].set()
        else:
            self._fitted[c].wait()
        flat = some.reshape(-1, some.shape[2])
        mean, basis = self.means[c].astype(np.float32), self.bases[c].astype(np.float32)
        if not is_first:
            self.coefficients[ids] = (flat @ basis.T - basis @ mean).reshape(*some.shape[:2], -1)
        along = self.coefficients[ids].astype(np.float32)
        ones = np.ones((len(flat), 1), np.float32)
        points = np.concatenate([along.reshape(len(flat), -1), ones], axis=1)
        sums = _squares(flat, points, np.concatenate([basis, mean[None]]), self._squared_scale)
        sums = sums.reshape(4, *some.shape[:2])
        weights, output_weights = (
            self._rows.weights[ids].astype(np.float64),
            self._rows.items.output_weights[ids],
        )
        kept = np.square(along, dtype=np.float64).sum(axis=1)[:, ::-1]  # [vertex, vector], the last one first
        parts = np.column_stack([sums[1].sum(axis=1), kept])
        more = np.cumsum(parts, axis=1)[:, ::-1]  # [vertex, vectors that count]
        rest = (
            weights @ sums[0].sum(axis=1),
            (output_weights * sums[3]).sum(),
            (output_weights * sums[2]).sum(),
        )
        return np.concatenate([weights @ more, rest])

    def _fit(self, c: int, ids: Indices, some: Floats) -> None:
        """What the coordinates know of the components is where the rows begin; chance, where they know nothing."""
        rows = some.reshape(-1, some.shape[2])
        weights = np.repeat(self._rows.weights[ids], some.shape[1])
        away = self._coordinates[ids].reshape(len(rows), -1) - self._found.means[c]
        products, unknown = away @ self._found.bases[c].T, ~self._found.bases[c].any(axis=1)
        products[:, unknown] = self._random[: len(rows), : unknown.sum()]
        mean, basis, along = refined_space(rows, weights, products, self._centred)
        self.means[c], self.bases[c, : len(basis)] = mean, basis
        self.coefficients[ids, :, : len(basis)] = along.reshape(*some.shape[:2], -1)


@numba.njit(fastmath=True, nogil=True, cache=True)
def _squares(rows: Floats, along: Floats, space: Floats, weights: Floats) -> Doubles:
    """Sums of squares of rows (n, m), and of what is left of them: (4, n).

    Of rows and of differences to along (n, b) @ space (b, m); then of both, times weights (m,).
    """
    sums = np.zeros((4, len(rows)))
    for first in range(0, len(rows), CACHED):
        points = np.dot(along[first : first + CACHED], space)
        for i in range(len(points)):
            a, b, c, d = np.float32(0), np.float32(0), np.float32(0), np.float32(0)
            for j in range(rows.shape[1]):
                row = rows[first + i, j]
                left = row - points[i, j]
                a += row * row
                b += left * left
                c += row * row * weights[j]
                d += left * left * weights[j]
            sums[0, first + i], sums[1, first + i], sums[2, first + i], sums[3, first + i] = a, b, c, d
    return sums


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
