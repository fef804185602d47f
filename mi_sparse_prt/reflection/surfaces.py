"""R of a scene's vertices: Lambertian, or with in-out factors where BSDFs are not."""

from __future__ import annotations

import warnings

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_sparse_prt.core.errors import PrtError, PrtWarning
from mi_sparse_prt.reflection.brdf_factors import (
    BrdfFactors,
    diffuse_reflectance,
    factors_of,
    harmonic_factors,
    is_anisotropic,
)
from mi_sparse_prt.reflection.frames import beside_vertices, vertex_tangents
from mi_sparse_prt.reflection.in_out_factors import InOutFactors
from mi_sparse_prt.reflection.reflection import Diffuse, Reflection
from mi_sparse_prt.scene.scene import Scene

NO_TANGENTS = (
    "shape '{}': its BSDF is anisotropic and it has no texture coordinates: Mitsuba then takes the first edge of each "
    "triangle for its tangent, which vertices cannot follow; give it texture coordinates"
)


def vertex_reflection(scene: Scene, terms: int = 0, harmonics: int | None = None) -> Reflection:
    """What vertices do with incident light.

    Parameters
    ----------
    scene : Scene
        With terms, BSDFs are diffuse or can be factored (``reflection.brdf_factors``).
    terms : int
        K, in-out factors of each BRDF that is not diffuse; 0 takes all for diffuse.
    harmonics : int, optional
        Spherical harmonics up to this order in place of each BRDF's own incident factors: (order + 1)^2 terms.

    Raises
    ------
    PrtError
        If no surface is glossy, though terms are asked for, or a BSDF cannot be factored, by name.
    """
    if not terms and harmonics is None:
        return Diffuse(scene.albedo)
    material, known = np.full(scene.n_vertices, -1), dict[bytes, int]()
    factors: list[BrdfFactors] = []
    albedo, surface = scene.albedo.copy(), beside_vertices(scene)
    shapes = scene.mitsuba.shapes()
    for mesh, own in zip(scene.meshes, scene.materials, strict=True):
        if own.diffuse:
            continue
        if not shapes[mesh.shape].has_vertex_texcoords() and is_anisotropic(own.bsdf, mesh.name):
            warnings.warn(NO_TANGENTS.format(mesh.name), PrtWarning, stacklevel=3)
        digest = own.digest()
        if digest not in known:
            known[digest] = len(factors)
            factors.append(
                factors_of(own.bsdf, mesh.name, terms)
                if harmonics is None
                else harmonic_factors(own.bsdf, mesh.name, harmonics)
            )
        material[mesh.vertices] = known[digest]
        found = factors[known[digest]]
        albedo[mesh.vertices] = found.diffuse
        if found.varying_diffuse:
            here = dr.arange(mi.UInt32, mesh.vertices.start, mesh.vertices.stop)
            albedo[mesh.vertices] = diffuse_reflectance(
                own.bsdf, mesh.name, dr.gather(mi.SurfaceInteraction3f, surface, here)
            )
    if not factors:
        raise PrtError(
            "no surface of the scene is glossy: leave terms out, its matrix is the same for all views"
        )
    return InOutFactors(albedo, vertex_tangents(scene), scene.normals, material, tuple(factors), harmonics)
