"""E, the light that may change, with a finite basis ([Leh07] eq. 12): what any basis has to know of itself."""

from __future__ import annotations

from contextlib import AbstractContextManager
from typing import Any, ClassVar, Protocol

import mitsuba as mi
import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mi_sparse_prt.scene.scene import Scene


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

    @property
    def weights(self) -> NDArray[np.float32]:
        """(size,) of the inner product of rows: what an element counts in the error of light that spreads over all."""

    @property
    def coordinates(self) -> dict[str, NDArray[Any]]:
        """What elements are called: names of coordinates, each with an array (size,)."""

    def neighbours(self, count: int, /) -> NDArray[np.int32] | None:
        """(size, count) elements nearest to each, itself first; None where elements have no neighbours."""

    def project(self, light: Any, /) -> NDArray[np.float32]:
        """Coefficients (size, 3) of a light: what T is multiplied with, linear RGB.

        Raises
        ------
        PrtError
            If it is no light of this space, or not finite.
        """

    def coarser(self, factor: int, /) -> EmissionSpace | None:
        """The same light in elements so many times as wide; None where elements have no neighbours."""

    def upsampling(self, coarse: Any, /) -> scipy.sparse.csr_array:
        """(size, coarse.size): interpolates what is known of the elements of a coarser version."""

    @property
    def sides(self) -> Any:
        """Which elements meet along sides and at corners, ``TexelSides``; None where they have no neighbours."""

    def scene_lit_by(self, light: Any, scene: Scene, /) -> AbstractContextManager[mi.Scene]:
        """A Mitsuba scene of the same surfaces under a light of this space and no other, world space.

        It is valid within the context. ``light`` is what ``project`` takes.
        """

    def attributes(self) -> dict[str, Any]:
        """What files keep; JSON as it is."""


class SampledEmission(EmissionSpace, Protocol):
    """A basis whose elements are sampled from where their light arrives; its light need not be distant."""

    @property
    def unmet(self) -> NDArray[np.int64]:
        """Elements (k,) that have light of points or of single directions, which no ray can meet; ascending."""

    def sample(self, element: Any, position: Any, uv: Any, /) -> tuple[Any, Any, Any, Any]:
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
        density : Float
            Of the sample, per solid angle; 0 where no ray can meet the light.
        """

    def element_of(self, si: Any, ray: Any, active: Any, /) -> tuple[Any, Any]:
        """The element whose light rays find, on the device.

        Parameters
        ----------
        si : SurfaceInteraction3f
            What rays meet, invalid where they leave the scene.
        ray : Ray3f, world
        active : Mask

        Returns
        -------
        Int32
            -1 where it is no light of this space.
        Color3f
            Its radiance along the ray, if the element has the coefficient 1.
        """

    def density(self, si: Any, ray: Any, active: Any, /) -> Any:
        """The density per solid angle with which ``sample`` finds, from where rays begin, the light that they meet.

        Parameters
        ----------
        si : SurfaceInteraction3f
            What rays meet: light of an element.
        ray : Ray3f, world
        active : Mask

        Returns
        -------
        Float
        """


class EmittedLight(SampledEmission, Protocol):
    """A basis whose light can be followed from where it leaves lamps: indirect light has less noise then."""

    @property
    def emitted(self) -> NDArray[np.int64]:
        """Elements (k,) that ``emit`` knows, ascending; not those of distant light, most of which misses a scene."""

    def emit(self, element: Any, u: Any, place: Any, towards: Any, /) -> tuple[Any, Any]:
        """Rays of light that leaves an element, on the device.

        Parameters
        ----------
        element : UInt32
        u : Float
            In [0, 1).
        place, towards : Point2f
            In [0, 1)^2.

        Returns
        -------
        ray : Ray3f, world
        power : Color3f
            If the element has the coefficient 1, over the density of the sample: its mean is the flux that leaves.
        """
