"""Two-sided surfaces: which of their backs light can reach; these have vertices of their own.

A surface that reflects on both sides has two sheets. The backs of most are the insides of closed solids, where it is
dark: no ray leaves them for anything but other dark backs. Such sheets have no rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy.sparse
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from mi_sparse_prt.core.device_arrays import on_device
from mi_sparse_prt.core.random_keys import hash_rows, random_generator
from mi_sparse_prt.scene.materials import Material
from mi_sparse_prt.scene.ray_offsets import ray_offset
from mi_sparse_prt.scene.traced_scene import TracedScene
from mi_sparse_prt.scene.triangle_mesh import TriangleMesh, find_pieces

FEW_RAYS, MANY_RAYS = (
    64,
    4096,
)  # from each piece of a surface: most find light at once, the others look closely
LANES = 1 << 22  # rays per wavefront
INSIDE = 0.85  # rays start this far inside of triangles: at their borders they leak through other surfaces

NO_PIECE, PASSES_LIGHT = -1, -2  # what a triangle's back is, if no piece of a sheet

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
) -> tuple[list[Back], list[str]]:
    """The backs of two-sided surfaces that light can reach, and the names of shapes that have others as well.

    Light reaches a connected piece of a surface if a ray from its back leaves the scene, or meets the front of a
    surface, one that light passes through, or the back of another piece that light reaches; or if a lamp shines on it.

    Parameters
    ----------
    scene : TracedScene
        In the normalised frame: the same triangles as those of the meshes, in their order.
    meshes : sequence of TriangleMesh
    materials : sequence of Material
    lamps : (n, 3) float32, optional
        Places of lamps that are no surfaces, normalised.

    Notes
    -----
    A piece counts as dark if none of 4096 or more cosine-distributed rays, at least one from each of its triangles,
    finds light: then less than a thousandth of what its points see is lit, with a probability of 98%.
    """
    if not any(material.two_sided for material in materials):
        return [], []
    pieces = _pieces(meshes, materials)
    passing = np.repeat([m.passes_light for m in materials], [len(mesh.triangles) for mesh in meshes])
    bright = _bright_pieces(
        scene, meshes, pieces, passing, np.zeros((0, 3), np.float32) if lamps is None else lamps
    )
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
    """Number of the connected piece of each triangle's back; NO_PIECE where it is black, or PASSES_LIGHT."""
    result, count = [], 0
    for mesh, material in zip(meshes, materials, strict=True):
        n = len(mesh.triangles)
        if not material.two_sided:
            result.append(np.full(n, PASSES_LIGHT if material.passes_light else NO_PIECE, np.int64))
            continue
        own = find_pieces(mesh)
        result.append(count + own.of)
        count += len(own.first)
    return np.concatenate(result)


