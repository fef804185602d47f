"""From a matrix to a small one that relights at once: the entry to all compressions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from tqdm.auto import tqdm

from mi_sparse_prt.compression.clustered_pca import MeshClusters, clustered_mesh, mesh_rows
from mi_sparse_prt.compression.haar_truncation import TARGET, haar_part
from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.core.metrics import relative_l2_by_name
from mi_sparse_prt.core.profiling import Stopwatch
from mi_sparse_prt.operators.clustered import Clustered
from mi_sparse_prt.transport import LightTransport

PER_CLUSTER = 300  # vertices, by default ...
MOST_CLUSTERS = 120  # ... unless clusters become more than these, of one mesh
METHODS = ("cpca", "haar")
ROWS = 1024  # of both matrices, expanded at a time
NEARLY = 1.1  # times the target: predicted errors up to this are looked at
ATTEMPTS = 5  # of which each has twice the clusters of the last


def compress(
    transport: LightTransport,
    method: str = "cpca",
    clusters: int | dict[str, int] | None = None,
    bases: int = 24,
    target_error: float | None = None,
    seed: int = 0,
    progress: bool = True,
) -> LightTransport:
    """Compress a light transport matrix for relighting.

    Parameters
    ----------
    transport : LightTransport
        Rows of a glossy vertex, unit-albedo light and terms, share its cluster ([Leh07] 3.3).
    method : {"cpca", "haar"}
        Clustered principal components, per mesh ([SHHS03], [HR10] 6), or the largest Haar wavelet coefficients of each
        row ([NRH03]), which knows neither ``clusters`` nor ``bases`` nor ``seed``.
    clusters : int or dict of mesh name to int, optional
        Of each mesh; one for 300 vertices, at most 120, if not given.
    bases : int
        Basis vectors per cluster, at most.
    target_error : float, optional
        Relative L2 error of the compressed matrix against the given one. Clusters are doubled until it is met, basis
        vectors left out that it does not need. With "haar" it is that of each row on the sphere, 0.05 if not given.
    seed : int
    progress : bool
        Show a progress bar.

    Returns
    -------
    LightTransport
        Whose one operator, unit-albedo transport of direct and indirect light together, is compressed. ``report`` is
        the given matrix's with ``compression``: ``method``, ``clusters`` per mesh, ``bases``, ``error`` (relative L2,
        per mesh and ``total``, of T and ``on_sphere``: weighted by vertex area, solid angles divided out), ``nbytes``,
        ``ratio`` to float32 of the same channels, ``seconds``. "haar" has ``coefficients`` and ``kept_energy`` per mesh
        in place of clusters and bases (``truncation.haar_part``).

    Raises
    ------
    PrtError
        If an argument makes no sense, the matrix is compressed already, or glossy and ``method`` is "haar".
    """
    _check(transport, method, clusters, bases, target_error)
    clock = Stopwatch()
    if method == "haar":
        with clock.phase("haar"):
            wavelets, report = haar_part(transport, target_error or TARGET, progress)
        report = transport.report | {"compression": {"method": method, **report, "seconds": clock.report()}}
        return replace(transport, operators={"compressed": wavelets}, report=report)
    counts = _counts(transport, clusters)
    for attempt in range(ATTEMPTS):
        with clock.phase("cpca"):
            found = _clustered(transport, counts, bases, seed, progress)
        errors = _errors(transport, [(mesh.squares, mesh.norms) for mesh in found])
        if target_error is None or errors["total"] <= target_error or attempt + 1 == ATTEMPTS:
            break
        counts = {name: 2 * count for name, count in counts.items()}
    if target_error is not None and errors["total"] < target_error:
        with clock.phase("fewer_bases"):
            found, errors = _with_fewer_bases(transport, found, target_error)
    part = _joined(transport, found)
    compressed = replace(transport, operators={"compressed": part}, report=dict(transport.report))
    compressed.report["compression"] = {
        "method": method,
        "clusters": {mesh.name: len(part.means) for mesh, part in zip(transport.meshes, found, strict=True)},
        "bases": part.bases.shape[1],
        "error": errors | {"on_sphere": _errors(transport, [(mesh.left[-1], mesh.energy) for mesh in found])},
        "nbytes": compressed.nbytes,
        "ratio": 4 * np.prod(part.coefficients.shape[:2]) * part.lighting.n_directions / compressed.nbytes,
        "seconds": clock.report(),
    }
    return compressed


def _check(
    transport: LightTransport,
    method: str,
    clusters: int | dict[str, int] | None,
    bases: int,
    target_error: float | None,
) -> None:
    if method not in METHODS:
        raise PrtError(f"method {method!r} is none of: {', '.join(METHODS)}")
    if "compressed" in transport.operators:
        raise PrtError("this matrix is compressed already; give the one that it was made of")
    if transport.emission.kind != "cubemap":
        raise PrtError("compression is for light from a cubemap; a matrix of lamps is small as it is")
    if method == "haar" and transport.terms:
        raise PrtError("method 'haar' is for matrices of diffuse surfaces; compress this one by 'cpca'")
    if method == "haar" and clusters is not None:
        raise PrtError("clusters are of method 'cpca'; leave them out, or the method")
    names = {mesh.name for mesh in transport.meshes}
    for name in set(clusters) - names if isinstance(clusters, dict) else ():
        raise PrtError(f"clusters names the mesh {name!r}; the matrix has: {', '.join(sorted(names))}")
    for count in clusters.values() if isinstance(clusters, dict) else (clusters,):
        if count is not None and count < 1:
            raise PrtError(f"clusters must be at least 1, not {count}")
    if bases < 0:
        raise PrtError(f"bases must not be negative, but is {bases}")
    if target_error is not None and not 0 < target_error < 1:
        raise PrtError(f"target_error must be between 0 and 1, not {target_error}")


def default_clusters(transport: LightTransport) -> dict[str, int]:
    """Clusters of each mesh, by its number of vertices."""
    sizes = {mesh.name: mesh.vertices.stop - mesh.vertices.start for mesh in transport.meshes}
    return {name: min(MOST_CLUSTERS, max(1, round(n / PER_CLUSTER))) for name, n in sizes.items()}


def _counts(transport: LightTransport, clusters: int | dict[str, int] | None) -> dict[str, int]:
    counts = default_clusters(transport)
    given = clusters if isinstance(clusters, dict) else dict.fromkeys(counts, clusters)
    return counts | {name: count for name, count in given.items() if count is not None}


def _clustered(
    transport: LightTransport, counts: dict[str, int], bases: int, seed: int, progress: bool
) -> list[MeshClusters]:
    with tqdm(
        total=len(transport.measurement), desc="compress", unit=" vertices", disable=not progress
    ) as bar:
        found = []
        for mesh in transport.meshes:
            found.append(clustered_mesh(mesh_rows(transport, mesh), counts[mesh.name], bases, seed=seed))
            bar.update(mesh.vertices.stop - mesh.vertices.start)
    return found


def _errors(transport: LightTransport, sums: list[tuple[float, float]]) -> dict[str, float]:
    """Relative L2 of each mesh and ``total``, from squared errors and squared norms."""
    return relative_l2_by_name({mesh.name: pair for mesh, pair in zip(transport.meshes, sums, strict=True)})


def _with_fewer_bases(
    transport: LightTransport, found: list[MeshClusters], target: float
) -> tuple[list[MeshClusters], dict[str, float]]:
    """As few basis vectors as meet the target; what is left out on the sphere tells how many, then T does."""
    norms = sum(mesh.norms for mesh in found)
    for count in range(len(found[0].left)):
        predicted = sum(mesh.squares * mesh.left[count] / max(mesh.left[-1], 1e-30) for mesh in found)
        if predicted > (NEARLY * target) ** 2 * norms:
            continue
        fewer = [mesh.first(count) for mesh in found]
        errors = matrix_errors(
            transport, replace(transport, operators={"compressed": _joined(transport, fewer)})
        )
        if errors["total"] <= target:
            return fewer, errors
    return found, _errors(transport, [(mesh.squares, mesh.norms) for mesh in found])


def matrix_errors(exact: LightTransport, other: LightTransport) -> dict[str, float]:
    """Relative L2 of one matrix against another of the same vertices, per mesh and ``total``."""
    sums = []
    for mesh in exact.meshes:
        truth, ours = mesh_rows(exact, mesh), mesh_rows(other, mesh)
        squares, pair = np.square(truth.scale), np.zeros(2)
        for a in range(0, len(truth), ROWS):
            ids = np.arange(a, min(a + ROWS, len(truth)))
            rows = truth.rows(ids)
            for k, values in enumerate((ours.rows(ids) - rows, rows)):
                pair[k] += (truth.items.output_weights[ids] * (np.square(values) @ squares)).sum(
                    dtype=np.float64
                )
        sums.append((float(pair[0]), float(pair[1])))
    return _errors(exact, sums)


def _joined(transport: LightTransport, found: list[MeshClusters]) -> Clustered:
    """One part of all meshes."""
    rows = [mesh_rows(transport, mesh).items.rows for mesh in transport.meshes]
    firsts = np.cumsum([0, *(len(mesh.means) for mesh in found)])
    kind: type[np.unsignedinteger] = np.uint16 if firsts[-1] <= 1 << 16 else np.uint32
    widest = max(mesh.bases.shape[1] for mesh in found)
    count, channels = sum(some.size for some in rows), found[0].coefficients.shape[1] // rows[0].shape[1]
    labels: NDArray[np.unsignedinteger] = np.empty(count, kind)
    coefficients = np.zeros((count, channels, widest), np.float16)
    for mesh, some, first in zip(found, rows, firsts, strict=False):
        labels[some] = (mesh.labels + first)[:, None]
        coefficients[some, :, : mesh.bases.shape[1]] = mesh.coefficients.reshape(
            *some.shape, channels, mesh.bases.shape[1]
        )
    return Clustered(
        labels,
        coefficients,
        np.concatenate([mesh.means for mesh in found]),
        np.concatenate([_padded(mesh.bases, 1, widest) for mesh in found]),
        transport.lighting,
    )


def _padded(array: NDArray[np.float16], axis: int, length: int) -> NDArray[np.float16]:
    more = [(0, length - n if k == axis else 0) for k, n in enumerate(array.shape)]
    return np.pad(array, more)
