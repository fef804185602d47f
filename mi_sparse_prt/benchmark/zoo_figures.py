"""The contact sheet of a zoo: each scene by ``sparse_prt``, by ``path``, and what they differ by."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from mi_sparse_prt.validation.matrix_figures import tonemapped

COLUMNS = 4  # scenes beside each other
DIFFERENCE = 5  # times as bright
GAP, LABEL = 6, 16  # pixels between scenes, and above each for its name
DPI = 110  # figures are saved so: a pixel of an image is a pixel of the file
PAPER, MISSING = 1.0, 0.85  # grey of the sheet, and of pictures that there are not
INK = {"agrees": "darkgreen", "told to be off": "darkorange"}  # of names; red of all others

Image = NDArray[np.float32]


@dataclass(frozen=True)
class SceneImages:
    """Linear images (height, width, 3) of a scene, as far as there are any.

    Attributes
    ----------
    reference : (height, width, 3) float32, optional
    ours : (height, width, 3) float32, optional
    """

    reference: Image | None = None
    ours: Image | None = None


def draw_contact_sheet(images: Mapping[str, SceneImages], verdicts: Mapping[str, str]) -> Figure:
    """Three pictures of each scene in a row: ours, ``path``, and five times their difference, in one tone curve.

    Parameters
    ----------
    images : dict of SceneImages
        By name; all of one size.
    verdicts : dict of str
        By name, written beside it.

    Returns
    -------
    Figure
        Whose pixels are those of the images.
    """
    known = (image.reference for image in images.values() if image.reference is not None)
    height, width = next(known, np.zeros((72, 96, 3))).shape[:2]
    cell = height + LABEL + GAP, 3 * width + GAP
    rows = -(-len(images) // COLUMNS)
    sheet = np.full((rows * cell[0], COLUMNS * cell[1], 3), PAPER)
    figure = Figure(figsize=(sheet.shape[1] / DPI, sheet.shape[0] / DPI), dpi=DPI)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    for k, (name, pictures) in enumerate(images.items()):
        y, x = k // COLUMNS * cell[0], k % COLUMNS * cell[1]
        sheet[y + LABEL : y + LABEL + height, x : x + 3 * width] = _in_a_row(pictures, height, width)
        ink = INK.get(verdicts[name], "darkred")
        axes.text(x + 1, y + LABEL / 2, f"{name}: {verdicts[name]}", fontsize=6.5, color=ink, va="center")
    axes.axis("off")
    axes.imshow(np.clip(sheet, 0, 1), interpolation="nearest")
    return figure


def _in_a_row(pictures: SceneImages, height: int, width: int) -> NDArray[np.floating]:
    """Ours, the reference and their difference as one picture (height, 3 width, 3) in [0, 1]."""
    row = np.full((height, 3 * width, 3), MISSING)
    truth, ours = pictures.reference, pictures.ours
    if truth is None:
        return row
    brightest = float(np.percentile(truth, 99))
    row[:, width : 2 * width] = tonemapped(truth, brightest)
    if ours is not None:
        row[:, :width] = tonemapped(ours, brightest)
        row[:, 2 * width :] = tonemapped(DIFFERENCE * np.abs(ours - truth), brightest)
    return row
