"""T applied to light that moves, frame by frame ([OBRG06])."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.emission.haar import haar_colours
from mi_sparse_prt.reflection.reflection import Diffuse
from mi_sparse_prt.relighting.approximations import (
    Approximation,
    Everything,
    Incremental,
    NonIncremental,
    PerBand,
    wavelet_bands,
)
from mi_sparse_prt.relighting.players import player
from mi_sparse_prt.transport import LightTransport

Floats = NDArray[np.float32]

APPROXIMATIONS: dict[str, type[Approximation]] = {
    kind.name: kind for kind in (PerBand, Incremental, NonIncremental, Everything)
}
FEWEST = 8  # wavelets of a frame, whatever its time


class Relighter:
    """Colours of vertices under a light that moves, and exact ones as soon as it stands still.

    Parameters
    ----------
    transport : LightTransport
        Of a cubemap. Compressed ones are quick (``prt.compress``); any other is relit in full in every frame.
    approximation : {"per_band", "incremental", "non_incremental", "everything"}
        How to choose the wavelets of a frame (``relighting.approximations``).
    budget : int or None
        Wavelets of a frame, at most; None for all that changed. The first frame has all.
    by_image : bool
        Choose wavelets by what they do to the vertices together; else by the area they cover, as [OBRG06] does. Bands
        are told to start anew by all combinations in the first case, and one by one in the second.
    vectors : int, optional
        Basis vectors of each cluster whose weights are applied in a frame, of clustered PCA alone; a quarter of them if
        not given.
    rate : float, optional
        Frames per second: the budget then follows from the time that frames take, ``budget`` being that of the first.

    Raises
    ------
    PrtError
        If the transport's light is no cubemap, the approximation is not known, or a number makes no sense.
    """

    def __init__(
        self,
        transport: LightTransport,
        approximation: str = "per_band",
        budget: int | None = 100,
        *,
        by_image: bool = True,
        vectors: int | None = None,
        rate: float | None = None,
    ) -> None:
        lighting = transport.emission
        if not isinstance(lighting, CubemapLighting):
            raise PrtError(f"moving light needs a cubemap, this matrix has {lighting!r}: use relight")
        if approximation not in APPROXIMATIONS:
            raise PrtError(f"approximation {approximation!r} is none of {', '.join(APPROXIMATIONS)}")
        if budget is not None and budget < 0:
            raise PrtError(f"a budget of {budget} wavelets: give 0 or more, or None for all")
        if vectors is not None and vectors < 1:
            raise PrtError(f"{vectors} basis vectors in a frame: give 1 or more")
        if rate is not None and not rate > 0:
            raise PrtError(f"{rate} frames per second: give a number above 0")
        self.transport, self.budget, self.rate = transport, budget, rate
        bands = wavelet_bands(lighting.resolution)
        groups = bands.count if approximation == PerBand.name else 1
        self.player = player(transport.incident, lighting, groups, vectors)
        norms = self.player.column_norms() if by_image else None
        chosen = APPROXIMATIONS[approximation]
        bands = wavelet_bands(lighting.resolution, norms)
        self.approximation = PerBand(bands, by_image, 1 + by_image) if chosen is PerBand else chosen(bands)
        self._scale = np.sqrt(lighting.solid_angles, dtype=np.float32)
        self._started = False

    def reset(self) -> None:
        """Start again, as with the first frame."""
        self.player.reset()
        self.approximation.reset()
        self._started = False

    def relight(self, light: Any, outgoing: ArrayLike | None = None) -> Floats:
        """Light leaving the points in a new frame.

        Parameters
        ----------
        light : (n_directions, 3) float, or anything that ``CubemapLighting.project`` takes
            L of this frame.
        outgoing : (n, 3) float, world, optional
            Directions in which light leaves glossy points, as for ``LightTransport.relight``.

        Returns
        -------
        (n, 3) float32
            As ``LightTransport.relight``.

        Raises
        ------
        PrtError
            If the light is not finite or has another shape: nothing changed then.
        """
        start, first = time.perf_counter(), not self._started
        self.follow(light)
        colours = self.colours(outgoing)
        if self.rate is not None and self.budget is not None and not first:
            slower = np.clip((time.perf_counter() - start) * self.rate, 0.8, 2)
            self.budget = int(np.clip(self.budget / slower, FEWEST, len(self._scale)))
        return colours

    def follow(self, light: Any) -> None:
        """Bring incident light up to date, without what leaves."""
        texels = self.transport.emission.project(light)
        coefficients = haar_colours(texels, self._scale)
        update = self.approximation.update(coefficients, self.budget if self._started else None)
        self.player.apply(update)
        self._started = True

    @property
    def incident(self) -> Floats:
        """Light (rows, 3) of vertices and terms in the last frame, for ``FixedCamera.image``."""
        return self.player.incident

    def colours(self, outgoing: ArrayLike | None = None) -> Floats:
        """What leaves the points under the light of the last frame: also for another view alone."""
        reflection, measurement = self.transport.reflection, self.transport.measurement
        if isinstance(reflection, Diffuse) and measurement.weights is None:
            return self.player.radiance(reflection.albedo)
        return self.transport.leaving(self.incident, outgoing)
