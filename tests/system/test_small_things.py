"""Pictures of things that are small beside what they stand on, by `sparse_prt` against `path`."""

import mitsuba as mi
import numpy as np
import pytest
from conftest import T, diffuse

from mi_sparse_prt.validation.mitsuba_reference import path_image

pytestmark = [
    pytest.mark.usefixtures("no_held_out"),
    pytest.mark.filterwarnings("ignore::mi_sparse_prt.core.errors.PrtWarning"),
]
GREY = diffuse(0.5, 0.5, 0.5)
PLAIN = {"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90).scale(300), "bsdf": GREY}
PLANET = {"type": "sphere", "center": [0, -500, 0], "radius": 500, "bsdf": GREY}


def small_things(ground: dict) -> mi.Scene:
    """A box and two balls on a ground, under an even sky."""
    camera = {
        "type": "perspective",
        "fov": 40,
        "to_world": T().look_at([1.2, 1.6, 2.6], [0, 0.1, 0], [0, 1, 0]),
        "film": {"type": "hdrfilm", "width": 64, "height": 48, "rfilter": {"type": "box"}},
    }
    box = {"type": "cube", "to_world": T().translate([0.4, 0.25, 0]).rotate([0, 1, 0], 30).scale(0.25)}
    ball = {"type": "sphere", "center": [-0.4, 0.3, 0.1], "radius": 0.3}
    pebble = {"type": "sphere", "center": [0.1, 0.08, 0.6], "radius": 0.08}
    shapes = {
        name: {**shape, "bsdf": GREY} for name, shape in {"box": box, "ball": ball, "pebble": pebble}.items()
    }
    return mi.load_dict(
        {"type": "scene", "ground": ground, **shapes, "sky": {"type": "constant"}, "camera": camera}
    )


@pytest.mark.parametrize(
    "ground", [PLAIN, pytest.param(PLANET, marks=pytest.mark.slow)], ids=["plain", "planet"]
)
def test_shadows_of_small_things(ground, tmp_path):
    """
    Scenario: a ground that is a thousand times as large as what stands on it.
    Expected: relative L2 error of blocks of 4 x 4 pixels below 2% and mean within 1%. With edges of one length, and
        rays that start off surfaces by 1e-4 of the scene, these were 42 and 25%, and 0.63 and 0.79.
    """
    lit = small_things(ground)
    settings = {
        "resolution": 8,
        "method": "gather",
        "max_depth": 4,
        "progress": False,
        "cache": str(tmp_path),
    }
    ours = mi.render(lit, integrator=mi.load_dict({"type": "sparse_prt", **settings}), spp=64, seed=1)
    ours = blocks(np.array(ours)[..., :3])
    one, other = (blocks(path_image(lit, lit.sensors()[0], 4, 512, seed)) for seed in (2, 3))
    error = np.sqrt(np.sum((ours - one) * (ours - other)) / np.sum(one * other))
    print(f"error {error:.2%}, mean {ours.mean() / (one.mean() + other.mean()) * 2:.4f}")
    assert error < 0.02
    assert ours.mean() == pytest.approx((one.mean() + other.mean()) / 2, rel=0.01)


def blocks(image: np.ndarray) -> np.ndarray:
    """Means of 4 x 4 pixels."""
    return image.reshape(12, 4, 16, 4, 3).mean(axis=(1, 3))
