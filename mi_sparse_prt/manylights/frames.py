"""Pictures of a scene that moves, which share the lights that stand for all: nothing flickers.

Of each frame for itself, other lights would represent other clusters, and the error would be another one from frame to
frame. Here lights go along with what moves, some rows of all frames tell which columns are alike (Hasan,
Velazquez-Armendariz, Pellacini, Bala 2008 have clusters of frames, too), and each frame is a sum of the same columns.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import reduce
from itertools import starmap
from pathlib import Path
from typing import Any, NamedTuple

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.core.random_keys import random_stream
from mi_sparse_prt.core.run import Run
from mi_sparse_prt.core.variant import check_variant
from mi_sparse_prt.emission.emitters import named_emitters
from mi_sparse_prt.manylights.elements import Done, Elements, Floats, ReducedColumns
from mi_sparse_prt.manylights.image import ManyLightsImage
from mi_sparse_prt.manylights.light_arrays import DIRECTION
from mi_sparse_prt.manylights.lights import Lights, count_lights, mean_counts, order_lights, scene_lights
from mi_sparse_prt.manylights.render import PROJECTED, RowColumn, Settings, View, find_view
from mi_sparse_prt.manylights.samples import Samples
from mi_sparse_prt.manylights.surfaces import Surfaces
from mi_sparse_prt.sampling.row_column import random_projection
from mi_sparse_prt.scene.scene import Scene

_PROJECT = 3  # key of random numbers


Moving = Callable[[int], mi.Scene | Scene]


def render_many_lights_frames(
    scene: mi.Scene | Scene | str | Path | Moving,
    sensors: Sequence[int | mi.Sensor],
    rows: int = 300,
    columns: int = 900,
    progress: bool = False,
    **settings: Any,
) -> Iterator[ManyLightsImage]:
    """Render frames of a film by the same point lights, whatever moves: see ``render_many_lights``.

    Parameters
    ----------
    scene : mi.Scene, Scene, str, Path or callable
        Where lamps, materials or shapes change: a callable that is given the number of a frame, from 0, and returns
        the scene as it is then. It is called up to three times for each, and may change and return one scene.
        All frames have the same emitters.
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
        Each frame as soon as it is known. Where lamps change nothing but colour and intensity, ``groups=True`` and
        ``mixed`` take milliseconds.

    Raises
    ------
    PrtError
        As ``render_many_lights``; for ``seconds`` and ``error``, which a frame cannot have for itself; for a frame
        that has other emitters than the first.
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
        shot = _MovingShot(scene, sensors, asked) if callable(scene) else _Shot(scene, sensors, asked)
    return _frames(shot, run)


class _Shot:
    """Frames of a scene in which nothing but the camera moves."""

    def __init__(
        self, scene: mi.Scene | Scene | str | Path, sensors: Sequence[int | mi.Sensor], asked: Settings
    ) -> None:
        self.asked = asked
        self._scene = find_view(scene, sensors[0])[0]
        self._cameras = [find_view(self._scene, sensor)[1] for sensor in sensors]

    def __len__(self) -> int:
        return len(self._cameras)

    def count_lights(self) -> None:
        """So that all frames have as many."""
        self._surfaces = Surfaces(self._scene)
        self._lights = scene_lights(self._scene, self.asked.light_options())

    def elements(self, frame: int) -> Elements:
        """The matrix of a frame."""
        return self._elements(self._scene, self._cameras[frame], self._surfaces, self._lights)

    def _elements(self, scene: mi.Scene, camera: mi.Sensor, surfaces: Surfaces, lights: Lights) -> Elements:
        asked = self.asked
        samples = Samples(scene, surfaces, camera, asked.spp, asked.max_depth, asked.seed, asked.groups)
        return Elements(scene, surfaces, samples, lights)


class _MovingShot(_Shot):
    """Frames of a scene that changes; none of them is kept."""

    def __init__(self, scene: Moving, sensors: Sequence[int | mi.Sensor], asked: Settings) -> None:
        self.asked, self._moving, self._sensors = asked, scene, sensors
        self._names = self._emitters(self._view(0)[0])

    def __len__(self) -> int:
        return len(self._sensors)

    def count_lights(self) -> None:
        """By the mean of all frames."""
        found = []
        for frame in range(len(self)):
            scene, _ = self._view(frame)
            self._check(frame, self._emitters(scene))
            found.append(count_lights(scene, self.asked.light_options()))
        self._counts = mean_counts(found)

    def elements(self, frame: int) -> Elements:
        scene, camera = self._view(frame)
        lights = scene_lights(scene, self.asked.light_options(), self._counts)
        return self._elements(scene, camera, Surfaces(scene), lights)

    def _view(self, frame: int) -> View:
        return find_view(self._moving(frame), self._sensors[frame])

    def _emitters(self, scene: mi.Scene) -> list[str]:
        numbers = named_emitters(scene, [shape.id() for shape in scene.shapes()])
        return sorted(numbers, key=lambda name: numbers[name])

    def _check(self, frame: int, names: list[str]) -> None:
        """Refuse frames whose lights cannot be those of the first one."""
        if sorted(names) != sorted(self._names):
            raise PrtError(
                f"frame {frame} has the emitters {', '.join(names) or 'none'}, and frame 0 "
                f"{', '.join(self._names) or 'none'}: give all frames the same"
            )
        if names != self._names:
            raise PrtError(
                f"frame {frame} has its emitters in another order than frame 0: load scenes with parallel=False"
            )


