"""What applies an update of the light to T: incident light of all rows, from one frame to the next.

========================  ======================================  ==================================================
``ColumnsPlayer``         lists of wavelet coefficients           adds columns ([OBRG06] Figure 6)
``ClusteredPlayer``       clustered PCA                           both of its steps go on from before (6.3)
``ProductPlayer``         any other matrix: bits, A D, low rank   the whole product T L~ in every frame
========================  ======================================  ==================================================

Sums over thousands of frames do not drift: what wavelets are added to has 64 bits, and of clustered PCA some clusters
are summed anew in every frame.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

import numba
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.emission.haar import inverse_haar
from mi_sparse_prt.operators.clustered import Clustered
from mi_sparse_prt.operators.haar_rows import HaarRows
from mi_sparse_prt.operators.operator import Operator
from mi_sparse_prt.relighting.approximations import Update
from mi_sparse_prt.relighting.clusters import ClusterColumns, cluster_columns
from mi_sparse_prt.relighting.columns import WaveletColumns, add_columns, wavelet_columns

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Ints = NDArray[np.int64]

REFRESH = 128  # frames within which all clusters are summed anew
MANY = 4  # a whole product is quicker than a sum of more columns than this part of all
DROPPED = 18  # bits of a float that do not tell how much a change matters: to within 3%
COEFFICIENTS = 512  # of clusters, that a thread works on at a time: they stay in its cache


class Player(ABC):
    """Sums of T L~ that follow L~.

    Attributes
    ----------
    prepared_bytes : int
        What it keeps in memory beside the matrix: a converted matrix, and sums.
    """

    name: ClassVar[str]

    @property
    @abstractmethod
    def incident(self) -> Floats:
        """T L~ (rows, 3): unit-albedo light of points, then of terms."""

    def radiance(self, albedo: Floats) -> Floats:
        """What leaves diffuse points of an albedo (rows, 3): (rows, 3)."""
        return _times(albedo, self.incident)

    @abstractmethod
    def reset(self) -> None:
        """No light."""

    @abstractmethod
    def apply(self, update: Update) -> None:
        """Bring the sums up to date."""

    @abstractmethod
    def column_norms(self) -> Floats | None:
        """(m,) how much wavelets do to all rows together; None if that would take the whole matrix."""

    @property
    @abstractmethod
    def prepared_bytes(self) -> int: ...


def player(
    operator: Operator, lighting: CubemapLighting, groups: int = 1, vectors: int | None = None
) -> Player:
    """What plays a linear factor of T best.

    Parameters
    ----------
    operator : Operator
    lighting : CubemapLighting
    groups : int
        Of coefficients that are reset apart from each other (``Approximation.groups``).
    vectors : int, optional
        Basis vectors of each cluster whose weights are applied in a frame; a quarter of them if not given.
    """
    if isinstance(operator, Clustered):
        clusters = cluster_columns(operator)
        return ClusteredPlayer(clusters, groups, clusters.quarter if vectors is None else vectors)
    if isinstance(operator, HaarRows):
        return ColumnsPlayer(wavelet_columns(operator, lighting), groups)
    return ProductPlayer(operator, lighting)


class ProductPlayer(Player):
    """The whole product in every frame: as dear as relighting, and exact for any matrix."""

    name = "product"

    def __init__(self, operator: Operator, lighting: CubemapLighting) -> None:
        self._operator, self._lighting = operator, lighting
        self.reset()

    def reset(self) -> None:
        self._incident = np.zeros((self._operator.shape[0], 3), np.float32)

    @property
    def incident(self) -> Floats:
        return self._incident

    def apply(self, update: Update) -> None:
        texels = inverse_haar(update.applied.T).T / np.sqrt(self._lighting.solid_angles)[:, None]
        self._incident = self._operator.relight(np.ascontiguousarray(texels, np.float32))

    def column_norms(self) -> Floats | None:
        return None

    @property
    def prepared_bytes(self) -> int:
        return self._incident.nbytes


class ColumnsPlayer(Player):
    """Columns of wavelets, added to an image for each group of coefficients that may be reset ([OBRG06] Figure 6).

    The sum of these images changes with them, so that a frame without resets costs no more than it adds.
    """

    name = "columns"

    def __init__(self, columns: WaveletColumns, groups: int = 1) -> None:
        self.columns, self._groups = columns, groups
        self.reset()

    def reset(self) -> None:
        rows = len(self.columns.scales)
        self._total = np.zeros((rows, 3))
        self._sums = np.zeros((self._groups, rows if self._groups > 1 else 0, 3))

    @property
    def incident(self) -> Floats:
        return _times(self.columns.scales, self._total)

    def apply(self, update: Update) -> None:
        columns = self.columns
        halves = columns.values.view(np.uint16)
        parts = update.coefficients, update.changes, update.starts, update.resets
        add_columns(
            columns.starts,
            columns.places,
            halves,
            columns.scales.shape[1],
            parts,
            self._sums,
            self._total,
        )

    def column_norms(self) -> Floats | None:
        return self.columns.norms()

    @property
    def prepared_bytes(self) -> int:
        return self.columns.nbytes + self._total.nbytes + self._sums.nbytes


class ClusteredPlayer(Player):
    """Clustered PCA: wavelets change coefficients of clusters, and these the light of rows ([OBRG06] 6.3).

    Parameters
    ----------
    clusters : ClusterColumns
    groups : int
    vectors : int, optional
        Basis vectors that are applied in a frame, for each cluster on average: those whose coefficients changed most,
        times the norm of their weights, wherever they are. What is left out is applied later. All if not given, and in
        the first frame.
    """

    name = "clustered"

    def __init__(self, clusters: ClusterColumns, groups: int = 1, vectors: int | None = None) -> None:
        self.clusters, self._groups = clusters, groups
        self.vectors = clusters.sizes.shape[1] if vectors is None else vectors
        self.reset()

    def reset(self) -> None:
        values, rows = self.clusters.columns.shape[1], len(self.clusters.order)
        self._sums = np.zeros((self._groups, 3, values))
        self._done = np.zeros((3, values))  # coefficients of clusters that rows show
        self._rows = np.zeros((3, rows), np.float32)  # by cluster
        self._bins = np.zeros(1 << (31 - DROPPED), np.int32)
        self._frame = 0

    @property
    def incident(self) -> Floats:
        return self.radiance(np.ones((len(self.clusters.order), 1), np.float32))

    def radiance(self, albedo: Floats) -> Floats:
        return _in_order(self._rows, self.clusters.order, albedo)

    def apply(self, update: Update) -> None:
        coefficients = self._coefficients(update)
        changes = _changes(coefficients, self._done, self.clusters.sizes)
        _add_to_rows(
            (coefficients, self._done, changes),
            (self.clusters.weights, self.clusters.starts),
            (self._least(changes), self._frame % REFRESH),
            self._rows,
        )
        self._frame += 1

    def _coefficients(self, update: Update) -> Doubles:
        """Coefficients of clusters (3, values) after an update."""
        columns = self.clusters.columns
        if self._groups == 1 and len(update.coefficients) > len(columns) // MANY:
            self._sums[0] = update.applied.T @ columns
            return self._sums[0]
        parts = update.coefficients, update.changes, update.starts, update.resets
        return _add_to_clusters(columns, parts, self._sums)

    def _least(self, changes: Floats) -> float:
        """Changes from here on are applied; the first frame is exact."""
        count = self.vectors * len(changes)
        if count >= changes.size or self._frame == 0:
            return 0.0
        return float(_threshold(changes.ravel(), count, self._bins))

    def column_norms(self) -> Floats | None:
        return self.clusters.norms()

    @property
    def prepared_bytes(self) -> int:
        return self.clusters.nbytes + sum(a.nbytes for a in (self._sums, self._done, self._rows))


@numba.njit(parallel=True, fastmath=True, cache=True)
def _add_to_clusters(
    columns: Floats, update: tuple[Ints, Floats, Ints, NDArray[np.bool_]], sums: Doubles
) -> Doubles:
    """Coefficients of clusters (3, values) from columns (m, values); ``sums`` (groups, 3, values) are updated."""
    coefficients, changes, group_starts, resets = update
    values = columns.shape[1]
    total = np.zeros((3, values))
    for chunk in numba.prange(-(-values // COEFFICIENTS)):
        first, last = chunk * COEFFICIENTS, min((chunk + 1) * COEFFICIENTS, values)
        for g in range(len(resets)):
            for colour in range(3):
                own = sums[g, colour, first:last]
                if resets[g]:
                    own[:] = 0
                for k in range(group_starts[g], group_starts[g + 1]):
                    change, column = np.float64(changes[k, colour]), columns[coefficients[k], first:last]
                    for q in range(len(own)):
                        own[q] += change * column[q]
                for q in range(len(own)):  # loops here and below: slices of slices compile for seconds
                    total[colour, first + q] += own[q]
    return total


@numba.njit(fastmath=True, cache=True)
def _changes(now: Doubles, done: Doubles, norms: Doubles) -> Floats:
    """How much it matters that coefficients of vectors changed: (clusters, b)."""
    clusters, b = norms.shape
    sizes = np.empty((clusters, b), np.float32)
    for c in range(clusters):
        first = c * (b + 1) + 1
        for q in range(b):
            red = now[0, first + q] - done[0, first + q]
            green = now[1, first + q] - done[1, first + q]
            blue = now[2, first + q] - done[2, first + q]
            sizes[c, q] = norms[c, q] * np.sqrt(red * red + green * green + blue * blue)
    return sizes


@numba.njit(cache=True)
def _threshold(sizes: Floats, count: int, bins: NDArray[np.int32]) -> np.float32:
    """What at least ``count`` sizes reach, and few more: the highest of as many as are alike to within 3%.

    Floats that are not negative have the order of their bits: the first count in ``bins``, 0 before and after.
    """
    bits, top = sizes.view(np.int32), 0
    for k in range(len(bits)):
        place = bits[k] >> DROPPED
        bins[place] += 1
        top = max(top, place)
    reached, least = 0, np.zeros(1, np.int32)
    while top > 0 and reached < count:
        reached += bins[top]
        least[0] = top << DROPPED
        top -= 1
    for k in range(len(bits)):
        bins[bits[k] >> DROPPED] = 0
    return least.view(np.float32)[0]


@numba.njit(parallel=True, fastmath=True, cache=True)
def _add_to_rows(
    clusters: tuple[Doubles, Doubles, Floats],
    layout: tuple[Floats, Ints],
    frame: tuple[float, int],
    rows: Floats,
) -> None:
    """Add to rows (3, n), by cluster, what coefficients of clusters changed.

    ``clusters``: coefficients now and as the rows show them, both (3, values), and how much their changes matter
    (clusters, b). ``layout``: weights (channels, b, n) and where clusters start. ``frame``: the least change that is
    applied, and the frame's number, which says which clusters are summed anew.
    """
    now, done, changes = clusters
    weights, starts = layout
    least, turn = frame
    channels, b = weights.shape[:2]
    for c in numba.prange(len(starts) - 1):
        first, last, base = starts[c], starts[c + 1], c * (b + 1)
        anew = c % REFRESH == turn
        if anew:
            for colour in range(3):
                for q in range(base, base + b + 1):
                    done[colour, q] = 0
                for i in range(first, last):
                    rows[colour, i] = 0
        for colour in range(3):
            change = np.float32(now[colour, base] - done[colour, base])
            done[colour, base] = now[colour, base]
            for i in range(first, last):
                rows[colour, i] += change
        for q in range(b):
            if not anew and (changes[c, q] < least or changes[c, q] == 0):
                continue
            for colour in range(3):
                change = np.float32(now[colour, base + 1 + q] - done[colour, base + 1 + q])
                done[colour, base + 1 + q] = now[colour, base + 1 + q]
                weight, own = weights[colour % channels, q, first:last], rows[colour, first:last]
                for i in range(len(own)):
                    own[i] += change * weight[i]


@numba.njit(parallel=True, fastmath=True, cache=True)
def _in_order(rows: Floats, order: Ints, albedo: Floats) -> Floats:
    """Rows (3, n) that were sorted, times the albedo (n, 1 or 3), in the order of this: (n, 3)."""
    result, channels = np.empty((len(order), 3), np.float32), albedo.shape[1]
    for k in numba.prange(len(order)):
        i = order[k]
        for c in range(3):
            result[i, c] = albedo[i, c % channels] * rows[c, k]
    return result


@numba.njit(parallel=True, fastmath=True, cache=True)
def _times(factors: Floats, values: NDArray[np.floating]) -> Floats:
    """Products of (n, 1 or 3) and (n, 3)."""
    result = np.empty(values.shape, np.float32)
    channels = factors.shape[1]
    for i in numba.prange(len(values)):
        for c in range(3):
            result[i, c] = factors[i, c % channels] * values[i, c]
    return result
