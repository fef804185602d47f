"""A texture that area lights look up but do not sample: of them, Mitsuba traces rays in another scene."""

from __future__ import annotations

from typing import Any

import mitsuba as mi


class EvenTexture(mi.Texture):
    """Looks up another texture, and says that it does not vary, so that area lights sample their surface evenly.

    Of a texture that varies, Mitsuba's ``area`` samples places by their brightness, and finds them on a mesh by rays in
    a scene of that mesh alone. On a GPU a kernel can trace rays in one scene only. Even samples have no bias, and more
    noise: twice as much, of a contrasty texture ten times.

    Parameters
    ----------
    texture : mi.Texture
    """

    def __init__(self, texture: mi.Texture) -> None:
        super().__init__(mi.Properties())
        self._texture = texture

    def traverse(self, callback: mi.TraversalCallback) -> None:
        """The texture that is looked up."""
        callback.put("texture", self._texture, mi.ParamFlags.Differentiable)

    def eval(self, si: mi.SurfaceInteraction3f, active: mi.Mask = True) -> mi.Color3f:
        """The texture's own value."""
        return self._texture.eval(si, active)

    def sample_spectrum(
        self, si: mi.SurfaceInteraction3f, sample: Any, active: mi.Mask = True
    ) -> tuple[Any, mi.Color3f]:
        """The texture's own value, for photons."""
        return self._texture.sample_spectrum(si, sample, active)

    def mean(self) -> mi.Float:
        """The texture's own."""
        return self._texture.mean()

    def is_spatially_varying(self) -> bool:
        """Never: area lights sample their surface, then."""
        return False

    def to_string(self) -> str:
        """What it looks up."""
        return f"EvenTexture[{self._texture}]"
