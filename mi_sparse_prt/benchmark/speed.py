"""Speed of the parts: the direct matrix against bare rays, paths, and the product with a lighting."""

from __future__ import annotations

from typing import Any

from tqdm.auto import tqdm

from mi_sparse_prt.benchmark.direct_speed import measure_direct
from mi_sparse_prt.benchmark.machine import report_header
from mi_sparse_prt.benchmark.path_speed import measure_paths
from mi_sparse_prt.benchmark.relight_speed import measure_relighting
from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.scene.scene import Scene

FEWEST_REPEATS = 3


def run_benchmark(
    scene: Scene, lighting: CubemapLighting, repeats: int = 3, progress: bool = True
) -> dict[str, Any]:
    """Measure the direct matrix, indirect paths and relighting of a scene.

    Parameters
    ----------
    scene : Scene
    lighting : CubemapLighting
    repeats : int
        Timed repeats of each part, after an untimed one that compiles; at least 3. Medians are reported.
    progress : bool
        Show a bar.

    Returns
    -------
    dict
        ``machine``, ``scene``, ``repeats``, and one entry per part: ``direct`` (see ``measure_direct``), ``paths``
        (``measure_paths``), ``relight`` (``measure_relighting``). JSON as it is.

    Raises
    ------
    PrtError
        If there are fewer repeats than a median needs.
    """
    if repeats < FEWEST_REPEATS:
        raise PrtError(f"{repeats} repeats are too few for a median; use at least {FEWEST_REPEATS}")
    with tqdm(total=3, desc="benchmark", unit=" parts", disable=not progress) as bar:
        direct, bits = measure_direct(scene, lighting, repeats)
        bar.update()
        paths = measure_paths(scene, lighting, repeats)
        bar.update()
        relight = measure_relighting(scene, lighting, bits, repeats)
        bar.update()
    return {
        **report_header(scene, lighting),
        "repeats": repeats,
        "direct": direct,
        "paths": paths,
        "relight": relight,
    }
