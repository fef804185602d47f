"""Matrices on disk: one Zarr v3 hierarchy in one zip file, chunked by blocks of vertices.

Every chunk carries a checksum (the zip's CRC-32), so a truncated or altered file is refused. Files are written under
a temporary name beside the target and renamed when complete.
"""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse
import zarr
from numpy.typing import NDArray

from mi_sparse_prt.core.bits import BITS
from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.glossy import GlossyTransport
from mi_sparse_prt.glossy_storage import (
    factor_attributes,
    glossy_arrays,
    read_factors,
    read_glossy,
    row_count,
)
from mi_sparse_prt.io.atomic import write_atomically
from mi_sparse_prt.operators.clustered import Clustered
from mi_sparse_prt.operators.fractional_visibility import FractionalVisibility
from mi_sparse_prt.operators.haar_rows import HaarRows
from mi_sparse_prt.operators.interpolated import Interpolated
from mi_sparse_prt.operators.low_rank import LowRank
from mi_sparse_prt.operators.mean_cosine import MeanCosine
from mi_sparse_prt.operators.upsampled import Upsampled
from mi_sparse_prt.operators.visibility import Visibility
from mi_sparse_prt.transport import LightTransport, MeshRange

FORMAT = "mi_sparse_prt light transport matrix"
VERSION = 6
_VERTEX_CHUNK = 4096  # rows
_LIST_CHUNK = 1 << 20  # numbers of a plain list
# what Zarr, zip and our own assembly raise when a file is not what it should be
_DAMAGE = (
    OSError,
    EOFError,
    zipfile.BadZipFile,
    zlib.error,
    LookupError,
    TypeError,
    ValueError,
    RuntimeError,
)


