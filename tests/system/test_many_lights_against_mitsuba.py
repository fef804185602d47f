"""Many lights against Mitsuba's own integrators, one physical situation each."""

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from conftest import diffuse

import mi_sparse_prt as prt
from mi_sparse_prt.manylights.elements import Elements
from mi_sparse_prt.manylights.lights import LightOptions, scene_lights
from mi_sparse_prt.manylights.samples import Samples
from mi_sparse_prt.manylights.surfaces import Surfaces

T = mi.ScalarTransform4f
SCENES = Path(__file__).parents[2] / "scenes_xml"
SIZE, BLOCK, SEEDS = 24, 4, 4
RED = diffuse(0.7, 0.5, 0.2)
LAMP = {
    "type": "rectangle",
    "to_world": T().translate([0, 3, 0]).rotate([1, 0, 0], 90).scale(0.5),
    "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [6, 5, 4]}},
}
SPOT = {"type": "spot", "to_world": T().look_at([1, 2.5, 1.5], [0, 0.5, 0], [0, 1, 0]), "intensity": 20.0}
FAR = {"type": "directional", "direction": [-0.3, -1, -0.5], "irradiance": 2.0}
SKY = {"type": "constant", "radiance": {"type": "rgb", "value": [0.3, 0.5, 0.8]}}
PANE = {
    "type": "rectangle",
    "to_world": T().translate([0, 1, 2]).scale(2),
    "bsdf": {"type": "thindielectric"},
}
CURVE = {
    "type": "bsplinecurve",
    "filename": str(SCENES / "zoo/curls.txt"),
    "to_world": T().translate([0, 1, 0]),
}


def scene_of(bsdf: dict, light: dict, **more: object) -> mi.Scene:
    """A ball on a floor before a wall."""
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    view = T().look_at([0, 1, 3.2], [0, 0.8, 0], [0, 1, 0])
    floor = {"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90).scale(2)}
    wall = {"type": "rectangle", "to_world": T().translate([0, 2, -2]).scale(2)}
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": {"type": "perspective", "fov": 50, "to_world": view, "film": film},
            "floor": {**floor, "bsdf": diffuse(0.6, 0.5, 0.4)},
            "wall": {**wall, "bsdf": {"type": "twosided", "bsdf": diffuse(0.3, 0.5, 0.7)}},
            "ball": {"type": "sphere", "center": [0, 0.7, 0], "radius": 0.7, "bsdf": bsdf},
            "light": light,
            **more,
        }
    )


def all_lights_image(scene: mi.Scene, max_depth: int, seed: int) -> np.ndarray:
    """By all lights, without a clamp."""
    surfaces = Surfaces(scene)
    samples = Samples(scene, surfaces, scene.sensors()[0], 16, max_depth, seed)
    count = 1000 if max_depth == 2 else 3000
    options = LightOptions(count, max_depth=max_depth, clamp=np.inf, seed=seed)
    elements = Elements(scene, surfaces, samples, scene_lights(scene, options))
    return samples.image(elements.sum_of_rows(np.arange(len(samples))))


