"""Sparse precomputed radiance transfer for Mitsuba 3."""

import sys as _sys
from pathlib import Path as _Path

from mi_sparse_prt.core.errors import PrtError, PrtWarning
from mi_sparse_prt.core.threads import wait_passively
from mi_sparse_prt.core.variant import choose_variant, variant

__version__ = "0.1.0"

wait_passively()  # before any compiled function runs
try:
    choose_variant()  # before any module that uses Mitsuba's types
except PrtError as _error:
    # the command line says one line; Python programs get the exception ("-m": python -m mi_sparse_prt...)
    if _Path(_sys.argv[0]).name in ("mi-sparse-prt", "-m"):
        raise SystemExit(f"mi-sparse-prt: {_error}") from None
    raise

from mi_sparse_prt.compression.compress import compress  # noqa: E402
from mi_sparse_prt.emission.cubemap import CubemapLighting  # noqa: E402
from mi_sparse_prt.emission.emitters import SceneEmitters  # noqa: E402
from mi_sparse_prt.emission.environment import Environment, load_environment  # noqa: E402
from mi_sparse_prt.measurement.pixels import camera_pixels  # noqa: E402
from mi_sparse_prt.plugins import register as _register_plugins  # noqa: E402
from mi_sparse_prt.precompute import precompute, precompute_glossy  # noqa: E402
from mi_sparse_prt.relighting.image import render  # noqa: E402
from mi_sparse_prt.scene.loading import load_scene  # noqa: E402
from mi_sparse_prt.scene.scene import Scene  # noqa: E402
from mi_sparse_prt.storage import load_transport  # noqa: E402
from mi_sparse_prt.transport import LightTransport  # noqa: E402
from mi_sparse_prt.validation.validate import Validation, validate  # noqa: E402

_register_plugins()

GlossyTransport = LightTransport  # one class serves both

__all__ = [
    "CubemapLighting",
    "Environment",
    "GlossyTransport",
    "LightTransport",
    "PrtError",
    "PrtWarning",
    "Scene",
    "SceneEmitters",
    "Validation",
    "__version__",
    "camera_pixels",
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
