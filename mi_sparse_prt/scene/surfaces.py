"""From Mitsuba shapes to clean triangles: the one place where a user's scene is read.

The rooms behind this one never look at Mitsuba shapes.
"""

from __future__ import annotations

from itertools import product

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.core.variant import check_variant
from mi_sparse_prt.scene.curves import curve_mesh
from mi_sparse_prt.scene.ellipsoids import ellipsoids_mesh
from mi_sparse_prt.scene.instances import PlacedShape, merge_groups, moved, placed_shapes
from mi_sparse_prt.scene.materials import Material
from mi_sparse_prt.scene.mesh_cleaning import (
    check_geometry,
    drop_degenerate,
    drop_unreferenced,
    face_inwards,
    flip_sides,
    make_unit_normals,
    split_by_face,
    stabilise_normals,
)
from mi_sparse_prt.scene.mitsuba_meshes import read_mesh
from mi_sparse_prt.scene.notes import Fact, Notes, about
from mi_sparse_prt.scene.parametric_shapes import FEWEST, parametric_mesh, projection
from mi_sparse_prt.scene.sdf_grids import sdf_mesh
from mi_sparse_prt.scene.sizing_field import Details, refine_near_details
from mi_sparse_prt.scene.subdivision import Project, as_it_is, subdivide
from mi_sparse_prt.scene.triangle_mesh import TriangleMesh

ALL_ROUND = 64  # spheres, disks and cylinders of as many segments as one has: 35,000 vertices
LEAST_AROUND = 12  # of many: seen from the side, they lack 3% of their radius

OFF = 0.01  # entries of a transform times its inverse: axes of three digits are less so
_BECOME_TRIANGLES = {"Sphere", "Disk", "Cylinder", "BSplineCurve", "LinearCurve", "Ellipsoids", "SDFGrid"}

_INSIDE = " {} inside {}: media are left out, light passes as through a vacuum (volpath renders them)"
_SENSOR, _EMITTER = (
    Fact(_INSIDE.format("is", "a medium"), _INSIDE.format("are", "media"), thing=thing)
    for thing in ("sensor", "emitter")
)
_INWARDS = (
    ": faces point inwards: from outside {} vertices will be black "
    "(set flip_normals, or use a twosided BSDF, if that is not meant)"
)
_FACES_INWARDS = Fact(_INWARDS.format("its"), _INWARDS.format("their"))
_NO_AREA = Fact(": {} triangles without area are left out")
_NO_TRIANGLE = Fact(": {} vertices that no triangle uses are left out")
_NO_COORDINATES = Fact(
    " has a texture and no texture coordinates: Mitsuba then takes those of each triangle, which are others where long "
    "edges are bisected (give it coordinates, or set edge_length to inf)",
    " have textures and no texture coordinates: Mitsuba then takes those of each triangle, which are others where long "
    "edges are bisected (give them coordinates, or set edge_length to inf)",
)
_NO_NORMAL = Fact(": {} vertices have a normal of length zero; it is computed from their faces")


