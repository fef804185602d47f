"""Many lights, frames of a camera or of lamps that move: each is right, and nothing flickers."""

import mitsuba as mi
import numpy as np
import pytest
from conftest import diffuse

import mi_sparse_prt as prt
from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.core.run import Run
from mi_sparse_prt.manylights.light_arrays import DIRECTION
from mi_sparse_prt.manylights.lights import LightOptions, count_lights, mean_counts, scene_lights
from mi_sparse_prt.manylights.render import Settings, matrix_of

T = mi.ScalarTransform4f
FEW = {"lights": 2000, "max_depth": 3}


def room() -> dict:
    wall = {"type": "rectangle", "bsdf": diffuse(0.5, 0.5, 0.6)}
    ball = {"type": "sphere", "radius": 0.6, "bsdf": diffuse(0.7, 0.5, 0.2)}
    lamp = {
        "type": "sphere",
        "radius": 0.1,
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 30}},
    }
    return {
        "type": "scene",
        "sensor": sensor(0),
        "floor": wall | {"to_world": T().rotate([1, 0, 0], -90).scale(3)},
        "wall": wall | {"to_world": T().translate([0, 1, -2]).scale(3)},
        "ball": ball | {"center": [-0.7, 0.6, 0]},
        "other": ball | {"center": [0.8, 0.6, -0.6]},
        "lamp": lamp | {"center": [0.2, 1.6, 0.9]},
        "lamp2": lamp | {"center": [-1.6, 0.3, -1.2]},
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.2, 0.25, 0.3]}},
    }


@pytest.fixture(scope="module")
def scene() -> mi.Scene:
    return mi.load_dict(room())


def sensor(frame: float, size: int = 24) -> dict:
    return {
        "type": "perspective",
        "fov": 45,
        "to_world": T().look_at([0.05 * frame, 1.6, 4], [0, 0.6, 0], [0, 1, 0]),
        "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}},
    }


@pytest.fixture(scope="module")
def cameras() -> list[mi.Sensor]:
    return [mi.load_dict(sensor(frame)) for frame in range(8)]


@pytest.fixture(scope="module")
def references(scene: mi.Scene, cameras: list[mi.Sensor]) -> np.ndarray:
    return all_lights(scene, cameras, 0)


def all_lights(scene: mi.Scene, cameras: list[mi.Sensor], seed: int) -> np.ndarray:
    found = []
    for camera in cameras:
        matrix = matrix_of((scene, camera), Settings(seed=seed, **FEW), Run(seed))
        n = matrix.shape[1]
        found.append(matrix.samples.image(matrix.sum_columns(np.arange(n), np.ones((n, 3), np.float32))))
    return np.array(found, np.float64)


def frames_of(scene: mi.Scene, cameras: list, rows: int, columns: int, **settings) -> np.ndarray:
    found = prt.render_many_lights_frames(scene, cameras, rows, columns, **FEW, **settings)
    return np.array([frame.image for frame in found], np.float64)


@pytest.mark.slow  # a callable of one scene is that scene, and what moves below flickers more
def test_frames_flicker_less_than_pictures(scene, cameras, references) -> None:
    """8 frames, 100 rows in all, 100 columns. Expected: errors change by less than a third of what they do where each
    frame has lights of its own (measured: see the figures), and are themselves at most 1.5 times as large.
    """
    errors = frames_of(scene, cameras, 100, 100) - references
    alone = [prt.render_many_lights(scene, 100, 100, sensor=camera, **FEW).image for camera in cameras]
    others = np.array(alone) - references
    flicker, beside = (np.linalg.norm(np.diff(e, axis=0)) for e in (errors, others))
    print(f"flicker {flicker / beside:.2f} of {beside / np.linalg.norm(references[1:]):.2%}")
    print(f"errors {np.linalg.norm(errors) / np.linalg.norm(others):.2f} of those of pictures")
    assert flicker < beside / 3
    assert np.linalg.norm(errors) < 1.5 * np.linalg.norm(others)