def save(transport: LightTransport | GlossyTransport, path: str | Path) -> None:
    """Write a matrix to a file; an interrupted or failed write leaves nothing under the name.

    Parameters
    ----------
    transport : LightTransport or GlossyTransport
    path : path
        By convention ``*.prt``.

    Raises
    ------
    PrtError
        If the folder does not exist or the file cannot be written (full disk, permissions).
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise PrtError(f"cannot write {path}: the folder {path.parent} does not exist; create it first")
    if path.exists() and not path.is_file():
        raise PrtError(f"cannot write {path}: it is a folder or a device; give a file name such as scene.prt")
    try:
        write_atomically(path, lambda temporary: _write(transport, temporary))
    except OSError as error:
        raise PrtError(
            f"cannot write {path}: {error.strerror or error}; nothing was left behind, "
            "free some space or choose another folder"
        ) from None


def load_transport(path: str | Path, scene: Any = None) -> LightTransport | GlossyTransport:
    """Read a matrix from a file.

    Parameters
    ----------
    path : path
    scene : Scene, optional
        The scene it should belong to; a matrix of another scene is refused. Rows come in this scene's vertex order.

    Returns
    -------
    LightTransport or GlossyTransport
        Whichever was saved.

    Raises
    ------
    PrtError
        If the file is missing, no matrix, truncated, altered, of a newer format, or of another scene.
    """
    path = Path(path)
    if not path.is_file():
        raise PrtError(
            f"no such matrix file: {path}; make it with `mi-sparse-prt precompute SCENE -o {path}`"
        )
    broken = f"{path} is damaged or not a matrix file of mi_sparse_prt; precompute it again"
    try:
        store = zarr.storage.ZipStore(path, mode="r")
        group = zarr.open_group(store, mode="r")  # a store that could not be opened cannot be closed
        try:
            attributes: dict[str, Any] = dict(group.attrs)
            if attributes.get("format") != FORMAT:
                raise PrtError(broken)
            if attributes["version"] > VERSION:
                raise PrtError(f"{path} was written by a newer mi_sparse_prt; upgrade the package to read it")
            arrays = {name: _read(array) for name, array in group.arrays()}
        finally:
            store.close()
        transport = _assemble(attributes, arrays)
    except PrtError:
        raise
    except _DAMAGE as error:
        raise PrtError(f"{broken} ({' '.join(str(error).split()) or type(error).__name__})") from None
    return transport if scene is None else transport.for_scene(scene)


def _write(transport: LightTransport | GlossyTransport, path: Path) -> None:
    attributes: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "resolution": transport.lighting.resolution,
        "scene_hash": transport.scene_hash,
        "meshes": [[m.name, m.vertices.start, m.vertices.stop] for m in transport.meshes],
        "indirect": transport.indirect is not None,
        "report": transport.report,
    }
    if isinstance(transport, GlossyTransport):
        attributes["factors"] = factor_attributes(transport.factors)
    else:
        attributes["basis"] = transport.basis
    store = zarr.storage.ZipStore(path, mode="w")
    try:
        group = zarr.create_group(store, attributes=attributes)
        for name, array in _arrays(transport).items():
            length = _VERTEX_CHUNK if array.ndim > 1 else _LIST_CHUNK
            chunks = (min(length, max(1, len(array))), *array.shape[1:])
            group.create_array(name, data=array, chunks=chunks, config={"write_empty_chunks": True})
    finally:
        store.close()


def _arrays(transport: LightTransport | GlossyTransport) -> dict[str, NDArray[Any]]:
    arrays: dict[str, NDArray[Any]] = {
        "albedo": transport.albedo,
        "areas": transport.areas,
        "vertex_keys": transport.vertex_keys,
    }
    if isinstance(transport, GlossyTransport):
        arrays |= glossy_arrays(transport)
    direct, indirect = transport.direct, transport.indirect
    if isinstance(direct, Interpolated):
        arrays |= _sparse_arrays("weights_direct", direct.weights)
        direct = direct.dense  # type: ignore[assignment]
    if isinstance(indirect, Interpolated):
        arrays |= _sparse_arrays("weights_indirect", indirect.weights)
        indirect = indirect.dense  # type: ignore[assignment]
    if isinstance(direct, Visibility):
        arrays |= {"visibility": direct.bits, "normals": direct.normals}
    elif isinstance(direct, FractionalVisibility):
        arrays |= {"visibility": direct.bits, "normals": direct.normals}
        arrays |= {"share_starts": direct.starts, "share_texels": direct.texels, "shares": direct.shares}
    elif isinstance(direct, MeanCosine):
        arrays |= {"mean_cosine": direct.fixed}
    elif isinstance(direct, Clustered):
        arrays |= {"cluster_labels": direct.labels, "cluster_coefficients": direct.coefficients}
        arrays |= {"cluster_means": direct.means, "cluster_bases": direct.bases}
    elif isinstance(direct, HaarRows):
        arrays |= {"haar_starts": direct.starts, "haar_places": direct.places}
        arrays |= {"haar_values": direct.values, "haar_scales": direct.scales}
    if isinstance(indirect, Upsampled):
        arrays |= {"indirect": indirect.density, **_sparse_arrays("upsampling", indirect.upsampling)}
    elif isinstance(indirect, LowRank):
        for name, factors in (("left", indirect.left), ("right", indirect.right)):
            arrays |= {f"{name}_{c}": factor for c, factor in enumerate(factors)}
    return arrays


def _sparse_arrays(name: str, matrix: scipy.sparse.csr_array) -> dict[str, NDArray[Any]]:
    """A sparse matrix as three arrays; the number of its columns is known from elsewhere."""
    return {f"{name}_{part}": getattr(matrix, part) for part in ("data", "indices", "indptr")}


def _sparse_matrix(name: str, arrays: dict[str, NDArray[Any]], columns: int) -> scipy.sparse.csr_array:
    data, indices, indptr = (arrays[f"{name}_{part}"] for part in ("data", "indices", "indptr"))
    matrix = scipy.sparse.csr_array((data, indices, indptr), shape=(len(indptr) - 1, columns))
    matrix.check_format(full_check=True)  # products do not look whether an index is out of range
    return matrix


def _read(array: Any) -> NDArray[Any]:
    if array.nchunks_initialized != array.nchunks:
        raise ValueError(f"{array.nchunks - array.nchunks_initialized} chunks are missing")
    return np.asarray(array[...])


def _assemble(
    attributes: dict[str, Any], arrays: dict[str, NDArray[Any]]
) -> LightTransport | GlossyTransport:
    lighting = CubemapLighting(attributes["resolution"])
    if "factors" in attributes:
        factors = read_factors(attributes["factors"], arrays)
        _check_shapes(arrays, lighting, row_count(factors, arrays["material"]))
        compressed = _clustered(arrays, lighting) if "cluster_labels" in arrays else None
        indirect = _factored(arrays) if attributes["indirect"] else None
        return read_glossy(attributes, arrays, lighting, factors, compressed, indirect)
    _check_shapes(arrays, lighting, len(arrays["albedo"]))
    return LightTransport(
        lighting=lighting,
        basis=attributes["basis"],
        albedo=arrays["albedo"],
        areas=arrays["areas"] if attributes["version"] >= 5 else np.ones(len(arrays["albedo"]), np.float32),
        direct=_direct(attributes["basis"], arrays, lighting),
        indirect=_indirect(arrays, lighting) if attributes["indirect"] else None,
        meshes=tuple(MeshRange(name, slice(a, b)) for name, a, b in attributes["meshes"]),
        vertex_keys=arrays["vertex_keys"],
        scene_hash=attributes["scene_hash"],
        report=attributes["report"],
    )


def _direct(
    basis: str, arrays: dict[str, NDArray[Any]], lighting: CubemapLighting
) -> Visibility | FractionalVisibility | MeanCosine | Interpolated | Clustered | HaarRows:
    if "cluster_labels" in arrays:
        return _clustered(arrays, lighting)
    if "haar_scales" in arrays:
        return _haar_rows(arrays, lighting)
    if basis == "direction":
        direct = Visibility(arrays["visibility"], arrays["normals"], lighting)
        if "weights_direct_data" in arrays:
            return Interpolated(direct, _sparse_matrix("weights_direct", arrays, len(direct.bits)))
        return direct
    if "shares" in arrays:
        starts, texels, shares = _shares(arrays, lighting.n_directions)
        return FractionalVisibility(arrays["visibility"], starts, texels, shares, arrays["normals"], lighting)
    return MeanCosine(arrays["mean_cosine"], lighting)


def _clustered(arrays: dict[str, NDArray[Any]], lighting: CubemapLighting) -> Clustered:
    """Labels are looked at: a wrong one would read beyond the clusters."""
    labels, coefficients, means, bases = (
        arrays[f"cluster_{name}"] for name in ("labels", "coefficients", "means", "bases")
    )
    if coefficients.shape[1] not in (1, 3) or (len(labels) and labels.max() >= len(means)):
        raise ValueError("clusters and their vertices do not fit together")
    if bases.shape[:2] != (len(means), coefficients.shape[2]):
        raise ValueError("basis vectors and coefficients do not fit together")
    return Clustered(labels, coefficients, means, bases, lighting)


def _haar_rows(arrays: dict[str, NDArray[Any]], lighting: CubemapLighting) -> HaarRows:
    """Lists are looked at: a wrong one would read beyond the lighting's coefficients."""
    starts, places, values, scales = (
        arrays[f"haar_{name}"] for name in ("starts", "places", "values", "scales")
    )
    if scales.shape[1] not in (1, 3) or places.shape != values.shape or values.dtype != np.float16:
        raise ValueError("wavelet coefficients and their vertices do not fit together")
    matrix = scipy.sparse.csr_array((places, places, starts), shape=(scales.size, lighting.n_directions))
    matrix.check_format(full_check=True)
    if not matrix.has_canonical_format:
        raise ValueError("wavelet coefficients are not in order")
    return HaarRows(starts, places, values, scales, lighting)


