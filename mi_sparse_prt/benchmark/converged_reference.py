"""What the methods are measured against: exact direct light, converged indirect light, brute force's time."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm.auto import tqdm

from mi_sparse_prt.benchmark.brute_force_time import RowsTime, time_rows
from mi_sparse_prt.benchmark.direct_error import BLOCK, DirectError, direct_error, worst
from mi_sparse_prt.benchmark.estimates import (
    MeanSquare,
    joint_relative_l2,
    mean_square,
    relative_l2,
    row_errors,
)
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.measurement.vertices import vertex_points
from mi_sparse_prt.operators.operator import Operator
from mi_sparse_prt.operators.visibility import Visibility
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.solvers.adjoint_paths import AdjointSolver
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.paths import PathSolver
from mi_sparse_prt.transport import LightTransport

MAX_DEPTH = 5
SPP = 16
VERTICES = 10_000  # at random, as many from each mesh
TEXELS = 3  # of a vertex, at random: errors differ mostly between vertices
ELEMENT_SPP = 6144  # of each of the two halves: noise below 0.3% of the matrix
ROWS, ROW_SPP = 96, 32  # whole rows, as many from each mesh; of each half
SEED = 1 << 30  # the methods' seeds are small

Halves = tuple[NDArray[np.float64], NDArray[np.float64]]


class Reference:
    """Transport of a scene: direct light at all elements, indirect light at some, in two independent halves.

    Parameters
    ----------
    scene : Scene
    lighting : CubemapLighting
    progress : bool
    spp : int, optional
        Paths per element of each half, 6144 if not given; with fewer it is done sooner, and noisier.

    Attributes
    ----------
    direct : Visibility
        Exact bits of all vertices.
    direct_seconds : float
        What they took, compilation left out.
    vertices, texels : dict
        Mesh name -> (k,) and (k, t) integers: elements at which indirect light is known.
    """

    def __init__(
        self, scene: Scene, lighting: CubemapLighting, progress: bool, spp: int | None = None
    ) -> None:
        self.scene, self.lighting, self.points = scene, lighting, vertex_points(scene)
        self._albedo = scene.albedo[:, : 1 if scene.grey else 3].astype(np.float64)
        bits, self.direct_seconds = self._direct()
        self.direct = Visibility(bits, scene.normals, lighting)
        self._direct_squares = {mesh.name: self._direct_square(mesh.vertices) for mesh in scene.meshes}
        rng = np.random.default_rng(1)
        self.vertices = self._some_of_each(VERTICES, rng)
        self.texels = {
            name: rng.integers(lighting.n_directions, size=(len(ids), TEXELS))
            for name, ids in self.vertices.items()
        }
        self._halves = {
            name: (
                self._elements(name, spp or ELEMENT_SPP, SEED, progress),
                self._elements(name, spp or ELEMENT_SPP, SEED + 1, progress),
            )
            for name in self.vertices
        }
        self._rows = self._some_of_each(ROWS, rng)
        self._row_halves = {name: self._whole_rows(name, progress) for name in self._rows}

    def paths(self, spp: int, seed: int) -> PathSolver:
        """A solver for indirect light at the scene's vertices."""
        return PathSolver(*self._problem(spp, seed))

    def adjoint(self, spp: int) -> AdjointSolver:
        """Another one, for whole rows."""
        return AdjointSolver(*self._problem(spp, 0))

    def _problem(self, spp: int, seed: int) -> tuple[Any, ...]:
        channels = 1 if self.scene.grey else 3
        return self.scene.normalised, self.lighting, self.points, "direction", MAX_DEPTH, spp, channels, seed

    def _some_of_each(self, count: int, rng: np.random.Generator) -> dict[str, NDArray[np.int64]]:
        """Mesh name -> some of its vertices, so many in all, or all that it has."""
        of_each, found = max(1, count // len(self.scene.meshes)), {}
        for mesh in self.scene.meshes:
            n = mesh.vertices.stop - mesh.vertices.start
            chosen = rng.choice(n, min(n, of_each), replace=False)
            found[mesh.name] = mesh.vertices.start + np.sort(chosen)
        return found

    def _direct(self) -> tuple[NDArray[Any], float]:
        solver = DirectSolver(self.scene.normalised, self.lighting, self.points)
        stored = solver.row_storage(len(self.points))
        solver.rows(np.arange(min(16, len(stored)), dtype=np.uint32))  # compiles
        start = time.perf_counter()
        for a in range(0, len(stored), solver.block_size):
            ids = np.arange(a, min(a + solver.block_size, len(stored)), dtype=np.uint32)
            stored[a : a + len(ids)] = solver.rows(ids)
        return stored, time.perf_counter() - start

    def _elements(self, name: str, spp: int, seed: int, progress: bool) -> NDArray[np.float64]:
        """Indirect light (k, t, channels) of the chosen elements of a mesh."""
        ids, texels, solver = self.vertices[name], self.texels[name], self.paths(spp, seed)
        parts, step = [], max(1, solver.block_elements // texels.shape[1])  # a wavefront
        for a in tqdm(range(0, len(ids), step), desc=f"reference {name}", disable=not progress):
            some = texels[a : a + step]
            mean = solver.elements(np.repeat(ids[a : a + step], some.shape[1]), some.ravel()).mean
            parts.append(mean.reshape(*some.shape, -1))
        solid_angles = self.lighting.solid_angles[texels].astype(np.float64)[..., None]
        return self._reflected(ids, np.concatenate(parts) * solid_angles)

    def _reflected(self, ids: NDArray[np.int64], white: NDArray[np.floating]) -> NDArray[np.float64]:
        """What vertices (k,) send out, (k, t, channels), of white transport (k, t, 1 or channels)."""
        return self._albedo[ids][:, None] * white

    def _whole_rows(self, name: str, progress: bool) -> Halves:
        """Indirect light (k, n_directions, channels) of the chosen rows of a mesh, twice."""
        ids, found = self._rows[name], []
        for seed in (SEED + 2, SEED + 3):
            solver = self.paths(ROW_SPP, seed)
            blocks = range(0, len(ids), solver.block_size)
            bar = tqdm(blocks, desc=f"reference rows {name}", disable=not progress)
            rows = [solver.rows(ids[a : a + solver.block_size]).mean for a in bar]
            found.append(self._sent_out(ids, np.concatenate(rows)))
        return found[0], found[1]

    def _sent_out(self, ids: NDArray[np.int64], rows: NDArray[np.float32]) -> NDArray[np.float64]:
        """What vertices (k,) send out, of white transport per solid angle, (k, n_directions, channels)."""
        return self._reflected(ids, rows * self.lighting.solid_angles.astype(np.float64)[:, None])

    def time_brute_force(self) -> dict[str, Any]:
        """Seconds that all elements would take with as many paths each as the methods have."""
        paths = self.time_paths(SPP)
        return {
            "direct_seconds": self.direct_seconds,
            "paths_seconds": paths.seconds,
            "paths_seconds_standard_error": paths.standard_error,
            "seconds": self.direct_seconds + paths.seconds,
            "rows": paths.rows,
        }

    def time_paths(self, spp: int) -> RowsTime:
        """Seconds of all indirect elements by so many paths each, a wavefront at a time."""
        solver = self.paths(spp, 0)
        return time_rows(solver, solver.block_size)

    def time_adjoint(self, spp: int) -> RowsTime:
        """Seconds of all indirect rows by the adjoint solver, in blocks of which all samples are traced together."""
        solver = self.adjoint(spp)
        return time_rows(solver, max(1, 2 * solver.block_size // solver.spp))

    def noise(self) -> dict[str, float]:
        """Relative L2 noise of the mean of both halves, per mesh."""
        noise = {}
        for name, (x, y) in self._halves.items():
            norm = self._norm(name).value
            noise[name] = float(np.sqrt(((x - y) ** 2).mean() / 4 / norm)) if norm else 0.0
        return noise

    def total_noise(self) -> float:
        """The same for all meshes together."""
        square, norm = 0.0, 0.0
        for name, (x, y) in self._halves.items():
            square += self._size(name) * float(((x - y) ** 2).mean()) / 4
            norm += self._size(name) * self._norm(name).value
        return float(np.sqrt(square / norm)) if norm else 0.0

    def brute_force_errors(self) -> dict[str, dict[str, Any]]:
        """Relative L2 per mesh of what brute force gives: its direct light is exact, its indirect light noisy."""
        found = {}
        for name in self.vertices:
            value, deviation = relative_l2(self._noise_of_paths(name, SPP), self._norm(name))
            found[name] = {
                "total": value,
                "direct": 0.0,
                "indirect": value,
                "standard_error": {"total": deviation, "indirect": deviation},
            }
        return found

    def relative_l2_of_paths(self, spp: int) -> dict[str, Any]:
        """What brute force gives with so many paths, in the form of ``relative_l2``."""
        return self._relative({name: self._noise_of_paths(name, spp) for name in self.vertices})

    def relative_l2_of_adjoint(self, spp: int) -> dict[str, Any]:
        """What exact direct light and adjoint rows of so many samples give, from the reference's whole rows."""
        solver, squares = self.adjoint(spp), {}
        for name, ids in self._rows.items():
            rows = self._sent_out(ids, solver.rows(ids).mean)
            squares[name] = self._square_of(rows, self._row_halves[name])
        return self._relative(squares)

    def relative_l2(self, transport: LightTransport) -> dict[str, Any]:
        """Relative L2 of a matrix.

        Parameters
        ----------
        transport : LightTransport

        Returns
        -------
        dict
            ``total`` (all meshes together), ``meshes`` (name -> relative L2), and ``standard_error``, which has
            both again. The form of ``report["estimated_error"]``.
        """
        direct = direct_error(self.direct, transport)
        return self._relative({name: self._squares(name, transport, direct)[0] for name in self.vertices})

    def errors(self, transport: LightTransport) -> tuple[dict[str, dict[str, Any]], DirectError]:
        """Errors per mesh (see ``measure_methods``), and all about those of the direct part."""
        direct, found = direct_error(self.direct, transport), {}
        for name in self.vertices:
            total, alone = (
                relative_l2(square, self._norm(name)) for square in self._squares(name, transport, direct)
            )
            found[name] = {
                "total": total[0],
                "direct": direct.relative_l2(name),
                "indirect": alone[0],
                "standard_error": {"total": total[1], "indirect": alone[1]},
                "rows": self._row_error(transport, name),
                "direct_rows": direct.worst_rows(name),
                "direct_columns": direct.worst_columns(name),
            }
        return found, direct

    def _squares(
        self, name: str, transport: LightTransport, direct: DirectError
    ) -> tuple[MeanSquare, MeanSquare]:
        """Squared errors of the matrix of a mesh, and of its indirect part alone."""
        indirect = self._at_elements(transport.operators.get("indirect"), name)
        x, y = (indirect - half for half in self._halves[name])
        wrong = self._at_elements(transport.operators["direct"], name) - self._exact(name)
        total = mean_square(direct.mean_square(name), np.broadcast_to(wrong, x.shape), x, y)
        return total, self._square_of(indirect, self._halves[name])

    def _noise_of_paths(self, name: str, spp: int) -> MeanSquare:
        return self._square_of(self._elements(name, spp, 0, progress=False), self._halves[name])

    @staticmethod
    def _square_of(indirect: NDArray[np.float64], halves: Halves) -> MeanSquare:
        """Squared errors of indirect light (k, ..., channels), where direct light is exact."""
        x, y = (indirect - half for half in halves)
        return mean_square(0.0, np.zeros_like(x), x, y)

    def _relative(self, squares: dict[str, MeanSquare]) -> dict[str, Any]:
        """Squared errors of all meshes in the form of ``relative_l2``."""
        norms = {name: self._norm(name) for name in squares}
        meshes = {name: relative_l2(square, norms[name]) for name, square in squares.items()}
        total = joint_relative_l2(
            list(squares.values()), list(norms.values()), [self._size(name) for name in squares]
        )
        return {
            "total": total[0],
            "meshes": {name: value for name, (value, _) in meshes.items()},
            "standard_error": {
                "total": total[1],
                "meshes": {name: deviation for name, (_, deviation) in meshes.items()},
            },
        }

    def _size(self, name: str) -> int:
        """Vertices of a mesh."""
        inside = next(mesh.vertices for mesh in self.scene.meshes if mesh.name == name)
        return int(inside.stop - inside.start)

    def _at_elements(self, part: Operator | None, name: str) -> NDArray[np.float64]:
        """What a part of a matrix sends out at the elements of a mesh, (k, t, channels); 0 where there is none."""
        ids, texels = self.vertices[name], self.texels[name]
        if part is None:
            return np.zeros((*texels.shape, 1))
        white = part.elements(np.repeat(ids, texels.shape[1]), texels.ravel())
        return self._reflected(ids, white.reshape(*texels.shape, -1))

    def _exact(self, name: str) -> NDArray[np.float64]:
        """Direct light at the elements of a mesh, (k, t, channels)."""
        return self._at_elements(self.direct, name)

    def _norm(self, name: str) -> MeanSquare:
        exact, (x, y) = self._exact(name), self._halves[name]
        return mean_square(self._direct_squares[name], np.broadcast_to(exact, x.shape), x, y)

    def _direct_square(self, inside: slice) -> float:
        """Mean square of the direct elements of a mesh."""
        total = 0.0
        for a in range(inside.start, inside.stop, BLOCK):
            ids = np.arange(a, min(a + BLOCK, inside.stop))
            squares = (self.direct.rows(ids)[..., 0] ** 2).sum(axis=1, dtype=np.float64)
            total += float(squares @ (self._albedo[ids] ** 2).mean(axis=1))
        return total / ((inside.stop - inside.start) * self.lighting.n_directions)

    def _row_error(self, transport: LightTransport, name: str) -> dict[str, Any]:
        """95th percentile and maximum of the relative L2 of whole rows."""
        ids, (x, y) = self._rows[name], self._row_halves[name]
        exact = self._reflected(ids, self.direct.rows(ids))
        ours = sum(self._reflected(ids, operator.rows(ids)) for operator in transport.operators.values())
        squares = ((ours - exact - x) * (ours - exact - y)).sum(axis=(1, 2))
        relative = row_errors(squares, ((exact + x) * (exact + y)).sum(axis=(1, 2)))
        found = worst(relative, 0, "vertex")
        return found | {"vertex": int(ids[found["vertex"]]), "rows": len(ids)}
