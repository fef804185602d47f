"""What an open page asks of Python: colours of vertices, rows of T, pictures, and images to light with."""

from __future__ import annotations

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
from mi_sparse_prt.relighting.image import render
from mi_sparse_prt.relighting.viewer import page_scene
from mi_sparse_prt.relighting.viewer.path_pictures import PathPictures
from mi_sparse_prt.relighting.viewer.question import Question, number, page_sensor, vector, whole
from mi_sparse_prt.relighting.viewer.turning import turn_matrix
from mi_sparse_prt.relighting.viewer.visible_lamps import VisibleLamps
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.transport import LightTransport

SPP = 4  # samples per pixel of a pass; passes go on while nothing moves
MOST_BYTES = 1 << 28  # of a dropped image
NEAREST = 16  # vertices to choose from where a surface is clicked
LARGEST_HALF = 65504.0

Floats = NDArray[np.float32]
Answer = tuple[dict[str, Any], bytes]


class Answers:
    """Answers to the questions of a page, one at a time: it keeps nothing of who asks.

    Pictures by ``path`` are made in a process of their own beside all others, see ``PathPictures``.

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
        self._path = PathPictures(scene, transport, self._one)
        self._places = cKDTree(scene.positions)

    def close(self) -> None:
        """Answer no more; returns when the last answer was found."""
        self._closed = True
        self._path.close()
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
            "picture": self._render,
            "environment": self._environment,
        }
        if question.get("ask") not in ways:
            raise PrtError(f"a page asks for {', '.join(ways)}, not for {question.get('ask')!r}")
        if self._closed:
            raise PrtError("the page was closed")
        if question["ask"] == "picture" and question.get("by") == "path":
            return self._render_by_path(question, content)
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
            eye = vector(question, "eye")
            away = eye - self.scene.positions
            away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-30)
            by_page = self.scene.albedo * parts[0]
            gloss = self.transport.leaving(found, away) - by_page
            faces = np.einsum("ij,ij->i", away, self.scene.normals) > 0  # what leaves others is not known
            parts.append(np.where(faces[:, None], gloss, 0))
        elif self._lamps is not None:
            parts.append(self._lamps.shine(light.reshape(-1, 3), self.scene.n_vertices))
        return {}, b"".join(_in_halves(part[self._order]) for part in parts)

    def _row(self, question: Question, content: bytes) -> Answer:
        """The row of T (m, 3) of the vertex where a ray from the eye meets a surface; nothing where it meets none."""
        origin, towards = vector(question, "eye"), vector(question, "towards")
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

    def _render(self, question: Question, content: bytes) -> Answer:
        """One pass of a picture (height, width, 3) by ``render``, linear RGB in half floats."""
        if question.get("by") != "render":
            raise PrtError(f"pictures are by render or path, not by {question.get('by')!r}")
        sensor, seed = page_sensor(question), _pass(question)
        image = render(self.scene, self.transport, self._light(question, content), sensor, SPP, seed)
        return {"spp": SPP}, _in_halves(image)

    def _render_by_path(self, question: Question, content: bytes) -> Answer:
        """The same by Mitsuba's own ``path``, to the depth of the matrix."""
        page_sensor(question)  # what is wrong with it is said here
        seed = _pass(question)
        image = self._path.render(self._light(question, content), question, SPP, seed)
        return {"spp": SPP}, _in_halves(image)

    def _light(self, question: Question, content: bytes) -> Environment | Floats:
        """An environment that is turned, or how bright lamps are (m, 3)."""
        if not isinstance(self.transport.emission, CubemapLighting):
            return self.transport.emission.project(np.frombuffer(content, "<f4").reshape(-1, 3))
        chosen = list(self.environments.values())[whole(question, "environment", 0, len(self.environments))]
        tip = vector({"tip": [0, 0, 0]} | dict(question), "tip").tolist()
        return chosen.rotated(turn_matrix(number(question, "degrees"), question.get("axis", "y"), tip))

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


def _pass(question: Question) -> int:
    """Which pass of a picture is asked for: its seed."""
    return whole(question, "pass", 0, 1 << 20)


def _in_halves(image: Floats) -> bytes:
    """Half floats, as pages read them."""
    return np.clip(image, -LARGEST_HALF, LARGEST_HALF).astype("<f2").tobytes()
