"""What the sparse methods are measured against: exact direct light, converged indirect light, brute force's time."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm.auto import tqdm

from mi_sparse_prt.benchmark.direct_error import BLOCK, DirectError, direct_error, worst
from mi_sparse_prt.benchmark.estimates import MeanSquare, mean_square, relative_l2, row_errors
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.matrix import LightTransport, Part, Visibility
from mi_sparse_prt.measurement.vertices import vertex_points
from mi_sparse_prt.scene import Scene
from mi_sparse_prt.transport.direct import DirectTransport
from mi_sparse_prt.transport.path import PathTransport

MAX_DEPTH = 5
SPP = 16
VERTICES, TEXELS = 5000, 3  # per mesh and vertex, at random: errors differ mostly between vertices
ELEMENT_SPP = 6144  # of each of the two halves: noise below 0.3% of the matrix
ROWS, ROW_SPP = 48, 32  # whole rows per mesh; of each half
TIMED_ROWS, TIMED_BLOCKS = 64, 16  # at least, per mesh, by brute force
SEED = 1 << 30  # the methods' seeds are small

Halves = tuple[NDArray[np.float64], NDArray[np.float64]]


class Reference:
    """Transport of a scene: direct light at all elements, indirect light at some, in two independent halves.

    Parameters
    ----------
    scene : Scene
    lighting : CubemapLighting
    progress : bool

    Attributes
    ----------
    direct : Visibility
        Exact bits of all vertices.
    direct_seconds : float
        What they took, compilation left out.
    vertices, texels : dict
        Mesh name -> (k,) and (k, t) integers: elements at which indirect light is known.
    """

    def __init__(self, scene: Scene, lighting: CubemapLighting, progress: bool) -> None:
        self.scene, self.lighting, self.points = scene, lighting, vertex_points(scene)
        self._albedo = scene.albedo[:, : 1 if scene.grey else 3].astype(np.float64)
        bits, self.direct_seconds = self._direct()
        self.direct = Visibility(bits, scene.normals, lighting)
        self._direct_squares = {mesh.name: self._direct_square(mesh.vertices) for mesh in scene.meshes}
        rng = np.random.default_rng(1)
        self.vertices = {mesh.name: self._some(mesh.vertices, VERTICES, rng) for mesh in scene.meshes}
        self.texels = {
            name: rng.integers(lighting.n_directions, size=(len(ids), TEXELS))
            for name, ids in self.vertices.items()
        }
        self._halves = {
            name: (
                self._elements(name, ELEMENT_SPP, SEED, progress),
                self._elements(name, ELEMENT_SPP, SEED + 1, progress),
            )
            for name in self.vertices
        }
        self._rows = {mesh.name: self._some(mesh.vertices, ROWS, rng) for mesh in scene.meshes}
        self._row_halves = {name: self._whole_rows(name, progress) for name in self._rows}

    def paths(self, spp: int, seed: int) -> PathTransport:
        """A solver for indirect light at the scene's vertices."""
        channels = 1 if self.scene.grey else 3
        return PathTransport(
            self.scene.normalised, self.lighting, self.points, "direction", MAX_DEPTH, spp, channels, seed
        )

    @staticmethod
    def _some(inside: slice, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
        n = inside.stop - inside.start
        return inside.start + np.sort(rng.choice(n, min(n, count), replace=False))

    def _direct(self) -> tuple[NDArray[Any], float]:
        solver = DirectTransport(self.scene.normalised, self.lighting, self.points)
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
            weights = self.lighting.solid_angles.astype(np.float64)[:, None]
            found.append(self._reflected(ids, np.concatenate(rows) * weights))
        return found[0], found[1]

    def time_brute_force(self) -> dict[str, Any]:
        """Seconds that all elements would take, from blocks of rows as brute force meets them.

        Blocks lie at random places of a mesh, each as many successive vertices as fill a wavefront.
        """
        solver, rng = self.paths(SPP, 0), np.random.default_rng(2)
        solver.rows(np.arange(min(len(self.points), solver.block_size), dtype=np.uint32))  # compiles
        seconds, variance, rows = 0.0, 0.0, {}
        for mesh in self.scene.meshes:
            n, size = mesh.vertices.stop - mesh.vertices.start, solver.block_size
            starts = mesh.vertices.start + size * np.arange(n // size)
            count = max(TIMED_BLOCKS, -(-TIMED_ROWS // size))
            if len(starts) < count:  # the whole mesh
                starts, size = np.array([mesh.vertices.start]), n
            else:
                starts = np.sort(rng.choice(starts, count, replace=False))
            per_row = np.array([_seconds(solver, a, a + size) / size for a in starts])
            seconds += n * float(per_row.mean())
            variance += n**2 * float(per_row.var(ddof=1)) / len(per_row) if len(per_row) > 1 else 0.0
            rows[mesh.name] = size * len(starts)
        return {
            "direct_seconds": self.direct_seconds,
            "paths_seconds": seconds,
            "paths_seconds_standard_error": float(np.sqrt(variance)),
            "seconds": self.direct_seconds + seconds,
            "rows": rows,
        }

    def noise(self) -> dict[str, float]:
        """Relative L2 noise of the mean of both halves, per mesh."""
        noise = {}
        for name, (x, y) in self._halves.items():
            norm = self._norm(name).value
            noise[name] = float(np.sqrt(((x - y) ** 2).mean() / 4 / norm)) if norm else 0.0
        return noise

    def brute_force_errors(self) -> dict[str, dict[str, Any]]:
        """Relative L2 per mesh of what brute force gives: its direct light is exact, its indirect light noisy."""
        found = {}
        for name in self.vertices:
            indirect = self._elements(name, SPP, 0, progress=False)
            x, y = (indirect - half for half in self._halves[name])
            error = mean_square(0.0, np.zeros_like(x), x, y)
            value, deviation = relative_l2(error, self._norm(name))
            found[name] = {
                "total": value,
                "direct": 0.0,
                "indirect": value,
                "standard_error": {"total": deviation, "indirect": deviation},
            }
        return found

    def errors(self, transport: LightTransport) -> tuple[dict[str, dict[str, Any]], DirectError]:
        """Errors per mesh (see ``measure_methods``), and all about those of the direct part."""
        direct, found = direct_error(self.direct, transport), {}
        for name, ids in self.vertices.items():
            texels = self.texels[name]
            wrong = self._reflected(ids, _elements_of(transport.direct, ids, texels)) - self._exact(name)
            indirect = self._reflected(ids, _elements_of(transport.indirect, ids, texels))
            x, y = (indirect - half for half in self._halves[name])
            norm = self._norm(name)
            total = relative_l2(
                mean_square(direct.mean_square(name), np.broadcast_to(wrong, x.shape), x, y), norm
            )
            alone = relative_l2(mean_square(0.0, np.zeros_like(x), x, y), norm)
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

    def _exact(self, name: str) -> NDArray[np.float64]:
        """Direct light at the elements of a mesh, (k, t, channels)."""
        ids = self.vertices[name]
        return self._reflected(ids, _elements_of(self.direct, ids, self.texels[name]))

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
        ours = self._reflected(ids, transport.direct.rows(ids))
        if transport.indirect is not None:
            ours = ours + self._reflected(ids, transport.indirect.rows(ids))
        squares = ((ours - exact - x) * (ours - exact - y)).sum(axis=(1, 2))
        relative = row_errors(squares, ((exact + x) * (exact + y)).sum(axis=(1, 2)))
        found = worst(relative, 0, "vertex")
        return found | {"vertex": int(ids[found["vertex"]]), "rows": len(ids)}


def _elements_of(part: Part | None, ids: NDArray[np.int64], texels: NDArray[np.int64]) -> NDArray[np.float32]:
    """White elements (k, t, channels) of vertices (k,) at their texels (k, t); 0 where there is no such part."""
    if part is None:
        return np.zeros((*texels.shape, 1), np.float32)
    blocks = [slice(a, a + ROWS) for a in range(0, len(ids), ROWS)]  # rows may be made of many dense ones
    found = [np.take_along_axis(part.rows(ids[b]), texels[b][..., None], axis=1) for b in blocks]
    return np.concatenate(found)


def _seconds(solver: PathTransport, start: int, stop: int) -> float:
    """Time of the rows [start, stop)."""
    begin = time.perf_counter()
    for a in range(start, stop, solver.block_size):
        solver.rows(np.arange(a, min(a + solver.block_size, stop), dtype=np.uint32))
    return time.perf_counter() - begin
