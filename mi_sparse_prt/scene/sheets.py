"""Two-sided surfaces: which of their backs light can reach; these have vertices of their own.

A surface that reflects on both sides has two sheets. The backs of most are the insides of closed solids, where it is
dark. They see fronts as well: solids stand in and on each other, and a floor goes on below a sofa. But no walk from
surface to surface leads from there to light. Such sheets have no rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.device_arrays import on_device
from mi_sparse_prt.core.random_keys import hash_rows, random_generator
from mi_sparse_prt.scene.materials import Material
from mi_sparse_prt.scene.ray_offsets import ray_offset
from mi_sparse_prt.scene.traced_scene import TracedScene
from mi_sparse_prt.scene.triangle_mesh import TriangleMesh, find_pieces

# from each piece of a surface: most find light at once, the others look closely
FEW_WALKS, MANY_WALKS = 64, 4096
LEAKS = 1e-4  # of the walks from a piece, which slip through where surfaces meet
LONGEST, THROUGH = 8, 8  # surfaces of a walk; so many that light goes through count as one
LANES = 1 << 22  # rays per wavefront
INSIDE = 0.85  # rays start this far inside of triangles: at their borders they leak through other surfaces

NO_PIECE = -1  # of a triangle whose back is no sheet
SCATTERS, PASSES, SHINES = 0, 1, 2  # what a walk does at a triangle

Ids = NDArray[np.int64]


@dataclass(frozen=True)
class Back:
    """Vertices on the back of a shape.

    Attributes
    ----------
    shape : int
        Its number.
    mesh : TriangleMesh
        Normals are turned, and the order of the corners of triangles.
    vertices : (n,) int64
        The vertex of the front that each one lies behind.
    """

    shape: int
    mesh: TriangleMesh
    vertices: Ids


def find_backs(
    scene: TracedScene,
    meshes: Sequence[TriangleMesh],
    materials: Sequence[Material],
    lamps: NDArray[np.float32] | None = None,
    cameras: NDArray[np.float32] | None = None,
) -> tuple[list[Back], list[str]]:
    """The backs of two-sided surfaces that light can reach, and the names of shapes that have others as well.

    Light reaches a connected piece of a surface if a random walk from its back, from surface to surface, leaves the
    scene, or meets an area lamp or a place that another lamp shines on.

    Parameters
    ----------
    scene : TracedScene
        In the normalised frame: the same triangles as those of the meshes, in their order.
    meshes : sequence of TriangleMesh
    materials : sequence of Material
    lamps : (n, 3) float32, optional
        Places of lamps that are no surfaces, normalised.
    cameras : (n, 3) float32, optional
        Places from which pieces are seen that are kept, however dark: a room may be so on purpose.

    Notes
    -----
    A piece counts as dark if none of 4096 or more walks, at least one from each of its triangles, finds light, or one
    in ten thousand: then less than a thousandth of what would reach it in the open does, with a probability of 98%.
    """
    if not any(material.two_sided for material in materials):
        return [], []
    pieces = _pieces(meshes, materials)
    none = np.zeros((0, 3), np.float32)
    from_surfaces = _Walks(scene, meshes, materials, pieces, none if lamps is None else lamps)
    bright = _bright_pieces(from_surfaces, pieces, none if cameras is None else cameras)
    found, dark, first = [], [], 0
    for shape, mesh in enumerate(meshes):
        own = pieces[first : first + len(mesh.triangles)]
        first += len(mesh.triangles)
        if not materials[shape].two_sided:
            continue
        lit = bright[own]
        if not lit.all():
            dark.append(mesh.name)
        if lit.any():
            found.append(_back(shape, mesh, lit))
    return found, dark


def _back(shape: int, mesh: TriangleMesh, lit: NDArray[np.bool_]) -> Back:
    """The back of some triangles."""
    part = mesh.take_triangles(lit)
    vertices, triangles = np.unique(part.triangles[:, ::-1], return_inverse=True)
    turned = part.take_vertices(vertices, triangles.reshape(-1, 3))
    assert turned.normals is not None
    return Back(shape, replace(turned, normals=-turned.normals), vertices.astype(np.int64))


def _pieces(meshes: Sequence[TriangleMesh], materials: Sequence[Material]) -> Ids:
    """Number of the connected piece of each triangle's back; NO_PIECE where that is black, or lets light through."""
    result, count = [], 0
    for mesh, material in zip(meshes, materials, strict=True):
        if not material.two_sided:
            result.append(np.full(len(mesh.triangles), NO_PIECE, np.int64))
            continue
        own = find_pieces(mesh)
        result.append(count + own.of)
        count += len(own.first)
    return np.concatenate(result)


