"""Clustered PCA as a page keeps it: the wavelet coefficients that matter most, and 8 bits for each number.

A basis vector is a column of wavelet coefficients, most of which change nothing that is seen. Kept are the largest, by
their size times the norm of the column's weights times the size that light has at this wavelet. Numbers are signed
squares of 8 bits times the column's largest: finer steps where most numbers are. Weights of rows are of the same kind,
and their scale is that of the column.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.relighting.clusters import ClusterColumns

Floats = NDArray[np.float32]
Bytes = NDArray[np.int8]

LARGEST = 127  # of a signed byte


@dataclass(frozen=True)
class TruncatedClusters:
    """Bases of clusters, truncated, and weights of rows.

    Attributes
    ----------
    wavelets : (k,) uint16
        Of what is kept, column after column, by place in ``order_of_wavelets``.
    values : (k,) int8
    starts : (columns + 1,) int64
        Where each column begins in these.
    scales : (columns,) float32
        What a value of 127 stands for.
    order_of_wavelets : (m,) int64
        All wavelets, the coarsest first.
    weights : (channels, b, n) int8
        127 stands for 1.
    layout : ClusterColumns
        Whose columns and weights these are.
    """

    wavelets: NDArray[np.uint16]
    values: Bytes
    starts: NDArray[np.int64]
    scales: Floats
    order_of_wavelets: NDArray[np.int64]
    weights: Bytes
    layout: ClusterColumns

    def decoded(self) -> ClusterColumns:
        """What a page plays, as columns and weights that a ``ClusteredPlayer`` takes."""
        columns = np.zeros_like(self.layout.columns)
        of = np.repeat(np.arange(len(self.scales)), np.diff(self.starts))
        columns[self.order_of_wavelets[self.wavelets], of] = _expanded(self.values) * self.scales[of]
        weights = _expanded(self.weights)
        parts = np.split(weights.astype(np.float64), self.layout.starts[1:-1], axis=2)
        sizes = np.sqrt([np.square(part).sum(axis=(0, 2)) for part in parts])
        return replace(self.layout, columns=columns, weights=weights, sizes=sizes)


def truncate_clusters(
    clusters: ClusterColumns, kept: float, light: Floats, order: NDArray[np.integer]
) -> TruncatedClusters:
    """Keep a share of the wavelet coefficients.

    Parameters
    ----------
    clusters : ClusterColumns
    kept : float
        The share of them that is kept, above 0 and up to 1.
    light : (m,) float
        Sizes that coefficients of the light are expected to have.
    order : (m,) integers
        All wavelets, the coarsest first: what is near in it is stored in less.
    """
    channels = len(clusters.weights)
    parts = np.split(np.abs(clusters.weights), clusters.starts[1:-1], axis=2)
    largest = np.stack([part.max(axis=(0, 2), initial=1e-30) for part in parts])  # (clusters, b)
    scale = np.concatenate([np.ones((len(largest), 1)), largest], axis=1).ravel().astype(np.float32)
    members = np.diff(clusters.starts)
    weights: Floats = (clusters.weights / np.repeat(largest, members, axis=0).T).astype(np.float32)
    columns: Floats = clusters.columns[order] * scale
    norms = np.concatenate([np.sqrt(channels * members)[:, None], clusters.sizes / largest], axis=1).ravel()
    matters = np.abs(columns) * norms.astype(np.float32) * light[order][:, None]
    count = max(1, round(kept * matters.size))
    chosen = matters >= np.partition(matters.ravel(), -count)[-count]
    of, wavelets = np.nonzero(chosen.T & (columns.T != 0))
    scales = np.abs(columns).max(axis=0)
    return TruncatedClusters(
        wavelets.astype(np.uint16),
        _compacted(columns[wavelets, of] / scales[of]),
        np.searchsorted(of, np.arange(columns.shape[1] + 1)),
        scales,
        np.asarray(order, np.int64),
        _compacted(weights),
        clusters,
    )


def _compacted(values: Floats) -> Bytes:
    """Numbers from -1 to 1 as signed square roots."""
    return np.rint(np.sign(values) * np.sqrt(np.abs(values)) * LARGEST).astype(np.int8)


def _expanded(roots: Bytes) -> Floats:
    values = roots.astype(np.float32) / np.float32(LARGEST)
    return values * np.abs(values)
