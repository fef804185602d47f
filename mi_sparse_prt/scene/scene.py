"""From a Mitsuba scene to vertices: positions, normals, albedo, triangles, and a copy in the unit box.

The rooms behind this one never look at Mitsuba shapes. What they get is a `Scene`: clean triangle meshes
whose vertices are the rows of the light transport matrix, and two Mitsuba scenes with exactly these meshes: one
where the user put them, one scaled to the unit box, where Mitsuba's absolute ray offsets mean the same for
every scene.
"""

from __future__ import annotations

import hashlib
import re
import warnings
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.errors import PrtError, PrtWarning
from mi_sparse_prt.core.random_keys import hash_rows, mix
from mi_sparse_prt.scene import tessellation
from mi_sparse_prt.scene.materials import Material
from mi_sparse_prt.scene.tessellation import TriangleMesh
from mi_sparse_prt.scene.triangle_keys import triangle_keys

#: More vertices than this are refused: 6144 directions would need 4 GB of visibility bits alone.
MAX_VERTICES = 5_000_000

#: The default edge length is the diagonal of the scene's box divided by this.
EDGES_PER_DIAGONAL = 64

PARAMETRIC = {"Sphere": "sphere", "Disk": "disk", "Cylinder": "cylinder"}


@dataclass(frozen=True)
class Mesh:
    """One mesh of a `Scene`.

    Attributes
    ----------
    name : str
        The shape's id, unique in the scene.
    vertices : slice
        Its vertices among the scene's.
    triangles : (n_t, 3) int32
        Indices local to the slice: the scene's vertex is ``vertices.start + index``.
    """

    name: str
    vertices: slice
    triangles: NDArray[np.int32]


