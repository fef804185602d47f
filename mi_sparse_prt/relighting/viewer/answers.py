"""What an open page asks of Python: colours of vertices, rows of T, pictures, and images to light with."""

from __future__ import annotations

import math
import tempfile
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.emission.environment import SUFFIXES, Environment, load_environment
from mi_sparse_prt.relighting.image import background_emitter, render
from mi_sparse_prt.relighting.viewer import page_scene
from mi_sparse_prt.relighting.viewer.turning import turn_matrix
from mi_sparse_prt.relighting.viewer.visible_lamps import VisibleLamps
from mi_sparse_prt.scene.mitsuba_meshes import lit_scene
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.transport import LightTransport

SPP = 4  # samples per pixel of a pass; passes go on while nothing moves
MOST_PIXELS = 1 << 22
MOST_BYTES = 1 << 28  # of a dropped image
NEAREST = 16  # vertices to choose from where a surface is clicked
LARGEST_HALF = 65504.0

Floats = NDArray[np.float32]
Question = Mapping[str, Any]
Answer = tuple[dict[str, Any], bytes]


class Answers:
    """Answers to the questions of a page, one at a time: it keeps nothing of who asks.

    Parameters
    ----------
    scene : Scene
    transport : LightTransport
        Of vertices; of a cubemap or of lamps.
    environments : dict of name to Environment
        Lights of the page, in their order; images that are dropped come after them.
    order : (n_v,) int64
        Which of the scene's vertices each vertex of the page is.
    lamps : VisibleLamps, optional
        Of a matrix of lamps.
    """

    def __init__(
        self,
        scene: Scene,
        transport: LightTransport,
        environments: Mapping[str, Environment],
        order: NDArray[np.int64],
        lamps: VisibleLamps | None = None,
    ) -> None:
        self.scene, self.transport, self._order, self._lamps = scene, transport, order, lamps
        self.environments = dict(environments)
        self._closed = False
        self._one = threading.Lock()  # two browsers do not render at the same time
        self._lit: tuple[object, mi.Scene] | None = None
        self._places = cKDTree(scene.positions)

    def close(self) -> None:
        """Answer no more; returns when the last answer was found."""
        self._closed = True
        self._one.acquire()

    def reply(self, question: Question, content: bytes = b"") -> Answer:
        """``answer``; what is wrong is the header's ``error``, in one line, and the page goes on."""
        try:
            return self.answer(question, content)
        except Exception as error:  # Mitsuba's own among them
            return {"error": " ".join(str(error).split()) or type(error).__name__}, b""

    def answer(self, question: Question, content: bytes = b"") -> Answer:
        """The answer to ``question["ask"]``: "colours", "row", "picture" or "environment".

        Returns
        -------
        header : dict
            JSON.
        content : bytes
            Little-endian numbers.

        Raises
        ------
        PrtError
            If the question makes no sense.
        """
        ways = {
            "colours": self._colours,
            "row": self._row,
            "picture": self._picture,
            "environment": self._environment,
        }
        if question.get("ask") not in ways:
            raise PrtError(f"a page asks for {', '.join(ways)}, not for {question.get('ask')!r}")
        if self._closed:
            raise PrtError("the page was closed")
        with self._one:
            return ways[question["ask"]](question, content)

    def _colours(self, question: Question, content: bytes) -> Answer:
        """Irradiance / pi of vertices under a light (m, 3); then what else leaves them, if there is more.

        That is what glossy terms add towards an eye, or the light of lamps themselves. Half floats.
        """
        light = np.frombuffer(content, "<f4")
        if light.size != 3 * self.transport.emission.size:
            raise PrtError(f"a light of {light.size} numbers; give 3 for each of {self.transport.emission!r}")
        found = self.transport.incident.relight(light.reshape(-1, 3))
        parts = [found[: self.scene.n_vertices]]
        if self.transport.terms:
            eye = _vector(question, "eye")
            away = eye - self.scene.positions
            away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-30)
            by_page = self.scene.albedo * parts[0]
            gloss = self.transport.leaving(found, away) - by_page
            faces = np.einsum("ij,ij->i", away, self.scene.normals) > 0  # what leaves others is not known
            parts.append(np.where(faces[:, None], gloss, 0))
        elif self._lamps is not None:
            parts.append(self._lamps.shine(light.reshape(-1, 3), self.scene.n_vertices))
        halves = [np.clip(part[self._order], -LARGEST_HALF, LARGEST_HALF).astype("<f2") for part in parts]
        return {}, b"".join(part.tobytes() for part in halves)

    def _row(self, question: Question, content: bytes) -> Answer:
        """The row of T (m, 3) of the vertex where a ray from the eye meets a surface; nothing where it meets none."""
        origin, towards = _vector(question, "eye"), _vector(question, "towards")
        if not towards.any():
            raise PrtError("towards=[0, 0, 0] is no direction")
        ray = mi.Ray3f(origin.tolist(), (towards / np.linalg.norm(towards)).tolist())
        si = self.scene.mitsuba.ray_intersect(ray)
        if not si.is_valid()[0]:
            return {"vertex": None}, b""
        vertex = self._seen_vertex(np.array(si.p).ravel(), -towards)
        mesh = next(m.name for m in self.scene.meshes if m.vertices.start <= vertex < m.vertices.stop)
        row = self.transport.rows([vertex])[0]
        return {"vertex": vertex, "mesh": mesh}, row.astype("<f4").tobytes()

    def _seen_vertex(self, place: NDArray[np.floating], towards: NDArray[np.floating]) -> int:
        """The nearest vertex whose surface faces an eye; the nearest of all if none does."""
        _, near = self._places.query(place, min(NEAREST, self.scene.n_vertices))
        near = np.atleast_1d(near)
        facing = self.scene.normals[near] @ towards > 0
        return int(near[np.argmax(facing)])

    def _picture(self, question: Question, content: bytes) -> Answer:
        """One pass of a picture (height, width, 3), linear RGB in half floats, by ``render`` or by ``path``."""
        sensor = page_sensor(question)
        seed = _whole(question, "pass", 0, 1 << 20)
        light = self._light(question, content)
        if question.get("by") == "render":
            image = render(self.scene, self.transport, light, sensor, SPP, seed)
        elif question.get("by") == "path":
            image = self._by_path(light, sensor, seed)
        else:
            raise PrtError(f"pictures are by render or path, not by {question.get('by')!r}")
        return {"spp": SPP}, np.clip(image, 0, LARGEST_HALF).astype("<f2").tobytes()

    def _by_path(self, light: Environment | Floats, sensor: mi.Sensor, seed: int) -> Floats:
        """Mitsuba's own, to the depth of the matrix."""
        path = mi.load_dict({"type": "path", "max_depth": self.transport.max_depth})
        arguments: dict[str, Any] = {"sensor": sensor, "integrator": path, "spp": SPP, "seed": seed}
        if not isinstance(light, Environment):
            with self.transport.emission.scene_lit_by(light, self.scene) as lit:
                return np.array(mi.render(lit, **arguments))[..., :3]
        key = id(light.pixels), light.rotation.tobytes()
        if self._lit is None or self._lit[0] != key:
            emitter = background_emitter(light, self.transport.lighting)
            self._lit = key, lit_scene(self.scene.unlit_shapes(), emitter)
        return np.array(mi.render(self._lit[1], **arguments))[..., :3]

    def _light(self, question: Question, content: bytes) -> Environment | Floats:
        """An environment that is turned, or how bright lamps are (m, 3)."""
        if not isinstance(self.transport.emission, CubemapLighting):
            return np.frombuffer(content, "<f4").reshape(-1, 3)
        number = _whole(question, "environment", 0, len(self.environments))
        chosen = list(self.environments.values())[number]
        tip = _vector({"tip": [0, 0, 0]} | dict(question), "tip").tolist()
        return chosen.rotated(turn_matrix(_number(question, "degrees"), question.get("axis", "y"), tip))

    def _environment(self, question: Question, content: bytes) -> Answer:
        """A dropped image as one more light of the page: its radiance (RGB9_E5), and its background."""
        name = str(question.get("name"))
        suffix = Path(name).suffix.lower()
        if suffix not in SUFFIXES:
            raise PrtError(f"not an HDR image by its name; drop a file that ends in {', '.join(SUFFIXES)}")
        if len(content) > MOST_BYTES:
            raise PrtError(f"larger than {MOST_BYTES >> 20} MB: make it smaller")
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / f"dropped{suffix}"
            file.write_bytes(content)
            try:
                environment = load_environment(file)
            except PrtError as error:
                raise PrtError(str(error).replace(str(file), name)) from None
        while name in self.environments:
            name = f"{name} "  # another image of the same name
        self.environments[name] = environment
        arrays, about = page_scene.lights({name: environment})
        header = about[0] | {"number": len(self.environments) - 1}
        return header, arrays["environment0"].astype("<u4").tobytes()


