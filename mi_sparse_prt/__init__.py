"""Sparse precomputed radiance transfer for Mitsuba 3."""

import sys as _sys
from importlib import import_module as _import_module
from types import ModuleType as _ModuleType
from typing import TYPE_CHECKING as _TYPE_CHECKING
from typing import Any as _Any

from mi_sparse_prt.core.errors import PrtError, PrtWarning
from mi_sparse_prt.core.threads import wait_passively
from mi_sparse_prt.core.variant import choose_variant, point_drjit_to_llvm, variant, with_mitsuba

if _TYPE_CHECKING:  # at run time: on first use, from the modules below
    from mi_sparse_prt.compression.compress import compress
    from mi_sparse_prt.emission.cubemap import CubemapLighting
    from mi_sparse_prt.emission.emitters import SceneEmitters
    from mi_sparse_prt.emission.environment import Environment, load_environment
    from mi_sparse_prt.manylights.frames import render_many_lights_frames
    from mi_sparse_prt.manylights.image import ManyLightsImage
    from mi_sparse_prt.manylights.render import render_many_lights
    from mi_sparse_prt.measurement.measurement import mesh_vertices
    from mi_sparse_prt.measurement.pixels import camera_pixels
    from mi_sparse_prt.precompute import precompute, precompute_glossy
    from mi_sparse_prt.relighting.fixed_camera import FixedCamera
    from mi_sparse_prt.relighting.image import render
    from mi_sparse_prt.relighting.light import TurningLight
    from mi_sparse_prt.relighting.relighter import Relighter
    from mi_sparse_prt.relighting.viewer.export import Page, make_page
    from mi_sparse_prt.relighting.viewer.mixer import make_mixer
    from mi_sparse_prt.relighting.viewer.widget import Viewer, show
    from mi_sparse_prt.scene.loading import load_scene
    from mi_sparse_prt.scene.scene import Scene
    from mi_sparse_prt.storage import load_transport
    from mi_sparse_prt.transport import GlossyTransport, LightTransport
    from mi_sparse_prt.validation.validate import Validation, validate

__version__ = "0.1.0"

_MODULES = {
    "CubemapLighting": "emission.cubemap",
    "Environment": "emission.environment",
    "FixedCamera": "relighting.fixed_camera",
    "GlossyTransport": "transport",
    "LightTransport": "transport",
    "ManyLightsImage": "manylights.image",
    "Page": "relighting.viewer.export",
    "Relighter": "relighting.relighter",
    "Scene": "scene.scene",
    "SceneEmitters": "emission.emitters",
    "TurningLight": "relighting.light",
    "Validation": "validation.validate",
    "Viewer": "relighting.viewer.widget",
    "camera_pixels": "measurement.pixels",
    "compress": "compression.compress",
    "load_environment": "emission.environment",
    "load_scene": "scene.loading",
    "load_transport": "storage",
    "make_mixer": "relighting.viewer.mixer",
    "make_page": "relighting.viewer.export",
    "mesh_vertices": "measurement.measurement",
    "precompute": "precompute",
    "precompute_glossy": "precompute",
    "render": "relighting.image",
    "render_many_lights": "manylights.render",
    "render_many_lights_frames": "manylights.frames",
    "show": "relighting.viewer.widget",
    "validate": "validation.validate",
}

__all__ = [
    "CubemapLighting",
    "Environment",
    "FixedCamera",
    "GlossyTransport",
    "LightTransport",
    "ManyLightsImage",
    "Page",
    "PrtError",
    "PrtWarning",
    "Relighter",
    "Scene",
    "SceneEmitters",
    "TurningLight",
    "Validation",
    "Viewer",
    "camera_pixels",
    "compress",
    "load_environment",
    "load_scene",
    "load_transport",
    "make_mixer",
    "make_page",
    "mesh_vertices",
    "precompute",
    "precompute_glossy",
    "render",
    "render_many_lights",
    "render_many_lights_frames",
    "show",
    "validate",
    "variant",
    "__version__",
]


class _Package(_ModuleType):
    """The package: its names stay where Python would put a submodule of the same name (``precompute``)."""

    def __setattr__(self, name: str, value: object) -> None:
        if not (name in _MODULES and isinstance(value, _ModuleType)):
            super().__setattr__(name, value)


def __getattr__(name: str) -> _Any:
    """Import a name when it is used first: with all of them, the package would take two seconds."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = getattr(_import_module(f"{__name__}.{_MODULES[name]}"), name)
    return globals()[name]


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def _prepare_mitsuba() -> None:
    """Choose the variant, before any module that uses Mitsuba's types, and register the plugins for it."""
    choose_variant()
    from mi_sparse_prt.plugins import register

    register()


_sys.modules[__name__].__class__ = _Package
wait_passively()  # before any compiled function runs
point_drjit_to_llvm()  # before Dr.Jit is imported, which loads one for good
with_mitsuba(_prepare_mitsuba)
