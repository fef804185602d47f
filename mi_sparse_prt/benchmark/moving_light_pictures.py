"""What a camera sees of approximations of a light that moves: counterparts of [OBRG06] Figures 8, 10, 11 and 12."""

from __future__ import annotations

import colorsys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from mi_sparse_prt.core.metrics import flip_map, relative_l2
from mi_sparse_prt.emission.haar import haar_colours
from mi_sparse_prt.relighting.approximations import (
    Approximation,
    Bands,
    Everything,
    Incremental,
    NonIncremental,
    PerBand,
    wavelet_bands,
)
from mi_sparse_prt.relighting.clusters import ClusterColumns
from mi_sparse_prt.relighting.fixed_camera import FixedCamera
from mi_sparse_prt.relighting.image import render
from mi_sparse_prt.relighting.light import TurningLight
from mi_sparse_prt.relighting.players import ClusteredPlayer
from mi_sparse_prt.relighting.sequences import interpolation, turning
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.transport import LightTransport
from mi_sparse_prt.validation.matrix_figures import draw_picture, panels, tonemapped

DEGREES, FRAMES, STILL = 180, 100, 301  # of the turn, as in [OBRG06] Figures 2 and 8
SHOWN = (30, 75, 125, 400)
QUICK, AFTER = 75, 104  # a frame of quick motion, and five frames after the stop
ASIDE = 50.0  # degrees between the two views
SPP = 16

Floats = NDArray[np.float32]
Report = dict[str, Any]
Pictures = dict[str, dict[str, Floats]]  # by row and column
Make = Callable[[Bands], Approximation]

NWA, BI, PBI = NonIncremental, Incremental, PerBand


@dataclass(frozen=True)
class _Seen:
    """A camera, and what plays light into it."""

    camera: FixedCamera
    clusters: ClusterColumns
    bands: Bands
    scale: Floats

    def pictures(
        self,
        frames: Sequence[Floats],
        method: Make,
        budget: int | None,
        shown: Sequence[int],
        vectors: int | None = None,
    ) -> dict[int, Floats]:
        """Images at the frames ``shown`` of lights (texels, 3); the first frame of all is exact."""
        approximation = method(self.bands)
        playing = ClusteredPlayer(self.clusters, approximation.groups, vectors)
        images = {}
        for frame in range(max(shown) + 1):
            coefficients = haar_colours(frames[frame], self.scale)
            playing.apply(approximation.update(coefficients, budget if frame else None))
            if frame in shown:
                images[frame] = self.camera.image(playing.incident)
        return images


def measure_pictures(
    scene: Scene,
    compressed: LightTransport,
    clusters: ClusterColumns,
    first: TurningLight,
    second: Floats,
) -> tuple[Report, dict[str, Figure]]:
    """Errors of pictures of the scene's first camera, and the pictures themselves.

    Parameters
    ----------
    scene : Scene
        With a camera, and without surfaces that rays go on from.
    compressed : LightTransport
        By clustered PCA: ``clusters``.
    clusters : ClusterColumns
    first : TurningLight
        It turns, and becomes the second.
    second : (n_directions, 3) float32

    Returns
    -------
    report : dict
        For each figure, row and column, ``relative_l2`` and ``flip`` (its mean) against the exact product; and what the
        camera takes: ``seconds``, ``nbytes``, ``milliseconds`` of a picture, of one with its background, and of
        ``render``.
    figures : dict
    """
    lighting = first.lighting
    start = time.perf_counter()
    camera = FixedCamera(scene, compressed, spp=SPP)
    report: Report = {
        "camera": {"seconds": time.perf_counter() - start} | _times(scene, compressed, camera, first)
    }
    scale = np.sqrt(lighting.solid_angles, dtype=np.float32)
    seen = _Seen(camera, clusters, wavelet_bands(lighting.resolution), scale)
    turn = list(turning(first, DEGREES, FRAMES, STILL))
    with _moved(scene) as sensor:
        aside = _Seen(FixedCamera(scene, compressed, sensor, SPP), clusters, seen.bands, scale)
    becoming = list(interpolation(first.exact(0), second, FRAMES))
    every = {
        "pictures_over_time": _over_time(seen, turn),
        "pictures_by_budget": _by_budget(seen, turn),
        "pictures_of_changes": _of_changes(seen, aside, turn, becoming),
        "pictures_of_clusters": _of_clusters(seen, turn),
    }
    report |= {name: _errors(pictures) for name, pictures in every.items()}
    figures = {name: _figure(pictures, report[name]) for name, pictures in every.items()}
    figures["clusters"] = _clusters_figure(seen)
    return report, figures


def _times(scene: Scene, compressed: LightTransport, camera: FixedCamera, light: TurningLight) -> Report:
    """Medians of pictures in milliseconds."""
    texels = light.exact(0)
    incident = compressed.incident.relight(texels)
    ways = {
        "picture": lambda: camera.image(incident),
        "with_background": lambda: camera.image(incident, texels),
        "render": lambda: render(scene, compressed, texels, spp=SPP),
    }
    milliseconds = {}
    for name, make in ways.items():
        times = []
        for _ in range(6):  # the first compiles
            start = time.perf_counter()
            make()
            times.append(1e3 * (time.perf_counter() - start))
        milliseconds[name] = float(np.median(times[1:]))
    return {"nbytes": camera.nbytes, "size": camera.size, "spp": SPP, "milliseconds": milliseconds}


