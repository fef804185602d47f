"""R of a scene's vertices: Lambertian, or with in-out factors where BSDFs are not."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.core.errors import PrtError, PrtWarning
from mi_sparse_prt.reflection.brdf_factors import (
    BrdfFactors,
    UnfactorableError,
    diffuse_reflectance,
    factors_for_images,
    factors_of,
    harmonic_factors,
    is_anisotropic,
)
from mi_sparse_prt.reflection.frames import beside_vertices, vertex_tangents
from mi_sparse_prt.reflection.in_out_factors import InOutFactors
from mi_sparse_prt.reflection.reflection import Diffuse, Reflection
from mi_sparse_prt.scene.materials import Material, bsdf_class
from mi_sparse_prt.scene.notes import Fact, Notes, listed
from mi_sparse_prt.scene.scene import Scene

TOO_NARROW = 0.5  # error of 16 factors that are left out: a diffuse surface in their place has 1
BETWEEN = 0.1  # error of factors that tell what followed surfaces send to others, by which it is blurred
FOLLOWED = 2.0  # times the bound, which is the target error: to be more exact is not worth the noise of rays
_TANGENTS = (
    ": {0} BSDF is anisotropic and {1} no texture coordinates: Mitsuba then takes the first edge of each triangle for "
    "its tangent, which vertices cannot follow; give {2} texture coordinates"
)
_NO_TANGENTS = Fact(_TANGENTS.format("its", "it has", "it"), _TANGENTS.format("their", "they have", "them"))

# factors of a BSDF, and the names of its shapes; None if it counts as diffuse
Find = Callable[[Material, list[str]], BrdfFactors | None]


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

    def find(material: Material, names: list[str]) -> BrdfFactors:
        if harmonics is None:
            return factors_of(material.bsdf, names[0], terms)
        return harmonic_factors(material.bsdf, names[0], harmonics)

    found = _with_factors(scene, find, harmonics)
    if found is None:
        raise PrtError(
            "no surface of the scene is glossy: leave terms out, its matrix is the same for all views"
        )
    return found


class ChosenReflection(NamedTuple):
    """R of a matrix, and that of light that surfaces send to each other, where it has more terms."""

    seen: Reflection
    sent: InOutFactors | None


def chosen_reflection(scene: Scene, bound: float) -> ChosenReflection:
    """What vertices do with incident light, with as many in-out factors as images need.

    Delta lobes have none: what a camera's ray sees by way of mirrors and glass, it sees by going on. Surfaces that
    cannot be factored are left as diffuse, and followed by cameras (``relighting.followed_rays``). Followed are also
    those whose factors miss twice the bound; to others they send light by as few factors as that needs. One warning
    names both.

    Parameters
    ----------
    scene : Scene
    bound : float
        Relative L2 error of reflected radiance, see ``FactorError.lit``.

    Returns
    -------
    ChosenReflection
        Followed surfaces are as diffuse in ``seen``; ``sent`` is None if there are none with factors.
    """
    choice = _Choice(bound)
    every = _with_factors(scene, choice.factors)
    choice.warn()
    if every is None:
        return ChosenReflection(Diffuse(scene.albedo), None)
    shown = np.array([not factors.followed for factors in every.factors])
    if shown.all():
        return ChosenReflection(every, None)
    followed = (every.material >= 0) & ~shown[every.material]
    albedo = np.where(followed[:, None], scene.albedo, every.albedo)
    if not shown.any():
        return ChosenReflection(Diffuse(albedo), every)
    number = np.where(shown, np.cumsum(shown) - 1, -1)
    material = np.where(every.material < 0, -1, number[every.material])
    factors = tuple(factors for factors in every.factors if not factors.followed)
    return ChosenReflection(replace(every, albedo=albedo, material=material, factors=factors), every)


class _Choice:
    """Factors of glossy BSDFs, and what there is to say about them.

    Parameters
    ----------
    bound : float
        See ``chosen_reflection``.
    """

    def __init__(self, bound: float) -> None:
        self._bound = bound
        self._left: dict[str, list[str]] = {}  # names of surfaces, by why no factors stand for them
        self._off: dict[str, list[str]] = {}  # by kind of BSDF and error

    def factors(self, material: Material, names: list[str]) -> BrdfFactors | None:
        """Of a surface that is glossy and can be factored."""
        kind = bsdf_class(material.bsdf)
        if material.rough_glass or not material.glossy and not material.bends_normals:
            return None  # rays go on there
        if material.bends_normals:
            self._left.setdefault(f"{kind} bends the shading normals", []).extend(names)
            return None
        try:
            found, error = factors_for_images(material.bsdf, names[0], self._bound)
        except UnfactorableError as problem:
            self._left.setdefault(problem.reason.removeprefix("BSDF "), []).extend(names)
            return None
        if error > TOO_NARROW:
            self._left.setdefault(f"the lobe of {kind} is too narrow", []).extend(names)
            return None
        if error > FOLLOWED * self._bound:
            found, _ = factors_for_images(material.bsdf, names[0], BETWEEN)
            found = replace(found, followed=True)
        if error > self._bound:
            self._off.setdefault(f"{kind}, {error:.1%}", []).extend(names)
        return found

    def warn(self) -> None:
        """Say once what is not as it should be."""
        said = []
        if self._left:
            said.append(
                f"no factors stand for some glossy surfaces: cameras' rays go on there, to others they are as diffuse, "
                f"which the estimated error does not know: {_by_reason(self._left)}"
            )
        if self._off:
            said.append(
                f"16 factors leave more than {self._bound:.1%} of the light that surfaces reflect, which the estimated "
                f"error does not know; where it is twice as much, cameras' rays go on: {_by_reason(self._off)}"
            )
        if said:
            warnings.warn("; ".join(said), PrtWarning, stacklevel=4)


def _by_reason(surfaces: dict[str, list[str]]) -> str:
    return ", ".join(f"{listed(names)} ({reason})" for reason, names in surfaces.items())


def _with_factors(scene: Scene, find: Find, harmonics: int | None = None) -> InOutFactors | None:
    """R with the factors that are found for each BSDF that is not diffuse; None if there are none."""
    alike: dict[bytes, list[int]] = {}  # meshes of each BSDF
    for k, own in enumerate(scene.materials):
        if not own.diffuse:
            alike.setdefault(own.digest(), []).append(k)
    material, albedo, factors = np.full(scene.n_vertices, -1), scene.albedo.copy(), list[BrdfFactors]()
    beside = cache(lambda: beside_vertices(scene))  # of few scenes, but of all meshes there
    notes = Notes()
    for some in alike.values():
        found = find(scene.materials[some[0]], [scene.meshes[k].name for k in some])
        if found is None:
            continue
        for k in some:
            material[scene.meshes[k].vertices] = len(factors)
            albedo[scene.meshes[k].vertices] = _diffuse_part(scene, k, found, beside, notes)
        factors.append(found)
    for note in notes.warnings():
        warnings.warn(note, stacklevel=5)
    if not factors:
        return None
    return InOutFactors(albedo, vertex_tangents(scene), scene.normals, material, tuple(factors), harmonics)


def _diffuse_part(
    scene: Scene,
    number: int,
    factors: BrdfFactors,
    beside: Callable[[], mi.SurfaceInteraction3f],
    notes: Notes,
) -> NDArray[np.floating]:
    """Its reflectance, (channels,) or (vertices, 3), on one of a scene's meshes."""
    mesh, own = scene.meshes[number], scene.materials[number]
    textured = scene.mitsuba.shapes()[mesh.shape].has_vertex_texcoords()
    if not textured and is_anisotropic(own.bsdf, mesh.name):
        notes.add(mesh.name, _NO_TANGENTS)
    if not factors.varying_diffuse:
        return factors.diffuse
    here = dr.arange(mi.UInt32, mesh.vertices.start, mesh.vertices.stop)
    return diffuse_reflectance(own.bsdf, mesh.name, dr.gather(mi.SurfaceInteraction3f, beside(), here))
