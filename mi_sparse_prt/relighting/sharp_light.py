"""Light of an environment that is sharper than texels and vertices can tell: a sun, a lamp far away.

Its shadows are found at the pixel, by one shadow ray of each sample, as those of a scene's own lamps are. What surfaces
send each other of it comes from the matrix.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.emission.environment import Environment, emitter_of, radiance_of
from mi_sparse_prt.emission.equirectangular import pixel_solid_angles, resampled
from mi_sparse_prt.transport import Coefficients, LightTransport

HEIGHT = 512  # pixels: a sun is one and a half of these wide
SMALL = 0.05  # steradians that light comes from, at most: 13 degrees across, two texels of a resolution of 16
WORTH = 0.1  # of all light: less is left to the matrix
LUMINANCE = (0.2126, 0.7152, 0.0722)


class SharpLight(NamedTuple):
    """The sharp part of an environment.

    Attributes
    ----------
    environment : Environment
    emitter : mi.Emitter
        The same.
    """

    environment: Environment
    emitter: mi.Emitter

    def taken_from(self, irradiance: NDArray[np.float32], transport: LightTransport) -> NDArray[np.float32]:
        """Irradiance / pi (k, n, 3) by depth without what arrives of it directly."""
        return irradiance - _direct_of(transport).irradiance_by_depth(self.environment)

    def taken_from_terms(self, found: list[Coefficients], transport: LightTransport) -> list[Coefficients]:
        """The same of coefficients."""
        (own,) = _direct_of(transport).coefficients_by_depth(self.environment)
        return [Coefficients(some.unit_albedo - own.unit_albedo, some.terms - own.terms) for some in found]


def sharp_light(environment: mi.Emitter) -> SharpLight | None:
    """What the brightest part of an environment has more than the rest of it; None if that is next to nothing.

    Parameters
    ----------
    environment : mi.Emitter

    Notes
    -----
    That part is of a fixed size. Where light comes from more of the sky, such as a window or an overcast sky, the
    brightest part is hardly brighter than what is beside it.
    """
    shone = np.maximum(radiance_of(environment, 2 * HEIGHT), 0)
    pixels = resampled(shone, HEIGHT, 2 * HEIGHT)
    brightness = pixels @ np.array(LUMINANCE, np.float32)
    solid_angles = pixel_solid_angles(HEIGHT, 2 * HEIGHT)
    all_of_it = float((brightness * solid_angles).sum())
    if SMALL * brightness.max() <= WORTH * all_of_it:
        return None  # nothing is bright enough
    order = np.argsort(brightness, axis=None)[::-1]
    within = int(np.searchsorted(np.cumsum(solid_angles.ravel()[order]), SMALL))
    rest = brightness.ravel()[order[within]]
    excess = pixels * np.maximum(1 - rest / np.maximum(brightness, 1e-30), 0)[..., None]
    if float((excess @ np.array(LUMINANCE) * solid_angles).sum()) <= WORTH * all_of_it:
        return None
    found = Environment(excess, source="sharp light")
    return SharpLight(found, emitter_of(found))


def _direct_of(transport: LightTransport) -> LightTransport:
    """Its direct light alone."""
    return replace(transport, operators={"direct": transport.operators["direct"]})
