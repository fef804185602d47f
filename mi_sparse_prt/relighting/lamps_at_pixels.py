"""Light of lamps that vertices cannot show, found at the pixel: lamps that are seen, and the shadows that they cast."""

from __future__ import annotations

from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi

from mi_sparse_prt.relighting.followed_rays import Seen, Way, follow
from mi_sparse_prt.relighting.image import RelitIntegrator, RelitScene
from mi_sparse_prt.scene.materials import is_one_of, sample_weight
from mi_sparse_prt.scene.mitsuba_meshes import scene_of
from mi_sparse_prt.scene.traced_scene import TracedScene
from mi_sparse_prt.solvers.paths import has_mirrors


class _Onwards(NamedTuple):
    """Rays that surfaces send on, but into single directions, which are followed anyway.

    Attributes
    ----------
    ray : Ray3f
    met : SurfaceInteraction3f
        By these rays.
    weight : Color3f
        Of what they find; 0 where there are none.
    """

    ray: Any
    met: Any
    weight: Any


class LampLitIntegrator(RelitIntegrator):
    """Looks at relit surfaces, and adds what lamps send to the camera themselves or after one reflection.

    The latter is what Mitsuba's ``path`` of ``max_depth`` 2 finds among the lamps alone: shadow rays and rays of the
    BSDF at every sample of a pixel, on the shapes as the scene has them. Mirrors, glass and masks on the way to a
    surface are no reflections in this sense, nor are those on the way to an area lamp, which rays of the BSDF meet or
    not.

    Parameters
    ----------
    relit : RelitScene
        All other light.
    scene : mi.Scene
        The shapes and the lamps, and maybe an environment, which is left out.
    max_depth : int
        As for ``path``, at least 2 or -1.
    hide_emitters : bool
        See ``RelitIntegrator``.
    triangles : bool
        The scene is one that ``TracedScene`` can look at: kernels are then traced fast, whatever else is in memory.
    """

    def __init__(
        self,
        relit: RelitScene,
        scene: mi.Scene,
        max_depth: int,
        hide_emitters: bool = False,
        triangles: bool = False,
    ) -> None:
        super().__init__(relit, hide_emitters)
        self._scene = scene if scene.environment() is None else without_environment(scene)
        self._traced = TracedScene(self._scene) if triangles else self._scene
        self._followed, self._max_depth = [*relit.followed, *relit.followed_for_lamps], max_depth
        self._goes_on = has_mirrors(scene) or bool(self._followed)
        self._rough_glass = relit.rough_glass
        met = has_mirrors(scene) and any(shape.is_emitter() for shape in scene.shapes())
        self._caustics = met or bool(self._rough_glass)
        delta = mi.EmitterFlags.Delta
        self._unmet = any(mi.has_flag(emitter.flags(), delta) for emitter in scene.emitters())

    def _radiance(self, ray: mi.Ray3f, sampler: mi.Sampler, active: mi.Mask) -> tuple[mi.Color3f, mi.Mask]:
        value, valid = super()._radiance(ray, sampler, active)
        sampler.schedule_state()
        dr.eval(value, valid, ray)  # the next scene is another one, and a kernel on a GPU traces in one only
        if self._goes_on:
            direct, _ = follow(self._seen, ray, sampler, active, self._max_depth)
        else:
            direct, _ = self._direct(self._traced.ray_intersect(ray, active), sampler, active, active)
        return value + direct, valid

    def _direct(
        self, si: mi.SurfaceInteraction3f, sampler: mi.Sampler, seen: mi.Mask, reflects: mi.Mask
    ) -> tuple[mi.Color3f, _Onwards]:
        """Lamps that are ``seen``, and what surfaces reflect of them: both kinds of rays, weighted as in ``path``.

        Second, where rays of the BSDF lead.
        """
        value = dr.select(seen, si.emitter(self._scene, seen).eval(si, seen), 0)
        bsdf, reflects = si.bsdf(), reflects & si.is_valid()
        asked = reflects & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        there, light = self._scene.sample_emitter_direction(si, sampler.next_2d(asked), False, asked)
        asked &= there.pdf > 0
        asked &= ~self._scene.ray_test(si.spawn_ray_to(there.p), asked)
        u, v = sampler.next_1d(reflects), mi.Point2f(sampler.next_2d(reflects))
        reflected, density, sample, weight = bsdf.eval_pdf_sample(
            mi.BSDFContext(), si, si.to_local(there.d), u, v, reflects
        )
        share = dr.select(there.delta, 1, there.pdf / (there.pdf + density))
        value += dr.select(asked, reflected * light * share, 0)

        weight = sample_weight(sample, weight)
        reflects &= ~dr.all(weight == 0)
        ray = si.spawn_ray(si.to_world(sample.wo))
        met = self._traced.ray_intersect(ray, reflects)
        radiance = met.emitter(self._scene, reflects).eval(met, reflects)
        single = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
        towards = mi.DirectionSample3f(self._scene, met, si)
        other = self._scene.pdf_emitter_direction(si, towards, reflects & ~single & met.is_valid())
        share = dr.select(single, 1, sample.pdf / (sample.pdf + other))
        lit = reflects & ~dr.all(radiance == 0)
        value += dr.select(lit, weight * radiance * share, 0)
        return value, _Onwards(ray, met, dr.select(reflects & ~single, weight, 0))

    def _seen(self, ray: mi.Ray3f, way: Way, sampler: mi.Sampler, active: mi.Mask) -> Seen:
        """See ``follow``; a lamp seen in a mirror is among the mirror's direct light."""
        si, reflects = self._traced.ray_intersect(ray, active), active & ~way.last
        direct, onwards = self._direct(si, sampler, reflects & (way.depth == 0), reflects)
        whole = is_one_of(self._followed, si)
        if self._caustics:
            direct += self._by_mirrors(onwards, way.depth + 1, sampler, reflects & si.is_valid() & ~whole)
        return Seen(direct, si, whole)

    def _by_mirrors(
        self, onwards: _Onwards, depth: mi.UInt32, sampler: mi.Sampler, active: mi.Mask
    ) -> mi.Color3f:
        """What surfaces reflect of lamps whose light came by mirrors and glass; ``depth`` surfaces count already.

        Of points and suns, which rays cannot meet, what leaves rough glass, by a shadow ray there.
        """

        def emitted(ray: mi.Ray3f, way: Way, sampler: mi.Sampler, active: mi.Mask) -> Seen:
            lit = active & (way.depth > depth)
            met = dr.select(way.depth > depth, self._traced.ray_intersect(ray, lit), onwards.met)
            radiance = dr.select(lit, met.emitter(self._scene, lit).eval(met, lit), 0)
            rough = active & is_one_of(self._rough_glass, met)
            if not self._rough_glass or not self._unmet:
                return Seen(radiance, met, rough)
            asked = rough & ~way.last
            there, light = self._scene.sample_emitter_direction(met, sampler.next_2d(asked), True, asked)
            asked &= there.delta
            value = met.bsdf().eval(mi.BSDFContext(), met, met.to_local(there.d), asked)
            return Seen(radiance + dr.select(asked, value * light, 0), met, rough)

        active &= onwards.met.is_valid() & (dr.max(onwards.weight) > 0)
        found, _ = follow(emitted, onwards.ray, sampler, active, self._max_depth, depth)
        return dr.select(active, onwards.weight * found, 0)


def without_environment(scene: mi.Scene) -> mi.Scene:
    """A scene of the same shapes and emitters but the environment."""
    on_shapes = [shape.emitter() for shape in scene.shapes() if shape.is_emitter()]
    free = [e for e in scene.emitters() if not e.is_environment() and not any(e is s for s in on_shapes)]
    return scene_of({f"kept_{k}": thing for k, thing in enumerate([*scene.shapes(), *free])})