class Scene:
    """Vertices to compute transport for, and the Mitsuba scenes to compute it in.

    Made by `load_scene` or `Scene.from_mitsuba`. All arrays are C-contiguous float32.

    Attributes
    ----------
    positions, normals : (n_v, 3) float32
        World space; normals are unit shading normals, one per vertex, as Mitsuba shades with.
    albedo : (n_v, 3) float32
        Diffuse reflectance (rgb, 0..1). For a BSDF that is not diffuse, its directional albedo at normal
        incidence.
    meshes : tuple of Mesh
    mitsuba : mi.Scene
        World space: the meshes of `meshes`, in that order and with these vertices, plus the sensors, emitters
        and integrator of the original scene (the same objects; area emitters of one colour are copied, textured
        ones left out).
    normalised : mi.Scene
        The same meshes and BSDF objects in the unit box: centred on the origin, longest side 1; no emitters,
        no sensors.
    centre : (3,) float64
    scale : float
        normalised = (world - centre) * scale, computed in float64. A scene that was scaled gives the same
        normalised positions within 1e-6; one moved by k times its size within k * 1e-7, which is what its
        float32 world positions still know.
    normalised_positions : (n_v, 3) float32
    warnings : list of str
        What was handled on the user's behalf; each was also issued as a `PrtWarning`.
    materials : list of Material
        One for each mesh.
    path : str or None
        The XML file.
    """

    def __init__(self, mitsuba: mi.Scene, meshes: list[TriangleMesh], materials: list[Material]) -> None:
        """Use `Scene.from_mitsuba`; `meshes` are clean and in world space, `materials` one for each."""
        self.path: str | None = None
        self.warnings: list[str] = []
        self.meshes = tuple(
            Mesh(mesh.name, slice(end - len(mesh.positions), end), mesh.triangles)
            for mesh, end in zip(meshes, np.cumsum([len(m.positions) for m in meshes]).tolist(), strict=True)
        )
        self.positions = np.concatenate([m.positions for m in meshes])
        self.normals = np.concatenate([m.normals for m in meshes])

        low, high = (
            self.positions.min(axis=0).astype(np.float64),
            self.positions.max(axis=0).astype(np.float64),
        )
        self.centre: NDArray[np.float64] = (low + high) / 2
        self.scale = float(1 / np.max(high - low))
        self.normalised_positions = ((self.positions.astype(np.float64) - self.centre) * self.scale).astype(
            np.float32
        )
        world = [_mitsuba_mesh(m, k.bsdf, k.emission()) for m, k in zip(meshes, materials, strict=True)]
        unit = [
            _mitsuba_mesh(m, k.bsdf, positions=self.normalised_positions[view.vertices])
            for m, k, view in zip(meshes, materials, self.meshes, strict=True)
        ]
        # An area emitter may outlive its shape, and Mitsuba then reads freed memory: the original is kept
        self._original = mitsuba
        self.mitsuba: mi.Scene = _mitsuba_scene(world, self.meshes, mitsuba)
        self.normalised: mi.Scene = _mitsuba_scene(unit, self.meshes)
        self.albedo = np.concatenate(
            [k.albedo(shape, m) for shape, m, k in zip(world, meshes, materials, strict=True)]
        )
        self._surfaces = meshes
        self.materials = materials

    @classmethod
    def from_mitsuba(cls, scene: mi.Scene, edge_length: float | None = None) -> Scene:
        """The `Scene` of a loaded Mitsuba scene, merged by Mitsuba or not.

        Parameters
        ----------
        scene : mi.Scene
            Meshes, spheres, disks and cylinders; its sensors, emitters and integrator are reused, not copied.
        edge_length : float, optional
            World units. Longer edges are bisected and curved shapes tessellated to it. Default: the diagonal of
            the scene's box / 64. `float("inf")` leaves meshes as they are.

        Raises
        ------
        PrtError
            No mesh; a shape that is no surface of triangles (instances, curves, grids); positions or normals
            that are not finite; an albedo outside [0, 1]; more than 5 million vertices.
        """
        result = cls._build(scene, edge_length)
        result._warn()
        return result

    @classmethod
    def _build(cls, scene: mi.Scene, edge_length: float | None) -> Scene:
        if not mi.is_rgb or not dr.is_jit_v(mi.Float):
            raise PrtError(f"variant {mi.variant()} is not supported: use llvm_ad_rgb or cuda_ad_rgb")
        if edge_length is not None and not edge_length > 0:
            raise PrtError(f"edge_length must be positive (or inf), not {edge_length}")
        shapes = scene.shapes()
        if not shapes:
            raise PrtError("the scene has no mesh: add at least one shape")
        notes: list[str] = []
        materials = [Material(shape, name, notes) for shape, name in zip(shapes, _names(shapes), strict=True)]
        clean = [
            _clean_mesh(s, m.name, notes) if s.is_mesh() else None
            for s, m in zip(shapes, materials, strict=True)
        ]
        if edge_length is None:
            edge_length = _diagonal(shapes, clean) / EDGES_PER_DIAGONAL

        meshes: list[TriangleMesh] = []
        for shape, mesh, material in zip(shapes, clean, materials, strict=True):
            limit = MAX_VERTICES - sum(len(m.positions) for m in meshes)
            mesh = _parametric(shape, material, edge_length, limit) if mesh is None else mesh
            if material.one_sided and len(mesh.triangles) and tessellation.faces_inwards(mesh):
                notes.append(
                    f"shape '{mesh.name}': faces point inwards: from outside its vertices will be black "
                    "(set flip_normals, or use a twosided BSDF, if that is not meant)"
                )
            if shape.is_mesh():
                mesh = tessellation.subdivide(mesh, edge_length, limit)
            meshes.append(mesh)
        used = [k for k, mesh in enumerate(meshes) if len(mesh.triangles)]
        if not used:
            raise PrtError("the scene has no triangle with an area: nothing to compute transport for")
        result = cls(scene, [meshes[k] for k in used], [materials[k] for k in used])
        result.warnings = notes
        return result

    def _warn(self) -> None:
        for sentence in self.warnings:
            warnings.warn(sentence, PrtWarning, stacklevel=3)

    def unlit_shapes(self) -> list[mi.Mesh]:
        """The world-space meshes without their area emitters, for scenes with other light."""
        return [
            _mitsuba_mesh(mesh, material.bsdf) if shape.is_emitter() else shape
            for shape, mesh, material in zip(
                self.mitsuba.shapes(), self._surfaces, self.materials, strict=True
            )
        ]

    @property
    def n_vertices(self) -> int:
        """The number of vertices, which is the number of rows of the matrix."""
        return len(self.positions)

    @cached_property
    def vertex_areas(self) -> NDArray[np.float32]:
        """(n_v,) area of the surface around each vertex: a third of its triangles', world units."""
        areas = np.zeros(self.n_vertices)
        for mesh in self.meshes:
            triangles = mesh.triangles + mesh.vertices.start
            a, b, c = (self.positions[triangles[:, k]].astype(np.float64) for k in range(3))
            thirds = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 6
            np.add.at(areas, triangles, thirds[:, None])
        return areas.astype(np.float32)

    @property
    def diffuse(self) -> bool:
        """Whether all BSDFs reflect purely diffusely."""
        return all(material.diffuse for material in self.materials)

    @cached_property
    def grey(self) -> bool:
        """Whether all surfaces provably reflect the three channels alike (within 1e-6)."""
        even = np.max(np.ptp(self.albedo, axis=1)) <= 1e-6
        return bool(even) and all(
            k.grey(mesh) for k, mesh in zip(self.materials, self._surfaces, strict=True)
        )

    @cached_property
    def vertex_keys(self) -> NDArray[np.uint64]:
        """(n_v,) hash of each vertex's position, normal and albedo bits, whatever its mesh and number."""
        return hash_rows(np.concatenate([self.positions, self.normals, self.albedo], axis=1))

    @cached_property
    def hash(self) -> str:
        """SHA-256 (hex) of geometry and materials, whatever the order of shapes, vertices and triangles.

        Merging meshes of one material does not change it; moving a vertex, or changing an albedo, a texture or
        any parameter that a BSDF shows, does.
        """
        total = np.zeros(2, np.uint64)
        digests = set()
        for view, mesh, material in zip(self.meshes, self._surfaces, self.materials, strict=True):
            digest = material.digest()
            digests.add(digest)
            seed = np.frombuffer(digest[:8], np.uint64)[0]
            keys = triangle_keys(mesh, self.vertex_keys[view.vertices], seed)
            with np.errstate(over="ignore"):
                total[0] += np.sum(mix(keys), dtype=np.uint64)
                total[1] += np.sum(mix(keys ^ np.uint64(0x5851F42D4C957F2D)), dtype=np.uint64)
        count = sum(len(mesh.triangles) for mesh in self.meshes)
        parts = [total.tobytes(), str(count).encode(), *sorted(digests)]
        return hashlib.sha256(b"|".join(parts)).hexdigest()

    @property
    def summary(self) -> dict[str, Any]:
        """What reports say of it; JSON as it is."""
        return {
            "path": self.path,
            "hash": self.hash,
            "vertices": self.n_vertices,
            "warnings": self.warnings,
        }

    def __repr__(self) -> str:
        names = ", ".join(f"{m.name} {m.vertices.stop - m.vertices.start}" for m in self.meshes)
        return f"Scene({self.n_vertices} vertices: {names})"