def blocks(images: list[np.ndarray]) -> np.ndarray:
    """Means (n, blocks) over squares of pixels, all channels together."""
    shape = (len(images), SIZE // BLOCK, BLOCK, SIZE // BLOCK, BLOCK, 3)
    return np.reshape(images, shape).mean(axis=(2, 4, 5)).reshape(len(images), -1)


def compared(scene: mi.Scene, max_depth: int, integrator: dict) -> tuple[float, float, np.ndarray]:
    """Relative difference of means, its standard error, and z of each block."""
    reference = mi.load_dict(integrator)
    ours = blocks([all_lights_image(scene, max_depth, seed) for seed in range(SEEDS)])
    theirs = blocks(
        [np.array(mi.render(scene, integrator=reference, spp=512, seed=9 + k)) for k in range(SEEDS)]
    )
    mean, error = ours.mean() / theirs.mean() - 1, 0.0
    for found in (ours, theirs):
        error += found.mean(axis=1).var(ddof=1) / SEEDS / theirs.mean() ** 2
    pooled = ours.var(axis=0, ddof=1) + theirs.var(axis=0, ddof=1)
    z = (ours.mean(axis=0) - theirs.mean(axis=0)) / np.sqrt(pooled / SEEDS + (1e-3 * theirs.mean()) ** 2)
    return mean, float(np.sqrt(error)), z


CASES = {
    "area lamp, direct": (RED, LAMP, {}, 2),
    "spot, a single light": (RED, SPOT, {}, 2),
    "sky, direct": (RED, SKY, {}, 2),
    "rough gold, direct": ({"type": "roughconductor", "material": "Au", "alpha": 0.3}, LAMP, {}, 2),
    "holes, direct": (
        {"type": "mask", "opacity": 0.4, "bsdf": {"type": "twosided", "b": RED}},
        LAMP,
        {},
        2,
    ),
    "interreflection of a spot": (RED, SPOT, {}, 4),
    "interreflection of the sky": (RED, SKY, {}, 3),
    "rough gold sends light on": (
        {"type": "roughconductor", "material": "Au", "alpha": 0.5},
        FAR,
        {},
        3,
    ),
    "a pane before the camera": (RED, SPOT, {"pane": PANE}, 4),
    "curves": (RED, SPOT, {"curve": CURVE}, 2),
}


# what these have, others have, too
LONG = (
    "rough gold, direct",
    "holes, direct",  # and gold: test_many_lights_compensated.py
    "rough gold sends light on",
    "interreflection of a spot",
    "interreflection of the sky",  # tests/unit/test_unfolding.py
)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name in LONG else name for name in CASES]
)
def test_all_lights_agree_with_mitsuba(name: str) -> None:
    """The sum of all elements is what ``direct`` or ``path`` of the same depth render.

    Rationale: lights, samples and elements are made of Mitsuba's own emitters, sensor and BSDFs; nothing but the way
    of adding up differs. Without a clamp and without caustics there is no bias. (``path`` is off where it samples holes
    at depth 2: ``direct`` is the reference of direct light.)
    Expected: the mean over the image within four standard errors of four light sets, and these below 0.7%, so that 2%
    would be seen; z of blocks of 4 x 4 pixels has a root mean square below 2.5 (t-distributed, 6 degrees of freedom:
    1.2; single lights near a surface make it larger), none is above 9.
    """
    bsdf, light, more, depth = CASES[name]
    integrator = {"type": "path", "max_depth": depth, "rr_depth": 100} if depth > 2 else {"type": "direct"}
    mean, error, z = compared(scene_of(bsdf, light, **more), depth, integrator)
    print(f"{name}: {mean:.2%} +- {error:.2%}, rms z {np.sqrt((z**2).mean()):.2f}")
    assert error < 0.007 and abs(mean) < 4 * error + 0.002, (mean, error)
    assert np.sqrt((z**2).mean()) < 2.5 and np.abs(z).max() < 9, z


def test_a_furnace_is_even() -> None:
    """Inside of a closed grey sphere that shines, radiance is known: L / (1 - albedo), cut off at a depth.

    Rationale: every light is seen by every sample, at every depth; what is lost or counted twice shows at once.
    Expected: with albedo 0.5 and depth 4, 1 + 1/2 + 1/4 + 1/8 times the lamp's radiance; the mean within 1%, as lights
    are clamped nowhere but near samples, of which the image takes a few percent in spots.
    """
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}}
    scene = mi.load_dict(
        {
            "type": "scene",
            "sensor": {"type": "perspective", "fov": 60, "film": film},
            "ball": {
                "type": "sphere",
                "flip_normals": True,
                "bsdf": diffuse(0.5, 0.5, 0.5),
                "emitter": {"type": "area", "radiance": 1.0},
            },
        }
    )
    image = np.mean([all_lights_image(scene, 4, seed) for seed in range(4)], axis=0)
    assert image.mean() == pytest.approx(1.875, rel=0.01)


def test_a_mirror_shows_what_is_before_it() -> None:
    """A wall that is a mirror: the camera sees floor and ball in it as in a room twice as deep.

    Rationale: samples are placed by chains through mirrors, and carry their throughput.
    Expected: the share of light that mirrors throw onto diffuse surfaces is missing (no connection finds it), so the
    picture of the mirror itself is compared under a light that shines away from it; 1% of the mean.
    """
    glass = {"type": "twosided", "b": {"type": "conductor", "material": "none"}}
    scene = scene_of(
        RED,
        {**FAR, "direction": [0, -1, 0]},
        wall={
            "type": "rectangle",
            "to_world": T().translate([0, 2, -2]).scale(2),
            "bsdf": glass,
        },
    )
    mean, error, _ = compared(scene, 3, {"type": "path", "max_depth": 3, "rr_depth": 100})
    ours = all_lights_image(scene, 3, 0)[4:10, 8:16]
    assert ours.mean() > 0.02, "nothing in the mirror"
    assert abs(mean) < 4 * error + 0.01


