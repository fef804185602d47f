"""Random elements of direct light on which ways to find what is seen are tried, for glossy surfaces.

Their radiance counts. Many lobes are brightest near the horizon, where irradiance hardly counts and tells of no error.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.estimation.pilot_elements import STRATA, PilotElements
from mi_sparse_prt.operators.factored_visibility import FactoredVisibility
from mi_sparse_prt.operators.fractional_visibility import FractionalVisibility
from mi_sparse_prt.reflection.factor_tables import incident_tables
from mi_sparse_prt.reflection.in_out_factors import InOutFactors
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.problem import Problem
from mi_sparse_prt.solvers.term_paths import TermRays


class TermPilot(PilotElements):
    """As ``PilotElements`` of direct light; glossy vertices have all their rows, and errors are of radiance.

    Parameters
    ----------
    problem : Problem
        With in-out factors.
    seed, vertices_per_mesh, texels_per_vertex
        As for ``PilotElements``.
    """

    def __init__(self, problem: Problem, seed: int, vertices_per_mesh: int, texels_per_vertex: int) -> None:
        super().__init__(problem, False, seed, vertices_per_mesh, texels_per_vertex)
        reflection = problem.reflection
        assert isinstance(reflection, InOutFactors)
        self._own, count = reflection.take(self.vertices), self.texels.shape[1]
        self._which = self._own.glossy
        self._gram = self._own.gram(self._which).astype(np.float64)
        self._tables = incident_tables(reflection.factors, texels=problem.emission.n_directions)
        rays = TermRays(DirectSolver(problem, STRATA), reflection)
        asked = np.repeat(self.vertices[self._which], count), self.texels[self._which].ravel()
        shape = len(self._which), count, 1 + reflection.terms
        self._rows = [rays.elements(*asked, s).reshape(shape).astype(np.float64) for s in self._seeds[:2]]
        self._square = self._total(self._with_terms(self._squares(*self.direct.values), *self._rows))

    def squared_error_of_shares(self, part: FractionalVisibility) -> float:
        factored = FactoredVisibility(part, self._own.tangents, self._own.material, self._tables)
        rows = self._own.rows_of_each(self._which, 1 + self._own.terms)[:, None]
        places = np.broadcast_arrays(rows, self.texels[self._which][:, :, None])
        ours = factored.elements(*(place.ravel() for place in places)).reshape(places[0].shape)
        errors = self._with_terms(self.errors_of_shares(part), *(ours - true for true in self._rows))
        return max(self._total(errors) / max(self._square, 1e-300), 0.0)

    def _with_terms(
        self, squares: NDArray[np.float64], first: NDArray[np.float64], second: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Squares (k, t), where those of glossy vertices are products of two estimates of their rows."""
        whole = squares.copy()
        whole[self._which] = np.einsum("kabc,kta,ktb->kt", self._gram, first, second, optimize=True)
        return whole
