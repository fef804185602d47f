"""The whole pipeline as a Mitsuba integrator."""

from __future__ import annotations

import time
import warnings
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_sparse_prt.cache import cached_precompute
from mi_sparse_prt.core.errors import LampWarning, NotDiffuseWarning, PrtError, PrtWarning
from mi_sparse_prt.emission.cubemap import CubemapLighting
from mi_sparse_prt.emission.unit_lamps import UnitLamps
from mi_sparse_prt.methods.settings import AUTO_TERMS, TARGET, Settings
from mi_sparse_prt.relighting.followed_rays import surfaces_to_follow
from mi_sparse_prt.relighting.image import GlossyRelitScene, RelitIntegrator, RelitScene
from mi_sparse_prt.relighting.lamps_at_pixels import LampLitIntegrator
from mi_sparse_prt.relighting.picture_error import picture_error
from mi_sparse_prt.relighting.sharp_light import sharp_light
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.transport import LightTransport

COMPARED = 0.1  # of the time that a picture's matrices take, to find out whether it is right
_UNSEEN = "DirectionalArea"  # no path from a camera finds its light, those of ``path`` neither


class SparsePRT(mi.SamplingIntegrator):
    r"""Precomputed light transport integrator (:monosp:`sparse_prt`)
    --------------------------------------------------------------

    A scene lit by its environment and its lamps through precomputed light transport matrices.

    On the first render of a scene its matrices are computed and kept in a cache; later renders, under whatever
    environment (``envmap``, ``constant``, ``sunsky``, ``cubemap``), with lamps however bright and from whatever camera,
    only apply them. The camera sees the irradiance of the vertices, interpolated over triangles, times the albedo
    texture at the pixel.

    A sun, or another small bright part of the environment that brings a tenth of its light or more, casts its shadows
    at the pixel, by one shadow ray of each sample. All else of the environment comes from the matrix, without noise.

    Lamps are all other emitters (``area``, ``point``, ``spot``, ``directional``, ``projector``). They have a matrix of
    their own, a column each, for light that is reflected more than once. What they send to the camera themselves, or
    after one reflection, is found at the pixel as ``path`` finds it, by shadow rays: shadows of small lamps are
    sharp, and any BSDF is exact there. That light has noise, which more samples per pixel reduce. Light that lamps send
    on more than once leaves surfaces as if these were diffuse, also with ``terms``; what of it reaches surfaces by way
    of mirrors and glass is left out.

    ``mi.traverse`` and ``update`` on the environment, or on how bright a lamp is (``radiance.value``,
    ``intensity.value``, ``irradiance.value``, ``scale``), relight; no matrix is computed again. A lamp that moved,
    turned or has another texture needs the matrix of lamps again; other geometry or materials need both.

    The error of a matrix is that of all light that may come. Where what the camera sees may be farther off than was
    asked for, the first picture is compared with a few samples of ``path``, and a warning tells by how much it is off
    in the light that there is.

    Films, crop windows, samplers, the alpha channel and ``hide_emitters`` are those of ``path``. An ``aov`` integrator
    may be put around this one; it then relights twice.

    .. tabs::
        .. code-tab:: xml

            <integrator type="sparse_prt">
                <integer name="resolution" value="32"/>
                <integer name="max_depth" value="5"/>
                <float name="target_error" value="0.02"/>
                <boolean name="reference" value="false"/>
                <integrator type="path"><integer name="max_depth" value="5"/></integrator>
            </integrator>

        .. code-tab:: python

            'type': 'sparse_prt',
            'resolution': 32,
            'max_depth': 5,
            'reference_integrator': {'type': 'path'}

    =================== ========== =============================================================================
    Parameter           Type       Meaning
    =================== ========== =============================================================================
    resolution          integer    Texels along an edge of the lighting's cubemap, a power of two. (32)
    method              string     As for ``prt.precompute``; for lamps all but ``brute_force`` mean ``auto``. (auto)
    basis               string     ``direction`` or ``texel``: light from a texel's centre or all of it. (texel)
    max_depth           integer    As for ``path``; 2 is direct light only. (5)
    precompute_spp      integer    Paths per indirect element, where there are any. (``auto`` chooses, or 16; of lamps
                                   64, or fewer for ``target_error``, or if there are many lamps and vertices)
    indirect_resolution integer    Texels along an edge of the cubemap of path-traced indirect light. (``auto``
                                   chooses; of ``brute_force`` 8, or ``resolution``)
    target_error        float      Relative L2 error of the environment's matrix to aim at, and of the noise that may
                                   be left in the indirect light of lamps. (0: that of ``prt.precompute``)
    specular_error      float      Noise of light by way of mirrors and glass that is small enough, of that light alone.
                                   (0: it is part of ``target_error``)
    max_seconds         float      ``auto`` begins nothing that is predicted to take longer. (300)
    strata              integer    Shadow rays per axis of a texel, for ``texel``. (2)
    terms               string or  In-out factors of each BSDF that is not diffuse, which is then shaded for the view,
                        integer    per pixel: ``auto`` (as many as the target error asks for, 16 at most), or a number;
                                   with 0, all count as diffuse. Rays go on from what has no factors. (auto)
    edge_length         float      Longest edge of a triangle, world units. (the scene's diagonal / 64,
                                   and less near small things)
    seed                integer    Of the precomputation. (0)
    cache               string     Folder of the cache. (``mi_sparse_prt`` in the user's cache folder)
    hide_emitters       boolean    As for ``path``: cameras see through area lamps, and no environment. (false)
    progress            boolean    Show a forecast and progress bars while precomputing. (true)
    reference           boolean    Render with the nested integrator instead. (false)
    (nested)            integrator The reference. (``path`` of the same ``max_depth`` and ``hide_emitters``)
    =================== ========== =============================================================================
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self._lighting = CubemapLighting(props.get("resolution", 32))
        method = props.get("method", "auto")
        coarse = min(8, self._lighting.resolution) if method == "brute_force" else 0
        self._settings = {
            "method": method,
            "basis": props.get("basis", "texel"),
            "max_depth": props.get("max_depth", 5),
            "spp": props.get("precompute_spp") if "precompute_spp" in props else None,
            "indirect_resolution": props.get("indirect_resolution", coarse) or None,
            "target_error": props.get("target_error", 0.0) or None,
            "specular_error": props.get("specular_error", 0.0) or None,
            "max_seconds": props.get("max_seconds", 300.0),
            "strata": props.get("strata", 2),
            "seed": props.get("seed", 0),
            "terms": props.get("terms", AUTO_TERMS),
        }
        Settings(self._lighting.resolution, **self._settings)  # complains now, not when rendering
        self._edge_length = props.get("edge_length", 0.0) or None
        cache = props.get("cache", "")
        self._cache = Path(cache) if cache else None
        self._progress = props.get("progress", True)
        self._use_reference = props.get("reference", False)
        self._doubtful: mi.Scene | None = None  # one to compare with path in, where that is needed
        self._compared = False
        self._hide_emitters = props.get("hide_emitters", False)
        nested = [value for _, value in props.objects() if isinstance(value, mi.Integrator)]
        usual = {"max_depth": self._settings["max_depth"], "hide_emitters": self._hide_emitters}
        self._path = mi.load_dict({"type": "path", **usual})
        self._reference = nested[0] if nested else self._path

    def render(
        self,
        scene: mi.Scene,
        sensor: int | mi.Sensor = 0,
        seed: int = 0,
        spp: int = 0,
        develop: bool = True,
        evaluate: bool = True,
    ) -> mi.TensorXf:
        """Render a camera (world units, linear RGB); the arguments are those of every Mitsuba integrator.

        Raises
        ------
        PrtError
            If the scene has no light, or cannot be used (see ``prt.load_scene``, ``prt.precompute``).
        """
        begin = time.perf_counter()
        integrator = self._looking_at(scene)
        if self._doubtful is not None and not self._compared:
            self._compared = True
            camera = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
            limit = COMPARED * (time.perf_counter() - begin)
            error = picture_error(integrator, self._path, self._doubtful, camera, self._target, limit)
            _warn_if_off(error, self._target)
        return integrator.render(scene, sensor, seed, spp, develop, evaluate)

    def sample(
        self,
        scene: mi.Scene,
        sampler: mi.Sampler,
        ray: mi.RayDifferential3f,
        medium: mi.Medium | None = None,
        active: mi.Mask = True,
    ) -> tuple[mi.Color3f, mi.Mask, list[mi.Float]]:
        """What integrators around this one ask for, ``aov`` and ``moment``; see ``render``."""
        radiance, valid, others = self._looking_at(scene).sample(scene, sampler, ray, medium, active)
        dr.eval(radiance, valid)  # on a GPU a kernel traces rays in one scene only, and theirs is another one
        return radiance, valid, others

    def _looking_at(self, scene: mi.Scene) -> mi.SamplingIntegrator:
        """The integrator that looks at the relit surfaces of a scene, or the reference."""
        if self._use_reference:
            return self._reference
        lamps = _has_lamps(scene)
        if scene.environment() is None and not lamps:
            raise PrtError(
                "sparse_prt: the scene has no light; add an emitter: envmap, constant, area, point ..."
            )
        surfaces = _read(scene, self._edge_length, self._settings["terms"] == AUTO_TERMS)
        relit, doubtful = self._relit(surfaces, scene.environment(), lamps)
        # shapes as they are, but for copies: rays that meet instances take long
        copies = any(shape.class_name() == "Instance" for shape in scene.shapes())
        lit = surfaces.mitsuba if copies else scene
        self._doubtful = lit if doubtful else None
        if lamps:
            depth = self._settings["max_depth"]
            return LampLitIntegrator(relit, lit, depth, self._hide_emitters, copies)
        return RelitIntegrator(relit, self._hide_emitters)

    @property
    def _target(self) -> float:
        return self._settings["target_error"] or TARGET

    def _relit(self, surfaces: Scene, environment: mi.Emitter | None, lamps: bool) -> tuple[RelitScene, bool]:
        """All light but that which lamps send to the camera directly or after one reflection.

        Second, whether the environment's may be farther off, in what cameras see, than was asked for.
        """
        irradiance = np.zeros((1, surfaces.n_vertices, 3), np.float32)
        depth = self._settings["max_depth"]
        if lamps and depth != 2:
            irradiance = self._light_of_lamps(surfaces)
        followed = surfaces_to_follow(surfaces) if self._settings["terms"] else []
        if environment is None:
            return RelitScene(surfaces, irradiance, None, None, depth, followed), False
        transport = cached_precompute(surfaces, self._lighting, self._cache, self._progress, **self._settings)
        sharp = sharp_light(environment)
        doubtful = _is_doubtful(transport, self._target)
        if not transport.terms:
            found = transport.irradiance_by_depth(environment)
            found = found if sharp is None else sharp.taken_from(found, transport)
            emitter = None if sharp is None else sharp.emitter
            relit = RelitScene(surfaces, irradiance + found, environment, None, depth, followed, emitter)
            return relit, doubtful
        others = irradiance if lamps else None
        return GlossyRelitScene(surfaces, transport, environment, environment, sharp, others), doubtful

    def _light_of_lamps(self, surfaces: Scene) -> NDArray[np.float32]:
        """Irradiance / pi (k, n_v, 3) of light of lamps that met some, and at most 0, 1, ... surfaces; k may be 1."""
        lamps, by_paths = UnitLamps(surfaces), self._settings["method"] == "brute_force"
        settings = {name: self._settings[name] for name in ("max_depth", "spp", "seed", "target_error")}
        settings["method"] = "brute_force" if by_paths else "auto"
        transport = cached_precompute(surfaces, lamps, self._cache, self._progress, **settings)
        found = transport.irradiance_by_depth(lamps.brightness)
        apart = bool(transport.operators["indirect"].by_depth)
        return np.concatenate([np.zeros_like(found[:1]), found]) if apart else found

    def to_string(self) -> str:
        return f"SparsePRT[lighting = {self._lighting!r}, settings = {self._settings}]"


def _read(scene: mi.Scene, edge_length: float | None, shaded: bool) -> Scene:
    """The surfaces of a scene.

    That matrices of a cubemap have no light of lamps is not for users of this plugin; nor is which surfaces are not
    diffuse, if ``shaded``: what is left as diffuse is said later.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LampWarning)
        if shaded:
            warnings.simplefilter("ignore", NotDiffuseWarning)
        return Scene.from_mitsuba(scene, edge_length)


def _is_doubtful(transport: LightTransport, target: float) -> bool:
    """Whether what cameras see is certainly farther off than a target, each element by itself."""
    error = transport.report.get("estimated_error", {})
    return "seen" in error and error["seen"] - 2 * error["standard_error"]["seen"] > target


def _warn_if_off(error: float, target: float) -> None:
    """Say so if a picture is certainly farther off than a target."""
    if error > target:
        warnings.warn(
            f"in this light the picture is {error:.1%} off or more, as a few samples of path tell: a smaller "
            "target_error or edge_length, or a larger resolution, helps",
            PrtWarning,
            stacklevel=4,
        )


def _has_lamps(scene: mi.Scene) -> bool:
    """Whether emitters other than the environment shine; those of unknown kinds on shapes are refused (PrtError)."""
    for shape in scene.shapes():
        if shape.is_emitter() and (kind := shape.emitter().class_name()) not in ("AreaLight", _UNSEEN):
            raise PrtError(
                f"sparse_prt: shape '{shape.id()}' has an emitter of type {kind}; give it one of type area"
            )
    return any(not e.is_environment() and e.class_name() != _UNSEEN for e in scene.emitters())