def read_surfaces(
    scene: mi.Scene, edge_length: float | None
) -> tuple[list[tuple[TriangleMesh, Material]], Details | None, Notes]:
    """Clean triangle meshes of a Mitsuba scene, in world space, and what was handled on the user's behalf.

    Parameters
    ----------
    scene : mi.Scene
    edge_length : float, optional
        As for `Scene.from_mitsuba`.

    Returns
    -------
    surfaces : list of (TriangleMesh, Material)
        One for each shape, and for each BSDF of the groups that have instances; a mesh may have no triangles left.
    details : Details or None
        Where edges are shorter than they would be for all of the scene.
    notes : Notes

    Raises
    ------
    PrtError
        As for `Scene.from_mitsuba`.
    """
    check_variant()
    if edge_length is not None and not edge_length > 0:
        raise PrtError(f"edge_length must be positive (or inf), not {edge_length}")
    most_vertices = 5_000_000  # 6144 directions would need 4 GB of visibility bits alone
    placed = placed_shapes(scene)
    if not placed:
        raise PrtError("the scene has no mesh: add at least one shape")
    _refuse_others(placed)
    notes = Notes()
    _note_media(scene, notes)
    materials = [Material(where.shape, where.name, notes) for where in placed]
    clean, limit = [], most_vertices
    for where in placed:
        mesh = (
            where.in_world(clean_mesh(where.shape, where.name, notes), limit)
            if where.shape.is_mesh()
            else None
        )
        limit -= 0 if mesh is None else len(mesh.positions)
        clean.append(mesh)
    details, automatic = None, edge_length is None
    if edge_length is None:
        edge_length = _diagonal(placed, clean) / 64
    surfaces: list[tuple[TriangleMesh, Material]] = []
    whole, limit, fewest = [], most_vertices, _segments_around(placed)
    for where, mesh, material in zip(placed, clean, materials, strict=True):
        if mesh is None:
            mesh = where.in_world(_tessellate(where, material, edge_length, limit, fewest), limit)
        whole.append(mesh)
        if where.shape.is_mesh():
            mesh = subdivide(mesh, edge_length, limit)
            finer = len(mesh.positions) > len(whole[-1].positions)
            if finer and material.textured and mesh.texcoords is None:
                notes.add(where.name, _NO_COORDINATES)
        limit -= len(mesh.positions)
        surfaces.append((mesh, material))
    _note_inwards(whole, materials, notes)
    if automatic:
        meshes = [mesh for mesh, _ in surfaces]
        meshes, details = refine_near_details(
            meshes, [_projection(where) for where in placed], edge_length, most_vertices
        )
        surfaces = list(zip(meshes, materials, strict=True))
    return merge_groups(placed, surfaces), details, notes


def _refuse_others(placed: list[PlacedShape]) -> None:
    """Refuse shapes that do not become triangles, before any work is done."""
    others: dict[str, list[str]] = {}
    for where in placed:
        if not where.shape.is_mesh() and where.shape.class_name() not in _BECOME_TRIANGLES:
            others.setdefault(where.shape.class_name(), []).append(where.name)
    for kind, names in others.items():
        are, it = ("are", "them") if len(names) > 1 else ("is", "it")
        raise PrtError(
            f"{about('shape', names)} {are} of type {kind}, which is not made of triangles: "
            f"replace {it} by a mesh (ply, obj)"
        )


def _note_media(scene: mi.Scene, notes: Notes) -> None:
    """Note cameras and lamps in media; shapes that bound media are noted with their materials."""
    for thing, fact in (
        *((sensor, _SENSOR) for sensor in scene.sensors()),
        *((emitter, _EMITTER) for emitter in scene.emitters()),
    ):
        if thing.get_medium() is not None and thing.get_shape() is None:
            notes.add(thing.id(), fact)


def _note_inwards(meshes: list[TriangleMesh], materials: list[Material], notes: Notes) -> None:
    """Note closed shapes that are black from outside."""
    seen = [
        mesh
        for mesh, material in zip(meshes, materials, strict=True)
        if len(mesh.triangles) and not material.two_sided and not material.passes_light
    ]
    for k in np.flatnonzero(face_inwards(seen)):
        notes.add(seen[k].name, _FACES_INWARDS)


def _diagonal(placed: list[PlacedShape], clean: list[TriangleMesh | None]) -> float:
    """The diagonal of the box around all shapes, in which unused vertices do not count."""
    points: list[NDArray] = []
    for where, mesh in zip(placed, clean, strict=True):
        if mesh is not None:
            points.append(mesh.positions)
            continue
        box = where.shape.bbox()
        corners = np.array(list(product(*zip(np.array(box.min), np.array(box.max), strict=True))))
        points += [corners] if where.copies is None else list(moved(corners, where.copies))
    return float(np.linalg.norm(np.ptp(np.concatenate(points).astype(np.float64), axis=0)))


