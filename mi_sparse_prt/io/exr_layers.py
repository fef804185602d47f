"""A picture and the layers that it is the sum of, in one .exr file: the light of each emitter apart."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.io.image_file import read_bitmap

SUFFIX = ".exr"
TOLERANCE = (
    0.01  # relative 2-norm by which a picture may be off the sum of its layers: half floats, compression
)
RENDER = "render it with `mi-sparse-prt many-lights SCENE.xml -o FILE.exr --groups`"

Floats = NDArray[np.float32]


def layers_bytes(image: Floats, layers: dict[str, Floats]) -> bytes:
    """A linear RGB image (height, width, 3) and layers of it, by name, as the content of one file."""
    stream, names = mi.MemoryStream(), [f"{name}.{c}" for name in layers for c in "RGB"]
    pixels = np.concatenate([image, *layers.values()], axis=2)
    bitmap = mi.Bitmap(np.ascontiguousarray(pixels, np.float32), channel_names=["R", "G", "B", *names])
    bitmap.write(stream, mi.Bitmap.FileFormat.OpenEXR)
    return bytes(stream.raw_buffer())


def read_layers(path: str | Path) -> dict[str, Floats]:
    """The layers of a picture, by name.

    Parameters
    ----------
    path : str or Path
        Of a file that ``layers_bytes`` made, or of any other whose channels are ``R``, ``G``, ``B`` and ``NAME.R``,
        ``NAME.G``, ``NAME.B`` of each layer.

    Returns
    -------
    dict of str to (height, width, 3) float32
        In the order of the file, which is alphabetical.

    Raises
    ------
    PrtError
        There is no such file, it cannot be read, has no layers, or these are not what its picture is the sum of.
    """
    channels = _channels(Path(path))
    names = [name.removesuffix(".R") for name in channels if name.endswith(".R")]
    found = {
        name: _rgb(channels, f"{name}.") for name in names if {f"{name}.G", f"{name}.B"} <= channels.keys()
    }
    if not found:
        raise PrtError(f"{path} has no layers of lamps: {RENDER}")
    if not all(np.isfinite(layer).all() for layer in found.values()):
        raise PrtError(f"{path} has pixels that are not finite: {RENDER}")
    if {"R", "G", "B"} <= channels.keys():
        image, total = _rgb(channels, ""), np.sum([*found.values()], axis=0, dtype=np.float64)
        if np.linalg.norm(total - image) > TOLERANCE * np.linalg.norm(image):
            raise PrtError(f"{path}: its layers are not lamps that add up to its picture: {RENDER}")
    return found


def _channels(path: Path) -> dict[str, Floats]:
    """All channels (height, width) of a file, by name."""
    bitmap = read_bitmap(path, RENDER)
    pixels = np.atleast_3d(np.array(bitmap)).astype(np.float32)
    return {field.name: pixels[..., k] for k, field in enumerate(bitmap.struct_())}


def _rgb(channels: dict[str, Floats], prefix: str) -> Floats:
    return np.stack([channels[f"{prefix}{c}"] for c in "RGB"], axis=-1)
