"""M, the measurement at mesh vertices: where a row of T is evaluated, and how a Mitsuba sensor gets there."""

from __future__ import annotations

from dataclasses import dataclass
from weakref import WeakKeyDictionary

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.random_keys import hash_rows
from mi_sparse_prt.measurement.touching_vertices import move_off
from mi_sparse_prt.scene.ray_offsets import ray_offsets
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.scene.traced_scene import TracedScene


@dataclass(frozen=True)
class Points:
    """Surface points at which transport is measured, in the normalised frame of a scene.

    Attributes
    ----------
    positions : (n, 3) float32, normalised frame
    normals : (n, 3) float32, shading normals: the cosine and the hemisphere
    offset_normals : (n, 3) float32, the direction in which rays leave the surface before they start. At a vertex it
        is the shading normal, so that every direction above the horizon starts on the outside; at a sensor's hit it
        is the geometric normal, as in Mitsuba's ``spawn_ray``.
    keys : (n,) uint64, what random numbers are derived from: the same point gets the same random numbers in any
        order and in any block, and is the same row of a matrix.
    """

    positions: NDArray[np.float32]
    normals: NDArray[np.float32]
    offset_normals: NDArray[np.float32]
    keys: NDArray[np.uint64]

    def __len__(self) -> int:
        return len(self.positions)


_KNOWN: WeakKeyDictionary[Scene, Points] = WeakKeyDictionary()


def vertex_points(scene: Scene) -> Points:
    """Return the scene's vertices as measurement points; the same ones each time.

    Vertices on the border of a mesh stand for the surface inside of it and are moved there by a few ray offsets (5e-4
    of the scene's longest side). Exactly on the border, where another surface often begins (the corners of a room, a
    box on the ground), their rays would start in that surface and leak through it.
    """
    if scene not in _KNOWN:
        _KNOWN[scene] = _vertex_points(scene)
    return _KNOWN[scene]


def _vertex_points(scene: Scene) -> Points:
    positions, triangles = scene.normalised_positions, _triangles(scene)
    border, centre = _centres_beside_border(positions, triangles)
    inwards = centre - positions[border]  # [border vertex, xyz]
    length = np.maximum(np.linalg.norm(inwards, axis=1, keepdims=True), 1e-30)
    # into their triangle by four of Mitsuba's ray offsets, or by a quarter of the way to its centre if that is less
    offset = 4 * ray_offsets(positions[border])
    moved = positions.copy()
    moved[border] += (inwards * np.minimum(offset / length, 0.25)).astype(np.float32)
    moved = move_off(scene, moved, border)
    # two vertices may differ only in the side to which they moved: where two meshes meet
    return Points(moved, scene.normals, scene.normals, hash_rows(moved, scene.vertex_keys))


def _triangles(scene: Scene) -> NDArray[np.int64]:
    """Of all sheets, by the numbers of the scene's vertices."""
    return np.concatenate([m.triangles.astype(np.int64) + m.vertices.start for m in scene.meshes])


