"""What Mitsuba itself sees: plugins, registered for the current variant as soon as Mitsuba is imported."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import mitsuba as mi


def register() -> None:
    """Make the plugins known to Mitsuba's XML and dict loaders."""
    import mitsuba as mi  # not above: its import calls this

    mi.register_sensor("mesh_vertices", _first_imported("MeshVertices"))
    mi.register_emitter("cubemap", _first_imported("CubemapEmitter"))
    mi.register_integrator("sparse_prt", _first_imported("SparsePRT"))
    mi.register_bsdf("phong", _first_imported("Phong"))
    mi.register_bsdf("ashikhmin_shirley", _first_imported("AshikhminShirley"))
    mi.register_bsdf("in_out_factors", _first_imported("InOutFactors"))


def _first_imported(name: str) -> Callable[[mi.Properties], Any]:
    """A plugin's constructor; its module, and what that needs of the package, is imported when a scene has one.

    All come from one module: Mitsuba makes the plugins of a scene in parallel, and threads that import modules which
    need each other would find them half done.
    """

    def make(properties: mi.Properties) -> Any:
        from mi_sparse_prt.plugins import classes

        return getattr(classes, name)(properties)

    return make
