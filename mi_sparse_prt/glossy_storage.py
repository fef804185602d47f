"""View-dependent transport on disk: what a file has besides or instead of a matrix' arrays (``storage``)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.bits import BITS
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.glossy import GlossyTransport
from mi_sparse_prt.operators.clustered import Clustered
from mi_sparse_prt.operators.factored_visibility import FactoredVisibility
from mi_sparse_prt.operators.low_rank import LowRank
from mi_sparse_prt.reflection.brdf_factors import BrdfFactors, DirectionGrid
from mi_sparse_prt.reflection.frames import frames
from mi_sparse_prt.transport import MeshRange

Arrays = dict[str, NDArray[Any]]


def factor_attributes(factors: tuple[BrdfFactors, ...]) -> list[dict[str, Any]]:
    """What is no array, of each BRDF; JSON as it is."""
    return [
        {"heights": f.grid.heights, "azimuths": f.grid.azimuths, "varying_diffuse": f.varying_diffuse}
        for f in factors
    ]


def glossy_arrays(transport: GlossyTransport) -> Arrays:
    """Arrays of surfaces, BRDFs and direct light."""
    arrays: Arrays = {
        "normals": transport.normals,
        "tangents": transport.tangents,
        "material": transport.material,
    }
    for number, factors in enumerate(transport.factors):
        arrays |= {
            f"factors_{number}_{name}": getattr(factors, name) for name in ("diffuse", "incident", "outgoing")
        }
    if isinstance(transport.direct, FactoredVisibility):
        direct = transport.direct
        arrays |= {"visibility": direct.bits, "incident_tables": direct.tables}
        arrays |= {"incident_numbers": direct.materials}
    return arrays


def read_factors(attributes: list[dict[str, Any]], arrays: Arrays) -> tuple[BrdfFactors, ...]:
    """BRDFs; their arrays are looked at."""
    found = []
    for number, known in enumerate(attributes):
        grid = DirectionGrid(known["heights"], known["azimuths"])
        diffuse, incident, outgoing = (
            arrays[f"factors_{number}_{name}"] for name in ("diffuse", "incident", "outgoing")
        )
        size, (terms, channels) = grid.heights * grid.azimuths, outgoing.shape[:2]
        if (
            incident.shape != (terms, size)
            or outgoing.shape[2] != size
            or len(diffuse) not in (1, 3)
            or channels not in (1, 3)
        ):
            raise ValueError(f"factors of BRDF {number} do not fit together")
        found.append(BrdfFactors(grid, diffuse, incident, outgoing, bool(known["varying_diffuse"])))
    return tuple(found)


def row_count(factors: tuple[BrdfFactors, ...], material: NDArray[np.integer]) -> int:
    """Rows of white light and of terms."""
    if not factors or (len(material) and not -1 <= material.min() <= material.max() < len(factors)):
        raise ValueError("vertices and their BRDFs do not fit together")
    return len(material) + int((material >= 0).sum()) * max(f.terms for f in factors)


def read_glossy(
    attributes: dict[str, Any],
    arrays: Arrays,
    lighting: CubemapLighting,
    factors: tuple[BrdfFactors, ...],
    compressed: Clustered | None,
    indirect: LowRank | None,
) -> GlossyTransport:
    """The transport; arrays of surfaces and direct light are looked at."""
    n = len(arrays["albedo"])
    if arrays["tangents"].shape != (n, 3) or arrays["material"].shape != (n,):
        raise ValueError("vertices and their tangents do not fit together")
    return GlossyTransport(
        lighting=lighting,
        albedo=arrays["albedo"],
        areas=arrays["areas"],
        direct=compressed or _factored_visibility(arrays, lighting, factors),
        indirect=indirect,
        tangents=arrays["tangents"],
        normals=arrays["normals"],
        material=arrays["material"],
        factors=factors,
        meshes=tuple(MeshRange(name, slice(a, b)) for name, a, b in attributes["meshes"]),
        vertex_keys=arrays["vertex_keys"],
        scene_hash=attributes["scene_hash"],
        report=attributes["report"],
    )


def _factored_visibility(
    arrays: Arrays, lighting: CubemapLighting, factors: tuple[BrdfFactors, ...]
) -> FactoredVisibility:
    """Numbers of tables are looked at: a wrong one would read beyond them."""
    glossy = np.flatnonzero(arrays["material"] >= 0)
    bits, tables, numbers = (arrays[name] for name in ("visibility", "incident_tables", "incident_numbers"))
    terms = max(f.terms for f in factors)
    if tables.ndim != 4 or tables.shape[1] != tables.shape[2] or tables.shape[3] != terms:
        raise ValueError("tables of incident factors and their BRDFs do not fit together")
    if numbers.shape != glossy.shape or (
        len(numbers) and not 0 <= numbers.min() <= numbers.max() < len(tables)
    ):
        raise ValueError("tables of incident factors and their vertices do not fit together")
    if bits.shape[1] != -(-lighting.n_directions // BITS):
        raise ValueError("visibility does not fit the lighting")
    turn = frames(arrays["tangents"][glossy], arrays["normals"][glossy])
    return FactoredVisibility(bits, arrays["normals"], lighting, glossy, turn, numbers, tables)
