"""What a target error costs: how fine and how well sampled the indirect light has to be, measured on a few vertices."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.emission.upsampling import upsampling
from mi_sparse_prt.measurement.vertices import vertex_points
from mi_sparse_prt.scene import Scene
from mi_sparse_prt.settings import Settings
from mi_sparse_prt.transport.direct import DirectTransport
from mi_sparse_prt.transport.path import PathTransport
from mi_sparse_prt.validation.pilot_elements import PilotElements

PILOT_VERTICES = 64  # per mesh
PILOT_SPP = 16
COARSEST = 4
SAFETY = 1.2  # more samples than predicted: the prediction itself is noisy
MOST_SAMPLES = 4096


@dataclass(frozen=True)
class IndirectPlan:
    """One way to compute the indirect light of a matrix.

    Attributes
    ----------
    resolution, spp : int
    bias : float
        Relative L2 error of the whole matrix that no number of samples removes: interpolation between coarse texels,
        and in the texel basis the direct part's own error.
    noise : float
        Relative L2 error of the whole matrix at one sample per element; falls with 1 / sqrt(spp).
    """

    resolution: int
    spp: int
    bias: float
    noise: float

    @property
    def paths(self) -> int:
        """Paths per vertex, the cost."""
        return 6 * self.resolution**2 * self.spp

    @property
    def error(self) -> float:
        """Predicted relative L2 error of the whole matrix."""
        return math.sqrt(self.bias**2 + self.noise**2 / self.spp)

    def report(self) -> dict[str, Any]:
        return {**asdict(self), "paths_per_vertex": self.paths, "predicted_error": self.error}


def indirect_solver(scene: Scene, settings: Settings) -> PathTransport:
    """The solver that settings ask for, at the scene's vertices."""
    return PathTransport(
        scene.normalised,
        settings.coarse,
        vertex_points(scene),
        settings.indirect_basis,
        settings.max_depth,
        settings.spp,
        1 if scene.grey else 3,
        settings.seed,
    )


def plan_indirect(scene: Scene, lighting: CubemapLighting, settings: Settings) -> list[IndirectPlan]:
    """Find the cheapest resolution and sample count of the indirect light that meet a target error.

    Parameters
    ----------
    scene : Scene
    lighting : CubemapLighting
    settings : Settings
        With a ``target_error``, the relative L2 of the whole matrix.

    Returns
    -------
    list of IndirectPlan
        One per resolution, plans that meet the target first, the cheapest of them at the head.

    Notes
    -----
    On a few vertices of each mesh, rows are computed at every resolution and compared with held-out elements. Their
    squared error is that of the samples, which is known from their variance, plus a rest that samples do not remove.
    """
    assert settings.target_error is not None
    target = settings.target_error
    held = PilotElements(
        scene, lighting, settings.basis, settings.max_depth, True, settings.seed + (1 << 20), PILOT_VERTICES
    )
    plans = []
    resolution = min(COARSEST, lighting.resolution)
    while resolution <= lighting.resolution:
        tried = replace(settings, indirect_resolution=resolution)
        bias, noise = _bias_and_noise(scene, lighting, tried, held)
        room = target**2 - bias**2
        spp = math.ceil(SAFETY * noise**2 / room) if room > 0 else MOST_SAMPLES
        plans.append(IndirectPlan(resolution, min(max(spp, 1), MOST_SAMPLES), bias, noise))
        resolution *= 2
    return sorted(plans, key=lambda p: (p.error > target, p.paths if p.error <= target else p.error))


def _bias_and_noise(
    scene: Scene, lighting: CubemapLighting, settings: Settings, held: PilotElements
) -> tuple[float, float]:
    """Relative L2 of what samples do not remove, and of the noise of one sample per element."""
    points, shape, basis = vertex_points(scene), held.texels.shape, settings.basis
    flat = np.repeat(held.vertices, shape[1]), held.texels.ravel()
    solver = indirect_solver(scene, replace(settings, spp=PILOT_SPP))
    same = settings.coarse.resolution == lighting.resolution
    mean, variance = _at_elements(solver, held) if same else _interpolated(solver, lighting, held)
    direct = DirectTransport(scene.normalised, lighting, points, basis, settings.strata, settings.seed)
    albedo = scene.albedo[held.vertices][:, None]  # [vertex, 1, rgb]
    solid_angles = lighting.solid_angles[held.texels][..., None]
    white = direct.elements(*flat).reshape(*shape, 1) + mean * solid_angles
    noise = (albedo**2 * variance * solid_angles**2).sum(axis=2)
    at_one_sample = math.sqrt(held.relative_square(noise) * PILOT_SPP)
    if same and basis == "direction":
        return 0.0, at_one_sample
    return math.sqrt(
        max(held.relative_square(held.squared_error(albedo * white) - noise), 0.0)
    ), at_one_sample


def _at_elements(
    solver: PathTransport, held: PilotElements
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Mean and variance (k, t, channels) of the held-out elements themselves."""
    estimate = solver.elements(np.repeat(held.vertices, held.texels.shape[1]), held.texels.ravel())
    shape = (*held.texels.shape, solver.channels)
    return estimate.mean.reshape(shape), estimate.variance.reshape(shape)


def _interpolated(
    solver: PathTransport, lighting: CubemapLighting, held: PilotElements
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Mean and variance (k, t, channels) at the held-out elements, interpolated from coarse rows."""
    estimate, weights = solver.rows(held.vertices), upsampling(solver.lighting, lighting)
    shape = (*held.texels.shape, solver.channels)
    mean, variance = np.empty(shape, np.float32), np.empty(shape, np.float32)
    for k, texels in enumerate(held.texels):
        own = weights[texels]
        mean[k], variance[k] = own @ estimate.mean[k], own.multiply(own) @ estimate.variance[k]
    return mean, variance
