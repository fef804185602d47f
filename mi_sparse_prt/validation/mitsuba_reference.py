"""The reference: columns of T, and relit images, rendered by Mitsuba's own ``path``."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from tqdm.auto import tqdm

from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.measurement.vertices import VertexRays, vertex_rays
from mi_sparse_prt.relighting.image import RelitIntegrator, RelitScene
from mi_sparse_prt.scene.mitsuba_meshes import watertight_scene
from mi_sparse_prt.scene.scene import Scene


def lit_scene(shapes: Sequence[mi.Shape], light: mi.Emitter | dict[str, Any], **others: Any) -> mi.Scene:
    """Shapes under one ``light``, which rays do not slip between, and other objects by name."""
    named = {f"shape_{k}": shape for k, shape in enumerate(shapes)}
    return mi.load_dict({**watertight_scene(), "light": light, **others, **named})


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


class ReferenceMatrix:
    """Elements of T by full Mitsuba renders: ``path``, the ``mesh_vertices`` sensor, one light per column.

    Parameters
    ----------
    scene : Scene
    lighting : CubemapLighting
    basis : {"direction", "texel"}
        A ``directional`` emitter that carries the texel's power, or the texel of a ``cubemap`` with radiance 1.
    max_depth : int
    vertices : (k,) integers
        The rows that are rendered.
    rays : VertexRays, optional
        Of all vertices of ``scene.normalised``, if they are known already.
    """

    def __init__(
        self,
        scene: Scene,
        lighting: CubemapLighting,
        basis: str,
        max_depth: int,
        vertices: NDArray[np.integer],
        rays: VertexRays | None = None,
    ) -> None:
        rays = rays or vertex_rays(scene.normalised)
        light: dict[str, Any]
        if basis == "direction":
            light = {"type": "directional", "direction": [0, 0, -1], "irradiance": 1.0}
        else:
            light = {"type": "cubemap", "resolution": lighting.resolution, "texel": 0}
        self._scene = lit_scene(
            scene.normalised.shapes(),
            light,
            integrator={"type": "path", "max_depth": max_depth},
            sensor={"type": "mesh_vertices", "vertices": len(vertices)},
        )
        self._sensor = self._scene.sensors()[0]
        self._sensor.bind(self._scene, rays.take(vertices))
        self._parameters = mi.traverse(self._scene)
        self._lighting, self._basis = lighting, basis

    def columns(
        self, texels: NDArray[np.integer], spp: int, seed: int = 0, progress: bool = False
    ) -> NDArray[np.float32]:
        """Render columns: (rows, columns, 3) float32.

        Every column has its own seed, so that columns are independent of each other.
        """
        rendered = [
            self._column(int(texel), spp, seed * self._lighting.n_directions + int(texel))
            for texel in tqdm(texels, desc="reference", unit=" columns", disable=not progress)
        ]
        return np.stack(rendered, axis=1)

    def _column(self, texel: int, spp: int, seed: int) -> NDArray[np.float32]:
        power = np.float32(1)
        if self._basis == "direction":
            direction = self._lighting.directions[texel].astype(np.float64)
            across = np.eye(3)[np.argmin(np.abs(direction))]
            self._parameters["light.to_world"] = mi.Transform4f().look_at([0, 0, 0], -direction, across)
            power = self._lighting.solid_angles[texel]
        else:
            self._parameters["light.texel"] = texel
        self._parameters.update()
        return self._sensor.radiance(mi.render(self._scene, spp=spp, seed=seed % (1 << 32))) * power


def reference_image(
    scene: Scene, background: mi.Emitter, sensor: mi.Sensor, max_depth: int, spp: int, seed: int
) -> NDArray[np.float32]:
    """Mitsuba's ``path`` image (height, width, 3) of a scene's meshes under one environment emitter, world units."""
    lit = lit_scene(scene.unlit_shapes(), background)
    return path_image(lit, sensor, max_depth, spp, seed)


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
    integrator = RelitIntegrator(RelitScene(scene, irradiance, background))
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
