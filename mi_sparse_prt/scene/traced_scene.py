"""Scenes of triangle meshes that rays are traced in."""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_sparse_prt.scene.shape_table import ShapeTable


class TracedScene:
    """A Mitsuba scene of triangle meshes with vertex normals, and the surfaces that rays find in it.

    Parameters
    ----------
    mitsuba : mi.Scene
        Nothing but such meshes, none of which flips its normals; lamps and cameras may be in it.

    Notes
    -----
    Mitsuba asks for the surface at a hit by a call that every shape in memory answers, whatever scene it belongs to:
    all of them are part of every kernel, and an instance brings all shapes once more. With a thousand instances a
    kernel that asks takes ten seconds to trace. Here what interpolation needs is looked up in arrays of all meshes,
    and kernels are the same for any number of shapes.
    """

    def __init__(self, mitsuba: mi.Scene) -> None:
        self.mitsuba = mitsuba
        shapes = mitsuba.shapes()
        counts = [shape.vertex_count() for shape in shapes]
        starts = np.cumsum([0, *counts[:-1]])
        triangles = [shape.face_count() for shape in shapes]
        self._first_triangle = ShapeTable([mitsuba], np.cumsum([0, *triangles[:-1]]))
        self._faces = mi.UInt32(
            np.concatenate(
                [shape.faces_buffer().numpy() + start for shape, start in zip(shapes, starts, strict=True)]
            ).astype(np.uint32)
        )
        self._positions = _joined([shape.vertex_positions_buffer() for shape in shapes])
        self._normals = _joined([shape.vertex_normals_buffer() for shape in shapes])
        textured = np.array([shape.has_vertex_texcoords() for shape in shapes])
        self._textured = ShapeTable([mitsuba], textured) if textured.any() else None
        self._texcoords = _joined(
            [
                shape.vertex_texcoords_buffer() if has else dr.zeros(mi.Float, 2 * count)
                for shape, has, count in zip(shapes, textured, counts, strict=True)
                if textured.any()
            ]
        )

    def shapes(self) -> list[mi.Mesh]:
        """Its meshes."""
        found: list[mi.Mesh] = self.mitsuba.shapes()
        return found

    def ray_test(self, ray: mi.Ray3f, active: mi.Mask | bool = True) -> mi.Mask:
        """Whether rays meet a surface."""
        return self.mitsuba.ray_test(ray, active)

    def ray_intersect_preliminary(
        self, ray: mi.Ray3f, active: mi.Mask | bool = True
    ) -> mi.PreliminaryIntersection3f:
        """The triangles that rays meet first."""
        return self.mitsuba.ray_intersect_preliminary(ray, active=active)

    def ray_intersect(self, ray: mi.Ray3f, active: mi.Mask | bool = True) -> mi.SurfaceInteraction3f:
        """The surfaces that rays meet first."""
        return self.interaction(self.ray_intersect_preliminary(ray, active), ray, active)

    def triangle(self, hit: mi.PreliminaryIntersection3f, active: mi.Mask) -> mi.UInt32:
        """The numbers of triangles that rays hit, among those of all shapes, shape after shape."""
        return self._first_triangle.gather(hit.shape, active) + hit.prim_index

    def interaction(
        self, hit: mi.PreliminaryIntersection3f, ray: mi.Ray3f, active: mi.Mask | bool = True
    ) -> mi.SurfaceInteraction3f:
        """The surfaces where rays hit triangles: what ``hit.compute_surface_interaction(ray)`` tells of them."""
        active = mi.Mask(active) & hit.is_valid()
        triangle = self.triangle(hit, active)
        corners = [dr.gather(mi.UInt32, self._faces, 3 * triangle + k, active) for k in range(3)]
        b = 1 - hit.prim_uv.x - hit.prim_uv.y, hit.prim_uv.x, hit.prim_uv.y
        p, n = (
            [dr.gather(mi.Vector3f, values, corner, active) for corner in corners]
            for values in (self._positions, self._normals)
        )
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.p = dr.fma(p[0], b[0], dr.fma(p[1], b[1], p[2] * b[2]))
        si.n = dr.normalize(dr.cross(p[1] - p[0], p[2] - p[0]))
        si.sh_frame.n = dr.normalize(dr.fma(n[2], b[2], dr.fma(n[1], b[1], n[0] * b[0])))
        si.uv, si.dp_du, si.dp_dv = mi.Point2f(b[1], b[2]), p[1] - p[0], p[2] - p[0]
        if self._textured is not None:
            textured = self._textured.gather(hit.shape, active) != 0
            self._add_texture_coordinates(si, corners, p, b, active & textured)
        si.shape, si.prim_index = hit.shape, hit.prim_index
        si.initialize_sh_frame()
        si.wi = si.to_local(-ray.d)
        si = dr.select(active, si, dr.zeros(mi.SurfaceInteraction3f))
        si.t, si.time, si.wavelengths = dr.select(active, hit.t, dr.inf), ray.time, ray.wavelengths
        si.wi = dr.select(active, si.wi, -ray.d)
        return si

    def _add_texture_coordinates(
        self,
        si: mi.SurfaceInteraction3f,
        corners: list[mi.UInt32],
        p: list[mi.Vector3f],
        b: tuple[mi.Float, mi.Float, mi.Float],
        active: mi.Mask,
    ) -> None:
        """Texture coordinates, and tangents along them, or any where they are degenerate."""
        uv = [dr.gather(mi.Point2f, self._texcoords, corner, active) for corner in corners]
        si.uv = dr.select(active, dr.fma(uv[2], b[2], dr.fma(uv[1], b[1], uv[0] * b[0])), si.uv)
        (du, dv), (eu, ev) = uv[1] - uv[0], uv[2] - uv[0]
        d, e = p[1] - p[0], p[2] - p[0]
        area = dr.fma(du, ev, -dv * eu)
        some = mi.coordinate_system(si.n)
        si.dp_du = dr.select(active, dr.select(area != 0, dr.fma(d, ev, -dv * e) / area, some[0]), d)
        si.dp_dv = dr.select(active, dr.select(area != 0, dr.fma(e, du, -eu * d) / area, some[1]), e)


def _joined(buffers: Sequence[mi.Float]) -> mi.Float:
    """One array of many; of one, itself."""
    if len(buffers) == 1:
        return mi.Float(buffers[0])
    return mi.Float(np.concatenate([buffer.numpy() for buffer in buffers])) if buffers else mi.Float()
