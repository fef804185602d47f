"""What surfaces send to each other, where no camera sees all of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.reflection.in_out_factors import InOutFactors
from mi_sparse_prt.reflection.reflection import Reflection


@dataclass(frozen=True)
class SentLight:
    """R of vertices as other surfaces see them: with terms at some vertices of surfaces that cameras' rays go on from.

    Attributes
    ----------
    reflection : InOutFactors
        Its glossy vertices send what they reflect; they are those of the matrix, and others.
    senders : (n,) int64
        Of each vertex the one whose light is sent in its place: itself, but where terms are known at fewer vertices.
    """

    reflection: InOutFactors
    senders: NDArray[np.int64]

    def rows_of(self, seen: Reflection) -> NDArray[np.int64]:
        """Where incident rows of the matrix are among those of light that is sent."""
        n = len(seen.albedo)
        number = np.searchsorted(self.reflection.glossy, seen.glossy)
        terms = n + number[:, None] * self.reflection.terms + np.arange(seen.terms)
        return np.concatenate([np.arange(n), terms.ravel()])
