"""The sun of an environment: shadows at the pixel in `sparse_prt`, against `path`; interreflections from the matrix."""

import mitsuba as mi
import numpy as np
import pytest
from conftest import GROUND, T, build

import mi_sparse_prt as prt
from mi_sparse_prt.emission.environment import emitter_of
from mi_sparse_prt.plugins import sparse_prt
from mi_sparse_prt.relighting.sharp_light import SMALL, sharp_light

pytestmark = [
    pytest.mark.usefixtures("no_held_out"),
    pytest.mark.filterwarnings("ignore::mi_sparse_prt.core.errors.PrtWarning"),
]
SIZE = 48
GLOSSY = {"type": "roughconductor", "alpha": 0.3, "material": "Al"}
SHAPES = {
    "ground": {**GROUND, "to_world": T().rotate([1, 0, 0], -90).scale(6)},
    "post": {
        "type": "cube",
        "to_world": T().translate([0, 0.5, 0]).rotate([0, 1, 0], 30).scale([0.1, 0.5, 0.1]),
    },
    "ball": {"type": "sphere", "center": [-0.7, 0.3, 0.4], "radius": 0.3},
}
HOLES = {"type": "checkerboard", "color0": 0.0, "color1": 1.0, "to_uv": T().scale(2)}
SHEETS = {
    "holes": {
        "type": "rectangle",
        "to_world": T().translate([0.6, 0.7, 0.3]).rotate([1, 0, 0], -90).scale(0.4),
        "bsdf": {"type": "mask", "opacity": HOLES, "bsdf": {"type": "twosided", "bsdf": GROUND["bsdf"]}},
    },
    "pane": {
        "type": "rectangle",
        "to_world": T().translate([0.8, 0.3, 1.2]).scale(0.3),
        "bsdf": {"type": "thindielectric"},
    },
}
CAMERA = {
    "type": "perspective",
    "fov": 40,
    "to_world": T().look_at([1, 2.2, 3.5], [0.2, 0.2, 0], [0, 1, 0]),
    "film": {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}},
}


def sky(sun: float, height: int = 128, radius: float = 3.0) -> mi.Emitter:
    """A blue sky, and a disk of some degrees that brings so many times its light, 40 degrees high."""
    theta, phi = np.meshgrid(
        *(np.pi * (np.arange(n) + 0.5) / height for n in (height, 2 * height)), indexing="ij"
    )
    towards = np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)], axis=-1)
    centre = np.array([-0.6, 0.64, -0.48])
    disk = towards @ centre > np.cos(np.radians(radius))
    pixels = np.broadcast_to(np.float32([0.3, 0.4, 0.6]), (*disk.shape, 3)).copy()
    area = 2 * np.pi * (1 - np.cos(np.radians(radius)))
    pixels[disk] += np.float32([1.0, 0.9, 0.8]) * (sun * 0.4 * 4 * np.pi / area)
    return emitter_of(prt.Environment(pixels))


def picture(scene: mi.Scene, integrator: mi.Integrator, spp: int, seed: int) -> np.ndarray:
    return np.array(mi.render(scene, integrator=integrator, spp=spp, seed=seed))[..., :3].astype(np.float64)


@pytest.mark.parametrize(
    "kind", ["glossy", *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("diffuse", "holes"))]
)
def test_shadows_of_a_sun_are_those_of_path(tmp_path, monkeypatch, kind):
    """Rationale: the ground's vertices are as far apart as the post is thick, and a texel is wider than the sun.

    Expected: an error of less than 3% of the picture beyond noise, and of less than 1% of its mean; by the matrix
        alone more than twice as much.
    """
    shapes = {name: {**shape, "bsdf": GROUND["bsdf"]} for name, shape in SHAPES.items()}
    if kind == "glossy":
        shapes["ball"]["bsdf"] = GLOSSY
    if kind == "holes":
        shapes |= SHEETS
    scene = mi.load_dict({"type": "scene", **shapes, "camera": CAMERA, "sky": sky(1.0)})
    options = {
        "type": "sparse_prt",
        "resolution": 8,
        "method": "gather",
        "max_depth": 4,
        "cache": str(tmp_path),
        "progress": False,
    }
    path = mi.load_dict({"type": "path", "max_depth": 4})
    theirs = [picture(scene, path, 512, 90 + k) for k in range(2)]
    errors = {}
    for name in ("pixel", "matrix"):
        if name == "matrix":
            monkeypatch.setattr(sparse_prt, "sharp_light", lambda _: None)
        ours = [picture(scene, mi.load_dict(options), 256, k) for k in range(2)]
        squares = ((ours[0] - theirs[0]) * (ours[1] - theirs[1])).sum()
        errors[name] = np.sqrt(max(squares, 0) / (theirs[0] * theirs[1]).sum())
        bias = sum(x.mean() for x in ours) / sum(x.mean() for x in theirs) - 1
        print(f"{name}: {errors[name]:.2%} off, mean {bias:+.2%}")
        if name == "pixel":
            assert abs(bias) < 0.01
    assert errors["pixel"] < 0.03
    assert errors["matrix"] > 2 * errors["pixel"]


def test_what_is_sharp():
    """Expected: nothing of even light, of a wide lamp, or of a sun of a twentieth; else a small part of the sky.

    It brings what the sun brings, and its emitter as much as its image.
    """
    lighting = prt.CubemapLighting(16)
    assert sharp_light(mi.load_dict({"type": "constant", "radiance": 2.0})) is None
    assert sharp_light(sky(1.0, radius=20.0)) is None
    assert sharp_light(sky(0.05)) is None
    for sun in (0.3, 1.0):
        found = sharp_light(sky(sun))
        assert found is not None
        power, by_emitter, whole = (
            (lighting.project(light) * lighting.solid_angles[:, None]).sum(axis=0)
            for light in (found.environment, found.emitter, sky(sun))
        )
        assert power == pytest.approx(np.array([1.0, 0.9, 0.8]) * sun * 0.4 * 4 * np.pi, rel=0.05)
        assert by_emitter == pytest.approx(power, rel=0.01)
        assert np.all(power < whole)
        lit = found.environment.pixels.any(axis=2)
        assert found.environment.solid_angles[lit].sum() <= SMALL


def test_the_matrix_gives_the_rest():
    """Expected: what is taken away is the direct light of the sun alone, of all depths."""
    scene, lighting = build(1.0, **SHAPES), prt.CubemapLighting(8)
    transport = prt.precompute(scene, lighting, "gather", progress=False)
    found, whole = sharp_light(sky(1.0)), sky(1.0)
    assert found is not None
    irradiance = transport.irradiance_by_depth(whole)
    rest = found.taken_from(irradiance, transport)
    direct = prt.precompute(scene, lighting, "gather", max_depth=2, progress=False)
    expected = direct.irradiance_by_depth(found.environment)[0]
    assert irradiance - rest == pytest.approx(np.broadcast_to(expected, irradiance.shape), abs=1e-5)
    assert (expected == 0).any() and (expected > 0).any()
