"""Noise averaged out along surfaces, at each vertex over as wide a neighbourhood as is worth it.

Levels of smoothing follow each other, each over neighbours that are twice as far apart, as there is less to see in what
is smooth already ("a trous", Dammertz et al. 2010, "Edge-Avoiding A-Trous Wavelet Transform for fast Global
Illumination Filtering"): three of them average as widely as 16 steps among nearest neighbours.

What n vertices with noise of variance s^2 are off by after that is not known, but Stein's unbiased estimate of it is:
|S x - x|^2 - s^2 + 2 S_ii s^2, if S is what the levels do (Stein 1981; Li, Wu and Chuang 2012, "SURE-based Optimization
for Adaptive Sampling and Reconstruction"). The neighbourhood is that for which it is least.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from typing import NamedTuple

import numba
import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mi_sparse_prt.core.morton import morton_order
from mi_sparse_prt.core.sparse_product import multiply_sparse
from mi_sparse_prt.core.threads import run_in_parts
from mi_sparse_prt.measurement.neighbours import surface_neighbours
from mi_sparse_prt.measurement.vertices import Points
from mi_sparse_prt.reconstruction.interpolation_weights import linear_weights
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.solvers.walls import Walls

NEAR = 12  # vertices of a neighbourhood; 8 leave up to twice the noise
STRIDES = (1, 4, 16)  # of vertices along a curve, of which one is looked at on each level; 64 was not better
OWN = 0.25  # of its own variance a vertex has at least: the mean of neighbours would not know that it is an outlier

Floats = NDArray[np.float32]


def smoothing_levels(
    scene: Scene,
    points: Points,
    vertices: NDArray[np.int64] | None = None,
    strides: Sequence[int] = STRIDES,
) -> list[scipy.sparse.csr_array]:
    """Each vertex of a mesh takes the value at it of the linear function that fits its neighbours best.

    Parameters
    ----------
    scene : Scene
    points : Points
        Of all vertices.
    vertices : (n,) integers, optional
        Those that are smoothed, among themselves, ascending; all if not given.
    strides : sequence of int, optional
        One of so many of them is looked at on each level.

    Returns
    -------
    list of (n, n) sparse float32
        One after another. Rows sum to 1. Neighbours face the same way, and no wall is between them.
    """
    chosen, walls = np.arange(len(points)) if vertices is None else vertices, Walls(scene, points)
    levels = []
    for stride in strides:
        every: list[_Entries] = []
        for mesh in scene.meshes:
            ids = chosen[slice(*np.searchsorted(chosen, (mesh.vertices.start, mesh.vertices.stop)))]
            every.append(_weights(scene, walls, ids, _thinned(scene, points, ids, stride)))
        levels.append(_matrix(every, chosen, chosen))
    return levels


def nearest_weights(
    scene: Scene, points: Points, vertices: NDArray[np.int64]
) -> tuple[scipy.sparse.csr_array, NDArray[np.int64]]:
    """The first level at some vertices, ascending: weights (k, m), and the vertices (m,) whose light these take."""
    walls = Walls(scene, points)
    every: list[_Entries] = []
    for mesh in scene.meshes:
        bounds = np.searchsorted(vertices, (mesh.vertices.start, mesh.vertices.stop))
        inside = np.arange(mesh.vertices.start, mesh.vertices.stop)
        every.append(_weights(scene, walls, vertices[slice(*bounds)], inside))
    seen = np.unique(np.concatenate([entries.columns for entries in every]))
    return _matrix(every, vertices, seen), seen


class _Entries(NamedTuple):
    """Of a sparse matrix: rows and columns by the scene's numbers of vertices."""

    rows: NDArray[np.int64]
    columns: NDArray[np.int64]
    values: Floats


def _matrix(
    every: list[_Entries], rows: NDArray[np.int64], columns: NDArray[np.int64]
) -> scipy.sparse.csr_array:
    """Of some vertices, by ascending numbers."""
    row, column, values = (np.concatenate(part) for part in zip(*every, strict=True))
    places = np.searchsorted(rows, row).astype(np.int32), np.searchsorted(columns, column).astype(np.int32)
    return scipy.sparse.csr_array((values, places), shape=(len(rows), len(columns)), dtype=np.float32)


