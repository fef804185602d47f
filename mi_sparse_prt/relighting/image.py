"""R and M at the pixels of a camera: vertex irradiance, interpolated, times the albedo at the pixel ([Leh07] 2.4).

Rays go on through mirrors, glass and masks, by Mitsuba's own samples of what these scatter into single directions,
until they meet no more of it. They go on in the same way from glossy surfaces that no in-out factors stand for, by all
that these scatter (``relighting.followed_rays``).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike, NDArray
from tqdm.auto import tqdm

from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.emission.environment import Environment, emitter_of
from mi_sparse_prt.emission.space import SampledEmission
from mi_sparse_prt.measurement.hidden_corners import hidden_corners
from mi_sparse_prt.reflection.factor_tables import look_up, outgoing_tables
from mi_sparse_prt.reflection.in_out_factors import InOutFactors
from mi_sparse_prt.reflection.varying_diffuse import VaryingDiffuse
from mi_sparse_prt.relighting.followed_rays import (
    Seen,
    Way,
    background_light,
    follow,
    past_lamps,
    reflected_background,
    reflected_lamps,
    reflected_light,
    surfaces_to_follow,
)
from mi_sparse_prt.relighting.sharp_light import SharpLight
from mi_sparse_prt.scene.materials import is_one_of
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.solvers.direct_rays import ALL, pass_straight
from mi_sparse_prt.solvers.problem import told_apart
from mi_sparse_prt.transport import LightTransport

SAMPLES_PER_PASS = 16  # so that a progress bar moves
_SEEDS = 9973  # passes of neighbouring seeds stay apart

Corner = tuple[
    Any, Any
]  # of the triangles that rays meet: vertices (UInt32), and their barycentric weights (Float)

# of what leaves a hit: the coefficient of a vertex (irradiance / pi, or a term from 1 on), and how much of it (Color3f)
Share = tuple[int, mi.UInt32, mi.Color3f]


class RelitScene:
    """A scene with the light of one relighting on its vertices, ready to be looked at.

    Parameters
    ----------
    scene : Scene
    irradiance : (k, n_v, 3) float32
        Irradiance / pi at the vertices, of light that met 0, 1, ... surfaces at most: what a camera's ray met before is
        taken from the last, which is all light (``LightTransport.irradiance_by_depth``).
    background : mi.Emitter or None
        What rays see that leave the scene.
    lamps : (SampledEmission, (size, 3) float32), optional
        Light of the scene that is seen itself, and how bright they are.
    max_depth : int
        As Mitsuba's ``path``; what a ray meets on its way, mirrors and glass, counts.
    followed : sequence of mi.BSDF, optional
        Of surfaces that rays go on from by all that these scatter.
    sharp : mi.Emitter, optional
        Light from infinitely far away that surfaces reflect at the pixel, by a shadow ray; not that of ``irradiance``.
    """

    def __init__(
        self,
        scene: Scene,
        irradiance: NDArray[np.float32],
        background: mi.Emitter | None,
        lamps: tuple[SampledEmission, NDArray[np.float32]] | None = None,
        max_depth: int = -1,
        followed: Sequence[mi.BSDF] = (),
        sharp: mi.Emitter | None = None,
    ) -> None:
        self._sharp, self._passes_straight = sharp, scene.passes_straight
        self._scene, self._background, self._lamps = scene.world, background, lamps
        self._brightness = None if lamps is None else mi.Color3f(np.ascontiguousarray(lamps[1].T))
        self.max_depth, self.followed = max_depth, followed
        #: Of surfaces that rays go on from for light of lamps alone.
        self.followed_for_lamps: Sequence[mi.BSDF] = ()
        self.goes_on, self.rough_glass = scene.specular or bool(followed), scene.rough_glass
        self._light = [_of_depths(irradiance)]  # irradiance / pi; coefficients of terms follow
        self._deepest, self._n_vertices = len(irradiance) - 1, scene.n_vertices
        self._albedo = mi.Color3f(np.ascontiguousarray(scene.albedo.T))
        triangles = np.concatenate([mesh.triangles + mesh.vertices.start for mesh in scene.fronts])
        self._backs = mi.Int32(scene.backs.astype(np.int32))
        self._corners = [mi.UInt32(np.ascontiguousarray(triangles[:, k])) for k in range(3)]  # [triangle]
        self._hidden = hidden_corners(scene).in_world(scene)

    def radiance(
        self, ray: mi.Ray3f, sampler: mi.Sampler, active: mi.Mask, hide_background: bool = False
    ) -> tuple[mi.Color3f, mi.Mask]:
        """Radiance towards the origins of rays (world), and which rays meet what is opaque, as for ``path``.

        A background that is seen is opaque. If it is hidden, it is so for rays that came straight from their origins.
        """
        shown = None if hide_background else self._background
        if self.goes_on:
            value, valid = follow(partial(self._seen, shown), ray, sampler, active, self.max_depth)
        else:
            way = Way(mi.UInt32(0), mi.Mask(False), mi.Float(0), mi.Mask(False), mi.Mask(False))
            found = self._met(ray, mi.Point2f(0.5), way, sampler, active, active)
            value, valid = found.radiance, active & found.si.is_valid()
            if shown is not None:
                value = dr.select(active & ~valid, shown.eval(found.si, active), value)
        return value, valid if shown is None else active

    def _seen(
        self, shown: mi.Emitter | None, ray: mi.Ray3f, way: Way, sampler: mi.Sampler, active: mi.Mask
    ) -> Seen:
        """See ``follow``; what is ``shown`` is the background of rays that come straight from a camera."""
        u = mi.Point2f(sampler.next_1d(active), sampler.next_1d(active))
        value, si, whole, partly = self._met(ray, u, way, sampler, active, active & ~way.last)
        if self._background is not None:
            leaves = active & ~si.is_valid() & ~way.told
            leaves &= way.met if shown is None else True
            value += background_light(self._background, ray, way, leaves)
            if self.followed:
                reflects = active & ~way.last & whole & ~way.told
                value += reflected_background(self._background, self._scene, si, sampler, reflects)
        if self._lamps is not None and self.followed:
            reflects = active & ~way.last & whole & si.is_valid()
            value += reflected_lamps(self._lamps[0], self._brightness, self._scene, si, sampler, reflects)
        return Seen(value, si, whole, partly)

    def _met(
        self,
        ray: mi.Ray3f,
        u: mi.Point2f,
        way: Way,
        sampler: mi.Sampler,
        active: mi.Mask,
        reflects: mi.Mask,
    ) -> Seen:
        """What rays meet after some surfaces; their radiance where it is asked for and they are not followed."""
        hit = self._scene.ray_intersect_preliminary(ray, active=active)
        si = self._scene.interaction(hit, ray, active)
        whole, partly = is_one_of(self.followed, si), is_one_of(self.followed_for_lamps, si)
        valid = reflects & si.is_valid() & ~whole & ~(partly & way.told)
        behind = valid & (mi.Frame3f.cos_theta(si.wi) < 0)
        corners, lit = self._hit_corners(hit, si, ray, valid, behind)
        light = (self._deepest - dr.minimum(way.depth, self._deepest)) * self._n_vertices
        value = dr.select(lit, self._shaded(si, corners, self._part(light, partly, way), u, lit), 0)
        if self._sharp is not None:
            value += reflected_light(self._sharp, self._arrives, si, sampler, lit & ~way.told)
        if self._lamps is not None:
            emitters, brightness = self._lamps
            lamp, radiance = emitters.element_of(si, ray, active)
            value += radiance * dr.gather(mi.Color3f, self._brightness, mi.UInt32(lamp), lamp >= 0)
        return Seen(value, si, whole, partly)

    def _part(self, light: mi.UInt32, partly: mi.Mask, way: Way) -> mi.UInt32:
        """Where light of a depth begins, of the part of all light that surfaces show; there is but one."""
        return light

    def _arrives(self, ray: mi.Ray3f, active: mi.Mask) -> mi.Mask:
        """Which rays leave the scene, through nothing but holes: light through panes is no part of direct light."""
        if not self._passes_straight:
            return ~self._scene.ray_test(ray, active)
        longest = self.max_depth - 2
        share, _, boundary = pass_straight(
            self._scene,
            ray,
            active,
            dr.opaque(mi.UInt32, longest if longest >= 0 else 1 << 30),
            lambda si: si.spawn_ray(ray.d),
            lambda passed: dr.sum(passed) / 3,
        )
        return (share >= ALL) & (~boundary if told_apart(self.max_depth) else True)

    def _hit_corners(
        self,
        hit: mi.PreliminaryIntersection3f,
        si: mi.SurfaceInteraction3f,
        ray: mi.Ray3f,
        valid: mi.Mask,
        behind: mi.Mask,
    ) -> tuple[list[Corner], mi.Mask]:
        """The vertices around each hit, on the sheet that it is on and on its side of walls; whether it has any."""
        triangle = self._scene.triangle(hit, valid)
        u, v = hit.prim_uv
        weights = [1 - u - v, u, v]
        if self._hidden.some:
            triangle, weights = self._hidden.corners(triangle, si.p, ray.d, weights, valid)
        vertices = [dr.gather(mi.UInt32, corner, triangle, valid) for corner in self._corners]
        backs = [dr.gather(mi.Int32, self._backs, vertex, behind) for vertex in vertices]
        valid &= ~behind | (backs[0] >= 0)
        vertices = [
            dr.select(behind, mi.UInt32(back), vertex) for back, vertex in zip(backs, vertices, strict=True)
        ]
        return list(zip(vertices, weights, strict=True)), valid

    def footprint(self, ray: mi.Ray3f, u: mi.Point2f) -> tuple[list[Share], mi.Mask, mi.Mask]:
        """What rays see as sums over vertices, whatever the light; which of them see any, and which leave the scene.

        For scenes without surfaces that rays go on from (``goes_on``).
        """
        hit = self._scene.ray_intersect_preliminary(ray)
        si = self._scene.interaction(hit, ray)
        met = si.is_valid()
        corners, lit = self._hit_corners(hit, si, ray, mi.Mask(met), met & (mi.Frame3f.cos_theta(si.wi) < 0))
        return self._shares(si, corners, u, lit), lit, ~met

    def _shaded(
        self,
        si: mi.SurfaceInteraction3f,
        corners: list[Corner],
        light: mi.UInt32,
        u: mi.Point2f,
        valid: mi.Mask,
    ) -> mi.Color3f:
        """Radiance that leaves surfaces, but for what they scatter into single directions.

        ``light`` is where light of as many surfaces as it may have met begins among that of all.
        """
        return self._summed(self._shares(si, corners, u, valid), light, valid)

    def _summed(self, shares: list[Share], light: mi.UInt32, valid: mi.Mask) -> mi.Color3f:
        """Radiance of shares of coefficients."""
        return sum(
            (
                weight * dr.gather(mi.Color3f, self._light[term], light + vertex, valid)
                for term, vertex, weight in shares
            ),
            mi.Color3f(0),
        )

    def _shares(
        self, si: mi.SurfaceInteraction3f, corners: list[Corner], u: mi.Point2f, valid: mi.Mask
    ) -> list[Share]:
        """What leaves surfaces as a sum over the vertices around each hit."""
        reflected = self._reflectance(si, corners, u, valid)
        return [(0, vertex, weight * reflected) for vertex, weight in corners]

    def _reflectance(
        self, si: mi.SurfaceInteraction3f, corners: list[Corner], u: mi.Point2f, valid: mi.Mask
    ) -> mi.Color3f:
        """Radiance that leaves surfaces for irradiance / pi of 1."""
        albedo = interpolated(self._albedo, corners, valid)
        bsdf = si.bsdf()
        flags = bsdf.flags()
        diffuse = ~mi.has_flag(flags, mi.BSDFFlags.Glossy) & ~mi.has_flag(flags, mi.BSDFFlags.Delta)
        reflected = dr.select(diffuse, bsdf.eval_diffuse_reflectance(si, valid), albedo)
        if self.goes_on:
            # a share of it is diffuse: what a random direction finds is that share, on average over all directions
            shared = mi.has_flag(flags, mi.BSDFFlags.Delta) & ~mi.has_flag(flags, mi.BSDFFlags.Glossy)
            out = mi.warp.square_to_cosine_hemisphere(u)
            out.z = dr.mulsign(out.z, mi.Frame3f.cos_theta(si.wi))
            value = bsdf.eval(mi.BSDFContext(), si, out, valid & shared)
            reflected = dr.select(shared, value * dr.pi / dr.maximum(dr.abs(out.z), 1e-6), reflected)
        return reflected


def interpolated(values: mi.Color3f, corners: list[Corner], valid: mi.Mask) -> mi.Color3f:
    """Values of vertices at points of triangles."""
    return sum((w * dr.gather(mi.Color3f, values, i, valid) for i, w in corners), mi.Color3f(0))


def _every_depth(values: NDArray[np.float32], depths: int) -> NDArray[np.float32]:
    """Light (k, ...) of so many depths, all of it at each if it is not told apart."""
    return np.broadcast_to(values, (depths, *values.shape[1:]))


def _of_depths(values: NDArray[np.float32]) -> mi.Color3f:
    """Colours (k, n_v, 3) of vertices on the device, those of each depth after the other."""
    return mi.Color3f(np.ascontiguousarray(values.reshape(-1, 3).T))


class GlossyRelitScene(RelitScene):
    """A scene with glossy surfaces, relit: coefficients of vertices are interpolated, BRDFs looked up at each hit.

    Each corner of a triangle has its own tangent, turned into the plane of the hit's normal: coefficients are never
    mixed across seams.

    Parameters
    ----------
    scene : Scene
    transport : LightTransport
        With terms.
    environment : Environment or (n_directions, 3) float
    background : mi.Emitter or None
    sharp : SharpLight, optional
        Part of the environment that is found at the pixel.
    lamps : (k, n_v, 3) float32, optional
        Irradiance / pi of other light, as of ``RelitScene``; rays go on from all glossy surfaces to find it.

    Raises
    ------
    PrtError
        If the matrix belongs to another scene.
    """

    def __init__(
        self,
        scene: Scene,
        transport: LightTransport,
        environment: Any,
        background: mi.Emitter | None,
        sharp: SharpLight | None = None,
        lamps: NDArray[np.float32] | None = None,
    ) -> None:
        transport = transport.for_scene(scene)
        found, surfaces = transport.coefficients_by_depth(environment), transport.reflection
        emitter = None
        if sharp is not None:
            found, emitter = sharp.taken_from_terms(found, transport), sharp.emitter
        assert isinstance(surfaces, InOutFactors)
        followed = surfaces_to_follow(scene, surfaces)
        depths = len(found) if lamps is None else max(len(found), len(lamps))
        sky = _every_depth(np.stack([some.unit_albedo for some in found]), depths)
        super().__init__(scene, sky, background, None, transport.max_depth, followed, emitter)
        if lamps is not None:
            every = surfaces_to_follow(scene)
            self.followed_for_lamps = [bsdf for bsdf in every if not any(bsdf is other for other in followed)]
            self.goes_on |= bool(every)
            others = _every_depth(lamps, depths)
            self._light = [_of_depths(np.concatenate([sky, sky + others, others]))]
        self._diffuse = mi.Color3f(np.ascontiguousarray(surfaces.albedo.T))
        self._light += [
            _of_depths(_every_depth(np.stack([some.terms[:, k] for some in found]), depths))
            for k in range(transport.terms)
        ]
        self._lit_by_lamps = lamps is not None
        self._tangents = mi.Vector3f(np.ascontiguousarray(surfaces.tangents.T))
        self._material = mi.UInt32(np.maximum(surfaces.material, 0).astype(np.uint32))
        self._glossy = mi.Bool(surfaces.material >= 0)
        tables = outgoing_tables(surfaces.factors)
        self._size = tables.shape[1]
        first = {
            number: own.bsdf for number, own in zip(_numbers(scene, surfaces), scene.materials, strict=True)
        }
        self._textures = {
            number: VaryingDiffuse(first[number])
            for number, factors in enumerate(surfaces.factors)
            if factors.varying_diffuse
        }
        self._tables = [mi.Float(np.ascontiguousarray(tables[..., c]).ravel()) for c in range(3)]

    def _part(self, light: mi.UInt32, partly: mi.Mask, way: Way) -> mi.UInt32:
        """Of the sky where rays go on for lamps; of all else where none did before, and of lamps after that."""
        if not self._lit_by_lamps:
            return light
        size = (self._deepest + 1) * self._n_vertices
        return light + dr.select(partly, 0, dr.select(way.told, 2 * size, size))

    def _reflectance(
        self, si: mi.SurfaceInteraction3f, corners: list[Corner], u: mi.Point2f, valid: mi.Mask
    ) -> mi.Color3f:
        glossy, material = self._glossy_at(corners, valid)
        diffuse = interpolated(self._diffuse, corners, glossy)
        for number, texture in self._textures.items():
            textured = glossy & (material == number)
            diffuse = dr.select(textured, mi.Color3f(texture.eval(si, textured)), diffuse)
        return dr.select(glossy, diffuse, super()._reflectance(si, corners, u, valid))

    def _shares(
        self, si: mi.SurfaceInteraction3f, corners: list[Corner], u: mi.Point2f, valid: mi.Mask
    ) -> list[Share]:
        glossy, material = self._glossy_at(corners, valid)
        return super()._shares(si, corners, u, valid) + self._lobes(si, corners, glossy, material)

    def _shaded(
        self,
        si: mi.SurfaceInteraction3f,
        corners: list[Corner],
        light: mi.UInt32,
        u: mi.Point2f,
        valid: mi.Mask,
    ) -> mi.Color3f:
        glossy, material = self._glossy_at(corners, valid)
        # a branch: dozens of look-ups, which most hits are spared
        lobes = dr.if_stmt(
            (si, corners, light, glossy, material),
            glossy,
            lambda si, corners, light, glossy, material: self._summed(
                self._lobes(si, corners, glossy, material), light, glossy
            ),
            lambda *_: mi.Color3f(0),
            label="lobes",
        )
        return self._summed(super()._shares(si, corners, u, valid), light, valid) + lobes

    def _lobes(
        self, si: mi.SurfaceInteraction3f, corners: list[Corner], glossy: mi.Mask, material: mi.UInt32
    ) -> list[Share]:
        """What terms of BRDFs send on."""
        shares: list[Share] = []
        towards = si.to_world(si.wi)
        normal = dr.select(mi.Frame3f.cos_theta(si.wi) < 0, -si.sh_frame.n, si.sh_frame.n)
        terms = len(self._light) - 1
        for vertex, weight in corners:
            tangent = dr.gather(mi.Vector3f, self._tangents, vertex, glossy)
            s = dr.normalize(tangent - normal * dr.dot(normal, tangent))
            local = mi.Frame3f(s, dr.cross(normal, s), normal).to_local(towards)
            lobes = [look_up(t, self._size, terms, material, local, glossy) for t in self._tables]
            for k in range(terms):
                value = weight * mi.Color3f(*(lobe[k] for lobe in lobes))
                shares.append((1 + k, vertex, dr.select(glossy, value, 0)))
        return shares

    def _glossy_at(self, corners: list[Corner], valid: mi.Mask) -> tuple[mi.Mask, mi.UInt32]:
        """Which hits are on glossy surfaces, and of which material."""
        glossy = valid & dr.gather(mi.Bool, self._glossy, corners[0][0], valid)
        return glossy, dr.gather(mi.UInt32, self._material, corners[0][0], glossy)


def _numbers(scene: Scene, surfaces: InOutFactors) -> list[int]:
    """Of each mesh's BRDF, -1 if it is diffuse."""
    return [int(surfaces.material[mesh.vertices.start]) for mesh in scene.meshes]


