"""Single elements of the parts of a matrix, without their rows."""

from __future__ import annotations

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mi_sparse_prt.core.bits import bits_at
from mi_sparse_prt.core.ragged import select_rows
from mi_sparse_prt.operators.clustered import Clustered
from mi_sparse_prt.operators.fractional_visibility import FractionalVisibility
from mi_sparse_prt.operators.haar_rows import HaarRows
from mi_sparse_prt.operators.interpolated import Interpolated
from mi_sparse_prt.operators.low_rank import LowRank
from mi_sparse_prt.operators.mean_cosine import FIXED_POINT, MeanCosine
from mi_sparse_prt.operators.upsampled import Upsampled
from mi_sparse_prt.operators.visibility import Visibility

BLOCK = (
    1 << 15
)  # elements at a time: an interpolated one has up to 40 dense ones, those four coarse ones each

EXPANDED = 512  # compressed rows at a time

Ids = NDArray[np.integer]
AnyPart = (
    Visibility | FractionalVisibility | MeanCosine | Upsampled | Interpolated | LowRank | HaarRows | Clustered
)


def elements(part: AnyPart, ids: Ids, texels: Ids) -> NDArray[np.float32]:
    """White elements of a part of a matrix.

    Parameters
    ----------
    part : Part
    ids, texels : (m,) integers
        Vertices and texels.

    Returns
    -------
    (m, channels) float32
        ``part.rows(ids)[range(m), texels]``, radiance that vertices of albedo 1 send out.
    """
    if isinstance(part, Visibility):
        return _seen(part, ids, texels)
    if isinstance(part, FractionalVisibility):
        return part.elements(ids, texels)[:, None]
    if isinstance(part, MeanCosine):
        weights = part.lighting.solid_angles[texels] / np.float32(np.pi * FIXED_POINT)
        return (part.fixed[ids, texels] * weights)[:, None]
    if isinstance(part, HaarRows | Clustered):
        few = [slice(a, a + EXPANDED) for a in range(0, max(len(ids), 1), EXPANDED)]
        return np.concatenate([part.rows(ids[b])[np.arange(len(ids[b])), texels[b]] for b in few])
    blocks = [slice(a, a + BLOCK) for a in range(0, max(len(ids), 1), BLOCK)]
    if isinstance(part, Upsampled):
        return np.concatenate([_interreflected(part, ids[b], texels[b]) for b in blocks])
    if isinstance(part, LowRank):
        return np.concatenate([_multiplied(part, ids[b], texels[b]) for b in blocks])
    return np.concatenate([_interpolated(part, ids[b], texels[b]) for b in blocks])


def _seen(part: Visibility, ids: Ids, texels: Ids) -> NDArray[np.float32]:
    seen = bits_at(part.bits, ids, texels)
    cosine = np.einsum("md,md->m", part.normals[ids], part.lighting.directions[texels])
    weights = part.lighting.solid_angles[texels] / np.float32(np.pi)
    return (np.maximum(cosine, 0) * seen * weights).astype(np.float32)[:, None]


def _interreflected(part: Upsampled, ids: Ids, texels: Ids) -> NDArray[np.float32]:
    element, coarse, weights = _entries(part.upsampling, texels)
    density = part.density[ids[element], coarse].astype(np.float32)  # [entry, channel]
    fine = _summed(element, weights, density, len(ids))
    return fine * part.lighting.solid_angles[texels][:, None]


def _multiplied(part: LowRank, ids: Ids, texels: Ids) -> NDArray[np.float32]:
    pairs = zip(part.left, part.right, strict=True)
    return np.stack([np.einsum("mr,rm->m", a[ids], b[:, texels]) for a, b in pairs], axis=1)


def _interpolated(part: Interpolated, ids: Ids, texels: Ids) -> NDArray[np.float32]:
    element, dense, weights = _entries(part.weights, ids)
    return _summed(element, weights, elements(part.dense, dense, texels[element]), len(ids))


def _entries(
    matrix: scipy.sparse.csr_array, rows: Ids
) -> tuple[NDArray[np.int64], NDArray[np.integer], NDArray[np.floating]]:
    """Position in ``rows``, column and value of all entries of these rows of a matrix."""
    _, position, entry = select_rows(matrix.indptr, rows)
    return position, matrix.indices[entry], matrix.data[entry]


def _summed(
    element: NDArray[np.int64], weights: NDArray[np.floating], values: NDArray[np.float32], n: int
) -> NDArray[np.float32]:
    """Sums of weighted entries (entries, channels) over their elements, (n, channels)."""
    channels = [np.bincount(element, weights * v, minlength=n) for v in values.T]
    return np.stack(channels, axis=1).astype(np.float32)