def load_scene(path: str | Path, edge_length: float | None = None, **parameters: Any) -> Scene:
    """Load a Mitsuba XML scene.

    Parameters
    ----------
    path : str or Path
        The XML file; file names inside are relative to it.
    edge_length : float, optional
        World units; see `Scene.from_mitsuba`.
    **parameters
        Values for the XML's ``<default name=...>`` entries, as Mitsuba's ``-D`` gives them.

    Raises
    ------
    PrtError
        Missing file, XML or plugin error, and everything that `Scene.from_mitsuba` refuses.
    """
    path = Path(path)
    if not path.is_file():
        raise PrtError(f"scene file {path} does not exist: check the path")
    try:
        loaded = mi.load_file(str(path), optimize=False, **{k: str(v) for k, v in parameters.items()})
    except Exception as error:  # Mitsuba raises RuntimeError, ValueError and others, over many lines
        reason = _one_line(error).replace(f"{path} ", "")
        raise PrtError(f"scene file {path} cannot be loaded: {reason}") from error
    if not isinstance(loaded, mi.Scene):
        raise PrtError(f"scene file {path} holds a {type(loaded).__name__}: its root element must be <scene>")
    try:
        scene = Scene._build(loaded, edge_length)
    except PrtError as error:
        raise PrtError(f"scene file {path}: {error}") from error
    scene.path = str(path)
    scene._warn()
    return scene


def _one_line(error: Exception, limit: int = 400) -> str:
    """A Mitsuba error without its line breaks, colours and places in Mitsuba's own source."""
    text = re.sub(r"\x1b\[[0-9;]*m|\[\w+\.(cpp|h):\d+\] ", "", str(error))
    text = " ".join(text.split())
    return text if len(text) <= limit else text[: limit - 3] + "..."


def _names(shapes: list[mi.Shape]) -> list[str]:
    """A unique name for each shape: its id, else the name of its file, else its type and number."""
    names: list[str] = ["type"]  # a reserved word in Mitsuba's dictionaries
    for k, shape in enumerate(shapes):
        name = shape.id()
        if not name or name.startswith("_"):
            file = re.search(r'name = "([^"]+)"', str(shape)) if shape.is_mesh() else None
            name = Path(file.group(1)).stem if file else f"{shape.class_name().lower()}_{k}"
        name = re.sub(r"[.\s/]", "_", name)
        unique, suffix = name, 2
        while unique in names:
            unique, suffix = f"{name}_{suffix}", suffix + 1
        names.append(unique)
    return names[1:]


def _diagonal(shapes: list[mi.Shape], clean: list[TriangleMesh | None]) -> float:
    """The diagonal of the box around all shapes, in which unused vertices do not count."""
    points: list[NDArray] = []
    for shape, mesh in zip(shapes, clean, strict=True):
        if mesh is None:
            box = shape.bbox()
            points += [np.array(box.min).reshape(1, 3), np.array(box.max).reshape(1, 3)]
        else:
            points.append(mesh.positions)
    return float(np.linalg.norm(np.ptp(np.concatenate(points).astype(np.float64), axis=0)))


