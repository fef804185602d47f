"""How long a relit frame takes: B = T L at all vertices."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.emission.upsampling import upsampling
from mi_sparse_prt.methods.execution import matrix_of
from mi_sparse_prt.methods.result import MethodResult
from mi_sparse_prt.operators.upsampled import Upsampled
from mi_sparse_prt.operators.visibility import Visibility
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.solvers.problem import diffuse_problem
from mi_sparse_prt.transport import LightTransport

INDIRECT_RESOLUTION = 8


def measure_relighting(
    scene: Scene, lighting: CubemapLighting, bits: NDArray[np.uint32], repeats: int
) -> dict[str, Any]:
    """Time the product with a lighting that was projected already, without and with an indirect part.

    The time of a product does not depend on the numbers in it, so the indirect part is random.

    Parameters
    ----------
    scene : Scene
    lighting : CubemapLighting
    bits : (n_v, ceil(n_directions / 32)) uint32
        The direct matrix.
    repeats : int

    Returns
    -------
    dict
        For ``direct`` and ``with_indirect``: ``seconds`` (median), ``first_run_seconds`` (compilation by numba
        included, where its cache is empty), ``matrix_bytes``. ``indirect_resolution`` and ``channels``.
    """
    rng = np.random.default_rng(0)
    coarse = CubemapLighting(min(INDIRECT_RESOLUTION, lighting.resolution))
    channels = 1 if scene.grey else 3
    density = np.empty((len(bits), coarse.n_directions, channels), dtype=np.float16)
    for row in density:
        row[:] = rng.random(row.shape, dtype=np.float32)
    indirect = Upsampled(density, upsampling(coarse, lighting), lighting)
    radiance = rng.random((lighting.n_directions, 3), dtype=np.float32)

    report: dict[str, Any] = {"indirect_resolution": coarse.resolution, "channels": channels}
    for name, part in (("direct", None), ("with_indirect", indirect)):
        transport = _transport(scene, lighting, bits, part)
        seconds = []
        for _ in range(1 + repeats):
            start = time.perf_counter()
            transport.relight(radiance)
            seconds.append(time.perf_counter() - start)
        report[name] = {
            "seconds": float(np.median(seconds[1:])),
            "first_run_seconds": seconds[0],
            "matrix_bytes": transport.nbytes,
        }
    return report


def _transport(
    scene: Scene, lighting: CubemapLighting, bits: NDArray[np.uint32], indirect: Upsampled | None
) -> LightTransport:
    direct = Visibility(bits, scene.normals, lighting)
    result = MethodResult(direct, indirect, 0, {}, {})
    return matrix_of(diffuse_problem(scene, lighting), result)
