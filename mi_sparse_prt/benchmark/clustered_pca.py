"""Clustered PCA in two passes, of a matrix' factors, against standard CPCA of the whole one ([HR10] Figure 11)."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.benchmark.converged_reference import MAX_DEPTH
from mi_sparse_prt.benchmark.cpca_pictures import cluster_picture, relit_pictures
from mi_sparse_prt.benchmark.machine import kept_memory, report_header
from mi_sparse_prt.compression.clustered_pca import SphereRows, clustered_mesh, mesh_rows
from mi_sparse_prt.compression.compress import compress, default_clusters
from mi_sparse_prt.compression.cpca import Clusters, squared_distances, standard_cpca
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.precompute import precompute, precompute_glossy
from mi_sparse_prt.relighting.image import render
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.transport import LightTransport

BASES = 24
# as in [HR10] Figure 8, by the scene's file name and the mesh; others by their number of vertices
CLUSTERS = {"bunny": {"bunny": 70, "ground": 120}, "dancer": {"dancer": 50, "ground": 100}}
TARGET = 0.02  # error of the matrix that is compressed
SPP = 64

Report = dict[str, Any]


@kept_memory()
def measure_cpca(
    scene: Scene, lighting: CubemapLighting, progress: bool = True, figures: Path | None = None
) -> Report:
    """Compress the matrix of a scene in both ways, with as many clusters, basis vectors and iterations.

    Where surfaces are glossy, it has the terms of their BRDFs.

    Parameters
    ----------
    scene : Scene
    lighting : CubemapLighting
    progress : bool
    figures : path, optional
        Folder for ``clusters.png`` and ``compressed.png``, made if needed.

    Returns
    -------
    dict
        JSON as it is. ``meshes``: for each its ``vertices``, ``clusters``, ``bases``; ``seconds`` and relative L2
        ``error`` (on the sphere, weighted by area) of ``standard``, of the full matrix in memory, and ``two_pass``, of
        the factors, to 16-bit numbers; ``faster``, ``error_increase``. ``total``: the same times of all meshes.
        ``compressed``: what ``compress`` reports of the whole; ``image``: relative L2 of a relit image against that of
        the uncompressed matrix.
    """
    if scene.diffuse:
        matrix = precompute(scene, lighting, max_depth=MAX_DEPTH, target_error=TARGET, progress=progress)
        return _both_ways(scene, matrix, progress, figures)
    glossy = precompute_glossy(scene, lighting, max_depth=MAX_DEPTH, progress=progress)
    return _both_ways(scene, glossy, progress, figures)


def _both_ways(scene: Scene, transport: LightTransport, progress: bool, figures: Path | None) -> Report:
    counts = CLUSTERS.get(Path(scene.path or "").stem) or default_clusters(transport)
    compressed = compress(transport, clusters=counts, bases=BASES, progress=progress)  # all is compiled then
    compressed = compress(transport, clusters=counts, bases=BASES, progress=progress)
    report: Report = {**report_header(scene, transport.lighting), "meshes": {}}
    for mesh in transport.meshes:
        report["meshes"][mesh.name] = _measured(mesh_rows(transport, mesh), counts[mesh.name])
    sums = {
        way: sum(mesh[way]["seconds"] for mesh in report["meshes"].values())
        for way in ("standard", "two_pass")
    }
    report["total"] = {**sums, "faster": sums["standard"] / sums["two_pass"]}
    report["compressed"] = compressed.report["compression"]
    report["image"] = _image_error(scene, transport, compressed, figures)
    return report


def _measured(rows: SphereRows, clusters: int) -> Report:
    start = time.perf_counter()
    ours = clustered_mesh(rows, clusters, BASES)
    two_pass = time.perf_counter() - start
    full = rows.rows(np.arange(len(rows)))  # in memory before its time begins
    start = time.perf_counter()
    found = standard_cpca(full, rows.weights, clusters, BASES)
    standard = time.perf_counter() - start
    errors = _error(full, rows.weights, found), float(np.sqrt(ours.left[-1] / ours.energy))
    return {
        "vertices": len(rows),
        "clusters": clusters,
        "bases": BASES,
        "standard": {"seconds": standard, "error": errors[0]},
        "two_pass": {"seconds": two_pass, "error": errors[1]},
        "faster": standard / two_pass,
        "error_increase": errors[1] / errors[0] - 1 if errors[0] > 0 else 0.0,
    }


def _error(rows: NDArray[np.float32], weights: NDArray[np.float32], found: Clusters) -> float:
    """Relative L2, weighted, of what the spaces leave out."""
    squares = squared_distances(rows, found, found.labels[:, None])[:, 0]
    energy = np.einsum("ngm,ngm->n", rows, rows)
    w = weights.astype(np.float64)
    return float(np.sqrt(max(w @ squares, 0) / (w @ energy)))


def _image_error(
    scene: Scene, transport: LightTransport, compressed: LightTransport, figures: Path | None
) -> float | None:
    environment = scene.mitsuba.environment()
    if environment is None or not scene.mitsuba.sensors():
        return None
    light = transport.lighting.project(environment)
    images = [render(scene, t, light, spp=SPP) for t in (transport, compressed)]
    if figures is not None:
        figures.mkdir(parents=True, exist_ok=True)
        relit_pictures(*images).savefig(figures / "compressed.png", dpi=110, bbox_inches="tight")
        cluster_picture(scene, compressed).savefig(figures / "clusters.png", dpi=110, bbox_inches="tight")
    return float(np.linalg.norm(images[1] - images[0]) / np.linalg.norm(images[0]))
