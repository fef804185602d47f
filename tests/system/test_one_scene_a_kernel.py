"""A kernel traces rays in one scene only: on a GPU, OptiX leaves out all other rays, and what they find is wrong."""

import re
from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import BALL, GROUND, PALE, T

import mi_sparse_prt as prt
from mi_sparse_prt.scene import materials

pytestmark = pytest.mark.skipif(
    not mi.variant().startswith("llvm"), reason="reads what Dr.Jit writes for LLVM"
)
# rays are traced by a function, for a scene, both of which are arguments of the kernel, or found by its calls
TRACED = re.compile(r"call void (%\w+)\(ptr [^,]+, ptr (%\w+), ptr %u\d+_in_ctx")
WALL = {
    "type": "rectangle",
    "to_world": T().translate([0.07, 0.4, 0]).rotate([0, 1, 0], 90).scale([2, 0.5, 1]),
    "bsdf": {"type": "twosided", "bsdf": PALE},
}
GLASS = {**BALL, "center": [-0.5, 0.4, 0.3], "bsdf": {"type": "roughdielectric", "alpha": 0.2}}
MIRROR = {**BALL, "center": [0.6, 0.4, 0.1], "bsdf": {"type": "conductor"}}
PANE = {"type": "rectangle", "to_world": T().translate([0, 0.3, 0.9]), "bsdf": {"type": "thindielectric"}}
PAINTED = mi.Bitmap(np.random.default_rng(3).uniform(0, 1, (4, 4, 3)).astype(np.float32))
LIGHT = {
    "panel": {
        "type": "rectangle",
        "to_world": T().translate([0, 1.8, 0]).rotate([1, 0, 0], 90).scale(0.3),
        "emitter": {"type": "area", "radiance": 3.0},
    },
    "painting": {
        "type": "rectangle",
        "to_world": T().translate([0, 1.8, 0]).rotate([1, 0, 0], 90).scale(0.3),
        "emitter": {"type": "area", "radiance": {"type": "bitmap", "bitmap": PAINTED, "raw": True}},
    },
    "bulb": {"type": "point", "position": [-0.6, 1.5, 0.2], "intensity": 1.0},
    "sky": {"type": "constant", "radiance": 0.3},
}
CAMERA = {
    "type": "perspective",
    "to_world": T().look_at([0, 1.2, 4], [0, 0.4, 0], [0, 1, 0]),
    "film": {"type": "hdrfilm", "width": 12, "height": 8},
}


def scenes_traced(work: Callable[[], object]) -> list[int]:
    """In how many scenes each kernel that traces rays does so."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        work()
        history = dr.kernel_history([dr.KernelType.JIT])
    kernels = {kernel["hash"]: kernel["ir"] for kernel in history}.values()
    code = [ir if isinstance(ir, str) else ir.read() for ir in kernels]
    counts = [len({scene for _, scene in TRACED.findall(text)}) for text in code]
    return [count for count in counts if count]


def lit_scene(*lights: str, **shapes: dict) -> mi.Scene:
    """A ground that a wall passes through, and others, under these lights."""
    lit = {name: LIGHT[name] for name in lights}
    content = {"ground": GROUND, "wall": WALL, **shapes, **lit, "camera": CAMERA}
    return mi.load_dict({"type": "scene", **content}, optimize=False)


def test_two_scenes_in_a_kernel_are_noticed():
    scenes = [lit_scene("sky") for _ in range(2)]
    ray = mi.Ray3f(mi.Point3f(0, 1.2, 4), mi.Vector3f(dr.linspace(mi.Float, -1, 1, 100), -0.2, -1))

    def mixed() -> None:
        dr.eval(scenes[0].ray_test(ray) & scenes[1].ray_test(ray))

    assert scenes_traced(mixed) == [2]


def irradiance_of_painting(samples: int) -> tuple[float, float]:
    """Of a place below it, by samples of Mitsuba's: the mean, and its standard error."""
    scene = prt.Scene.from_mitsuba(lit_scene("painting"), 0.6).mitsuba
    rng, si = mi.PCG32(samples), dr.zeros(mi.SurfaceInteraction3f, samples)
    si.p = mi.Point3f(0.1, 0.9, 0.2)
    uv = mi.Point2f(rng.next_float32(), rng.next_float32())
    there, value = scene.sample_emitter_direction(si, uv, True)
    found = dr.max(value * dr.abs(there.d.y)).numpy().astype(np.float64)
    return found.mean(), found.std() / samples**0.5


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_textures_of_lamps_are_not_searched_by_rays_on_a_gpu(monkeypatch):
    """Expected: as much light as by samples of the texture, for which Mitsuba traces rays in a scene of the lamp's.

    Standard errors of 0.1% would show 1%.
    """
    traced, found = [], []
    for variant in ("llvm_ad_rgb", "cuda_ad_rgb"):
        monkeypatch.setattr(materials, "variant", lambda variant=variant: variant)
        traced.append(scenes_traced(lambda: found.append(irradiance_of_painting(1 << 16))))
    print(found)
    assert [max(counts) for counts in traced] == [2, 1]
    (a, error), (b, other) = found
    assert error + other < 0.004 * a and abs(a - b) < 4 * np.hypot(error, other)


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize(
    "kind", [*(pytest.param(kind, marks=pytest.mark.slow) for kind in ("sky", "panes")), "lamps"]
)
def test_precomputing_rendering_and_validating(kind, monkeypatch):
    """Rationale: corners behind walls are looked for by rays from the pixels; mirrors and glass lead rays to lamps.

    What panes let through is told by rays among these, where others are not in the way.
    """
    if kind != "lamps":
        shapes = {"pane": PANE, "glass": GLASS, "mirror": MIRROR} if kind == "panes" else {}
        scene = prt.Scene.from_mitsuba(lit_scene("sky", **shapes), 0.6)
        emission, options = prt.CubemapLighting(2), {"basis": "texel"}
    else:
        monkeypatch.setattr(materials, "variant", lambda: "cuda_ad_rgb")
        scene = prt.Scene.from_mitsuba(lit_scene("painting", "bulb", glass=GLASS, mirror=MIRROR), 0.6)
        emission, options = prt.SceneEmitters(scene), {}

    def work() -> None:
        transport = prt.precompute(scene, emission, max_depth=4, progress=False, **options)
        prt.validate(scene, transport, 8, 4, spp=2, progress=False, image_width=12, image_spp=4)

    counts = scenes_traced(work)
    assert len(counts) > 20
    assert set(counts) == {1}


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize(
    "around", [pytest.param(False, marks=pytest.mark.slow), True], ids=["alone", "in aov"]
)
def test_the_integrator(around, tmp_path):
    """Rationale: it looks at its copy of the scene and, for lamps, at the scene; integrators around it do, too."""
    ours = {
        "type": "sparse_prt",
        "resolution": 2,
        "edge_length": 0.3,
        "progress": False,
        "cache": str(tmp_path),
    }
    ours |= {"hide_emitters": True, "max_depth": 3}
    integrator = mi.load_dict({"type": "aov", "aovs": "d:depth", "image": ours} if around else ours)
    scene = lit_scene("sky", "panel")
    counts = scenes_traced(lambda: mi.render(scene, integrator=integrator, spp=1))
    assert len(counts) > 5
    assert set(counts) == {1}
