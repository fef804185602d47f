"""Interpolation from a coarse cubemap to a finer one, continued across the edges of the faces."""

from __future__ import annotations

import numpy as np
import scipy.sparse

from mi_sparse_prt.emission.cube_faces import cube_points, texels_towards


def upsampling(coarse: int, fine: int) -> scipy.sparse.csr_array:
    """Bilinear interpolation of values at coarse texel centres to fine texel centres.

    Parameters
    ----------
    coarse, fine : int
        Resolutions; the coarse one divides the fine one. Where they are equal the result is the identity.

    Returns
    -------
    (6 n_fine^2, 6 n_coarse^2) sparse
        Rows sum to 1. Where a neighbour lies beyond a face's edge, it is the texel that the continued face plane
        points at on the next face.
    """
    n, m = fine, coarse
    if n == m:
        return scipy.sparse.eye_array(6 * n * n, format="csr", dtype=np.float32)
    face, row, col = np.unravel_index(np.arange(6 * n * n), (6, n, n))
    y, x = (
        (i + 0.5) * m / n - 0.5 for i in (row, col)
    )  # in units of coarse texels, centres at whole numbers
    data, indices = [], []
    for dy in (0, 1):
        for dx in (0, 1):
            r, c = np.floor(y) + dy, np.floor(x) + dx
            s, t = (2 * c + 1) / m - 1, (2 * r + 1) / m - 1  # may leave [-1, 1] by half a texel
            indices.append(texels_towards(cube_points(face, s, t), m))
            data.append((1 - np.abs(y - r)) * (1 - np.abs(x - c)))
    rows = np.tile(np.arange(6 * n * n), 4)
    entries = (np.concatenate(data).astype(np.float32), (rows, np.concatenate(indices)))
    return scipy.sparse.coo_array(entries, shape=(6 * n * n, 6 * m * m)).tocsr()
