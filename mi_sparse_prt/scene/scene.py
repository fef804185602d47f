"""From a Mitsuba scene to vertices: positions, normals, albedo, triangles, and a copy in the unit box.

The rooms behind this one never look at Mitsuba shapes. What they get is a `Scene`: clean triangle meshes
whose vertices are the rows of the light transport matrix, and Mitsuba scenes with exactly these meshes: one
where the user put them, one scaled to the unit box, where Mitsuba's absolute ray offsets mean the same for
every scene; and one of the same surfaces in few triangles, which rays are faster in.
"""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.errors import PrtError, PrtWarning
from mi_sparse_prt.core.random_keys import hash_rows, mix
from mi_sparse_prt.scene.materials import Material
from mi_sparse_prt.scene.mitsuba_meshes import build_mitsuba_mesh, build_mitsuba_scene, objects_off_shapes
from mi_sparse_prt.scene.opaque_parts import opaque_part
from mi_sparse_prt.scene.shape_table import ShapeTable
from mi_sparse_prt.scene.sheets import Back, find_backs
from mi_sparse_prt.scene.sizing_field import Details
from mi_sparse_prt.scene.surfaces import read_surfaces
from mi_sparse_prt.scene.traced_scene import TracedScene
from mi_sparse_prt.scene.traversal import places_of_cameras, places_of_lamps
from mi_sparse_prt.scene.triangle_mesh import (
    TriangleMesh,
    concatenated,
    connected_pieces,
    triangle_keys,
    unique_rows,
)

FEW_MESHES = 12  # more are sampled together: what each took would grow with shapes, not with vertices
TOGETHER = 4  # meshes, as of which samples of these are


@dataclass(frozen=True)
class Mesh:
    """One mesh of a `Scene`: the front of a shape, or its back where it reflects on both sides.

    Attributes
    ----------
    name : str
        The shape's id, unique in the scene; with ``_back`` for its back.
    vertices : slice
        Its vertices among the scene's.
    triangles : (n_t, 3) int32
        Indices local to the slice: the scene's vertex is ``vertices.start + index``.
    shape : int
        Its number among the scene's Mitsuba shapes.
    """

    name: str
    vertices: slice
    triangles: NDArray[np.int32]
    shape: int = 0