def _bright_pieces(
    scene: TracedScene,
    meshes: Sequence[TriangleMesh],
    pieces: Ids,
    passing: NDArray[np.bool_],
    lamps: NDArray[np.float32],
) -> NDArray[np.bool_]:
    """Which pieces light reaches, (pieces,) bool; ``passing`` (triangles,): light goes through."""
    n = int(pieces.max()) + 1
    sees_light, seen = np.zeros(n, np.bool_), [np.zeros((0, 2), np.int64)]
    looks = _Looks(scene, meshes, pieces, passing)
    for lamp in lamps:
        sees_light[looks.from_place(lamp)] = True
    size = np.bincount(pieces[pieces >= 0], minlength=n)
    for pass_, rays in enumerate((FEW_RAYS, MANY_RAYS)):
        some = np.flatnonzero(pieces >= 0)
        some = some[~sees_light[pieces[some]]]
        each = -(-rays // size[pieces[some]])  # rays from each triangle
        for a in range(0, len(some), LANES // rays):
            part = slice(a, a + LANES // rays)
            lit, pairs = looks.from_backs(some[part], each[part], pass_)
            sees_light[lit] = True
            seen.append(pairs)
    pairs = np.unique(np.concatenate(seen), axis=0)
    graph = scipy.sparse.coo_array((np.ones(len(pairs), np.int8), pairs.T), shape=(n, n))
    groups, group = connected_components(graph, directed=False)  # light goes both ways
    bright = np.zeros(groups, np.bool_)
    bright[group[sees_light]] = True
    return np.asarray(bright[group])


class _Looks:
    """Rays from the backs of triangles, and what they meet.

    Parameters
    ----------
    scene : TracedScene
        In the normalised frame.
    meshes : sequence of TriangleMesh
        In any frame; normals count.
    pieces : (triangles,) int64
        Of all meshes, see ``_pieces``.
    passing : (triangles,) bool
        Whether light goes through.
    """

    def __init__(
        self, scene: TracedScene, meshes: Sequence[TriangleMesh], pieces: Ids, passing: NDArray[np.bool_]
    ) -> None:
        self._scene, self._pieces, self._passing = scene, pieces, passing
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
        normal *= np.where(np.einsum("td,td->t", normal, outwards) > 0, -1, 1)[:, None]
        self._corners = [mi.Point3f(np.ascontiguousarray(corners[:, k].T)) for k in range(3)]
        self._backwards = dr.normalize(mi.Vector3f(np.ascontiguousarray(normal.T)))
        self._keys = mi.UInt64(hash_rows(corners.sum(axis=1)))

    def from_backs(self, triangles: Ids, each: Ids, seed: int) -> tuple[Ids, NDArray[np.int64]]:
        """Look back from some triangles, with so many rays each.

        Returns
        -------
        lit : (l,) int64
            Pieces from which a ray found light.
        pairs : (m, 2) int64
            Pieces that saw each other's backs.
        """
        start = np.repeat(triangles, each)
        sample = np.arange(len(start)) - np.repeat(np.cumsum(each) - each, each)
        triangle = on_device(mi.UInt32, start.astype(np.uint32))
        other, lit = self._met(self._rays(triangle, on_device(mi.UInt32, sample.astype(np.uint32)), seed))
        own = self._pieces[start]
        facing = other >= 0
        return np.unique(own[lit]), np.unique(np.stack([own[facing], other[facing]], axis=1), axis=0)

    def from_place(self, place: NDArray[np.float32]) -> Ids:
        """Pieces whose backs are seen from a point (3,), looking around."""
        rng = mi.PCG32(size=MANY_RAYS)
        direction = mi.warp.square_to_uniform_sphere(mi.Point2f(rng.next_float32(), rng.next_float32()))
        met, _ = self._met(mi.Ray3f(mi.Point3f(place), direction))
        return np.unique(met[met >= 0])

    def _met(self, ray: mi.Ray3f) -> tuple[Ids, NDArray[np.bool_]]:
        """The piece whose back each ray meets (NO_PIECE of a black one), and whether light comes from there.

        It comes from all that is no back, and from backs that it goes through.
        """
        hit = self._scene.ray_intersect_preliminary(ray)
        met = hit.is_valid()
        index = dr.select(met, self._scene.triangle(hit, met), 0)
        # of the triangles themselves: by shading normals, a curved wall seen along it may be a front
        behind = met & (dr.dot(dr.gather(mi.Vector3f, self._backwards, index), ray.d) < 0)
        piece = np.where(behind.numpy(), self._pieces[index.numpy()], PASSES_LIGHT)
        return piece, (piece == PASSES_LIGHT) | (piece >= 0) & self._passing[index.numpy()]

    def _rays(self, triangle: mi.UInt32, sample: mi.UInt32, seed: int) -> mi.Ray3f:
        rng = random_generator(dr.gather(mi.UInt64, self._keys, triangle), sample, mi.UInt32(0), seed)
        b = mi.warp.square_to_uniform_triangle(mi.Point2f(rng.next_float32(), rng.next_float32()))
        weights = [(1 - INSIDE) / 3 + INSIDE * x for x in (1 - b.x - b.y, b.x, b.y)]
        p = sum(
            (w * dr.gather(mi.Point3f, c, triangle) for w, c in zip(weights, self._corners, strict=True)),
            mi.Point3f(0),
        )
        n = dr.gather(mi.Vector3f, self._backwards, triangle)
        local = mi.warp.square_to_cosine_hemisphere(mi.Point2f(rng.next_float32(), rng.next_float32()))
        return mi.Ray3f(dr.fma(n, ray_offset(p), p), mi.Frame3f(n).to_world(local))


def _mean_normals(mesh: TriangleMesh) -> NDArray[np.float32]:
    """Sums (triangles, 3) of the normals of the corners of triangles."""
    assert mesh.normals is not None
    total: NDArray[np.float32] = mesh.normals[mesh.triangles].sum(axis=1)
    return total
