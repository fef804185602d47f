"""Time and memory of one matrix in a process of its own: ``python -m mi_sparse_prt.benchmark.one_size ARGUMENTS``.

Memory that others have used in a process before would count as this matrix's own, or be found ready and count as none.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import warnings
from contextlib import redirect_stdout
from typing import Any

import mitsuba as mi

from mi_sparse_prt.core.errors import PrtError, PrtWarning
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.precompute import precompute
from mi_sparse_prt.scene.loading import load_scene

PARTS = {"direct": 2, "whole": 5}  # max_depth


def measure(
    path: str, parameters: dict[str, str], edge_length: float | None, resolution: int, method: str
) -> dict[str, Any]:
    """Precompute a scene file's matrix, its direct light alone first.

    Parameters
    ----------
    path : str
    parameters : dict
        Values for the scene's ``<default>`` entries.
    edge_length : float or None
        As for ``load_scene``.
    resolution : int
        Of the lighting.
    method : str
        As for ``precompute``.

    Returns
    -------
    dict
        ``vertices``, ``resolution``, ``directions``, ``edge_length``; and for ``direct`` (no interreflections) and
        ``whole`` (three): ``seconds``, ``seconds_without_held_out``, ``peak_memory_bytes`` of the process,
        ``stored_bytes``, ``estimated_error``, and the ``plan`` that was carried out.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PrtWarning)
        scene, lighting = load_scene(path, edge_length, **parameters), CubemapLighting(resolution)
        found: dict[str, Any] = {
            "vertices": scene.n_vertices,
            "resolution": resolution,
            "directions": lighting.n_directions,
            "edge_length": edge_length,
        }
        for part, max_depth in PARTS.items():
            transport = precompute(scene, lighting, method, max_depth=max_depth, progress=False)
            found[part] = _cost(transport.report)
            del transport
    return found


def _cost(report: dict[str, Any]) -> dict[str, Any]:
    seconds = report["seconds"]
    return {
        "seconds": seconds["total"],
        "seconds_without_held_out": seconds["total"] - seconds["held_out"],
        "peak_memory_bytes": report["peak_memory_bytes"],
        "stored_bytes": report["stored_bytes"],
        "estimated_error": report["estimated_error"]["total"],
        "plan": report["plan"],
    }


def measured_apart(**arguments: Any) -> dict[str, Any]:
    """``measure`` in a new process, in this one's Mitsuba variant.

    Raises
    ------
    PrtError
        What ``measure`` raises there, or if the process ends otherwise (killed because memory ran out).
    """
    done = subprocess.run(
        [sys.executable, "-c", f"from {__name__} import main; main()", json.dumps(arguments)],
        env=os.environ | {"MI_SPARSE_PRT_VARIANT": mi.variant()},
        stdout=subprocess.PIPE,
        text=True,
        check=False,
    )
    if done.returncode:
        raise PrtError(
            f"the process that measured {arguments} ended with code {done.returncode}: "
            "ask for a smaller size if memory ran out"
        )
    found: dict[str, Any] = json.loads(done.stdout)
    if "refused" in found:
        raise PrtError(found["refused"])
    return found


def main() -> None:
    """Measure what the first argument says, and print it, both in JSON."""
    with redirect_stdout(sys.stderr):
        try:
            found = measure(**json.loads(sys.argv[1]))
        except PrtError as error:
            found = {"refused": str(error)}
    json.dump(found, sys.stdout)