@pytest.mark.slow
def test_a_coat_shows_what_is_before_it() -> None:
    """A ball of black plastic under a sky: all that is seen of it is the sky in its coat, by one row of each pixel.

    Rationale: those rays count as if all samples had one, and go on from one coat to the next by chance.
    Expected: the mean of the ball's pixels is that of `path`, of depth 5 before a floor of black plastic (two coats and
    more), within four standard errors, which are below 0.4%.
    """
    black = {"type": "plastic", "diffuse_reflectance": 0.0}
    scene = scene_of(
        black, SKY, tile={"type": "sphere", "center": [0, -20.2, 0], "radius": 20.2, "bsdf": black}
    )
    ball = np.s_[9:13, 9:15]  # not its edge, where the one row of a pixel may miss it
    ours = [all_lights_image(scene, 5, seed)[ball].mean() for seed in range(6)]
    path = mi.load_dict({"type": "path", "max_depth": 5})
    theirs = [np.array(mi.render(scene, integrator=path, spp=1024, seed=k))[ball].mean() for k in range(4)]
    noise = np.hypot(np.std(ours, ddof=1) / np.sqrt(6), np.std(theirs, ddof=1) / 2)
    assert abs(np.mean(ours) - np.mean(theirs)) < 4 * noise
    assert noise < 0.004 * np.mean(theirs)


@pytest.mark.slow  # of one partition: tests/unit/test_many_lights.py
def test_the_same_error_is_predicted_and_found() -> None:
    """``report["estimated_error"]`` is the expected error of the picture against all lights.

    Rationale: it is measured on second representatives of a tenth of the clusters, at samples of the same image.
    Expected: root mean squares over eight seeds agree within a factor of 1.5 (each seed's error is itself one draw; the
    rows change, too).
    """
    scene = scene_of(RED, LAMP)
    settings = {"lights": 2000, "max_depth": 3, "rows": 30, "columns": 60, "spp": 4}
    predicted, true = [], []
    for seed in range(8):
        found = prt.render_many_lights(scene, seed=seed, **settings)
        surfaces = Surfaces(scene)
        samples = Samples(scene, surfaces, scene.sensors()[0], 4, 3, seed)
        lights = scene_lights(scene, LightOptions(2000, max_depth=3, seed=seed))
        exact = samples.image(Elements(scene, surfaces, samples, lights).sum_of_rows(np.arange(len(samples))))
        true.append(((found.image - exact) ** 2).sum() / (exact**2).sum())
        predicted.append(found.report["estimated_error"] ** 2)
    ratio = np.sqrt(np.mean(predicted) / np.mean(true))
    print(f"predicted {np.sqrt(np.mean(predicted)):.2%}, true {np.sqrt(np.mean(true)):.2%}")
    assert 1 / 1.5 < ratio < 1.5


@pytest.mark.slow
def test_millions_of_triangles_by_instances() -> None:
    """A scene of more than two million triangles, instances of one mesh, which tessellation would refuse.

    Expected: an image that is finite, and not black where the instances are.
    """
    group = {
        "type": "shapegroup",
        "bunny": {"type": "ply", "filename": str(SCENES / "meshes/bunny.ply"), "bsdf": RED},
    }
    count = len(mi.load_dict(group["bunny"]).faces_buffer()) // 3
    instances = {
        f"copy_{k}": {
            "type": "instance",
            "to_world": T().translate([0.5 * (k % 8) - 2, 0, -0.5 * (k // 8)]).scale(3),
            "group": {"type": "ref", "id": "group"},
        }
        for k in range(-(-2_000_000 // count))
    }
    scene = scene_of(RED, SKY, group=group, **instances)
    found = prt.render_many_lights(scene, rows=20, columns=40, lights=2000, max_depth=3)
    assert np.isfinite(found.image).all() and found.image[12:].mean() > 0.01
