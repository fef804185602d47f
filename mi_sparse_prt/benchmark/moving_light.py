"""Relighting with temporal coherence: errors and times of all approximations of a light that moves ([OBRG06])."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from tqdm.auto import tqdm

from mi_sparse_prt.benchmark.measuring import kept_memory, report_header
from mi_sparse_prt.benchmark.moving_light_figures import moving_light_figures
from mi_sparse_prt.benchmark.moving_light_pictures import measure_pictures
from mi_sparse_prt.benchmark.moving_light_speed import measure_frames
from mi_sparse_prt.benchmark.relit_reference import environments_of
from mi_sparse_prt.compression.compress import compress
from mi_sparse_prt.core.metrics import relative_l2
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.emission.haar import haar_colours, haar_columns, inverse_haar
from mi_sparse_prt.emission.spherical_harmonics import harmonic_orders, spherical_harmonics
from mi_sparse_prt.precompute import precompute
from mi_sparse_prt.relighting.approximations import (
    Approximation,
    Bands,
    Everything,
    Incremental,
    Linear,
    NonIncremental,
    PerBand,
    wavelet_bands,
    weighted_error,
)
from mi_sparse_prt.relighting.clusters import ClusterColumns, cluster_columns
from mi_sparse_prt.relighting.fixed_camera import stands_for_pictures
from mi_sparse_prt.relighting.light import TurningLight
from mi_sparse_prt.relighting.players import ClusteredPlayer
from mi_sparse_prt.relighting.sequences import cut, interpolation, moving_disc, turning
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.validation.validate import save_figures

Floats = NDArray[np.float32]
Report = dict[str, Any]

ORDER = 24  # of spherical harmonics, up to which they are played: 625


@dataclass(frozen=True)
class MovingEffort:
    """Which sequences are played (turns of 100 frames as in [OBRG06] Figures 2 to 4, fewer that stand still).

    Attributes
    ----------
    frames, still : int
    degrees : tuple of float
        Of the turns.
    target_error : float
        Of the matrix.
    """

    frames: int = 100
    still: int = 60
    degrees: tuple[float, ...] = (60, 180, 360)
    target_error: float = 0.02


PAPER = MovingEffort()


@dataclass(frozen=True)
class _Method:
    """An approximation and its budget, in one of the bases that ``_bases`` makes."""

    make: Callable[[Bands], Approximation]
    budget: int
    basis: str = "wavelets"


@dataclass(frozen=True)
class _Basis:
    """What light and matrix are written in: orthonormal functions, columns of which L~ chooses some.

    Attributes
    ----------
    bands : Bands
    clusters : ClusterColumns
        Of these functions.
    functions : (m, k) float32, optional
        Their wavelet coefficients; None for wavelets themselves.
    """

    bands: Bands
    clusters: ClusterColumns
    functions: Floats | None = None

    def coefficients(self, wavelets: Floats) -> Floats:
        """Of a light (m, 3)."""
        return wavelets if self.functions is None else self.functions.T @ wavelets

    def wavelets(self, coefficients: Floats) -> Floats:
        """Of a light that has these coefficients."""
        return coefficients if self.functions is None else self.functions @ coefficients


METHODS = {
    **{f"NWA({k})": _Method(NonIncremental, k) for k in (30, 60, 100, 150, 300, 500)},
    "BI(30)": _Method(Incremental, 30),
    "PBI(30) by band": _Method(lambda bands: PerBand(bands, exhaustive=False), 30),
    "PBI(30)": _Method(PerBand, 30),
    "PBI(100)": _Method(PerBand, 100),
    "by image(30)": _Method(lambda bands: PerBand(bands, power=2), 30, "by image"),
    "by image(100)": _Method(lambda bands: PerBand(bands, power=2), 100, "by image"),
    **{f"SH({k})": _Method(Linear, k, "harmonics") for k in (36, 100)},
    "PBI of SH(36)": _Method(lambda bands: PerBand(bands, exhaustive=False), 36, "harmonics"),
    "all SH": _Method(Everything, 1 << 30, "harmonics"),
}


@kept_memory()
def measure_moving_light(
    scene: Scene,
    lighting: CubemapLighting,
    progress: bool = True,
    figures: Path | None = None,
    effort: MovingEffort = PAPER,
) -> Report:
    """Play turning environments by all approximations, through the clustered PCA of a scene's matrix.

    Parameters
    ----------
    scene : Scene
    lighting : CubemapLighting
    progress : bool
    figures : path, optional
        Folder for the counterparts of [OBRG06] Figures 2 to 5 and 7 to 12.
    effort : MovingEffort

    Returns
    -------
    dict
        JSON as it is. ``turning``: for each environment and angle, for each method, ``light`` (mean over the turn of
        the weighted L1 error of wavelets), ``sphere`` (of the L1 error of radiance), ``image`` (of the relative L2 of
        vertex colours against the exact product), ``flicker`` (of the change of the image's error from frame to frame),
        ``frames`` (the first of these, frame by frame) and ``resets`` per band. ``stop``: frames after the stop until
        the error is below that of others, still. ``vectors``: relative L2 of a quarter of the weights. ``changing``:
        the same of a light that becomes another, of a round one that moves and grows, and of a cut. ``frames``: see
        ``measure_frames``. ``pictures``: see ``measure_pictures``; None for scenes without a camera, or whose pictures
        are no sums over vertices. ``matrix``: errors and sizes of what is played.
    """
    transport = precompute(scene, lighting, target_error=effort.target_error, progress=progress)
    compressed = compress(transport, progress=progress)
    clusters = cluster_columns(compressed.operators["compressed"])  # type: ignore[arg-type]
    bases = _bases(clusters, lighting)
    lights = {name: TurningLight(light, lighting) for name, light in environments_of(scene).items()}
    report: Report = report_header(scene, lighting) | {
        "matrix": {
            "error": transport.report["estimated_error"]["total"],
            "compression_error": compressed.report["compression"]["error"]["total"],
            "nbytes": compressed.nbytes,
        },
        "turning": {},
    }
    cases = [(name, degrees) for name in lights for degrees in effort.degrees]
    for name, degrees in tqdm(cases, desc="moving light", unit=" turns", disable=not progress):
        frames = list(turning(lights[name], degrees, effort.frames, effort.still))
        case = _Case(frames, bases, compressed.albedo, lighting, effort.frames)
        report["turning"].setdefault(name, {})[f"{degrees:g}"] = case.measured()
    shown = "sunset" if "sunset" in lights else next(iter(lights))
    other = next((name for name in lights if name != shown), None)
    # an only one becomes itself, seen from behind
    second = lights[shown].exact(180) if other is None else lights[other].exact(0)
    changing = _changing(lights[shown].exact(0), second, lighting, effort)
    report["changing"] = {
        name: _Case(frames, bases, compressed.albedo, lighting, effort.frames).measured()
        for name, frames in tqdm(changing.items(), desc="changing light", disable=not progress)
    }
    report["frames"] = measure_frames(transport, compressed, clusters, next(iter(lights.values())), progress)
    report["pictures"] = None
    pictures: dict[str, Figure] = {}
    if scene.mitsuba.sensors() and stands_for_pictures(scene, compressed):
        report["pictures"], pictures = measure_pictures(scene, compressed, clusters, lights[shown], second)
    if figures is not None:
        save_figures(figures, moving_light_figures(report, lights[shown], shown) | pictures)
    return report


def _bases(clusters: ClusterColumns, lighting: CubemapLighting) -> dict[str, _Basis]:
    """By name: wavelets by the area they cover, by what they do to all vertices, and harmonics."""
    n = lighting.resolution
    order = min(ORDER, n)
    functions = haar_columns(spherical_harmonics(lighting, order))
    harmonics = replace(clusters, columns=functions.T @ clusters.columns)
    orders = harmonic_orders(order)
    return {
        "wavelets": _Basis(wavelet_bands(n), clusters),
        "by image": _Basis(wavelet_bands(n, clusters.norms()), clusters),
        "harmonics": _Basis(Bands(orders, np.ones(len(orders), np.float32)), harmonics, functions),
    }


def _changing(
    first: Floats, second: Floats, lighting: CubemapLighting, effort: MovingEffort
) -> dict[str, list[Floats]]:
    """Lights that change and do not turn."""
    frames, still = effort.frames, effort.still
    return {
        "one light becomes another": list(interpolation(first, second, frames, still)),
        "a round light": list(moving_disc(lighting, frames=frames, still=still)),
        "a cut": list(cut(first, second, frames // 2, frames + still)),
    }


class _Case:
    """One sequence: its light, and the images that are right."""

    def __init__(
        self,
        texels: list[Floats],
        bases: dict[str, _Basis],
        albedo: Floats,
        lighting: CubemapLighting,
        turn: int,
    ) -> None:
        self.texels, self.lighting, self.turn = texels, lighting, turn
        self.albedo, self.bases = albedo, bases
        self.scale = np.sqrt(lighting.solid_angles)[:, None]
        self.light: list[Floats] = []
        for k, values in enumerate(texels):
            same = k > 0 and values is texels[k - 1]
            self.light.append(
                self.light[-1] if same else haar_colours(values, np.sqrt(lighting.solid_angles))
            )
        self.exact = self._images()

    def measured(self) -> Report:
        """All methods, what a quarter of the weights leaves out, and frames until the error is below others'."""
        methods = {label: self._played(method) for label, method in METHODS.items()}
        fewer = self._images(self.bases["wavelets"].clusters.quarter)
        errors = [relative_l2(ours, exact) for ours, exact in zip(fewer, self.exact, strict=True)]
        result: Report = {"methods": methods, "vectors": {"mean": float(np.mean(errors[1:]))}}
        result["stop"] = {
            label: {
                other: self._frames_until(methods[label], methods[other])
                for other in ("NWA(300)", "NWA(500)")
            }
            for label in ("PBI(30)", "PBI(30) by band", "by image(30)")
        }
        return result

    def _played(self, method: _Method) -> Report:
        """One method: errors of light and image."""
        basis, bands = self.bases[method.basis], self.bases["wavelets"].bands
        approximation = method.make(basis.bands)
        playing = ClusteredPlayer(basis.clusters, approximation.groups)
        light, sphere, image, flicker, resets = [], [], [], [], []
        before = np.zeros_like(self.albedo)
        for k, wavelets in enumerate(self.light):
            update = approximation.update(basis.coefficients(wavelets), method.budget if k else None)
            applied = basis.wavelets(approximation.applied)
            light.append(weighted_error(applied, wavelets, bands))
            resets.append(update.resets.tolist())
            if 0 < k < self.turn:
                playing.apply(update)
                sphere.append(self._sphere_error(applied, self.texels[k]))
                wrong = playing.radiance(self.albedo) - self.exact[k]
                norm = np.linalg.norm(self.exact[k])
                image.append(float(np.linalg.norm(wrong) / norm))
                flicker.append(float(np.linalg.norm(wrong - before) / norm))
                before = wrong
            elif k == 0:
                playing.apply(update)
        return {
            "light": float(np.mean(light[1 : self.turn])),
            "sphere": float(np.mean(sphere)),
            "image": float(np.mean(image)),
            "flicker": float(np.mean(flicker)),
            "frames": light,
            "images": image,
            "resets": np.mean(resets[1 : self.turn], axis=0).tolist(),
        }

    def _images(self, vectors: int | None = None) -> list[Floats]:
        """Colours of the vertices in the frames that change, with all wavelets."""
        basis = self.bases["wavelets"]
        everything = Everything(basis.bands)
        playing = ClusteredPlayer(basis.clusters, everything.groups, vectors)
        images = []
        for coefficients in self.light[: self.turn]:
            playing.apply(everything.update(coefficients, None))
            images.append(playing.radiance(self.albedo))
        return images

    def _sphere_error(self, applied: Floats, texels: Floats) -> float:
        """Relative L1 of the radiance that was applied, over the sphere."""
        away = np.abs(inverse_haar(applied.T).T / self.scale - texels).sum(axis=1)
        return float(away @ self.lighting.solid_angles / (texels.sum(axis=1) @ self.lighting.solid_angles))

    def _frames_until(self, ours: Report, other: Report) -> int | None:
        """Frames after the stop until the error of light is below; None if never."""
        below = np.array(ours["frames"][self.turn :]) < np.array(other["frames"][self.turn :])
        return int(np.argmax(below)) + 1 if below.any() else None
