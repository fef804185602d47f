"""One bounce of light between vertices as a sparse matrix, by rays ([Leh07] 2.5, T_i of eq. 18).

Light is interpolated between the corners of triangles, which is right as long as these see about what the points
between them see. In a gap much narrower than the triangles they do not: a wall is lit at its vertices, and dark where a
tile is a millimetre before it. There a ray goes on, by chance as the surface reflects, until it is out of the gap.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numba
import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.core.random_keys import random_generator
from mi_sparse_prt.core.sobol import sobol_points
from mi_sparse_prt.core.threads import run_in_parts
from mi_sparse_prt.measurement.hidden_corners import hidden_corners
from mi_sparse_prt.measurement.point_arrays import PointArrays, start_ray
from mi_sparse_prt.measurement.vertices import Points, vertex_points
from mi_sparse_prt.scene.ray_offsets import ray_offset
from mi_sparse_prt.scene.scene import Scene

LANES = 1 << 23  # rays per wavefront
NOTHING = int(
    np.iinfo(np.int32).max
)  # in place of a vertex: what a ray meets if it meets no sheet with vertices
# A gap is narrow if less than this share of the way to the vertex whose light is taken. Of 1, 1/2, 1/4 and 1/10, 1/4
# had the least error in a kitchen with gaps of 1 mm (indirect light 3.0, 2.8, 2.7 and 3.6% off, 4.5% by interpolation).
NARROW = 0.25
TRIES = 8  # to find an open corner of a triangle, of three
MOST_IN_GAP = (
    64  # surfaces, where ``max_depth`` sets no limit: a ray that white ones keep for longer ends as any other
)


def gather_matrix(
    scene: Scene,
    points: Points,
    rays_per_vertex: int,
    seed: int = 0,
    nodes: NDArray[np.integer] | None = None,
    max_depth: int = -1,
) -> scipy.sparse.csr_array:
    """G (n, n_v): what cosine-distributed rays from some vertices find, by the vertices of the triangles they hit.

    Each ray names one corner of its triangle, by chance and with the barycentric weight as its probability. That is
    linear interpolation on average, for a third of the entries. A ray that meets nothing, or the back of a surface
    that has no vertices there, finds no light.

    Parameters
    ----------
    scene : Scene
    points : Points
        Of all vertices.
    rays_per_vertex : int
        A power of two.
    seed : int
    nodes : (n,) integers, optional
        The vertices that have rows; all if not given.
    max_depth : int
        As Mitsuba's ``path``: so many surfaces less 2 light may meet in gaps.

    Returns
    -------
    (n, n_v) sparse float32
        Entries are multiples of 1 / rays_per_vertex.
    """
    if rays_per_vertex < 1 or rays_per_vertex & (rays_per_vertex - 1):
        raise PrtError(f"rays_per_vertex {rays_per_vertex} is not a power of two; use 64, 128, 256, ...")
    surfaces, arrays, samples = Surfaces(scene, max_depth), PointArrays(points), sobol(rays_per_vertex)
    starting = np.arange(len(points)) if nodes is None else nodes
    size = max(1, LANES // rays_per_vertex)
    blocks = []
    for a in range(0, len(starting), size):
        ids = mi.UInt32(starting[a : a + size].astype(np.uint32))
        hits = surfaces.seen_from(arrays, ids, samples, seed)
        blocks.append(_merged(hits.reshape(-1, rays_per_vertex)))
    counts, columns, values = (np.concatenate(part) for part in zip(*blocks, strict=True))
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32 if counts.sum() < NOTHING else np.int64)
    entries = values / np.float32(rays_per_vertex), columns, starts
    return scipy.sparse.csr_array(entries, shape=(len(starting), scene.n_vertices))


class Traced(NamedTuple):
    """What rays met, on the device.

    Attributes
    ----------
    vertex : UInt32
        The vertex whose light each finds, or NOTHING.
    ray : Ray3f
    point : UInt32
        Where it started.
    gaps : UInt32
        Rays that ended in narrow gaps.
    last : Vector3f
        The directions of these when they met their vertices.
    """

    vertex: Any
    ray: Any
    point: Any
    gaps: Any
    last: Any


class Surfaces:
    """The triangles of a scene on the device, by the numbers of all vertices (``n_vertices``).

    Parameters
    ----------
    scene : Scene
    max_depth : int
        As Mitsuba's ``path``, at least 3, or -1.
    """

    def __init__(self, scene: Scene, max_depth: int = -1) -> None:
        self._scene, self._passes_straight = scene.normalised, scene.passes_straight
        triangles = np.concatenate([mesh.triangles + mesh.vertices.start for mesh in scene.fronts])
        self.n_vertices = scene.n_vertices
        self._triangles = mi.UInt32(triangles.astype(np.uint32).ravel())
        self._normals = mi.Vector3f(scene.normals.T)
        self._hidden = hidden_corners(scene)
        self._backs = mi.UInt32(np.where(scene.backs < 0, NOTHING, scene.backs).astype(np.uint32))
        self._positions = mi.Point3f(vertex_points(scene).positions.T)
        self._normalised_positions = scene.normalised_positions
        self._albedo = mi.Float(scene.albedo.mean(axis=1))
        # rays that meet one side find, by chance, the light that comes through from the other
        through = scene.transmitted.mean(axis=1) / np.maximum(scene.sent_albedo.mean(axis=1), 1e-6)
        self._others = (mi.Float(through), _other_sides(scene)) if through.any() else None
        self._most = MOST_IN_GAP if max_depth < 0 else min(max(max_depth - 3, 0), MOST_IN_GAP)
        self._endless = max_depth < 0
        dr.eval(self._positions, self._albedo)

    def seen_from(
        self, points: PointArrays, ids: mi.UInt32, samples: list[mi.UInt32], seed: int
    ) -> NDArray[np.int32]:
        """A vertex or NOTHING for every sample of each point; samples side by side."""
        return mi.Int32(self.traced(points, ids, samples, seed).vertex).numpy()

    def traced(self, points: PointArrays, ids: mi.UInt32, samples: list[mi.UInt32], seed: int) -> Traced:
        """What cosine-distributed rays from points meet, samples side by side."""
        ray, point, vertex, narrow, *_ = self._met(cosine_rays(points, ids, samples, seed))
        dr.eval(vertex, narrow)
        lanes = dr.compress(narrow)  # few, and the ways out of gaps are long: these go together
        last = mi.Vector3f()
        if len(lanes):
            some, _, inside, _, hit, rng = self._met(cosine_rays(points, ids, samples, seed, lanes))
            inside, last = self._out_of_gap(some, hit, inside, rng)
            dr.scatter(vertex, inside, lanes)
            dr.eval(vertex, last)
        return Traced(vertex, ray, point, lanes, last)

    def _met(self, rays: tuple[mi.Ray3f, mi.UInt32, mi.Float, mi.PCG32]) -> tuple[Any, ...]:
        """Rays, their points, the vertices that they meet, and whether in a narrow gap; where, and random numbers."""
        ray, point, u, rng = rays
        hit = self._scene.ray_intersect_preliminary(ray)
        vertex = self.corner(hit, ray, u)
        sender = self.sender(vertex, rng)
        return ray, point, sender, self._is_narrow(hit, ray, vertex) & (sender == vertex), hit, rng

    def _is_narrow(self, hit: mi.PreliminaryIntersection3f, ray: mi.Ray3f, vertex: mi.UInt32) -> mi.Mask:
        return (vertex != NOTHING) & (hit.t < NARROW * self._way(hit, ray, vertex))

    def _way(self, hit: mi.PreliminaryIntersection3f, ray: mi.Ray3f, vertex: mi.UInt32) -> mi.Float:
        """From where rays hit to vertices."""
        return dr.norm(dr.gather(mi.Point3f, self._positions, vertex, vertex != NOTHING) - ray(hit.t))

    def _out_of_gap(
        self, ray: mi.Ray3f, hit: mi.PreliminaryIntersection3f, vertex: mi.UInt32, rng: mi.PCG32
    ) -> tuple[mi.UInt32, mi.Vector3f]:
        """Vertices whose light is that of places in narrow gaps, or NOTHING, and the rays' last directions.

        From the place, a ray goes into a random direction. If it is blocked before it is as far as the vertex, what
        blocks it shines on the place, if chance reflects that. Else the place is lit as a vertex that is as open,
        which is asked for the same way; of the corners of a triangle some may be deeper in the gap.
        """
        most = dr.opaque(mi.UInt32, self._most)

        def go_on(
            ray: mi.Ray3f,
            hit: mi.PreliminaryIntersection3f,
            vertex: mi.UInt32,
            rng: mi.PCG32,
            inside: mi.Mask,
            is_open: mi.Mask,
            met: mi.UInt32,
        ) -> tuple[Any, ...]:
            onward = self._random_ray(ray, hit, vertex, is_open, rng, inside)
            found = self._scene.ray_intersect_preliminary(onward, active=inside)
            blocked = inside & found.is_valid() & (found.t < self._way(hit, ray, vertex))
            again = blocked & is_open & (met < TRIES)
            albedo = dr.gather(mi.Float, self._albedo, vertex, blocked)
            lit = blocked & ~is_open & (rng.next_float32() < albedo)
            reflected = lit & (met < most)
            ray, hit = dr.select(reflected, onward, ray), dr.select(reflected, found, hit)
            absorbed = blocked & ~is_open & ~(lit if self._endless else reflected)
            vertex = dr.select(again | reflected, self.corner(hit, ray, rng.next_float32()), vertex)
            vertex = dr.select(absorbed, NOTHING, vertex)
            opened = inside & ~blocked & ~is_open
            goes_on = again | opened | (reflected & self._is_narrow(hit, ray, vertex))
            met = dr.select(opened, 0, met + 1)
            return ray, hit, vertex, rng, goes_on & (vertex != NOTHING), is_open | opened, met

        state = ray, hit, vertex, rng, mi.Mask(True), mi.Mask(False), mi.UInt32(0)
        ray, _, vertex, *_ = dr.while_loop(state, lambda *state: state[4], go_on)
        return vertex, ray.d

    def _random_ray(
        self,
        ray: mi.Ray3f,
        hit: mi.PreliminaryIntersection3f,
        vertex: mi.UInt32,
        of_vertex: mi.Mask,
        rng: mi.PCG32,
        active: mi.Mask,
    ) -> mi.Ray3f:
        """Cosine-distributed rays from vertices or, of other lanes, from where rays hit."""
        si = self._scene.interaction(hit, ray, active)
        there = active & of_vertex
        normal = dr.select(
            of_vertex,
            dr.gather(mi.Vector3f, self._normals, vertex, there),
            dr.mulsign(mi.Vector3f(si.n), -dr.dot(si.n, ray.d)),
        )
        start = dr.select(of_vertex, dr.gather(mi.Point3f, self._positions, vertex, there), si.p)
        uv = mi.Point2f(rng.next_float32(), rng.next_float32())
        direction = mi.Frame3f(normal).to_world(mi.warp.square_to_cosine_hemisphere(uv))
        lifted = dr.fma(normal, ray_offset(start), start)
        return mi.Ray3f(lifted, direction)

    def corner(self, hit: mi.PreliminaryIntersection3f, ray: mi.Ray3f, u: mi.Float) -> mi.UInt32:
        """The corner of each hit triangle that u in [0, 1) selects, on the sheet that is met; or NOTHING.

        Also NOTHING with the probability of light to go straight on: rows of masks are those of what they cover.
        """
        valid = hit.is_valid()
        if self._passes_straight:
            si = self._scene.interaction(hit, ray, valid)
            passed = dr.sum(mi.Color3f(si.bsdf().eval_null_transmission(si, valid))) / 3
            valid &= u >= passed
            u = (u - passed) / dr.maximum(1 - passed, 1e-6)
        return self.corner_met(hit, ray, u, valid)

    def sender(self, vertex: mi.UInt32, rng: mi.PCG32) -> mi.UInt32:
        """The vertex whose light each sends on to what sees it: by chance the one on the other side, or NOTHING.

        With the probability that what is sent has come through the surface (``Scene.transmitted``); of what vertices
        receive, they send on ``Scene.sent_albedo``.
        """
        if self._others is None:
            return vertex
        known = vertex != NOTHING
        through, other = (dr.gather(type(x), x, vertex, known) for x in self._others)
        return dr.select(known & (rng.next_float32() < through), other, vertex)

    def corner_met(
        self, hit: mi.PreliminaryIntersection3f, ray: mi.Ray3f, u: mi.Float, valid: mi.Mask
    ) -> mi.UInt32:
        """The same, whether or not light goes straight on."""
        triangle = self._scene.triangle(hit, valid)
        corners = [dr.gather(mi.UInt32, self._triangles, 3 * triangle + k, valid) for k in range(3)]
        b = hit.prim_uv.x, hit.prim_uv.y
        weights = 1 - b[0] - b[1], *b
        normal = mi.Vector3f(0)
        for corner, weight in zip(corners, weights, strict=True):
            normal += weight * dr.gather(mi.Vector3f, self._normals, corner, valid)
        front = dr.dot(normal, ray.d) < 0  # of the shading normal, as for Mitsuba's BSDFs
        if self._hidden.some:
            k = self._hidden.choose(triangle, ray(hit.t), ray.d, weights, u, valid)
        else:
            k = dr.select(u < b[0], 1, dr.select(u < b[0] + b[1], mi.UInt32(2), 0))
        chosen = dr.select(k == 1, corners[1], dr.select(k == 2, corners[2], corners[0]))
        chosen = dr.select(front, chosen, dr.gather(mi.UInt32, self._backs, chosen, valid & ~front))
        return dr.select(valid, chosen, NOTHING)

    @cached_property
    def _places(self) -> mi.Vector3f:
        """Of corners themselves, off which rows of vertices may start a little."""
        return mi.Vector3f(self._normalised_positions.T)

    def corners_above(
        self, triangle: mi.UInt32, side: mi.Float, rng: mi.PCG32
    ) -> tuple[mi.UInt32, mi.UInt32]:
        """A corner, on a side, of each triangle by a random place on it; and that which a ray to there finds.

        The ray comes from half of the way to what the place sees in a random direction. It finds another corner where a
        wall hides the first, and NOTHING if it meets another surface, as it may where one lies on the triangle.
        """
        corners = [dr.gather(mi.UInt32, self._triangles, 3 * triangle + k) for k in range(3)]
        p, n = (
            [dr.gather(mi.Vector3f, x, corner) for corner in corners] for x in (self._places, self._normals)
        )
        uv = mi.warp.square_to_uniform_triangle(mi.Point2f(rng.next_float32(), rng.next_float32()))
        b = 1 - uv.x - uv.y, uv.x, uv.y
        place, shading = (x[0] * b[0] + x[1] * b[1] + x[2] * b[2] for x in (p, n))
        normal = side * dr.normalize(dr.cross(p[1] - p[0], p[2] - p[0]))
        uv = mi.Point2f(rng.next_float32(), rng.next_float32())
        way = mi.Frame3f(normal).to_world(mi.warp.square_to_cosine_hemisphere(uv))
        seen = self._scene.ray_intersect_preliminary(mi.Ray3f(dr.fma(normal, ray_offset(place), place), way))
        ray = mi.Ray3f(dr.fma(way, dr.minimum(seen.t, 2) / 2, place), -way)
        hit, u = self._scene.ray_intersect_preliminary(ray), rng.next_float32()
        expected = dr.select(u < b[1], corners[1], dr.select(u < b[1] + b[2], corners[2], corners[0]))
        front = dr.dot(shading, way) > 0
        expected = dr.select(front, expected, dr.gather(mi.UInt32, self._backs, expected, ~front))
        own = hit.is_valid() & (self._scene.triangle(hit, hit.is_valid()) == triangle)
        return expected, self.corner_met(hit, ray, u, own)


def _other_sides(scene: Scene) -> mi.UInt32:
    """The vertex on the other side of each, or NOTHING."""
    fronts = len(scene.backs)
    others = np.concatenate([np.where(scene.backs < 0, NOTHING, scene.backs), scene.front_of[fronts:]])
    return mi.UInt32(others.astype(np.uint32))


def cosine_rays(
    points: PointArrays, ids: mi.UInt32, samples: list[mi.UInt32], seed: int, lanes: mi.UInt32 | None = None
) -> tuple[mi.Ray3f, mi.UInt32, mi.Float, mi.PCG32]:
    """Cosine-distributed rays from points, samples side by side; or those of some lanes.

    With each one's point, a number in [0, 1) for it, and more random numbers.
    """
    rays = len(samples[0])
    lane = dr.arange(mi.UInt32, len(ids) * rays) if lanes is None else lanes
    row = lane // rays
    point, sample = dr.gather(mi.UInt32, ids, row), lane - row * rays
    rng = random_generator(points.key(point), mi.UInt32(0), mi.UInt32(0), seed)
    # bits flipped alike for all samples of a point (Owen's digital shift): they stay stratified
    x, y, z = (
        mi.Float((dr.gather(mi.UInt32, column, sample) ^ rng.next_uint32()) >> 8) * 2**-24
        for column in samples
    )
    local = mi.warp.square_to_cosine_hemisphere(mi.Point2f(x, y))
    direction = mi.Frame3f(points.normal(point)).to_world(local)
    own = random_generator(points.key(point), sample, mi.UInt32(1), seed)
    return start_ray(points, point, direction), point, z, own


def sobol(n: int) -> list[mi.UInt32]:
    """Three columns of n Sobol points as 32-bit fractions, neighbours on the square side by side."""
    points = sobol_points(n)
    order = np.argsort(_interleaved(*(points[:, :2] >> np.uint32(16)).T), kind="stable")
    columns = [mi.UInt32(column) for column in points[order].T.copy()]
    dr.eval(columns)
    return columns


def _interleaved(x: NDArray[np.uint32], y: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """The bits of two 16-bit numbers in turn (Morton's order)."""
    result = np.zeros_like(x)
    for k in range(16):
        result |= (x >> k & 1) << (2 * k) | (y >> k & 1) << (2 * k + 1)
    return result


@numba.njit(nogil=True, cache=True)
def _sort(first: int, last: int, hits: NDArray[np.int32], counts: NDArray[np.int64]) -> None:
    """Sort each row in place; how many different vertices it has."""
    for i in range(first, last):
        row = hits[i]
        row.sort()
        count = 0
        for k in range(len(row)):
            count += row[k] < NOTHING and (k == 0 or row[k] != row[k - 1])
        counts[i] = count


def _merged(hits: NDArray[np.int32]) -> tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.float32]]:
    """Entries of each row (n,), their columns, in order, and how many rays they got, (m,) each."""
    counts = np.empty(len(hits), np.int64)
    run_in_parts(_sort, len(hits), hits, counts)
    columns = np.empty(counts.sum(), np.int32)
    values = np.empty(len(columns), np.float32)
    run_in_parts(_fill, len(hits), hits, np.cumsum(counts) - counts, columns, values)
    return counts, columns, values


@numba.njit(nogil=True, cache=True)
def _fill(
    first: int,
    last: int,
    hits: NDArray[np.int32],
    starts: NDArray[np.int64],
    columns: NDArray[np.int32],
    values: NDArray[np.float32],
) -> None:
    for i in range(first, last):
        at = starts[i] - 1
        for k in range(hits.shape[1]):
            vertex = hits[i, k]
            if vertex >= NOTHING:
                break
            if k == 0 or vertex != hits[i, k - 1]:
                at += 1
                columns[at], values[at] = vertex, np.float32(1)
            else:
                values[at] += np.float32(1)
