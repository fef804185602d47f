"""What Mitsuba itself sees: plugins, registered for the current variant as soon as Mitsuba is imported."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.core.variant import variant

if TYPE_CHECKING:
    import mitsuba as mi


def register() -> None:
    """Make the plugins known to Mitsuba's XML and dict loaders, those of other variants to say that there are none."""
    import mitsuba as mi  # not above: its import calls this

    chosen = mi.variant()
    _register(chosen)
    mi.detail.add_variant_callback(lambda _, new: None if new == chosen else _register(chosen))


def _register(chosen: str | None) -> None:
    """In the variant that is set, plugins of the one that was chosen."""
    import mitsuba as mi

    mi.register_sensor("mesh_vertices", _first_imported("MeshVertices", chosen))
    mi.register_emitter("cubemap", _first_imported("CubemapEmitter", chosen))
    mi.register_integrator("sparse_prt", _first_imported("SparsePRT", chosen))
    mi.register_integrator("row_column", _first_imported("RowColumn", chosen))
    mi.register_bsdf("phong", _first_imported("Phong", chosen))
    mi.register_bsdf("ashikhmin_shirley", _first_imported("AshikhminShirley", chosen))
    mi.register_bsdf("in_out_factors", _first_imported("InOutFactors", chosen))


def _first_imported(name: str, chosen: str | None) -> Callable[[mi.Properties], Any]:
    """A plugin's constructor, in the chosen variant alone.

    Its module, and what that needs of the package, is imported when a scene has one. All come from one module: Mitsuba
    makes the plugins of a scene in parallel, and threads that import modules which need each other would find them half
    done.
    """

    def make(properties: mi.Properties) -> Any:
        if variant() != chosen:
            raise PrtError(
                f"plugins of mi_sparse_prt are those of {chosen}, not of {variant()}: "
                f"call mitsuba.set_variant('{chosen}')"
            )
        from mi_sparse_prt.plugins import classes

        return getattr(classes, name)(properties)

    return make
