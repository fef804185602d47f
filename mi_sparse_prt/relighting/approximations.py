"""Which part of a light that moves is applied in a frame ([OBRG06]): wavelets, differences and resets.

An approximation knows no matrix. It takes the lighting L of a frame, as coefficients in an orthonormal basis, and a
budget of coefficients; it keeps L~, what has been applied so far, and says how to go on from there (``Update``).

=====================  ======================================================  =======================
``NonIncremental``     the largest coefficients of L, anew in every frame      NWA, [NRH03]
``Incremental``        the largest of L - L~                                   BI, equations 3 to 6
``PerBand``            of some bands one, of some the other                    PBI, Figure 6
``Leading``            the first coefficients, always: spherical harmonics     section 7
``Everything``         all that changed
=====================  ======================================================  =======================

Coefficients are compared by their weight times their norm over the colour channels. The weight of a Haar wavelet is its
square's side: an area times the height of a wavelet of height 1, whose orthonormal coefficient is that times the side.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numba
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.emission.haar import haar_bands

Floats = NDArray[np.float32]
Ints = NDArray[np.int64]
Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class Bands:
    """Bands of an orthonormal basis.

    Attributes
    ----------
    number : (m,) int64
        The band of each coefficient, from 0, the coarsest.
    weights : (m,) float32
        How much a coefficient counts when the largest are chosen.
    """

    number: Ints
    weights: Floats

    @property
    def count(self) -> int:
        return int(self.number.max()) + 1


def wavelet_bands(n: int, weights: Floats | None = None) -> Bands:
    """Levels of the Haar wavelets of 6 x n x n texels; weights are sides of squares, if no others are given."""
    number, sides = haar_bands(n)
    return Bands(number, sides if weights is None else np.asarray(weights, np.float32))


@dataclass(frozen=True)
class Update:
    """What a frame applies: L~ is set to zero in some groups of coefficients, then changes are added to it.

    Attributes
    ----------
    coefficients : (k,) int64
        Those that change, by group.
    changes : (k, 3) float32
    starts : (groups + 1,) int64
        Where each group begins in these.
    resets : (groups,) bool
    applied : (m, 3) float32
        L~ afterwards; the next frame changes it.
    """

    coefficients: Ints
    changes: Floats
    starts: Ints
    resets: Flags
    applied: Floats


class Approximation(ABC):
    """State and choice of one method.

    Parameters
    ----------
    bands : Bands

    Attributes
    ----------
    applied : (m, 3) float32
        L~.
    """

    name: ClassVar[str]

    def __init__(self, bands: Bands) -> None:
        self.bands = bands
        self.reset()

    @property
    def groups(self) -> int:
        """Groups of coefficients that are reset apart from each other."""
        return 1

    def reset(self) -> None:
        """Forget all that was applied."""
        self.applied: Floats = np.zeros((len(self.bands.number), 3), np.float32)

    def update(self, light: Floats, budget: int | None) -> Update:
        """What to apply for the light of a new frame.

        Parameters
        ----------
        light : (m, 3) float32
        budget : int or None
            Coefficients, at most; None for all, which makes L~ = L.

        Raises
        ------
        PrtError
            If the light has another shape or is not finite: the state is as before.
        """
        light = np.ascontiguousarray(light, np.float32)
        if light.shape != self.applied.shape:
            raise PrtError(
                f"light has shape {light.shape}; {self.name} was made for {self.applied.shape}: make another"
            )
        if not np.isfinite(light.sum()) and not np.isfinite(light).all():
            raise PrtError("light has values that are NaN or infinite; this frame was left out")
        if budget is not None and budget < 0:
            raise PrtError(f"a budget of {budget} coefficients: give 0 or more, or None for all")
        return self._everything(light) if budget is None else self._update(light, int(budget))

    @abstractmethod
    def _update(self, light: Floats, budget: int) -> Update: ...

    def _everything(self, light: Floats) -> Update:
        return self._incremental(light, np.flatnonzero((light != self.applied).any(axis=1)))

    def _incremental(self, light: Floats, chosen: Ints) -> Update:
        """Chosen coefficients become those of the light; no group is reset."""
        return self._set(light, chosen, np.zeros(self.groups, np.bool_))

    def _set(self, light: Floats, chosen: Ints, resets: Flags) -> Update:
        """Chosen coefficients become those of the light, after the resets."""
        group = self.bands.number if self.groups > 1 else np.zeros(1, np.int64)
        if resets.any():
            self.applied[resets[group] if self.groups > 1 else slice(None)] = 0
        if self.groups > 1:
            chosen = chosen[np.argsort(group[chosen], kind="stable")]
            starts = np.searchsorted(group[chosen], np.arange(self.groups + 1))
        else:
            starts = np.array([0, len(chosen)])
        changes = light[chosen] - self.applied[chosen]
        self.applied[chosen] = light[chosen]
        return Update(chosen, changes, starts, resets, self.applied)


class NonIncremental(Approximation):
    """NWA ([NRH03]): in every frame the largest coefficients of the light, and nothing from the frame before."""

    name = "non_incremental"

    def _update(self, light: Floats, budget: int) -> Update:
        chosen = _largest(_sizes(light, self.applied, self.bands.weights)[1], budget)
        return self._set(light, chosen, np.ones(1, np.bool_))


class Incremental(Approximation):
    """BI ([OBRG06] 3): the largest differences to what was applied."""

    name = "incremental"

    def _update(self, light: Floats, budget: int) -> Update:
        return self._incremental(light, _largest(_sizes(light, self.applied, self.bands.weights)[0], budget))


class PerBand(Approximation):
    """PBI ([OBRG06] 5): each band goes on from the frame before, or starts anew.

    Parameters
    ----------
    bands : Bands
    exhaustive : bool
        Try every combination of bands (5.2.1); else a band starts anew if the light is nearer to 0 than to what was
        applied (5.2.2), by the L1 norm.

    Attributes
    ----------
    resets : (bands,) bool
        Which bands started anew in the last frame.
    """

    name = "per_band"

    def __init__(self, bands: Bands, exhaustive: bool = True) -> None:
        self.exhaustive = exhaustive
        self._offsets = np.concatenate([[0], np.cumsum(np.bincount(bands.number))])
        self._order = np.argsort(bands.number, kind="stable")
        super().__init__(bands)

    @property
    def groups(self) -> int:
        return self.bands.count

    def reset(self) -> None:
        super().reset()
        self.resets: Flags = np.zeros(self.bands.count, np.bool_)

    def _update(self, light: Floats, budget: int) -> Update:
        differences, sizes = _sizes(light, self.applied, self.bands.weights)
        both = np.stack([differences, sizes])[:, self._order]
        totals = np.add.reduceat(both, self._offsets[:-1], axis=1, dtype=np.float64)  # [mode, band]
        most = min(budget, both.shape[1])
        if self.exhaustive and most > 0:
            largest, places, lengths = _largest_of_bands(both, self._offsets, most)
            self.resets, counts = _best_combination(largest, lengths, totals, most)
            chosen = [places[int(self.resets[b]), b, :k] for b, k in enumerate(counts)]
            return self._set(light, self._order[np.concatenate(chosen)], self.resets)
        self.resets = totals[0] > totals[1]
        ours = np.where(self.resets[self.bands.number], sizes, differences)
        return self._set(light, _largest(ours, budget), self.resets)


class Leading(Approximation):
    """The first coefficients of the basis, all of them in every frame: low-order spherical harmonics ([SKS02])."""

    name = "leading"

    def _update(self, light: Floats, budget: int) -> Update:
        return self._set(light, np.arange(min(budget, len(light))), np.ones(1, np.bool_))


class Everything(Approximation):
    """All that changed: T L itself, for comparison."""

    name = "everything"

    def _update(self, light: Floats, budget: int) -> Update:
        return self._everything(light)


def weighted_error(approximation: Approximation, light: Floats) -> float:
    """How far L~ is from L, relative: the weighted L1 norm over coefficients ([OBRG06] Figure 7)."""
    left, all_of_it = _sizes(
        np.ascontiguousarray(light, np.float32), approximation.applied, approximation.bands.weights
    )
    return float(left.sum(dtype=np.float64) / max(all_of_it.sum(dtype=np.float64), 1e-30))


@numba.njit(parallel=True, fastmath=True, cache=True)
def _sizes(light: Floats, applied: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """Weighted norms over channels of L - L~ and of L, (m,) each."""
    m = len(light)
    differences, sizes = np.empty(m, np.float32), np.empty(m, np.float32)
    for j in numba.prange(m):
        a, b, c = light[j, 0], light[j, 1], light[j, 2]
        d, e, f = a - applied[j, 0], b - applied[j, 1], c - applied[j, 2]
        sizes[j] = weights[j] * np.sqrt(a * a + b * b + c * c)
        differences[j] = weights[j] * np.sqrt(d * d + e * e + f * f)
    return differences, sizes


def _largest(sizes: Floats, count: int) -> Ints:
    """Places of so many of the largest values that are not 0, ascending."""
    if count == 0:
        return np.zeros(0, np.int64)
    places = np.argpartition(sizes, -count)[-count:] if count < len(sizes) else np.arange(len(sizes))
    return np.sort(places[sizes[places] > 0])


@numba.njit(cache=True)
def _keep_largest(values: Floats, count: int, sizes: Floats, places: Ints) -> int:
    """Write up to so many of the largest values that are not 0, descending, and their places; how many."""
    length = 0
    for j in range(len(values)):
        value = values[j]
        if value <= 0 or (length == count and value <= sizes[0]):
            continue
        if length < count:  # a heap: the least is at its root
            k, length = length, length + 1
            while k > 0 and sizes[(k - 1) // 2] > value:
                sizes[k], places[k] = sizes[(k - 1) // 2], places[(k - 1) // 2]
                k = (k - 1) // 2
        else:
            k = _sink(sizes, places, value, length)
        sizes[k], places[k] = value, j
    for end in range(length - 1, 0, -1):  # the least goes to the end, and so on
        value, place = sizes[end], places[end]
        sizes[end], places[end] = sizes[0], places[0]
        k = _sink(sizes, places, value, end)
        sizes[k], places[k] = value, place
    return length


@numba.njit(cache=True)
def _sink(sizes: Floats, places: Ints, value: np.float32, length: int) -> int:
    """Where a value goes in a heap whose root is free."""
    k = 0
    while True:
        child = 2 * k + 1
        if child >= length:
            return k
        if child + 1 < length and sizes[child + 1] < sizes[child]:
            child += 1
        if sizes[child] >= value:
            return k
        sizes[k], places[k] = sizes[child], places[child]
        k = child


@numba.njit(parallel=True, cache=True)
def _largest_of_bands(values: Floats, offsets: Ints, count: int) -> tuple[Floats, Ints, Ints]:
    """The largest (2, bands, count) of both modes, descending, their places in these, and how many there are."""
    bands = len(offsets) - 1
    sizes, places = np.zeros((2, bands, count), np.float32), np.zeros((2, bands, count), np.int64)
    lengths = np.zeros((2, bands), np.int64)
    for which in numba.prange(2 * bands):
        mode, band = which % 2, bands - 1 - which // 2
        first, last = offsets[band], offsets[band + 1]
        length = _keep_largest(values[mode, first:last], count, sizes[mode, band], places[mode, band])
        places[mode, band, :length] += first
        lengths[mode, band] = length
    return sizes, places, lengths


@numba.njit(cache=True)
def _best_combination(
    sizes: Floats, lengths: Ints, totals: NDArray[np.float64], budget: int
) -> tuple[Flags, Ints]:
    """The combination of bands that leaves least, (bands,) bool, and how many coefficients each band gets.

    Lists are merged by what their next coefficient is worth. Where combinations are alike, that with fewer resets
    among the coarse bands is taken.
    """
    bands = lengths.shape[1]
    best, resets, counts = np.float64(np.inf), np.zeros(bands, np.bool_), np.zeros(bands, np.int64)
    taken = np.zeros(bands, np.int64)
    for combination in range(1 << bands):
        left = np.float64(0)
        for b in range(bands):
            taken[b] = 0
            left += totals[(combination >> (bands - 1 - b)) & 1, b]
        for _ in range(budget):
            largest, at = np.float32(0), -1
            for b in range(bands):
                mode = (combination >> (bands - 1 - b)) & 1
                if taken[b] < lengths[mode, b] and sizes[mode, b, taken[b]] > largest:
                    largest, at = sizes[mode, b, taken[b]], b
            if at < 0:
                break
            taken[at] += 1
            left -= largest
        if left < best * (1 - 1e-9):
            best = left
            for b in range(bands):
                resets[b] = (combination >> (bands - 1 - b)) & 1
                counts[b] = taken[b]
    return resets, counts