class RelitIntegrator(mi.SamplingIntegrator):
    """A Mitsuba integrator that looks at a ``RelitScene``; sampling, filtering and films are Mitsuba's own.

    Parameters
    ----------
    relit : RelitScene
    hide_emitters : bool
        As for ``path``: a camera sees through area lamps, and no background.
    """

    def __init__(self, relit: RelitScene, hide_emitters: bool = False) -> None:
        super().__init__(mi.Properties())
        self._relit, self._hide_emitters = relit, hide_emitters

    def sample(
        self,
        scene: mi.Scene,
        sampler: mi.Sampler,
        ray: mi.RayDifferential3f,
        medium: mi.Medium | None = None,
        active: mi.Mask = True,
    ) -> tuple[mi.Color3f, mi.Mask, list[mi.Float]]:
        ray, active = mi.Ray3f(ray), mi.Mask(active)
        if self._hide_emitters:
            ray = past_lamps(scene, ray, active)
            dr.eval(ray)  # on a GPU a kernel traces rays in one scene only
        value, valid = self._radiance(ray, sampler, active)
        return value, valid, []

    def _radiance(self, ray: mi.Ray3f, sampler: mi.Sampler, active: mi.Mask) -> tuple[mi.Color3f, mi.Mask]:
        """What rays see that begin behind all that is hidden, see ``RelitScene.radiance``."""
        return self._relit.radiance(ray, sampler, active, self._hide_emitters)


