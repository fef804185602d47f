"""Light of lamps that vertices cannot show, found at the pixel: lamps that are seen, and the shadows that they cast."""

from __future__ import annotations

from collections.abc import Sequence

import mitsuba as mi

from mi_sparse_prt.relighting.image import RelitIntegrator, RelitScene
from mi_sparse_prt.scene.mitsuba_meshes import scene_of


class LampLitIntegrator(RelitIntegrator):
    """Looks at relit surfaces, and adds what lamps send to the camera themselves or after one reflection.

    The latter is Mitsuba's ``path`` of ``max_depth`` 2 among the lamps alone: shadow rays and rays of the BSDF at every
    sample of a pixel, on the shapes as the scene has them.

    Parameters
    ----------
    relit : sequence of RelitScene
        All other light; what they show is added up.
    scene : mi.Scene
        The shapes and the lamps, and maybe an environment, which is left out.
    """

    def __init__(self, relit: Sequence[RelitScene], scene: mi.Scene) -> None:
        super().__init__(relit[0])
        self._more = relit[1:]
        self._scene = scene if scene.environment() is None else without_environment(scene)
        self._direct = mi.load_dict({"type": "path", "max_depth": 2})

    def sample(
        self,
        scene: mi.Scene,
        sampler: mi.Sampler,
        ray: mi.RayDifferential3f,
        medium: mi.Medium | None = None,
        active: mi.Mask = True,
    ) -> tuple[mi.Color3f, mi.Mask, list[mi.Float]]:
        value, valid, others = super().sample(scene, sampler, ray, medium, active)
        for relit in self._more:
            value += relit.radiance(mi.Ray3f(ray), mi.Mask(active))[0]
        direct, _, _ = self._direct.sample(self._scene, sampler, ray, medium, active)
        return value + direct, valid, others


def without_environment(scene: mi.Scene) -> mi.Scene:
    """A scene of the same shapes and emitters but the environment."""
    on_shapes = [shape.emitter() for shape in scene.shapes() if shape.is_emitter()]
    free = [e for e in scene.emitters() if not e.is_environment() and not any(e is s for s in on_shapes)]
    return scene_of({f"kept_{k}": thing for k, thing in enumerate([*scene.shapes(), *free])})
