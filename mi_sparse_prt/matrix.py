"""The result: a factored light transport matrix T ([HR10] eq. 1), stored in incident form ([Leh07] 2.4).

``T[i, j, c] = albedo[i, c] * (direct[i, j] + indirect[i, j, c])``. Both parts are *white* transport: what a vertex of
albedo 1 would send out. Direct light needs one channel and no more than its visibility; indirect light is smooth and
may have fewer directions; colour exists only where the scene has any.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import numba
import numpy as np
import scipy.sparse
from numpy.typing import ArrayLike, NDArray

from mi_sparse_prt.bits import BITS
from mi_sparse_prt.blocks import in_blocks, rows_times
from mi_sparse_prt.compression.clustered_rows import Clustered
from mi_sparse_prt.compression.haar_rows import HaarRows
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.emission.environment import Environment
from mi_sparse_prt.errors import PrtError
from mi_sparse_prt.fractional_visibility import FractionalVisibility
from mi_sparse_prt.measurement.vertices import vertex_points
from mi_sparse_prt.scene import Scene
from mi_sparse_prt.transport.direct import FIXED_POINT

Rows = NDArray[np.integer]


class Part(Protocol):
    """One additive part of white transport."""

    def rows(self, ids: Rows) -> NDArray[np.float32]:
        """White rows (len(ids), n_directions, channels), float32."""

    def columns(self, ids: Rows) -> NDArray[np.float32]:
        """White columns (n_v, len(ids), channels), float32."""

    def relight(self, lighting: NDArray[np.float32]) -> NDArray[np.float32]:
        """White radiance (n_v, 3) under L (n_directions, 3)."""

    @property
    def nbytes(self) -> int:
        """Bytes that the part keeps in memory."""


class StoredPart(Part, Protocol):
    """A part that a matrix keeps."""

    def reordered(self, source: Rows) -> StoredPart:
        """Some rows, in this order."""

    def project(self, vectors: NDArray[np.float32]) -> NDArray[np.float32]:
        """Products (n_v, k, channels) with vectors (n_directions, k), the same for all channels."""


@dataclass(frozen=True)
class Visibility:
    """Direct light in the direction basis: one bit per element, cosine and solid angle analytic.

    Attributes
    ----------
    bits : (n_v, n_directions / 32) uint32
        Bit j % 32 of word j // 32: whether texel j's centre is seen (never below the horizon).
    normals : (n_v, 3) float32, world
    lighting : CubemapLighting
    """

    bits: NDArray[np.uint32]
    normals: NDArray[np.float32]
    lighting: CubemapLighting

    @property
    def nbytes(self) -> int:
        return self.bits.nbytes

    def rows(self, ids: Rows) -> NDArray[np.float32]:
        beams = np.ascontiguousarray((self.lighting.directions * self._weights()[:, None]).T)
        return _expanded_bits(self.bits, self.normals, np.asarray(ids, np.int64), beams)[..., None]

    def columns(self, ids: Rows) -> NDArray[np.float32]:
        ids = np.asarray(ids)
        words = self.bits[:, ids // BITS]  # [vertex, column]
        seen = (words >> (ids % BITS).astype(np.uint32)) & 1
        cosine = np.maximum(self.normals @ self.lighting.directions[ids].T, 0)
        return (cosine * seen * self._weights()[ids])[..., None].astype(np.float32)

    def relight(self, lighting: NDArray[np.float32]) -> NDArray[np.float32]:
        n_padded = self.bits.shape[1] * BITS
        directions = np.zeros((3, n_padded), dtype=np.float32)
        power = np.zeros((3, n_padded), dtype=np.float32)
        directions[:, : len(lighting)] = self.lighting.directions.T
        power[:, : len(lighting)] = (lighting * self._weights()[:, None]).T
        return _relight_bits(self.bits, self.normals, directions, power)

    def project(self, vectors: NDArray[np.float32]) -> NDArray[np.float32]:
        return rows_times(self.rows, len(self.bits), vectors)

    def reordered(self, source: Rows) -> Visibility:
        return replace(self, bits=self.bits[source], normals=self.normals[source])

    def _weights(self) -> NDArray[np.float32]:
        return self.lighting.solid_angles / np.float32(np.pi)


@numba.njit(parallel=True, cache=True)
def _expanded_bits(
    bits: NDArray[np.uint32], normals: NDArray[np.float32], ids: NDArray[np.int64], beams: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Elements (n, m) of rows ``ids``; beams (3, m) are directions times power."""
    result = np.zeros((len(ids), beams.shape[1]), np.float32)
    for i in numba.prange(len(ids)):
        nx, ny, nz = normals[ids[i], 0], normals[ids[i], 1], normals[ids[i], 2]
        for word in range(bits.shape[1]):
            mask = bits[ids[i], word]
            if mask == 0:
                continue
            for j in range(word * 32, min(word * 32 + 32, beams.shape[1])):
                cosine = nx * beams[0, j] + ny * beams[1, j] + nz * beams[2, j]
                seen = np.float32((mask >> np.uint32(j % 32)) & np.uint32(1))
                result[i, j] = max(cosine, np.float32(0)) * seen
    return result


