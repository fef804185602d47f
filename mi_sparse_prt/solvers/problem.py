"""What is asked for, as every solver needs it: the scene and the choices of E, M and R ([Leh07] eq. 12)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.measurement.measurement import Measurement, MeshRange
from mi_sparse_prt.measurement.vertices import Points, vertex_points
from mi_sparse_prt.reflection.reflection import Reflection
from mi_sparse_prt.scene.scene import Scene


@dataclass(frozen=True)
class Problem:
    """The light transport matrix of a scene that is to be found.

    Attributes
    ----------
    scene : Scene
    emission : CubemapLighting
        E: its columns.
    reflection : Reflection
        R: what its points do with incident light.
    basis : {"direction", "texel"}
        How the light of a column arrives.
    max_depth : int
        As Mitsuba's ``path``: 2 = direct light only, 5 = three interreflections, -1 = no limit.
    """

    scene: Scene
    emission: CubemapLighting
    reflection: Reflection
    basis: str = "direction"
    max_depth: int = 5

    @cached_property
    def points(self) -> Points:
        """M: where its rows hold, in the scene's normalised frame."""
        return vertex_points(self.scene)

    @property
    def measurement(self) -> Measurement:
        """M, as the result keeps it."""
        groups = tuple(MeshRange(mesh.name, mesh.vertices) for mesh in self.scene.meshes)
        return Measurement(self.points.keys, self.scene.vertex_areas, groups)

    @property
    def channels(self) -> int:
        """1 in a grey scene, else 3."""
        return 1 if self.scene.grey else 3
