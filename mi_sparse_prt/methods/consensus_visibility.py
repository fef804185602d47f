"""All direct light in the direction basis, most of it copied from neighbours (``sampling.consensus``)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.profiling import Stopwatch
from mi_sparse_prt.sampling.angular import AngularGrid
from mi_sparse_prt.sampling.consensus import Consensus, Surface, sample_by_levels
from mi_sparse_prt.scene.scene import Mesh, Scene
from mi_sparse_prt.solvers.direct_rays import DirectSolver


def by_consensus(scene: Scene, direct: DirectSolver, clock: Stopwatch) -> Consensus:
    """Visibility of all vertices of a scene.

    Parameters
    ----------
    scene : Scene
    direct : DirectSolver
        Direction basis, at the scene's vertices.
    clock : Stopwatch
        Phases ``consensus`` and ``consensus_rays``.

    Returns
    -------
    Consensus
        ``visible`` bits of all vertices, and those that were ``evaluated``.
    """
    with clock.phase("consensus"):

        def trace(vertices: NDArray[np.uint32], texels: NDArray[np.uint32]) -> NDArray[np.bool_]:
            with clock.phase("consensus_rays"):
                return direct.visible(vertices, texels)

        state = Consensus(direct.points.normals, AngularGrid(direct.lighting), trace)
        for mesh in scene.meshes:
            sample_by_levels(state, surface_of(scene, direct, mesh))
    return state


def surface_of(scene: Scene, direct: DirectSolver, mesh: Mesh) -> Surface:
    """A mesh as a surface on which vertices have neighbours."""
    inside = mesh.vertices
    return Surface(
        inside.start,
        scene.normalised_positions[inside],
        scene.normals[inside],
        direct.points.keys[inside],
    )
