"""Time and error of the sparse methods against brute force and a converged reference ([HR10] Figures 9, 10 and 12)."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.benchmark.machine import describe_machine
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.errors import PrtError
from mi_sparse_prt.matrix import LightTransport, Visibility
from mi_sparse_prt.measurement.vertices import vertex_points
from mi_sparse_prt.precompute import precompute
from mi_sparse_prt.scene import Scene
from mi_sparse_prt.transport.direct import DirectTransport
from mi_sparse_prt.transport.path import PathTransport

MAX_DEPTH = 5
SPP = 16
BRUTE_FORCE_ROWS = 64  # per mesh, path traced whole: the others would take as long
VERTICES, TEXELS = 300, 48  # per mesh and vertex, of the reference
REFERENCE_SPP = 2048  # of each of its two halves
BLOCK = 4096
RAYS_AND_PATHS = ("dense_rays", "sparse_rays", "dense_paths", "sparse_paths")


def measure_methods(
    scene: Scene, lighting: CubemapLighting, methods: list[str], progress: bool = True
) -> dict[str, Any]:
    """Run methods on a scene, direct light and three interreflections, 16 paths per element.

    Parameters
    ----------
    scene : Scene
    lighting : CubemapLighting
    methods : list of str
        Of ``precompute``, without brute force.
    progress : bool

    Returns
    -------
    dict
        ``brute_force``: ``direct_seconds`` (whole matrix), ``paths_seconds`` (from ``rows`` random whole rows of each
        mesh, weighted by its vertices) and their sum. ``reference_noise`` per mesh, relative L2. For each of
        ``methods``: ``seconds`` per phase, ``ratio`` to brute force, ``overhead`` (all that is no ray or path, as a
        share of its own time, and in microseconds per sparse vertex), ``elements`` (share of all), ``sampling`` rates
        per mesh, and relative L2 ``errors`` per mesh: ``total``, ``direct`` and ``indirect``, all relative to the
        whole matrix of the mesh but the direct one, which is relative to the direct matrix. JSON as it is.

    Raises
    ------
    PrtError
        If a method is unknown or brute force itself.
    """
    for method in methods:
        if method not in ("sparse", "huang2010"):
            raise PrtError(
                f"method {method!r} cannot be compared with brute force; choose sparse or huang2010"
            )
    reference = _Reference(scene, lighting)
    brute_force = reference.time_brute_force()
    report: dict[str, Any] = {
        "machine": describe_machine(),
        "scene": {
            "path": scene.path,
            "vertices": len(scene.positions),
            "directions": lighting.n_directions,
        },
        "brute_force": brute_force,
        "reference_noise": reference.noise(),
        "methods": {},
    }
    for method in methods:
        transport = precompute(scene, lighting, method, max_depth=MAX_DEPTH, spp=SPP, progress=progress)
        report["methods"][method] = _summary(transport, brute_force["seconds"], reference)
    return report


def _summary(transport: LightTransport, brute_force: float, reference: _Reference) -> dict[str, Any]:
    made = transport.report
    seconds = made["seconds"]
    rays = sum(seconds.get(name, 0.0) for name in RAYS_AND_PATHS)
    own = seconds["total"] - seconds["held_out"]  # validation, which brute force would need as well
    total = made["elements_total"]
    sparse = sum(
        (1 - rates["dense_vertices"]) * (mesh.vertices.stop - mesh.vertices.start)
        for mesh, rates in zip(transport.meshes, made["sampling"].values(), strict=True)
    )
    return {
        "seconds": seconds,
        "ratio": own / brute_force,
        "overhead": {"share": 1 - rays / own, "microseconds_per_sparse_vertex": 1e6 * (own - rays) / sparse},
        "elements": made["elements_evaluated"] / total,
        "elements_of_parts": {name: count / total for name, count in made["elements"].items()},
        "rays": made["rays"],
        "sampling": made["sampling"],
        "errors": reference.errors(transport),
        "estimated_error": made["estimated_error"],
        "stored_bytes": transport.nbytes,
    }


class _Reference:
    """The exact direct matrix, and converged indirect light at random elements, in two independent halves."""

    def __init__(self, scene: Scene, lighting: CubemapLighting) -> None:
        self.scene, self.lighting, self.points = scene, lighting, vertex_points(scene)
        self.solver = DirectTransport(scene.normalised, lighting, self.points)
        bits, self.direct_seconds = self._direct()
        self.direct = Visibility(bits, scene.normals, lighting)
        rng = np.random.default_rng(1)
        self.vertices, self.texels = [], []
        for mesh in scene.meshes:
            n = mesh.vertices.stop - mesh.vertices.start
            ids = mesh.vertices.start + np.sort(rng.choice(n, min(n, VERTICES), replace=False))
            self.vertices.append(ids)
            self.texels.append(rng.integers(lighting.n_directions, size=(len(ids), TEXELS)))
        self.halves = [self._indirect(1 << 30), self._indirect((1 << 30) + 1)]

    def _direct(self) -> tuple[NDArray[Any], float]:
        stored = self.solver.row_storage(len(self.points))
        self.solver.rows(np.arange(min(16, len(stored)), dtype=np.uint32))  # compiles
        start = time.perf_counter()
        for a in range(0, len(stored), self.solver.block_size):
            ids = np.arange(a, min(a + self.solver.block_size, len(stored)), dtype=np.uint32)
            stored[a : a + len(ids)] = self.solver.rows(ids)
        return stored, time.perf_counter() - start

    def _paths(self, spp: int, seed: int) -> PathTransport:
        channels = 1 if self.scene.grey else 3
        return PathTransport(
            self.scene.normalised, self.lighting, self.points, "direction", MAX_DEPTH, spp, channels, seed
        )

    def _indirect(self, seed: int) -> list[NDArray[np.float64]]:
        """White indirect light per mesh, (k, t, channels)."""
        solver, found = self._paths(REFERENCE_SPP, seed), []
        for ids, texels in zip(self.vertices, self.texels, strict=True):
            mean = solver.elements(np.repeat(ids, TEXELS), texels.ravel()).mean
            weights = self.lighting.solid_angles[texels][..., None]
            found.append(mean.reshape(*texels.shape, -1).astype(np.float64) * weights)
        return found

    def time_brute_force(self) -> dict[str, Any]:
        """Seconds that all elements would take."""
        solver, rng, seconds = self._paths(SPP, 0), np.random.default_rng(2), []
        for mesh in self.scene.meshes:
            n = mesh.vertices.stop - mesh.vertices.start
            count = min(n, BRUTE_FORCE_ROWS)
            ids = np.sort(mesh.vertices.start + rng.choice(n, count, replace=False)).astype(np.uint32)
            solver.rows(ids)  # compiles, and warms up
            start = time.perf_counter()
            for a in range(0, count, solver.block_size):
                solver.rows(ids[a : a + solver.block_size])
            seconds.append(n / count * (time.perf_counter() - start))
        return {
            "direct_seconds": self.direct_seconds,
            "paths_seconds": sum(seconds),
            "seconds": self.direct_seconds + sum(seconds),
            "rows": BRUTE_FORCE_ROWS,
        }

    def noise(self) -> dict[str, float]:
        """Relative L2 noise of the mean of both halves, per mesh."""
        noise = {}
        for k, mesh in enumerate(self.scene.meshes):
            x, y = self.halves[0][k], self.halves[1][k]
            noise[mesh.name] = float(np.sqrt(((x - y) ** 2).mean() / 4 / self._square(k)))
        return noise

    def _exact(self, k: int) -> NDArray[np.float32]:
        """White direct light at the elements of mesh k, (n, t, 1)."""
        rows = self.direct.rows(self.vertices[k])
        return np.take_along_axis(rows, self.texels[k][..., None], axis=1)

    def _square(self, k: int) -> float:
        """Mean square of the elements of mesh k, free of noise."""
        exact = self._exact(k)
        return float(((exact + self.halves[0][k]) * (exact + self.halves[1][k])).mean())

    def errors(self, transport: LightTransport) -> dict[str, dict[str, float]]:
        """Relative L2 errors per mesh; noise of the reference taken out by its two halves."""
        found = {}
        for k, mesh in enumerate(self.scene.meshes):
            ids, texels = self.vertices[k], self.texels[k][..., None]
            indirect: NDArray[np.floating] = np.zeros(1)
            if transport.indirect is not None:
                indirect = np.take_along_axis(transport.indirect.rows(ids), texels, axis=1)
            direct = np.take_along_axis(transport.direct.rows(ids), texels, axis=1) - self._exact(k)
            x, y = (indirect - half[k] for half in self.halves)
            parts = {"total": (direct + x) * (direct + y), "indirect": x * y}
            found[mesh.name] = {
                name: float(np.sqrt(max(square.mean(), 0) / self._square(k)))
                for name, square in parts.items()
            }
            found[mesh.name]["direct"] = self._direct_error(transport, mesh.vertices)
        return found

    def _direct_error(self, transport: LightTransport, inside: slice) -> float:
        """Relative L2 of the direct part over all vertices of a mesh."""
        error = norm = 0.0
        for a in range(inside.start, inside.stop, BLOCK):
            ids = np.arange(a, min(a + BLOCK, inside.stop))
            exact = self.direct.rows(ids)
            error += float(((transport.direct.rows(ids) - exact) ** 2).sum())
            norm += float((exact**2).sum())
        return float(np.sqrt(error / norm)) if norm else 0.0
