"""Matrices read from files: emission space, measurement, reflection and operators revived by name."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.emission.emitters import StoredEmitters
from mi_sparse_prt.emission.space import EmissionSpace
from mi_sparse_prt.io.store import DAMAGE, Arrays, read_store
from mi_sparse_prt.measurement.measurement import Measurement
from mi_sparse_prt.operators.stored import operator_from_arrays
from mi_sparse_prt.reflection.in_out_factors import InOutFactors
from mi_sparse_prt.reflection.reflection import Diffuse, Reflection
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.transport import FORMAT, VERSION, LightTransport

_REFLECTIONS: dict[str, type[Reflection]] = {kind.kind: kind for kind in (Diffuse, InOutFactors)}


def load_transport(path: str | Path, scene: Scene | None = None) -> LightTransport:
    """Read a matrix from a file.

    Parameters
    ----------
    path : path
    scene : Scene, optional
        The scene it should belong to; a matrix of another scene is refused. Rows come in this scene's vertex order.

    Returns
    -------
    LightTransport

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
        attributes, arrays = read_store(path)
        if attributes.get("format") != FORMAT:
            raise PrtError(broken)
        if attributes["version"] > VERSION:
            raise PrtError(f"{path} was written by a newer mi_sparse_prt; upgrade the package to read it")
        if attributes["version"] < VERSION:
            attributes, arrays = _upgraded(attributes, arrays)
        transport = _assembled(path, attributes, arrays)
    except PrtError:
        raise
    except DAMAGE as error:
        raise PrtError(f"{broken} ({' '.join(str(error).split()) or type(error).__name__})") from None
    return transport if scene is None else transport.for_scene(scene)


def _assembled(path: Path, attributes: dict[str, Any], arrays: Arrays) -> LightTransport:
    emission = attributes["emission"]
    if emission["kind"] == "cubemap":
        lighting: EmissionSpace = CubemapLighting(emission["resolution"])
    elif emission["kind"] == "emitters":
        lighting = StoredEmitters(emission["groups"])
    else:
        raise PrtError(
            f"{path} has the emission space {emission['kind']!r}, which is unknown here; upgrade the package"
        )
    measurement = Measurement.from_arrays(attributes["measurement"], _under("measurement.", arrays))
    known = attributes["reflection"]
    reflection = _REFLECTIONS[known["kind"]].from_arrays(known, _under("reflection.", arrays))
    kinds: dict[str, str] = attributes["operators"]
    operators = {
        name: operator_from_arrays(name, kinds, arrays, lighting) for name in kinds if "." not in name
    }
    if attributes["basis"] not in ("direction", "texel") or not operators:
        raise ValueError("no operators of a basis that is known")
    rows = reflection.row_count, lighting.size
    if len(reflection.albedo) != len(measurement) or any(
        operator.shape[:2] != rows for operator in operators.values()
    ):
        raise ValueError("arrays are not all of the same points")
    dense = arrays.get("dense_vertices")
    if dense is not None and np.any(dense >= len(measurement)):
        raise ValueError("dense vertices that the matrix does not have")
    return LightTransport(
        lighting,
        attributes["basis"],
        attributes.get("max_depth", attributes["report"].get("parameters", {}).get("max_depth", -1)),
        measurement,
        reflection,
        operators,
        attributes["scene_hash"],
        attributes["report"],
        None if dense is None else dense.astype(np.int64),
    )


def _under(start: str, arrays: Arrays) -> Arrays:
    """Arrays whose names begin so, without that."""
    return {name.removeprefix(start): array for name, array in arrays.items() if name.startswith(start)}


# --- files of versions 1 to 6 -------------------------------------------------------------------------------

# how names of arrays began, and what followed, of each kind of compressed operator
_COMPRESSED = {
    "clustered": ("cluster", ("labels", "coefficients", "means", "bases")),
    "haar_rows": ("haar", ("starts", "places", "values", "scales")),
}


