"""What ``method="sparse"`` costs, from measured rays and paths, and its rates on the bunny and the dancer."""

from __future__ import annotations

import math
from dataclasses import dataclass

from mi_sparse_prt.methods.sparse import SparseOptions

DENSE = SparseOptions().spatial.fraction  # of the vertices: with that share these were measured
RAYS = 0.8  # seconds of direct light, relative to all rays ...
PATHS = 0.08  # ... and of indirect light, relative to all paths
OVERHEAD = 60e-6  # seconds per vertex
DIRECT = 0.01  # relative L2 error for direct light
# error of indirect light, relative to the noise of as many paths for all elements: 0.3 on meshes of 15,000 vertices and
# more, whose rows hide noise from each other, 0.8 on those of hundreds. A trial may turn out better, hardly worse
NOISE = 0.8


@dataclass(frozen=True)
class SparseCosts:
    """Cost and error for any share of dense vertices.

    Attributes
    ----------
    vertices : int
    rays : float
        Seconds of all direct light by rays.
    path : float
        Seconds of a path for every element.
    noise : float
        Relative L2 error of the whole matrix that these have.
    spp : int
    """

    vertices: int
    rays: float
    path: float
    noise: float
    spp: int

    def seconds(self, dense: float) -> float:
        """Predicted time."""
        own = RAYS * self.rays + OVERHEAD * self.vertices
        return own + PATHS * dense / DENSE * self.spp * self.path

    def error(self, dense: float) -> float:
        """Predicted relative L2 error of the whole matrix."""
        return math.hypot(DIRECT, NOISE * self.noise / math.sqrt(self.spp)) * math.sqrt(DENSE / dense)
