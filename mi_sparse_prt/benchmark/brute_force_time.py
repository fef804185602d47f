"""How long the whole matrix takes where every element is traced, from blocks of rows as a full run meets them."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from mi_sparse_prt.solvers.adjoint_paths import AdjointSolver
from mi_sparse_prt.solvers.paths import PathSolver

ROWS, BLOCKS = 128, 16  # at least


@dataclass(frozen=True)
class RowsTime:
    """Time of all rows of a scene.

    Attributes
    ----------
    seconds, standard_error : float
        Of all rows, extrapolated from some; the latter from the spread between blocks.
    rows : int
        How many were timed.
    """

    seconds: float
    standard_error: float
    rows: int


def time_rows(solver: PathSolver | AdjointSolver, size: int) -> RowsTime:
    """Time blocks of successive vertices, one at a random place in each of as many equal parts of a scene.

    Parameters
    ----------
    solver : PathSolver or AdjointSolver
        At the scene's vertices, mesh after mesh. If there are fewer blocks, all are timed.
    size : int
        Vertices in a block: as many as a full run traces together.
    """
    n, rng = len(solver.points), np.random.default_rng(2)
    solver.rows(np.arange(min(n, size), dtype=np.uint32))  # compiles
    starts = np.arange(0, n, size)
    count = max(BLOCKS, -(-ROWS // size))
    if len(starts) > count:
        starts = np.array([rng.choice(part) for part in np.array_split(starts[: n // size], count)])
    lengths = np.minimum(starts + size, n) - starts
    seconds = np.array([_seconds(solver, int(a), int(a + k)) for a, k in zip(starts, lengths, strict=True)])
    per_row, timed = seconds / lengths, int(lengths.sum())
    if timed == n:
        return RowsTime(float(seconds.sum()), 0.0, n)
    return RowsTime(
        n * float(per_row.mean()), n * float(per_row.std(ddof=1)) / float(np.sqrt(len(starts))), timed
    )


def _seconds(solver: PathSolver | AdjointSolver, start: int, stop: int) -> float:
    """Time of the rows [start, stop)."""
    begin = time.perf_counter()
    solver.rows(np.arange(start, stop, dtype=np.uint32))
    return time.perf_counter() - begin