@numba.njit(parallel=True, fastmath=True, cache=True)
def _relight_bits(
    bits: NDArray[np.uint32],
    normals: NDArray[np.float32],
    directions: NDArray[np.float32],
    power: NDArray[np.float32],
) -> NDArray[np.float32]:
    """Sum of power[:, j] * max(0, n_i . w_j) over the set bits j of row i; the inner loop is one word of bits."""
    radiance = np.zeros((bits.shape[0], 3), dtype=np.float32)
    for i in numba.prange(bits.shape[0]):
        nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
        red, green, blue = np.float32(0), np.float32(0), np.float32(0)
        for word in range(bits.shape[1]):
            mask = bits[i, word]
            if mask == 0:
                continue
            for k in range(32):
                j = word * 32 + k
                cosine = nx * directions[0, j] + ny * directions[1, j] + nz * directions[2, j]
                seen = max(cosine, np.float32(0)) * np.float32((mask >> np.uint32(k)) & np.uint32(1))
                red += seen * power[0, j]
                green += seen * power[1, j]
                blue += seen * power[2, j]
        radiance[i, 0], radiance[i, 1], radiance[i, 2] = red, green, blue
    return radiance


@dataclass(frozen=True)
class MeanCosine:
    """Direct light in the texel basis, by brute force: the mean of V max(0, n . w) over each texel.

    Attributes
    ----------
    fixed : (n_v, n_directions) uint16
        The mean as 16-bit fixed point, 65535 = 1.
    lighting : CubemapLighting
    """

    fixed: NDArray[np.uint16]
    lighting: CubemapLighting

    @property
    def nbytes(self) -> int:
        return self.fixed.nbytes

    def rows(self, ids: Rows) -> NDArray[np.float32]:
        return (self.fixed[ids] * self._weights())[..., None]

    def columns(self, ids: Rows) -> NDArray[np.float32]:
        return (self.fixed[:, ids] * self._weights()[ids])[..., None]

    def relight(self, lighting: NDArray[np.float32]) -> NDArray[np.float32]:
        return in_blocks(self.fixed, lighting * self._weights()[:, None])

    def project(self, vectors: NDArray[np.float32]) -> NDArray[np.float32]:
        return in_blocks(self.fixed, vectors * self._weights()[:, None])[..., None]

    def reordered(self, source: Rows) -> MeanCosine:
        return replace(self, fixed=self.fixed[source])

    def _weights(self) -> NDArray[np.float32]:
        return self.lighting.solid_angles / np.float32(np.pi * FIXED_POINT)


