"""Which rows, which columns, how far apart: [HR10] Figures 5 and 6 for every mesh of a scene, by one command."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mi_sparse_prt.benchmark.column_choice_errors import compare_choices, plot_choices
from mi_sparse_prt.benchmark.measuring import report_header
from mi_sparse_prt.benchmark.neighbour_radius import error_against_radius, plot_error_against_radius
from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.validation.validate import save_figures

RADII = [0.025, 0.0375, 0.05, 0.075, 0.1, 0.125, 0.15]  # in longest sides of the scene
VERTICES = 1000  # of a mesh, at which choices are compared
RADIUS_VERTICES = 200  # and radii
DIRECTIONS = 0.057  # of all, sampled at a sparse vertex: 350 of 6144


def measure_choices(
    scene: Scene, lighting: CubemapLighting, progress: bool = True, figures: Path | None = None
) -> dict[str, Any]:
    """Compare choices of rows and columns, and radii of neighbours, on the direct light of every mesh.

    Parameters
    ----------
    scene : Scene
    lighting : CubemapLighting
    progress : bool
    figures : Path, optional
        Folder for ``choices_MESH.png`` and ``radius_MESH.png``, made if needed.

    Returns
    -------
    dict
        ``machine``, ``scene``, and under ``meshes`` for each mesh ``choices`` (see ``compare_choices``) and ``radius``
        (``error_against_radius``); ``skipped`` says which meshes are not among them, and why. JSON as it is.
    """
    directions = max(1, round(DIRECTIONS * lighting.n_directions))
    report: dict[str, Any] = {**report_header(scene, lighting), "meshes": {}, "skipped": []}
    for mesh in scene.meshes:
        try:
            found = {
                "choices": compare_choices(scene, lighting, mesh.name, VERTICES, progress=progress),
                "radius": error_against_radius(
                    scene, lighting, mesh.name, RADII, RADIUS_VERTICES, directions, progress=progress
                ),
            }
        except PrtError as error:  # too small, or in the dark: the others can still be measured
            report["skipped"].append(f"mesh {mesh.name}: {error}")
            continue
        report["meshes"][mesh.name] = found
        if figures is not None:
            choices, radius = plot_choices(found["choices"]), plot_error_against_radius(found["radius"])
            save_figures(figures, {f"choices_{mesh.name}": choices, f"radius_{mesh.name}": radius})
    return report
