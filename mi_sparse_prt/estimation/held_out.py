"""How good a matrix is, from elements that it was not made of: no reference render is needed.

With T = D + S, direct and indirect light, and their true values d and s, an element's squared error is

    (D - d)^2  +  2 (D - d)(S - s) + (S - s)^2.

The first term is about visibility: often zero, sometimes large, and a ray tells. The other two need paths, and are
about an average over many small errors. So each part has its own elements (see ``chosen``), and the two estimates are
added. An element's noise is left out by its variance: if m is a mean of samples and v the estimated variance of that
mean, (S - m)^2 - v estimates (S - s)^2.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.estimation.element_sampling import Chosen, for_direct_light, for_indirect_light
from mi_sparse_prt.measurement.vertices import vertex_points
from mi_sparse_prt.operators.single_elements import AnyPart, elements
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.paths import PathSolver
from mi_sparse_prt.transport import LightTransport

SPP = 512
STRATA = 4  # shadow rays per axis of a texel
ROUNDING = 1e-5  # relative errors below are those of float32
ROUND = 0.25  # of the elements: these mostly tell whether a target is met


@dataclass(frozen=True)
class Sample:
    """Elements that stand for a mesh in one sum over it.

    Attributes
    ----------
    weights : (m,) float64
        How many elements each stands for.
    squares, norms : (m,) float64
        Unbiased estimates of what each adds to the squared error and the squared norm, summed over channels.
    """

    weights: NDArray[np.float64]
    squares: NDArray[np.float64]
    norms: NDArray[np.float64]


Samples = dict[tuple[str, str], Sample]  # by the names of a mesh and of a part


def held_out_error(
    scene: Scene, transport: LightTransport, max_depth: int, seed: int, target: float | None = None
) -> dict[str, Any]:
    """Estimate the relative L2 error of a matrix.

    Parameters
    ----------
    scene : Scene
    transport : LightTransport
        Of this scene, rows in the order of its vertices; its albedo is the scene's.
    max_depth : int
        As for ``precompute``. Where the matrix has no indirect light, none is expected.
    seed : int
        Elements and their random numbers are drawn from it, and differ from those of a matrix of the same seed.
    target : float, optional
        Relative L2 error. If given, elements are drawn by the quarter until these leave no doubt (2 standard errors)
        whether the error is above it.

    Returns
    -------
    dict
        ``total`` (relative L2), ``meshes`` (name -> relative L2), ``standard_error`` (``total`` and ``meshes`` again,
        from the spread between elements; where no element is wrong, as if an average one were), ``elements`` (how
        many were drawn).
    """
    judge, rng = _Judge(scene, transport, max_depth, seed), np.random.default_rng([seed, 1])
    if target is None:
        return _estimate(judge.samples(rng, 1.0))
    samples: Samples = {}
    for _ in range(round(1 / ROUND)):
        samples = _together(samples, judge.samples(rng, ROUND))
        found = _estimate(samples)
        if abs(found["total"] - target) > 2 * found["standard_error"]["total"]:
            break
    return found


def _together(first: Samples, second: Samples) -> Samples:
    """Samples of which each stands for its mesh as one; weights matter relative to each other only."""
    return {
        key: Sample(*(np.concatenate(pair) for pair in zip(astuple(first[key]), astuple(more), strict=True)))
        if key in first
        else more
        for key, more in second.items()
    }


def _estimate(samples: Samples) -> dict[str, Any]:
    """Relative L2 errors and standard errors."""
    names = dict.fromkeys(name for name, _ in samples)
    meshes = {name: relative([sample for (of, _), sample in samples.items() if of == name]) for name in names}
    total = relative(list(samples.values()))
    return {
        "total": total[0],
        "meshes": {name: value for name, (value, _) in meshes.items()},
        "standard_error": {
            "total": total[1],
            "meshes": {name: error for name, (_, error) in meshes.items()},
        },
        "elements": sum(len(sample.weights) for sample in samples.values()),
    }


class _Judge:
    """Compares elements of a matrix with true ones."""

    def __init__(self, scene: Scene, transport: LightTransport, max_depth: int, seed: int) -> None:
        self._transport, self._albedo = transport, scene.albedo.astype(np.float64)
        self._normals = scene.normals
        points, lighting = vertex_points(scene), transport.lighting
        self._seeds = [(seed << 3) + k for k in (2, 3, 4)]  # none is the matrix's own
        self._rays = DirectSolver(scene.normalised, lighting, points, transport.basis, STRATA, self._seeds[0])
        self._paths = PathSolver(
            scene.normalised,
            lighting,
            points,
            transport.basis,
            max_depth,
            SPP,
            1 if scene.grey else 3,
            self._seeds[2],
        )

    def samples(self, rng: np.random.Generator, effort: float) -> Samples:
        """Elements of each mesh, for direct and for indirect light."""
        transport, samples = self._transport, {}
        for mesh in transport.meshes:
            lit = for_direct_light(transport, self._normals, mesh.vertices, rng, effort)
            samples[mesh.name, "direct"] = self.direct(lit)
            if transport.indirect is not None:
                seen = for_indirect_light(transport, mesh.vertices, rng, effort)
                samples[mesh.name, "indirect"] = self.indirect(seen)
        return samples

    def direct(self, chosen: Chosen) -> Sample:
        """Squared errors and norms of direct light alone."""
        x, y = self._halves(chosen)
        ours = self._ours(self._transport.direct, chosen)[:, 0]
        squared_albedo = (self._albedo[chosen.vertices] ** 2).sum(axis=1)
        return Sample(chosen.weights, squared_albedo * (ours - x) * (ours - y), squared_albedo * x * y)

    def indirect(self, chosen: Chosen) -> Sample:
        """What indirect light adds to both: its square and twice its product with direct light."""
        transport = self._transport
        assert transport.indirect is not None
        estimate = self._paths.elements(chosen.vertices, chosen.texels)
        solid_angles = transport.lighting.solid_angles[chosen.texels].astype(np.float64)[:, None]
        true = estimate.mean * solid_angles  # [element, channel]
        variance = estimate.variance * solid_angles**2
        direct = np.mean(self._halves(chosen), axis=0)[:, None]
        error = self._ours(transport.indirect, chosen) - true
        direct_error = self._ours(transport.direct, chosen) - direct
        squared_albedo = self._albedo[chosen.vertices] ** 2
        squares = squared_albedo * (error * (error + 2 * direct_error) - variance)
        norms = squared_albedo * (true * (true + 2 * direct) - variance)
        return Sample(chosen.weights, squares.sum(axis=1), norms.sum(axis=1))

    def _halves(self, chosen: Chosen) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """White direct light (m,) twice, independently; it is the same where one ray tells all."""
        first = self._rays.elements(chosen.vertices, chosen.texels).astype(np.float64)
        if self._transport.basis == "direction":
            return first, first
        second = self._rays.elements(chosen.vertices, chosen.texels, self._seeds[1])
        return first, second.astype(np.float64)

    def _ours(self, part: AnyPart, chosen: Chosen) -> NDArray[np.float64]:
        return elements(part, chosen.vertices, chosen.texels).astype(np.float64)


def relative(samples: list[Sample]) -> tuple[float, float]:
    """Relative L2 and its standard error, from samples whose sums are added.

    Its square R^2 is a ratio of two sums; to first order it spreads as the sum of e - R^2 n does, e and n being the
    squared error and norm of an element (Cochran 1977, "Sampling Techniques", 6.11).
    """
    norm = sum(float((s.weights * s.norms).sum()) for s in samples)
    square = sum(float((s.weights * s.squares).sum()) for s in samples)
    if norm <= 0:  # a black mesh
        return (0.0 if square <= 0 else 1.0), 0.0
    ratio = max(square, 0.0) / norm  # below zero is noise about zero
    found, spread = float(np.sqrt(ratio)), float(np.sqrt(sum(_variance(s, ratio) for s in samples))) / norm
    # d sqrt(e) = de / (2 sqrt(e)); near zero the bound is that of sqrt(spread)
    return found, spread / (2 * found) if ratio > spread else float(np.sqrt(spread))


def _variance(sample: Sample, ratio: float) -> float:
    """Variance of the sum of e - R^2 n, elements having been drawn independently of each other.

    A few wrong elements may hold most of the squared error. Samples with few of them see too little spread as well,
    so the worst element is counted once more; where none is wrong, one average element may be.
    """
    squares, norms = sample.weights * sample.squares, sample.weights * sample.norms
    size = float(np.abs(norms).sum())
    if np.abs(squares).sum() <= ROUNDING**2 * size:
        return (float((norms**2).sum()) / max(size, 1e-300)) ** 2
    left = (squares - ratio * norms) ** 2
    return float(left.sum() + left.max())