def render(
    scene: Scene,
    transport: LightTransport,
    environment: Environment | mi.Emitter | ArrayLike,
    sensor: int | mi.Sensor = 0,
    spp: int = 64,
    seed: int = 0,
    progress: bool = False,
) -> NDArray[np.float32]:
    """Render a camera's view of the relit scene.

    Parameters
    ----------
    scene : Scene
        The scene of the matrix.
    transport : LightTransport
    environment : Environment, emitter or (n_directions, 3) float
        The light; also the background. Of a matrix of lamps, how bright these are (``SceneEmitters.project``).
    sensor : int or mi.Sensor
        One of ``scene.mitsuba.sensors()``, or any other.
    spp : int
        Samples per pixel (for edges and textures: the light itself has no noise).
    seed : int
    progress : bool
        Show a progress bar.

    Returns
    -------
    (height, width, 3) float32, linear RGB
        Of the film's crop window, whatever its pixel format.

    Raises
    ------
    PrtError
        If the scene has no such sensor, or the matrix belongs to another scene.
    """
    sensor = scene.sensor(sensor)
    transport = transport.for_scene(scene)
    check_camera(transport, sensor)
    image = _rendered(scene, sensor, relit_scene(scene, transport, environment), spp, seed, progress)
    if transport.measurement.image is None:
        return image
    return image + transport.relight(environment).reshape(image.shape)


