"""The reference: columns of T, one light at a time, by full renders with Mitsuba's own ``path``."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from tqdm.auto import tqdm

from mi_sparse_prt.emission.space import EmissionSpace
from mi_sparse_prt.measurement.vertices import VertexRays, vertex_rays
from mi_sparse_prt.scene.mitsuba_meshes import lit_scene
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.validation.diffuse_patches import diffuse_patches

Floats = NDArray[np.float32]


class ReferenceMatrix:
    """Elements of T by full Mitsuba renders.

    Parameters
    ----------
    scene : Scene
    emission : EmissionSpace
        A texel of a cubemap is a ``directional`` emitter of the texel's power, or a texel of radiance 1 of a
        ``cubemap``, by the basis; a lamp is the scene with all others off.
    basis : {"direction", "texel"}
    max_depth : int
    rows : (k,) integers
        Vertices, seen through the ``mesh_vertices`` sensor, or pixels of the camera. Under a cubemap, those that
        are not diffuse get a ``diffuse_patches`` triangle each.
    rays : VertexRays, optional
        Of all vertices of ``scene.normalised``, or of ``scene.mitsuba`` for lamps, if they are known already.
    camera : mi.Sensor, optional
        Rows are its pixels. Lights that it sees themselves are left out, as T has only what surfaces reflect.
    """

    def __init__(
        self,
        scene: Scene,
        emission: EmissionSpace,
        basis: str,
        max_depth: int,
        rows: NDArray[np.integer],
        rays: VertexRays | None = None,
        camera: mi.Sensor | None = None,
    ) -> None:
        self._scene, self._emission, self._basis, self._rows = scene, emission, basis, rows
        self._path = mi.load_dict({"type": "path", "max_depth": max_depth})
        self._only_lights = mi.load_dict({"type": "path", "max_depth": 1})
        distant, self._camera = emission.kind == "cubemap", camera
        self._sees_lights = camera is not None or not distant
        if camera is None:
            rays = rays or vertex_rays(scene.normalised if distant else scene.mitsuba, scene)
        if distant:
            self._sky = self._under_a_sky(
                scene.unlit_shapes() if rays is None else _painted(scene, rays, rows)
            )
            self._parameters = mi.traverse(self._sky)
        if rays is not None:
            lit = self._sky if distant else scene.mitsuba
            self._vertices = mi.load_dict({"type": "mesh_vertices", "vertices": len(rows)})
            self._vertices.bind(lit, rays.take(rows))

    def columns(
        self, elements: NDArray[np.integer], spp: int, seed: int = 0, progress: bool = False
    ) -> Floats:
        """Render columns: (rows, columns, 3) float32.

        Every column has its own seed, so that columns are independent of each other.
        """
        rendered = []
        for element in tqdm(elements, desc="reference", unit=" columns", disable=not progress):
            with self._lit_by(int(element)) as (lit, power):
                own = (seed * self._emission.size + int(element)) % (1 << 32)
                rendered.append(self._radiance(lit, spp, own) * power)
        return np.stack(rendered, axis=1)

    def _under_a_sky(self, shapes: list[mi.Mesh]) -> mi.Scene:
        light: dict[str, Any] = {"type": "directional", "direction": [0, 0, -1], "irradiance": 1.0}
        if self._basis == "texel":
            light = {"type": "cubemap", "resolution": self._emission.attributes()["resolution"], "texel": 0}
        return lit_scene(shapes, light)

    @contextmanager
    def _lit_by(self, element: int) -> Iterator[tuple[mi.Scene, np.float32]]:
        """A scene under one element's light, and what its radiance is to be multiplied by."""
        power = np.float32(1)
        if self._emission.kind != "cubemap":
            alone = np.zeros((self._emission.size, 3), np.float32)
            alone[element] = 1
            with self._emission.scene_lit_by(alone, self._scene) as lit:
                yield lit, power
            return
        if self._basis == "direction":
            directions = np.stack([self._emission.coordinates[axis] for axis in "xyz"], axis=1)
            direction = directions[element].astype(np.float64)
            across = np.eye(3)[np.argmin(np.abs(direction))]
            self._parameters["light.to_world"] = mi.Transform4f().look_at([0, 0, 0], -direction, across)
            power = self._emission.weights[element]
        else:
            self._parameters["light.texel"] = element
        self._parameters.update()
        yield self._sky, power

    def _radiance(self, lit: mi.Scene, spp: int, seed: int) -> Floats:
        """Reflected radiance (rows, 3)."""
        sensor = self._vertices if self._camera is None else self._camera

        def seen(integrator: mi.Integrator) -> Floats:
            image = mi.render(lit, sensor=sensor, integrator=integrator, spp=spp, seed=seed)
            if self._camera is None:
                return sensor.radiance(image)
            return np.array(image)[..., :3].reshape(-1, 3)[self._rows]

        return seen(self._path) - (seen(self._only_lights) if self._sees_lights else np.float32(0))


def _painted(scene: Scene, rays: VertexRays, rows: NDArray[np.integer]) -> list[mi.Mesh]:
    """The surfaces of the normalised frame, and specks of paint on rows that are not diffuse."""
    paint = diffuse_patches(scene, rays, rows)
    return [*scene.normalised.shapes(), *([] if paint is None else [paint])]
