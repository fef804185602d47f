"""Sparse precomputed radiance transfer for Mitsuba 3."""

import sys as _sys
from importlib import import_module as _import_module
from types import ModuleType as _ModuleType
from typing import TYPE_CHECKING as _TYPE_CHECKING
from typing import Any as _Any

from .errors import PrtError, PrtWarning
from .threads import wait_passively
from .variant import choose_variant, point_drjit_to_llvm, variant, with_mitsuba

if _TYPE_CHECKING:  # at run time: on first use, from the modules below
    from .compression.compress import compress
    from .emission.cubemap import CubemapLighting
    from .emission.environment import Environment, load_environment
    from .glossy import GlossyTransport, precompute_glossy
    from .matrix import LightTransport
    from .precompute import precompute
    from .relighting.image import render
    from .scene import Scene, load_scene
    from .storage import load_transport
    from .validation.validate import Validation, validate

__version__ = "0.1.0"

_MODULES = {
    "CubemapLighting": "emission.cubemap",
    "Environment": "emission.environment",
    "GlossyTransport": "glossy",
    "LightTransport": "matrix",
    "Scene": "scene",
    "Validation": "validation.validate",
    "compress": "compression.compress",
    "load_environment": "emission.environment",
    "load_scene": "scene",
    "load_transport": "storage",
    "precompute": "precompute",
    "precompute_glossy": "glossy",
    "render": "relighting.image",
    "validate": "validation.validate",
}

__all__ = [
    "CubemapLighting",
    "Environment",
    "GlossyTransport",
    "LightTransport",
    "PrtError",
    "PrtWarning",
    "Scene",
    "Validation",
    "__version__",
    "compress",
    "load_environment",
    "load_scene",
    "load_transport",
    "precompute",
    "precompute_glossy",
    "render",
    "validate",
    "variant",
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
    globals()[name] = getattr(_import_module(f".{_MODULES[name]}", __name__), name)
    return globals()[name]


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def _prepare_mitsuba() -> None:
    """Choose the variant, before any module that uses Mitsuba's types, and register the plugins for it."""
    choose_variant()
    from .plugins import register

    register()


_sys.modules[__name__].__class__ = _Package
wait_passively()  # before any compiled function runs
point_drjit_to_llvm()  # before Dr.Jit is imported, which loads one for good
with_mitsuba(_prepare_mitsuba)
