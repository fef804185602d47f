"""Relit images and vertices, rendered by Mitsuba's own ``path``."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.measurement.vertices import VertexRays
from mi_sparse_prt.relighting.image import RelitIntegrator, RelitScene
from mi_sparse_prt.scene.mitsuba_meshes import lit_scene
from mi_sparse_prt.scene.scene import Scene


@contextmanager
def posed(
    sensor: mi.Sensor, width: int, turn: float = 0.0, centre: NDArray[np.float64] | None = None
) -> Iterator[None]:
    """Within this context a sensor's film has another width and the same shape, and the sensor is turned.

    Parameters
    ----------
    sensor : mi.Sensor
    width : int
        Pixels.
    turn : float
        Degrees about the world's Y axis through ``centre``.
    centre : (3,) float, optional
        The origin if not given.
    """
    parameters = mi.traverse(sensor)
    size = next(k for k in parameters.keys() if k.endswith("film.size"))
    old = {size: mi.ScalarVector2u(parameters[size])}
    new = {size: mi.ScalarVector2u(width, max(1, round(width * old[size].y / old[size].x)))}
    if turn:
        c = mi.ScalarVector3f([0, 0, 0] if centre is None else centre)
        old["to_world"] = mi.Transform4f(parameters["to_world"])
        new["to_world"] = (
            mi.Transform4f().translate(c).rotate([0, 1, 0], turn).translate(-c) @ old["to_world"]
        )
    try:
        parameters.update(new)
        yield
    finally:
        parameters.update(old)


def path_image(
    lit: mi.Scene, sensor: mi.Sensor, max_depth: int, spp: int, seed: int, **options: Any
) -> NDArray[np.float32]:
    """Mitsuba's ``path`` image (height, width, 3) of a scene, with options of that integrator."""
    integrator = mi.load_dict({"type": "path", "max_depth": max_depth, **options})
    return np.array(mi.render(lit, sensor=sensor, integrator=integrator, spp=spp, seed=seed))[..., :3]


def image_of_vertices(
    scene: Scene,
    irradiance: NDArray[np.float32],
    background: mi.Emitter | None,
    spp: int,
    sensor: mi.Sensor | int = 0,
    seed: int = 0,
) -> NDArray[np.float32]:
    """Image (height, width, 3) of a scene from irradiance / pi (n_v, 3) at its vertices, by whatever method."""
    integrator = RelitIntegrator(RelitScene(scene, irradiance[None], background))
    return np.array(mi.render(scene.mitsuba, sensor=sensor, integrator=integrator, spp=spp, seed=seed))[
        ..., :3
    ]


def reference_vertices(
    scene: Scene, background: mi.Emitter, rays: VertexRays, max_depth: int, spp: int, seed: int
) -> NDArray[np.float32]:
    """Mitsuba's ``path`` radiance (n_v, 3) of all vertices under one environment emitter."""
    sensor = {"type": "mesh_vertices", "vertices": len(rays.origins)}
    lit = lit_scene(scene.normalised.shapes(), background, sensor=sensor)
    lit.sensors()[0].bind(lit, rays)
    integrator = mi.load_dict({"type": "path", "max_depth": max_depth})
    return lit.sensors()[0].radiance(mi.render(lit, integrator=integrator, spp=spp, seed=seed))
