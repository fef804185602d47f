"""The largest Haar wavelet coefficients of each row of a light transport matrix ([NRH03]).

Rows are functions on the sphere, t_j / sqrt(d_omega_j): wavelets are orthonormal there, so that what is left out of a
row is its error. Direct and indirect light come together. The matrix is expanded a block of rows at a time.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray
from tqdm.auto import tqdm

from mi_sparse_prt.compression.clustered_pca import mesh_rows
from mi_sparse_prt.core.metrics import relative_l2_by_name
from mi_sparse_prt.core.ragged import row_starts
from mi_sparse_prt.core.threads import run_in_parts
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.emission.haar import haar
from mi_sparse_prt.measurement.measurement import MeshRange
from mi_sparse_prt.operators.haar_rows import HaarRows
from mi_sparse_prt.operators.operator import Operator
from mi_sparse_prt.transport import LightTransport

TARGET = 0.05  # relative error of a row, if not given
BLOCK = 1 << 22  # elements of the matrix, expanded at a time: about 100 MB with all copies
LARGEST = 2.0**14  # of a row's numbers as they are stored: far from where float16 has fewer digits
ROUNDING = 2.0**-22  # of the squares that are kept: what float16 adds to the squares left out, at most
BLACK = 1e-30  # rows with no larger coefficient
_DIGITS = (
    (31, 20),
    (20, 10),
    (10, 0),
)  # bits of a float32 without its sign, whose order is that of magnitudes

Indices = NDArray[np.int64]
Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]


@dataclass(frozen=True)
class HaarMesh:
    """One mesh, compressed, and what that left out.

    Attributes
    ----------
    part : HaarRows
        Of its vertices alone.
    energy, residual : float
        Squared norm of the rows on the sphere, weighted by area, and what is left out of it before numbers are rounded.
    on_sphere : float
        Squared error, weighted so; rounding included.
    squares, norms : float
        Squared error and squared norm of T's rows: not weighted, albedo and solid angles included.
    """

    part: HaarRows
    energy: float
    residual: float
    on_sphere: float
    squares: float
    norms: float


def haar_part(
    transport: LightTransport, target_error: float = TARGET, progress: bool = True
) -> tuple[HaarRows, dict[str, Any]]:
    """Keep of each row and channel as few wavelet coefficients as an error allows.

    Parameters
    ----------
    transport : LightTransport
    target_error : float
        Relative L2 error of each row on the sphere, at most; 0.05 leaves 0.0025 of its energy out.
    progress : bool
        Show a progress bar.

    Returns
    -------
    HaarRows
        Unit-albedo transport, direct and indirect light together.
    dict
        ``target_error``; ``coefficients`` of a row, per mesh: their ``mean`` and ``largest`` number; ``kept_energy``
        per mesh, a share of the squares on the sphere; ``error`` (relative L2, per mesh and ``total``, of T and
        ``on_sphere``: weighted by vertex area, solid angles divided out); ``nbytes``; ``ratio`` to float32 of the same
        channels.

    Notes
    -----
    Time O(n_v n_directions).
    """
    with tqdm(
        total=len(transport.measurement), desc="compress", unit=" vertices", disable=not progress
    ) as bar:
        found = [haar_mesh(transport, mesh, target_error, bar) for mesh in transport.meshes]
    part = _joined([mesh.part for mesh in found])
    elements = part.scales.size * transport.lighting.n_directions
    names = [mesh.name for mesh in transport.meshes]
    lengths = [np.diff(mesh.part.starts) for mesh in found]
    by_name = dict(zip(names, found, strict=True))
    report = {
        "target_error": target_error,
        "coefficients": {
            name: {"mean": float(some.mean()), "largest": int(some.max())}
            for name, some in zip(names, lengths, strict=True)
        },
        "kept_energy": {
            name: 1 - mesh.residual / mesh.energy if mesh.energy > 0 else 1.0
            for name, mesh in by_name.items()
        },
        "error": relative_l2_by_name({name: (mesh.squares, mesh.norms) for name, mesh in by_name.items()})
        | {"on_sphere": relative_l2_by_name({name: (m.on_sphere, m.energy) for name, m in by_name.items()})},
        "nbytes": part.nbytes,
        "ratio": 4 * elements / part.nbytes,
    }
    return part, report


def haar_mesh(transport: LightTransport, mesh: MeshRange, target_error: float, bar: tqdm) -> HaarMesh:
    """Truncate the rows of one mesh; the bar is told of vertices that are done."""
    sphere, m = mesh_rows(transport, mesh), transport.lighting.n_directions
    step = max(1, BLOCK // (3 * m))
    share = max(target_error**2 - ROUNDING, 0)
    blocks, sums = [], np.zeros(5)
    for a in range(0, len(sphere), step):
        ids = np.arange(a, min(a + step, len(sphere)))
        rows = sphere.rows(ids)  # [vertex, channel, direction]
        coefficients = haar(rows)
        energies = truncate(coefficients, share)
        part = _stored(coefficients, transport.lighting)
        blocks.append(part)
        sums += _sums(rows, part, energies, sphere.weights[ids], transport.albedo[mesh.vertices][ids])
        bar.update(len(ids))
    return HaarMesh(_joined(blocks), *sums.tolist())


def haar_lists(
    operator: Operator, ids: Indices, lighting: CubemapLighting, target_error: float = TARGET
) -> HaarRows:
    """Some rows of any linear factor of T as lists of wavelet coefficients; errors are those of ``haar_part``."""
    rows = np.moveaxis(operator.rows(ids), 2, 1) / np.sqrt(lighting.solid_angles)
    coefficients = haar(np.ascontiguousarray(rows, np.float32))
    truncate(coefficients, max(target_error**2 - ROUNDING, 0))
    return _stored(coefficients, lighting)


def truncate(coefficients: Floats, share: float) -> Doubles:
    """Set to zero as many of each row's coefficients (..., m) as have no more than a share of its squares together.

    Returns
    -------
    (..., 2) float64
        Squared norm of each row before, and what it lost.
    """
    flat = coefficients.reshape(-1, coefficients.shape[-1])
    energies = np.empty((len(flat), 2))
    run_in_parts(_truncate, len(flat), flat, flat.view(np.int32), share, energies)
    return energies.reshape(*coefficients.shape[:-1], 2)


@numba.njit(nogil=True, cache=True)
def _truncate(
    start: int, end: int, rows: Floats, bits: NDArray[np.int32], share: float, energies: Doubles
) -> None:
    """Find the least magnitude that is kept digit by digit, from sums of squares for each digit: no row is sorted."""
    m = rows.shape[1]
    for i in range(start, end):
        total = 0.0
        for j in range(m):
            total += np.float64(rows[i, j]) ** 2
        allowed, lost, least = share * total, 0.0, 0
        for above, below in _DIGITS:
            digits = 1 << (above - below)
            squares = np.zeros(digits)
            for j in range(m):
                size = np.int64(bits[i, j] & 0x7FFFFFFF)
                if size >> above == least:
                    squares[(size >> below) & (digits - 1)] += np.float64(rows[i, j]) ** 2
            digit = 0
            while digit < digits - 1 and lost + squares[digit] <= allowed:
                lost += squares[digit]
                digit += 1
            least = least * digits + digit
        square = np.float64(np.uint32(least).view(np.float32)) ** 2
        # as many of the least magnitude are left out as well
        equal = np.int64((allowed - lost) / square) if total > 0 else 0
        energies[i, 0], energies[i, 1] = total, lost + equal * square if total > 0 else 0.0
        for j in range(m):
            size = np.int64(bits[i, j] & 0x7FFFFFFF)
            if size < least or (size == least and equal > 0):
                equal -= size == least
                rows[i, j] = 0


def _stored(coefficients: Floats, lighting: CubemapLighting) -> HaarRows:
    """Truncated coefficients (n, channels, m) as lists."""
    m = coefficients.shape[2]
    flat = coefficients.reshape(-1, m)
    largest = np.maximum(flat.max(axis=1), -flat.min(axis=1))
    lengths = np.where(largest > BLACK, np.count_nonzero(flat, axis=1), 0)
    starts = row_starts(lengths)
    places = np.empty(starts[-1], np.uint16 if m <= np.iinfo(np.uint16).max + 1 else np.uint32)
    values = np.empty(starts[-1], np.float32)
    _list(flat, largest, starts, places, values)
    scales = np.where(largest > BLACK, largest / np.float32(LARGEST), 0).astype(np.float32)
    return HaarRows(
        starts, places, values.astype(np.float16), scales.reshape(coefficients.shape[:2]), lighting
    )


@numba.njit(parallel=True, cache=True)
def _list(
    rows: Floats, largest: Floats, starts: Indices, places: NDArray[np.unsignedinteger], values: Floats
) -> None:
    """Write where each row's coefficients are, and what they are in units of its scale."""
    for i in numba.prange(len(rows)):
        e = starts[i]
        if starts[i + 1] == e:
            continue
        factor = np.float32(LARGEST) / largest[i]
        for j in range(rows.shape[1]):
            if rows[i, j] != 0:
                places[e], values[e] = j, rows[i, j] * factor
                e += 1


def _sums(rows: Floats, part: HaarRows, energies: Doubles, weights: Floats, albedo: Floats) -> Doubles:
    """The five numbers of a ``HaarMesh``, of rows (n, channels, m)."""
    solid_angles = part.lighting.solid_angles
    away = rows - np.moveaxis(part.rows(np.arange(len(rows))), 2, 1) / np.sqrt(solid_angles)
    output_weights = np.square(albedo, dtype=np.float64)  # [vertex, rgb]; one channel stands for three
    weighted = weights.astype(np.float64) @ energies.sum(axis=1)
    on_sphere = weights.astype(np.float64) @ np.einsum("ncm,ncm->n", away, away)
    squares, norms = ((output_weights * (np.square(x) @ solid_angles)).sum() for x in (away, rows))
    return np.array([*weighted, on_sphere, squares, norms])


def _joined(parts: list[HaarRows]) -> HaarRows:
    """Rows of one part after those of another."""
    lengths = np.concatenate([np.diff(part.starts) for part in parts])
    return HaarRows(
        row_starts(lengths),
        np.concatenate([part.places for part in parts]),
        np.concatenate([part.values for part in parts]),
        np.concatenate([part.scales for part in parts]),
        parts[0].lighting,
    )
