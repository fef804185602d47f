"""Phase 1 of [HR10]: dense vertices, chosen where transport is complex, and their rows, sampled adaptively in angle."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.bits import Bits
from mi_sparse_prt.core.run import Run
from mi_sparse_prt.io.checkpoint import Checkpoint
from mi_sparse_prt.sampling.angular import AngularGrid, DenseRows
from mi_sparse_prt.sampling.spatial import SpatialSampling, choose_dense
from mi_sparse_prt.scene.scene import Mesh
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.paths import Estimate, PathSolver


@dataclass
class Dense:
    """Densely sampled vertices and the visibility of their rows.

    Attributes
    ----------
    ids : (n_dense,) int64
        Vertices of the scene, in the order of ``rows``: mesh by mesh, and there by key, so that sums over rows round
        alike in whatever order vertices come.
    rows : DenseRows
    ranks : (n_v,) float32
        Local rank of every vertex ([HR10] 4.1); 0 where it was not asked for.
    iterations : dict
        Mesh name -> list of arrays of the scene's vertices chosen in each iteration.
    """

    ids: NDArray[np.int64]
    rows: DenseRows
    ranks: NDArray[np.float32]
    iterations: dict[str, list[NDArray[np.int64]]] = field(default_factory=dict)

    def of_mesh(self, mesh: Mesh) -> slice:
        """Where in ``ids`` the dense vertices of a mesh are."""
        before, until = (int((self.ids < end).sum()) for end in (mesh.vertices.start, mesh.vertices.stop))
        return slice(before, until)


class DenseSampler:
    """Collects dense rows, mesh by mesh.

    Parameters
    ----------
    direct : DirectSolver
        Direction basis, at the scene's vertices.
    grid : AngularGrid
    run : Run
        Phases ``spatial_sampling``, ``rank``, ``dense_rays`` and ``angular_sampling``.
    """

    def __init__(self, direct: DirectSolver, grid: AngularGrid, run: Run) -> None:
        self.scene, self.direct, self.grid, self.run = direct.problem.scene, direct, grid, run
        self._ids: list[NDArray[np.int64]] = []
        self._rows: list[DenseRows] = []
        self._ranks = np.zeros(len(direct.points), np.float32)
        self._iterations: dict[str, list[NDArray[np.int64]]] = {}

    def choose(self, mesh: Mesh, how: SpatialSampling) -> None:
        """Take vertices of a mesh in steps, by their local rank."""
        inside, start = mesh.vertices, mesh.vertices.start
        with self.run.clock.phase("rank"):
            samples = choose_dense(
                self.scene.normalised_positions[inside],
                self.direct.points.keys[inside],
                lambda ids: self.add(ids + start),
                how,
                self.run.seed,
            )
        for phase, sign in (("spatial_sampling", 1), ("rank", -1)):
            self.run.clock.add(phase, sign * samples.seconds["choice"])
        self._ranks[inside] = samples.ranks
        self._iterations[mesh.name] = [ids + start for ids in samples.iterations]

    def add(self, ids: NDArray[np.int64]) -> Bits:
        """Sample the rows of more vertices; returns their visibility."""
        with self.run.clock.phase("angular_sampling"):
            names = ids.astype(np.uint32)
            rows = self.grid.sample(self.scene.normals[ids], lambda r, t: self._traced(names[r], t))
        self._ids.append(ids)
        self._rows.append(rows)
        return rows.visible

    def dense(self) -> Dense:
        """All that was taken so far."""
        ids = np.concatenate(self._ids)
        mesh = np.searchsorted([m.vertices.stop for m in self.scene.meshes], ids, side="right")
        order = np.lexsort((self.direct.points.keys[ids], mesh))
        joined = [
            np.concatenate([getattr(rows, name) for rows in self._rows])[order]
            for name in ("visible", "evaluated", "features", "above")
        ]
        return Dense(ids[order], DenseRows(*joined), self._ranks, self._iterations)

    def _traced(self, ids: NDArray[np.uint32], texels: NDArray[np.uint32]) -> NDArray[np.bool_]:
        with self.run.clock.phase("dense_rays"):
            return self.direct.visible(ids, texels)


def indirect_of(
    solver: PathSolver,
    vertices: NDArray[np.integer],
    texels: NDArray[np.integer],
    run: Run,
    name: str = "indirect",
    state: str = "",
) -> tuple[Estimate, Checkpoint | None]:
    """Indirect light of all given vertices at all given texels: mean and variance (k, t, channels).

    And the file in which finished rows are kept, for the caller to remove when all is done. ``name`` is that of the
    progress bar, ``state`` tells the file from others of the run.
    """
    checkpoint = run.checkpoint(state)
    # [vertex, mean or variance, texel, channel]
    stored = np.empty((len(vertices), 2, len(texels), solver.channels), np.float32)
    kept = Checkpoint(checkpoint, stored) if checkpoint else None
    done = kept.rows_done if kept else 0
    block = max(1, solver.block_elements // max(1, len(texels)))
    with run.bar(len(vertices), name, done=done) as bar:
        for a in range(done, len(vertices), block):
            ids = np.asarray(vertices[a : a + block], np.uint32)
            part = solver.elements(
                np.repeat(ids, len(texels)), np.tile(np.asarray(texels, np.uint32), len(ids))
            )
            rows = stored[a : a + len(ids)]
            for k, values in enumerate((part.mean, part.variance)):
                rows[:, k] = values.reshape(len(ids), len(texels), solver.channels)
            if kept:
                kept.append(rows)
            bar.update(len(ids))
    return Estimate(stored[:, 0], stored[:, 1]), kept
