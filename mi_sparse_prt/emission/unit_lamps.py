"""The lamps of a scene apart from how bright they are: columns that outlast dimming."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.core.random_keys import hash_rows
from mi_sparse_prt.emission.emitters import RADIATED, SceneEmitters, emitter_names, shapes_of_emitters
from mi_sparse_prt.scene.materials import digest, printed
from mi_sparse_prt.scene.scene import Scene

_NUMBERS = ("value", "scale")  # of a texture that is the same everywhere; a factor of one that is not


class UnitLamps(SceneEmitters):
    """All emitters of a scene but its environment, a column each: the scene lit by it alone at brightness 1.

    Parameters
    ----------
    scene : Scene
        With at least one such emitter.

    Attributes
    ----------
    brightness : (size, 3) float32
        Of the lamps as they are now, what the columns are multiplied with: the radiance of an area light, the intensity
        of a point ... linear RGB. It is 1 of lamps whose light no number scales: a texture is part of the column.
    hash : str
        SHA-256 (hex) of all that the columns depend on besides the scene's surfaces: what the lamps are, where they are
        and where they point, their textures and their names, but not their brightness.

    Raises
    ------
    PrtError
        If there is no such emitter.
    """

    def __init__(self, scene: Scene) -> None:
        emitters = scene.mitsuba.emitters()
        names = [name for name, k in emitter_names(scene).items() if not emitters[k].is_environment()]
        if not names:
            raise PrtError(f"the scene {scene.path or ''} has no lamp besides its environment: add one")
        super().__init__(scene, {name: [name] for name in names})
        self._lamps = [emitters[number] for (number,) in self._members]
        self.brightness = np.array([_brightness(lamp) for lamp in self._lamps], np.float32)
        self.hash = self._hash(scene)

    @contextmanager
    def at_unit_brightness(self) -> Iterator[None]:
        """Within it all lamps have the brightness 1: the columns are to be computed there."""
        before = []
        try:
            for lamp in self._lamps:
                parameters = mi.traverse(lamp)
                old = {key: type(parameters[key])(parameters[key]) for key in _numbers(parameters)}
                before.append((parameters, old))
                parameters.update({key: type(value)(1) for key, value in old.items()})
            yield
        finally:
            for parameters, old in before:
                parameters.update(old)

    def _hash(self, scene: Scene) -> str:
        state, meshes = hashlib.sha256(), shapes_of_emitters(scene.mitsuba)
        with self.at_unit_brightness():
            for name, lamp, (number,) in zip(self.names, self._lamps, self._members, strict=True):
                state.update(f"|{name}|".encode())
                state.update(digest(printed(lamp), mi.traverse(lamp), ("sampling_weight",)))
                if number in meshes:
                    state.update(_surface(scene, meshes[number]))
        return state.hexdigest()


def _numbers(parameters: mi.SceneParameters) -> list[str]:
    """Parameters of an emitter that its light is proportional to, and that are one number or colour each."""
    places = [(key, *key.split(".")) for key in parameters.keys()]
    return [
        key
        for key, first, *rest in places
        if key == "scale" or (first in RADIATED and len(rest) == 1 and rest[0] in _NUMBERS)
    ]


def _brightness(emitter: mi.Emitter) -> NDArray[np.float32]:
    """(3,) the product of these, linear RGB."""
    parameters = mi.traverse(emitter)
    product = np.ones(3, np.float32)
    for key in _numbers(parameters):
        product *= np.ravel(np.array(parameters[key], np.float32))
    return product


def _surface(scene: Scene, mesh: int) -> bytes:
    """Which of the surfaces shines, and how its texture lies on it, whatever the order of its vertices."""
    keys, shape = scene.vertex_keys[scene.fronts[mesh].vertices], scene.mitsuba.shapes()[mesh]
    if shape.has_vertex_texcoords():
        keys = hash_rows(np.array(shape.vertex_texcoords_buffer(), np.float32).reshape(-1, 2), keys)
    return np.sort(keys).tobytes()
