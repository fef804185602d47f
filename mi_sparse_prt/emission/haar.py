"""The nonstandard 2-D Haar wavelets of a cubemap's faces: an orthonormal basis of its 6 x n x n texels ([NRH03]).

Coefficients come in the layout of texels: coefficient (row, col) of face f has index f n^2 + row n + col. The first of
a face is its mean times n. Level l, from 0 to log2(n) - 1, splits the face into 2^l x 2^l squares of n / 2^l texels per
side, and has three coefficients for each square, in three blocks of 2^l x 2^l:

    [0, 2^l) x [2^l, 2^(l + 1))             kind 1: left half minus right half
    [2^l, 2^(l + 1)) x [0, 2^l)             kind 2: upper half minus lower half
    [2^l, 2^(l + 1)) x [2^l, 2^(l + 1))     kind 3: upper left and lower right quarters minus the others

within which they lie as their squares do; all divided by the square's side. Levels are nested: the first 2^l x 2^l
coefficients of a face are the transform of a face of 2^l x 2^l texels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pywt
from numpy.typing import NDArray

Floats = NDArray[np.floating]


def haar(values: Floats) -> Floats:
    """Wavelet coefficients (..., 6 n^2) of values (..., 6 n^2) at texels; n is a power of two."""
    result = _faces(values).copy()
    size = result.shape[-1]
    while size > 1:
        half = size // 2
        mean, (down, across, both) = pywt.dwt2(result[..., :size, :size], "haar", "periodization")
        result[..., :half, :half], result[..., :half, half:size] = mean, across
        result[..., half:size, :half], result[..., half:size, half:size] = down, both
        size = half
    return result.reshape(values.shape)


def inverse_haar(coefficients: Floats) -> Floats:
    """Values (..., 6 n^2) at texels of wavelet coefficients (..., 6 n^2)."""
    result = _faces(coefficients).copy()
    half = 1
    while half < result.shape[-1]:
        size = 2 * half
        across, down = result[..., :half, half:size], result[..., half:size, :half]
        details = down, across, result[..., half:size, half:size]
        result[..., :size, :size] = pywt.idwt2((result[..., :half, :half], details), "haar", "periodization")
        half = size
    return result.reshape(coefficients.shape)


def _faces(values: Floats) -> Floats:
    """(..., 6, n, n)."""
    n = round((values.shape[-1] / 6) ** 0.5)
    return values.reshape(*values.shape[:-1], 6, n, n)


@dataclass(frozen=True)
class HaarSquares:
    """What each coefficient of a cubemap with n texels along a face's edge belongs to, all (6 n^2,) int64.

    Attributes
    ----------
    face : 0 to 5
    level : 0 to log2(n) - 1
        Its squares are n / 2^level texels wide; 0 for a face's mean as well.
    kind : 0 to 3
        0 is a face's mean; see the module for 1 to 3.
    row, col : 0 to 2^level - 1
        Of the square among those of its level.
    """

    face: NDArray[np.int64]
    level: NDArray[np.int64]
    kind: NDArray[np.int64]
    row: NDArray[np.int64]
    col: NDArray[np.int64]


def haar_squares(resolution: int) -> HaarSquares:
    """Names of all coefficients of a cubemap of ``resolution`` texels along a face's edge, a power of two."""
    n = resolution
    face, row, col = np.unravel_index(np.arange(6 * n * n), (6, n, n))
    level = np.log2(np.maximum(np.maximum(row, col), 1)).astype(np.int64)
    squares = 1 << level  # along an edge
    down, across = (row >= squares).astype(np.int64), (col >= squares).astype(np.int64)
    return HaarSquares(face, level, 2 * down + across, row - down * squares, col - across * squares)