def _bright_pieces(from_surfaces: _Walks, pieces: Ids, cameras: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Which pieces light reaches, or are seen, (pieces,) bool."""
    bright = np.zeros(int(pieces.max()) + 1, np.bool_)
    for place in cameras:
        bright[from_surfaces.from_place(place)] = True
    size = np.bincount(pieces[pieces >= 0], minlength=len(bright))
    for pass_, walks in enumerate((FEW_WALKS, MANY_WALKS)):
        some = np.flatnonzero(pieces >= 0)
        some = some[~bright[pieces[some]]]
        each = -(-walks // size[pieces[some]])  # walks from each triangle
        lit = np.zeros(len(bright), np.int64)
        for a in range(0, len(some), LANES // walks):
            part = slice(a, a + LANES // walks)
            lit += from_surfaces.from_backs(some[part], each[part], pass_)
        bright |= lit > LEAKS * -(-walks // size) * size
    return bright


class _Walks:
    """Random walks from the backs of triangles, and whether they find light.

    Parameters
    ----------
    scene : TracedScene
        In the normalised frame.
    meshes : sequence of TriangleMesh
        In any frame; normals count.
    materials : sequence of Material
        Of each mesh.
    pieces : (triangles,) int64
        Of all meshes, see ``_pieces``.
    lamps : (n, 3) float32
    """

    def __init__(
        self,
        scene: TracedScene,
        meshes: Sequence[TriangleMesh],
        materials: Sequence[Material],
        pieces: Ids,
        lamps: NDArray[np.float32],
    ) -> None:
        self._scene, self._pieces, self._lamps = scene, pieces, len(lamps)
        self._places = mi.Point3f(np.ascontiguousarray(lamps.T))
        kinds = [SHINES if m.shines else PASSES if m.passes_light else SCATTERS for m in materials]
        sizes = [len(mesh.triangles) for mesh in meshes]
        self._kind = mi.UInt32(np.repeat(kinds, sizes).astype(np.uint32))
        black = [not (m.two_sided or m.passes_light) for m in materials]
        self._black = mi.Bool(np.repeat(black, sizes))  # their backs
        corners = np.concatenate(
            [
                np.array(shape.vertex_positions_buffer()).reshape(-1, 3)[
                    np.array(shape.faces_buffer()).reshape(-1, 3)
                ]
                for shape in scene.shapes()
            ]
        ).astype(np.float32)  # [triangle, corner, xyz]
        outwards = np.concatenate([_mean_normals(mesh) for mesh in meshes])
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        # of the triangles themselves: by shading normals, a curved wall seen along it may be a front
        normal *= np.where(np.einsum("td,td->t", normal, outwards) > 0, -1, 1)[:, None]
        self._corners = [mi.Point3f(np.ascontiguousarray(corners[:, k].T)) for k in range(3)]
        self._backwards = dr.normalize(mi.Vector3f(np.ascontiguousarray(normal.T)))
        self._keys = mi.UInt64(hash_rows(corners.sum(axis=1)))

    def from_backs(self, triangles: Ids, each: Ids, seed: int) -> Ids:
        """How many walks from each piece (pieces,) find light, of some triangles with so many walks each."""
        start = np.repeat(triangles, each)
        sample = np.arange(len(start)) - np.repeat(np.cumsum(each) - each, each)
        triangle, number = (on_device(mi.UInt32, x.astype(np.uint32)) for x in (start, sample))
        found = self._finds_light(*self._rays(triangle, number, seed)).numpy()
        return np.bincount(self._pieces[start[found]], minlength=int(self._pieces.max()) + 1)

    def from_place(self, place: NDArray[np.float32]) -> Ids:
        """Pieces whose backs are seen from a point (3,), looking around."""
        rng = mi.PCG32(size=MANY_WALKS)
        direction = mi.warp.square_to_uniform_sphere(mi.Point2f(rng.next_float32(), rng.next_float32()))
        ray = mi.Ray3f(mi.Point3f(place), direction)
        hit = self._scene.ray_intersect_preliminary(ray)
        met = hit.is_valid()
        index = dr.select(met, self._scene.triangle(hit, met), 0)
        behind = met & (dr.dot(dr.gather(mi.Vector3f, self._backwards, index), ray.d) < 0)
        seen = np.unique(np.where(behind.numpy(), self._pieces[index.numpy()], NO_PIECE))
        return seen[seen >= 0]

    @dr.syntax
    def _finds_light(self, ray: mi.Ray3f, rng: mi.PCG32) -> mi.Mask:
        """Whether random walks find light that begin with these rays and go on as from white diffuse surfaces."""
        active, found, left = mi.Mask(True), mi.Mask(False), dr.opaque(mi.Int32, LONGEST * THROUGH)
        while active:
            hit = self._scene.ray_intersect_preliminary(ray, active)
            met = active & hit.is_valid()
            index = self._scene.triangle(hit, met)
            kind = dr.gather(mi.UInt32, self._kind, index, met)
            back = dr.gather(mi.Vector3f, self._backwards, index, met)
            behind = dr.dot(back, ray.d) < 0
            found |= active & ~met | met & (kind == SHINES) & ~behind
            passes, side = kind == PASSES, dr.select(behind, back, -back)  # where the ray came from
            place = ray(hit.t)
            # back along the ray, where nothing is in the way: along the normal may be another surface that meets it
            step = ray_offset(place) / dr.maximum(dr.abs(dr.dot(side, ray.d)), 1e-6)
            place += ray.d * dr.select(passes, step, -dr.minimum(step, 0.5 * hit.t))
            if dr.hint(self._lamps > 0, mode="scalar"):
                lamp = dr.minimum(mi.UInt32(rng.next_float32() * self._lamps), self._lamps - 1)
                towards = dr.gather(mi.Point3f, self._places, lamp, met) - place
                asked = met & ~passes & (dr.dot(side, towards) > 0)
                found |= asked & ~self._scene.ray_test(_up_to(place, towards), asked)
            local = mi.warp.square_to_cosine_hemisphere(mi.Point2f(rng.next_float32(), rng.next_float32()))
            ray = mi.Ray3f(place, dr.select(passes, ray.d, mi.Frame3f(side).to_world(local)))
            left -= dr.select(passes, 1, THROUGH)
            active = met & ~found & (left > 0)
            active &= passes | ~(behind & dr.gather(mi.Bool, self._black, index, met))
        return found

    def _rays(self, triangle: mi.UInt32, sample: mi.UInt32, seed: int) -> tuple[mi.Ray3f, mi.PCG32]:
        rng = random_generator(dr.gather(mi.UInt64, self._keys, triangle), sample, mi.UInt32(0), seed)
        b = mi.warp.square_to_uniform_triangle(mi.Point2f(rng.next_float32(), rng.next_float32()))
        weights = [(1 - INSIDE) / 3 + INSIDE * x for x in (1 - b.x - b.y, b.x, b.y)]
        p = sum(
            (w * dr.gather(mi.Point3f, c, triangle) for w, c in zip(weights, self._corners, strict=True)),
            mi.Point3f(0),
        )
        n = dr.gather(mi.Vector3f, self._backwards, triangle)
        local = mi.warp.square_to_cosine_hemisphere(mi.Point2f(rng.next_float32(), rng.next_float32()))
        return mi.Ray3f(dr.fma(n, ray_offset(p), p), mi.Frame3f(n).to_world(local)), rng


def _up_to(place: mi.Point3f, towards: mi.Vector3f) -> mi.Ray3f:
    ray = mi.Ray3f(place, towards)
    ray.maxt = mi.Float(1)
    return ray


def _mean_normals(mesh: TriangleMesh) -> NDArray[np.float32]:
    """Sums (triangles, 3) of the normals of the corners of triangles."""
    assert mesh.normals is not None
    total: NDArray[np.float32] = mesh.normals[mesh.triangles].sum(axis=1)
    return total
