"""Vertices where surfaces touch: what lights them from behind the other surface lights no triangle around them.

The vertices at the foot of a wall lie in the wall's plane and see what is behind it, the lowest vertex of a ball on
the ground sees what is below. That is a matter of rounding, and of one point; but interpolated over the triangles
around, it is light that leaks.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.bits import Bits, above_horizon, bits_at, unpack
from mi_sparse_prt.core.ragged import select_rows
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.operators.factored_visibility import FactoredVisibility
from mi_sparse_prt.operators.fractional_visibility import FractionalVisibility
from mi_sparse_prt.operators.mean_cosine import MeanCosine
from mi_sparse_prt.operators.operator import Part
from mi_sparse_prt.operators.visibility import Visibility
from mi_sparse_prt.scene.scene import Scene

BEYOND = 0.02  # of the way from a triangle's middle to a corner: what is as near behind it touches it
SMOOTH = 0.5  # cosine between the normals of two triangles, above which they are taken for one surface
DIGITS = 3  # of normals: what is equal in these is one plane

Ids = NDArray[np.integer]


@dataclass(frozen=True)
class Contacts:
    """Directions that count for the triangles around vertices which touch other surfaces.

    Attributes
    ----------
    vertices : (k,) int64
        Ascending.
    open : (k, words) uint32 bits
        Texels above the horizons of all surfaces that each touches.
    lighting : CubemapLighting
    """

    vertices: NDArray[np.int64]
    open: Bits
    lighting: CubemapLighting

    def lit(self, direct: Part) -> Part:
        """Direct light, with a row for each vertex, without what comes from behind surfaces that vertices touch."""
        if not len(self.vertices):
            return direct
        if isinstance(direct, MeanCosine):
            fixed = direct.fixed.copy()
            fixed[self.vertices] *= unpack(self.open, fixed.shape[1])
            return replace(direct, fixed=fixed)
        if not isinstance(direct, Visibility | FractionalVisibility | FactoredVisibility):
            return _Lit(direct, self)
        bits = direct.bits.copy()
        bits[self.vertices] &= self.open
        if not isinstance(direct, FractionalVisibility):
            return replace(direct, bits=bits)
        return replace(direct, bits=bits, shares=self._lit_shares(direct))

    def _lit_shares(self, direct: FractionalVisibility) -> NDArray[np.uint8]:
        """Shares of the texels that edges cut, those behind surfaces being 0."""
        shares = direct.shares.copy()
        _, row, entries = select_rows(direct.starts, self.vertices)
        shares[entries] *= bits_at(self.open, row, direct.texels[entries]).astype(np.uint8)
        return shares

    def counts(self, vertices: Ids, texels: Ids) -> NDArray[np.bool_]:
        """Whether light of texels at vertices, (m,) each, counts for the triangles around."""
        result, some = np.ones(len(vertices), np.bool_), np.isin(vertices, self.vertices)
        result[some] = bits_at(self.open, np.searchsorted(self.vertices, vertices[some]), texels[some])
        return result


@dataclass(frozen=True)
class _Lit:
    """Any direct part, of one channel, as ``Contacts.lit`` says."""

    part: Part
    contacts: Contacts

    @property
    def nbytes(self) -> int:
        return self.part.nbytes + self.contacts.open.nbytes

    def rows(self, ids: Ids) -> NDArray[np.float32]:
        every = np.arange(self.contacts.lighting.n_directions)
        counts = self.contacts.counts(np.repeat(ids, len(every)), np.tile(every, len(ids)))
        return self.part.rows(ids) * counts.reshape(len(ids), -1, 1)

    def columns(self, ids: Ids) -> NDArray[np.float32]:
        result, own = self.part.columns(ids), self.contacts.vertices
        counts = self.contacts.counts(np.repeat(own, len(ids)), np.tile(ids, len(own)))
        result[own] *= counts.reshape(len(own), -1, 1)
        return result

    def relight(self, lighting: NDArray[np.float32]) -> NDArray[np.float32]:
        result, own = self.part.relight(lighting), self.contacts.vertices
        result[own] = self.rows(own)[..., 0] @ lighting
        return result


def contacts(scene: Scene, lighting: CubemapLighting) -> Contacts:
    """Find them: from the middle of each triangle rays go to its corners, and a little farther.

    Parameters
    ----------
    scene : Scene
    lighting : CubemapLighting
    """
    triangles = np.concatenate([mesh.triangles + mesh.vertices.start for mesh in scene.meshes])
    p = [mi.Point3f(scene.normalised_positions[column].astype(np.float32).T) for column in triangles.T]
    normal = dr.normalize(dr.cross(p[1] - p[0], p[2] - p[0]))
    outwards = scene.normals[triangles].sum(axis=1)
    normal = dr.mulsign(normal, dr.dot(normal, mi.Vector3f(outwards.T)))
    start, found = _lifted((p[0] + p[1] + p[2]) / 3, normal), []
    for column, corner in zip(triangles.T, p, strict=True):
        way = _lifted(corner, normal) - start
        length = dr.norm(way)
        ray = mi.Ray3f(start, way / length)
        ray.maxt = length * (1 + BEYOND)
        hit = scene.normalised.ray_intersect_preliminary(ray)
        other = hit.compute_surface_interaction(ray, mi.RayFlags.Minimal, hit.is_valid()).n
        met = (hit.is_valid() & (dr.dot(other, normal) < SMOOTH) & (dr.dot(other, way) < 0)).numpy()
        found.append(np.column_stack([column[met], other.numpy().T[met].round(DIGITS)]))
    pairs = np.unique(np.concatenate(found), axis=0)  # [vertex, normal]
    vertices, first = np.unique(pairs[:, 0].astype(np.int64), return_index=True)
    above = above_horizon(pairs[:, 1:].astype(np.float32), lighting.directions)
    return Contacts(vertices, np.bitwise_and.reduceat(above, first) if len(first) else above, lighting)


def _lifted(p: mi.Point3f, normal: mi.Vector3f) -> mi.Point3f:
    """A point off its surface, as far as rays start from it."""
    return dr.fma(normal, (1 + dr.max(dr.abs(p))) * mi.math.RayEpsilon, p)