@dataclass(frozen=True)
class Indirect:
    """Interreflected light: white transport per solid angle, at the lighting's directions or at fewer.

    Attributes
    ----------
    density : (n_v, n_coarse, channels) float16, 1/sr
        channels is 1 in a grey scene.
    upsampling : (n_directions, n_coarse) sparse, rows sum to 1
        Interpolates a coarse cubemap at the lighting's directions; the identity where none is coarser.
    lighting : CubemapLighting
    """

    density: NDArray[np.float16]
    upsampling: scipy.sparse.csr_array
    lighting: CubemapLighting

    @property
    def nbytes(self) -> int:
        return self.density.nbytes

    def rows(self, ids: Rows) -> NDArray[np.float32]:
        density = self.density[ids].astype(np.float32)  # [row, coarse, channel]
        fine = np.stack([(self.upsampling @ density[..., c].T).T for c in range(density.shape[2])], axis=-1)
        return fine * self.lighting.solid_angles[:, None]

    def columns(self, ids: Rows) -> NDArray[np.float32]:
        weights = self.upsampling[np.asarray(ids)].multiply(self.lighting.solid_angles[ids][:, None]).tocsr()
        needed = np.unique(weights.indices)
        density = self.density[:, needed].astype(np.float32)  # [vertex, needed coarse, channel]
        return np.stack(
            [(weights[:, needed] @ density[..., c].T).T for c in range(density.shape[2])], axis=-1
        )

    def relight(self, lighting: NDArray[np.float32]) -> NDArray[np.float32]:
        coarse = self.upsampling.T @ (lighting * self.lighting.solid_angles[:, None])  # [coarse, rgb]
        if self.density.shape[2] == 1:
            return in_blocks(self.density[..., 0], coarse)
        channels = [in_blocks(self.density[..., c], coarse[:, c : c + 1]) for c in range(3)]
        return np.concatenate(channels, axis=1)

    def project(self, vectors: NDArray[np.float32]) -> NDArray[np.float32]:
        coarse = self.upsampling.T @ (vectors * self.lighting.solid_angles[:, None])  # [coarse, vector]
        channels = [in_blocks(self.density[..., c], coarse) for c in range(self.density.shape[2])]
        return np.stack(channels, axis=-1)

    def reordered(self, source: Rows) -> Indirect:
        return replace(self, density=self.density[source])


@dataclass(frozen=True)
class Interpolated:
    """Rows of all vertices as combinations of a few dense rows: A D ([HR10] eq. 4).

    Attributes
    ----------
    dense : Visibility or Indirect
        D, the rows of the densely sampled vertices.
    weights : (n_v, n_dense) sparse float32
        A: a row has the weights of a vertex's dense neighbours. That of a dense vertex is 1 at itself (``huang2010``)
        or smooths its row by its neighbours' (``sparse``).
    """

    dense: Visibility | Indirect
    weights: scipy.sparse.csr_array

    @property
    def nbytes(self) -> int:
        weights = self.weights
        return self.dense.nbytes + weights.data.nbytes + weights.indices.nbytes + weights.indptr.nbytes

    def rows(self, ids: Rows) -> NDArray[np.float32]:
        weights = self.weights[np.asarray(ids)]
        needed = np.unique(weights.indices)
        dense = self.dense.rows(needed)  # [needed dense row, direction, channel]
        flat = weights[:, needed] @ dense.reshape(len(needed), dense.shape[1] * dense.shape[2])
        return flat.reshape(len(ids), *dense.shape[1:])

    def columns(self, ids: Rows) -> NDArray[np.float32]:
        dense = self.dense.columns(ids)  # [dense row, column, channel]
        flat = self.weights @ dense.reshape(len(dense), -1)
        return flat.reshape(len(flat), *dense.shape[1:])

    def relight(self, lighting: NDArray[np.float32]) -> NDArray[np.float32]:
        return self.weights @ self.dense.relight(lighting)

    def project(self, vectors: NDArray[np.float32]) -> NDArray[np.float32]:
        dense = self.dense.project(vectors)  # [dense row, vector, channel]
        return (self.weights @ dense.reshape(len(dense), -1)).reshape(-1, *dense.shape[1:])

    def reordered(self, source: Rows) -> Interpolated:
        return replace(self, weights=self.weights[source])


