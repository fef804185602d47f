"""Visibility by consensus: rays are traced where neighbouring vertices disagree, and bits are copied where they agree.

Vertices become known in levels, each some times as dense as the one before: the nearer the neighbours that are asked,
the fewer directions they disagree about. What the first level knows was sampled adaptively in angle ([HR10] 4.2).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.bits import above_horizon, list_bits, overwrite_bits
from mi_sparse_prt.core.morton import morton_order
from mi_sparse_prt.measurement.neighbours import renumber, surface_neighbours
from mi_sparse_prt.sampling.angular import AngularGrid
from mi_sparse_prt.sampling.features import copy_agreed, find_contested

Ids = NDArray[np.int64]
Trace = Callable[[NDArray[np.uint32], NDArray[np.uint32]], NDArray[np.bool_]]
LeaveFewer = Callable[[int, Ids, NDArray[np.int32]], NDArray[np.bool_]]


@dataclass(frozen=True)
class ConsensusOptions:
    """How vertices become known.

    Attributes
    ----------
    strides : tuple of int
        One vertex in so many is known after each level; each divides the one before, and the last is 1. [HR10] 4.1 has
        two levels, dense and sparse vertices.
    neighbours : int
        Known vertices that are asked. On a bumpy sphere, of whose vertices a quarter were known in a single level, 8
        left 11.6% of all elements to be traced, at an error of 4.9%; 12 left 12.6%, at 3.7%.
    least_neighbours : int
        With fewer on its own surface, or none of them on its side of walls, a vertex is sampled as those of the first
        level.
    repair_neighbours : int
        Of all vertices, asked again at the end.
    block : int
        Vertices at a time, some hundred rays each.
    """

    strides: tuple[int, ...] = (12, 4, 2, 1)
    neighbours: int = 8
    least_neighbours: int = 3
    repair_neighbours: int = 8
    block: int = 1 << 14


class Consensus:
    """Visibility of the vertices of a scene as it becomes known.

    Parameters
    ----------
    normals : (n_v, 3) float32
        In the frame of the lighting.
    grid : AngularGrid
    trace : callable
        ``trace(vertices, texels)``, both (m,) uint32: whether vertices see the centres of texels, (m,) bool.
    options : ConsensusOptions

    Attributes
    ----------
    visible, evaluated, above : (n_v, words) uint32 bits
        As in ``DenseRows``.
    """

    def __init__(
        self,
        normals: NDArray[np.float32],
        grid: AngularGrid,
        trace: Trace,
        options: ConsensusOptions | None = None,
    ) -> None:
        self._grid, self._trace, self._normals = grid, trace, normals
        self.options = options or ConsensusOptions()
        self.above = above_horizon(normals, grid.lighting.directions)
        self.visible, self.evaluated = np.zeros_like(self.above), np.zeros_like(self.above)
        self._sampled: list[Ids] = []

    @property
    def sampled_themselves(self) -> NDArray[np.int64]:
        """Vertices (k,) that asked no neighbours, ascending."""
        return np.sort(np.concatenate([np.zeros(0, np.int64), *self._sampled]))

    def sample(self, vertices: Ids) -> None:
        """Sample rows adaptively in angle."""
        ids = vertices.astype(np.uint32)
        rows = self._grid.sample(self._normals[vertices], lambda r, t: self._trace(ids[r], t))
        self.visible[vertices], self.evaluated[vertices] = rows.visible, rows.evaluated
        self._sampled.append(vertices)

    def agree(self, vertices: Ids, near: NDArray[np.int32]) -> None:
        """Give vertices (n,) what their neighbours (n, k) agree on, and traced rays elsewhere.

        Neighbours are vertices whose rows are known, -1 where there are fewer.
        """
        copy_agreed(near, self.visible, self.above, vertices, self.above, self.visible)
        self.repair(vertices, near)

    def repair(self, vertices: Ids, near: NDArray[np.int32]) -> None:
        """Trace where neighbours (n, k) of vertices (n,) disagree, and no ray has been traced.

        All are compared before any is changed: the order of vertices and the size of blocks do not matter.
        """
        asked = find_contested(near, self.visible, self.above, vertices, self.above, self.evaluated)
        block = self.options.block
        for a in range(0, len(vertices), block):
            some, bits = vertices[a : a + block], asked[a : a + block]
            rows, texels = list_bits(bits)
            values = self._trace(some.astype(np.uint32)[rows], texels)
            overwrite_bits(self.visible, self.evaluated, some, bits, values)


@dataclass(frozen=True)
class Surface:
    """A mesh, on which vertices have neighbours.

    Attributes
    ----------
    first : int
        Of its vertices, which follow each other.
    positions, normals : (n, 3) float
    keys : (n,) uint64
        Of the vertices (``Points.keys``).
    """

    first: int
    positions: NDArray[np.floating]
    normals: NDArray[np.floating]
    keys: NDArray[np.uint64]

    def levels(self, strides: tuple[int, ...]) -> list[Ids]:
        """Its vertices (counted from 0) in levels, each spread evenly; independent of the order in which they come.

        After each level, one vertex in as many as its stride is in this level or one before.
        """
        order = morton_order(self.positions, self.keys)
        level = np.full(len(order), len(strides) - 1)
        for number, stride in reversed(list(enumerate(strides))):
            level[::stride] = number
        return [order[level == number] for number in range(len(strides))]


def sample_by_levels(state: Consensus, surface: Surface, walls_leave_fewer: LeaveFewer) -> None:
    """Make the rows of a mesh known, level by level, and repair them.

    Parameters
    ----------
    state : Consensus
    surface : Surface
    walls_leave_fewer : callable
        ``walls_leave_fewer(least, vertices, neighbours)``: which vertices (n,) have fewer than so many of their
        neighbours (n, k), -1 where there are none, on their own side of walls. Those behind a wall may see another
        part of the scene, but where some are not, the others only add to what is traced.
    """
    options = state.options
    levels = surface.levels(options.strides)
    p, n, first = surface.positions, surface.normals, surface.first
    known = levels[0]
    state.sample(first + known)
    for new in levels[1:]:
        near = surface_neighbours(p[new], n[new], p[known], n[known], options.neighbours).ids
        near = renumber(near, first + known)
        lonely = (near >= 0).sum(axis=1) < options.least_neighbours
        lonely |= walls_leave_fewer(1, first + new, near)  # one is enough to object to those behind a wall
        state.sample(first + new[lonely])
        state.agree(first + new[~lonely], near[~lonely])
        known = np.concatenate([known, new])
    around = surface_neighbours(p[known], n[known], p, n, options.repair_neighbours + 1).ids[
        :, 1:
    ]  # without itself
    state.repair(first + known, renumber(around, first + np.arange(len(p))))