@contextmanager
def _moved(scene: Scene) -> Iterator[mi.Sensor]:
    """The first camera, that has gone round the scene for a while."""
    sensor = scene.sensor(0)
    parameters = mi.traverse(sensor)
    before = mi.ScalarTransform4f(parameters["to_world"].matrix.numpy()[..., 0])
    middle = [float(x) for x in scene.centre]
    turn = mi.ScalarTransform4f().translate(middle).rotate([0, 1, 0], ASIDE).translate([-x for x in middle])
    parameters["to_world"] = mi.Transform4f(turn @ before)
    parameters.update()
    try:
        yield sensor
    finally:
        parameters["to_world"] = mi.Transform4f(before)
        parameters.update()


def _over_time(seen: _Seen, turn: Sequence[Floats]) -> Pictures:
    """[OBRG06] Figures 2 and 8: ghosts of BI, none of PBI."""
    ways = {"exact": (Everything, None), "NWA(30)": (NWA, 30), "BI(30)": (BI, 30), "PBI(30)": (PBI, 30)}
    return {
        label: {f"frame {k}": image for k, image in seen.pictures(turn, method, budget, SHOWN).items()}
        for label, (method, budget) in ways.items()
    }


def _by_budget(seen: _Seen, turn: Sequence[Floats]) -> Pictures:
    """[OBRG06] Figure 10: numbers of wavelets, in motion and five frames after the stop."""
    pictures: Pictures = {}
    for name, method in (("NWA", NWA), ("PBI", PBI)):
        for budget in (30, 100, 300):
            found = seen.pictures(turn, method, budget, (QUICK, AFTER))
            for frame, words in ((QUICK, "moving"), (AFTER, "5 frames after the stop")):
                pictures.setdefault(f"{name}, {words}", {})[f"{budget} wavelets"] = found[frame]
    for frame, words in ((QUICK, "moving"), (AFTER, "5 frames after the stop")):
        exact = seen.pictures(turn, Everything, None, (frame,))[frame]
        for name in ("NWA", "PBI"):
            pictures[f"{name}, {words}"]["exact"] = exact
    return pictures


def _of_changes(seen: _Seen, aside: _Seen, turn: Sequence[Floats], becoming: Sequence[Floats]) -> Pictures:
    """[OBRG06] Figure 11: light that turns, light that becomes another, and a view that moves alone."""
    pictures: Pictures = {}
    ways = {"NWA(30)": (NWA, 30), "NWA(100)": (NWA, 100), "PBI(30)": (PBI, 30), "exact": (Everything, None)}
    for label, (method, budget) in ways.items():
        pictures[label] = {
            "turning": seen.pictures(turn, method, budget, (QUICK,))[QUICK],
            "becoming another": seen.pictures(becoming, method, budget, (QUICK,))[QUICK],
            "the view alone": aside.pictures(turn, method, budget, (SHOWN[-1],))[SHOWN[-1]],
        }
    return pictures


def _of_clusters(seen: _Seen, turn: Sequence[Floats]) -> Pictures:
    """[OBRG06] Figure 12: all wavelets, and the weights of a few basis vectors of each cluster in a frame."""
    most = seen.clusters.sizes.shape[1]
    counts = sorted({min(count, most) for count in (2, 4, 6)} | {most})
    images = {count: seen.pictures(turn, Everything, None, (QUICK,), count)[QUICK] for count in counts}
    exact = images[most]
    return {
        f"{count} of {most} basis vectors": {"picture": image, "exact": exact}
        for count, image in images.items()
    }


def _errors(pictures: Pictures) -> Report:
    """Of each picture against the exact one of its column, or of its row."""
    return {
        row: {
            column: {
                "relative_l2": float(relative_l2(image, _exact(pictures, row, column))),
                "flip": float(flip_map(_exact(pictures, row, column), image).mean()),
            }
            for column, image in images.items()
            if "exact" not in (row, column)
        }
        for row, images in pictures.items()
        if row != "exact"
    }


def _exact(pictures: Pictures, row: str, column: str) -> Floats:
    return pictures["exact"][column] if "exact" in pictures else pictures[row]["exact"]


def _figure(pictures: Pictures, errors: Report) -> Figure:
    """Rows and columns of pictures, with their errors; all of one column are as bright."""
    columns = list(next(iter(pictures.values())))
    height, width = next(iter(next(iter(pictures.values())).values())).shape[:2]
    figure, axes = panels(
        4 * len(columns), (4 * height / width + 0.4) * len(pictures), len(pictures), len(columns)
    )
    for place, (row, images) in zip(axes.reshape(len(pictures), -1), pictures.items(), strict=True):
        for axis, column in zip(place, columns, strict=True):
            brightest = float(np.percentile(_exact(pictures, row, column), 99.9))
            title = f"{row}: {column}"
            if column in errors.get(row, {}):
                found = errors[row][column]
                title += f" ({found['relative_l2']:.1%}, FLIP {found['flip']:.3f})"
            draw_picture(axis, tonemapped(np.maximum(images[column], 0), brightest), title, 8)
    return figure


def _clusters_figure(seen: _Seen) -> Figure:
    """Which cluster vertices are in: colours that follow each other by the golden ratio are never alike."""
    clusters = seen.clusters
    sizes = np.diff(clusters.starts)
    hues = (np.arange(len(sizes)) * (5**0.5 - 1) / 2) % 1
    colours = np.array([colorsys.hsv_to_rgb(hue, 0.7, 0.9) for hue in hues], np.float32)
    incident = np.zeros((len(clusters.order), 3), np.float32)
    incident[clusters.order] = np.repeat(colours, sizes, axis=0)
    figure, axes = panels(6, 5, 1, 1)
    draw_picture(np.ravel(axes)[0], tonemapped(seen.camera.image(incident)), f"{len(sizes)} clusters")
    return figure
