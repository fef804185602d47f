"""All direct light in the direction basis, most of it copied from neighbours (``sampling.consensus``)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.run import Run
from mi_sparse_prt.sampling.angular import AngularGrid
from mi_sparse_prt.sampling.consensus import Consensus, Surface, sample_by_levels
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.walls import Walls


def by_consensus(direct: DirectSolver, run: Run) -> Consensus:
    """Visibility of all vertices of a scene, phases ``consensus`` and ``consensus_rays``.

    Parameters
    ----------
    direct : DirectSolver
        Direction basis, at the scene's vertices.
    run : Run

    Returns
    -------
    Consensus
        ``visible`` bits of all vertices, and those that were ``evaluated``.
    """
    scene, keys = direct.problem.scene, direct.points.keys
    with run.clock.phase("consensus"):

        def trace(vertices: NDArray[np.uint32], texels: NDArray[np.uint32]) -> NDArray[np.bool_]:
            with run.clock.phase("consensus_rays"):
                return direct.visible(vertices, texels)

        state = Consensus(scene.normals, AngularGrid(direct.lighting), trace)
        walls = Walls(scene, direct.points)
        for at in scene.sampled_together:
            positions, normals = scene.normalised_positions[at], scene.normals[at]
            sample_by_levels(state, Surface(at.start, positions, normals, keys[at]), walls.leave_fewer)
    return state