def _parametric(shape: mi.Shape, material: Material, edge_length: float, limit: int) -> TriangleMesh:
    """The grid of a sphere, disk or cylinder, in world space; every other shape is refused."""
    kind = PARAMETRIC.get(shape.class_name())
    if kind is None:
        raise PrtError(
            f"shape '{material.name}' is of type {shape.class_name()}, which is not made of triangles: "
            "replace it by a mesh (ply, obj), an instance by a copy of its shapes"
        )
    to_world = np.array(mi.traverse(shape)["to_world"].matrix, dtype=np.float64).reshape(4, 4)
    # A mirrored cylinder turns its own flag, and the cross product behind its normals turns it back.
    mirrored = kind == "cylinder" and np.linalg.det(to_world[:3, :3]) < 0
    return tessellation.parametric_mesh(
        kind,
        to_world,
        edge_length,
        material.name,
        limit=limit,
        flip=shape.has_flipped_normals() != mirrored,
        weld=material.constant,
    )


def _clean_mesh(shape: mi.Mesh, name: str, notes: list[str]) -> TriangleMesh:
    """A Mitsuba mesh as clean triangles in world space, with the normals that Mitsuba shades with."""
    mesh = _read(shape, name)
    tessellation.check_geometry(mesh)
    if mesh.normals is not None:
        mesh = tessellation.stabilise_normals(mesh, _recomputed_normals(mesh))
    mesh, dropped = tessellation.drop_degenerate(mesh)
    if dropped:
        notes.append(f"shape '{name}': {dropped} triangles without area are left out")
    mesh, dropped = tessellation.drop_unreferenced(mesh)
    if dropped:
        notes.append(f"shape '{name}': {dropped} vertices that no triangle uses are left out")
    if mesh.normals is None:  # Mitsuba shades such meshes flat
        mesh = tessellation.split_by_face(mesh)
    mesh, zero = tessellation.make_unit_normals(mesh)
    if zero:
        notes.append(
            f"shape '{name}': {zero} vertices have a normal of length zero; it is computed from their faces"
        )
    return tessellation.flip_sides(mesh) if shape.has_flipped_normals() else mesh


def _recomputed_normals(mesh: TriangleMesh) -> NDArray[np.float32]:
    """(n, 3) normals as Mitsuba computes them for files that have none."""
    scratch = mi.Mesh(mesh.name, len(mesh.positions), len(mesh.triangles), has_vertex_normals=True)
    parameters = mi.traverse(scratch)
    parameters["faces"] = mi.UInt32(mesh.triangles.astype(np.uint32).ravel())
    parameters["vertex_positions"] = mi.Float(mesh.positions.ravel())
    parameters.update()
    return np.array(scratch.vertex_normals_buffer(), np.float32).reshape(-1, 3)


def _read(shape: mi.Mesh, name: str) -> TriangleMesh:
    """The buffers of a Mitsuba mesh as NumPy copies."""

    def rows(buffer: Any, width: int, dtype: type) -> NDArray:
        return np.array(buffer, dtype=dtype).reshape(-1, width).copy()

    n, t = shape.vertex_count(), shape.face_count()
    vertex_attributes, face_attributes = {}, {}
    for key in mi.traverse(shape).keys():
        if key.startswith("vertex_") and key[7:] not in ("positions", "normals", "texcoords"):
            vertex_attributes[key] = np.array(shape.attribute_buffer(key), np.float32).reshape(n, -1)
        elif key.startswith("face_"):
            face_attributes[key] = np.array(shape.attribute_buffer(key), np.float32).reshape(t, -1)
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


def _mitsuba_mesh(
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


def _mitsuba_scene(
    shapes: list[mi.Mesh], views: tuple[Mesh, ...], original: mi.Scene | None = None
) -> mi.Scene:
    """A Mitsuba scene of these meshes, in order, with the original's sensors, emitters and integrator."""
    content = watertight_scene()
    content.update({view.name: shape for view, shape in zip(views, shapes, strict=True)})
    if original is not None:
        on_shapes = [s.emitter() for s in original.shapes() if s.is_emitter()]
        on_shapes += [s.sensor() for s in original.shapes() if s.is_sensor()]
        others = [*original.sensors(), *original.emitters(), original.integrator()]
        for k, thing in enumerate(t for t in others if t is not None and not any(t is s for s in on_shapes)):
            key = thing.id()
            content[key if key and "." not in key and key not in content else f"_other_{k}"] = thing
    return mi.load_dict(content, optimize=False)
