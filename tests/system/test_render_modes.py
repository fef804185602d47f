"""How a scene may be looked at: alpha, hidden emitters, crop windows, pixel formats, samplers, AOVs, as by `path`."""

from collections.abc import Callable

import mitsuba as mi
import numpy as np
import pytest
from conftest import T, diffuse

import mi_sparse_prt as prt
from mi_sparse_prt.scene.scene import Scene

pytestmark = pytest.mark.usefixtures("no_held_out")
SIZE, SPP = 24, 64
SKY = {"type": "constant", "radiance": {"type": "rgb", "value": [1, 1.2, 1.5]}}
PANEL = {
    "type": "rectangle",
    "to_world": T().translate([0.3, 1.6, 0.5]).rotate([1, 0, 0], 40).scale(0.3),
    "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [6, 5, 4]}},
}
SEEN_THROUGH = {
    "glass": {
        "type": "cube",
        "to_world": T().translate([1, 0.6, 0.3]).scale(0.3),
        "b": {"type": "dielectric"},
    },
    "nothing": {"type": "cube", "to_world": T().translate([-0.8, 0.5, 1]).scale(0.3), "b": {"type": "null"}},
    "pane": {
        "type": "rectangle",
        "to_world": T().translate([-0.8, 1, -1]).scale(0.5),
        "b": {"type": "thindielectric"},
    },
    "mirror": {
        "type": "rectangle",
        "to_world": T().translate([0.9, 1.2, -1]).scale(0.4),
        "b": {"type": "conductor"},
    },
}
MASK = {
    "type": "rectangle",
    "to_world": T().translate([0, 1, 1]).scale(0.6),
    "b": {"type": "mask", "opacity": 0.5, "b": {"type": "twosided", "b": diffuse(0.7, 0.6, 0.5)}},
}


def view(sampler: str = "independent", **film: object) -> dict:
    film = {"width": SIZE, "height": SIZE, "pixel_format": "rgba", "rfilter": {"type": "box"}, **film}
    return {
        "type": "perspective",
        "fov": 45,
        "to_world": T().look_at(origin=[0, 2, 4], target=[0, 0.5, 0], up=[0, 1, 0]),
        "film": {"type": "hdrfilm", **film},
        "sampler": {"type": sampler, "sample_count": SPP},
    }


