"""Noise taken out of densely sampled rows: light transport is of low rank, path noise is not ([HR10] 5.1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.sparse
from numpy.typing import NDArray


@dataclass(frozen=True)
class DenoisingOptions:
    """How singular vectors above the noise are found.

    Attributes
    ----------
    exact : int
        Rows or columns, up to which no precision is given up for speed.
    sketch : int
        Singular vectors looked for first; scenes have had at most 142.
    passes : int
        Over the Gram matrix; after 4, errors of dense rows are within 0.3% of those of exact vectors.
    balancings : int
        Of rows and columns in turn; after 5, the deviations of the noise have settled within 1%.
    least_row, least_column : float
        Least deviation, in means of all.
    """

    exact: int = 256
    sketch: int = 192
    passes: int = 4
    balancings: int = 5
    least_row: float = 0.02
    least_column: float = 0.3


@dataclass(frozen=True)
class DenoisedRows:
    """A matrix ``left @ right`` of low rank, and what noise is left in it.

    Attributes
    ----------
    left : (n, r) float32
    right : (r, m) float32
        Orthonormal rows, but for a factor per column.
    noise : (n,) float32
        Squared norm to be expected of the noise in each row of ``left``.
    """

    left: NDArray[np.float32]
    right: NDArray[np.float32]
    noise: NDArray[np.float32]

    @property
    def rank(self) -> int:
        return len(self.right)

    def matrix(self) -> NDArray[np.float32]:
        """The matrix (n, m)."""
        return self.left @ self.right


def denoise_rows(
    rows: NDArray[np.float32], variance: NDArray[np.float32], options: DenoisingOptions | None = None
) -> DenoisedRows:
    """The low-rank matrix closest to the one that noisy rows are estimates of.

    Parameters
    ----------
    rows : (n, m) float32
        Independent, unbiased estimates.
    variance : (n, m) float32
        Of each estimate. Taken for a product of one factor per row and one per column, by which the matrix is scaled
        to unit noise: noise that is uneven looks like signal (Landa et al. 2022, "Biwhitening Reveals the Rank of a
        Count Matrix").
    options : DenoisingOptions, optional

    Returns
    -------
    DenoisedRows
        Of as many singular values as rise above those of noise alone.

    Notes
    -----
    Singular values y (in units of sqrt(n), with aspect beta = m / n) at or below 1 + sqrt(beta) are noise and are
    dropped; the others shrink to sqrt((y^2 - beta - 1)^2 - 4 beta) / y, which minimizes the expected squared error
    (Gavish and Donoho 2017, "Optimal Shrinkage of Singular Values", eq. 7).
    """
    if not variance.any():  # nothing to take out, or one path per element: the noise is unknown
        return DenoisedRows(rows, np.eye(rows.shape[1], dtype=np.float32), np.zeros(len(rows), np.float32))
    options = options or DenoisingOptions()
    by_row, by_column = _deviations(variance, options)
    left, values, right = _leading(rows, by_row, by_column, options)
    n, m = max(rows.shape), min(rows.shape)
    beta, squares = m / n, values.astype(np.float64) ** 2 / n
    shrunk = np.sqrt(np.maximum((squares - beta - 1) ** 2 - 4 * beta, 0)) / squares  # new over old values
    noise = np.float32((shrunk**2).sum()) * by_row**2
    return DenoisedRows(left * shrunk.astype(np.float32) * by_row[:, None], right * by_column, noise)


def smooth_rows(rows: DenoisedRows, smoothing: scipy.sparse.csr_array) -> DenoisedRows:
    """Neighbouring rows averaged wherever that takes away no more than noise.

    What smoothing would change is scaled by 1 - (its energy if it were noise) / (its energy), 0 at least, with
    energies averaged over the neighbours: the positive-part estimator of James and Stein.

    Parameters
    ----------
    rows : DenoisedRows
        Of n rows.
    smoothing : (n, n) sparse
        A row has the weights of a row's neighbours and its own; they sum to 1.

    Returns
    -------
    DenoisedRows
        With the same ``right``, and ``noise`` as before smoothing.
    """
    if not rows.noise.any():
        return rows
    smooth = smoothing @ rows.left
    change = rows.left - smooth
    difference = scipy.sparse.eye_array(len(change), format="csr") - smoothing
    least = 1e-12 * float(rows.noise.max())
    noise = np.maximum(difference.multiply(difference) @ rows.noise, least)
    excess = smoothing @ (np.einsum("nr,nr->n", change, change) / noise)
    kept = np.maximum(1 - 1 / np.maximum(excess, 1), 0).astype(np.float32)
    return DenoisedRows(smooth + kept[:, None] * change, rows.right, rows.noise)


def _deviations(
    variance: NDArray[np.float32], options: DenoisingOptions
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Factors of rows (n,) and columns (m,) whose product stands for the standard deviation of the noise.

    They make the mean variance of every scaled row and column 1 (Sinkhorn's iteration). No noise counts as a little.
    """
    n, m = variance.shape
    rows: NDArray[np.floating] = np.ones(n, np.float32)  # variances
    columns: NDArray[np.floating] = np.ones(m, np.float32)
    for _ in range(options.balancings):
        columns = _raise_to_least((1 / rows) @ variance / np.float32(n), options.least_column)
        rows = _raise_to_least(variance @ (1 / columns) / np.float32(m), options.least_row)
    return np.sqrt(rows, dtype=np.float32), np.sqrt(columns, dtype=np.float32)


def _raise_to_least(variance: NDArray[np.floating], least: float) -> NDArray[np.floating]:
    mean = float(np.sqrt(variance, dtype=np.float64).mean())
    return np.maximum(variance, np.float32((least * mean) ** 2 or 1.0))


def _leading(
    rows: NDArray[np.float32],
    by_row: NDArray[np.float32],
    by_column: NDArray[np.float32],
    options: DenoisingOptions,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Of rows in units of noise: singular vectors times values (n, r), values (r,) and vectors (r, m).

    Those whose values are above the largest one of unit noise alone.
    """
    n, m = rows.shape
    least = np.sqrt(n) + np.sqrt(m)
    if min(n, m) <= options.exact:
        scaled = (rows / by_row[:, None] / by_column).astype(np.float32, copy=False)
        left, values, right = np.linalg.svd(scaled, full_matrices=False)
        found = int((values > least).sum())
        return left[:, :found] * values[:found], values[:found], right[:found]
    if n < m:
        long, values, short = _leading(rows.T, by_column, by_row, options)
        return short.T * values, values, (long / values).T
    squares, vectors = _eigenvectors_above(_gram(rows, by_row, by_column), least**2, options)
    projected = (rows @ (vectors / by_column[:, None])) / by_row[:, None]
    return projected.astype(np.float32, copy=False), np.sqrt(squares), vectors.T


def _gram(
    rows: NDArray[np.float32], by_row: NDArray[np.float32], by_column: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Products (m, m) of columns of rows in units of noise.

    float32 loses what is 3000 times smaller than the largest singular value; path noise is larger than that.
    """
    gram = np.zeros((rows.shape[1], rows.shape[1]), np.float32)
    block = 4096  # rows at a time
    for a in range(0, len(rows), block):
        scaled = rows[a : a + block] / by_row[a : a + block, None]
        scaled /= by_column
        gram += scaled.T @ scaled  # NumPy computes half of it
    return gram


def _eigenvectors_above(
    gram: NDArray[np.float32], least: float, options: DenoisingOptions
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Eigenvalues (r,) above a limit and their vectors (m, r).

    By subspace iteration (Halko, Martinsson and Tropp 2011, algorithm 4.4): few rise above the noise, and those that
    hardly do are shrunk to almost nothing. If they are many after all, exactly.
    """
    basis = np.random.default_rng(0).standard_normal((len(gram), options.sketch), np.float32)
    for _ in range(options.passes):
        basis = _orthonormalise(gram @ basis)
    squares, turned = np.linalg.eigh(basis.T @ (gram @ basis))
    if (squares > least).sum() <= 0.8 * options.sketch:
        return squares[squares > least], basis @ turned[:, squares > least]
    values, vectors = scipy.linalg.eigh(
        gram, subset_by_value=(least, np.inf), driver="evx", overwrite_a=True, check_finite=False
    )
    return values, vectors


def _orthonormalise(vectors: NDArray[np.float32]) -> NDArray[np.float32]:
    """The columns (m, b) made orthonormal, by Cholesky factors of their products: a sixth of the time of a QR.

    They square the condition, for which float64 has room unless a column is hardly more than rounding. All by NumPy:
    SciPy has a BLAS of its own, whose threads wait busily for a while and leave NumPy's one core of two.
    """
    wide = vectors.astype(np.float64)
    try:
        inverse = np.linalg.inv(np.linalg.cholesky(wide.T @ wide))
    except np.linalg.LinAlgError:
        return np.linalg.qr(vectors)[0]
    return (wide @ inverse.T).astype(np.float32)
