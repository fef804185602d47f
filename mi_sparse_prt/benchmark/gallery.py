"""Pictures of a scene beside Mitsuba's, as [HR10] Figures 15 to 19 and 21 show them, its clusters and its factors."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
from matplotlib.figure import Figure

from mi_sparse_prt.benchmark.converged_reference import MAX_DEPTH
from mi_sparse_prt.benchmark.cpca_pictures import cluster_picture, side_by_side
from mi_sparse_prt.benchmark.factor_pictures import factor_picture
from mi_sparse_prt.compression.compress import compress
from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.precompute import precompute, precompute_glossy
from mi_sparse_prt.relighting.image import background_emitter, render
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.transport import LightTransport
from mi_sparse_prt.validation.glossy_images import lit_scene

SPP, REFERENCE_SPP = 64, 256
DIFFERENCE = 5  # times as bright


def draw_gallery(scene: Scene, lighting: CubemapLighting, progress: bool = True) -> dict[str, Figure]:
    """Precompute a scene, relight it, and draw it.

    Parameters
    ----------
    scene : Scene
        With an environment and a sensor. Where surfaces are glossy, its transport has the factors of their BRDFs.
    lighting : CubemapLighting
    progress : bool

    Returns
    -------
    dict of matplotlib Figure
        ``relit``: Mitsuba's ``path`` under the same cubemap, the matrix, the compressed matrix, and the difference of
        the first two. ``clusters``: of the compressed matrix ([OBRG06] Figure 12). ``factors_0``, ...: of each glossy
        BRDF.

    Raises
    ------
    PrtError
        If the scene has no environment or no sensor.
    """
    if scene.mitsuba.environment() is None or not scene.mitsuba.sensors():
        raise PrtError(
            f"{scene.path or 'the scene'} has no environment or no sensor: there is nothing to draw"
        )
    if scene.diffuse:
        return _drawn(scene, precompute(scene, lighting, max_depth=MAX_DEPTH, progress=progress), progress)
    glossy = precompute_glossy(scene, lighting, max_depth=MAX_DEPTH, progress=progress)
    return _drawn(scene, glossy, progress) | {
        f"factors_{k}": factor_picture(factors)
        for k, factors in enumerate(getattr(glossy.reflection, "factors", ()))
    }


def save_gallery(figures: dict[str, Figure], folder: Path, name: str) -> list[Path]:
    """Write figures as ``name_*.png`` into a folder (made if needed); where they are."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{name}_{kind}.png" for kind in figures]
    for path, figure in zip(paths, figures.values(), strict=True):
        figure.savefig(path, dpi=110, bbox_inches="tight")
    return paths


def _drawn(scene: Scene, transport: LightTransport, progress: bool) -> dict[str, Figure]:
    light = transport.lighting.project(scene.mitsuba.environment())
    compressed = compress(transport, progress=progress)
    ours, small = (render(scene, t, light, spp=SPP, progress=progress) for t in (transport, compressed))
    lit = lit_scene(scene.unlit_shapes(), background_emitter(light, transport.lighting))
    path = mi.load_dict({"type": "path", "max_depth": MAX_DEPTH})
    sensor = scene.mitsuba.sensors()[0]
    truth = np.array(mi.render(lit, sensor=sensor, integrator=path, spp=REFERENCE_SPP))[..., :3]
    kind = f"{transport.terms} terms" if transport.terms else "matrix"
    titles = [
        "Mitsuba path",
        f"relit, {kind}",
        f"compressed, 1/{compressed.report['compression']['ratio']:.0f}",
        f"difference x {DIFFERENCE}",
    ]
    images = [truth, ours, small, DIFFERENCE * np.abs(ours - truth)]
    scale = 1 / np.percentile(truth, 99)
    return {
        "relit": side_by_side([image * scale for image in images], titles),
        "clusters": cluster_picture(scene, compressed),
    }
