"""Lamps as a page shows them: which vertices shine, by which lamp, and what is behind the scene."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.emission.environment import Environment, environment_of
from mi_sparse_prt.emission.space import SampledEmission
from mi_sparse_prt.scene.scene import Mesh, Scene

NEAR = 1e-3  # of the scene's size: how far before a surface a ray begins that is to meet it
INSIDE = 0.05  # of the way to the centre of a triangle
DARK = np.zeros((1, 2, 3), np.float32)  # behind a scene without an environment

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class VisibleLamps:
    """Vertices on area lights, and the environment.

    Attributes
    ----------
    vertices : (k,) int64
    lamps : (k,) int32
        Whose light it is.
    radiance : (k, 3) float32
        At full brightness, along the normal.
    background : Environment
        Black where there is none.
    background_lamp : int
        Its number, -1 where no lamp is it.
    """

    vertices: NDArray[np.int64]
    lamps: NDArray[np.int32]
    radiance: Floats
    background: Environment
    background_lamp: int

    def shine(self, brightness: Floats, count: int) -> Floats:
        """Radiance (count, 3) of all vertices themselves, from that of lamps (size, 3)."""
        found = np.zeros((count, 3), np.float32)
        found[self.vertices] = self.radiance * brightness[self.lamps]
        return found


def visible_lamps(scene: Scene, emission: SampledEmission) -> VisibleLamps:
    """Look at each vertex of each area light from nearby, and away from the scene."""
    shapes = scene.mitsuba.shapes()
    shining = [mesh for mesh in scene.fronts if shapes[mesh.shape].is_emitter()]
    none = np.zeros(0, np.int64)
    vertices = np.concatenate([none, *(np.arange(m.vertices.start, m.vertices.stop) for m in shining)])
    inside = np.concatenate([np.zeros((0, 3)), *(_places_inside(scene, mesh) for mesh in shining)])
    size = float(np.linalg.norm(np.ptp(scene.positions, axis=0)))
    normals = scene.normals[vertices]
    lamps, radiance = _seen(scene, emission, (inside + NEAR * size * normals).astype(np.float32), -normals)
    known = lamps >= 0
    up = np.array([[0, 1, 0]], np.float32)
    (behind,), _ = _seen(scene, emission, (scene.centre + 10 * size * up).astype(np.float32), up)
    environment = scene.mitsuba.environment()
    background = Environment(DARK) if environment is None else environment_of(environment)
    return VisibleLamps(vertices[known], lamps[known], radiance[known], background, int(behind))


def _places_inside(scene: Scene, mesh: Mesh) -> NDArray[np.float64]:
    """Places (n, 3) close to the vertices of a mesh, not on its edges, which rays may miss; world."""
    positions = scene.positions[mesh.vertices].astype(np.float64)
    centres = positions.copy()
    for corner in mesh.triangles.T:
        centres[corner] = positions[mesh.triangles].mean(axis=1)  # of any triangle of the vertex
    return positions + INSIDE * (centres - positions)


def _seen(
    scene: Scene, emission: SampledEmission, origins: Floats, directions: Floats
) -> tuple[NDArray[np.int32], Floats]:
    """Lamps (k,) whose light rays meet, -1 for none, and their radiance (k, 3)."""
    if not len(origins):
        return np.zeros(0, np.int32), np.zeros((0, 3), np.float32)
    ray = mi.Ray3f(
        mi.Point3f(np.ascontiguousarray(origins.T)), mi.Vector3f(np.ascontiguousarray(directions.T))
    )
    si = scene.mitsuba.ray_intersect(ray)
    lamp, radiance = emission.element_of(si, ray, mi.Bool(True))
    return np.array(lamp), np.ascontiguousarray(np.array(radiance).T)
