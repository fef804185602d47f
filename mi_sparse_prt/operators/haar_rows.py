"""Rows of unit-albedo transport as lists of Haar wavelet coefficients ([NRH03]).

Rows are kept as functions on the sphere, t_j / sqrt(d_omega_j), for which the wavelets are orthonormal.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numba
import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mi_sparse_prt.core.ragged import select_rows
from mi_sparse_prt.core.threads import run_in_parts
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.emission.haar import haar, inverse_haar
from mi_sparse_prt.operators.operator import Floats, Ids, Operator


@dataclass(frozen=True)
class HaarRows(Operator):
    """Direct and indirect light together, compressed.

    Attributes
    ----------
    starts : (n_v * channels + 1,) int64
        Where the coefficients of each vertex and channel begin in the next two arrays; channels of a vertex follow
        each other.
    places : (m,) uint16 or uint32
        Which coefficients, ascending (``emission.haar`` has the layout).
    values : (m,) float16
    scales : (n_v, channels) float32
        What the values are multiplied by.
    lighting : CubemapLighting
    """

    kind: ClassVar[str] = "haar_rows"
    stored: ClassVar[tuple[str, ...]] = ("starts", "places", "values", "scales")
    starts: NDArray[np.int64]
    places: NDArray[np.unsignedinteger]
    values: NDArray[np.float16]
    scales: Floats
    lighting: CubemapLighting

    @property
    def shape(self) -> tuple[int, int, int]:
        return len(self.scales), self.lighting.n_directions, self.scales.shape[1]

    def rows(self, ids: Ids) -> Floats:
        some, m = self.take(ids), self.lighting.n_directions
        values = some.values * np.repeat(some.scales.ravel(), np.diff(some.starts))
        lists = (values, some.places.astype(np.int32), some.starts)
        coefficients = scipy.sparse.csr_array(lists, shape=(some.scales.size, m)).toarray()
        unit_albedo = inverse_haar(coefficients) * self._scale()
        return np.ascontiguousarray(np.moveaxis(unit_albedo.reshape(*some.scales.shape, m), 1, 2))

    def columns(self, ids: Ids) -> Floats:
        ids = np.asarray(ids)
        single = np.zeros((self.lighting.n_directions, len(ids)), np.float32)
        single[ids, np.arange(len(ids))] = 1
        products = self._products(self._transformed(single)[None])
        return np.ascontiguousarray(np.moveaxis(products, 1, 2))

    def relight(self, lighting: Floats) -> Floats:
        colours = self._transformed(lighting)
        if self.scales.shape[1] == 3:  # each channel has its own light
            return self._products(np.ascontiguousarray(colours.T[..., None]))[..., 0]
        return self._products(colours[None])[:, 0]

    def _apply(self, x: Floats) -> Floats:
        return self._products(np.stack([self._transformed(x[:, c]) for c in range(x.shape[1])]))

    def check(self) -> None:
        fit = self.places.shape == self.values.shape and self.values.dtype == np.float16
        if self.scales.shape[1] not in (1, 3) or not fit:
            raise ValueError("wavelet coefficients and their vertices do not fit together")
        # a wrong list would read beyond the lighting's coefficients
        lists = (self.places, self.places, self.starts)
        matrix = scipy.sparse.csr_array(lists, shape=(self.scales.size, self.lighting.n_directions))
        matrix.check_format(full_check=True)
        if not matrix.has_canonical_format:
            raise ValueError("wavelet coefficients are not in order")

    def take(self, source: Ids) -> HaarRows:
        channels = self.scales.shape[1]
        lists = (np.asarray(source, np.int64)[:, None] * channels + np.arange(channels)).ravel()
        starts, _, entries = select_rows(self.starts, lists)
        return replace(
            self,
            starts=starts,
            places=self.places[entries],
            values=self.values[entries],
            scales=self.scales[source],
        )

    def _transformed(self, vectors: Floats) -> Floats:
        """Coefficients (n_directions, k) of vectors (n_directions, k)."""
        return np.ascontiguousarray(haar((vectors * self._scale()[:, None]).T).T)

    def _products(self, vectors: Floats) -> Floats:
        """(n_v, channels, k) with transformed vectors (1 or channels, n_directions, k)."""
        (n, channels), k = self.scales.shape, vectors.shape[2]
        result = np.zeros((n, channels, k), np.float32)
        lists = self.starts, self.places, self.values.view(np.uint16), self.scales
        run_in_parts(_times_three if k == 3 else _times, n, *lists, vectors, result)
        return result

    def _scale(self) -> Floats:
        return np.sqrt(self.lighting.solid_angles, dtype=np.float32)


@numba.njit(inline="always")
def half_float(half: int) -> np.float32:
    """A float16 from its 16 bits: where float32 has them they mean 2^-112 of it, as exponents count from elsewhere."""
    bits = np.uint32(((half & 0x8000) << 16) | ((half & 0x7FFF) << 13))
    return bits.view(np.float32) * np.float32(2.0**112)


@numba.njit(nogil=True, fastmath=True, cache=True)
def _times_three(
    first: int,
    last: int,
    starts: NDArray[np.int64],
    places: NDArray[np.unsignedinteger],
    halves: NDArray[np.uint16],
    scales: Floats,
    vectors: Floats,
    result: Floats,
) -> None:
    """``_times`` with three vectors: the sums stay in registers. Slices keep checks of signs out of the loop."""
    channels = scales.shape[1]
    for i in range(first, last):
        for c in range(channels):
            light = vectors[c % len(vectors)]
            start, end = starts[i * channels + c], starts[i * channels + c + 1]
            own_places, own_halves = places[start:end], halves[start:end]
            red, green, blue = np.float32(0), np.float32(0), np.float32(0)
            for e in range(len(own_places)):
                value, j = half_float(own_halves[e]), own_places[e]
                red += value * light[j, 0]
                green += value * light[j, 1]
                blue += value * light[j, 2]
            scale = scales[i, c]
            result[i, c, 0], result[i, c, 1], result[i, c, 2] = red * scale, green * scale, blue * scale


@numba.njit(nogil=True, fastmath=True, cache=True)
def _times(
    first: int,
    last: int,
    starts: NDArray[np.int64],
    places: NDArray[np.unsignedinteger],
    halves: NDArray[np.uint16],
    scales: Floats,
    vectors: Floats,
    result: Floats,
) -> None:
    """Products (n, channels, k) of lists with vectors (1 or channels, m, k), the same for all channels or one each."""
    channels, k = scales.shape[1], vectors.shape[2]
    for i in range(first, last):
        for c in range(channels):
            light, sums = vectors[c % len(vectors)], result[i, c]
            start, end = starts[i * channels + c], starts[i * channels + c + 1]
            own_places, own_halves = places[start:end], halves[start:end]
            for e in range(len(own_places)):
                value, j = half_float(own_halves[e]) * scales[i, c], own_places[e]
                for q in range(k):
                    sums[q] += value * light[j, q]
