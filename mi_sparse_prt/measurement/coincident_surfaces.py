"""Surfaces that lie on each other: which of them a ray meets first is a matter of rounding."""

from __future__ import annotations

import itertools

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.measurement.vertices import VertexRays
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.scene.triangle_mesh import unique_rows

RAYS = 64  # from around a vertex: of two surfaces in one plane, each is met first by some of them
NEAR = 0.1  # of the way of a ray: what is met within so much of the same place lies there


def lie_on_others(scene: Scene, rays: VertexRays) -> NDArray[np.bool_]:
    """Whether another surface lies where rays end, so that they may meet either.

    Parameters
    ----------
    scene : Scene
    rays : VertexRays
        In its normalised frame.

    Returns
    -------
    (n,) bool
    """
    triangles = np.concatenate([mesh.triangles + mesh.vertices.start for mesh in scene.fronts])
    straight = mi.Ray3f(mi.Point3f(rays.origins.T), mi.Vector3f(rays.directions.T))
    hit = scene.normalised.ray_intersect_preliminary(straight)
    valid = hit.is_valid()
    way = dr.select(valid, hit.t, 0)
    end, triangle = straight(way), dr.select(valid, scene.normalised.triangle(hit, valid), 0)
    dr.eval(way, end, triangle)
    lane = dr.arange(mi.UInt32, len(rays.missed) * RAYS)
    point, k = lane // RAYS, lane % RAYS
    u = mi.Point2f((mi.Float(k) + 0.5) / RAYS, mi.Float(dr.brev(k)) * 2**-32)  # Hammersley's points
    frame = mi.Frame3f(-dr.gather(mi.Vector3f, straight.d, point))
    away = frame.to_world(mi.warp.square_to_uniform_hemisphere(u) + mi.Vector3f(0, 0, 1))
    length = dr.gather(mi.Float, way, point)
    away = dr.normalize(away)  # at most 60 degrees from the ray
    other = scene.normalised.ray_intersect_preliminary(
        mi.Ray3f(dr.fma(away, length, dr.gather(mi.Point3f, end, point)), -away)
    )
    there = other.is_valid() & (dr.abs(other.t - length) < NEAR * length)
    first, second = dr.gather(mi.UInt32, triangle, point), scene.normalised.triangle(other, there)
    corners = mi.UInt32(triangles.ravel().astype(np.uint32))
    apart = dr.select(there & ~_share_a_corner(corners, first, second, there), mi.UInt32(1), 0)
    found = dr.block_reduce(dr.ReduceOp.Or, apart, RAYS).numpy() > 0
    return found | _repeated(scene, triangles)[triangle.numpy()]


def _repeated(scene: Scene, triangles: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which triangles have the same corners as others, which rays meet at the very same places."""
    _, place = unique_rows(scene.normalised_positions)
    _, same = unique_rows(np.sort(place[triangles], axis=1))
    repeated: NDArray[np.bool_] = np.bincount(same)[same] > 1
    return repeated


def _share_a_corner(corners: mi.UInt32, first: mi.UInt32, second: mi.UInt32, active: mi.Mask) -> mi.Mask:
    """Whether two triangles have a vertex in common."""
    a, b = ([dr.gather(mi.UInt32, corners, 3 * t + k, active) for k in range(3)] for t in (first, second))
    same = mi.Mask(False)
    for one, other in itertools.product(a, b):
        same |= one == other
    return same
