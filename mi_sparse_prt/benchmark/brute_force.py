"""Brute force's time and error: of all rows from some blocks of them, for any number of paths from a few."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mi_sparse_prt.benchmark.measuring import timed
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
    blocks = [np.arange(a, min(a + size, n), dtype=np.uint32) for a in starts.tolist()]
    lengths = np.array([len(block) for block in blocks])
    seconds = np.array([timed(solver.rows, block)[0] for block in blocks])
    if lengths.sum() == n:
        return RowsTime(float(seconds.sum()), 0.0, n)
    per_row = seconds / lengths
    error = n * float(per_row.std(ddof=1)) / float(np.sqrt(len(blocks)))
    return RowsTime(n * float(per_row.mean()), error, int(lengths.sum()))


@dataclass(frozen=True)
class BruteForce:
    """Time and error of exact direct light and path-traced indirect light, at any number of paths per element.

    Its direct light is exact, so that all of its error is noise and falls as 1 / sqrt(spp). Time is interpolated
    between the measured numbers of paths, and beyond the largest grows in proportion to it.

    Attributes
    ----------
    direct_seconds : float
    spp : tuple of int
        Ascending.
    path_seconds, errors, standard_errors : tuple of float
        At each of ``spp``, of the whole matrix.
    """

    direct_seconds: float
    spp: tuple[int, ...]
    path_seconds: tuple[float, ...]
    errors: tuple[float, ...]
    standard_errors: tuple[float, ...]

    @property
    def noise(self) -> float:
        """Relative L2 at one path per element, from all measurements, each by how well it is known."""
        at_one = np.array(self.errors) * np.sqrt(self.spp)
        deviation = np.array(self.standard_errors) * np.sqrt(self.spp)
        return float(np.average(at_one, weights=1 / np.maximum(deviation, 1e-9) ** 2))

    def seconds(self, spp: float) -> float:
        """Of the whole matrix."""
        if spp > self.spp[-1]:
            return self.direct_seconds + self.path_seconds[-1] * spp / self.spp[-1]
        return self.direct_seconds + float(np.interp(spp, self.spp, self.path_seconds))

    def compared(self, seconds: float, error: float) -> dict[str, Any]:
        """A method against brute force at the method's error.

        Parameters
        ----------
        seconds, error : float
            Of the method; the error is relative L2.

        Returns
        -------
        dict
            ``spp`` at which brute force has that error, at least 1; its ``seconds``; ``speed_up``, how many times as
            long it takes; ``extrapolated``, whether so many paths were never traced. All are None where the error is
            too small to be told from none.
        """
        if error <= 0:
            return {"spp": None, "seconds": None, "speed_up": None, "extrapolated": None}
        spp = max(1.0, (self.noise / error) ** 2)
        own = self.seconds(spp)
        return {"spp": spp, "seconds": own, "speed_up": own / seconds, "extrapolated": spp > self.spp[-1]}
