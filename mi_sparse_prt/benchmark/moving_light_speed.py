"""What a frame of moving light takes, stage by stage, and how that compares with whole products."""

from __future__ import annotations

import time
from collections import defaultdict
from typing import Any

import numpy as np
import psutil
from numpy.typing import NDArray
from tqdm.auto import tqdm

from mi_sparse_prt.emission.haar import haar_colours
from mi_sparse_prt.relighting.approximations import (
    Approximation,
    Everything,
    NonIncremental,
    PerBand,
    wavelet_bands,
)
from mi_sparse_prt.relighting.clusters import ClusterColumns
from mi_sparse_prt.relighting.columns import wavelet_columns
from mi_sparse_prt.relighting.light import TurningLight
from mi_sparse_prt.relighting.players import ClusteredPlayer, ColumnsPlayer, Player
from mi_sparse_prt.transport import LightTransport

FRAMES, WARM = 120, 8  # measured, and those before them that compile and fill caches
ROWS = 2048  # expanded at a time

Report = dict[str, Any]
Floats = NDArray[np.float32]


def measure_frames(
    transport: LightTransport,
    compressed: LightTransport,
    clusters: ClusterColumns,
    light: TurningLight,
    progress: bool,
) -> Report:
    """Times of frames of a turning light.

    Returns
    -------
    dict
        For each way of playing: ``milliseconds`` of each stage (medians), their ``total``, ``per_second`` and
        ``prepared_bytes``. ``overhead``: time of PBI over that of NWA, without the light. ``product``: milliseconds of
        T L in float32 by BLAS (None if T does not fit into memory), and ratios to the products of clustered PCA.
    """
    bands = wavelet_bands(light.lighting.resolution)
    columns = wavelet_columns(compressed.incident, light.lighting)

    def played(
        method: type[Approximation], budget: int | None, vectors: int | None = None, lists: bool = False
    ) -> Report:
        approximation = method(bands)
        playing: Player = (
            ColumnsPlayer(columns, approximation.groups)
            if lists
            else ClusteredPlayer(clusters, approximation.groups, vectors)
        )
        return _measured(approximation, playing, budget, compressed.albedo, light)

    ways = {
        "clusters, all wavelets": lambda: played(Everything, None),
        "clusters, NWA(100)": lambda: played(NonIncremental, 100),
        "clusters, NWA(30)": lambda: played(NonIncremental, 30),
        "clusters, NWA(1)": lambda: played(NonIncremental, 1),
        "clusters, PBI(100)": lambda: played(PerBand, 100),
        "clusters, PBI(30)": lambda: played(PerBand, 30),
        "clusters, PBI(1)": lambda: played(PerBand, 1),
        "clusters, PBI(30), a quarter of the weights": lambda: played(PerBand, 30, clusters.quarter),
        "columns, NWA(30)": lambda: played(NonIncremental, 30, lists=True),
        "columns, PBI(30)": lambda: played(PerBand, 30, lists=True),
    }
    result: Report = {}
    for name, play in tqdm(ways.items(), desc="frames", unit=" ways", disable=not progress):
        result[name] = play()
    result["overhead"] = {
        f"{kind}, {budget} wavelets": _without_light(result[f"{kind}, PBI({budget})"])
        / _without_light(result[f"{kind}, NWA({budget})"])
        - 1
        for kind, budget in (("clusters", 1), ("clusters", 30), ("columns", 30))
    }
    result["product"] = _product(transport, result, light)
    return result


def _measured(
    approximation: Approximation, playing: Player, budget: int | None, albedo: Floats, light: TurningLight
) -> Report:
    """Medians of the stages of frames, from light to colours of vertices."""
    scale = np.sqrt(light.lighting.solid_angles, dtype=np.float32)
    stages = defaultdict(list)
    for frame in range(WARM + FRAMES):
        moments = [time.perf_counter()]
        texels = light.turned(90 * (frame / FRAMES) ** 2)
        moments.append(time.perf_counter())
        coefficients = haar_colours(texels, scale)
        moments.append(time.perf_counter())
        update = approximation.update(coefficients, budget if frame else None)
        moments.append(time.perf_counter())
        playing.apply(update)
        moments.append(time.perf_counter())
        playing.radiance(albedo)
        moments.append(time.perf_counter())
        if frame >= WARM:
            for stage, seconds in zip(
                ("light", "haar", "choice", "rows", "colours"), np.diff(moments), strict=True
            ):
                stages[stage].append(1e3 * seconds)
    milliseconds = {stage: float(np.median(values)) for stage, values in stages.items()}
    total = sum(milliseconds.values())
    return {
        "milliseconds": milliseconds,
        "total": total,
        "per_second": 1e3 / total,
        "prepared_bytes": playing.prepared_bytes,
    }


def _without_light(way: Report) -> float:
    return float(way["total"] - way["milliseconds"]["light"])


def _product(transport: LightTransport, ways: Report, light: TurningLight) -> Report:
    """T L of unit albedo in float32 by BLAS, all of T in memory."""
    operator = transport.incident
    n, m, channels = operator.shape
    needed = 4 * n * m
    names = ("clusters, NWA(100)", "clusters, all wavelets")
    if channels != 1 or needed > 0.6 * psutil.virtual_memory().available:
        return {"milliseconds": None, "bytes": needed}
    dense = np.empty((n, m), np.float32)
    for first in range(0, n, ROWS):
        ids = np.arange(first, min(first + ROWS, n))
        dense[ids] = operator.rows(ids)[..., 0]
    texels, times = light.exact(30), []
    for _ in range(5):
        start = time.perf_counter()
        dense @ texels
        times.append(1e3 * (time.perf_counter() - start))
    whole = float(np.median(times))
    faster = {name: whole / ways[name]["milliseconds"]["rows"] for name in names}
    return {"milliseconds": whole, "bytes": needed, "faster": faster}
