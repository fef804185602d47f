"""Relighting with temporal coherence: errors and times of all approximations of a light that moves ([OBRG06])."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
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
from mi_sparse_prt.emission.haar import haar_colours, inverse_haar
from mi_sparse_prt.precompute import precompute
from mi_sparse_prt.relighting.approximations import (
    Approximation,
    Bands,
    Everything,
    Incremental,
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
    """An approximation and its budget; ``by_image``: wavelets are chosen by the norms of their columns."""

    make: Callable[[Bands], Approximation]
    budget: int
    by_image: bool = False


METHODS = {
    **{f"NWA({k})": _Method(NonIncremental, k) for k in (30, 60, 100, 150, 300, 500)},
    "BI(30)": _Method(Incremental, 30),
    "PBI(30) by band": _Method(lambda bands: PerBand(bands, exhaustive=False), 30),
    "PBI(30)": _Method(PerBand, 30),
    "PBI(100)": _Method(PerBand, 100),
    "by image(30)": _Method(lambda bands: PerBand(bands, power=2), 30, by_image=True),
    "by image(100)": _Method(lambda bands: PerBand(bands, power=2), 100, by_image=True),
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
    norms = clusters.norms()
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
        case = _Case(frames, clusters, compressed.albedo, lighting, norms, effort.frames)
        report["turning"].setdefault(name, {})[f"{degrees:g}"] = case.measured()
    shown = "sunset" if "sunset" in lights else next(iter(lights))
    other = next((name for name in lights if name != shown), None)
    # an only one becomes itself, seen from behind
    second = lights[shown].exact(180) if other is None else lights[other].exact(0)
    changing = _changing(lights[shown].exact(0), second, lighting, effort)
    report["changing"] = {
        name: _Case(frames, clusters, compressed.albedo, lighting, norms, effort.frames).measured()
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
        clusters: ClusterColumns,
        albedo: Floats,
        lighting: CubemapLighting,
        norms: Floats,
        turn: int,
    ) -> None:
        self.texels, self.lighting, self.norms, self.turn = texels, lighting, norms, turn
        self.albedo, self.clusters = albedo, clusters
        self.scale = np.sqrt(lighting.solid_angles)[:, None]
        self.light: list[Floats] = []
        for k, values in enumerate(texels):
            same = k > 0 and values is texels[k - 1]
            self.light.append(
                self.light[-1] if same else haar_colours(values, np.sqrt(lighting.solid_angles))
            )
        self.bands = wavelet_bands(lighting.resolution)
        self.exact = self._images(Everything(self.bands), None, turn)

    def measured(self) -> Report:
        """All methods, what a quarter of the weights leaves out, and frames until the error is below others'."""
        methods = {label: self._played(method) for label, method in METHODS.items()}
        fewer = self._images(Everything(self.bands), None, self.turn, self.clusters.quarter)
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
        bands = wavelet_bands(self.lighting.resolution, self.norms) if method.by_image else self.bands
        approximation = method.make(bands)
        playing = ClusteredPlayer(self.clusters, approximation.groups)
        light, sphere, image, flicker, resets = [], [], [], [], []
        before = np.zeros_like(self.albedo)
        for k, coefficients in enumerate(self.light):
            update = approximation.update(coefficients, method.budget if k else None)
            light.append(weighted_error(approximation, coefficients, self.bands))
            resets.append(update.resets.tolist())
            if 0 < k < self.turn:
                playing.apply(update)
                sphere.append(self._sphere_error(approximation.applied, self.texels[k]))
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

    def _images(
        self, approximation: Approximation, budget: int | None, frames: int, vectors: int | None = None
    ) -> list[Floats]:
        """Colours of the vertices in the first frames."""
        playing = ClusteredPlayer(self.clusters, approximation.groups, vectors)
        images = []
        for coefficients in self.light[:frames]:
            playing.apply(approximation.update(coefficients, budget))
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
