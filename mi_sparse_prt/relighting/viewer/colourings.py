"""What a matrix is made of, as colours of vertices: clusters, their ranks, and vertices that were sampled densely."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import matplotlib
import numpy as np
from matplotlib.colors import hsv_to_rgb
from numpy.typing import NDArray

from mi_sparse_prt.operators.clustered import Clustered
from mi_sparse_prt.operators.haar_rows import HaarRows
from mi_sparse_prt.transport import LightTransport

GOLDEN = 0.6180339887498949  # colours of neighbouring clusters differ by this part of the circle of hues
HELD = 0.95  # of what a cluster's basis vectors add to its mean, squared: as many as hold this are its rank
DENSE, OTHERS = (255, 176, 48), (48, 58, 84)

Colours = NDArray[np.uint8]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Colouring:
    """Colours of vertices, and what they say.

    Attributes
    ----------
    colours : (n_v, 3) uint8
        sRGB.
    legend : str
        One line.
    """

    colours: Colours
    legend: str


def colourings(transport: LightTransport) -> dict[str, Colouring | str]:
    """``"clusters"``, ``"rank"`` and ``"dense"``; a sentence in place of one that this matrix does not know."""
    return {"clusters": _clusters(transport), "rank": _rank(transport), "dense": _dense(transport)}


def in_page(
    found: Mapping[str, Colouring | str], order: Ints
) -> tuple[dict[str, Colours], dict[str, dict[str, str]]]:
    """Arrays of a page, whose vertices come in an order, and what it says of colourings, known and unknown."""
    known = {name: made for name, made in found.items() if isinstance(made, Colouring)}
    words = {
        "legends": {name: made.legend for name, made in known.items()},
        "unknown": {name: sentence for name, sentence in found.items() if isinstance(sentence, str)},
    }
    return {f"{name}Colours": made.colours[order] for name, made in known.items()}, words


def _clusters(transport: LightTransport) -> Colouring | str:
    """Each cluster has a colour of its own, unlike that of its neighbours."""
    operator = transport.operators.get("compressed")
    if not isinstance(operator, Clustered):
        return "The matrix has no clusters: compress it by clustered PCA."
    numbers = np.arange(len(operator.means))
    hues = np.stack([numbers * GOLDEN % 1, 0.45 + 0.3 * (numbers % 2), np.full(len(numbers), 0.9)], axis=1)
    colours = np.rint(255 * np.asarray(hsv_to_rgb(hues))).astype(np.uint8)
    return Colouring(colours[_labels(transport, operator)], f"{len(numbers)} clusters")


def _rank(transport: LightTransport) -> Colouring | str:
    """How many numbers rows need: dark where few do."""
    operator = transport.operators.get("compressed")
    if isinstance(operator, Clustered):
        ranks = cluster_ranks(operator)[_labels(transport, operator)]
        words = f"of {operator.bases.shape[1]} basis vectors hold {HELD:.0%} of the energy"
    elif isinstance(operator, HaarRows):
        ranks = np.diff(operator.starts[:: operator.scales.shape[1]])
        words = "wavelet coefficients were kept"
    else:
        return "Ranks are not known: the matrix is not compressed."
    low, high = int(ranks.min()), int(ranks.max())
    shares = (ranks - low) / max(high - low, 1)
    colours = np.rint(255 * matplotlib.colormaps["viridis"](shares)[:, :3]).astype(np.uint8)
    return Colouring(colours, f"{low} (dark) to {high} (bright) {words}")


def _labels(transport: LightTransport, operator: Clustered) -> Ints:
    """Clusters (n_v,) of vertices, without the rows of terms, which are those of their vertices."""
    return operator.labels[: len(transport.measurement)].astype(np.int64)


def cluster_ranks(operator: Clustered) -> Ints:
    """How many basis vectors each cluster (k,) needs for what they all add to its mean, but for a share.

    All clusters have the same number of vectors, whether they need them or not.
    """
    # vectors are orthonormal, so that squares of coefficients add up to those of rows
    squares = np.square(operator.coefficients, dtype=np.float32).sum(axis=1)  # [row, vector]
    energies = np.zeros(operator.bases.shape[:2])
    np.add.at(energies, operator.labels, squares)
    held = np.cumsum(-np.sort(-energies, axis=1), axis=1)  # by the largest ones
    all_hold = held.max(axis=1, initial=0)
    ranks: Ints = (held < HELD * all_hold[:, None]).sum(axis=1) + (all_hold > 0)
    return ranks


def _dense(transport: LightTransport) -> Colouring | str:
    """Vertices whose rows were sampled themselves, bright; the others', dark, follow from theirs."""
    ids, count = transport.dense_vertices, len(transport.measurement)
    if ids is None:
        return "Dense vertices are not known: all were sampled alike, or the file is older than this colour."
    colours = np.full((count, 3), OTHERS, np.uint8)
    colours[ids] = DENSE
    return Colouring(colours, f"{len(ids):,} of {count:,} vertices (bright) were sampled themselves")