def check_camera(transport: LightTransport, sensor: mi.Sensor) -> None:
    """Refuse a camera whose image has another size than that of a matrix of pixels (PrtError)."""
    pixels = transport.measurement.image
    if pixels is not None and pixels != tuple(int(n) for n in sensor.film().crop_size())[::-1]:
        raise PrtError(
            f"this matrix has the pixels of another camera: {pixels[1]} x {pixels[0]}; give that one"
        )


def relit_scene(scene: Scene, transport: LightTransport, environment: Any) -> RelitScene:
    """What a camera sees: of a matrix of pixels nothing but the lights themselves, of others the surfaces, too."""
    if transport.emission.kind != CubemapLighting.kind:
        background, lamps = None, (transport.lighting, transport.emission.project(environment))
    else:
        background, lamps = background_emitter(environment, transport.lighting), None
    if transport.terms:
        return GlossyRelitScene(scene, transport, environment, background)
    dark = transport.measurement.kind != "vertices"
    if dark:
        irradiance = np.zeros((1, scene.n_vertices, 3), np.float32)
    else:
        irradiance = transport.irradiance_by_depth(environment)
    followed = () if dark else surfaces_to_follow(scene, transport.reflection)
    return RelitScene(scene, irradiance, background, lamps, transport.max_depth, followed)


