"""Indirect light of ``method="sparse"``: T = A D, smooth, so that few rows and few directions of these suffice.

D, the dense rows, are path traced on a quarter of the directions and freed of noise by their low rank. A interpolates
them along the surface; where a few samples at sparse vertices show that to be worth it, they correct it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mi_sparse_prt.core.bits import Bits, list_bits, pack
from mi_sparse_prt.core.ragged import concatenate_ranges, row_starts
from mi_sparse_prt.core.random_keys import mix
from mi_sparse_prt.core.run import Run
from mi_sparse_prt.io.checkpoint import Checkpoint
from mi_sparse_prt.measurement.neighbours import Neighbours
from mi_sparse_prt.methods.dense_neighbourhoods import Neighbourhood
from mi_sparse_prt.methods.dense_sampling import Dense, indirect_of
from mi_sparse_prt.methods.half_floats import halved
from mi_sparse_prt.operators.interpolated import Interpolated
from mi_sparse_prt.operators.upsampled import Upsampled
from mi_sparse_prt.reconstruction.denoising import DenoisedRows, denoise_rows, smooth_rows
from mi_sparse_prt.reconstruction.interpolation_weights import linear_weights
from mi_sparse_prt.reconstruction.normal_equations import normal_equations
from mi_sparse_prt.reconstruction.ridge import System, choose_deviation, fit_correction, shift_to_prior
from mi_sparse_prt.sampling.angular import AngularGrid
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.solvers.paths import PathSolver
from mi_sparse_prt.solvers.walls import Walls

BLOCK = 4096  # sparse vertices at a time


@dataclass(frozen=True)
class IndirectOptions:
    """What the reconstruction of indirect light may be tuned by.

    Attributes
    ----------
    neighbours : int
        Dense vertices from which a vertex takes its light.
    pilot : int
        Sparse vertices of a mesh that tell whether samples help.
    least_noise : float
        Of a sample, in means of all: a few paths may agree by chance.
    """

    neighbours: int = 10
    pilot: int = 512
    least_noise: float = 0.1


def indirect_part(
    solver: PathSolver,
    dense: Dense,
    groups: list[Neighbourhood],
    evaluated: Bits,
    grid: AngularGrid,
    run: Run,
    options: IndirectOptions,
) -> tuple[Interpolated, int]:
    """Evaluate and reconstruct indirect light.

    Parameters
    ----------
    solver : PathSolver
        At the scene's vertices and the full resolution of the lighting.
    dense : Dense
    groups : list of Neighbourhood
        One per mesh.
    evaluated : (n_v, words) uint32 bits
        Elements that were evaluated for direct light. Sparse vertices sample indirect light in some of them.
    grid : AngularGrid
    run : Run
        Phases ``dense_paths``, ``low_rank``, ``sparse_paths``, ``system``, ``solver``.
    options : IndirectOptions

    Returns
    -------
    Interpolated, int
        The part, and how many of its elements were evaluated.
    """
    scene = solver.problem.scene
    with run.clock.phase("solver"):
        walls = Walls(scene, solver.points)
        priors = [_prior(scene, walls, group, dense, options.neighbours) for group in groups]
    density, noise, kept = _dense_rows(solver, dense, groups, priors, grid, run)
    fit = _Fit(solver, density, noise, evaluated, grid, run, options)
    counts, columns, values = [], [], []
    for group, (near, prior) in zip(groups, priors, strict=True):  # meshes follow each other, and so do rows
        corrected = fit.corrected(group, near, prior)
        present = near.ids >= 0
        counts.append(present.sum(axis=1))
        columns.append(near.ids[present])
        values.append(corrected[present])
    starts = row_starts(np.concatenate(counts))
    entries = np.concatenate(values), np.concatenate(columns), starts
    weights = scipy.sparse.csr_array(entries, shape=(len(scene.positions), len(dense.ids)))
    for file in kept:
        file.remove()
    factor = Upsampled(halved(density), grid.upsampling, solver.lighting)
    return Interpolated(factor, weights), len(dense.ids) * len(grid.texels) + fit.elements


def _dense_rows(
    solver: PathSolver,
    dense: Dense,
    groups: list[Neighbourhood],
    priors: list[tuple[Neighbours, NDArray[np.float32]]],
    grid: AngularGrid,
    run: Run,
) -> tuple[NDArray[np.float32], NDArray[np.float64], list[Checkpoint]]:
    """Indirect light (n_dense, n_grid, channels) of the dense vertices on the quarter grid, freed of noise by mesh.

    The mean variance of an element's estimate in each row, (n_dense,); and the files that keep finished rows.
    """
    density = np.empty((len(dense.ids), len(grid.texels), solver.channels), np.float32)
    noise, files = np.empty(len(dense.ids)), []
    for number, (group, prior) in enumerate(zip(groups, priors, strict=True)):
        chosen = dense.of_mesh(group.mesh)
        # other vertices would be dense for another fraction
        name, state = f"indirect {group.mesh.name}", f".{number}.{len(dense.ids)}"
        with run.clock.phase("dense_paths"):
            rows, kept = indirect_of(solver, dense.ids[chosen], grid.texels, run, name, state)
        files += [kept] if kept else []
        with run.clock.phase("low_rank"):
            noise[chosen] = rows.variance.mean(axis=(1, 2))
            smoothing = _smoothing(dense.ids[chosen] - group.mesh.vertices.start, chosen.start, *prior)
            for c in range(solver.channels):
                mean, variance = rows.mean[..., c], rows.variance[..., c]
                factors = _with_sums_of(mean, smooth_rows(denoise_rows(mean, variance), smoothing))
                np.matmul(*factors, out=density[chosen, :, c])
    return density, noise, files


def _smoothing(
    rows: NDArray[np.int64], first: int, near: Neighbours, prior: NDArray[np.float32]
) -> scipy.sparse.csr_array:
    """Weights (n, n) among the dense vertices of a mesh: those by which other vertices are interpolated.

    They are these rows of the mesh's neighbours, and the first one is ``first`` among all dense vertices.
    """
    ids, weights = near.ids[rows], prior[rows]
    present = ids >= 0
    starts = row_starts(present.sum(axis=1))
    entries = weights[present], ids[present] - first, starts
    return scipy.sparse.csr_array(entries, shape=(len(rows), len(rows)))


def _with_sums_of(
    rows: NDArray[np.float32], low_rank: DenoisedRows
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Factors of the matrix of low rank, and of what its sums lack, in the proportions of columns and rows.

    Shrinkage minimizes the error of elements, and takes light away. Sums hold little noise: a mesh gets what it should
    from every direction, a vertex what it should under even light.
    """
    left, right = low_rank.left, low_rank.right
    by_column, by_row = left.sum(axis=0) @ right, left @ right.sum(axis=1)
    total = float(by_row.sum())
    if total <= 0:
        return left, right
    of_rows, of_columns = rows.sum(axis=1) - by_row, rows.sum(axis=0) - by_column
    of_columns -= of_rows.sum() / total * by_column  # what the rows get is shared out among columns
    return (
        np.hstack([left, of_rows[:, None], by_row[:, None]]),
        np.vstack([right, by_column / total, of_columns / total]),
    )