@pytest.mark.slow
def test_frames_are_right_on_average(scene, cameras) -> None:
    """20 seeds of two frames, few rows. Expected: on average all lights of the same seed, within 4 standard errors."""
    pair = cameras[::7]
    apart, whole = [], []
    for seed in range(20):
        found = frames_of(scene, pair, 20, 60, seed=seed)
        whole.append(all_lights(scene, pair, seed).mean(axis=(1, 2)))
        apart.append(found.mean(axis=(1, 2)) - whole[-1])
    error = np.std(apart, axis=0, ddof=1) / np.sqrt(len(apart))
    print("z", np.abs(np.mean(apart, axis=0) / error).max(), "error", (error / np.mean(whole, axis=0)).max())
    assert np.all(error < 0.005 * np.mean(whole, axis=0))  # so that 2% are seen
    assert np.all(np.abs(np.mean(apart, axis=0)) < 4 * error)


def test_a_frame_is_the_same_whenever_it_comes(scene, cameras) -> None:
    """Expected: equal cameras have equal pictures; each report is of its own frame."""
    found = list(prt.render_many_lights_frames(scene, [cameras[0], cameras[1], cameras[0]], 10, 20, **FEW))
    assert np.array_equal(found[0].image, found[2].image)
    assert not np.array_equal(found[0].image, found[1].image)
    assert all(frame.report["estimated_error"] > 0 for frame in found)


def test_more_frames_than_rows(scene, cameras) -> None:
    found = frames_of(scene, cameras, 3, 20)
    assert len(found) == len(cameras)
    assert np.isfinite(found).all()
    assert np.all(found.mean(axis=(1, 2, 3)) > 0)


def test_groups_and_compensation_of_frames(scene, cameras) -> None:
    """Expected: layers add up to the image."""
    for frame in prt.render_many_lights_frames(
        scene, cameras[:2], 20, 30, groups=True, compensate=True, **FEW
    ):
        assert list(frame.layers) == ["lamp", "lamp2", "sky"]
        np.testing.assert_allclose(sum(frame.layers.values()), frame.image, rtol=1e-4, atol=1e-5)


def moving_scene(frame: int) -> mi.Scene:
    """A lamp moves, another fades in after the first frame, a ball rolls, the sky turns blue."""
    scene = mi.load_dict(room())
    known = mi.traverse(scene)
    known["lamp.to_world"] = T().translate([0.2 - 0.03 * frame, 1.6, 0.9]).scale(0.1)
    known["lamp2.emitter.radiance.value"] = mi.Color3f(10.0 * frame)
    known["ball.to_world"] = T().translate([-0.7 + 0.02 * frame, 0.6, 0]).scale(0.6)
    known["sky.radiance.value"] = mi.Color3f(0.2, 0.25, 0.3 + 0.02 * frame)
    known.update()
    return scene


@pytest.fixture(scope="module")
def moving_references() -> np.ndarray:
    """All lights of each frame, those of the same seed."""
    camera = mi.load_dict(sensor(0))
    return np.concatenate([all_lights(moving_scene(frame), [camera], 0) for frame in range(6)])


def test_moving_lamps_do_not_flicker(moving_references) -> None:
    """6 frames, 100 rows in all, 100 columns. Expected: as for a camera that moves."""
    camera = mi.load_dict(sensor(0))
    errors = frames_of(moving_scene, [camera] * 6, 100, 100) - moving_references
    alone = [prt.render_many_lights(moving_scene(k), 100, 100, sensor=camera, **FEW).image for k in range(6)]
    others = np.array(alone) - moving_references
    flicker, beside = (np.linalg.norm(np.diff(e, axis=0)) for e in (errors, others))
    print(f"flicker {flicker / beside:.2f} of {beside / np.linalg.norm(moving_references[1:]):.2%}")
    print(f"errors {np.linalg.norm(errors) / np.linalg.norm(others):.2f} of those of pictures")
    assert flicker < beside / 3
    assert np.linalg.norm(errors) < 1.5 * np.linalg.norm(others)


def test_a_callable_of_one_scene_is_that_scene(scene, cameras) -> None:
    """Expected: bit by bit."""
    found = frames_of(lambda _: scene, cameras[:3], 10, 20)
    assert np.array_equal(found, frames_of(scene, cameras[:3], 10, 20))


