"""M, what is asked for: a set of surface points, and what makes outputs of them ([Leh07] eq. 12)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.core.sparse_arrays import sparse_from_arrays, sparse_to_arrays
from mi_sparse_prt.measurement.vertices import Points, vertex_points
from mi_sparse_prt.scene.ray_offsets import ray_offsets
from mi_sparse_prt.scene.scene import Scene

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class MeshRange:
    """Name of a mesh, or of another group of points, and the slice of its points among all."""

    name: str
    vertices: slice


class SurfacePoints(NamedTuple):
    """Where rows of T hold, in world space: (n, 3) float32 each.

    Attributes
    ----------
    positions
    normals
        Shading normals: the cosine and the hemisphere.
    ray_offsets
        From a position to where its rays start, on the front of the surface.
    """

    positions: Floats
    normals: Floats
    ray_offsets: Floats


@dataclass(frozen=True)
class Measurement:
    """Points for which incident rows hold, and outputs made of them; by `mesh_vertices` or `camera_pixels`.

    Attributes
    ----------
    keys : (n,) uint64
        Identify points whatever their order: random numbers are made of them.
    areas : (n,) float32
        Of the surface around each point, world units.
    groups : tuple of MeshRange
        They follow each other.
    kind : str
        ``"vertices"``, ``"pixels"``, or what else its points are.
    normalised : Points, optional
        In the scene's normalised frame; None where the matrix came from a file without its scene.
    frame : ((3,) float64, float), optional
        Centre and scale of that frame: normalised = (world - centre) * scale.
    scene_hash : str, optional
        Of the scene that it is of.
    albedo : (n, 3) float32, optional
        Diffuse reflectance at the points; that of the scene's vertices if not given.
    weights : (outputs, n) sparse float32, optional
        Without it, each point is an output.
    image : (height, width), optional
        Of outputs that are pixels, row by row.
    """

    keys: NDArray[np.uint64]
    areas: Floats
    groups: tuple[MeshRange, ...]
    kind: str = "vertices"
    normalised: Points | None = None
    frame: tuple[NDArray[np.float64], float] | None = None
    scene_hash: str | None = None
    albedo: Floats | None = None
    weights: scipy.sparse.csr_array | None = None
    image: tuple[int, int] | None = None

    def __repr__(self) -> str:
        return f"Measurement({self.outputs} {self.kind})"

    def __len__(self) -> int:
        """Points."""
        return len(self.keys)

    @property
    def outputs(self) -> int:
        """What is asked for: rows of T."""
        return len(self) if self.weights is None else int(self.weights.shape[0])

    @property
    def group_names(self) -> NDArray[np.str_]:
        """(outputs,) name of the mesh that each output is of, "image" where outputs are pixels."""
        if self.weights is not None:
            return np.full(self.outputs, "image")
        names, sizes = (
            [g.name for g in self.groups],
            [g.vertices.stop - g.vertices.start for g in self.groups],
        )
        return np.repeat(np.array(names, np.str_), sizes)

    @property
    def points(self) -> SurfacePoints:
        """Positions, normals and ray offsets, world space, for which the rows hold.

        Raises
        ------
        PrtError
            If the matrix came from a file without its scene.
        """
        if self.normalised is None or self.frame is None:
            raise PrtError("these points were not kept in the file: load_transport(path, scene) has them")
        points, (centre, scale) = self.normalised, self.frame
        offset = ray_offsets(points.positions) / scale
        world = points.positions / scale + centre
        return SurfacePoints(
            world.astype(np.float32), points.normals, (points.offset_normals * offset).astype(np.float32)
        )

    def combined(self, values: Floats) -> Floats:
        """Outputs (outputs, ...) of values at all points (n, ...)."""
        return values if self.weights is None else _product(self.weights, values)

    def combined_adjoint(self, values: Floats) -> Floats:
        """The transpose of ``combined``: (outputs, ...) to (n, ...)."""
        return values if self.weights is None else _product(self.weights.T, values)

    def take(self, points: NDArray[np.integer], groups: tuple[MeshRange, ...]) -> Measurement:
        """Some points, in this order, which are in these groups; without weights."""
        return replace(self, keys=self.keys[points], areas=self.areas[points], groups=groups)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """What files keep, beside ``attributes``."""
        own: dict[str, NDArray[Any]] = {"keys": self.keys, "areas": self.areas}
        return own if self.weights is None else own | sparse_to_arrays("weights", self.weights)

    def attributes(self) -> dict[str, Any]:
        """JSON as it is."""
        groups = [[group.name, group.vertices.start, group.vertices.stop] for group in self.groups]
        return {"kind": self.kind, "groups": groups, "image": self.image}

    @classmethod
    def from_arrays(cls, attributes: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> Measurement:
        """From what ``attributes`` and ``arrays`` gave; ValueError or KeyError if these do not fit together."""
        groups = tuple(MeshRange(name, slice(a, b)) for name, a, b in attributes["groups"])
        keys, areas = arrays["keys"], arrays["areas"]
        if areas.shape != keys.shape or (groups and groups[-1].vertices.stop != len(keys)):
            raise ValueError("points and their areas do not fit together")
        some = "weights_indptr" in arrays
        weights = sparse_from_arrays("weights", arrays, len(keys)) if some else None
        image = attributes.get("image")
        kind = attributes.get("kind", "vertices")
        return cls(keys, areas, groups, kind, weights=weights, image=tuple(image) if image else None)


def _product(weights: scipy.sparse.sparray, values: Floats) -> Floats:
    """Weights (m, n) times values (n, ...)."""
    return (weights @ values.reshape(len(values), -1)).reshape(-1, *values.shape[1:])


def mesh_vertices(scene: Scene) -> Measurement:
    """The vertices of a scene's meshes: each is an output."""
    groups = tuple(MeshRange(mesh.name, mesh.vertices) for mesh in scene.meshes)
    points = vertex_points(scene)
    return Measurement(
        points.keys,
        scene.vertex_areas,
        groups,
        normalised=points,
        frame=(scene.centre, scene.scale),
        scene_hash=scene.hash,
    )
