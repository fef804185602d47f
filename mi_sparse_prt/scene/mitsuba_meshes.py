"""Triangle meshes out of Mitsuba and into it, and scenes made of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.scene.triangle_mesh import TriangleMesh

#: Parameters of meshes that are no attributes.
_GEOMETRY = ("vertex_positions", "vertex_normals", "vertex_texcoords")


def read_mesh(shape: mi.Mesh, name: str) -> TriangleMesh:
    """The buffers of a Mitsuba mesh as NumPy copies."""

    def rows(buffer: Any, width: int, dtype: type) -> NDArray:
        return np.array(buffer, dtype=dtype).reshape(-1, width).copy()

    n, t = shape.vertex_count(), shape.face_count()
    vertex_attributes: dict[str, NDArray[np.float32]] = {}
    face_attributes: dict[str, NDArray[np.float32]] = {}
    parameters = mi.traverse(shape)
    # an `ellipsoidsmesh` has values for each ellipsoid, all of as many vertices and triangles, instead of attributes
    ellipsoids = len(parameters["data"]) // 10 if shape.class_name() == "EllipsoidsMesh" else None
    for key in parameters.keys():
        if not key.startswith(("vertex_", "face_")) or key in _GEOMETRY:
            continue
        found, count = (vertex_attributes, n) if key.startswith("vertex_") else (face_attributes, t)
        if ellipsoids is None:
            found[key] = np.array(shape.attribute_buffer(key), np.float32).reshape(count, -1)
        else:
            values = np.array(parameters[key], np.float32).reshape(ellipsoids, -1)
            found[key] = np.repeat(values, count // ellipsoids, axis=0)
    return TriangleMesh(
        name,
        rows(shape.vertex_positions_buffer(), 3, np.float32),
        rows(shape.vertex_normals_buffer(), 3, np.float32)
        if shape.has_vertex_normals() and not shape.has_face_normals()
        else None,
        rows(shape.faces_buffer(), 3, np.uint32).astype(np.int32),
        rows(shape.vertex_texcoords_buffer(), 2, np.float32) if shape.has_vertex_texcoords() else None,
        vertex_attributes,
        face_attributes,
    )


def build_mitsuba_mesh(
    mesh: TriangleMesh,
    bsdf: mi.BSDF,
    emitter: mi.Emitter | None = None,
    positions: NDArray[np.float32] | None = None,
) -> mi.Mesh:
    """A Mitsuba mesh of these triangles; `positions` replaces the mesh's own."""
    properties = mi.Properties()
    properties["bsdf"] = bsdf
    if emitter is not None:
        properties["emitter"] = emitter
    assert mesh.normals is not None
    result = mi.Mesh(
        mesh.name,
        vertex_count=len(mesh.positions),
        face_count=len(mesh.triangles),
        props=properties,
        has_vertex_normals=True,
        has_vertex_texcoords=mesh.texcoords is not None,
    )
    parameters = mi.traverse(result)
    parameters["faces"] = mi.UInt32(mesh.triangles.astype(np.uint32).ravel())
    # Dr.Jit shares NumPy's memory: the mesh gets its own.
    parameters["vertex_positions"] = mi.Float(
        (mesh.positions if positions is None else positions).ravel().copy()
    )
    if mesh.texcoords is not None:
        parameters["vertex_texcoords"] = mi.Float(mesh.texcoords.ravel())
    parameters.update()
    # Mitsuba recomputes normals whenever positions change: set ours afterwards.
    parameters["vertex_normals"] = mi.Float(mesh.normals.ravel())
    parameters.update()
    for key, values in (*mesh.vertex_attributes.items(), *mesh.face_attributes.items()):
        result.add_attribute(key, values.shape[1], values.ravel())
    return result


def watertight_scene() -> dict[str, Any]:
    """The beginning of a scene's dict: rays do not slip between triangles.

    Embree's default mode misses hits on edges that triangles share, and light leaks into closed rooms. Its robust mode
    costs about a quarter more time per ray.
    """
    embree = {"embree_use_robust_intersections": True} if mi.variant().startswith("llvm") else {}
    return {"type": "scene", **embree}


def lit_scene(shapes: Sequence[mi.Shape], light: mi.Emitter | dict[str, Any], **others: Any) -> mi.Scene:
    """Shapes under one ``light``, which rays do not slip between, and other objects by name."""
    named = {f"shape_{k}": shape for k, shape in enumerate(shapes)}
    return mi.load_dict({**watertight_scene(), "light": light, **others, **named})


def objects_off_shapes(scene: mi.Scene) -> list[mi.Object]:
    """Its sensors, emitters and integrator that belong to no shape."""
    on_shapes = [s.emitter() for s in scene.shapes() if s.is_emitter()]
    on_shapes += [s.sensor() for s in scene.shapes() if s.is_sensor()]
    things = [*scene.sensors(), *scene.emitters(), scene.integrator()]
    return [thing for thing in things if thing is not None and not any(thing is s for s in on_shapes)]


def build_mitsuba_scene(
    shapes: list[mi.Mesh], names: list[str], others: Sequence[mi.Object] = ()
) -> mi.Scene:
    """A Mitsuba scene of these meshes, in order, and of other objects, which keep their ids where these are free."""
    content = dict(zip(names, shapes, strict=True))
    named: dict[str, mi.Object] = {}
    for k, thing in enumerate(others):
        key = thing.id()
        free = key and "." not in key and key not in ("type", *content, *named)
        named[key if free else f"_other_{k}"] = thing
    return scene_of(named, content)


def scene_of(kept: dict[str, mi.Object], others: dict[str, Any] | None = None) -> mi.Scene:
    """A scene of objects by name, which rays do not slip between.

    Mitsuba gives them these names as ids; those that are ``kept`` belong to a user's scene, and get theirs back.
    """
    ids = [thing.id() for thing in kept.values()]
    scene = mi.load_dict({**watertight_scene(), **(others or {}), **kept}, optimize=False)
    for thing, name in zip(kept.values(), ids, strict=True):
        thing.set_id(name)
    return scene