def _number(question: Question, name: str) -> float:
    value = question.get(name)
    if not isinstance(value, int | float) or not math.isfinite(value):
        raise PrtError(f"{name}={value!r}: a number is asked for")
    return float(value)


def _whole(question: Question, name: str, least: int, stop: int) -> int:
    value = question.get(name)
    if not isinstance(value, int) or not least <= value < stop:
        raise PrtError(f"{name}={value!r}: a whole number from {least} to {stop - 1} is asked for")
    return value


def _vector(question: Question, name: str) -> NDArray[np.float32]:
    value = question.get(name)
    if not isinstance(value, list) or len(value) != 3:
        raise PrtError(f"{name}={value!r}: three numbers are asked for")
    return np.array([_number({name: x}, name) for x in value], np.float32)


def page_sensor(question: Question) -> mi.Sensor:
    """The page's camera: eye, target, up (world), height at distance 1, and columns and rows of pixels."""
    across, down = (_whole(question, name, 1, 1 << 14) for name in ("columns", "rows"))
    if across * down > MOST_PIXELS:
        raise PrtError(f"{across} x {down} pixels: make the window smaller")
    eye, target, up = (_vector(question, name).tolist() for name in ("eye", "target", "up"))
    height = _number(question, "height")
    if eye == target or height <= 0:
        raise PrtError("a camera looks at another place than its own, and its picture has a height")
    return mi.load_dict(
        {
            "type": "perspective",
            "fov_axis": "y",
            "fov": math.degrees(2 * math.atan(height / 2)),
            "to_world": mi.ScalarTransform4f().look_at(eye, target, up),
            "film": {
                "type": "hdrfilm",
                "width": across,
                "height": down,
                "rfilter": {"type": "box"},
            },
        }
    )