def _thinned(scene: Scene, points: Points, ids: NDArray[np.int64], stride: int) -> NDArray[np.int64]:
    """About every so many vertices of a mesh, evenly spread; enough of them for a neighbourhood, if there are."""
    count = max(len(ids) // stride, min(len(ids), NEAR))
    order = morton_order(scene.normalised_positions[ids], points.keys[ids])
    return ids[np.sort(order[(2 * np.arange(count) + 1) * len(ids) // max(2 * count, 1)])]


def _weights(scene: Scene, walls: Walls, ids: NDArray[np.int64], seen: NDArray[np.int64]) -> _Entries:
    """Of the nearest of those seen, in the light of vertices of the same mesh."""
    p, n = scene.normalised_positions, scene.normals
    near = surface_neighbours(p[ids], n[ids], p[seen], n[seen], NEAR, looked_through=1)
    near = walls.without_hidden(ids, near, seen)
    weights = linear_weights(near, p[ids], n[ids], p[seen], n[seen])
    row, place = np.nonzero(near.ids >= 0)
    alone = ids[near.ids[:, 0] < 0]  # see none of these, and keep their own value
    return _Entries(
        np.concatenate([ids[row], alone]),
        np.concatenate([seen[near.ids[row, place]], alone]),
        np.concatenate([weights[row, place], np.ones(len(alone), np.float32)]),
    )


class SurfaceSmoothing:
    """No, one or more levels of smoothing, at each vertex as many as leave the least error.

    Parameters
    ----------
    levels : list of (n_v, n_v) sparse float32
        As of ``smoothing_levels``.
    """

    def __init__(self, levels: list[scipy.sparse.csr_array]) -> None:
        self._levels, near = levels, levels[0]
        self._pool = scipy.sparse.csr_array((np.ones_like(near.data), near.indices, near.indptr), near.shape)
        self._pool.data /= np.repeat(self._pool.sum(axis=1), np.diff(near.indptr))

    def pooled(self, values: Floats) -> Floats:
        """Means (n_v, k) over the neighbours of each vertex."""
        return multiply_sparse(self._pool, values)

    @cached_property
    def own(self) -> Floats:
        """What vertices have of their own value after no, one, ... levels (levels + 1, n_v)."""
        first, second, *others = self._levels
        twice = second.multiply(first.T).sum(axis=1)
        # each further level reaches four times as many vertices
        further = [twice / 4**k for k in range(1, len(others) + 1)]
        return np.stack([np.ones_like(twice), first.diagonal(), twice, *further])

    def least(self, light: Floats, risk: Callable[[Floats, int], Floats]) -> NDArray[np.int8]:
        """How many levels leave the least error.

        Parameters
        ----------
        light : (n_v, k) float32
        risk : callable
            Of ``light`` after some levels, and their number: estimates (n_v, m) of the squared error.

        Returns
        -------
        (n_v, m) int8
        """
        least = self.pooled(risk(light, 0))
        chosen = np.zeros(least.shape, np.int8)
        for number, smooth in self._after(light):
            found = self.pooled(risk(smooth, number))
            better = found < least
            chosen[better], least[better] = number, found[better]
        return chosen

    def averaged(self, light: Floats, chosen: NDArray[np.int8]) -> Floats:
        """Light (n_v, m, ...) after as many levels as were chosen (n_v, m); no seams where neighbours differ.

        Peaks are smoothed little and what is around them much: what they lose and it gains are not the same. What is
        taken from light in wide neighbourhoods, which is no noise, is given back ("twicing", Tukey 1977).
        """
        own = (*chosen.shape, *(1,) * (light.ndim - chosen.ndim))

        def share(number: int) -> Floats:
            return self.pooled((chosen == number).astype(np.float32)).reshape(own)

        result = share(0) * light
        for number, smooth in self._after(light.reshape(len(light), -1)):
            result += share(number) * smooth.reshape(light.shape)
        *_, (_, lost) = self._after((light - result).reshape(len(light), -1))
        return result + lost.reshape(light.shape)

    def _after(self, light: Floats) -> Iterator[tuple[int, Floats]]:
        """Light (n_v, k) after 1, 2, ... levels."""
        for number, level in enumerate(self._levels, 1):
            light = multiply_sparse(level, light)
            yield number, light


def smooth_light(light: Floats, variance: Floats, levels: list[scipy.sparse.csr_array]) -> Floats:
    """Estimates of light at vertices, with less noise.

    Parameters
    ----------
    light : (n_v, m, channels) float32
        Independent, unbiased estimates of m lights, of which none is negative.
    variance : (n_v, m, channels) float32
        Of each estimate.
    levels : list of (n_v, n_v) sparse float32
        As of ``smoothing_levels``.

    Returns
    -------
    (n_v, m, channels) float32
    """
    if not variance.any():  # nothing to average out, or one path per element: the noise is unknown
        return light
    smoothing = SurfaceSmoothing(levels)
    chosen, _ = _least_risk(smoothing, light, variance)
    return np.maximum(smoothing.averaged(light, chosen), 0)


def noise_left(light: Floats, variance: Floats, levels: list[scipy.sparse.csr_array]) -> Floats:
    """The variance (n_v, m, channels) that ``smooth_light`` leaves, about: what vertices have of their own values."""
    smoothing = SurfaceSmoothing(levels)
    chosen, noise = _least_risk(smoothing, light, variance)
    kept = np.zeros(chosen.shape, np.float32)
    for number, own in enumerate(smoothing.own):
        kept += smoothing.pooled((chosen == number).astype(np.float32)) * np.maximum(own, 0)[:, None]
    kept += np.maximum(smoothing.own[-1], 0)[:, None] * (1 - kept)  # with what is given back
    return kept[..., None] * noise


def _least_risk(
    smoothing: SurfaceSmoothing, light: Floats, variance: Floats
) -> tuple[NDArray[np.int8], Floats]:
    """How many levels leave the least error (n_v, m), by Stein's estimate; the noise (n_v, m, channels) without any."""
    flat, spread = light.reshape(len(light), -1), variance.reshape(len(light), -1)
    noise = np.maximum(smoothing.pooled(spread), np.float32(OWN) * spread)

    def risk(smooth: Floats, number: int) -> Floats:
        found = np.empty(light.shape[:2], np.float32)
        counts = (2 * smoothing.own[number] - 1).astype(np.float32)
        run_in_parts(_risks, len(light), smooth, flat, noise, counts, light.shape[2], found)
        return found

    return smoothing.least(flat, risk), noise.reshape(light.shape)


@numba.njit(nogil=True, cache=True)
def _risks(
    first: int,
    last: int,
    smooth: Floats,
    light: Floats,
    noise: Floats,
    counts: Floats,
    channels: int,
    found: Floats,
) -> None:
    """What smoothing changed, squared, and as much of the noise as it counts, of all channels."""
    for i in range(first, last):
        for lamp in range(found.shape[1]):
            total = np.float32(0)
            for k in range(lamp * channels, (lamp + 1) * channels):
                total += (smooth[i, k] - light[i, k]) ** 2 + counts[i] * noise[i, k]
            found[i, lamp] = total