@pytest.mark.slow
def test_moving_frames_are_right_on_average() -> None:
    """30 seeds of frames 0, 3 and 6, few rows. Expected: on average all lights, within 4 standard errors."""
    camera, apart = [mi.load_dict(sensor(0, 12))], []
    for seed in range(30):
        found = frames_of(lambda k: moving_scene(3 * k), camera * 3, 20, 60, seed=seed)
        whole = np.concatenate([all_lights(moving_scene(3 * k), camera, seed) for k in range(3)])
        apart.append(found.mean(axis=(1, 2)) / whole.mean(axis=(1, 2)) - 1)
    error = np.std(apart, axis=0, ddof=1) / np.sqrt(len(apart))
    print("z", np.abs(np.mean(apart, axis=0) / error).max(), "error", error.max())
    assert np.all(error < 0.005)  # so that 2% are seen
    assert np.all(np.abs(np.mean(apart, axis=0)) < 4 * error)


def test_other_emitters_are_refused() -> None:
    def other(frame: int) -> mi.Scene:
        return mi.load_dict({name: one for name, one in room().items() if not frame or name != "lamp2"})

    found = prt.render_many_lights_frames(other, [0, 0], 4, 8, **FEW)
    with pytest.raises(PrtError, match="frame 1 has the emitters lamp, sky, and frame 0 lamp, lamp2, sky"):
        next(found)


def test_another_order_of_emitters_is_refused() -> None:
    """Files that are loaded in parallel have one now and then."""

    def other(frame: int) -> mi.Scene:
        names = sorted(room(), reverse=bool(frame))
        return mi.load_dict({name: room()[name] for name in names}, parallel=False, optimize=False)

    found = prt.render_many_lights_frames(other, [0, 0], 4, 8, **FEW)
    with pytest.raises(PrtError, match="frame 1 has its emitters in another order than frame 0"):
        next(found)


def test_lights_of_a_frame_are_counted() -> None:
    """Expected: of the lamp that is dark in the first frame, none there, and some later."""
    found = list(prt.render_many_lights_frames(moving_scene, [0, 0], 4, 8, **FEW))
    counts = [frame.report["lights"]["emitters"]["lamp2"] for frame in found]
    assert counts[0] == {"direct": 0, "indirect": 0}
    assert counts[1]["direct"] > 0 and counts[1]["indirect"] > 0


def test_a_sun_that_rises_does_not_change_the_sky(cameras) -> None:
    """A sky's directions are as many in all frames, though its sun takes others out of them.

    Expected: what is told of emitters has the same number of lights, but for those that the sun covers.
    """

    def morning(frame: int) -> mi.Scene:
        sky = {"type": "sunsky", "sun_direction": [1, 0.3 + 0.1 * frame, 0.5], "sun_scale": 0.01}
        return mi.load_dict(room() | {"sky": sky})

    counts = mean_counts([count_lights(morning(k), LightOptions(2000)) for k in range(3)])
    found = [scene_lights(morning(k), LightOptions(2000), counts) for k in range(3)]
    sky = [set(one.identity[one.arrays.kind.numpy() == DIRECTION]) for one in found]
    assert len(sky[0] & sky[1] & sky[2]) > 0.95 * max(map(len, sky))
    assert len(list(prt.render_many_lights_frames(morning, [0, 0], 4, 8, **FEW))) == 2


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"seconds": 3}, "give these, and not seconds"),
        ({"error": 0.1}, "give these, and not error"),
        ({"sensors": []}, "there are no sensors"),
        ({"rows": 0}, "rows is 0"),
        ({"colour": 1}, "unexpected keyword argument 'colour'"),
        ({"sensors": [3]}, "no sensor 3"),
    ],
)
def test_what_frames_cannot_have(scene, options: dict, message: str) -> None:
    """Expected: an error when it is asked for, not with the first frame."""
    sensors = options.pop("sensors", [0])
    with pytest.raises(PrtError, match=message):
        prt.render_many_lights_frames(scene, sensors, **options)
