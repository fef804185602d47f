"""Matrices that were computed before, found again by what they depend on."""

from __future__ import annotations

import hashlib
import json
import warnings
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from mi_sparse_prt.core.errors import PrtError, PrtWarning
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.glossy import GlossyTransport, precompute_glossy
from mi_sparse_prt.io.cache_folder import cache_folder
from mi_sparse_prt.methods.settings import Settings
from mi_sparse_prt.precompute import precompute
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.storage import VERSION, load_transport
from mi_sparse_prt.transport import LightTransport


def cached_precompute(
    scene: Scene,
    lighting: CubemapLighting,
    folder: Path | None = None,
    progress: bool = True,
    **settings: Any,
) -> LightTransport:
    """``precompute``, or the matrix that an earlier call left in a folder.

    Parameters
    ----------
    scene : Scene
    lighting : CubemapLighting
    folder : Path, optional
        Made if it does not exist; the default is ``cache_folder()``. Files in it may be deleted at any time.
    progress : bool
    **settings
        As for ``precompute``. Together with the scene's hash they are the key of the file; the order of the scene's
        shapes is not part of it.
    """
    what = asdict(Settings(lighting.resolution, **settings))
    found = _cached(
        scene,
        what,
        folder or cache_folder(),
        lambda kept: precompute(scene, lighting, progress=progress, checkpoint_folder=kept, **settings),
    )
    assert isinstance(found, LightTransport)
    return found


def cached_glossy(
    scene: Scene,
    lighting: CubemapLighting,
    folder: Path | None = None,
    progress: bool = True,
    **settings: Any,
) -> GlossyTransport:
    """``precompute_glossy``, or the transport that an earlier call left in a folder; as ``cached_precompute``."""
    what = {"glossy": lighting.resolution, **settings}
    found = _cached(
        scene,
        what,
        folder or cache_folder(),
        lambda _: precompute_glossy(scene, lighting, progress=progress, **settings),
    )
    assert isinstance(found, GlossyTransport)
    return found


def _cached(
    scene: Scene,
    what: dict[str, Any],
    folder: Path,
    make: Callable[[Path], LightTransport | GlossyTransport],
) -> LightTransport | GlossyTransport:
    """What a scene and JSON-able settings lead to, from a file of the folder or made, given the folder, and kept."""
    key = json.dumps([VERSION, scene.hash, what], sort_keys=True)
    path = folder / f"{hashlib.sha256(key.encode()).hexdigest()[:32]}.prt"
    if path.exists():
        try:
            return load_transport(path, scene)
        except PrtError as error:
            warnings.warn(f"cache: {error}", PrtWarning, stacklevel=3)
    transport = make(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        transport.save(path)
    except (OSError, PrtError) as error:  # the result is good, only not kept
        warnings.warn(f"cache: {error}", PrtWarning, stacklevel=3)
    return transport
