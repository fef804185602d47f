"""Glossy transport: its time against that of a diffuse matrix and of brute force, its images against Mitsuba's."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from mi_sparse_prt.benchmark.gallery import factor_picture
from mi_sparse_prt.benchmark.measuring import kept_memory, report_header, timed
from mi_sparse_prt.core.run import Run
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.emission.environment import Environment, load_environment
from mi_sparse_prt.measurement.measurement import mesh_vertices
from mi_sparse_prt.measurement.vertices import vertex_points
from mi_sparse_prt.methods.plan import Plan
from mi_sparse_prt.precompute import precompute
from mi_sparse_prt.reflection.brdf_factors import measure_factor_error
from mi_sparse_prt.reflection.in_out_factors import InOutFactors
from mi_sparse_prt.scene.materials import bsdf_class
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.solvers.problem import Problem
from mi_sparse_prt.solvers.term_paths import TermPaths
from mi_sparse_prt.transport import LightTransport
from mi_sparse_prt.validation.glossy_images import validate_glossy, with_bsdf
from mi_sparse_prt.validation.validate import save_figures

STUDIO = Path(__file__).parents[2] / "scenes_xml/envmaps/studio.exr"
TERMS = 4
REPEATS = 2  # of which the second counts: all is compiled then
EVALUATION = (
    "setup",
    "direct",
    "gather_rays",
    "interreflection",
)  # of a diffuse matrix; held-out elements are not

Report = dict[str, Any]


@dataclass(frozen=True)
class GlossyEffort:
    """How well glossy transport is measured.

    Attributes
    ----------
    rows, spp : int
        Vertices that brute force is timed at, and its paths per element.
    image_spp, image_width : int
        Of images.
    """

    rows: int = 64
    spp: int = 16
    image_spp: int = 512
    image_width: int = 320


FULL = GlossyEffort()


@kept_memory()
def measure_glossy(
    scene: Scene,
    lighting: CubemapLighting,
    progress: bool = True,
    figures: Path | None = None,
    effort: GlossyEffort = FULL,
) -> Report:
    """Measure the transport of a scene with glossy surfaces.

    Parameters
    ----------
    scene : Scene
        With an environment and a sensor.
    lighting : CubemapLighting
    progress : bool
    figures : path, optional
        Folder for images side by side ([HR10] Figures 17 to 19) and factors of each BRDF, made if needed.
    effort : GlossyEffort, optional

    Returns
    -------
    dict
        JSON as it is. ``seconds``: of ``glossy`` (factors from the cache), of ``diffuse``, a scene with the same
        surfaces made diffuse, by the same direct light and as many gather rays, and of ``brute_force``, extrapolated
        from some vertices, whose paths are shared by all terms; ``ratios`` of these. ``factors``: held-out errors of
        each BRDF. ``images``: what ``validate_glossy`` reports, under the scene's environment and another.
    """
    plan = Plan("exact", "gather", rays=64, tolerance=0.06)
    diffuse_scene = diffuse_copy(scene)
    for _ in range(REPEATS):
        diffuse = precompute(diffuse_scene, lighting, method=plan, progress=progress).report["seconds"]
        transport = precompute(scene, lighting, method=plan, terms=TERMS, progress=progress)
    brute = _time_brute_force(scene, transport, effort) + transport.report["seconds"]["direct"]
    seconds = {
        "glossy": sum(transport.report["seconds"].get(name, 0.0) for name in EVALUATION),
        "diffuse": sum(diffuse.get(name, 0.0) for name in EVALUATION),
        "brute_force": brute,
    }
    spp, width = effort.image_spp, effort.image_width
    images = validate_glossy(
        scene, transport, _environments(scene), spp=spp, width=width, run=Run(progress=progress)
    )
    if figures is not None:
        images.save(figures)
        drawn = {
            f"factors_{k}": factor_picture(factors) for k, factors in enumerate(_surfaces(transport).factors)
        }
        save_figures(figures, drawn)
    return {
        **report_header(scene, lighting),
        "parameters": transport.report["parameters"],
        "seconds": seconds,
        "phases": {"glossy": transport.report["seconds"], "diffuse": diffuse},
        "ratios": {
            "glossy_over_diffuse": seconds["glossy"] / seconds["diffuse"],
            "brute_force_over_glossy": seconds["brute_force"] / seconds["glossy"],
        },
        "ranks": transport.report["radiosity"]["ranks"],
        "factors": _factor_errors(scene, transport),
        "images": images.report,
    }


def _environments(scene: Scene) -> dict[str, Environment | mi.Emitter]:
    """The scene's own, and small lights, where the file is: it does not come with an installed package."""
    found: dict[str, Environment | mi.Emitter] = {"own": scene.mitsuba.environment()}
    if STUDIO.is_file():
        found["studio"] = load_environment(STUDIO)
    return found


def diffuse_copy(scene: Scene) -> Scene:
    """The same vertices, with diffuse surfaces of the same albedo where they are glossy."""
    shapes = {}
    for mesh, shape, material in zip(scene.fronts, scene.unlit_shapes(), scene.materials, strict=False):
        if not material.diffuse:
            albedo = scene.albedo[mesh.vertices].mean(axis=0).astype(float).tolist()
            bsdf = mi.load_dict({"type": "diffuse", "reflectance": {"type": "rgb", "value": albedo}})
            shape = with_bsdf(shape, bsdf, material.two_sided)
        shapes[mesh.name] = shape
    return Scene.from_mitsuba(mi.load_dict({"type": "scene", **shapes}, optimize=False), float("inf"))


def _time_brute_force(scene: Scene, transport: LightTransport, effort: GlossyEffort) -> float:
    """Seconds of paths for all elements, unit-albedo transport and all terms at once."""
    points, max_depth = vertex_points(scene), transport.report["parameters"]["max_depth"]
    here, surfaces = mesh_vertices(scene), transport.reflection
    paths = TermPaths(Problem(scene, transport.lighting, here, surfaces, max_depth=max_depth), effort.spp)
    every = transport.lighting.n_directions
    chosen = np.random.default_rng(0).permutation(len(points))[: 2 * effort.rows]
    for some in np.split(chosen, [effort.rows]):  # the second half counts
        place = np.repeat(some, every), np.tile(np.arange(every), len(some))
        elapsed, _ = timed(paths.elements, *place)
    return elapsed / effort.rows * len(points)


def _surfaces(transport: LightTransport) -> InOutFactors:
    assert isinstance(transport.reflection, InOutFactors)
    return transport.reflection


def _factor_errors(scene: Scene, transport: LightTransport) -> list[Report]:
    errors = []
    for number, factors in enumerate(_surfaces(transport).factors):
        vertex = int(np.flatnonzero(_surfaces(transport).material == number)[0])
        mesh, material = next(
            (m, k) for m, k in zip(scene.meshes, scene.materials, strict=True) if m.vertices.stop > vertex
        )
        error = measure_factor_error(factors, material.bsdf, mesh.name)
        regions = {name: getattr(error, name).tolist() for name in ("whole", "grazing", "peak")}
        errors.append(
            {"mesh": mesh.name, "bsdf": bsdf_class(material.bsdf), "terms": factors.terms} | regions
        )
    return errors