def _segments_around(placed: list[PlacedShape]) -> int:
    """Segments around round shapes, at least: fewer of each where there are many, which are small then."""
    count = sum(
        1 if where.copies is None else len(where.copies) for where in placed if not where.shape.is_mesh()
    )
    return max(LEAST_AROUND, 4 * int(FEWEST * min(1.0, np.sqrt(ALL_ROUND / max(count, 1))) // 4))


def _tessellate(
    where: PlacedShape, material: Material, edge_length: float, limit: int, fewest: int
) -> TriangleMesh:
    """Triangles of a shape that has none, in world space or that of its group."""
    shape, edge_length = where.shape, edge_length / where.largest_scale
    if shape.class_name() in ("BSplineCurve", "LinearCurve"):
        return curve_mesh(shape, edge_length, where.name, limit)
    if shape.class_name() == "Ellipsoids":
        return ellipsoids_mesh(shape, edge_length, where.name, limit)
    kind, to_world = shape.class_name().lower(), _to_world(shape)
    if kind == "sdfgrid":
        return sdf_mesh(shape, to_world, edge_length, where.name, limit=limit, fewest=fewest)
    # A mirrored cylinder turns its own flag, and the cross product behind its normals turns it back.
    mirrored = kind == "cylinder" and np.linalg.det(to_world[:3, :3]) < 0
    mesh = parametric_mesh(
        kind, to_world, edge_length, material.name, limit=limit, fewest=fewest, weld=material.constant
    )
    return flip_sides(mesh) if shape.has_flipped_normals() != mirrored else mesh


def _to_world(shape: mi.Shape) -> NDArray[np.float64]:
    """Local to world (4, 4). A sphere is one to Mitsuba however it is scaled: its x axis has the radius.

    Raises
    ------
    PrtError
        If Mitsuba's own inverse is that of another transform: its rays would meet what is not where the shape is.
    """
    given = mi.traverse(shape)["to_world"]
    to_world = np.array(given.matrix, dtype=np.float64).reshape(4, 4)
    back = to_world @ np.array(given.inverse().matrix, dtype=np.float64).reshape(4, 4)
    if np.abs(back[:3, :3] - np.eye(3)).max() > OFF:
        raise PrtError(
            f"shape '{shape.id()}': its to_world rotates about an axis whose length is not 1, of which Mitsuba makes a "
            "shape that rays do not meet where it lies: give the axis a length of 1"
        )
    if shape.class_name() == "Sphere" and (radius := np.linalg.norm(to_world[:3, 0])) > 0:
        left, _, right = np.linalg.svd(to_world[:3, :3])
        to_world[:3, :3] = radius * left @ right
    return to_world


def _projection(where: PlacedShape) -> Project | None:
    """How new vertices come to lie on a shape; None where that is not known."""
    kind = where.shape.class_name().lower()
    if where.shape.is_mesh() or kind == "disk":
        return as_it_is
    return (
        projection(kind, _to_world(where.shape))
        if kind in ("sphere", "cylinder") and where.copies is None
        else None
    )


def clean_mesh(shape: mi.Mesh, name: str, notes: Notes) -> TriangleMesh:
    """A Mitsuba mesh as clean triangles in world space, with the normals that Mitsuba shades with."""
    mesh = read_mesh(shape, name)
    check_geometry(mesh)
    if mesh.normals is not None:
        mesh = stabilise_normals(mesh, _recomputed_normals(mesh))
    mesh, dropped = drop_degenerate(mesh)
    if dropped:
        notes.add(name, _NO_AREA, dropped)
    mesh, dropped = drop_unreferenced(mesh)
    if dropped:
        notes.add(name, _NO_TRIANGLE, dropped)
    if mesh.normals is None:  # Mitsuba shades such meshes flat
        mesh = split_by_face(mesh)
    mesh, zero = make_unit_normals(mesh)
    if zero:
        notes.add(name, _NO_NORMAL, zero)
    return flip_sides(mesh) if shape.has_flipped_normals() else mesh


def _recomputed_normals(mesh: TriangleMesh) -> NDArray[np.float32]:
    """(n, 3) normals as Mitsuba computes them for files that have none."""
    scratch = mi.Mesh(mesh.name, len(mesh.positions), len(mesh.triangles), has_vertex_normals=True)
    parameters = mi.traverse(scratch)
    parameters["faces"] = mi.UInt32(mesh.triangles.astype(np.uint32).ravel())
    parameters["vertex_positions"] = mi.Float(mesh.positions.ravel())
    parameters.update()
    return np.array(scratch.vertex_normals_buffer(), np.float32).reshape(-1, 3)
