"""A picture for each of many lights around the scene, one at a time: what people photograph with a light stage."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from mi_sparse_prt.cli.film import FrameFolder, make_film
from mi_sparse_prt.cli.running import Command
from mi_sparse_prt.relighting.film import images_one_light_at_a_time
from mi_sparse_prt.relighting.light import even_lights
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.transport import LightTransport

LIGHTS = "lights.json"  # beside the pictures
SUFFIX = ".exr"


def make_pictures_of_each(
    command: Command,
    scene: Scene,
    transport: LightTransport,
    count: int,
    folder: Path,
    camera: tuple[int, int],
    progress: bool,
) -> dict[str, Any]:
    """Write 0000.exr, 0001.exr, ... and where their lights are; what a report says of these.

    Parameters
    ----------
    command : Command
    scene : Scene
    transport : LightTransport
    count : int
        Lights.
    folder : Path
        Made if it is not there.
    camera : (int, int)
        Which of the scene's sensors, and samples per pixel.
    progress : bool
    """
    images = images_one_light_at_a_time(scene, transport, count, *camera)
    directions, owners = even_lights(transport.lighting, count)
    angles = [float(transport.lighting.solid_angles[owners == k].sum()) for k in range(count)]
    lights = [
        {"direction": towards.tolist(), "solid_angle": angle}
        for towards, angle in zip(directions, angles, strict=True)
    ]
    into = FrameFolder(command, folder, count, 0.0, SUFFIX)
    size = make_film(command, into, images, count, progress)
    text = json.dumps({"radiance": 1, "lights": lights}, indent=1).encode()
    command.write(folder / LIGHTS, text, part_of=folder)
    return {"path": str(folder), "pictures": count, "bytes": size + len(text)}
