"""Terms of glossy BRDFs by rays and by path tracing: no finite elements, no interpolation.

``T_k(x, j)`` is the integral of ``f_k(w) L(x, w; j)`` over directions w ([HR10] eq. 3), L the radiance that comes from
the sky or by way of other surfaces. With cosine-distributed first rays it is the mean of f_k(w) pi / cos times the
radiance that they find, as unit-albedo transport is that of the radiance alone. All terms of a vertex share its paths.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.device_arrays import on_device
from mi_sparse_prt.reflection.in_out_factors import InOutFactors
from mi_sparse_prt.solvers.direct_rays import LANES, DirectSolver
from mi_sparse_prt.solvers.lobes import Lobes
from mi_sparse_prt.solvers.paths import PathSolver
from mi_sparse_prt.solvers.problem import Problem


class TermPaths(PathSolver):
    """Indirect light and terms at vertices; paths ask Mitsuba's BSDFs of all surfaces they meet.

    An element has 1 + K rows, unit-albedo transport and the terms, which are 0 where a vertex is not glossy, in 1/sr
    and per sr of light; each has the colours of the problem: ``elements`` gives (n, (1 + K) * colours), colours side by
    side. Those of an element are not independent of each other, those of two elements are.

    Parameters
    ----------
    problem : Problem
        With in-out factors.
    spp, seed : int
        As for ``PathSolver``.
    """

    def __init__(self, problem: Problem, spp: int = 16, seed: int = 0) -> None:
        assert isinstance(problem.reflection, InOutFactors)
        super().__init__(problem, spp, seed)
        self.colours, self.channels = problem.channels, (1 + problem.reflection.terms) * problem.channels
        self._lobes = Lobes(problem.reflection)

    def _weighted(self, point: mi.UInt32, direction: mi.Vector3f, radiance: list[mi.Float]) -> list[mi.Float]:
        weights = [mi.Float(1), *self._lobes.incident(point, direction)]
        return [weight * radiance[c] for weight in weights for c in range(self.colours)]


class TermRays:
    """Direct light and terms at vertices, by shadow rays.

    Parameters
    ----------
    direct : DirectSolver
    reflection : InOutFactors
        Of the same points.
    """

    def __init__(self, direct: DirectSolver, reflection: InOutFactors) -> None:
        self._direct, self._lobes = direct, Lobes(reflection)
        self._terms = reflection.terms

    def elements(
        self, point_ids: NDArray[np.integer], texel_ids: NDArray[np.integer], seed: int | None = None
    ) -> NDArray[np.float32]:
        """Unit-albedo row and terms of listed elements, (n, 1 + K) float32; see ``DirectSolver.elements``."""
        result = np.zeros((len(point_ids), 1 + self._terms), np.float32)
        size = LANES // (self._direct.rays_per_element * (1 + self._terms))
        for a in range(0, len(point_ids), size):
            part = slice(a, a + size)
            points, texels = (on_device(mi.UInt32, ids[part]) for ids in (point_ids, texel_ids))
            rows = self._direct.weighted_means(
                points, texels, lambda point, w: [mi.Float(1), *self._lobes.incident(point, w)], seed
            )
            dr.eval(rows)
            result[part] = np.stack([row.numpy() for row in rows], axis=1)
        return result * (self._direct.lighting.solid_angles[texel_ids] / np.float32(np.pi))[:, None]
