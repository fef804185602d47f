"""What surfaces of a scene do with light, as far as kernels are made for it."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.scene.instances import placed_shapes
from mi_sparse_prt.scene.materials import bends_normals, is_one_of

#: Of lobes that send light into single directions, but straight on.
BENT = int(mi.BSDFFlags.DeltaReflection) | int(mi.BSDFFlags.DeltaTransmission)


class Surfaces:
    """All BSDFs of a scene, those of instances too.

    Parameters
    ----------
    scene : mi.Scene

    Attributes
    ----------
    passes_straight : bool
        Some surfaces let light pass straight on: masks, thin panes, ``null``.
    coated : bool
        Some reflect into single directions, and do something else as well.
    all_lambertian : bool
        All reflect diffusely, and do nothing else.

    Raises
    ------
    PrtError
        A shape bounds a medium.
    """

    def __init__(self, scene: mi.Scene) -> None:
        found: dict[int, mi.BSDF] = {}
        for where in placed_shapes(scene):
            shape = where.shape
            if shape.interior_medium() is not None or shape.exterior_medium() is not None:
                raise PrtError(
                    f"shape '{where.name}' bounds a medium: many lights know none; remove it, or use volpath"
                )
            bsdf = shape.bsdf()
            found[id(bsdf)] = bsdf
        bsdfs = list(found.values())
        self._bent = [bsdf for bsdf in bsdfs if bends_normals(bsdf)]
        self.passes_straight = any(mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null) for bsdf in bsdfs)
        self.coated = any(
            mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth) and bsdf.flags() & BENT for bsdf in bsdfs
        )
        self.all_lambertian = not self._bent and all(_lambertian(bsdf.flags()) for bsdf in bsdfs)

    def lambertian(self, si: mi.SurfaceInteraction3f) -> mi.Mask:
        """Whether the surfaces that were met reflect diffusely, and do nothing else."""
        if self.all_lambertian:
            return si.is_valid()
        found = si.is_valid() & _lambertian(si.bsdf().flags())
        return found & ~is_one_of(self._bent, si) if self._bent else found


def diffuse_value(si: mi.SurfaceInteraction3f, active: mi.Mask) -> mi.Color3f:
    """The value of diffuse BSDFs on the side that they are seen from, in 1/sr; 0 behind one-sided ones."""
    normal = mi.Vector3f(0, 0, dr.mulsign(mi.Float(1), mi.Frame3f.cos_theta(si.wi)))
    return si.bsdf().eval(mi.BSDFContext(), si, normal, active)


def _lambertian(flags: Any) -> Any:
    """Of a BSDF's flags, or of many of these on the device."""
    return (flags & int(mi.BSDFFlags.All)) == int(mi.BSDFFlags.DiffuseReflection)
