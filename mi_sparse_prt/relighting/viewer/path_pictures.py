"""Mitsuba's own pictures of what a page shows, by ``path``, in a process of their own: nothing waits for them."""

from __future__ import annotations

import os
import threading
import warnings
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.errors import PrtError, PrtWarning
from mi_sparse_prt.core.worker_process import DONE, WorkerProcess
from mi_sparse_prt.emission.emitters import SceneEmitters
from mi_sparse_prt.emission.environment import Environment, emitter_of
from mi_sparse_prt.relighting.viewer.question import Question, page_sensor
from mi_sparse_prt.scene.loading import load_scene
from mi_sparse_prt.scene.mitsuba_meshes import lit_scene
from mi_sparse_prt.scene.scene import Scene, SceneFile
from mi_sparse_prt.transport import LightTransport

NICE = 10  # what a page asks for meanwhile comes first

Floats = NDArray[np.float32]


class PathPictures:
    """Pictures by ``path`` to the depth of a matrix.

    A scene from a file is loaded once more by a process, which renders it. One that is not from a file, or that comes
    out otherwise there (it was changed, or has a plugin of the user's own), is rendered here.

    Parameters
    ----------
    scene : Scene
    transport : LightTransport
        Of a cubemap or of lamps.
    lock : context manager
        That this process holds when it renders.

    Attributes
    ----------
    reason : str or None
        Why pictures are made here, where they are.
    """

    def __init__(self, scene: Scene, transport: LightTransport, lock: AbstractContextManager[object]) -> None:
        groups = transport.emission.attributes()["groups"] if transport.lights else None
        self._here, self._rendering = _Renderer(scene, groups, transport.max_depth), lock
        self._process, self._asking = WorkerProcess(), threading.Lock()
        self._closed = False
        self.reason: str | None = "the scene is not from a file" if scene.file is None else None
        if scene.file is not None:
            path, edge_length, parameters = scene.file
            named = SceneFile(str(Path(path).absolute()), edge_length, parameters)
            self._there = _There(named, scene.hash, str(mi.variant()), groups, transport.max_depth)

    def close(self) -> None:
        """Render no more; whoever waits for a picture is told."""
        self._closed = True
        self._process.kill()

    def render(self, light: Environment | Floats, question: Question, spp: int, seed: int) -> Floats:
        """An image (height, width, 3) float32, linear RGB.

        Parameters
        ----------
        light : Environment, or (m, 3) float32
            How bright lamps are.
        question : dict
            The camera, see ``page_sensor``.

        Raises
        ------
        PrtError
            If it is closed.
        """
        if self.reason is None:
            image = self._rendered_there(light, question, spp, seed)
            if image is not None:
                return image
        if self._closed:
            raise PrtError("the page was closed")
        with self._rendering:
            return self._here.render(light, page_sensor(question), spp, seed)

    def _rendered_there(
        self, light: Environment | Floats, question: Question, spp: int, seed: int
    ) -> Floats | None:
        """An image by the process; None if that has failed, which it is not asked to do again."""
        pixels = light.pixels if isinstance(light, Environment) else None
        told = (id(pixels), light.rotation) if isinstance(light, Environment) else light
        with self._asking:
            if self._closed:
                return None
            asked = _rendered, self._there, told, dict(question), spp, seed
            outcome, found = self._process.call(*asked)
            if outcome == DONE and found is None:  # pixels are sent once, not for each pass
                self._process.call(_keep, id(pixels), pixels)
                outcome, found = self._process.call(*asked)
        if self._closed:
            self._process.kill()  # it may have begun after it was closed
        if outcome == DONE:
            return found
        self.reason = str(found)
        return None


class _Renderer:
    """Renders a scene under one light after the other."""

    def __init__(self, scene: Scene, groups: dict[str, list[str]] | None, max_depth: int) -> None:
        self._scene = scene
        self._lamps = None if groups is None else SceneEmitters(scene, groups)
        self._path = mi.load_dict({"type": "path", "max_depth": max_depth})
        self._lit: tuple[object, mi.Scene] | None = None

    def render(self, light: Environment | Floats, sensor: mi.Sensor, spp: int, seed: int) -> Floats:
        if isinstance(light, Environment):
            return self._image(self._under(light), sensor, spp, seed)
        assert self._lamps is not None
        with self._lamps.scene_lit_by(light, self._scene) as lit:
            return self._image(lit, sensor, spp, seed)

    def _image(self, lit: mi.Scene, sensor: mi.Sensor, spp: int, seed: int) -> Floats:
        image = mi.render(lit, sensor=sensor, integrator=self._path, spp=spp, seed=seed)
        return np.array(image)[..., :3]

    def _under(self, light: Environment) -> mi.Scene:
        """The scene under an environment; the last one is kept."""
        key = id(light.pixels), light.rotation.tobytes()
        if self._lit is None or self._lit[0] != key:
            self._lit = key, lit_scene(self._scene.unlit_shapes(), emitter_of(light))
        return self._lit[1]


# --- in the process


@dataclass(frozen=True)
class _There:
    """What the process renders: a scene, and how it is to come out."""

    file: SceneFile
    scene_hash: str
    variant: str
    groups: dict[str, list[str]] | None
    max_depth: int


_ENVIRONMENTS: dict[int, Environment] = {}
_RENDERERS: list[_Renderer] = []


def _keep(number: int, pixels: Floats) -> None:
    _ENVIRONMENTS[number] = Environment(pixels)


def _rendered(
    there: _There, light: tuple[int, NDArray[np.float64]] | Floats, question: Question, spp: int, seed: int
) -> Floats | None:
    """An image; None if it lacks the pixels of the environment."""
    if not _RENDERERS:
        _RENDERERS.append(_renderer(there))
    if isinstance(light, tuple):
        number, rotation = light
        if number not in _ENVIRONMENTS:
            return None
        under: Environment | Floats = _ENVIRONMENTS[number].rotated(rotation)
    else:
        under = light
    return _RENDERERS[0].render(under, page_sensor(question), spp, seed)


def _renderer(there: _There) -> _Renderer:
    """Load the scene, behind everything else that runs."""
    os.nice(NICE)
    if mi.variant() != there.variant:
        raise PrtError(f"Mitsuba runs in the variant {mi.variant()} here, not in {there.variant}")
    path, edge_length, parameters = there.file
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PrtWarning)  # said when it was loaded for the page
        scene = load_scene(path, edge_length, **parameters)
    if scene.hash != there.scene_hash:
        raise PrtError(f"scene file {path} was changed: open the page again")
    return _Renderer(scene, there.groups, there.max_depth)
