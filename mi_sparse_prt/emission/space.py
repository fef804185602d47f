"""E, the light that may change, with a finite basis ([Leh07] eq. 12): what any basis has to know of itself."""

from __future__ import annotations

from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray


class EmissionSpace(Protocol):
    """A basis of light: a column of T for each element.

    Attributes
    ----------
    kind : str
        Its name in files.
    size : int
        Elements.
    """

    kind: ClassVar[str]

    @property
    def size(self) -> int: ...

    def project(self, light: Any, /) -> NDArray[np.float32]:
        """Coefficients (size, 3) of a light: what T is multiplied with, linear RGB.

        Raises
        ------
        PrtError
            If it is no light of this space, or not finite.
        """

    def attributes(self) -> dict[str, Any]:
        """What files keep; JSON as it is."""


class SampledEmission(EmissionSpace, Protocol):
    """A basis whose elements are sampled from where their light arrives; its light need not be distant."""

    def sample(self, element: Any, position: Any, uv: Any, /) -> tuple[Any, Any, Any]:
        """One direction in which light of an element arrives, on the device.

        Parameters
        ----------
        element : UInt32
        position : Point3f, world
            Where it arrives.
        uv : Point2f
            In [0, 1)^2.

        Returns
        -------
        direction : Vector3f, world
            Unit vectors towards the light.
        irradiance : Color3f
            At right angles to it, over the density of the sample.
        distance : Float, world units
            To the light.
        """