def _rendered(
    scene: Scene, sensor: mi.Sensor, relit: RelitScene, spp: int, seed: int, progress: bool
) -> NDArray[np.float32]:
    """The image, by some samples per pixel at a time."""
    integrator = RelitIntegrator(relit)
    passes = []
    with tqdm(total=spp, desc="render", unit=" spp", disable=not progress) as bar:
        for first in range(0, spp, SAMPLES_PER_PASS):
            samples = min(SAMPLES_PER_PASS, spp - first)
            rendered = mi.render(
                scene.mitsuba, sensor=sensor, integrator=integrator, spp=samples, seed=seed + _SEEDS * first
            )
            passes.append(_linear_rgb(np.array(rendered), sensor.film()) * np.float32(samples / spp))
            bar.update(samples)
    return np.sum(passes, axis=0, dtype=np.float32)


def _linear_rgb(image: NDArray[np.float32], film: mi.Film) -> NDArray[np.float32]:
    """What a film has developed (h, w, channels), in three channels."""
    kind = re.search(r"pixel_format = (y|xyz)a?,", str(film))
    if kind is None:
        return image[..., :3]
    kept = mi.Bitmap(
        np.ascontiguousarray(image[..., : len(kind[1])]), getattr(mi.Bitmap.PixelFormat, kind[1].upper())
    )
    return np.array(kept.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, False))


def background_emitter(
    environment: Environment | mi.Emitter | ArrayLike, lighting: CubemapLighting
) -> mi.Emitter:
    """An environment as a Mitsuba emitter: an image as ``envmap``, texel values as ``cubemap``."""
    if isinstance(environment, mi.Emitter):
        return environment
    if isinstance(environment, Environment):
        return emitter_of(environment)
    texels, n = lighting.project(environment), lighting.resolution
    return mi.load_dict({"type": "cubemap", "data": mi.TensorXf(texels.reshape(6, n, n, 3)), "resolution": n})
