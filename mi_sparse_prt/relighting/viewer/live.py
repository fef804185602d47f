"""A page that is open while Python runs: it asks for what it does not have inside."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import matplotlib
import mitsuba as mi

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.emission.environment import Environment
from mi_sparse_prt.operators.clustered import Clustered
from mi_sparse_prt.reflection.reflection import Diffuse
from mi_sparse_prt.relighting.viewer import page_scene
from mi_sparse_prt.relighting.viewer.answers import Answers
from mi_sparse_prt.relighting.viewer.archive import packed
from mi_sparse_prt.relighting.viewer.export import DIFFERENCES, KEPT, SCRIPTS, played_part, shown_part
from mi_sparse_prt.relighting.viewer.page_file import page_text
from mi_sparse_prt.relighting.viewer.visible_lamps import visible_lamps
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.transport import LightTransport


@dataclass(frozen=True)
class LivePage:
    """A page, and what answers it.

    Attributes
    ----------
    text : str
        HTML.
    answers : Answers
    camera : dict
        Where the first view is from: eye, target, up (world), height of the picture at distance 1.
    lights : tuple of str
        Names, the first shown first.
    notes : tuple of str
        What it shows otherwise than ``render`` does, a sentence each.
    """

    text: str
    answers: Answers
    camera: dict[str, Any]
    lights: tuple[str, ...]
    notes: tuple[str, ...]


def make_live_page(
    scene: Scene,
    transport: LightTransport,
    environments: Mapping[str, Environment],
    *,
    kept: float = KEPT,
    sensor: int | mi.Sensor | None = None,
    title: str = "light transport",
) -> LivePage:
    """A page of any matrix of vertices, which Python answers while it is open.

    Clustered PCA of diffuse surfaces is played by the page itself, as ``make_page`` has it. Of all others, colours of
    vertices are found here, for each light and, if surfaces are glossy, for each view.

    Parameters
    ----------
    scene : Scene
    transport : LightTransport
        Of vertices, and of a cubemap or of lamps.
    environments : dict of name to Environment
        Lights to choose from; none for lamps.
    kept, sensor, title
        As for ``make_page``.

    Returns
    -------
    LivePage

    Raises
    ------
    PrtError
        If the matrix is another scene's, or one of pixels or directions, or there is no light.
    """
    transport = transport.for_scene(scene)
    if transport.measurement.kind != "vertices":
        raise PrtError(f"a page shows matrices of vertices, this one is of {transport.measurement.kind}")
    lamps = visible_lamps(scene, transport.lighting) if transport.lights else None
    lights = dict(environments) if lamps is None else {"lamps": lamps.background}
    if not lights:
        raise PrtError("a page without light shows nothing: give at least one environment")
    drawn, operator = page_scene.draw_order(scene), transport.operators.get("compressed")
    arrays, about = shown_part(scene, transport, lights, sensor, drawn)
    if isinstance(operator, Clustered) and lamps is None and isinstance(transport.reflection, Diffuse):
        _, played, header = played_part(operator, lights, kept, drawn.order)
        arrays |= played
    else:
        resolution = transport.lighting.resolution if lamps is None else 1
        glossy = transport.terms > 0
        header = {
            "resolution": resolution,
            "streamed": True,
            "glossy": glossy,
            "shines": glossy or lamps is not None,
        }
    if lamps is not None:
        header |= {"lamps": list(transport.lights), "backgroundLamp": lamps.background_lamp}
    header |= {"live": True, "errors": _mesh_errors(transport)}
    text = page_text("index", SCRIPTS, title, packed(about | header, arrays, DIFFERENCES))
    answers = Answers(scene, transport, lights, drawn.order, lamps)
    return LivePage(text, answers, about["camera"], tuple(lights), tuple(about["notes"]))


def _mesh_errors(transport: LightTransport) -> dict[str, dict[str, Any]]:
    """Held-out error of each mesh, and a colour for it: bright where it is large."""
    found = transport.report.get("estimated_error") or {}
    errors = {name: float(error) for name, error in found.get("meshes", {}).items()}
    most = max(errors.values(), default=0.0)
    colours = matplotlib.colormaps["viridis"]
    return {
        name: {"error": error, "colour": [*map(float, colours(error / most if most > 0 else 0.0)[:3])]}
        for name, error in errors.items()
    }
