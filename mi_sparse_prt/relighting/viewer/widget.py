"""A viewer in a notebook: the page in a cell, light and camera as traits."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Mapping
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.emission.environment import Environment, environment_of
from mi_sparse_prt.relighting.image import render
from mi_sparse_prt.relighting.viewer.live import LivePage, make_live_page
from mi_sparse_prt.relighting.viewer.question import page_sensor
from mi_sparse_prt.relighting.viewer.turning import AXES, axis_up, turn_matrix
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.transport import LightTransport

try:
    import anywidget
    import traitlets
except ModuleNotFoundError:
    raise PrtError("a viewer in a notebook needs anywidget: pip install 'mi-sparse-prt[notebooks]'") from None

HEIGHT = 480  # pixels
PATIENCE = 20.0  # seconds for a browser to send a picture


class Viewer(anywidget.AnyWidget):
    """A page in a notebook, and what it shows; see ``show``.

    Attributes
    ----------
    light : str
        Name of the environment.
    degrees : float
        By which it is turned about ``axis``, counter-clockwise seen from its end.
    axis : {"x", "y", "z"}
        Of the world: +y, or +z where that is what the scene's camera calls up.
    tip : list of 3 float
        By which it is turned before that: about this direction of the world, by as many degrees as it is long.
        ``[90, 0, 0]`` stands an environment upright where +z is up.
    exposure : float
        Stops.
    camera : list of 6 float
        Where it is, and what it looks at; world.
    lamps : list of float
        How bright the lamps are, of a matrix of lamps.
    """

    _esm = files(__package__) / "page" / "widget.js"

    page = traitlets.Unicode().tag(sync=True)
    height = traitlets.Int(HEIGHT).tag(sync=True)
    light = traitlets.Unicode().tag(sync=True)
    degrees = traitlets.Float(0.0).tag(sync=True)
    axis = traitlets.Enum(tuple(AXES), "y").tag(sync=True)
    tip = traitlets.List(traitlets.Float(), [0.0, 0.0, 0.0], 3, 3).tag(sync=True)
    exposure = traitlets.Float(0.0).tag(sync=True)
    camera = traitlets.List(traitlets.Float()).tag(sync=True)
    lamps = traitlets.List(traitlets.Float()).tag(sync=True)

    def __init__(self, page: LivePage, height: int = HEIGHT) -> None:
        start = page.camera
        super().__init__(
            page=page.text,
            height=height,
            light=page.lights[0],
            axis=axis_up(start["up"]),
            camera=[*map(float, start["eye"]), *map(float, start["target"])],
            lamps=[1.0] * len(page.answers.transport.lights),
        )
        self._live, self._screenshots = page, dict[int, tuple[Any, Any]]()
        self.on_msg(self._received)

    def image(self, width: int = 640, height: int = 480, spp: int = 64) -> NDArray[np.float32]:
        """What the viewer shows, by ``prt.render``: the same light and camera.

        Parameters
        ----------
        width, height : int
            Pixels.
        spp : int
            Samples per pixel.

        Returns
        -------
        (height, width, 3) float32, linear RGB
            Of exposure 0.

        Raises
        ------
        PrtError
            If there is no light of this name.
        """
        start, answers = self._live.camera, self._live.answers
        place = {
            "eye": self.camera[:3],
            "target": self.camera[3:],
            "up": start["up"],
            "height": start["height"],
        }
        sensor = page_sensor(place | {"columns": width, "rows": height})
        if answers.transport.lights:
            light: Any = np.asarray(self.lamps, np.float32)
        elif self.light in answers.environments:
            light = answers.environments[self.light].rotated(turn_matrix(self.degrees, self.axis, self.tip))
        else:
            raise PrtError(f"there is no light {self.light!r}; there are: {', '.join(answers.environments)}")
        return render(answers.scene, answers.transport, light, sensor, spp)

    async def screenshot(self) -> bytes:
        """The page's own picture, as PNG: ``await viewer.screenshot()``, when the page is shown.

        Raises
        ------
        PrtError
            If no browser answers: none shows the page, or the kernel hears it only after this cell (run it in a cell
            of its own; ipykernel 7 hears it meanwhile).
        """
        number, loop = len(self._screenshots), asyncio.get_running_loop()
        found: asyncio.Future[bytes] = loop.create_future()
        self._screenshots[number] = loop, found
        self.send({"screenshot": number})
        try:
            return await asyncio.wait_for(found, PATIENCE)
        except TimeoutError:
            raise PrtError("no browser sent a picture: show the viewer, and ask in a cell after it") from None

    def _received(self, _: object, content: Mapping[str, Any], buffers: list[Any]) -> None:
        """A question of the page, or its picture."""
        sent = bytes(buffers[0]) if buffers else b""
        if "screenshot" in content:
            loop, found = self._screenshots[content["screenshot"]]
            loop.call_soon_threadsafe(lambda: found.done() or found.set_result(sent))
            return
        if content["header"].get("by") == "path":  # by a process of its own: the kernel does not wait for it
            threading.Thread(target=self._reply, args=(content, sent), daemon=True).start()
        else:
            self._reply(content, sent)

    def _reply(self, content: Mapping[str, Any], sent: bytes) -> None:
        header, answer = self._live.answers.reply(content["header"], sent)
        self.send({"number": content["number"], "header": header}, [answer])


def show(
    scene: Scene,
    transport: LightTransport,
    environments: Mapping[str, Environment] | Environment | None = None,
    *,
    height: int = HEIGHT,
) -> Viewer:
    """A viewer in a notebook: turn the light with the mouse.

    Clustered PCA (``prt.compress``) of diffuse surfaces is played by the browser; of other matrices, Python sends
    colours of vertices.

    Parameters
    ----------
    scene : Scene
    transport : LightTransport
        Of vertices, and of a cubemap or of lamps.
    environments : dict of name to Environment, or Environment, optional
        Lights to choose from; the scene's own if none is given. Not for lamps.
    height : int
        Of the page, pixels.

    Returns
    -------
    Viewer
        As the last line of a cell it is shown there.

    Raises
    ------
    PrtError
        If the matrix is another scene's or one of pixels, or there is no light.
    """
    if isinstance(environments, Environment):
        environments = {"environment": environments}
    elif environments is None:
        own = scene.mitsuba.environment()
        environments = {} if own is None else {"scene": environment_of(own)}
    return Viewer(make_live_page(scene, transport, environments), height)