def _frames(shot: _Shot, run: Run) -> Iterator[ManyLightsImage]:
    asked = shot.asked
    with run.clock.phase("lights"):
        shot.count_lights()
    with run.clock.phase("rows"), run.bar(asked.rows, "rows") as bar:
        tracks = _tracks_of_all(shot, bar.update)
    for frame in range(len(shot)):
        own = Run(asked.seed, progress=run.progress) if frame else run  # the first has what was done for all
        with own.clock.phase("samples"):
            elements = shot.elements(frame)
            elements = elements.with_lights(elements.lights.named(tracks.identity, tracks.group))
        found = RowColumn(elements, asked, own, tracks.flux)
        found.trace_left_out()
        yield found.picture(found.compensated(found.estimate_from(tracks.reduced)))


class _Tracks(NamedTuple):
    """Lights of several frames, ascending by identity until they are put into order.

    Attributes
    ----------
    identity, group : (n,) integers
        See ``Lights``.
    place : (n, 3) float32
        Where each was when it was last seen.
    far : (n,) bool
        It is a direction.
    flux : (n,) float64
        Of all frames.
    reduced : ReducedColumns
        Of rows of all frames.
    """

    identity: NDArray[np.int64]
    group: NDArray[np.int32]
    place: Floats
    far: NDArray[np.bool_]
    flux: NDArray[np.float64]
    reduced: ReducedColumns

    def take(self, ids: NDArray[np.int64]) -> _Tracks:
        """Some of them, in another order."""
        identity, group, place, far, flux, reduced = self
        return _Tracks(identity[ids], group[ids], place[ids], far[ids], flux[ids], reduced.of_lights(ids))

    def and_frame(self, later: _Tracks) -> _Tracks:
        """Those of a frame more."""
        identity = np.union1d(self.identity, later.identity)
        before, now = (np.searchsorted(identity, own) for own in (self.identity, later.identity))

        def spread(values: NDArray[Any], places: NDArray[np.int64]) -> NDArray[Any]:
            whole = np.zeros((len(identity), *values.shape[1:]), values.dtype)
            whole[places] = values
            return whole

        def latest(old: NDArray[Any], new: NDArray[Any]) -> NDArray[Any]:
            whole = spread(old, before)
            whole[now] = new
            return whole

        def total(old: NDArray[Any], new: NDArray[Any]) -> NDArray[Any]:
            return spread(old, before) + spread(new, now)

        projected = total(self.reduced.projected, later.reduced.projected)
        squares = total(self.reduced.channel_norms**2, later.reduced.channel_norms**2)
        return _Tracks(
            identity,
            latest(self.group, later.group),
            latest(self.place, later.place),
            latest(self.far, later.far),
            total(self.flux, later.flux),
            ReducedColumns(projected, np.sqrt(squares.sum(axis=1)), np.sqrt(squares)),
        )


def _tracks_of_all(shot: _Shot, done: Done) -> _Tracks:
    """Lights of all frames, and their columns of rows of all frames, as many of each; no frame is kept."""
    asked = shot.asked
    projection = random_projection(asked.rows, PROJECTED, asked.random(_PROJECT))

    def of_frame(frame: int, places: NDArray[np.int64]) -> _Tracks:
        elements = shot.elements(frame)
        seed = int(random_stream(asked.seed, frame).generate_state(1)[0])  # rows of frames differ
        rows = elements.samples.stratified_rows(len(places), seed)
        return _tracks(elements.lights, elements.reduce_columns(rows, projection[places[: len(rows)]], done))

    found = reduce(_Tracks.and_frame, starmap(of_frame, enumerate(_shared_out(asked.rows, len(shot)))))
    return found.take(order_lights(found.place, found.far))


def _tracks(lights: Lights, reduced: ReducedColumns) -> _Tracks:
    """Of one frame."""
    place, far = lights.arrays.place.numpy().T, lights.arrays.kind.numpy() == DIRECTION
    found = _Tracks(lights.identity, lights.group, place, far, lights.flux, reduced)
    return found.take(np.argsort(lights.identity))


def _shared_out(rows: int, frames: int) -> list[NDArray[np.int64]]:
    """Rows of each frame, as many as of the others but for one; of some frames if they are too few."""
    middle = (np.arange(rows) + 0.5) * frames / rows
    return [np.flatnonzero(middle.astype(np.int64) == k) for k in range(frames)]
