"""Which part of a light that moves is applied in a frame ([OBRG06]): wavelets, differences and resets.

An approximation knows no matrix. It takes the lighting L of a frame, as coefficients in an orthonormal basis, and a
budget of coefficients; it keeps L~, what has been applied so far, and says how to go on from there (``Update``).

=====================  ======================================================  =======================
``Linear``             the coarsest coefficients of L, the same in all frames  LWA, [NRH03]
``NonIncremental``     the largest coefficients of L, anew in every frame      NWA, [NRH03]
``Incremental``        the largest of L - L~                                   BI, equations 3 to 6
``PerBand``            of some bands one, of some the other                    PBI, Figure 6
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
from mi_sparse_prt.core.heap import keep_largest
from mi_sparse_prt.core.threads import run_in_parts
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
        flat = light.ravel()
        # the first test is quick; squares of finite light may overflow
        if not np.isfinite(flat @ flat) and not np.isfinite(light).all():
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

    def _set(self, light: Floats, chosen: Ints, resets: Flags, counts: Ints | None = None) -> Update:
        """Chosen coefficients become those of the light, after the resets; ``counts`` are those of groups, in order."""
        if counts is None:
            group = self.bands.number[chosen] if self.groups > 1 else np.zeros(len(chosen), np.int64)
            chosen = chosen[np.argsort(group, kind="stable")]
            counts = np.bincount(group, minlength=self.groups)
        if resets.any():
            _zero(self.applied, self.bands.number, resets)
        starts = np.concatenate([[0], np.cumsum(counts)])
        changes = _replace(self.applied, light, chosen)
        return Update(chosen, changes, starts, resets, self.applied)


class Linear(Approximation):
    """The first coefficients in order of bands, whatever the light: what spherical harmonics are used for ([NRH03])."""

    name = "linear"

    def _update(self, light: Floats, budget: int) -> Update:
        return self._set(light, np.argsort(self.bands.number, kind="stable")[:budget], np.ones(1, np.bool_))


class NonIncremental(Approximation):
    """NWA ([NRH03]): in every frame the largest coefficients of the light, and nothing from the frame before."""

    name = "non_incremental"

    def _update(self, light: Floats, budget: int) -> Update:
        chosen = _largest(norms(light, self.bands.weights), budget)
        return self._set(light, chosen, np.ones(1, np.bool_))


class Incremental(Approximation):
    """BI ([OBRG06] 3): the largest differences to what was applied."""

    name = "incremental"

    def _update(self, light: Floats, budget: int) -> Update:
        return self._incremental(light, _largest(norms(light - self.applied, self.bands.weights), budget))


class PerBand(Approximation):
    """PBI ([OBRG06] 5): each band goes on from the frame before, or starts anew.

    Parameters
    ----------
    bands : Bands
    exhaustive : bool
        Try every combination of bands (5.2.1); else a band starts anew if the light is nearer to 0 than to what was
        applied (5.2.2).
    power : int
        Of the weighted norms whose sum tells which is nearer: 1, as the paper has it, or 2.

    Attributes
    ----------
    resets : (bands,) bool
        Which bands started anew in the last frame.
    """

    name = "per_band"

    def __init__(self, bands: Bands, exhaustive: bool = True, power: int = 1) -> None:
        self.exhaustive, self.power = exhaustive, power
        self._offsets = np.concatenate([[0], np.cumsum(np.bincount(bands.number))])
        self._order = np.argsort(bands.number, kind="stable")
        self._sizes = np.empty((2, len(bands.number)), np.float32)  # by band
        super().__init__(bands)

    @property
    def groups(self) -> int:
        return self.bands.count

    def reset(self) -> None:
        super().reset()
        self.resets: Flags = np.zeros(self.bands.count, np.bool_)

    def _update(self, light: Floats, budget: int) -> Update:
        _sizes(light, self.applied, self.bands.weights, self._order, self._sizes)
        most = min(budget, self._sizes.shape[1])
        largest, places, lengths, totals = _largest_of_bands(self._sizes, self._offsets, most, self.power)
        if self.exhaustive:
            self.resets, counts = _best_combination(largest**self.power, lengths, totals, most)
        else:
            self.resets = totals[0] > totals[1]
            counts = _merged(largest, lengths, self.resets, most)
        chosen = [places[int(self.resets[b]), b, :k] for b, k in enumerate(counts)]
        return self._set(light, self._order[np.concatenate(chosen)], self.resets, counts)


class Everything(Approximation):
    """All that changed: T L itself, for comparison."""

    name = "everything"

    def _update(self, light: Floats, budget: int) -> Update:
        return self._everything(light)


def weighted_error(applied: Floats, light: Floats, bands: Bands) -> float:
    """How far L~ is from L, relative: the weighted L1 norm over coefficients ([OBRG06] Figure 7)."""
    left, whole = (norms(x, bands.weights).sum(dtype=np.float64) for x in (light - applied, light))
    return float(left / max(whole, 1e-30))


@numba.njit(cache=True)
def _zero(applied: Floats, number: Ints, resets: Flags) -> None:
    """Set some groups to zero; with one group all."""
    for j in range(len(applied)):
        if resets[number[j] if len(resets) > 1 else 0]:
            applied[j, 0] = applied[j, 1] = applied[j, 2] = 0


@numba.njit(cache=True)
def _replace(applied: Floats, light: Floats, chosen: Ints) -> Floats:
    """Let some coefficients be those of the light; how they change, (k, 3)."""
    changes = np.empty((len(chosen), 3), np.float32)
    for k, j in enumerate(chosen):
        for c in range(3):
            changes[k, c] = light[j, c] - applied[j, c]
            applied[j, c] = light[j, c]
    return changes


@numba.njit(parallel=True, fastmath=True, cache=True)
def norms(light: Floats, weights: Floats) -> Floats:
    """Weighted norms of colours (m, 3): (m,)."""
    sizes = np.empty(len(light), np.float32)
    for j in numba.prange(len(light)):
        a, b, c = light[j, 0], light[j, 1], light[j, 2]
        sizes[j] = weights[j] * np.sqrt(a * a + b * b + c * c)
    return sizes


@numba.njit(parallel=True, fastmath=True, cache=True)
def _sizes(light: Floats, applied: Floats, weights: Floats, order: Ints, sizes: Floats) -> None:
    """Weighted norms of L - L~ and of L (2, m), in an order."""
    for k in numba.prange(len(order)):
        j = order[k]
        a, b, c = light[j, 0], light[j, 1], light[j, 2]
        d, e, f = a - applied[j, 0], b - applied[j, 1], c - applied[j, 2]
        sizes[0, k] = weights[j] * np.sqrt(d * d + e * e + f * f)
        sizes[1, k] = weights[j] * np.sqrt(a * a + b * b + c * c)


def _largest(sizes: Floats, count: int) -> Ints:
    """Places of so many of the largest values that are not 0."""
    if count > len(sizes) // 8:  # a heap would be slower than a sort
        places = np.argsort(-sizes, kind="stable")[:count]
        return places[sizes[places] > 0]
    room, places = np.empty(count, np.float32), np.empty(count, np.int64)
    return places[: keep_largest(sizes, count, room, places)]


def _largest_of_bands(
    values: Floats, offsets: Ints, count: int, power: int
) -> tuple[Floats, Ints, Ints, NDArray[np.float64]]:
    """The largest (2, bands, count) of both modes, descending, their places, how many there are; sums of all powers."""
    bands = len(offsets) - 1
    sizes, places = np.zeros((2, bands, count), np.float32), np.zeros((2, bands, count), np.int64)
    lengths, totals = np.zeros((2, bands), np.int64), np.zeros((2, bands))
    # a thread has all bands of a mode: the finest is most of the work
    run_in_parts(_find_largest, 2, values, offsets, count, power, sizes, places, lengths, totals)
    return sizes, places, lengths, totals


@numba.njit(nogil=True, cache=True)
def _find_largest(
    first: int,
    last: int,
    values: Floats,
    offsets: Ints,
    count: int,
    power: int,
    sizes: Floats,
    places: Ints,
    lengths: Ints,
    totals: NDArray[np.float64],
) -> None:
    for mode in range(first, last):
        for band in range(len(offsets) - 1):
            own = values[mode, offsets[band] : offsets[band + 1]]
            length = keep_largest(own, count, sizes[mode, band], places[mode, band])
            for k in range(length):  # not a slice, which compiles for seconds
                places[mode, band, k] += offsets[band]
            lengths[mode, band] = length
            total = 0.0
            for value in own:
                total += value if power == 1 else value * value
            totals[mode, band] = total


@numba.njit(cache=True)
def _merged(sizes: Floats, lengths: Ints, resets: Flags, budget: int) -> Ints:
    """How many of the largest coefficients each band gets, whose modes are given."""
    counts = np.zeros(len(resets), np.int64)
    for _ in range(budget):
        largest, at = np.float32(0), -1
        for b in range(len(resets)):
            mode = int(resets[b])
            if counts[b] < lengths[mode, b] and sizes[mode, b, counts[b]] > largest:
                largest, at = sizes[mode, b, counts[b]], b
        if at < 0:
            break
        counts[at] += 1
    return counts


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
    tried = np.zeros(bands, np.bool_)
    for combination in range(1 << bands):
        for b in range(bands):
            tried[b] = (combination >> (bands - 1 - b)) & 1
        taken = _merged(sizes, lengths, tried, budget)
        left = np.float64(0)
        for b in range(bands):
            mode = int(tried[b])
            left += totals[mode, b]
            for k in range(taken[b]):
                left -= sizes[mode, b, k]
        if left < best * (1 - 1e-9):
            best = left
            resets[:], counts[:] = tried, taken
    return resets, counts
