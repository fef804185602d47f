"""View-dependent light transport by in-out factors of BRDFs ([HR10] eq. 2 and 3).

Radiance that leaves vertex x towards w_o is ``rho_x B(x) + sum_k g_k(w_o) B_k(x)``: the diffuse part of its BRDF, and
the coefficients ``B_k = T_k L``. T_k has the visibility of x, traced once for all k, times f_k in the frame of x;
indirect light is gathered by finite elements among white light and coefficients of all vertices.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mi_sparse_prt.core.block_products import multiply_rows
from mi_sparse_prt.core.errors import PrtError, PrtWarning
from mi_sparse_prt.core.profiling import Stopwatch, peak_memory, reset_peak_memory, versions
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.emission.environment import Environment
from mi_sparse_prt.measurement.vertices import vertex_points
from mi_sparse_prt.methods.execution import Evaluation
from mi_sparse_prt.methods.settings import Settings
from mi_sparse_prt.operators.clustered import Clustered
from mi_sparse_prt.operators.factored_visibility import FactoredVisibility
from mi_sparse_prt.operators.low_rank import LowRank
from mi_sparse_prt.operators.visibility import Visibility
from mi_sparse_prt.reflection.brdf_factors import (
    BrdfFactors,
    diffuse_reflectance,
    factors_of,
    harmonic_factors,
    is_anisotropic,
)
from mi_sparse_prt.reflection.factor_tables import incident_tables, outgoing_tables
from mi_sparse_prt.reflection.frames import beside_vertices, frames, vertex_tangents
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.glossy_radiosity import glossy_indirect
from mi_sparse_prt.transport import MeshRange, row_order

TERMS = 4
RAYS = 64
TOLERANCE = 0.06  # of the first bounce, for its low rank

NO_TANGENTS = (
    "shape '{}': its BSDF is anisotropic and it has no texture coordinates: Mitsuba then takes the first edge of each "
    "triangle for its tangent, which vertices cannot follow; give it texture coordinates"
)
EVEN = 1e-6  # relative difference of channels that is none

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Coefficients:
    """What one lighting makes of a glossy scene.

    Attributes
    ----------
    white : (n_v, 3) float32
        Irradiance / pi of each vertex.
    terms : (n_v, K, 3) float32
        B_k; zeros at vertices that are not glossy.
    """

    white: Floats
    terms: Floats


@dataclass(frozen=True)
class GlossyTransport:
    """Light transport of a scene with glossy surfaces, factored.

    Attributes
    ----------
    lighting : CubemapLighting
    albedo : (n_v, 3) float32
        Of the diffuse part.
    areas : (n_v,) float32
        Of the surface around each vertex, world units.
    direct : FactoredVisibility, or Clustered
        White light of all vertices, then the terms of the glossy ones. A compressed transport has direct and indirect
        light together here.
    indirect : LowRank or None
        The same rows.
    tangents, normals : (n_v, 3) float32, world
    material : (n_v,) int64
        Number of a vertex's BRDF among ``factors``, -1 if it is diffuse.
    factors : tuple of BrdfFactors
    meshes : tuple of MeshRange
    vertex_keys : (n_v,) uint64
    scene_hash : str
    report : dict
    """

    lighting: CubemapLighting
    albedo: Floats
    areas: Floats
    direct: FactoredVisibility | Clustered
    indirect: LowRank | None
    tangents: Floats
    normals: Floats
    material: NDArray[np.int64]
    factors: tuple[BrdfFactors, ...]
    meshes: tuple[MeshRange, ...]
    vertex_keys: NDArray[np.uint64]
    scene_hash: str
    report: dict[str, Any] = field(default_factory=dict)

    @property
    def terms(self) -> int:
        """K."""
        return max(factors.terms for factors in self.factors)

    @cached_property
    def glossy(self) -> NDArray[np.int64]:
        """Numbers of the glossy vertices."""
        return np.flatnonzero(self.material >= 0)

    @property
    def nbytes(self) -> int:
        """Bytes of the stored factors."""
        return self.direct.nbytes + (self.indirect.nbytes if self.indirect else 0)

    def white_rows(self, ids: NDArray[np.integer]) -> Floats:
        """Rows (k, n_directions, channels) by their numbers in ``direct``, terms among them."""
        rows = self.direct.rows(ids)
        return rows if self.indirect is None else rows + self.indirect.rows(ids)

    def project_white(self, vectors: Floats, ids: NDArray[np.integer]) -> Floats:
        """Some rows times vectors (n_directions, r): (k, r, channels)."""
        found = multiply_rows(lambda some: self.direct.rows(ids[some]), len(ids), vectors)
        return found if self.indirect is None else found + self.indirect.reordered(ids).project(vectors)

    def for_scene(self, scene: Scene) -> GlossyTransport:
        """The same transport with its rows in the order of a scene's vertices, as ``LightTransport.for_scene``."""
        source = row_order(self.scene_hash, self.vertex_keys, scene)
        if source is None:
            return self
        n = len(self.albedo)
        terms = np.searchsorted(self.glossy, source[self.material[source] >= 0])[:, None] * self.terms
        rows = np.concatenate([source, (n + terms + np.arange(self.terms)).ravel()])
        bits = isinstance(self.direct, FactoredVisibility)
        return replace(
            self,
            albedo=self.albedo[source],
            areas=self.areas[source],
            direct=self.direct.reordered(source if bits else rows),
            indirect=self.indirect and self.indirect.reordered(rows),
            tangents=self.tangents[source],
            normals=self.normals[source],
            material=self.material[source],
            meshes=tuple(MeshRange(mesh.name, mesh.vertices) for mesh in scene.meshes),
            vertex_keys=self.vertex_keys[source],
        )

    def save(self, path: str | Path) -> None:
        """Write the transport to one file (see ``storage.save``)."""
        from mi_sparse_prt.storage import save

        save(self, path)

    def with_bsdf(self, mesh: str, bsdf: mi.BSDF) -> GlossyTransport:
        """The transport with another BSDF on a glossy mesh; nothing is traced.

        Parameters
        ----------
        mesh : str
            Its name.
        bsdf : mi.BSDF

        Returns
        -------
        GlossyTransport
            Of the same vertices; rendered with the same scene. Light that this mesh sends to others remains that of the
            old BSDF, all that leaves it towards a camera is of the new one.

        Raises
        ------
        PrtError
            If the transport was not made with ``harmonics``, whose terms serve any BSDF, if there is no such glossy
            mesh, or if the BSDF cannot be factored or its diffuse part varies over the surface.
        """
        order = self.report["parameters"]["harmonics"]
        if order is None:
            raise PrtError(
                "these terms are of their own BRDFs; precompute them with harmonics=3 to choose later"
            )
        known = {m.name: m.vertices for m in self.meshes if self.material[m.vertices.start] >= 0}
        if mesh not in known:
            raise PrtError(f"{mesh!r} is no glossy mesh of this transport; it has: {', '.join(known)}")
        factors = harmonic_factors(bsdf, mesh, order)
        if factors.varying_diffuse:
            raise PrtError(f"shape '{mesh}': the new BSDF has a texture; give one that is the same all over")
        material, albedo = self.material.copy(), self.albedo.copy()
        material[known[mesh]], albedo[known[mesh]] = len(self.factors), factors.diffuse
        return replace(self, material=material, albedo=albedo, factors=(*self.factors, factors))

    def term_numbers(self, vertices: slice) -> tuple[NDArray[np.int64], Floats]:
        """Rows of the terms of one mesh's vertices (n, K), and the mean squares of g_k over views (K, 3).

        None where the mesh is not glossy. Views weigh by their cosine.
        """
        number = int(self.material[vertices.start])
        if number < 0:
            return np.zeros((vertices.stop - vertices.start, 0), np.int64), np.zeros((0, 3), np.float32)
        first = int(np.searchsorted(self.glossy, vertices.start))
        order = np.arange(first, first + vertices.stop - vertices.start)
        rows = len(self.albedo) + order[:, None] * self.terms + np.arange(self.terms)
        factors = self.factors[number]
        weights = factors.grid.solid_angles * factors.grid.directions[:, 2] / np.pi
        squares = np.square(factors.outgoing.astype(np.float64)) @ weights  # [term, channel]
        result = np.zeros((self.terms, 3), np.float32)
        result[: factors.terms] = squares
        return rows, result

    def coefficients(self, lighting: Environment | ArrayLike) -> Coefficients:
        """White light and terms of all vertices under an environment or L (n_directions, 3)."""
        radiance = self.lighting.project(lighting)
        found = self.direct.relight(radiance)
        if self.indirect is not None:
            found = found + self.indirect.relight(radiance)
        n = len(self.albedo)
        terms = np.zeros((n, self.terms, 3), np.float32)
        terms[self.glossy] = found[n:].reshape(-1, self.terms, 3)
        return Coefficients(found[:n], terms)

    def relight(self, lighting: Environment | ArrayLike, outgoing: ArrayLike) -> Floats:
        """Radiance (n_v, 3) that leaves the vertices in world directions (n_v, 3) or (3,)."""
        found = self.coefficients(lighting)
        towards = np.broadcast_to(np.asarray(outgoing, np.float32), self.normals.shape)
        towards = towards / np.linalg.norm(towards, axis=1, keepdims=True)
        radiance = self.albedo * found.white
        turn = frames(self.tangents, self.normals)
        for number, factors in enumerate(self.factors):
            own = np.flatnonzero(self.material == number)
            local = np.einsum("nij,nj->ni", turn[own], towards[own])
            g = factors.grid.interpolate(factors.outgoing, local)  # [term, channel, vertex]
            lobes = np.broadcast_to(g, (len(g), 3, len(own)))
            radiance[own] += np.einsum("kcn,nkc->nc", lobes, found.terms[own][:, : len(g)])
        above = np.einsum("nd,nd->n", towards, self.normals) > 0
        return np.where(above[:, None], radiance, 0).astype(np.float32)


