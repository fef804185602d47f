"""Weights by plain least squares and by ridge regression, which [HR10] 5.1 compares its l1 minimization with."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mi_sparse_prt.reconstruction.l1 import Fit, check_option, check_products

Floats = NDArray[np.float64]


def least_squares_fit(
    gram: ArrayLike, correlation: ArrayLike, squared_norm: ArrayLike, relative_ridge: float = 0.0
) -> Fit:
    """Minimise ``||A a - y||^2 + ridge ||a||^2``, by the shortest a where several do.

    Parameters
    ----------
    gram, correlation, squared_norm : (m, k, k), (m, k), (m,)
        As for `l1_fit`.
    relative_ridge : float
        Ridge in units of the mean of the Gram matrix's diagonal, over unknowns whose column is not 0.

    Returns
    -------
    Fit
        Eigenvectors whose eigenvalue (plus ridge) is at most k eps times the largest (eps of the Gram matrix's type)
        carry no weight: columns shorter than sqrt(k eps) of the longest, or closer to each other, are lost in noise.
        The objective includes the ridge; ``gap`` and ``iterations`` are 0.

    Raises
    ------
    PrtError
        For shapes that do not match, values that are not finite (naming the problem), or a negative ridge.
    """
    G, r, s, eps = check_products(gram, correlation, squared_norm)
    check_option("relative_ridge", relative_ridge, relative_ridge >= 0, "0 or more")
    m, k = r.shape
    weights, objective = np.zeros((m, k)), s.copy()
    block = 4096  # eigendecompositions at a time
    for a in range(0, m if k else 0, block):
        part = slice(a, a + block)
        weights[part], objective[part] = _by_eigenvectors(
            G[part].astype(np.float64), r[part], s[part], relative_ridge, k * eps
        )
    return Fit(weights, objective, np.zeros(m), np.zeros(m, dtype=np.int64))


def _by_eigenvectors(
    G: Floats, r: Floats, s: Floats, relative_ridge: float, cut_off: float
) -> tuple[Floats, Floats]:
    """Weights and objectives of a block of problems."""
    diagonal = np.einsum("mii->mi", G)  # [problem, unknown]
    present = diagonal > 0
    scale = np.abs(G).max(axis=(1, 2))
    scale[scale == 0] = 1
    G, r = G / scale[:, None, None], r / scale[:, None]
    mean = (diagonal * present).sum(axis=1) / scale / np.maximum(present.sum(axis=1), 1)
    ridge = relative_ridge * mean

    values, vectors = np.linalg.eigh(G)  # [problem, eigenvalue], [problem, unknown, eigenvalue]
    values = np.maximum(values, 0) + ridge[:, None]
    kept = values > cut_off * values[:, -1:]
    inverse = kept / np.where(kept, values, 1)
    weights = np.einsum("mij,mj->mi", vectors, inverse * np.einsum("mij,mi->mj", vectors, r)) * present

    square = np.einsum("mi,mi->m", weights, np.einsum("mij,mj->mi", G, weights) - 2 * r) * scale + s
    return weights, np.maximum(square, 0) + ridge * scale * (weights**2).sum(axis=1)
