"""What the methods are measured against: exact direct light, converged indirect light, brute force's time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm.auto import tqdm

from mi_sparse_prt.benchmark.brute_force import RowsTime, time_rows
from mi_sparse_prt.benchmark.direct_error import BLOCK, DirectError, direct_error
from mi_sparse_prt.benchmark.exact_rows import trace_visibility
from mi_sparse_prt.benchmark.measuring import timed
from mi_sparse_prt.benchmark.sampled_norms import (
    MeanSquare,
    joint_relative_l2,
    mean_square,
    sampled_relative_l2,
)
from mi_sparse_prt.core.metrics import relative_l2_of_rows, worst_rows
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.measurement.vertices import vertex_points
from mi_sparse_prt.operators.operator import Operator
from mi_sparse_prt.operators.visibility import Visibility
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.solvers.adjoint_paths import AdjointSolver
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.paths import PathSolver
from mi_sparse_prt.solvers.problem import diffuse_problem
from mi_sparse_prt.transport import LightTransport

MAX_DEPTH = 5
SPP = 16
SEED = 1 << 30  # the methods' seeds are small

Doubles = NDArray[np.float64]
Halves = tuple[Doubles, Doubles]


@dataclass(frozen=True)
class ReferenceEffort:
    """How much of the indirect light a reference knows, and how well.

    Attributes
    ----------
    vertices : int
        At random, as many from each mesh.
    texels : int
        Of a vertex, at random: errors differ mostly between vertices.
    element_spp : int
        Paths of an element in each of two halves: 6144 leave noise below 0.3% of the matrix.
    rows, row_spp : int
        Whole rows, as many from each mesh, and paths of their elements in each half.
    """

    vertices: int = 10_000
    texels: int = 3
    element_spp: int = 6144
    rows: int = 96
    row_spp: int = 32


CONVERGED = ReferenceEffort()


@dataclass(frozen=True)
class KnownElements:
    """Indirect light of some elements of a mesh, in two independent halves.

    Attributes
    ----------
    ids, texels : (k,), (k, t) integers
    halves : two of (k, t, channels) float64
    """

    ids: NDArray[np.int64]
    texels: NDArray[np.int64]
    halves: Halves

    def square(self, indirect: Doubles) -> MeanSquare:
        """Squared errors of indirect light (k, t, channels), where direct light is exact."""
        x, y = (indirect - half for half in self.halves)
        return mean_square(0.0, np.zeros(1), x, y)


class Reference:
    """Transport of a scene: direct light at all elements, indirect light at some, in two independent halves.

    Parameters
    ----------
    scene : Scene
    lighting : CubemapLighting
    progress : bool
    effort : ReferenceEffort, optional

    Attributes
    ----------
    direct : Visibility
        Exact bits of all vertices.
    direct_seconds : float
        What they took, compilation left out.
    elements : dict
        Mesh name -> elements at which indirect light is known.
    """

    def __init__(
        self, scene: Scene, lighting: CubemapLighting, progress: bool, effort: ReferenceEffort = CONVERGED
    ) -> None:
        self.scene, self.lighting, self.points = scene, lighting, vertex_points(scene)
        self._problem = diffuse_problem(scene, lighting, MAX_DEPTH)
        self._meshes = {mesh.name: mesh.vertices for mesh in scene.meshes}
        self._sizes = {name: inside.stop - inside.start for name, inside in self._meshes.items()}
        self._albedo = scene.albedo[:, : 1 if scene.grey else 3].astype(np.float64)
        direct, everyone = DirectSolver(self._problem), np.arange(len(self.points), dtype=np.uint32)
        direct.rows(everyone[:16])  # compiles
        self.direct_seconds, bits = timed(trace_visibility, direct, everyone)
        self.direct = Visibility(bits, scene.normals, lighting)
        rng, every = np.random.default_rng(1), np.arange(lighting.n_directions)
        vertices = self._draw_vertices(effort.vertices, rng)
        texels = {
            name: rng.integers(len(every), size=(len(ids), effort.texels)) for name, ids in vertices.items()
        }
        self.elements = {
            name: self._trace(name, ids, texels[name], effort.element_spp, SEED, progress)
            for name, ids in vertices.items()
        }
        self._norms = {
            name: mean_square(self._direct_square(name), self._values(self.direct, known), *known.halves)
            for name, known in self.elements.items()
        }
        rows = self._draw_vertices(effort.rows, rng)
        self._rows = {
            name: self._trace(name, ids, np.tile(every, (len(ids), 1)), effort.row_spp, SEED + 2, progress)
            for name, ids in rows.items()
        }

    def paths(self, spp: int, seed: int) -> PathSolver:
        """A solver for indirect light at the scene's vertices."""
        return PathSolver(self._problem, spp, seed)

    def adjoint(self, spp: int) -> AdjointSolver:
        """Another one, for whole rows."""
        return AdjointSolver(self._problem, spp)

    def time_paths(self, spp: int) -> RowsTime:
        """Seconds of all indirect elements by so many paths each, a wavefront at a time."""
        solver = self.paths(spp, 0)
        return time_rows(solver, solver.block_size)

    def time_adjoint(self, spp: int) -> RowsTime:
        """Seconds of all indirect rows by the adjoint solver, in blocks of which all samples are traced together."""
        solver = self.adjoint(spp)
        return time_rows(solver, max(1, 2 * solver.block_size // solver.spp))

    # ------------------------------------------------------------------------------------------------- errors

    def noise(self) -> dict[str, Any]:
        """Relative L2 noise of the mean of both halves, in the form of ``relative_l2``."""
        return self._relative(
            {
                name: MeanSquare(0.0, (np.subtract(*known.halves) ** 2 / 4).mean(axis=(1, 2)))
                for name, known in self.elements.items()
            }
        )

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
        return self._relative({name: self._squares(name, transport, direct)[0] for name in self._meshes})

    def relative_l2_of_paths(self, spp: int) -> dict[str, Any]:
        """What brute force gives with so many paths, in the form of ``relative_l2``: its direct light is exact."""
        solver = self.paths(spp, 0)
        return self._relative(
            {
                name: known.square(self._trace_once(known.ids, known.texels, solver))
                for name, known in self.elements.items()
            }
        )

    def relative_l2_of_adjoint(self, spp: int) -> dict[str, Any]:
        """What exact direct light and adjoint rows of so many samples give, from the reference's whole rows."""
        solver = self.adjoint(spp)
        return self._relative(
            {
                name: known.square(self._per_texel(known.ids, known.texels, solver.rows(known.ids).mean))
                for name, known in self._rows.items()
            }
        )

    def errors(self, transport: LightTransport) -> tuple[dict[str, dict[str, Any]], DirectError]:
        """Errors per mesh (see ``measure_methods``), and all about those of the direct part."""
        direct, errors = direct_error(self.direct, transport), {}
        for name in self._meshes:
            total, indirect = (
                sampled_relative_l2(square, self._norms[name])
                for square in self._squares(name, transport, direct)
            )
            errors[name] = {
                "total": total[0],
                "direct": direct.relative_l2(name),
                "indirect": indirect[0],
                "standard_error": {"total": total[1], "indirect": indirect[1]},
                "rows": self._row_error(transport, name),
                "direct_rows": direct.row_errors(name),
                "direct_columns": direct.column_errors(name),
            }
        return errors, direct

    def _squares(
        self, name: str, transport: LightTransport, direct: DirectError
    ) -> tuple[MeanSquare, MeanSquare]:
        """Squared errors of the matrix of a mesh, and of its indirect part alone."""
        known = self.elements[name]
        indirect = self._values(transport.indirect, known)
        x, y = (indirect - half for half in known.halves)
        wrong = self._values(transport.direct, known) - self._values(self.direct, known)
        return mean_square(direct.mean_square(name), wrong, x, y), known.square(indirect)

    def _relative(self, squares: dict[str, MeanSquare]) -> dict[str, Any]:
        """Squared errors of all meshes in the form of ``relative_l2``."""
        norms = [self._norms[name] for name in squares]
        meshes = {name: sampled_relative_l2(square, self._norms[name]) for name, square in squares.items()}
        total = joint_relative_l2(list(squares.values()), norms, [self._sizes[name] for name in squares])
        return {
            "total": total[0],
            "meshes": {name: value for name, (value, _) in meshes.items()},
            "standard_error": {
                "total": total[1],
                "meshes": {name: deviation for name, (_, deviation) in meshes.items()},
            },
        }

    def _row_error(self, transport: LightTransport, name: str) -> dict[str, Any]:
        """95th percentile and maximum of the relative L2 of whole rows."""
        known = self._rows[name]
        exact, (x, y) = self._values(self.direct, known), known.halves
        ours = self._values(transport.direct, known) + self._values(transport.indirect, known)
        squares = ((ours - exact - x) * (ours - exact - y)).sum(axis=(1, 2))
        errors = relative_l2_of_rows(squares, ((exact + x) * (exact + y)).sum(axis=(1, 2)))
        return worst_rows(errors, known.ids, "vertex") | {"rows": len(known.ids)}

    # ------------------------------------------------------------------------------------- values of elements

    def _draw_vertices(self, count: int, rng: np.random.Generator) -> dict[str, NDArray[np.int64]]:
        """Mesh name -> some of its vertices, so many in all, or all that it has."""
        of_each = max(1, count // len(self._meshes))
        return {
            name: self._meshes[name].start + np.sort(rng.choice(n, min(n, of_each), replace=False))
            for name, n in self._sizes.items()
        }

    def _trace(
        self,
        name: str,
        ids: NDArray[np.int64],
        texels: NDArray[np.int64],
        spp: int,
        seed: int,
        progress: bool,
    ) -> KnownElements:
        """Indirect light of elements of a mesh, twice."""
        title = f"reference {name}" if progress else None
        x, y = (self._trace_once(ids, texels, self.paths(spp, seed + k), title) for k in (0, 1))
        return KnownElements(ids, texels, (x, y))

    def _trace_once(
        self, ids: NDArray[np.int64], texels: NDArray[np.int64], solver: PathSolver, title: str | None = None
    ) -> Doubles:
        """Indirect light (k, t, channels) of elements; a bar if there is a title."""
        parts, step = [], max(1, solver.block_elements // texels.shape[1])  # a wavefront
        for a in tqdm(range(0, len(ids), step), desc=title, disable=title is None):
            some = texels[a : a + step]
            mean = solver.elements(np.repeat(ids[a : a + step], some.shape[1]), some.ravel()).mean
            parts.append(mean.reshape(*some.shape, -1))
        return self._per_texel(ids, texels, np.concatenate(parts))

    def _per_texel(
        self, ids: NDArray[np.int64], texels: NDArray[np.int64], density: NDArray[np.floating]
    ) -> Doubles:
        """Elements of T from unit-albedo transport per solid angle (k, t, channels)."""
        solid_angles = self.lighting.solid_angles[texels].astype(np.float64)
        return self._albedo[ids][:, None] * (density * solid_angles[..., None])

    def _values(self, part: Operator | None, known: KnownElements) -> Doubles:
        """A part of a matrix at elements, (k, t, channels); 0 where there is none."""
        if part is None:
            return np.zeros((*known.texels.shape, 1))
        ids = np.repeat(known.ids, known.texels.shape[1])
        unit_albedo = part.elements(ids, known.texels.ravel()).reshape(*known.texels.shape, -1)
        return self._albedo[known.ids][:, None] * unit_albedo

    def _direct_square(self, name: str) -> float:
        """Mean square of the direct elements of a mesh."""
        total, inside = 0.0, self._meshes[name]
        for a in range(inside.start, inside.stop, BLOCK):
            ids = np.arange(a, min(a + BLOCK, inside.stop))
            squares = (self.direct.rows(ids)[..., 0] ** 2).sum(axis=1, dtype=np.float64)
            total += float(squares @ (self._albedo[ids] ** 2).mean(axis=1))
        return total / (self._sizes[name] * self.lighting.n_directions)