def _prior(
    scene: Scene, walls: Walls, group: Neighbourhood, dense: Dense, count: int
) -> tuple[Neighbours, NDArray[np.float32]]:
    """Neighbours and weights (n, k) of all vertices of a mesh, the dense ones among them; none behind walls."""
    p, n, inside = scene.normalised_positions, scene.normals, group.mesh.vertices
    near = walls.without_hidden(np.arange(inside.start, inside.stop), group.near, dense.ids)
    near = Neighbours(near.ids[:, :count], near.distances[:, :count])
    return near, linear_weights(near, p[inside], n[inside], p[dense.ids], n[dense.ids])


class _Fit:
    """Corrects the weights of sparse vertices by samples of their own.

    Parameters
    ----------
    density : (n_dense, n_grid, channels) float32
        D.
    noise : (n_dense,) float64
        Mean variance of a row's elements. Samples are trusted by that of the dense neighbours: few samples which are
        too dark by chance have too small a variance of their own, and would count for more than those too bright.
    evaluated : bits
        Of these elements, those on the grid are path traced: no others are evaluated for it.

    Attributes
    ----------
    elements : int
        That were path traced.
    """

    def __init__(
        self,
        solver: PathSolver,
        density: NDArray[np.float32],
        noise: NDArray[np.float64],
        evaluated: Bits,
        grid: AngularGrid,
        run: Run,
        options: IndirectOptions,
    ) -> None:
        self._solver, self._noise, self._evaluated = solver, noise, evaluated
        self._run, self._clock, self._options = run, run.clock, options
        # [channel, dense vertex, place on the grid]
        self._rows = np.ascontiguousarray(np.moveaxis(density, 2, 0))
        self._place = np.full(solver.lighting.n_directions, -1, np.int32)
        self._place[grid.texels] = np.arange(len(grid.texels), dtype=np.int32)
        self.elements = 0

    def corrected(
        self, group: Neighbourhood, near: Neighbours, prior: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Weights (n, k) of all vertices of a mesh."""
        weights, start = prior.copy(), group.mesh.vertices.start
        order = np.argsort(mix(self._solver.points.keys[group.sparse]), kind="stable")
        pilot = np.sort(group.sparse[order[: self._options.pilot]])
        halves, noise = self._sampled(pilot, near.ids[pilot - start], prior[pilot - start], 2)
        with self._clock.phase("solver"):
            deviation = choose_deviation((halves[0], halves[1]), noise)
        if deviation == 0:
            return weights
        for ids in self._batches(group, pilot):
            if ids is not pilot:
                halves, noise = self._sampled(ids, near.ids[ids - start], prior[ids - start], 1)
            with self._clock.phase("solver"):
                system = sum(halves[1:], halves[0])
                weights[ids - start] += fit_correction(system, noise, deviation).astype(np.float32)
        return weights

    def _batches(self, group: Neighbourhood, pilot: NDArray[np.int64]) -> Iterator[NDArray[np.int64]]:
        """The pilot, and all other sparse vertices of a mesh in their order."""
        others = np.setdiff1d(group.sparse, pilot)
        yield pilot
        with self._run.bar(len(others), f"sparse {group.mesh.name}", " vertices") as bar:
            for a in range(0, len(others), BLOCK):
                yield others[a : a + BLOCK]
                bar.update(len(others[a : a + BLOCK]))

    def _sampled(
        self, ids: NDArray[np.int64], near: NDArray[np.int32], prior: NDArray[np.float32], parts: int
    ) -> tuple[list[System], NDArray[np.float64]]:
        """Systems of every so many samples of some vertices, and the noise of one sample of each, (n,)."""
        with self._clock.phase("system"):
            rows, texels = list_bits(self._evaluated[ids] & pack(self._place >= 0))
        with self._clock.phase("sparse_paths"):
            found = self._solver.elements(ids[rows].astype(np.uint32), texels)
        self.elements += len(rows)
        with self._clock.phase("system"):
            count = np.bincount(rows, minlength=len(ids))
            at = concatenate_ranges(np.zeros(len(ids), np.int64), count)[1]  # place of each sample in its row
            directions = np.full((len(ids), max(2, int(count.max(initial=0)))), -1, np.int32)
            directions[rows, at] = self._place[texels]
            values = np.zeros((self._solver.channels, *directions.shape), np.float32)
            values[:, rows, at] = found.mean.T
            present = near >= 0
            noise = (self._noise[near] * present).sum(axis=1) / np.maximum(present.sum(axis=1), 1)
            noise = np.maximum(noise, self._options.least_noise * self._noise.mean())
            return [
                self._system(directions[:, k::parts], values[:, :, k::parts], near, prior)
                for k in range(parts)
            ], noise

    def _system(
        self,
        directions: NDArray[np.int32],
        values: NDArray[np.float32],
        near: NDArray[np.int32],
        prior: NDArray[np.float32],
    ) -> System:
        """Channels share the weights: their systems add up."""
        taken, a = np.ascontiguousarray(directions), prior.astype(np.float64)
        count = (taken >= 0).sum(axis=1)
        systems = [
            shift_to_prior(a, *normal_equations(rows, near, taken, np.ascontiguousarray(y)), count)
            for rows, y in zip(self._rows, values, strict=True)
        ]
        return sum(systems[1:], systems[0])
