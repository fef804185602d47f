"""What paths cost and how far off they are: at every resolution of the indirect light, for any number of samples."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.estimation.pilot_elements import PilotElements
from mi_sparse_prt.methods.execution import indirect_solver
from mi_sparse_prt.methods.settings import Settings
from mi_sparse_prt.planner.row_timing import seconds_per_row
from mi_sparse_prt.solvers.paths import PathSolver
from mi_sparse_prt.solvers.problem import Problem

PILOT_PATHS = 6144  # per vertex
PILOT_SPP = 16  # where rows are timed
COARSEST = 4
MOST_SAMPLES = 4096


@dataclass(frozen=True)
class PathCosts:
    """Cost and error of one path per element at each resolution.

    Attributes
    ----------
    seconds : dict
        Resolution -> of the whole matrix.
    noise : dict
        Resolution -> relative L2 error of the whole matrix; falls with 1 / sqrt(spp).
    bias : dict
        Resolution -> relative L2 error that no number of samples removes: interpolation between coarse texels.
    """

    seconds: dict[int, float]
    noise: dict[int, float]
    bias: dict[int, float]

    def priced(self, path: float, finest: int) -> PathCosts:
        """The same, if a path for every element at the finest resolution takes so many seconds."""
        return replace(self, seconds={r: (r / finest) ** 2 * path for r in self.bias})

    def error(self, resolution: int, spp: int) -> float:
        """Predicted relative L2 error of the whole matrix."""
        return math.sqrt(self.bias[resolution] ** 2 + self.noise[resolution] ** 2 / spp)

    def samples(self, resolution: int, target: float) -> int:
        """Paths per element that meet a target, or as many as ever make sense."""
        room = target**2 - self.bias[resolution] ** 2
        needed = self.noise[resolution] ** 2 / room if room > 0 else MOST_SAMPLES
        return int(min(max(math.ceil(needed), 1), MOST_SAMPLES))


def path_costs(
    problem: Problem, settings: Settings, held: PilotElements, path: float, resolutions: Iterable[int]
) -> PathCosts:
    """Measure rows of some resolutions at the vertices of the held-out elements.

    Parameters
    ----------
    problem : Problem
    settings : Settings
    held : PilotElements
        With indirect light.
    path : float
        Seconds of one path for every element (``seconds_of_a_path``).
    resolutions : integers
        At most that of the lighting; at this one, the held-out elements tell all.
    """
    assert held.indirect is not None
    lighting, noise, bias = held.lighting, {}, {}
    for resolution in resolutions:
        if resolution == lighting.resolution:
            bias[resolution], noise[resolution] = 0.0, noise_of_a_path(held)
            continue
        spp = max(2, PILOT_PATHS // (6 * resolution**2))
        solver = indirect_solver(problem, replace(settings, spp=spp, indirect_resolution=resolution))
        mean, variance = _interpolated(solver, lighting, held)
        power = lighting.solid_angles[held.texels][..., None]
        own = held.weighted(variance * power**2)
        rest = held.relative_square(held.error_of(held.indirect, mean * power) - own)
        bias[resolution] = math.sqrt(max(rest, 0.0))
        noise[resolution] = math.sqrt(held.relative_square(own) * spp)
    return PathCosts({}, noise, bias).priced(path, lighting.resolution)


def coarse_resolutions(finest: int) -> list[int]:
    """Those below the finest, from the coarsest that makes sense."""
    return [2**k for k in range(COARSEST.bit_length() - 1, finest.bit_length() - 1)]


def seconds_of_a_path(problem: Problem, settings: Settings, lighting: CubemapLighting) -> float:
    """Seconds of one path for every element of the matrix."""
    solver = indirect_solver(
        problem, replace(settings, spp=PILOT_SPP, indirect_resolution=lighting.resolution)
    )
    return seconds_per_row(solver) * len(problem.points) / PILOT_SPP


def noise_of_a_path(held: PilotElements) -> float:
    """Relative L2 error of the whole matrix, with one path per element at the full resolution."""
    assert held.indirect is not None
    return math.sqrt(max(held.relative_square(held.weighted(held.indirect.variance)), 0.0))


def _interpolated(
    solver: PathSolver, lighting: CubemapLighting, held: PilotElements
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Mean and variance (k, t, channels) at the held-out elements, interpolated from coarse rows."""
    estimate, weights = solver.rows(held.vertices), lighting.upsampling(solver.lighting)
    shape = (*held.texels.shape, solver.channels)
    mean, variance = np.empty(shape, np.float32), np.empty(shape, np.float32)
    for k, texels in enumerate(held.texels):
        own = weights[texels]
        mean[k], variance[k] = own @ estimate.mean[k], own.multiply(own) @ estimate.variance[k]
    return mean, variance
