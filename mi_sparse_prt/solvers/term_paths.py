"""Terms of glossy BRDFs by path tracing: what finite elements among glossy surfaces are held against.

``T_k(x, j)`` is the integral of ``f_k(w) L(x, w; j)`` over directions w ([HR10] eq. 3), L the radiance that comes by
way of other surfaces. With cosine-distributed first rays it is the mean of f_k(w) pi / cos times the radiance that they
find, as white light is that of the radiance alone. All terms of a vertex share its paths.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from mi_sparse_prt.measurement.vertices import Points
from mi_sparse_prt.operators.factored_visibility import FactoredVisibility
from mi_sparse_prt.solvers.glossy_radiosity import Lobes
from mi_sparse_prt.solvers.paths import PathSolver


class TermPaths(PathSolver):
    """Indirect white light and terms of a grey scene's vertices; paths ask Mitsuba's BSDFs of all surfaces they meet.

    Channels are white light and K terms, which are 0 where a vertex is not glossy: ``elements`` gives (n, 1 + K), in
    1/sr and per sr of light. An element's channels are not independent of each other, those of two elements are.

    Parameters
    ----------
    scene : mi.Scene
        Normalised copy without emitters; red stands for all colours.
    direct : FactoredVisibility
        It has the light directions, the frames and the incident factors.
    points : Points
        Of all vertices.
    max_depth, spp, seed : int
        As for ``PathSolver``.
    """

    def __init__(
        self,
        scene: mi.Scene,
        direct: FactoredVisibility,
        points: Points,
        max_depth: int = 5,
        spp: int = 16,
        seed: int = 0,
    ) -> None:
        super().__init__(scene, direct.lighting, points, "direction", max_depth, spp, 1 + direct.terms, seed)
        self._lobes = Lobes(direct, np.empty((0, *direct.tables.shape), np.float32))

    def _weighted(self, point: mi.UInt32, direction: mi.Vector3f, radiance: mi.Color3f) -> list[mi.Float]:
        return [radiance.x, *(weight * radiance.x for weight in self._lobes.incident(point, direction))]
