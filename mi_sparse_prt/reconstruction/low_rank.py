"""Noise taken out of densely sampled rows: light transport is of low rank, path noise is not ([HR10] 5.1)."""

from __future__ import annotations

import numpy as np
import scipy.linalg
from numpy.typing import NDArray


def denoised(rows: NDArray[np.float32], variance: NDArray[np.float32]) -> tuple[NDArray[np.float32], int]:
    """The low-rank matrix closest to the one that noisy rows are estimates of.

    Parameters
    ----------
    rows : (n, m) float32
        Independent, unbiased estimates.
    variance : (n, m) float32
        Of each estimate. Rows are scaled to unit noise; within a row noise counts as even.

    Returns
    -------
    denoised : (n, m) float32
    rank : int
        Singular values that rise above those of noise alone.

    Notes
    -----
    Singular values y (in units of sqrt(n), with aspect beta = m / n) at or below 1 + sqrt(beta) are noise and are
    dropped; the others shrink to sqrt((y^2 - beta - 1)^2 - 4 beta) / y, which minimizes the expected squared error
    (Gavish and Donoho 2017, "Optimal Shrinkage of Singular Values", eq. 7).
    """
    if not variance.any():  # nothing to take out, or one path per element: the noise is unknown
        return rows, min(rows.shape)
    scale = _noise(variance)
    wide = len(rows) < rows.shape[1]
    shrunk, rank = _shrunk((rows / scale).T if wide else rows / scale)
    return (shrunk.T if wide else shrunk) * scale, rank


def _noise(variance: NDArray[np.float32]) -> NDArray[np.float32]:
    """Standard deviation of the noise of each row, (n, 1); a row without noise gets little instead of none."""
    deviation = np.sqrt(variance.mean(axis=1, keepdims=True, dtype=np.float64))
    least = 1e-3 * float(deviation.mean()) or 1.0
    return np.maximum(deviation, least).astype(np.float32)


def _shrunk(tall: NDArray[np.float32]) -> tuple[NDArray[np.float32], int]:
    """Shrink the singular values of a matrix (n, m), n >= m, with noise of standard deviation 1."""
    n, m = tall.shape
    if m == 0:
        return tall, 0
    beta = m / n
    gram = (tall.T @ tall).astype(np.float64) / n
    least = (1 + np.sqrt(beta)) ** 2
    squares, vectors = scipy.linalg.eigh(gram, subset_by_value=(least, np.inf), overwrite_a=True)
    gain = (
        np.sqrt(np.maximum((squares - beta - 1) ** 2 - 4 * beta, 0)) / squares
    )  # new over old singular value
    vectors = vectors.astype(np.float32)
    return (tall @ (vectors * gain.astype(np.float32))) @ vectors.T, len(squares)