def _centres_beside_border(
    positions: NDArray[np.float32], triangles: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Border vertices, and the centre of the widest triangle of each: a point of the surface, on folds too.

    Among triangles of equal width the one of smallest coordinates is taken, and sums of three float32 are exact in
    float64, so that neither the order of triangles nor that of their corners shows.
    """
    owners = triangles.ravel()
    chosen = np.flatnonzero(_border_vertices(triangles)[owners])
    owners, face = owners[chosen], chosen // 3
    width = _widths(positions[triangles[face]])
    widest = np.zeros(len(positions))
    np.maximum.at(widest, owners, width)
    wide = width >= 0.999 * widest[owners]  # equal but for rounding
    owners, face = owners[wide], face[wide]
    sums = positions.astype(np.float64)[triangles[face]].sum(axis=1)  # [corner, xyz]
    order = np.lexsort((*sums.T, owners))
    border, first = np.unique(owners[order], return_index=True)
    return border, sums[order][first] / 3


def _widths(corners: NDArray[np.floating]) -> NDArray[np.float64]:
    """Room in triangles (t, 3, 3): height over the longest edge."""
    p = corners.astype(np.float64)
    longest = np.linalg.norm(np.roll(p, -1, axis=1) - p, axis=2).max(axis=1)
    return np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1) / longest


def _border_vertices(triangles: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which vertices have an edge that belongs to one triangle only."""
    edges = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)  # [edge of a triangle, end]
    n = int(triangles.max()) + 1
    keys, count = np.unique(edges[:, 0] * n + edges[:, 1], return_counts=True)
    border = np.zeros(n, dtype=bool)
    single = keys[count == 1]
    border[single // n] = border[single % n] = True
    return border


@dataclass(frozen=True)
class VertexRays:
    """One ray per vertex that ends on the surface beside it, in the frame of the Mitsuba scene it was made for.

    Attributes
    ----------
    origins, directions : (n_v, 3) float32
    missed : (n_v,) bool
        Vertices at which no approach hit the surface within a triangle's reach (0 unless the vertex is buried in
        another surface); their ray is kept, and what it hits is another surface.
    """

    origins: NDArray[np.float32]
    directions: NDArray[np.float32]
    missed: NDArray[np.bool_]

    def take(self, vertices: NDArray[np.integer]) -> VertexRays:
        """The rays of some vertices."""
        return VertexRays(self.origins[vertices], self.directions[vertices], self.missed[vertices])


def vertex_rays(scene: mi.Scene | TracedScene, sheets: Scene | None = None) -> VertexRays:
    """Find for every mesh vertex of a Mitsuba scene a ray that hits the surface next to it.

    Parameters
    ----------
    scene : mi.Scene or TracedScene
        All its shapes are meshes; vertices are counted in the order of the shapes.
    sheets : Scene, optional
        Whose shapes these are: vertices on the backs of two-sided surfaces follow, seen from there.

    Notes
    -----
    A ray shot straight at a vertex misses at borders and poles. Here it starts just above the triangle and ends a
    hundredth of its size inside. The result is verified by tracing; the vertices that fail are tried again on their
    other triangles and from other heights.
    """
    # A ray reaches a vertex from just above one of its triangles: this far from the corner towards the triangle's
    # centre (barycentric), and from this height over it (in units of the scene's longest side). Later pairs are for
    # vertices that the first ones miss (slivers, surfaces in contact).
    approaches = ((1e-2, 2e-4), (3e-2, 1e-4), (1e-1, 3e-5), (3e-2, 1e-3))
    vertices, triangles = _merge(scene)
    if sheets is not None:
        vertices, triangles = vertices[sheets.front_of], _triangles(sheets)
    extent = float(np.ptp(vertices, axis=0).max()) or 1.0
    owners, rank, corners = _triangles_of_vertices(vertices, triangles)
    origins = np.zeros_like(vertices)
    directions = np.zeros_like(vertices)
    missing = np.ones(len(vertices), dtype=bool)
    for attempt in range(len(approaches) * int(rank.max(initial=0) + 1)):
        step, height = approaches[attempt % len(approaches)]
        chosen = missing[owners] & (rank == attempt // len(approaches))  # one corner per vertex at most
        if not chosen.any():
            continue
        ids = owners[chosen]
        o, d, target = _approach(vertices, triangles, corners[chosen], step, height * extent)
        hit = scene.ray_intersect_preliminary(mi.Ray3f(mi.Point3f(o.T), mi.Vector3f(d.T)))
        distance = np.where(hit.is_valid().numpy(), hit.t.numpy(), np.inf)
        good = np.abs(distance - target) < 0.1 * target
        first = attempt == 0
        origins[ids[good | first]], directions[ids[good | first]] = o[good | first], d[good | first]
        missing[ids[good]] = False
        if not missing.any():
            break
    return VertexRays(origins, directions, missing)


def _merge(scene: mi.Scene | TracedScene) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Concatenate all meshes: vertices (n_v, 3) and triangles (n_t, 3) with global indices."""
    vertices, triangles, offset = [], [], 0
    for shape in scene.shapes():
        vertices.append(shape.vertex_positions_buffer().numpy().reshape(-1, 3))
        triangles.append(shape.faces_buffer().numpy().reshape(-1, 3).astype(np.int64) + offset)
        offset += len(vertices[-1])
    return np.concatenate(vertices), np.concatenate(triangles)


def _triangles_of_vertices(
    vertices: NDArray[np.float32], triangles: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """List every corner with its vertex and its rank there: the corner in the widest triangle has rank 0."""
    owners = triangles.reshape(-1)
    corners = np.arange(len(owners))
    order = np.lexsort((-np.repeat(_widths(vertices[triangles]), 3), owners))
    owners, corners = owners[order], corners[order]
    first = np.searchsorted(owners, owners)  # index of each vertex's first corner
    return owners, np.arange(len(owners)) - first, corners


def _approach(
    vertices: NDArray[np.float32],
    triangles: NDArray[np.int64],
    corners: NDArray[np.int64],
    step: float,
    height: float,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float64]]:
    """Rays that come down on triangles near given corners: origins, directions, and the distance they should go."""
    face, corner = corners // 3, corners % 3
    p = vertices[triangles[face]].astype(np.float64)  # [ray, corner, xyz]
    here = p[np.arange(len(p)), corner]
    target = here + step * (p.mean(axis=1) - here)
    normal = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    origin = (target + height * normal).astype(np.float32)
    return origin, (-normal).astype(np.float32), np.full(len(p), height)


def sensor_points(scene: Scene, rays: VertexRays | None = None) -> Points:
    """Return the points that the ``mesh_vertices`` sensor really sees: its own hits, with Mitsuba's normals there.

    Parameters
    ----------
    scene : Scene
    rays : VertexRays, optional
        Of ``scene.normalised``; made here if not given.
    """
    rays = rays or vertex_rays(scene.normalised, scene)
    ray = mi.Ray3f(mi.Point3f(rays.origins.T), mi.Vector3f(rays.directions.T))
    si = scene.normalised.ray_intersect(ray)
    dr.eval(si)
    p, normals, geometric = (np.ascontiguousarray(a.numpy().T) for a in (si.p, si.sh_frame.n, si.n))
    backs = scene.front_of != np.arange(scene.n_vertices)
    normals[backs] *= -1
    geometric[backs] *= -1
    # the random numbers of the vertices: what differs between the two is then due to the points alone
    return Points(p, normals, geometric, vertex_points(scene).keys)
