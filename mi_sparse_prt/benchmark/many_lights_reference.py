"""All lights at some pixels: what pictures by many lights are measured against."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from mi_sparse_prt.core.metrics import relative_l2_of_sample
from mi_sparse_prt.core.run import Run
from mi_sparse_prt.manylights.baselines import all_lights
from mi_sparse_prt.manylights.elements import Elements, Floats
from mi_sparse_prt.manylights.render import RowColumn, Settings

PIXELS = 5000  # errors of one picture at other pixels differ by 1 to 3%
PICTURE = (
    1200,
    9000,
)  # rows and columns of what pictures are compared with by eye, where they have more pixels


class Reference:
    """All lights, at pixels at random, or at all of a small image.

    Pixels are means of their samples, whatever the film's filter, as the predicted errors have them.

    Parameters
    ----------
    elements : Elements
    run : Run
        Shows progress.
    folder : Path
        Where finished rows are kept.
    pixels : int
        At most.

    Attributes
    ----------
    pixels : (k,) int64
        Ascending.
    radiance : (k, 3) float64
        Linear RGB, of all lights and of what is seen besides.
    """

    def __init__(self, elements: Elements, run: Run, folder: Path, pixels: int = PIXELS) -> None:
        self._elements, samples = elements, elements.samples
        height, width = samples.shape
        rng = np.random.default_rng(0)
        self.pixels = np.sort(rng.choice(width * height, min(pixels, width * height), replace=False))
        pixel_of_row = samples.ids // samples.spp
        self._rows = np.flatnonzero(np.isin(pixel_of_row, self.pixels))
        self._place = np.searchsorted(self.pixels, pixel_of_row[self._rows])
        self._values = all_lights(elements, run, self._rows, folder)
        self.radiance = self._means(self._values)

    @property
    def is_whole(self) -> bool:
        """Whether there are no other pixels."""
        height, width = self._elements.samples.shape
        return len(self.pixels) == width * height

    def _means(self, values: Floats) -> np.ndarray:
        """Means (k, 3) over the samples of pixels, of what their rows reflect, and what they see besides."""
        samples = self._elements.samples
        total = samples.seen.reshape(-1, samples.spp, 3)[self.pixels].sum(axis=1, dtype=np.float64)
        np.add.at(total, self._place, values)
        return total / samples.spp

    def error(self, values: Floats) -> tuple[float, float]:
        """Relative 2-norm error of what all rows (m, 3) reflect; and its standard error, as pixels are at random."""
        return relative_l2_of_sample(*self._squares(values))

    def _squares(self, values: Floats) -> tuple[np.ndarray, np.ndarray]:
        off = self._means(values[self._rows]) - self.radiance
        return np.square(off).sum(axis=1), np.square(self.radiance).sum(axis=1)

    def square(self) -> float:
        """Squared 2-norm of the whole image, estimated."""
        height, width = self._elements.samples.shape
        return float(np.square(self.radiance).sum()) * width * height / max(len(self.pixels), 1)

    def values(self, settings: Settings) -> Floats:
        """What all rows (m, 3) reflect: of all lights where all pixels are known, else of very many columns."""
        if self.is_whole:
            return self._values
        rows, columns = (min(k, most) for k, most in zip(PICTURE, self._elements.shape, strict=True))
        fine = replace(settings, method="adaptive", rows=rows, columns=columns, seconds=None)
        return RowColumn(self._elements, fine, Run(settings.seed)).estimate().values