@dataclass(frozen=True)
class Factored:
    """Interreflected light as a product of two thin matrices per channel: it has a low rank.

    Attributes
    ----------
    left : tuple of (n_v, rank) float32
        One per channel: 1 in a grey scene, else 3. Ranks may differ.
    right : tuple of (rank, n_directions) float32
    """

    left: tuple[NDArray[np.float32], ...]
    right: tuple[NDArray[np.float32], ...]

    @property
    def ranks(self) -> tuple[int, ...]:
        """Of each channel."""
        return tuple(len(right) for right in self.right)

    @property
    def nbytes(self) -> int:
        return sum(factor.nbytes for factor in (*self.left, *self.right))

    def rows(self, ids: Rows) -> NDArray[np.float32]:
        channels = [a[ids] @ b for a, b in zip(self.left, self.right, strict=True)]
        return np.stack(channels, axis=-1) if len(channels) > 1 else channels[0][..., None]

    def columns(self, ids: Rows) -> NDArray[np.float32]:
        return np.stack([a @ b[:, ids] for a, b in zip(self.left, self.right, strict=True)], axis=-1)

    def relight(self, lighting: NDArray[np.float32]) -> NDArray[np.float32]:
        if len(self.left) == 1:
            return self.left[0] @ (self.right[0] @ lighting)
        channels = zip(self.left, self.right, lighting.T, strict=True)
        return np.stack([a @ (b @ light) for a, b, light in channels], axis=-1)

    def project(self, vectors: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.stack([a @ (b @ vectors) for a, b in zip(self.left, self.right, strict=True)], axis=-1)

    def reordered(self, source: Rows) -> Factored:
        return replace(self, left=tuple(left[source] for left in self.left))


@dataclass(frozen=True)
class MeshRange:
    """Name of a mesh and the slice of its vertices among all."""

    name: str
    vertices: slice


@dataclass(frozen=True)
class LightTransport:
    """A precomputed light transport matrix T (n_v, n_directions, 3), factored.

    Attributes
    ----------
    lighting : CubemapLighting
    basis : {"direction", "texel"}
    albedo : (n_v, 3) float32
    areas : (n_v,) float32
        Of the surface around each vertex, world units.
    direct, indirect : Part or None
        White parts; None where there is no such light. A compressed matrix has both together, as ``direct``.
    meshes : tuple of MeshRange
    vertex_keys : (n_v,) uint64
        Identify rows whatever their order (``Points.keys``).
    scene_hash : str
    report : dict
        What was done, skipped, how long it took and how good it is; JSON as it is.
    """

    lighting: CubemapLighting
    basis: str
    albedo: NDArray[np.float32]
    areas: NDArray[np.float32]
    direct: Visibility | FractionalVisibility | MeanCosine | Interpolated | Clustered | HaarRows
    indirect: Indirect | Interpolated | Factored | None
    meshes: tuple[MeshRange, ...]
    vertex_keys: NDArray[np.uint64]
    scene_hash: str
    report: dict[str, Any] = field(default_factory=dict)

    @property
    def shape(self) -> tuple[int, int, int]:
        """(vertices, directions, 3)."""
        return len(self.albedo), self.lighting.n_directions, 3

    @property
    def nbytes(self) -> int:
        """Bytes of the stored factors."""
        return sum(part.nbytes for part in self._parts())

    def rows(self, ids: ArrayLike) -> NDArray[np.float32]:
        """Rows of T: radiance leaving vertices under light from each texel alone.

        Parameters
        ----------
        ids : (k,) integers
            Vertices.

        Returns
        -------
        (k, n_directions, 3) float32

        Raises
        ------
        PrtError
            If an index is out of range.
        """
        chosen = _checked(ids, len(self.albedo), "vertex")
        return self.albedo[chosen][:, None, :] * self.white_rows(chosen)

    def columns(self, ids: ArrayLike) -> NDArray[np.float32]:
        """Columns of T: radiance leaving all vertices under light from one texel each.

        Parameters
        ----------
        ids : (k,) integers
            Texels.

        Returns
        -------
        (n_v, k, 3) float32

        Raises
        ------
        PrtError
            If an index is out of range.
        """
        chosen = _checked(ids, self.lighting.n_directions, "direction")
        return self.albedo[:, None, :] * _summed([part.columns(chosen) for part in self._parts()])

    def irradiance(self, lighting: Any) -> NDArray[np.float32]:
        """What leaves the vertices if they were white: irradiance / pi, (n_v, 3) float32 (see ``relight``)."""
        radiance = self.lighting.project(lighting)
        return _summed([part.relight(radiance) for part in self._parts()])

    def relight(self, lighting: Environment | ArrayLike) -> NDArray[np.float32]:
        """B = T L: radiance leaving the vertices under an environment.

        Parameters
        ----------
        lighting : Environment, str, or (n_directions, 3) float
            An environment is projected to the cubemap first.

        Returns
        -------
        (n_v, 3) float32
        """
        return self.albedo * self.irradiance(lighting)

    def for_scene(self, scene: Scene) -> LightTransport:
        """The same matrix with its rows in the order of a scene's vertices.

        Parameters
        ----------
        scene : Scene
            The same geometry and materials; shapes may be merged or come in another order.

        Raises
        ------
        PrtError
            If the matrix belongs to another scene.
        """
        source = row_order(self.scene_hash, self.vertex_keys, scene)
        if source is None:
            return self
        return replace(
            self,
            albedo=self.albedo[source],
            areas=self.areas[source],
            direct=self.direct.reordered(source),
            indirect=self.indirect and self.indirect.reordered(source),
            meshes=tuple(MeshRange(mesh.name, mesh.vertices) for mesh in scene.meshes),
            vertex_keys=self.vertex_keys[source],
        )

    def save(self, path: str | Path) -> None:
        """Write the matrix to one file (see ``storage.save``)."""
        from mi_sparse_prt.storage import save

        save(self, path)

    def white_rows(self, ids: NDArray[np.integer]) -> NDArray[np.float32]:
        """Rows (k, n_directions, channels) without the albedo; a grey scene has one channel."""
        return _summed([part.rows(ids) for part in self._parts()])

    def project_white(self, vectors: NDArray[np.float32], ids: NDArray[np.integer]) -> NDArray[np.float32]:
        """White rows of some vertices times vectors (n_directions, k): (n, k, channels)."""
        return _summed([part.reordered(ids).project(vectors) for part in self._parts()])

    def _parts(self) -> list[StoredPart]:
        return [self.direct] if self.indirect is None else [self.direct, self.indirect]


def row_order(scene_hash: str, vertex_keys: NDArray[np.uint64], scene: Scene) -> NDArray[np.int64] | None:
    """Where a matrix has the vertices of a scene, (n_v,); None if they come in the same order.

    Raises
    ------
    PrtError
        If the matrix belongs to another scene.
    """
    if scene.hash != scene_hash:
        raise PrtError(
            f"this matrix belongs to another scene than {scene.path or 'the one given'} "
            "(geometry or materials differ); precompute it again"
        )
    keys = vertex_points(scene).keys
    if np.array_equal(vertex_keys, keys):
        return None
    ours, theirs = (np.argsort(k, kind="stable") for k in (vertex_keys, keys))
    if not np.array_equal(vertex_keys[ours], keys[theirs]):
        raise PrtError("this matrix belongs to other vertices of the same scene; precompute it again")
    source = np.empty_like(ours)
    source[theirs] = ours
    return source


def _checked(ids: ArrayLike, count: int, what: str) -> Rows:
    """Ids as indices below ``count``; a mask of that length and negative ids mean what they do in NumPy."""
    chosen = np.atleast_1d(np.asarray(ids))
    if chosen.dtype == bool and chosen.shape == (count,):
        return np.flatnonzero(chosen)
    if chosen.ndim != 1 or not (chosen.size == 0 or np.issubdtype(chosen.dtype, np.integer)):
        raise PrtError(
            f"{what} ids must be a list of integers or a mask of {count}, not {chosen.dtype} of shape {chosen.shape}"
        )
    chosen = chosen.astype(np.int64)
    outside = (chosen < -count) | (chosen >= count)
    if outside.any():
        raise PrtError(f"{what} id {chosen[outside][0]} is out of range: there are {count}")
    return np.where(chosen < 0, chosen + count, chosen)


def _summed(parts: list[NDArray[np.float32]]) -> NDArray[np.float32]:
    """The sum; arrays of one channel stand for three. They are new, and one of them is reused."""
    if len(parts) == 1:
        return parts[0]
    larger, smaller = parts if parts[0].shape[-1] >= parts[1].shape[-1] else parts[::-1]
    larger += smaller
    return larger
