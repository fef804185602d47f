"""Time and error of the sparse methods against brute force and a converged reference ([HR10] sections 4, 5 and 7)."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mi_sparse_prt.benchmark.converged_reference import MAX_DEPTH, SPP, Reference, ReferenceEffort
from mi_sparse_prt.benchmark.measuring import kept_memory, report_header
from mi_sparse_prt.benchmark.method_figures import MethodPictures, PictureEffort, method_figures
from mi_sparse_prt.benchmark.relit_reference import RelitEffort, RelitReference
from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.precompute import precompute
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.transport import LightTransport
from mi_sparse_prt.validation.validate import save_figures

METHODS = ("sparse", "huang2010", "gather")
WARM_UP = 4  # texels per edge of a face
# Phases as Figure 12 names them; what is not listed is its "system time"
STAGES = {
    # the pilot asks rays whether surfaces meet; to "gather" all vertices are dense
    "dense rays": ("pilot", "direct", "dense_rays", "dense_paths"),
    "sparse rays": ("sparse_rays", "sparse_paths"),
    "spatial sampling": ("spatial_sampling",),
    "rank": ("rank",),
    "angular sampling": ("angular_sampling", "features"),
    "gather rays": ("gather_rays",),
    "solver": ("solver", "low_rank", "consensus", "repair", "interreflection"),
    "held out": ("held_out",),
}
RAYS = ("dense rays", "sparse rays", "gather rays", "held out")  # the held-out error is paths


@dataclass(frozen=True)
class ComparisonEffort:
    """How well a comparison knows the truth, and how it is drawn."""

    reference: ReferenceEffort = field(default_factory=ReferenceEffort)
    relit: RelitEffort = field(default_factory=RelitEffort)
    pictures: PictureEffort = field(default_factory=PictureEffort)


CONVERGED = ComparisonEffort()


@kept_memory()
def measure_methods(
    scene: Scene,
    lighting: CubemapLighting,
    methods: list[str],
    progress: bool = True,
    figures: Path | None = None,
    effort: ComparisonEffort = CONVERGED,
) -> dict[str, Any]:
    """Run methods on a scene, direct light and three interreflections, 16 paths per element (``"gather"`` has none).

    Parameters
    ----------
    scene : Scene
    lighting : CubemapLighting
    methods : list of str
        Of ``precompute``, without brute force.
    progress : bool
    figures : path, optional
        A folder for a PNG of every figure (see ``method_figures``), made if needed.
    effort : ComparisonEffort, optional

    Returns
    -------
    dict
        JSON as it is. ``brute_force``: ``direct_seconds`` (whole matrix), ``paths_seconds`` (from some whole wavefronts
        of successive rows) and its standard error, ``seconds`` (their sum), and the ``errors`` that its 16
        paths leave. ``reference_noise`` per mesh, relative L2 of the matrix, and ``lighting_noise`` per mesh and
        environment. For each of ``methods``:

        - ``seconds`` per phase, ``stages`` as in Figure 12; ``ratio`` of its time to that of brute force and
          ``elements`` (share of all), both with the held-out elements, and in ``without_held_out`` without;
          ``seconds_per_element``, the cost of an element relative to one of brute force; ``overhead``: all that is no
          ray or path, as a share of its own time, and in microseconds per sparse vertex (None without such).
        - ``elements_of_parts``, ``rays``, and ``sampling`` rates per mesh as in Figure 9 (of methods that leave
          elements out).
        - ``errors`` per mesh: relative L2 ``total``, ``direct`` and ``indirect``, all relative to the whole matrix of
          the mesh but the direct one, which is relative to the direct matrix; ``standard_error`` of those that are
          sampled; the worst of sampled whole ``rows``, and of all ``direct_rows`` and ``direct_columns``.
        - ``environments`` per mesh: relative L2 of the relit vertices. ``rotation``: the same while an environment
          turns, and how it changes from frame to frame.

    Raises
    ------
    PrtError
        If a method is unknown or brute force itself.
    """
    for method in methods:
        if method not in METHODS:
            raise PrtError(
                f"method {method!r} cannot be compared with brute force; choose {' or '.join(METHODS)}"
            )
    reference = Reference(scene, lighting, progress, effort.reference)
    relit = RelitReference(scene, reference.direct, progress, effort.relit)
    brute_force = _brute_force(reference)
    report: dict[str, Any] = {
        **report_header(scene, lighting),
        "parameters": {"max_depth": MAX_DEPTH, "spp": SPP},
        "brute_force": brute_force,
        "reference_noise": reference.noise()["meshes"],
        "lighting_noise": relit.noise(),
        "methods": {},
    }
    pictures = MethodPictures(scene, reference.direct, progress, effort.pictures) if figures else None
    for method in dict.fromkeys(methods):
        # what is compiled on the first run of an installation is not the method's time
        precompute(scene, CubemapLighting(WARM_UP), method, max_depth=MAX_DEPTH, spp=1, progress=False)
        transport = precompute(scene, lighting, method, max_depth=MAX_DEPTH, spp=SPP, progress=progress)
        errors, direct = reference.errors(transport)
        report["methods"][method] = (
            _cost(transport, brute_force["seconds"]) | {"errors": errors} | relit.errors(transport)
        )
        if pictures:
            pictures.add(method, transport, direct.vertices())
    if figures and pictures:
        save_figures(figures, method_figures(report, pictures))
    return report


def _brute_force(reference: Reference) -> dict[str, Any]:
    """Seconds that all elements would take with as many paths each as the methods have, and their errors."""
    paths, errors = reference.time_paths(SPP), reference.relative_l2_of_paths(SPP)
    deviations = errors["standard_error"]["meshes"]
    return {
        "direct_seconds": reference.direct_seconds,
        "paths_seconds": paths.seconds,
        "paths_seconds_standard_error": paths.standard_error,
        "seconds": reference.direct_seconds + paths.seconds,
        "rows": paths.rows,
        "errors": {
            name: {
                "total": value,
                "direct": 0.0,
                "indirect": value,
                "standard_error": dict.fromkeys(("total", "indirect"), deviations[name]),
            }
            for name, value in errors["meshes"].items()
        },
    }


def _cost(transport: LightTransport, brute_force: float) -> dict[str, Any]:
    """Time and elements, the held-out ones included, and where the time went."""
    made = transport.report
    seconds, total = made["seconds"], made["elements_total"]
    stages = seconds_of_stages(seconds)
    overhead = seconds["total"] - sum(stages[name] for name in RAYS)
    evaluated = made["elements_evaluated"]
    elements = (evaluated + made["estimated_error"]["elements"]) / total
    sparse = _sparse_vertices(transport)
    ratio = seconds["total"] / brute_force
    own = seconds["total"] - seconds["held_out"]
    return {
        "seconds": seconds,
        "stages": stages,
        "ratio": ratio,
        "elements": elements,
        "without_held_out": {"ratio": own / brute_force, "elements": evaluated / total},
        "seconds_per_element": ratio / elements,
        "overhead": {
            "share": overhead / seconds["total"],
            "microseconds_per_sparse_vertex": 1e6 * overhead / sparse if sparse else None,
        },
        "elements_of_parts": {name: count / total for name, count in made["elements"].items()},
        "rays": made["rays"],
        "sampling": made["sampling"],
        "estimated_error": made["estimated_error"],
        "stored_bytes": transport.nbytes,
    }


def seconds_of_stages(seconds: dict[str, float]) -> dict[str, float]:
    """Seconds of phases as those of the stages of Figure 12; they add up to ``seconds["total"]``."""
    stages = {stage: sum(seconds.get(phase, 0.0) for phase in phases) for stage, phases in STAGES.items()}
    return stages | {"system": seconds["total"] - sum(stages.values())}


def _sparse_vertices(transport: LightTransport) -> float:
    rates = transport.report["sampling"]
    return sum(
        (1 - rates[mesh.name]["dense_vertices"]) * (mesh.vertices.stop - mesh.vertices.start)
        for mesh in transport.meshes
        if mesh.name in rates
    )