def precompute_glossy(
    scene: Scene,
    lighting: CubemapLighting,
    terms: int = TERMS,
    harmonics: int | None = None,
    direct: str = "exact",
    max_depth: int = 5,
    rays: int = RAYS,
    tolerance: float = TOLERANCE,
    seed: int = 0,
    progress: bool = True,
) -> GlossyTransport:
    """Compute the view-dependent light transport of a scene with glossy BSDFs.

    Parameters
    ----------
    scene : Scene
        BSDFs are diffuse or can be factored (``reflection.brdf_factors``).
    lighting : CubemapLighting
        The direction basis is used.
    terms : int
        K, of each BRDF.
    harmonics : int, optional
        Spherical harmonics up to this order instead of each BRDF's own incident factors: (order + 1)^2 terms, which
        serve any BRDF (``GlossyTransport.with_bsdf``).
    direct : {"exact", "consensus"}
        How visibility is found, once for all terms.
    max_depth : int
        As Mitsuba's ``path``: 2 = direct light only, -1 = no limit.
    rays : int
        Per vertex, that gather indirect light; a power of two.
    tolerance : float
        Relative L2 error that a low rank may cost the first bounce; at least as much as the rays have noise.
    seed : int
    progress : bool
        Show progress bars.

    Returns
    -------
    GlossyTransport
        With ``report``: ``seconds`` per phase, ``rays``, ``ranks``, ``noise_of_rays`` (relative L2,
        in the first bounce), ``glossy_vertices``, ``peak_memory_bytes``,
        ``seed``, ``scene``, ``parameters``, ``versions``.

    Raises
    ------
    PrtError
        If an argument makes no sense or a BSDF cannot be factored, by name.
    """
    _check(terms, direct)
    settings = Settings(lighting.resolution, "gather", "direction", max_depth, None, None, seed, None, 2)
    reset_peak_memory()
    clock = Stopwatch()
    with clock.phase("setup"):
        points = vertex_points(scene)
        solver = DirectSolver(scene.normalised, lighting, points, "direction", 2, seed)
    with clock.phase("factors"):
        material, factors, albedo = factored_materials(scene, terms, harmonics)
        tangents = vertex_tangents(scene)
    light = Evaluation(scene, solver, settings, max_depth != 2, clock, progress).direct_light(direct)
    assert isinstance(light.direct, Visibility)
    glossy = np.flatnonzero(material >= 0)
    part = FactoredVisibility(
        light.direct.bits,
        scene.normals,
        lighting,
        glossy,
        frames(tangents[glossy], scene.normals[glossy]),
        material[glossy],
        incident_tables(factors),
    )
    indirect, noise = None, None
    if max_depth != 2:
        with clock.phase("indirect"):
            shades, out = _channels(albedo, outgoing_tables(factors))
            indirect, noise = glossy_indirect(
                scene, points, part, out, shades, rays, tolerance, max_depth, seed
            )
    report = {
        "seconds": clock.report(),
        "rays": light.rays | ({} if indirect is None else {"gather": len(points) * rays}),
        "ranks": [] if indirect is None else list(indirect.ranks),
        "noise_of_rays": noise,
        "glossy_vertices": len(glossy),
        "peak_memory_bytes": peak_memory(),
        "seed": seed,
        "scene": scene.summary,
        "parameters": {
            "terms": max(found.terms for found in factors),
            "harmonics": harmonics,
            "direct": direct,
            "max_depth": max_depth,
            "rays": rays,
            "tolerance": tolerance,
        },
        "versions": versions(),
    }
    return GlossyTransport(
        lighting=lighting,
        albedo=albedo,
        areas=scene.vertex_areas,
        direct=part,
        indirect=indirect,
        tangents=tangents,
        normals=scene.normals,
        material=material,
        factors=tuple(factors),
        meshes=tuple(MeshRange(mesh.name, mesh.vertices) for mesh in scene.meshes),
        vertex_keys=points.keys,
        scene_hash=scene.hash,
        report=report,
    )


