"""Pictures of a camera that moves, which share the lights that stand for all: nothing flickers.

Of each frame for itself, other lights would represent other clusters, and the error would be another one from frame to
frame. Here some rows of all frames tell which columns are alike (Hasan, Velazquez-Armendariz, Pellacini, Bala 2008 have
clusters of frames, too), and each frame is a sum of the same columns.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.core.random_keys import random_stream
from mi_sparse_prt.core.run import Run
from mi_sparse_prt.core.variant import check_variant
from mi_sparse_prt.manylights.elements import Done, Elements, ReducedColumns
from mi_sparse_prt.manylights.image import ManyLightsImage
from mi_sparse_prt.manylights.lights import scene_lights
from mi_sparse_prt.manylights.render import PROJECTED, RowColumn, Settings, find_view
from mi_sparse_prt.manylights.samples import Samples
from mi_sparse_prt.manylights.surfaces import Surfaces
from mi_sparse_prt.sampling.row_column import random_projection
from mi_sparse_prt.scene.scene import Scene

_PROJECT = 3  # key of random numbers


def render_many_lights_frames(
    scene: mi.Scene | Scene | str | Path,
    sensors: Sequence[int | mi.Sensor],
    rows: int = 300,
    columns: int = 900,
    progress: bool = False,
    **settings: Any,
) -> Iterator[ManyLightsImage]:
    """Render a scene from several cameras by the same point lights, as frames of a film: see ``render_many_lights``.

    Parameters
    ----------
    scene : mi.Scene, Scene, str or Path
    sensors : sequence of int or mi.Sensor
        One for each frame; frames that see the same surfaces, or rows tell less about each of them.
    rows : int
        Of all frames together.
    columns : int
        That are evaluated for each frame.
    progress : bool
        Show progress bars.
    **settings
        As for ``render_many_lights``, but for ``seconds`` and ``error``.

    Yields
    ------
    ManyLightsImage
        Each frame as soon as it is known. Where lights change colour and intensity, take ``groups=True`` and ``mixed``.

    Raises
    ------
    PrtError
        As ``render_many_lights``; and for ``seconds`` and ``error``, which a frame cannot have for itself.
    """
    check_variant()
    for name in ("seconds", "error"):
        if settings.get(name) is not None:
            raise PrtError(f"frames share their rows and columns: give these, and not {name}")
    try:
        asked = Settings(rows, columns, **settings)
    except TypeError as error:
        raise PrtError(f"render_many_lights_frames: {error}") from None
    if not len(sensors):
        raise PrtError("there are no sensors: give one for each frame")
    run = Run(asked.seed, progress=progress)
    with run.clock.phase("load"):
        loaded = find_view(scene, sensors[0])[0]
        cameras = [find_view(loaded, sensor)[1] for sensor in sensors]
    return _frames(loaded, cameras, asked, run)


def _frames(
    scene: mi.Scene, cameras: list[mi.Sensor], asked: Settings, run: Run
) -> Iterator[ManyLightsImage]:
    surfaces = Surfaces(scene)
    with run.clock.phase("lights"):
        lights = scene_lights(scene, asked.light_options())

    def matrix(camera: mi.Sensor) -> Elements:
        samples = Samples(scene, surfaces, camera, asked.spp, asked.max_depth, asked.seed, asked.groups)
        return Elements(scene, surfaces, samples, lights)

    with run.clock.phase("rows"), run.bar(asked.rows, "rows") as bar:
        reduced = _reduced_of_all(cameras, matrix, len(lights), asked, bar.update)
    for k, camera in enumerate(cameras):
        own = Run(asked.seed, progress=run.progress) if k else run  # the first has what was done for all
        with own.clock.phase("samples"):
            elements = matrix(camera)
        found = RowColumn(elements, asked, own)
        found.trace_left_out()
        yield found.picture(found.compensated(found.estimate_from(reduced)))


def _reduced_of_all(
    cameras: list[mi.Sensor],
    matrix: Callable[[mi.Sensor], Elements],
    lights: int,
    asked: Settings,
    done: Done,
) -> ReducedColumns:
    """Reduced columns of rows of all frames, as many of each; no frame is kept."""
    projection = random_projection(asked.rows, PROJECTED, asked.random(_PROJECT))
    projected, squares = np.zeros((lights, projection.shape[1]), np.float32), np.zeros((lights, 3))
    for k, places in enumerate(_shared_out(asked.rows, len(cameras))):
        if len(places):
            elements = matrix(cameras[k])
            seed = int(random_stream(asked.seed, k).generate_state(1)[0])  # rows of frames differ
            ids = elements.samples.stratified_rows(len(places), seed)
            found = elements.reduce_columns(ids, projection[places[: len(ids)]], done)
            projected += found.projected
            squares += found.channel_norms**2
    return ReducedColumns(projected, np.sqrt(squares.sum(axis=1)), np.sqrt(squares))


def _shared_out(rows: int, frames: int) -> list[NDArray[np.int64]]:
    """Rows of each frame, as many as of the others but for one; of some frames if they are too few."""
    middle = (np.arange(rows) + 0.5) * frames / rows
    return [np.flatnonzero(middle.astype(np.int64) == k) for k in range(frames)]
