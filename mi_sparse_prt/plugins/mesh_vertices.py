"""M as a Mitsuba sensor: an image whose pixels are the scene's vertices."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.measurement.vertices import VertexRays, vertex_rays


class MeshVertices(mi.Sensor):
    r"""Vertex sensor (:monosp:`mesh_vertices`)
    ----------------------------------------

    Every pixel looks at one vertex of the scene's meshes.

    With any integrator, pixel ``i`` (row by row) is the radiance that leaves vertex ``i``, the vertices of all shapes
    counted in the order of ``scene.shapes()``. A vertex is seen from just above one of its triangles, a hundredth of
    the triangle's size inside it, so that borders and poles are not missed.

    The rays are made when the sensor is bound to a loaded scene, because Mitsuba does not tell a sensor its scene:
    ``scene.sensors()[0].bind(scene)``. Rendering an unbound sensor is an error.

    .. tabs::
        .. code-tab:: xml

            <sensor type="mesh_vertices">
                <integer name="vertices" value="64075"/>
                <sampler type="independent"><integer name="sample_count" value="64"/></sampler>
            </sensor>

        .. code-tab:: python

            'type': 'mesh_vertices', 'vertices': 64075, 'sampler': {'type': 'independent'}

    ========== ========= ==================================================================================
    Parameter  Type      Meaning
    ========== ========= ==================================================================================
    vertices   integer   Number of pixels that look at vertices; the film gets at least that many.
    film       film      Optional: its own film, 2-D, box filter, at least ``vertices`` pixels. The default is
                         a square one of 32-bit floats. A wide or one-row film loses pixels to float rounding.
    ========== ========= ==================================================================================
    """

    def __init__(self, props: mi.Properties) -> None:
        self._vertices = int(props.get("vertices", 0))
        if self._vertices < 1:
            raise PrtError("mesh_vertices: say how many with <integer name='vertices' value='...'/>")
        if not any(isinstance(value, mi.Film) for _, value in props.objects()):
            side = math.ceil(math.sqrt(self._vertices))
            props["film"] = mi.load_dict(
                {
                    "type": "hdrfilm",
                    "width": side,
                    "height": side,
                    "pixel_format": "rgb",
                    "component_format": "float32",
                    "rfilter": {"type": "box"},
                }
            )
        super().__init__(props)
        self._size = self.film().size()
        if self._size.x * self._size.y < self._vertices:
            raise PrtError(
                f"mesh_vertices: a film of {self._size.x} x {self._size.y} pixels is too small "
                f"for {self._vertices} vertices"
            )
        if self.film().rfilter().radius() > 0.5 + 1e-6:
            raise PrtError("mesh_vertices: the film's filter mixes vertices; set <rfilter type='box'/>")
        self._origins: mi.Point3f | None = None

    def bind(self, scene: mi.Scene, rays: VertexRays | None = None) -> VertexRays:
        """Look at the vertices of a scene.

        Parameters
        ----------
        scene : mi.Scene
            The scene that will be rendered; all its shapes are meshes.
        rays : VertexRays, optional
            Made earlier for this scene, or a selection of such; found here if not given.

        Returns
        -------
        VertexRays
            The rays in use, with the flags of vertices that none reached.

        Raises
        ------
        PrtError
            If the number of rays is not that of the sensor.
        """
        rays = rays or vertex_rays(scene)
        if len(rays.origins) != self._vertices:
            raise PrtError(
                f"mesh_vertices: made for {self._vertices} vertices, but there are {len(rays.origins)}"
            )
        self._origins, self._directions = mi.Point3f(rays.origins.T), mi.Vector3f(rays.directions.T)
        dr.eval(self._origins, self._directions)
        return rays

    def sample_ray(
        self,
        time: mi.Float,
        wavelength_sample: mi.Float,
        position_sample: mi.Point2f,
        aperture_sample: mi.Point2f,
        active: mi.Mask = True,
    ) -> tuple[mi.Ray3f, mi.Spectrum]:
        """The ray of the pixel at a film position in [0, 1]^2; pixels beyond the last vertex see nothing."""
        if self._origins is None:
            raise PrtError(
                "mesh_vertices: not bound to a scene; call scene.sensors()[0].bind(scene) before rendering"
            )
        column, row = (
            dr.clip(mi.UInt32(position_sample[axis] * self._size[axis]), 0, self._size[axis] - 1)
            for axis in (0, 1)
        )
        vertex = row * self._size.x + column
        active = mi.Mask(active) & (vertex < self._vertices)
        ray = dr.zeros(mi.Ray3f)
        ray.o = dr.gather(mi.Point3f, self._origins, vertex, active)
        ray.d = dr.gather(mi.Vector3f, self._directions, vertex, active)
        ray.time = time
        ray.maxt = dr.select(active, dr.largest(mi.Float), 0)
        return ray, dr.select(active, mi.Spectrum(1), 0)

    def sample_ray_differential(
        self, *arguments: Any, **named: Any
    ) -> tuple[mi.RayDifferential3f, mi.Spectrum]:
        """As ``sample_ray``; a vertex has no neighbours on the film, so there are no differentials."""
        ray, weight = self.sample_ray(*arguments, **named)
        return mi.RayDifferential3f(ray), weight

    def radiance(self, image: mi.TensorXf) -> NDArray[np.float32]:
        """The rendered pixels as one row per vertex, (n_v, 3) float32."""
        return np.array(image)[..., :3].reshape(-1, 3)[: self._vertices]

    def bbox(self) -> mi.BoundingBox3f:
        return mi.BoundingBox3f()

    def to_string(self) -> str:
        return f"MeshVertices[vertices = {self._vertices}, bound = {self._origins is not None}]"
