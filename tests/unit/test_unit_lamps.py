"""Lamps apart from their brightness: what their columns depend on, and what they are multiplied with."""

import warnings

import mitsuba as mi
import numpy as np
import pytest
from conftest import T, diffuse

import mi_sparse_prt as prt
from mi_sparse_prt.emission.unit_lamps import UnitLamps

DOWN = T().translate([0, 2, 0]).rotate([1, 0, 0], 90)


def rgb(*values: float) -> dict:
    return {"type": "rgb", "value": list(values)}


def lamps(screen: float = 1.0, turned: float = 0.0, **changes: object) -> UnitLamps:
    """A panel, a screen, a bulb, a spot and a sky over a floor, some of them changed."""
    pixels = mi.TensorXf(screen * np.arange(1, 13, dtype=np.float32).reshape(2, 2, 3))
    texture = {"type": "bitmap", "data": pixels, "raw": True, "to_uv": mi.ScalarTransform3f().rotate(turned)}
    content = {
        "floor": {
            "type": "rectangle",
            "to_world": T().rotate([1, 0, 0], -90),
            "bsdf": diffuse(0.5, 0.5, 0.5),
        },
        "panel": {
            "type": "rectangle",
            "to_world": DOWN,
            "emitter": {"type": "area", "radiance": rgb(1, 2, 3)},
        },
        "screen": {
            "type": "rectangle",
            "to_world": T().translate([0, 1, -1]),
            "emitter": {"type": "area", "radiance": texture},
        },
        "bulb": {"type": "point", "position": [0, 1, 0], "intensity": rgb(3, 2, 1)},
        "beam": {"type": "spot", "to_world": T().look_at([0, 1, 1], [0, 0, 0], [0, 1, 0]), "intensity": 5.0},
        "sky": {"type": "constant"},
    }
    for name, change in changes.items():
        content[name] = content[name] | change
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", prt.PrtWarning)
        return UnitLamps(
            prt.Scene.from_mitsuba(mi.load_dict({"type": "scene", **content}, optimize=False), 1)
        )


def arriving(space: UnitLamps) -> np.ndarray:
    """(size, 3) light of each lamp at a point of the floor, at right angles, from one sample."""
    count = space.size
    element = mi.UInt32(np.arange(count, dtype=np.uint32))
    position, uv = mi.Point3f(np.tile([[0.1], [0], [0.2]], count)), mi.Point2f(np.full((2, count), 0.3))
    return space.sample(element, position, uv)[1].numpy().T


def test_columns_times_brightness_are_the_lamps():
    space = lamps()
    assert sorted(space.names) == ["beam", "bulb", "panel", "screen"]
    brightness = dict(zip(space.names, space.brightness.tolist(), strict=True))
    assert brightness == {"panel": [1, 2, 3], "screen": [1, 1, 1], "bulb": [3, 2, 1], "beam": [5, 5, 5]}
    authored = arriving(space)
    assert (authored > 0).all()
    with space.at_unit_brightness():
        unit = arriving(space)
    np.testing.assert_allclose(unit * space.brightness, authored, rtol=1e-5)
    with pytest.raises(KeyError), space.at_unit_brightness():
        raise KeyError
    assert np.array_equal(arriving(space), authored)  # as they were, whatever happens


@pytest.mark.parametrize(
    ("changes", "same"),
    [
        ({}, True),
        ({"bulb": {"intensity": rgb(0, 0, 0)}}, True),
        ({"beam": {"intensity": rgb(0.1, 7, 3)}}, True),
        ({"panel": {"emitter": {"type": "area", "radiance": 0.5}}}, True),
        ({"sky": {"radiance": 3.0}}, True),
        ({"bulb": {"position": [0, 1, 0.001]}}, False),
        ({"beam": {"cutoff_angle": 21.0}}, False),
        ({"beam": {"to_world": T().look_at([0, 1, 1], [0, 0.01, 0], [0, 1, 0])}}, False),
        ({"panel": {"to_world": DOWN @ T().rotate([0, 0, 1], 1)}}, False),
        ({"screen": 0.5}, False),
        ({"turned": 90.0}, False),
    ],
    ids=str,
)
def test_the_hash_is_of_where_lamps_are(changes, same):
    assert (lamps(**changes).hash == lamps().hash) == same


def test_another_surface_that_shines_is_another_hash():
    """The same two shapes, of which one or the other is the lamp."""

    def space(shining: str) -> UnitLamps:
        shapes = {
            name: {"type": "rectangle", "to_world": T().translate([0, 0, z]), "bsdf": diffuse(0.5, 0.5, 0.5)}
            for name, z in (("a", 0), ("b", 1))
        }
        shapes[shining]["emitter"] = {"type": "area", "radiance": 1.0}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", prt.PrtWarning)
            scene = prt.Scene.from_mitsuba(mi.load_dict({"type": "scene", **shapes}, optimize=False))
        space = UnitLamps(scene)
        space.scene_hash = scene.hash
        return space

    assert space("a").scene_hash == space("b").scene_hash
    assert space("a").hash != space("b").hash
