"""How much longer brute force takes for the same error, from its time and noise at a few numbers of paths."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class BruteForce:
    """Time and error of exact direct light and path-traced indirect light, at any number of paths per element.

    Its direct light is exact, so that all of its error is noise and falls as 1 / sqrt(spp). Time is interpolated
    between the measured numbers of paths, and beyond the largest grows in proportion to it.

    Attributes
    ----------
    direct_seconds : float
    spp : tuple of int
        Ascending.
    path_seconds, errors, standard_errors : tuple of float
        At each of ``spp``, of the whole matrix.
    """

    direct_seconds: float
    spp: tuple[int, ...]
    path_seconds: tuple[float, ...]
    errors: tuple[float, ...]
    standard_errors: tuple[float, ...]

    @property
    def noise(self) -> float:
        """Relative L2 at one path per element, from all measurements, each by how well it is known."""
        at_one = np.array(self.errors) * np.sqrt(self.spp)
        deviation = np.array(self.standard_errors) * np.sqrt(self.spp)
        return float(np.average(at_one, weights=1 / np.maximum(deviation, 1e-9) ** 2))

    def error(self, spp: float) -> float:
        """Relative L2 of the whole matrix."""
        return self.noise / float(np.sqrt(spp))

    def seconds(self, spp: float) -> float:
        """Of the whole matrix."""
        if spp > self.spp[-1]:
            return self.direct_seconds + self.path_seconds[-1] * spp / self.spp[-1]
        return self.direct_seconds + float(np.interp(spp, self.spp, self.path_seconds))

    def compared(self, seconds: float, error: float) -> dict[str, Any]:
        """A method against brute force at the method's error.

        Parameters
        ----------
        seconds, error : float
            Of the method; the error is relative L2.

        Returns
        -------
        dict
            ``spp`` at which brute force has that error, at least 1; its ``seconds``; ``speed_up``, how many times as
            long it takes; ``extrapolated``, whether so many paths were never traced. All are None where the error is
            too small to be told from none.
        """
        if error <= 0:
            return {"spp": None, "seconds": None, "speed_up": None, "extrapolated": None}
        spp = max(1.0, (self.noise / error) ** 2)
        own = self.seconds(spp)
        return {
            "spp": spp,
            "seconds": own,
            "speed_up": own / seconds,
            "extrapolated": spp > self.spp[-1],
        }