def _upgraded(attributes: dict[str, Any], old: Arrays) -> tuple[dict[str, Any], Arrays]:
    """Attributes and arrays of a file as version 7 has them."""
    glossy = "factors" in attributes
    new = {
        "measurement.keys": old["vertex_keys"],
        "measurement.areas": old.get("areas", np.ones(len(old["albedo"]), np.float32)),
    }
    surfaces = ["albedo", *(["tangents", "normals", "material"] if glossy else [])]
    surfaces += [name for name in old if name.startswith("factors_")]
    new |= {f"reflection.{name}": old[name] for name in surfaces}
    kinds: dict[str, str] = {}
    indirect = _upgraded_indirect(old) if attributes["indirect"] else ({}, {})
    for part in (_upgraded_direct(attributes, old), indirect):
        kinds, new = kinds | part[0], new | part[1]
    return {
        "format": FORMAT,
        "version": VERSION,
        "emission": {"kind": "cubemap", "resolution": attributes["resolution"]},
        "basis": attributes.get("basis", "direction"),
        "measurement": {"groups": attributes["meshes"]},
        "reflection": {
            "kind": "in_out_factors" if glossy else "diffuse",
            "factors": attributes.get("factors"),
            "harmonics": attributes["report"].get("parameters", {}).get("harmonics"),
        },
        "operators": kinds,
        "scene_hash": attributes["scene_hash"],
        "report": attributes["report"],
    }, new


def _upgraded_direct(attributes: dict[str, Any], old: Arrays) -> tuple[dict[str, str], Arrays]:
    """Kinds and arrays of direct light, or of all light of a compressed matrix."""
    for kind, (start, names) in _COMPRESSED.items():
        if f"{start}_{names[0]}" in old:
            return {"compressed": kind}, {f"compressed.{name}": old[f"{start}_{name}"] for name in names}
    if attributes.get("basis") == "texel" and "shares" not in old:
        return {"direct": "mean_cosine"}, {"direct.mean_cosine": old["mean_cosine"]}
    bits = {"visibility": old["visibility"], "normals": old["normals"]}
    if attributes.get("basis") == "texel":
        bits |= {"starts": old["share_starts"], "texels": old["share_texels"], "shares": old["shares"]}
        return {"direct": "fractional_visibility"}, _below("direct", bits)
    if "factors" in attributes:
        material = np.full(len(old["material"]), -1, np.int64)
        material[old["material"] >= 0] = old["incident_numbers"]
        own = {"tangents": old["tangents"], "material": material, "tables": old["incident_tables"]}
        kinds = {"direct": "factored_visibility", "direct.visibility": "visibility"}
        return kinds, _below("direct.visibility", bits) | _below("direct", own)
    if "weights_direct_data" in old:
        weights = _renamed("weights_direct", "direct.weights", old)
        return {"direct": "interpolated", "direct.dense": "visibility"}, _below(
            "direct.dense", bits
        ) | weights
    return {"direct": "visibility"}, _below("direct", bits)


def _below(start: str, arrays: Arrays) -> Arrays:
    """Arrays by names that begin so."""
    return {f"{start}.{name}": array for name, array in arrays.items()}


def _upgraded_indirect(old: Arrays) -> tuple[dict[str, str], Arrays]:
    if "left_0" in old:
        factors = {name: array for name, array in old.items() if name.startswith(("left_", "right_"))}
        return {"indirect": "low_rank"}, _below("indirect", factors)
    if "weights_indirect_data" in old:
        dense = {"indirect.dense.density": old["indirect"]}
        dense |= _renamed("upsampling", "indirect.dense.upsampling", old)
        weights = _renamed("weights_indirect", "indirect.weights", old)
        return {"indirect": "interpolated", "indirect.dense": "upsampled"}, dense | weights
    arrays = {"indirect.density": old["indirect"]}
    return {"indirect": "upsampled"}, arrays | _renamed("upsampling", "indirect.upsampling", old)


def _renamed(name: str, new: str, old: Arrays) -> Arrays:
    """The three arrays of a sparse matrix under another name."""
    return {f"{new}_{part}": old[f"{name}_{part}"] for part in ("data", "indices", "indptr")}
