"""What a row costs in this scene, on this machine."""

from __future__ import annotations

import time

import numpy as np

from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.paths import PathSolver

SHARE = 32  # a pilot traces this fraction of one wavefront


def seconds_per_row(solver: DirectSolver | PathSolver) -> float:
    """Time a few random rows, the second time: the first time, their kernel may have to be compiled."""
    n = len(solver.points)
    count = min(n, max(1, solver.block_size // SHARE))
    ids = np.sort(np.random.default_rng(0).choice(n, count, replace=False)).astype(np.uint32)
    solver.rows(ids)
    start = time.perf_counter()
    solver.rows(ids)
    return (time.perf_counter() - start) / count
