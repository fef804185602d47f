"""Instances of shape groups as plain triangles: rays through instances take many times as long."""

from __future__ import annotations

import re
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.scene.materials import Material
from mi_sparse_prt.scene.mesh_cleaning import flip_sides
from mi_sparse_prt.scene.traversal import children
from mi_sparse_prt.scene.triangle_mesh import TriangleMesh, concatenated, normalise_rows

MERGED = " + "  # between the names of meshes that Mitsuba has merged into one


@dataclass(frozen=True)
class PlacedShape:
    """A shape of a scene, and where it stands.

    Attributes
    ----------
    shape : mi.Shape
        No instance: a shape of its own, or one of a group.
    name : str
        Unique in the scene; of a shape of a group, it begins with the group's.
    copies : (k, 4, 4) float64 or None
        Where the instances of its group stand, world from group; None for a shape of no group.
    """

    shape: mi.Shape
    name: str
    copies: NDArray[np.float64] | None

    @property
    def largest_scale(self) -> float:
        """How much the largest of its copies is stretched."""
        return 1.0 if self.copies is None else float(np.linalg.norm(self.copies[:, :3, :3], 2, (1, 2)).max())

    def in_world(self, mesh: TriangleMesh, limit: int) -> TriangleMesh:
        """The shape's triangles, or all copies of them, in world space.

        Raises
        ------
        PrtError
            More than `limit` vertices; a copy without size.
        """
        return mesh if self.copies is None else copied(mesh, self.copies, limit)


def placed_shapes(scene: mi.Scene) -> list[PlacedShape]:
    """The shapes of a scene: first those of no group, then those of each group that has instances."""
    own = [shape for shape in scene.shapes() if shape.class_name() != "Instance"]
    found: list[tuple[mi.Shape, str, NDArray[np.float64] | None]]
    found = [(shape, _name(shape, k), None) for k, shape in enumerate(own)]
    for group, copies in _instances(scene):
        members = [member for _, member in children(group) if isinstance(member, mi.Shape)]
        found += [(member, f"{group.id()}_{_name(member, k)}", copies) for k, member in enumerate(members)]
    taken = {"type"}  # a reserved word in Mitsuba's dictionaries
    result = []
    for shape, name, where in found:
        name = re.sub(r"[.\s/]", "_", name)
        unique, suffix = name, 2
        while unique in taken:
            unique, suffix = f"{name}_{suffix}", suffix + 1
        taken.add(unique)
        result.append(PlacedShape(shape, unique, where))
    return result


def moved(points: NDArray[np.floating], to_world: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points (n, 3) under transforms (k, 4, 4): (k, n, 3)."""
    return np.einsum("kij,nj->kni", to_world[:, :3, :3], points, dtype=np.float64) + to_world[:, None, :3, 3]


def copied(mesh: TriangleMesh, to_world: NDArray[np.float64], limit: int) -> TriangleMesh:
    """Copies of a mesh as one mesh.

    Parameters
    ----------
    to_world : (k, 4, 4) float64
        Affine transforms, also uneven, sheared and mirrored ones: normals stay on their side of the surface, and
        triangles go around them as before.
    limit : int
        The largest number of vertices allowed.

    Raises
    ------
    PrtError
        More than `limit` vertices; a transform that leaves no volume.
    """
    k, n = len(to_world), len(mesh.positions)
    if k * n > limit:
        raise PrtError(
            f"shape '{mesh.name}': its {k} instances have {k * n} vertices, more than {limit} are left for them: "
            "use fewer instances, or simpler meshes"
        )
    linear = to_world[:, :3, :3]
    volume = np.linalg.det(linear)
    if not np.all(volume):
        raise PrtError(
            f"shape '{mesh.name}': the to_world of an instance leaves no size: scale by more than 0"
        )
    assert mesh.normals is not None
    normals = np.einsum("kji,nj->kni", np.linalg.inv(linear), mesh.normals, dtype=np.float64)
    turned = np.where(
        (volume < 0)[:, None, None], flip_sides(mesh).triangles, mesh.triangles
    )  # [k, t, corner]
    return replace(
        mesh,
        positions=moved(mesh.positions, to_world).reshape(-1, 3).astype(np.float32),
        normals=normalise_rows(normals.reshape(-1, 3)).astype(np.float32),
        triangles=(turned + n * np.arange(k)[:, None, None]).reshape(-1, 3).astype(np.int32),
        texcoords=None if mesh.texcoords is None else np.tile(mesh.texcoords, (k, 1)),
        vertex_attributes={name: np.tile(v, (k, 1)) for name, v in mesh.vertex_attributes.items()},
        face_attributes={name: np.tile(v, (k, 1)) for name, v in mesh.face_attributes.items()},
    )


def merge_groups(
    placed: Sequence[PlacedShape], surfaces: Sequence[tuple[TriangleMesh, Material]]
) -> list[tuple[TriangleMesh, Material]]:
    """One mesh for all shapes of groups that share a BSDF, in the place and with the name of the first of them.

    Shapes that differ in what a BSDF may look up (texture coordinates, attributes) stay apart if theirs does.
    """
    merged: dict[Hashable, tuple[list[TriangleMesh], Material]] = {}
    for k, (where, (mesh, material)) in enumerate(zip(placed, surfaces, strict=True)):
        key: Hashable = k
        if where.copies is not None:
            key = (id(material.bsdf), () if material.constant else _channels(mesh))
        merged.setdefault(key, ([], material))[0].append(mesh)
    return [(concatenated(meshes), material) for meshes, material in merged.values()]


def _channels(mesh: TriangleMesh) -> tuple[Hashable, ...]:
    """What a mesh has beside positions and normals."""
    attributes = {**mesh.vertex_attributes, **mesh.face_attributes}
    return (mesh.texcoords is None, *sorted((name, v.shape[1]) for name, v in attributes.items()))


def _instances(scene: mi.Scene) -> list[tuple[mi.Shape, NDArray[np.float64]]]:
    """The groups of a scene that have instances, and where these stand: (k, 4, 4), world from group."""
    instances = [shape for shape in scene.shapes() if shape.class_name() == "Instance"]
    groups = [thing for _, thing in children(scene) if isinstance(thing, mi.Shape)] if instances else []
    ids = [group.id() for group in groups]
    to_world: dict[int, list[NDArray[np.float64]]] = {}
    try:
        # Mitsuba shows an instance's transform as a parameter, and of its group nothing but the id, where it prints it:
        # several may have the same
        for k, group in enumerate(groups):
            group.set_id(str(k))
        for shape in instances:
            found = re.search(r'name = "(\d+)"', str(shape))
            assert found is not None
            matrix = np.array(mi.traverse(shape)["to_world"].matrix, np.float64).reshape(4, 4)
            to_world.setdefault(int(found[1]), []).append(matrix)
    finally:
        for group, name in zip(groups, ids, strict=True):
            group.set_id(name)
    return [(groups[k], np.stack(matrices)) for k, matrices in to_world.items()]


def _name(shape: mi.Shape, k: int) -> str:
    """Its id, else the name of its file, else its type and number; the first of several that Mitsuba has merged."""
    name, *others = shape.id().split(MERGED)
    if not name or name.startswith("_"):
        file = re.search(r'name = "([^"]+)"', str(shape)) if shape.is_mesh() else None
        first, *others = (file.group(1) if file else "").split(MERGED)
        name = Path(first.strip()).stem or f"{shape.class_name().lower()}_{k}"
    return f"{name} and {len(others)} more" if others else name
