"""Errors of the direct part of a matrix against exact visibility: all rows and all columns, nothing is sampled."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.metrics import relative_l2_from_squares, relative_l2_of_rows, worst_rows
from mi_sparse_prt.operators.visibility import Visibility
from mi_sparse_prt.transport import LightTransport

BLOCK = 512  # rows at a time: tens of megabytes, and those of their dense vertices
LIT = 0.1  # of the largest norm: columns below it light next to nothing, their relative error says nothing


@dataclass(frozen=True)
class DirectError:
    """Squared errors and squared norms of direct transport, means over the channels.

    Attributes
    ----------
    rows, row_norms : (n_v,) float64
    columns, column_norms : dict
        Mesh name -> (n_directions,) float64, sums over the vertices of the mesh.
    meshes : dict
        Mesh name -> slice of its vertices.
    """

    rows: NDArray[np.float64]
    row_norms: NDArray[np.float64]
    columns: dict[str, NDArray[np.float64]]
    column_norms: dict[str, NDArray[np.float64]]
    meshes: dict[str, slice]

    def relative_l2(self, mesh: str) -> float:
        """Over the whole direct matrix of a mesh."""
        inside = self.meshes[mesh]
        return float(relative_l2_from_squares(self.rows[inside].sum(), self.row_norms[inside].sum()))

    def mean_square(self, mesh: str) -> float:
        """Mean squared error of an element of a mesh."""
        return float(self.rows[self.meshes[mesh]].mean()) / len(self.columns[mesh])

    def vertices(self) -> NDArray[np.float64]:
        """Relative L2 (n_v,) of every row."""
        relative = np.empty(len(self.rows))
        for inside in self.meshes.values():
            relative[inside] = relative_l2_of_rows(self.rows[inside], self.row_norms[inside])
        return relative

    def row_errors(self, mesh: str) -> dict[str, Any]:
        """95th percentile and maximum of the relative L2 of rows, and its vertex."""
        inside = self.meshes[mesh]
        errors = relative_l2_of_rows(self.rows[inside], self.row_norms[inside])
        return worst_rows(errors, np.arange(inside.start, inside.stop), "vertex")

    def column_errors(self, mesh: str) -> dict[str, Any]:
        """The same for columns (light from a single texel), of those that light the mesh."""
        lit = np.flatnonzero(self.column_norms[mesh] >= LIT**2 * self.column_norms[mesh].max())
        errors = relative_l2_of_rows(self.columns[mesh][lit], self.column_norms[mesh][lit])
        return worst_rows(errors, lit, "texel")


def direct_error(exact: Visibility, transport: LightTransport) -> DirectError:
    """Compare the direct part of a matrix, at all vertices and texels.

    Parameters
    ----------
    exact : Visibility
        All elements by ray tracing.
    transport : LightTransport
    """
    n, n_directions = transport.shape[:2]
    rows, norms = np.empty(n), np.empty(n)
    meshes = {mesh.name: mesh.vertices for mesh in transport.meshes}
    columns = {name: np.zeros(n_directions) for name in meshes}
    column_norms = {name: np.zeros(n_directions) for name in meshes}
    squared_albedo = np.square(transport.albedo).mean(axis=1)[:, None]
    for name, inside in meshes.items():
        for a in range(inside.start, inside.stop, BLOCK):
            ids = np.arange(a, min(a + BLOCK, inside.stop))
            truth = exact.rows(ids)[..., 0]
            square = squared_albedo[ids] * (transport.operators["direct"].rows(ids)[..., 0] - truth) ** 2
            norm = squared_albedo[ids] * truth**2
            rows[ids], norms[ids] = square.sum(axis=1, dtype=np.float64), norm.sum(axis=1, dtype=np.float64)
            columns[name] += square.sum(axis=0, dtype=np.float64)
            column_norms[name] += norm.sum(axis=0, dtype=np.float64)
    return DirectError(rows, norms, columns, column_norms, meshes)
