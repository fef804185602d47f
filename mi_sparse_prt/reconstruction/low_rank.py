"""Noise taken out of densely sampled rows: light transport is of low rank, path noise is not ([HR10] 5.1)."""

from __future__ import annotations

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

SMALL = 256  # rows or columns, up to which no precision is given up for speed
BALANCINGS = 5  # of rows and columns in turn; the deviations settle within 1%
LEAST_ROW, LEAST_COLUMN = 0.02, 0.3  # least deviation, in means of all


def denoised(rows: NDArray[np.float32], variance: NDArray[np.float32]) -> tuple[NDArray[np.float32], int]:
    """The low-rank matrix closest to the one that noisy rows are estimates of.

    Parameters
    ----------
    rows : (n, m) float32
        Independent, unbiased estimates.
    variance : (n, m) float32
        Of each estimate. Taken for a product of one factor per row and one per column, by which the matrix is scaled
        to unit noise: noise that is uneven looks like signal (Landa et al. 2022, "Biwhitening Reveals the Rank of a
        Count Matrix").

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
    by_row, by_column = _deviations(variance)
    scaled = np.asarray(rows * (1 / by_row)[:, None], np.float32)
    scaled *= 1 / by_column
    left, values, right = _leading(scaled)
    n, m = max(rows.shape), min(rows.shape)
    beta, squares = m / n, values.astype(np.float64) ** 2 / n
    new = np.sqrt(n * np.maximum((squares - beta - 1) ** 2 - 4 * beta, 0) / squares)
    shrunk = (left * (new.astype(np.float32) * by_row[:, None])) @ (right * by_column)
    return shrunk, len(values)


def _deviations(variance: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Factors of rows (n,) and columns (m,) whose product stands for the standard deviation of the noise.

    They make the mean variance of every scaled row and column 1 (Sinkhorn's iteration). No noise counts as a little.
    """
    n, m = variance.shape
    rows: NDArray[np.floating] = np.ones(n, np.float32)  # variances
    columns: NDArray[np.floating] = np.ones(m, np.float32)
    for _ in range(BALANCINGS):
        columns = _raised((1 / rows) @ variance / np.float32(n), LEAST_COLUMN)
        rows = _raised(variance @ (1 / columns) / np.float32(m), LEAST_ROW)
    return np.sqrt(rows, dtype=np.float32), np.sqrt(columns, dtype=np.float32)


def _raised(variance: NDArray[np.floating], least: float) -> NDArray[np.floating]:
    mean = float(np.sqrt(variance, dtype=np.float64).mean())
    return np.maximum(variance, np.float32((least * mean) ** 2 or 1.0))


def _leading(
    scaled: NDArray[np.float32],
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Singular vectors (n, r), values (r,) and vectors (r, m) above the largest value of unit noise alone."""
    least = np.sqrt(scaled.shape[0]) + np.sqrt(scaled.shape[1])
    if min(scaled.shape) <= SMALL:
        left, values, right = np.linalg.svd(scaled, full_matrices=False)
        found = int((values > least).sum())
        return left[:, :found], values[:found], right[:found]
    tall = scaled if scaled.shape[0] >= scaled.shape[1] else scaled.T
    # float32 loses what is 3000 times smaller than the largest; path noise is larger than that
    gram = scipy.linalg.blas.ssyrk(1.0, tall.T, lower=True)
    squares, short = scipy.linalg.eigh(
        gram,
        lower=True,
        subset_by_value=(least**2, np.inf),
        driver="evx",
        overwrite_a=True,
        check_finite=False,
    )
    values = np.sqrt(squares)
    long = tall @ (short / values)
    return (long, values, short.T) if tall is scaled else (short, values, long.T)
