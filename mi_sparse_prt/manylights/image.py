"""A picture of many lights, and the light of each emitter apart."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.errors import PrtError

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class ManyLightsImage:
    """A picture, and how it came about.

    Attributes
    ----------
    image : (height, width, 3) float32
        Linear RGB, of the film's crop window.
    alpha : (height, width) float32
        Share of each pixel that is covered by what the scene shows.
    layers : dict of str to (height, width, 3) float32
        Of ``groups``: what each emitter of the scene adds, by name, itself where it is seen among it. Their sum is the
        image. Under other colours and intensities of the emitters, it is another weighted sum (``mixed``).
    report : dict
        ``seconds`` by phase, ``rows``, ``columns``, ``samples``, ``lights`` (by emitter), ``elements_total``,
        ``elements_evaluated``, ``estimated_error`` (relative 2-norm of the image, None where it is not known; with
        ``compensate`` the noise of its paths is in it), ``tries`` (with ``error``: rows, columns and estimated error of
        each), ``left_out``, ``clamp``, ``peak_memory_bytes``,
        ``parameters``, ``seed``, ``versions``. JSON as it is.

        ``left_out`` has shares of the mean radiance of the image with all light, each with its ``standard_error``:
        ``clamped``, what the clamp cuts off, and ``specular``, light by way of mirrors and glass between samples and
        lights. They are missing in the image, or were ``added``.
    """

    image: Floats
    alpha: NDArray[np.float32]
    layers: dict[str, Floats]
    report: dict[str, Any]

    def mixed(self, weights: Mapping[str, float | Sequence[float]]) -> Floats:
        """The image (height, width, 3) under emitters of other intensities and colours: a weighted sum of layers.

        Parameters
        ----------
        weights : dict of str to float or RGB
            By what the radiance of each emitter is multiplied; 1 for those that are not named.

        Raises
        ------
        PrtError
            There are no layers, or none of that name; a weight is not one or three numbers of 0 or more.
        """
        if not self.layers:
            raise PrtError("the picture has no layers to mix: render it with groups=True")
        if unknown := [name for name in weights if name not in self.layers]:
            raise PrtError(f"no emitter is named {unknown[0]!r}: choose from {', '.join(self.layers)}")
        image = np.zeros_like(self.image)
        for name, layer in self.layers.items():
            image += layer * _rgb_weight(name, weights.get(name, 1.0))
        return image


def _rgb_weight(name: str, weight: float | Sequence[float]) -> Floats:
    """One or three numbers of 0 or more."""
    try:
        found = np.asarray(weight, np.float32)
    except (TypeError, ValueError):
        found = np.full(1, np.nan, np.float32)
    if found.shape not in ((), (3,)) or not np.all(np.isfinite(found) & (found >= 0)):
        raise PrtError(f"the weight of {name!r} is {weight!r}: give a number of 0 or more, or three of them")
    return found


def relative_error(image: Floats, squared_error: float) -> float:
    """Relative 2-norm of an error; 0 of a black image, NaN where the error is not known."""
    norm = float(np.square(image, dtype=np.float64).sum())
    return float(np.sqrt(squared_error / norm)) if norm > 0 else 0.0
