"""The result: a factored light transport matrix T ([HR10] eq. 1), stored in incident form ([Leh07] 2.4).

``T[i, j, c] = albedo[i, c] * (direct[i, j] + indirect[i, j, c])``. Both parts are *white* transport: what a vertex of
albedo 1 would send out. Direct light needs one channel and no more than its visibility; indirect light is smooth and
may have fewer directions; colour exists only where the scene has any.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.emission.environment import Environment
from mi_sparse_prt.measurement.vertices import vertex_points
from mi_sparse_prt.operators.clustered import Clustered
from mi_sparse_prt.operators.fractional_visibility import FractionalVisibility
from mi_sparse_prt.operators.haar_rows import HaarRows
from mi_sparse_prt.operators.interpolated import Interpolated
from mi_sparse_prt.operators.low_rank import LowRank
from mi_sparse_prt.operators.mean_cosine import MeanCosine
from mi_sparse_prt.operators.operator import Rows, StoredPart
from mi_sparse_prt.operators.upsampled import Upsampled
from mi_sparse_prt.operators.visibility import Visibility
from mi_sparse_prt.scene.scene import Scene


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
    indirect: Upsampled | Interpolated | LowRank | None
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
