"""What the cameras of a scene see of its surfaces: pictures are made of nothing else."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.scene.scene import Scene

ACROSS = 256  # rays per axis of a film
LONGEST = 4  # surfaces that a ray meets


def camera_shares(scene: Scene) -> NDArray[np.float32]:
    """How much of the films of all cameras shows each vertex (n_v,): the sum is 1, or 0 if none sees anything.

    What is seen in mirrors and through glass, or glossy surfaces reflect, is seen as well: rays go on from these,
    mirrored or straight, and each surface on the way counts alike.
    """
    shares, surfaces = np.zeros(scene.n_vertices + 1), scene.normalised
    corners = np.concatenate([mesh.triangles + mesh.vertices.start for mesh in scene.fronts])
    backs = np.where(scene.backs < 0, scene.n_vertices, scene.backs)
    sizes, materials = [len(mesh.triangles) for mesh in scene.fronts], scene.materials[: len(scene.fronts)]
    goes_on = [m.single_directions or not m.known_by_irradiance for m in materials]
    followed, passes = (
        mi.Bool(np.repeat(kind, sizes)) for kind in (goes_on, [m.passes_light for m in materials])
    )
    for sensor in scene.cameras:
        ray, rng, active = _rays_of(sensor, scene), mi.PCG32(size=ACROSS**2), mi.Mask(True)
        for _ in range(LONGEST if any(goes_on) else 1):
            hit = surfaces.ray_intersect_preliminary(ray, active)
            si = surfaces.interaction(hit, ray, active)
            met = active & si.is_valid()
            triangle = dr.select(met, surfaces.triangle(hit, met), 0)
            behind = mi.Frame3f.cos_theta(si.wi) < 0
            through = dr.gather(mi.Bool, passes, triangle, met) & (rng.next_float32() < 0.5)
            active = met & dr.gather(mi.Bool, followed, triangle, met)
            ray = si.spawn_ray(dr.select(through, ray.d, si.to_world(mi.reflect(si.wi))))
            dr.eval(ray, active, rng, met, triangle, behind, hit.prim_uv)
            some = np.flatnonzero(met.numpy())
            vertices = corners[triangle.numpy()[some]]
            vertices = np.where(behind.numpy()[some, None], backs[vertices], vertices)
            u, v = (x.numpy()[some] for x in (hit.prim_uv.x, hit.prim_uv.y))
            weights = np.stack([1 - u - v, u, v], axis=1)
            shares += np.bincount(vertices.ravel(), weights.ravel(), len(shares))
    seen = shares[:-1]  # the last is what no vertex tells: backs that no light reaches
    return (seen / max(float(seen.sum()), 1e-30)).astype(np.float32)


def _rays_of(sensor: mi.Sensor, scene: Scene) -> mi.Ray3f:
    """Through an even grid of places on the film, in the normalised frame."""
    number = dr.arange(mi.UInt32, ACROSS**2)
    row = number // ACROSS
    place = (mi.Point2f(mi.Float(number - row * ACROSS), mi.Float(row)) + 0.5) / ACROSS
    ray, _ = sensor.sample_ray_differential(0.0, 0.5, place, mi.Point2f(0.5))
    origins = (ray.o.numpy().T.astype(np.float64) - scene.centre) * scene.scale
    return mi.Ray3f(mi.Point3f(np.ascontiguousarray(origins.T.astype(np.float32))), ray.d)
