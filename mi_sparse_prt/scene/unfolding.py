"""Scenes of many instances as scenes of meshes."""

from __future__ import annotations

import mitsuba as mi

from mi_sparse_prt.scene.instances import PlacedShape, merge_groups, placed_shapes
from mi_sparse_prt.scene.materials import Material
from mi_sparse_prt.scene.mitsuba_meshes import build_mitsuba_mesh, scene_of
from mi_sparse_prt.scene.notes import Notes
from mi_sparse_prt.scene.surfaces import clean_mesh

FEW = 16  # instances: kernels have code of its own for each of them, and a thousand take a minute to compile
MOST = 5_000_000  # vertices of all copies


def unfold_instances(scene: mi.Scene) -> mi.Scene:
    """A scene whose instances are copies in a mesh for each BSDF, if there are more than a few, and of meshes alone.

    Other shapes, the emitters and the cameras are the same objects. Where copies would have more than `MOST` vertices,
    the scene is what it was.

    Parameters
    ----------
    scene : mi.Scene
        World units, as those of the result. As long as it lives, kernels have code for its instances.

    Raises
    ------
    PrtError
        A mesh whose buffers make no sense; an instance without size.
    """
    if sum(shape.class_name() == "Instance" for shape in scene.shapes()) <= FEW:
        return scene
    placed = placed_shapes(scene)
    own = [where.shape for where in placed if where.copies is None]
    grouped = [where for where in placed if where.copies is not None]
    if not all(map(_is_plain_mesh, grouped)) or sum(map(_vertices, grouped)) > MOST:
        return scene
    notes = Notes()  # of triangles without area, which reflect nothing
    surfaces = [
        (
            where.in_world(clean_mesh(where.shape, where.name, notes), 2 * MOST),
            Material(where.shape, where.name, notes),
        )
        for where in grouped
    ]
    meshes = {
        mesh.name: build_mitsuba_mesh(mesh, material.bsdf)
        for mesh, material in merge_groups(grouped, surfaces)
    }
    on_shapes = [*(shape.emitter() for shape in own), *(shape.sensor() for shape in own)]
    others = [*scene.emitters(), *scene.sensors()]
    free = [thing for thing in others if not any(thing is other for other in on_shapes)]
    return scene_of({f"_kept_{k:06d}": thing for k, thing in enumerate([*own, *free])}, meshes)


def _is_plain_mesh(where: PlacedShape) -> bool:
    return where.shape.is_mesh() and not where.shape.is_emitter()


def _vertices(where: PlacedShape) -> int:
    """Of all copies; facets have three for each triangle."""
    assert where.copies is not None
    faceted = where.shape.has_face_normals() or not where.shape.has_vertex_normals()
    return len(where.copies) * (3 * where.shape.face_count() if faceted else where.shape.vertex_count())
