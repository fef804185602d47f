"""Lamps apart from their brightness: what their columns depend on, and what they are multiplied with."""

import warnings

import mitsuba as mi
import numpy as np
import pytest
from conftest import T, build, diffuse

import mi_sparse_prt as prt
from mi_sparse_prt.emission.unit_lamps import UnitLamps

DOWN = T().translate([0, 2, 0]).rotate([1, 0, 0], 90)


def rgb(*values: float) -> dict:
    return {"type": "rgb", "value": list(values)}


def room(screen: float = 1.0, turned: float = 0.0, **changes: object) -> prt.Scene:
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
        return prt.Scene.from_mitsuba(mi.load_dict({"type": "scene", **content}, optimize=False), 1)


def lamps(**changes: object) -> UnitLamps:
    return UnitLamps(room(**changes))


def arriving(space: prt.SceneEmitters, samples: int = 1 << 12) -> np.ndarray:
    """(size, 3) light of each lamp at a point above the floor, at right angles to it."""
    element = mi.UInt32(np.repeat(np.arange(space.size, dtype=np.uint32), samples))
    uv = np.random.default_rng(0).random((2, len(element))).astype(np.float32)
    position = mi.Point3f(np.tile([[0.1], [0.2], [0.2]], len(element)))
    found = space.sample(element, position, mi.Point2f(uv))[1].numpy()
    return found.reshape(3, space.size, samples).mean(axis=2, dtype=np.float64).T


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


def test_textured_lamps_are_dimmed_and_coloured():
    scene = room()
    space = prt.SceneEmitters(scene, {"screen": ["screen"]})
    before = arriving(space)
    for brightness, noise in (([0.5, 0.5, 0.5], 1e-4), ([2, 0, 0.25], 0.02)):  # samples go where it is bright
        with space.scene_lit_by({"screen": brightness}, scene):
            np.testing.assert_allclose(arriving(space), before * brightness, rtol=noise)
    assert np.array_equal(arriving(space), before)


def test_what_takes_no_colour_is_refused_by_name():
    scene = room()
    space = prt.SceneEmitters(scene, {"sky": ["sky"]})
    with (
        pytest.raises(prt.PrtError, match="'sky' .* takes no colour"),
        space.scene_lit_by([[1, 2, 3]], scene),
    ):
        pass
    with space.scene_lit_by(0.5, scene):
        assert mi.traverse(scene.mitsuba)["sky.radiance.value"] == 0.5
    with pytest.raises(prt.PrtError, match="no lamp besides its environment"):
        UnitLamps(prt.Scene.from_mitsuba(mi.load_dict({"type": "scene", "a": {"type": "sphere"}}), 1))


@pytest.mark.parametrize("metal", [pytest.param(False, marks=pytest.mark.slow), True])
def test_pictures_ask_for_what_surfaces_reflect(metal: bool) -> None:
    """
    Rationale: pictures sample the lamps themselves; their direct light, and its check, would be for nothing.
    Expected: the indirect part of the matrix of lamps and no other, by finite elements and by paths. The error that it
        tells is relative to all light: within 20% or 3 standard errors of how far it is from 4096 paths (0.58 +- 0.13
        and 0.64%; with metal 3.8 +- 0.4 and 3.7%).
    """
    scene = build(
        0.5,
        floor={"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90), "bsdf": diffuse(0.7, 0.5, 0.3)},
        wall={
            "type": "rectangle",
            "to_world": T().translate([-1, 1, 0]).rotate([0, 1, 0], 90),
            "bsdf": {"type": "roughconductor", "alpha": 0.4} if metal else diffuse(0.6, 0.6, 0.6),
        },
        panel={"type": "rectangle", "to_world": DOWN, "emitter": {"type": "area", "radiance": rgb(1, 2, 3)}},
        bulb={"type": "point", "position": [0.3, 1, 0], "intensity": 2.0},
    )
    space, rows = UnitLamps(scene), np.arange(scene.n_vertices)
    with space.at_unit_brightness():
        found = prt.precompute(scene, space, progress=False)
        lamps = prt.SceneEmitters(scene, {name: [name] for name in space.names})
        whole = prt.precompute(scene, lamps, progress=False)
        true = prt.precompute(scene, lamps, "brute_force", spp=4096, seed=1, progress=False)
    assert set(whole.operators) == {"direct", "indirect"} and set(found.operators) == {"indirect"}
    np.testing.assert_array_equal(found.indirect.rows(rows), whole.indirect.rows(rows))
    wrong = found.indirect.rows(rows) - true.indirect.rows(rows)
    error, every = (np.linalg.norm(scene.albedo[:, None] * x) for x in (wrong, true.incident.rows(rows)))
    told, spread = (found.report["estimated_error"][name] for name in ("total", "standard_error"))
    assert abs(told - error / every) < max(0.2 * error / every, 3 * spread["total"])