def _check(terms: int, direct: str) -> None:
    if terms < 1:
        raise PrtError(f"terms must be at least 1, not {terms}")
    if direct not in ("exact", "consensus"):
        raise PrtError(f"direct {direct!r} is neither 'exact' nor 'consensus'")


def factored_materials(
    scene: Scene, terms: int, harmonics: int | None = None
) -> tuple[NDArray[np.int64], list[BrdfFactors], Floats]:
    """What BRDFs vertices have.

    Returns
    -------
    material : (n_v,) int64
        Number of each vertex's BRDF among the glossy ones, -1 if it is diffuse.
    factors : list of BrdfFactors
        Of these.
    albedo : (n_v, 3) float32
        Of the diffuse part of each vertex.
    """
    material, known = np.full(scene.n_vertices, -1), dict[bytes, int]()
    factors: list[BrdfFactors] = []
    albedo, surface = scene.albedo.copy(), beside_vertices(scene)
    for mesh, own, shape in zip(scene.meshes, scene.materials, scene.mitsuba.shapes(), strict=True):
        if own.diffuse:
            continue
        if not shape.has_vertex_texcoords() and is_anisotropic(own.bsdf, mesh.name):
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
            "no surface of the scene is glossy: use precompute, whose matrix is the same for all views"
        )
    return material, factors, albedo


def _channels(albedo: Floats, outgoing: Floats) -> tuple[Floats, Floats]:
    """Albedos (n_v, channels) and g_k (channels, ...), one channel where all are alike."""
    grey = np.ptp(albedo, axis=1).max() <= EVEN and np.ptp(outgoing, axis=4).max() <= EVEN * outgoing.max()
    count = 1 if grey else 3
    return np.ascontiguousarray(albedo[:, :count]), np.ascontiguousarray(np.moveaxis(outgoing, 4, 0)[:count])