def scene_of(camera: dict | None = None, **more: object) -> mi.Scene:
    """A box on a ground: all is flat, so that triangles are no approximation."""
    content = {
        "ground": {"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90), "b": diffuse(0.6, 0.5, 0.4)},
        "box": {"type": "cube", "to_world": T().translate([0, 0.5, 0]).rotate([1, 1, 0], 40).scale(0.3)},
    }
    return mi.load_dict({"type": "scene", "camera": camera or view(), **content, **more})


@pytest.fixture(scope="module")
def integrator(tmp_path_factory: pytest.TempPathFactory) -> dict:
    """Parameters of ours; all tests share a cache."""
    cache = str(tmp_path_factory.mktemp("modes"))
    return {"type": "sparse_prt", "resolution": 8, "max_depth": 4, "edge_length": 0.2} | {
        "method": "gather",
        "progress": False,
        "cache": cache,
    }


def looked_at(scene: mi.Scene, integrator: dict, seed: int, **parameters: object) -> np.ndarray:
    return np.array(mi.render(scene, integrator=mi.load_dict(integrator | parameters), spp=SPP, seed=seed))


def by_path(scene: mi.Scene, seed: int, **parameters: object) -> np.ndarray:
    return looked_at(scene, {"type": "path", "max_depth": 4}, seed, **parameters)


def several(render: Callable[..., np.ndarray], *about: object, **parameters: object) -> list[np.ndarray]:
    return [render(*about, seed, **parameters) for seed in range(1, 7)]


def error(ours: list[np.ndarray], theirs: list[np.ndarray]) -> float:
    """Relative L2 between colours of the same camera rays, less what the spread of the differences explains."""
    off = (np.stack(ours) - theirs)[..., :3]
    noise = np.var(off, axis=0, ddof=1).sum() / len(off)
    beyond, size = np.sum(off.mean(axis=0) ** 2) - noise, np.linalg.norm(np.mean(theirs, axis=0)[..., :3])
    print(f"{np.sqrt(max(beyond, 0)) / size:.2%} off, noise {np.sqrt(noise) / size:.2%}")
    return float(np.sqrt(max(beyond, 0)) / size)


@pytest.mark.parametrize("hide", [pytest.param(False, marks=pytest.mark.slow), True])
@pytest.mark.parametrize(
    "light", ["panel", *(pytest.param(light, marks=pytest.mark.slow) for light in ("sky", "both"))]
)
def test_alpha_and_hidden_emitters(integrator: dict, light: str, hide: bool) -> None:
    """
    Rationale: an image is put in front of another by its alpha; hidden lamps do not stand in the way.
    Expected: alpha of the same camera rays as ``path`` has it, also behind glass, nothing, a thin pane, and by way of a
        mirror; the same colours.
    """
    lights = ({} if light == "panel" else {"sky": SKY}) | ({} if light == "sky" else {"panel": PANEL})
    scene = scene_of(**SEEN_THROUGH, **lights)
    ours = several(looked_at, scene, integrator, hide_emitters=hide)
    theirs = several(by_path, scene, hide_emitters=hide)
    off, found = np.abs(ours[0] - theirs[0])[..., 3].mean(), error(ours, theirs)
    print(f"alpha {ours[0][..., 3].mean():.3f}, off {off:.4f}")
    assert off < 0.002
    assert (ours[0][..., 3].mean() == 1) == (light != "panel" and not hide)
    assert found < 0.04


def test_half_open_surfaces_keep_their_colour(integrator: dict) -> None:
    """
    Rationale: what is hidden from the camera shines on; ``path`` loses a fifth of a mask's light there.
    Expected: without the environment behind it, an image lacks what its alpha leaves of that, and nothing else.
    """
    scene = scene_of(sky=SKY, mask=MASK)
    shown, hidden = (
        np.mean(several(looked_at, scene, integrator, hide_emitters=h), axis=0) for h in (False, True)
    )
    missing = (1 - hidden[..., 3:]) * SKY["radiance"]["value"]
    assert ((hidden[..., 3] > 0.3) & (hidden[..., 3] < 0.7)).sum() > 10
    np.testing.assert_allclose(shown[..., :3] - hidden[..., :3], missing, atol=1e-4)
    assert np.abs(hidden - np.mean(several(by_path, scene, hide_emitters=True), axis=0))[..., 3].max() < 0.01


@pytest.mark.slow  # Mitsuba crops; tests/unit/test_fixed_camera.py
def test_crop_windows(integrator: dict) -> None:
    window = {"crop_width": 10, "crop_height": 6, "crop_offset_x": 8, "crop_offset_y": 9}
    scene = scene_of(view(**window), sky=SKY, panel=PANEL)
    ours, theirs = several(looked_at, scene, integrator), several(by_path, scene)
    assert ours[0].shape == (6, 10, 4)
    assert error(ours, theirs) < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("sampler", ["stratified", "multijitter", "ldsampler"])
def test_samplers(integrator: dict, sampler: str) -> None:
    """Expected: ``path``'s image; and less noise than independent samples have, which is that of edges."""
    scene, usual = (scene_of(view(kind), sky=SKY) for kind in (sampler, "independent"))
    ours, theirs = several(looked_at, scene, integrator), several(by_path, scene)
    noise = np.std(ours, axis=0).mean() / np.std(several(looked_at, usual, integrator), axis=0).mean()
    print(f"noise {noise:.2f} of that of independent samples")
    assert noise < 0.8
    assert error(ours, theirs) < 0.01


def test_aov_around_it(integrator: dict) -> None:
    """Expected: its own image, and the variables that ``aov`` finds around ``path``."""
    scene = scene_of(sky=SKY, panel=PANEL)
    around = {"type": "aov", "aovs": "d:depth,n:sh_normal"}
    ours = looked_at(scene, around | {"image": integrator}, 1)
    theirs = looked_at(scene, around | {"image": {"type": "path"}}, 1)
    assert ours.shape == theirs.shape == (SIZE, SIZE, 8)
    np.testing.assert_allclose(ours[..., :4], looked_at(scene, integrator, 1), rtol=1e-6)
    np.testing.assert_allclose(ours[..., 4:], theirs[..., 4:], atol=1e-5)


@pytest.mark.parametrize("pixel_format", ["rgba", "xyz", "luminance_alpha"])
def test_render_gives_linear_rgb(pixel_format: str) -> None:
    """`prt.render`, whatever the pixel format: that of a film of rgb, or grey with its luminance."""
    scene = Scene.from_mitsuba(scene_of(view(pixel_format="rgb"), sky=SKY), 0.5)
    transport = prt.precompute(
        scene, prt.CubemapLighting(4), method="gather", max_depth=2, strata=2, progress=False
    )
    rgb = prt.render(scene, transport, 1.0, spp=16)
    other = mi.load_dict(view(pixel_format=pixel_format))
    image = prt.render(scene, transport, 1.0, other, spp=16)
    grey = np.repeat(rgb @ [[0.212671], [0.71516], [0.072169]], 3, axis=2)
    np.testing.assert_allclose(image, grey if "luminance" in pixel_format else rgb, rtol=1e-3, atol=1e-4)
