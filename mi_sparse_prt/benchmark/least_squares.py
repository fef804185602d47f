"""Weights by plain least squares, which [HR10] 5.1 compares its l1 minimization with."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mi_sparse_prt.reconstruction.l1 import Fit, check_products

Floats = NDArray[np.float64]


def least_squares_fit(gram: ArrayLike, correlation: ArrayLike, squared_norm: ArrayLike) -> Fit:
    """Minimise ``||A a - y||^2``, by the shortest a where several do.

    Parameters
    ----------
    gram, correlation, squared_norm : (m, k, k), (m, k), (m,)
        As for `l1_fit`.

    Returns
    -------
    Fit
        Eigenvectors whose eigenvalue is at most k eps times the largest (eps of the Gram matrix's type) carry no
        weight: columns shorter than sqrt(k eps) of the longest, or closer to each other, are lost in noise. ``gap`` and
        ``iterations`` are 0.

    Raises
    ------
    PrtError
        For shapes that do not match, or values that are not finite (naming the problem).
    """
    G, r, s, eps = check_products(gram, correlation, squared_norm)
    m, k = r.shape
    weights, objective = np.zeros((m, k)), s.copy()
    block = 4096  # eigendecompositions at a time
    for a in range(0, m if k else 0, block):
        part = slice(a, a + block)
        weights[part], objective[part] = _by_eigenvectors(
            G[part].astype(np.float64), r[part], s[part], k * eps
        )
    return Fit(weights, objective, np.zeros(m), np.zeros(m, dtype=np.int64))


def _by_eigenvectors(G: Floats, r: Floats, s: Floats, cut_off: float) -> tuple[Floats, Floats]:
    """Weights and objectives of a block of problems."""
    present = np.einsum("mii->mi", G) > 0  # [problem, unknown]
    scale = np.abs(G).max(axis=(1, 2))
    scale[scale == 0] = 1
    G, r = G / scale[:, None, None], r / scale[:, None]

    values, vectors = np.linalg.eigh(G)  # [problem, eigenvalue], [problem, unknown, eigenvalue]
    values = np.maximum(values, 0)
    kept = values > cut_off * values[:, -1:]
    inverse = kept / np.where(kept, values, 1)
    weights = np.einsum("mij,mj->mi", vectors, inverse * np.einsum("mij,mi->mj", vectors, r)) * present

    square = np.einsum("mi,mi->m", weights, np.einsum("mij,mj->mi", G, weights) - 2 * r) * scale + s
    return weights, np.maximum(square, 0)
