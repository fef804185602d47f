"""Matrices that were computed before, found again by what they depend on."""

from __future__ import annotations

import hashlib
import json
import warnings
from contextlib import nullcontext
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any

from mi_sparse_prt.core.errors import PrtError, PrtWarning
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.emission.unit_lamps import UnitLamps
from mi_sparse_prt.io.cache_folder import cache_folder
from mi_sparse_prt.methods.settings import Settings
from mi_sparse_prt.precompute import precompute
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.storage import load_transport
from mi_sparse_prt.transport import LightTransport

# whose code decides what is in a matrix
_ROOMS = (
    "core",
    "scene",
    "emission",
    "measurement",
    "reflection",
    "operators",
    "transport.py",
    "solvers",
    "sampling",
    "reconstruction",
    "methods",
    "estimation",
    "planner",
    "precompute.py",
)


def cached_precompute(
    scene: Scene,
    lighting: CubemapLighting | UnitLamps,
    folder: Path | None = None,
    progress: bool = True,
    **settings: Any,
) -> LightTransport:
    """``precompute``, or the matrix that an earlier call left in a folder.

    Parameters
    ----------
    scene : Scene
    lighting : CubemapLighting or UnitLamps
        Of lamps, columns are those of brightness 1.
    folder : Path, optional
        Made if it does not exist; the default is ``cache_folder()``. Files in it may be deleted at any time.
    progress : bool
    **settings
        As for ``precompute``. Together with the hashes of the scene and of its lamps and the algorithms they are the
        key of the file; the order of the scene's shapes is not part of it.
    """
    folder = folder or cache_folder()
    lamps = lighting if isinstance(lighting, UnitLamps) else None
    known = Settings(1 if isinstance(lighting, UnitLamps) else lighting.resolution, **settings)
    key = [_algorithms(), scene.hash, lamps and lamps.hash, asdict(known)]
    digest = hashlib.sha256(json.dumps(key, sort_keys=True).encode()).hexdigest()
    path = folder / f"{digest[:32]}.prt"
    if path.exists():
        try:
            return load_transport(path, scene)
        except PrtError as error:
            warnings.warn(f"cache: {error}", PrtWarning, stacklevel=2)
    with lamps.at_unit_brightness() if lamps else nullcontext():
        transport = precompute(scene, lighting, progress=progress, checkpoint_folder=folder, **settings)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        transport.save(path)
    except (OSError, PrtError) as error:  # the result is good, only not kept
        warnings.warn(f"cache: {error}", PrtWarning, stacklevel=2)
    return transport


@cache
def _algorithms() -> str:
    """Stands for all code that a matrix depends on: one that other code would compute is not served."""
    root = Path(__file__).parent
    state = hashlib.sha256()
    for room in _ROOMS:
        for path in sorted((root / room).rglob("*.py")) if (root / room).is_dir() else [root / room]:
            state.update(path.read_bytes())
    return state.hexdigest()[:16]