def _shares(
    arrays: dict[str, NDArray[Any]], n_directions: int
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Lists of texels that are seen in part; nothing that uses them looks whether they make sense."""
    starts, texels, shares = (arrays[name] for name in ("share_starts", "share_texels", "shares"))
    matrix = scipy.sparse.csr_array((shares, texels, starts), shape=(len(starts) - 1, n_directions))
    matrix.check_format(full_check=True)
    if not matrix.has_canonical_format:
        raise ValueError("texels that are seen in part are not in order")
    return starts, texels, shares


def _indirect(
    arrays: dict[str, NDArray[Any]], lighting: CubemapLighting
) -> Upsampled | Interpolated | LowRank:
    if "left_0" in arrays:
        return _factored(arrays)
    density = arrays["indirect"]
    indirect = Upsampled(density, _sparse_matrix("upsampling", arrays, density.shape[1]), lighting)
    if "weights_indirect_data" in arrays:
        return Interpolated(indirect, _sparse_matrix("weights_indirect", arrays, len(density)))
    return indirect


def _factored(arrays: dict[str, NDArray[Any]]) -> LowRank:
    left, right = (
        [arrays[f"{side}_{c}"] for c in range(3) if f"{side}_{c}" in arrays] for side in ("left", "right")
    )
    if len(left) not in (1, 3) or [a.shape[1] for a in left] != [b.shape[0] for b in right]:
        raise ValueError("factors of the indirect light do not fit together")
    return LowRank(tuple(left), tuple(right))


def _check_shapes(arrays: dict[str, NDArray[Any]], lighting: CubemapLighting, rows: int) -> None:
    """All arrays are of the same vertices, or of all rows, and of the file's lighting."""
    n, m = len(arrays["albedo"]), lighting.n_directions
    # an interpolated part has fewer rows than the matrix, and weights with a row for each vertex
    n_direct = len(arrays["normals"]) if "weights_direct_indptr" in arrays else n
    n_indirect = len(arrays["indirect"]) if "weights_indirect_indptr" in arrays else n
    expected = {
        "albedo": (n, 3),
        "areas": (n,),
        "vertex_keys": (n,),
        "normals": (n_direct, 3),
        "visibility": (n_direct, -(-m // BITS)),
        "mean_cosine": (n, m),
        "share_starts": (n + 1,),
        "indirect": (n_indirect, *arrays["indirect"].shape[1:]) if "indirect" in arrays else (),
        "upsampling_indptr": (m + 1,),
        "cluster_labels": (rows,),
        "weights_direct_indptr": (n + 1,),
        "weights_indirect_indptr": (n + 1,),
    }
    for name, array in arrays.items():
        if name.startswith("left_") or name in ("cluster_coefficients", "haar_scales"):
            expected[name] = (rows, *array.shape[1:])
        elif name.startswith("right_") or name in ("cluster_means", "cluster_bases"):
            expected[name] = (*array.shape[:-1], m)
    for name, shape in expected.items():
        if name in arrays and arrays[name].shape != shape:
            raise ValueError(f"array {name} has shape {arrays[name].shape} instead of {shape}")
