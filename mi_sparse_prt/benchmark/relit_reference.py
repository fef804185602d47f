"""Errors as they are seen: vertices under whole environments, and under one that turns."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm.auto import tqdm

from mi_sparse_prt.benchmark.converged_reference import MAX_DEPTH
from mi_sparse_prt.benchmark.sampled_norms import MeanSquare, mean_square, sampled_relative_l2
from mi_sparse_prt.core.errors import PrtWarning
from mi_sparse_prt.core.metrics import relative_l2_from_squares
from mi_sparse_prt.core.random_keys import mix
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.emission.environment import SUFFIXES, Environment, load_environment
from mi_sparse_prt.measurement.vertices import Points, vertex_points
from mi_sparse_prt.operators.visibility import Visibility
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.solvers.paths import PathSolver
from mi_sparse_prt.solvers.problem import diffuse_problem
from mi_sparse_prt.transport import LightTransport

FOLDER = "envmaps"  # beside a scene's file
FALLBACK = {"sky", "sun"}  # where there is none
PATHS_TOGETHER = 1 << 21
SEED = (1 << 30) + 4


@dataclass(frozen=True)
class RelitEffort:
    """How well the light of relit vertices is known.

    Attributes
    ----------
    vertices : int
        Per mesh, at random, at which indirect light is path traced.
    paths : int
        Per vertex, in each of two halves, shared by all lights.
    rotations : int
        Frames of a full turn.
    """

    vertices: int = 1000
    paths: int = 8192
    rotations: int = 36


CONVERGED = RelitEffort()


def environments_of(scene: Scene) -> dict[str, Environment]:
    """Environments to relight a scene with; no method was tuned to any, all know the transport only.

    They are the images in the folder ``envmaps`` beside the scene's file; if there are none, a hazy sky and a low sun.
    """
    folder = Path(scene.path).parent / FOLDER if scene.path else None
    files = (
        sorted(p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES)
        if folder and folder.is_dir()
        else []
    )
    if not files:
        return {"sky": Environment(_sky(sun=0.0)), "sun": Environment(_sky(sun=2e3))}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PrtWarning)  # negative pixels, clamped: as good a light as any
        return {file.stem: load_environment(file) for file in files}


def _sky(sun: float) -> NDArray[np.float64]:
    """A sky (32, 64, 3), brighter and less blue towards the horizon, over dark ground, with a sun of that radiance."""
    elevation = np.pi / 2 - (np.arange(32) + 0.5) / 32 * np.pi
    height = np.maximum(np.sin(elevation), 0)[:, None, None]
    pixels = np.where(elevation[:, None, None] > 0, 1 - height * np.array([0.7, 0.5, 0.2]), 0.1)
    pixels = np.repeat(pixels, 64, axis=1)
    pixels[10, 12] += sun
    return pixels


def path_traced(
    scene: Scene,
    lighting: CubemapLighting,
    lights: NDArray[np.floating],
    vertices: NDArray[np.integer],
    paths: int,
    seed: int,
    progress: bool = False,
) -> NDArray[np.float64]:
    """Indirect light of vertices of unit albedo under environments, without bias and without a matrix.

    Texels are drawn for each vertex in proportion to the power that they have in the mean of all lights, one path
    each; so the same paths serve all lights, and none is lit by less than its share of them.

    Parameters
    ----------
    scene : Scene
    lighting : CubemapLighting
    lights : (l, n_directions, 3) float
        Radiance of the texels; their light comes from their centres (direction basis).
    vertices : (k,) integers
    paths : int
        Per vertex.
    seed : int
    progress : bool

    Returns
    -------
    (l, k, 3) float64
    """
    power = lights.mean(axis=2) * lighting.solid_angles.astype(np.float64)
    total = power.sum(axis=1, keepdims=True)
    share = np.divide(power, total, out=np.zeros_like(power), where=total > 0).mean(axis=0)
    found = np.zeros((len(lights), len(vertices), 3))
    if not share.any():
        return found
    weights = np.divide(lighting.solid_angles, paths * share, out=np.zeros_like(share), where=share > 0)
    points = vertex_points(scene)
    block = max(1, PATHS_TOGETHER // paths)
    for a in tqdm(range(0, len(vertices), block), desc="paths under lights", disable=not progress):
        some = vertices[a : a + block]
        rows = _sums(scene, lighting, points, share, some, paths, seed) * weights[:, None]
        for k in range(rows.shape[2]):  # one channel of transport stands for all in a grey scene
            colours = slice(None) if rows.shape[2] == 1 else slice(k, k + 1)
            found[:, a : a + len(some), colours] = np.matmul(rows[None, :, :, k], lights[:, :, colours])
    return found


def _sums(
    scene: Scene,
    lighting: CubemapLighting,
    points: Points,
    share: NDArray[np.float64],
    vertices: NDArray[np.integer],
    paths: int,
    seed: int,
) -> NDArray[np.float64]:
    """Sums (k, n_directions, channels) of unit-albedo transport density over the paths of each vertex, by texel."""
    rng = np.random.default_rng([seed, int(vertices[0])])
    stratified = (np.arange(paths) + rng.random((len(vertices), 1))) / paths  # [vertex, path]
    cumulative = np.cumsum(share)
    texels = np.searchsorted(cumulative, stratified.ravel() * cumulative[-1], side="right")
    texels = np.minimum(texels, np.flatnonzero(share)[-1])
    # every path is a point of its own: a texel that is drawn again gets other random numbers
    owners = np.repeat(np.asarray(vertices, np.int64), paths)
    keys = mix(points.keys[owners] + np.tile(np.arange(paths, dtype=np.uint64), len(vertices)))
    copies = Points(points.positions[owners], points.normals[owners], points.offset_normals[owners], keys)
    solver = PathSolver(diffuse_problem(scene, lighting, MAX_DEPTH).at(copies), spp=1, seed=seed)
    values = solver.elements(np.arange(len(owners), dtype=np.uint32), texels.astype(np.uint32)).mean
    n = lighting.n_directions
    where = np.repeat(np.arange(len(vertices)), paths) * n + texels
    sums = [
        np.bincount(where, values[:, c], len(vertices) * n).reshape(-1, n) for c in range(solver.channels)
    ]
    return np.stack(sums, axis=-1)


@dataclass(frozen=True)
class _Relit:
    """Radiance under all lights on one mesh, or its error, as a known part and a path-traced one.

    Attributes
    ----------
    known : (l, n, 3) float64
        At all vertices.
    samples : (k,) integers
        Vertices at which there is more.
    x, y : (l, k, 3) float64
        Two independent estimates of the rest.
    """

    known: NDArray[np.float64]
    samples: NDArray[np.int64]
    x: NDArray[np.float64]
    y: NDArray[np.float64]

    def squares(self) -> list[MeanSquare]:
        """One per light."""
        return [
            mean_square(float((d**2).mean()), d[self.samples], x, y)
            for d, x, y in zip(self.known, self.x, self.y, strict=True)
        ]

    def changes(self) -> _Relit:
        """From every light to the next."""
        known, x, y = (np.diff(radiance, axis=0) for radiance in (self.known, self.x, self.y))
        return _Relit(known, self.samples, x, y)


class RelitReference:
    """What leaves the vertices under environments: direct light exactly at all, indirect light path traced at some.

    Parameters
    ----------
    scene : Scene
    direct : Visibility
        Exact bits.
    progress : bool
    effort : RelitEffort, optional
    """

    def __init__(
        self, scene: Scene, direct: Visibility, progress: bool, effort: RelitEffort = CONVERGED
    ) -> None:
        lighting = direct.lighting
        self.scene, self._effort = scene, effort
        self.environments = environments_of(scene)
        self.turning = max(self.environments, key=lambda name: _sharpness(self.environments[name], lighting))
        self.degrees = 360 / effort.rotations * np.arange(effort.rotations + 1)
        turning = self.environments[self.turning]
        still = [lighting.project(environment) for environment in self.environments.values()]
        turned = [lighting.project(turning.rotated(float(a))) for a in self.degrees[:-1]]
        # [light, texel, rgb]; the last turn closes the circle
        self.lights = np.stack([*still, *turned, turned[0]])
        self._still, self._turned = slice(0, len(still)), slice(len(still), None)
        albedo = scene.albedo.astype(np.float64)
        direct_light = self._relit_by(direct)
        rng = np.random.default_rng(3)
        self._relit: dict[str, _Relit] = {}
        for mesh in scene.meshes:
            n, inside = mesh.vertices.stop - mesh.vertices.start, mesh.vertices
            samples = np.sort(rng.choice(n, min(n, effort.vertices), replace=False))
            ids = samples + inside.start
            x, y = (
                path_traced(scene, lighting, self.lights, ids, effort.paths, SEED + k, progress) * albedo[ids]
                for k in (0, 1)
            )
            self._relit[mesh.name] = _Relit(direct_light[:, inside], samples, x, y)

    def errors(self, transport: LightTransport) -> dict[str, Any]:
        """``environments`` and ``rotation`` of a matrix, see ``measure_methods``."""
        ours = self._errors_of(transport)
        return {
            "environments": {
                name: self._under_environments(relit, ours[name]) for name, relit in self._relit.items()
            },
            "rotation": {
                "environment": self.turning,
                "reference": f"direct light exact at all vertices, indirect light path traced at "
                f"{self._effort.vertices} of each mesh, {self._effort.paths} paths in each of two halves",
                "degrees": self.degrees[:-1].tolist(),
                "meshes": {name: self._turning(relit, ours[name]) for name, relit in self._relit.items()},
            },
        }

    def noise(self) -> dict[str, dict[str, float]]:
        """Relative L2 noise of the mean of both halves, per mesh and environment."""
        found: dict[str, dict[str, float]] = {}
        for mesh, relit in self._relit.items():
            norms = [square.value for square in relit.squares()[self._still]]
            noise = [((x - y) ** 2).mean() / 4 for x, y in zip(relit.x, relit.y, strict=True)]
            found[mesh] = {
                name: float(relative_l2_from_squares(a, b))
                for name, a, b in zip(self.environments, noise, norms, strict=False)
            }
        return found

    def _errors_of(self, transport: LightTransport) -> dict[str, _Relit]:
        """Error of the radiance under all lights, per mesh."""
        direct = self._relit_by(transport.direct)
        indirect = np.zeros(direct.shape)
        if transport.indirect is not None:
            indirect = self._relit_by(transport.indirect)
        found = {}
        for mesh in self.scene.meshes:
            relit, inside = self._relit[mesh.name], mesh.vertices
            ours = indirect[:, inside][:, relit.samples]
            known = direct[:, inside] - relit.known
            found[mesh.name] = _Relit(known, relit.samples, ours - relit.x, ours - relit.y)
        return found

    def _relit_by(self, part: Any) -> NDArray[np.float64]:
        """What leaves the vertices under all lights, (l, n_v, 3)."""
        return np.stack([part.relight(light) for light in self.lights]) * self.scene.albedo.astype(np.float64)

    def _under_environments(self, relit: _Relit, error: _Relit) -> dict[str, Any]:
        pairs = zip(error.squares()[self._still], relit.squares()[self._still], strict=True)
        values = [sampled_relative_l2(*pair) for pair in pairs]
        each = {
            name: {"relative_l2": value, "standard_error": deviation}
            for name, (value, deviation) in zip(self.environments, values, strict=True)
        }
        return {"mean": float(np.mean([value for value, _ in values])), **each}

    def _turning(self, relit: _Relit, error: _Relit) -> dict[str, Any]:
        """Per frame: error, its change to the next frame, and that of the light, over the norm of the frame."""
        norms = relit.squares()[self._turned][:-1]
        shown = {
            "error": error.squares()[self._turned][:-1],
            "change_of_error": error.changes().squares()[self._turned],
            "change_of_light": relit.changes().squares()[self._turned],
        }
        frames = {
            name: [sampled_relative_l2(a, b)[0] for a, b in zip(squares, norms, strict=True)]
            for name, squares in shown.items()
        }
        return {"frames": frames, "mean": {name: float(np.mean(values)) for name, values in frames.items()}}


def _sharpness(environment: Environment, lighting: CubemapLighting) -> float:
    """Share of an environment's power that its strongest texel has: shadows of the largest move the most."""
    power = lighting.project(environment).mean(axis=1) * lighting.solid_angles
    return float(power.max() / max(float(power.sum()), 1e-30))
