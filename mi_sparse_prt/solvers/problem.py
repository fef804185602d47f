"""What is asked for, as every solver needs it: the scene and the choices of E, M and R ([Leh07] eq. 12)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.measurement.measurement import Measurement, mesh_vertices
from mi_sparse_prt.measurement.vertices import Points
from mi_sparse_prt.reflection.reflection import Diffuse, Reflection
from mi_sparse_prt.reflection.sent_light import SentLight
from mi_sparse_prt.scene.scene import Scene

MOST_APART = 8  # surfaces; of light that met more there is little, and telling it apart takes ever longer


@dataclass(frozen=True)
class Problem:
    """The light transport matrix of a scene that is to be found.

    Attributes
    ----------
    scene : Scene
    emission : EmissionSpace
        E: its columns.
    measurement : Measurement
        M: its points, not from a file.
    reflection : Reflection
        R: what these do with incident light.
    basis : {"direction", "texel"}
        How the light of a column arrives, if that is a cubemap's texel.
    max_depth : int
        As Mitsuba's ``path``: 2 = direct light only, 5 = three interreflections, -1 = no limit.
    specular_apart : bool
        Light that comes from the sky by way of mirrors and glass alone is not part of the indirect light, but an
        operator of its own (``solvers.specular``).
    sent : SentLight, optional
        What vertices send to each other, where they have terms for that alone; as ``reflection`` if not given.
    """

    scene: Scene
    emission: Any
    measurement: Measurement
    reflection: Reflection
    basis: str = "direction"
    max_depth: int = 5
    specular_apart: bool = False
    sent: SentLight | None = None

    @property
    def sending(self) -> Reflection:
        """What points send to each other."""
        return self.reflection if self.sent is None else self.sent.reflection

    @property
    def points(self) -> Points:
        """Where rows hold, in the scene's normalised frame."""
        assert self.measurement.normalised is not None
        return self.measurement.normalised

    @property
    def depths_apart(self) -> int:
        """How many surfaces light may meet, where it is told apart by their number (``ByDepth``); 0 where it is not."""
        return told_apart(self.max_depth) if self.specular_apart else 0

    @property
    def channels(self) -> int:
        """1 in a grey scene, else 3."""
        return 1 if self.scene.grey else 3

    def raise_to_mesh_mean(self, importance: NDArray[np.float32]) -> NDArray[np.float32]:
        """What counts at points (n,); at vertices no less than on average over their mesh (root mean square).

        They are few beside the texels of a texture: pictures have others between them.
        """
        least = importance.copy()
        if self.measurement.kind == "vertices":
            for mesh in self.scene.meshes:
                part = least[mesh.vertices.start : mesh.vertices.stop]
                np.maximum(part, np.sqrt(np.square(part, dtype=np.float64).mean()), out=part)
        return least

    def at(self, points: Points) -> Problem:
        """The same at other points of the scene (normalised frame), which receive light and reflect all of it."""
        n = len(points)
        where = Measurement(points.keys, np.ones(n, np.float32), (), "points", normalised=points)
        return replace(self, measurement=where, reflection=Diffuse(np.ones((n, 3), np.float32)), sent=None)

    def on(self, resolution: int) -> Problem:
        """The same on a coarser cubemap, of which an element stands for all directions in its texel."""
        factor = self.emission.resolution // resolution
        return self if factor == 1 else replace(self, emission=self.emission.coarser(factor), basis="texel")

    @property
    def at_vertices(self) -> Problem:
        """The same at the vertices, which know the light that surfaces send out: one bounce before other points."""
        if self.measurement.kind == "vertices":
            return self
        depth = self.max_depth if self.max_depth < 0 else self.max_depth - 1
        diffuse = diffuse_problem(self.scene, self.emission, depth)
        return replace(diffuse, basis=self.basis, specular_apart=self.specular_apart)


def told_apart(max_depth: int) -> int:
    """By how many surfaces light of such a depth is told apart, where anything mirrors it or lets it pass."""
    most = max_depth - 2
    return most if 0 < most <= MOST_APART else 0


def diffuse_problem(scene: Scene, emission: Any, max_depth: int = 5) -> Problem:
    """At the vertices of a scene whose surfaces are all taken for diffuse, in the direction basis."""
    return Problem(scene, emission, mesh_vertices(scene), Diffuse(scene.albedo), max_depth=max_depth)
