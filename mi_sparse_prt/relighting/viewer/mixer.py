"""A light mixer: a page on which the lamps of a picture are dimmed, coloured and switched, in milliseconds."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.relighting.viewer.archive import packed
from mi_sparse_prt.relighting.viewer.page_file import PageFile, page_text

SCRIPTS = ("archive", "shared", "webgl", "mixer")
LARGEST = 32768.0  # number that each layer is scaled to, for most of the range of half floats to lie below
MOST_BYTES = 1 << 28  # of all layers

Floats = NDArray[np.float32]


def make_mixer(layers: Mapping[str, Floats], title: str = "light mixer") -> PageFile:
    """One HTML file that mixes the light of a picture's lamps; it needs WebGL 2, and nothing from a network.

    Parameters
    ----------
    layers : dict of str to (height, width, 3)
        What each lamp adds to the picture, by name, linear RGB: ``render_many_lights(groups=True).layers``.
    title : str

    Returns
    -------
    PageFile
        The last line of a notebook's cell shows it.

    Raises
    ------
    PrtError
        There are no layers, their sizes differ, or they are too large for a page.
    """
    shapes = {np.shape(layer) for layer in layers.values()}
    if len(shapes) != 1 or len(shape := shapes.pop()) != 3 or shape[2] != 3 or not min(shape):
        raise PrtError("a mixer needs layers of one size, (height, width, 3): render with groups=True")
    size = 2 * len(layers) * int(np.prod(shape))
    if size > MOST_BYTES:
        raise PrtError(
            f"{len(layers)} layers of {shape[1]} x {shape[0]} pixels are {size >> 20} MB, and a page holds "
            f"{MOST_BYTES >> 20}: render a smaller picture"
        )
    scales = [float(np.abs(layer).max()) / LARGEST or 1.0 for layer in layers.values()]
    halves = [(layer / scale).astype("<f2") for layer, scale in zip(layers.values(), scales, strict=True)]
    header = {"width": shape[1], "height": shape[0], "lamps": list(layers), "scales": scales}
    data = packed(header, {"layers": np.stack(halves).view("<u2")}, frozenset())
    return PageFile(page_text("mixer", SCRIPTS, title, data))