class SceneFile(NamedTuple):
    """What a scene was loaded from: the arguments of ``load_scene``."""

    path: str
    edge_length: float | None
    parameters: dict[str, Any]


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
    transmitted : (n_v, 3) float32
        Light that goes through into all directions on the other side, as curtains and leaves let it; measured as the
        albedo, which it is no part of.
    meshes : tuple of Mesh
        The fronts of all shapes (those of instances last, one for each BSDF), then the backs of two-sided ones, as
        far as light can reach them.
    fronts : tuple of Mesh
        The first of these, one for each shape.
    front_of : (n_v,) int64
        The vertex at the same place on the front: of a front itself, of a back the one that it lies behind.
    backs : (vertices of fronts,) int64
        The other way round: the vertex behind each; -1 where it is dark there, or the back reflects no light.
    dark_backs : list of str
        Two-sided shapes with backs that no light reaches, such as the inside of a closed solid. These have no vertices.
    mitsuba : mi.Scene
        World space: the meshes of `fronts`, in that order and with these vertices, plus the sensors, emitters
        and integrator of the original scene (the same objects; area emitters are copied, their textures are not).
    normalised : TracedScene
        The same surfaces and BSDF objects in the unit box: centred on the origin, longest side 1; no emitters, no
        sensors. Where things are small beside the scene, they are in the middle, and as large as if there were nothing
        else: rays start off a surface by some 1e-4 of the unit, which must be little to them. Of more than a dozen
        meshes, those of one plain material that follow each other are one shape: every shape that is alive makes
        kernels slower to trace, a thousand of them by 0.2 s each time.
    centre : (3,) float64
    scale : float
        normalised = (world - centre) * scale, computed in float64. A scene that was scaled gives the same
        normalised positions within 1e-6; one moved by k times its size within k * 1e-7, which is what its
        float32 world positions still know.
    normalised_positions : (n_v, 3) float32
    warnings : list of str
        What was handled on the user's behalf, a sentence for each fact; each was also issued as a `PrtWarning`.
    notes : list of PrtWarning
        These themselves.
    materials : list of Material
        One for each mesh.
    file : SceneFile or None
        What it was loaded from, if it was.
    """

    def __init__(
        self,
        mitsuba: mi.Scene,
        meshes: list[TriangleMesh],
        materials: list[Material],
        details: Details | None = None,
    ) -> None:
        """Use `Scene.from_mitsuba`; `meshes` are clean and in world space, `materials` one for each."""
        self.file: SceneFile | None = None
        self.notes: list[PrtWarning] = []
        fronts = np.concatenate([m.positions for m in meshes])
        low, high = (f(fronts, axis=0).astype(np.float64) for f in (np.min, np.max))
        centre, size = ((low + high) / 2, 1.0) if details is None else details
        self.centre: NDArray[np.float64] = centre
        self.scale = float(1 / np.max(high - low)) / size
        # An area emitter may outlive its shape, and Mitsuba then reads freed memory: these are kept. Others are not:
        # each instance that is alive makes every kernel slower to trace
        self._original = [shape for shape in mitsuba.shapes() if shape.is_emitter()]
        self._others, self._emission = objects_off_shapes(mitsuba), [k.emission() for k in materials]
        self._surfaces, self._runs = meshes, _alike(materials)
        unit = [self._traced(concatenated(meshes[run]), materials[run.start]) for run in self._runs]
        names = [meshes[run.start].name for run in self._runs]
        self.normalised = TracedScene(build_mitsuba_scene(unit, names))

        scattered = [_scattered(k, m) for m, k in zip(meshes, materials, strict=True)]
        places = (self._normalise(find(mitsuba)) for find in (places_of_lamps, places_of_cameras))
        backs, self.dark_backs = find_backs(self.normalised, meshes, materials, *places)
        behind = {back.shape: materials[back.shape].back() for back in backs}
        scattered_behind = {k: _scattered(own, meshes[k]) for k, own in behind.items()}
        backs = [back for back in backs if any(part.any() for part in scattered_behind[back.shape])]
        self.albedo, self.transmitted = (
            np.concatenate(
                [
                    *(own[part] for own in scattered),
                    *(scattered_behind[k.shape][part][k.vertices] for k in backs),
                ]
            )
            for part in (0, 1)
        )
        self.materials = [*materials, *(behind[back.shape] for back in backs)]
        self.meshes = _listed(meshes, backs)
        self.fronts = self.meshes[: len(meshes)]
        starts = [self.fronts[back.shape].vertices.start for back in backs]
        self.front_of = np.concatenate(
            [
                np.arange(len(fronts)),
                *(start + back.vertices for start, back in zip(starts, backs, strict=True)),
            ]
        )
        self.backs = np.full(len(fronts), -1, np.int64)
        self.backs[self.front_of[len(fronts) :]] = np.arange(len(fronts), len(self.front_of))
        self.positions = fronts[self.front_of]
        self.normals = np.concatenate([m.normals for m in (*meshes, *(back.mesh for back in backs))])
        self.normalised_positions = self._normalise(self.positions)

    def _traced(self, mesh: TriangleMesh, material: Material) -> mi.Mesh:
        """A mesh of the normalised frame."""
        return build_mitsuba_mesh(mesh, material.bsdf, positions=self._normalise(mesh.positions))

    def _normalise(self, positions: NDArray[np.float32]) -> NDArray[np.float32]:
        return ((positions.astype(np.float64) - self.centre) * self.scale).astype(np.float32)

    @classmethod
    def from_mitsuba(cls, scene: mi.Scene, edge_length: float | None = None) -> Scene:
        """The `Scene` of a loaded Mitsuba scene, merged by Mitsuba or not.

        Parameters
        ----------
        scene : mi.Scene
            Meshes; spheres, disks, cylinders, curves, ellipsoids and distance grids, which become triangles; instances,
            which become one mesh for each BSDF of their groups. Its sensors, emitters and integrator are reused.
        edge_length : float, optional
            World units. Longer edges are bisected and curved shapes tessellated to it. Default: the diagonal of
            the scene's box / 64, and shorter near small things and on them (``sizing_field``). `float("inf")` leaves
            meshes as they are.

        Raises
        ------
        PrtError
            No mesh; a shape that cannot become triangles (of a plugin that is not Mitsuba's own); positions or normals
            that are not finite; an albedo outside [0, 1]; more than 5 million vertices.
        """
        result = cls._build(scene, edge_length)
        result._warn()
        return result

    @classmethod
    def _build(cls, scene: mi.Scene, edge_length: float | None) -> Scene:
        surfaces, details, notes = read_surfaces(scene, edge_length)
        used = [(mesh, material) for mesh, material in surfaces if len(mesh.triangles)]
        if not used:
            raise PrtError("the scene has no triangle with an area: nothing to compute transport for")
        result = cls(scene, [mesh for mesh, _ in used], [material for _, material in used], details)
        result.notes = notes.warnings()
        return result

    def _warn(self) -> None:
        for note in self.notes:
            warnings.warn(note, stacklevel=3)

    @property
    def warnings(self) -> list[str]:
        """What was handled on the user's behalf."""
        return [str(note) for note in self.notes]

    @cached_property
    def mitsuba(self) -> mi.Scene:
        """World space: what the user's scene shows, by its own lamps and cameras.

        Built when it is first asked for: an environment's matrix is computed without, and a thousand shapes that are
        alive make every kernel slower to trace.
        """
        shapes = [
            build_mitsuba_mesh(mesh, material.bsdf, emitter)
            for mesh, material, emitter in zip(self._surfaces, self.materials, self._emission, strict=False)
        ]
        return build_mitsuba_scene(shapes, [mesh.name for mesh in self._surfaces], self._others)

    @cached_property
    def world(self) -> TracedScene:
        """``mitsuba``, for rays that look at its surfaces."""
        return TracedScene(self.mitsuba)

    def unlit_shapes(self) -> list[mi.Mesh]:
        """The world-space meshes without their area emitters, for scenes with other light."""
        return [
            build_mitsuba_mesh(mesh, material.bsdf) if shape.is_emitter() else shape
            for shape, mesh, material in zip(
                self.mitsuba.shapes(), self._surfaces, self.materials[: len(self.fronts)], strict=True
            )
        ]

    def to_world(self, p: mi.Point3f) -> mi.Point3f:
        """Points of the normalised frame in world space, on the device."""
        return p / self.scale + mi.Point3f(*map(float, self.centre))

    def from_world(self, p: mi.Point3f) -> mi.Point3f:
        """Points of world space in the normalised frame, on the device."""
        return (p - mi.Point3f(*map(float, self.centre))) * self.scale

    def shape_in_world(self, shape: mi.ShapePtr, active: mi.Mask) -> mi.ShapePtr:
        """The shapes of ``mitsuba``, which have emitters, in place of those of ``normalised`` or ``unsplit``.

        A kernel on a GPU can trace rays in one scene only: what rays of others meet is looked up.
        """
        return dr.reinterpret_array(mi.ShapePtr, self._shapes_in_world.gather(shape, active))

    @cached_property
    def _shapes_in_world(self) -> ShapeTable:
        pointers = dr.reinterpret_array(mi.UInt32, self.mitsuba.shapes_dr()).numpy()
        of_runs = pointers[
            [run.start for run in self._runs]
        ]  # of which none shines, if it is of several shapes
        return ShapeTable([self.normalised.mitsuba, self.unsplit.mitsuba], np.tile(of_runs, 2))

    @property
    def cameras(self) -> list[mi.Sensor]:
        """Sensors that belong to no shape."""
        return [thing for thing in self._others if isinstance(thing, mi.Sensor)]

    def sensor(self, sensor: int | mi.Sensor) -> mi.Sensor:
        """One of the scene's own cameras by its number; a sensor is passed on.

        Raises
        ------
        PrtError
            If there is no such number.
        """
        if not isinstance(sensor, int):
            return sensor
        sensors = self.mitsuba.sensors()
        if not -len(sensors) <= sensor < len(sensors):
            raise PrtError(
                f"the scene {self.path or ''} has {len(sensors)} sensors, there is no number {sensor}"
            )
        return sensors[sensor]

    @property
    def path(self) -> str | None:
        """The XML file."""
        return self.file.path if self.file else None

    @property
    def n_vertices(self) -> int:
        """The number of vertices, which is the number of rows of the matrix."""
        return len(self.positions)

    @property
    def sampled_together(self) -> list[slice]:
        """Vertices that are strata or surfaces of their own: those of each mesh, or all where meshes are many."""
        if len(self.meshes) > FEW_MESHES:
            return [slice(0, self.n_vertices)]
        return [mesh.vertices for mesh in self.meshes]

    @cached_property
    def sent_albedo(self) -> NDArray[np.float32]:
        """(n_v, 3) of all light that vertices receive, what they send on: to their own side and to the other."""
        return np.minimum(self.albedo + self.transmitted, 1)

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

    @cached_property
    def pieces(self) -> NDArray[np.int64]:
        """(n_v,) number of the connected piece of each vertex; both sides of a surface are pieces of their own."""
        sizes = [mesh.vertices.stop - mesh.vertices.start for mesh in self.meshes]
        triangles = np.concatenate([mesh.triangles + mesh.vertices.start for mesh in self.meshes])
        places = np.column_stack([np.repeat(np.arange(len(sizes)), sizes), self.positions.astype(np.float64)])
        first, same = unique_rows(places)
        return connected_pieces(same[triangles], len(first))[1][same].astype(np.int64)

    @property
    def diffuse(self) -> bool:
        """Whether all BSDFs reflect purely diffusely."""
        return all(material.diffuse for material in self.materials)

    @property
    def specular(self) -> bool:
        """Whether light goes on from any surface as it came: mirrors, glass, rough glass, masks."""
        return any(material.single_directions or material.rough_glass for material in self.materials)

    @property
    def bends_light(self) -> bool:
        """Whether light goes on from any surface in another direction: mirrors, glass, rough glass."""
        return any(material.bends_light for material in self.materials)

    @cached_property
    def rough_glass(self) -> list[mi.BSDF]:
        """BSDFs that let light through into a range of directions."""
        return [material.bsdf for material in self.materials[: len(self.fronts)] if material.rough_glass]

    @cached_property
    def unsplit(self) -> TracedScene:
        """The surfaces of ``normalised``, flat ones as they were before their edges were bisected.

        For rays that need no vertices: a floor is two triangles, and in a room rays take a half to a third of the time.
        """
        if all(mesh.unsplit is None for mesh in self._surfaces):
            return self.normalised
        shapes = []
        for run, shape in zip(self._runs, self.normalised.shapes(), strict=True):
            whole = concatenated(self._surfaces[run]).unsplit
            shapes.append(shape if whole is None else self._traced(whole, self.materials[run.start]))
        names = [self._surfaces[run.start].name for run in self._runs]
        return TracedScene(build_mitsuba_scene(shapes, names))

    @cached_property
    def specular_surfaces(self) -> TracedScene | None:
        """Those of ``unsplit`` from which light goes on as it came, alone: rays that may meet one are found fast."""
        return self._unsplit_surfaces(lambda material: material.single_directions or material.rough_glass)

    @cached_property
    def passing_surfaces(self) -> TracedScene | None:
        """Those of ``unsplit`` that some light goes straight through."""
        return self._unsplit_surfaces(lambda material: material.passes_straight)

    @cached_property
    def blocking_surfaces(self) -> TracedScene | None:
        """Those of ``unsplit`` that no light goes straight through, and opaque parts of others."""
        return self._unsplit_surfaces(lambda material: not material.passes_straight, self._opaque_parts)

    @cached_property
    def dimming_surfaces(self) -> TracedScene | None:
        """Those of ``unsplit`` past which no light is as it was: ``blocking_surfaces``, and panes."""
        return self._unsplit_surfaces(
            lambda material: not material.passes_straight or material.dims, self._opaque_parts
        )

    @cached_property
    def _opaque_parts(self) -> list[mi.Mesh]:
        """Triangles of ``unsplit`` under masks that certainly let no light pass there."""
        return [part for shape in self.unsplit.shapes() if (part := opaque_part(shape)) is not None]

    def _unsplit_surfaces(
        self, belongs: Callable[[Material], bool], others: Sequence[mi.Mesh] = ()
    ) -> TracedScene | None:
        """A scene of some surfaces of ``unsplit`` and others, in the normalised frame; None for none."""
        which = [k for k, run in enumerate(self._runs) if belongs(self.materials[run.start])]
        shapes = self.unsplit.shapes()
        if not others and len(which) in (0, len(shapes)):
            return self.unsplit if which else None
        names = [self.fronts[self._runs[k].start].name for k in which]
        names += [f"opaque part {k}" for k in range(len(others))]
        return TracedScene(build_mitsuba_scene([*(shapes[k] for k in which), *others], names))

    @property
    def passes_straight(self) -> bool:
        """Whether light goes straight through any surface."""
        return any(material.passes_straight for material in self.materials)

    @cached_property
    def grey(self) -> bool:
        """Whether all surfaces provably reflect the three channels alike (within 1e-6)."""
        even = np.max(np.ptp(self.albedo, axis=1)) <= 1e-6
        return bool(even) and all(
            k.grey(mesh)
            for k, mesh in zip(self.materials, self._surfaces, strict=False)  # fronts
        )

    @cached_property
    def vertex_keys(self) -> NDArray[np.uint64]:
        """(n_v,) hash of each vertex's position, normal and albedo bits, whatever its mesh and number."""
        return hash_rows(np.concatenate([self.positions, self.normals, self.albedo], axis=1))

    @cached_property
    def hash(self) -> str:
        """SHA-256 (hex) of geometry and materials, whatever the order of shapes, vertices and triangles.

        Merging meshes of one material does not change it; moving a vertex, or changing an albedo, a texture or
        any parameter that a BSDF shows, does. So does a lamp that is carried into a closed room, whose walls then have
        vertices inside.
        """
        total = np.zeros(2, np.uint64)
        digests = set()
        for view, mesh, material in zip(self.fronts, self._surfaces, self.materials, strict=False):
            digest = material.digest()
            digests.add(digest)
            seed = np.frombuffer(digest[:8], np.uint64)[0]
            keys = triangle_keys(mesh, self.vertex_keys[view.vertices], seed)
            with np.errstate(over="ignore"):
                total[0] += np.sum(mix(keys), dtype=np.uint64)
                total[1] += np.sum(mix(keys ^ np.uint64(0x5851F42D4C957F2D)), dtype=np.uint64)
        count = sum(len(mesh.triangles) for mesh in self.fronts)
        parts = [total.tobytes(), str(count).encode(), *sorted(digests)]
        behind = self.n_vertices - len(self.backs)
        parts += [str(behind).encode()] if behind else []  # a lamp in a closed room lights its backs
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


def _scattered(material: Material, mesh: TriangleMesh) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Albedo and transmittance (n, 3) each, of a shape that does not stay alive: kernels would be slower."""
    shape = build_mitsuba_mesh(mesh, material.bsdf)
    return material.albedo(shape, mesh), material.transmittance(shape, mesh)


def _alike(materials: Sequence[Material]) -> list[slice]:
    """Runs of meshes, of the same plain material each; what shines, or has a texture, is alone, as are few meshes."""
    if len(materials) <= FEW_MESHES:
        return [slice(k, k + 1) for k in range(len(materials))]
    digests = [k.digest() if k.constant and not k.shines else None for k in materials]
    starts = [k for k, own in enumerate(digests) if k == 0 or own is None or own != digests[k - 1]]
    return [slice(a, b) for a, b in zip(starts, [*starts[1:], len(materials)], strict=True)]


def _listed(fronts: list[TriangleMesh], backs: list[Back]) -> tuple[Mesh, ...]:
    """Their vertices follow each other; backs get names of their own."""
    found: list[Mesh] = []
    names = {mesh.name for mesh in fronts}
    named = [(mesh, number, mesh.name) for number, mesh in enumerate(fronts)]
    for back in backs:
        name = f"{back.mesh.name}_back"
        while name in names:
            name += "_"
        names.add(name)
        named.append((back.mesh, back.shape, name))
    for mesh, shape, name in named:
        start = found[-1].vertices.stop if found else 0
        found.append(Mesh(name, slice(start, start + len(mesh.positions)), mesh.triangles, shape))
    return tuple(found)
