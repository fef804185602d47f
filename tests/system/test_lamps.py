"""The scene's own emitters as columns: what Mitsuba's ``path`` renders with them, one at a time and all together."""

import json
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from conftest import build, still_life
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation
from typer.testing import CliRunner

import mi_sparse_prt as prt
from mi_sparse_prt.cli import app
from mi_sparse_prt.core.metrics import relative_l2_without_noise
from mi_sparse_prt.measurement.vertices import sensor_points
from mi_sparse_prt.operators.dense import Dense
from mi_sparse_prt.validation.mitsuba_reference import path_image

DEPTH = 4
T = mi.ScalarTransform4f


def room(lit: tuple[str, ...] = ("lamp", "bulb", "beam", "sky")) -> mi.Scene:
    """Three walls, a floor and a ball under an area light, a point, a spot and a constant sky, those that are lit."""

    def wall(axis: list[float], angle: float, place: list[float], colour: list[float]) -> dict:
        return {
            "type": "rectangle",
            "to_world": T().translate(place).rotate(axis, angle),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": colour}},
        }

    lamp = {
        "type": "rectangle",
        "to_world": T().translate([0, 0.9, 0]).rotate([1, 0, 0], 90).scale(0.3),
        "bsdf": {"type": "diffuse", "reflectance": 0.2},
    }
    if "lamp" in lit:
        lamp["emitter"] = {"type": "area", "radiance": {"type": "rgb", "value": [8, 7, 5]}}
    others = {
        "bulb": {
            "type": "point",
            "position": [-0.5, 0.2, 0.3],
            "intensity": {"type": "rgb", "value": [0.2, 0.3, 1.0]},
        },
        "beam": {
            "type": "spot",
            "to_world": T().look_at([0.5, 0.9, 0.8], [0.2, -0.6, 0], [0, 1, 0]),
            "intensity": {"type": "rgb", "value": [1, 0.3, 0.3]},
        },
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.1, 0.1, 0.12]}},
    }
    camera = {
        "type": "perspective",
        "fov": 40,
        "to_world": T().look_at([0, 0, 3.5], [0, 0, 0], [0, 1, 0]),
        "film": {"type": "hdrfilm", "width": 32, "height": 32},
    }
    return mi.load_dict(
        {
            "type": "scene",
            "floor": wall([1, 0, 0], -90, [0, -1, 0], [0.7, 0.7, 0.7]),
            "back": wall([1, 0, 0], 0, [0, 0, -1], [0.7, 0.7, 0.7]),
            "left": wall([0, 1, 0], 90, [-1, 0, 0], [0.7, 0.1, 0.1]),
            "right": wall([0, 1, 0], -90, [1, 0, 0], [0.1, 0.6, 0.1]),
            "ball": {
                "type": "sphere",
                "center": [0.2, -0.6, 0],
                "radius": 0.4,
                "bsdf": {"type": "diffuse", "reflectance": 0.5},
            },
            "panel": lamp,
            **{name: emitter for name, emitter in others.items() if name in lit},
            "camera": camera,
        },
        optimize=False,
    )


@pytest.fixture(scope="module")
def scene() -> prt.Scene:
    return prt.Scene.from_mitsuba(room(), 0.12)


@pytest.fixture(scope="module")
def lamps(scene) -> prt.SceneEmitters:
    return prt.SceneEmitters(scene)


@pytest.fixture(scope="module")
def transport(scene, lamps) -> prt.LightTransport:
    return prt.precompute(scene, lamps, max_depth=DEPTH, progress=False)


def rendered_at_vertices(scene: prt.Scene, spp: int = 256) -> tuple[NDArray, NDArray]:
    """Radiance (n_v, 3) of all vertices by Mitsuba's ``path``, twice; emitters on surfaces do not count themselves."""
    sensor = mi.load_dict({"type": "mesh_vertices", "vertices": scene.n_vertices})
    sensor.bind(scene.mitsuba)
    path = mi.load_dict({"type": "path", "max_depth": DEPTH})
    halves = [
        sensor.radiance(mi.render(scene.mitsuba, sensor=sensor, integrator=path, spp=spp, seed=seed))
        for seed in (1, 2)
    ]
    for mesh, shape in zip(scene.meshes, scene.mitsuba.shapes(), strict=True):
        if shape.is_emitter():
            for half in halves:
                half[mesh.vertices] -= [8, 7, 5]
    return halves[0], halves[1]


def test_all_lamps_together_are_what_mitsuba_renders(scene, transport):
    """Rationale: the sum of the columns is the scene as authored.

    Expected: on every mesh no bias (the mean within 1%), and an error of a few per cent (finite elements, their
    noise, and Mitsuba's hits beside the vertices).
    """
    x, y = rendered_at_vertices(scene)
    ours = transport.relight(1.0)
    for mesh in scene.meshes:
        own = mesh.vertices
        assert ours[own].mean() == pytest.approx((x[own].mean() + y[own].mean()) / 2, rel=0.01), mesh.name
        assert relative_l2_without_noise(ours[own], x[own], y[own])[0] < 0.05, mesh.name


@pytest.mark.parametrize("name", [pytest.param("panel", marks=pytest.mark.slow), "beam"])
def test_a_column_is_the_scene_with_one_lamp(scene, transport, name):
    """Rationale: ``columns`` are the one-light-at-a-time images that people ask Mitsuba for."""
    lit = "lamp" if name == "panel" else name
    alone = prt.Scene.from_mitsuba(room((lit,)), 0.12)
    x, y = rendered_at_vertices(alone)
    column = transport.columns([transport.lights.index(name)])[:, 0]
    assert np.allclose(column, transport.relight({name: 1.0}), atol=1e-6 * column.max())
    assert column.mean() == pytest.approx((x.mean() + y.mean()) / 2, rel=0.01)
    assert relative_l2_without_noise(column, x, y)[0] < 0.05


def test_a_lamp_close_to_a_surface_lights_it():
    """Rationale: shadow rays end before the lamp, however near it is. Truth: the form factor of a square above a point.

    A square of 0.2 x 0.2, 0.1 above a floor of 2 x 2.
    """
    floor = {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": 1.0}}
    lamp = {
        "type": "rectangle",
        "to_world": T().translate([0, 0, 0.1]).rotate([1, 0, 0], 180).scale(0.1),
        "emitter": {"type": "area", "radiance": 1.0},
    }
    lit = mi.load_dict({"type": "scene", "floor": floor, "lamp": lamp}, optimize=False)
    scene = prt.Scene.from_mitsuba(lit, 0.5)
    light = prt.precompute(scene, prt.SceneEmitters(scene), max_depth=2, progress=False).relight(1.0)
    below = np.flatnonzero((np.abs(scene.positions) < 1e-5).all(axis=1))
    assert len(below) == 1
    truth = 4 / np.pi * np.arctan(np.sqrt(0.5)) * np.sqrt(0.5)
    np.testing.assert_allclose(light[below[0]], truth, rtol=0.01)


def test_validation_sees_what_is_wrong_with_lamps(scene, transport):
    """Rationale: `validate` renders each lamp alone; all rows of a few hundred vertices.

    Expected: the error is that of finite elements (a few per cent); 5% too much light of one lamp, or two lamps that
    changed places, are seen, and in the lamp that they are of.
    """

    def report(matrix: prt.LightTransport) -> dict:
        return prt.validate(scene, matrix, n_rows=240, spp=256, progress=False, image=False).report

    good = report(transport)
    total = good["relative_l2"]["total"]
    assert 0 < total < 0.05
    assert good["hit_against_vertex"] < 0.05
    names = transport.emission.names
    factors = np.ones((4, 1), np.float32)
    factors[names.index("beam")] = 1.3

    def changed(order: list[int]) -> prt.LightTransport:
        operators = {k: Dense((o.values * factors)[:, order]) for k, o in transport.operators.items()}
        return replace(transport, operators=operators)

    brighter = report(changed([0, 1, 2, 3]))
    assert names[brighter["column_worst"]["lamp"]] == "beam"
    assert brighter["column_worst"]["relative_l2"] == pytest.approx(0.3, rel=0.1)
    factors[:] = 1.02
    assert report(changed([0, 1, 2, 3]))["relative_l2"]["total"] == pytest.approx(
        np.hypot(total, 0.02), rel=0.25
    )
    assert report(changed([1, 0, 2, 3]))["relative_l2"]["total"] > 0.5


def test_a_picture_of_all_lamps_is_validated(scene, transport, tmp_path):
    validation = prt.validate(
        scene, transport, n_rows=24, spp=64, image_width=32, image_spp=128, progress=False
    )
    assert validation.report["image"]["relative_l2"] < 0.05
    validation.save(tmp_path)
    assert (tmp_path / "image.png").exists()


@pytest.mark.usefixtures("no_held_out")
def test_lamps_are_dimmed_coloured_and_grouped(scene, transport):
    red = transport.relight({"panel": [2, 0, 0], "sky": 0.5})
    panel, sky = (transport.emission.names.index(name) for name in ("panel", "sky"))
    columns = transport.columns([panel, sky])
    assert np.allclose(red, columns[:, 0] * [2, 0, 0] + 0.5 * columns[:, 1], atol=1e-6 * columns.max())
    groups = prt.SceneEmitters(scene, {"small": ["bulb", "beam"], "wide": ["panel", "sky"]})
    pairs = prt.precompute(scene, groups, max_depth=2, progress=False)
    single = prt.precompute(scene, transport.emission, max_depth=2, progress=False)
    wanted = single.relight({"panel": 1.0, "sky": 1.0})
    # half of the rays for each of two lamps: noise, of which the mean has little
    assert pairs.relight({"wide": 1.0}).mean() == pytest.approx(wanted.mean(), rel=0.01)
    assert pairs.relight({"small": 1.0}).mean() == pytest.approx(
        single.relight({"bulb": 1.0, "beam": 1.0}).mean(), rel=0.01
    )


@pytest.mark.slow  # their indirect light: tests/unit/test_unit_lamps.py
def test_paths_and_finite_elements_agree(scene, lamps, transport):
    paths = prt.precompute(scene, lamps, "brute_force", max_depth=DEPTH, spp=16, progress=False)
    ours, theirs = transport.columns(range(4)), paths.columns(range(4))
    for column in range(4):
        assert ours[:, column].mean() == pytest.approx(theirs[:, column].mean(), rel=0.01)
    # the estimates of both are of the whole matrix, independently
    difference = np.linalg.norm(ours - theirs) / np.linalg.norm(theirs)
    errors = [t.report["estimated_error"]["total"] for t in (transport, paths)]
    assert difference < 1.2 * np.hypot(*errors) + 0.01


def test_a_picture_at_its_pixels(scene, lamps, artefact):
    """Rationale: lamps x pixels, both other than the papers'. Results: the image beside Mitsuba's, as an artefact."""
    import matplotlib.pyplot as plt

    pixels = prt.camera_pixels(scene, spp=16)
    transport = prt.precompute(scene, lamps, measurement=pixels, max_depth=DEPTH, progress=False)
    image = prt.render(scene, transport, 1.0, spp=16)
    path = mi.load_dict({"type": "path", "max_depth": DEPTH})
    x, y = (
        np.array(mi.render(scene.mitsuba, integrator=path, spp=256, seed=seed))[..., :3] for seed in (1, 2)
    )
    figure, axes = plt.subplots(1, 2)
    for axis, shown in zip(axes, (image, (x + y) / 2), strict=True):
        axis.imshow(np.clip(shown, 0, 1) ** (1 / 2.2))
    artefact(figure)
    # without the edge of the lamp itself: few samples of something bright, in both
    dim = ~binary_dilation(x.max(axis=2) > 2, iterations=3)
    assert image[dim].mean() == pytest.approx(x[dim].mean(), rel=0.01)
    assert relative_l2_without_noise(image[dim], x[dim], y[dim])[0] < 0.04


def test_direct_light_alone_at_pixels(scene, lamps):
    """Expected: that of a matrix with indirect light."""
    pixels = prt.camera_pixels(scene, spp=1)
    direct, whole = (
        prt.precompute(scene, lamps, measurement=pixels, max_depth=depth, progress=False)
        for depth in (2, DEPTH)
    )
    assert "indirect" not in direct.operators
    ids = np.arange(0, len(pixels.points), 37)
    light = direct.operators["direct"].rows(ids)
    assert light.any()
    assert np.array_equal(light, whole.operators["direct"].rows(ids))


BALLS = {
    "mirror": {"type": "conductor"},
    "glass": {"type": "dielectric"},
    "rough glass": {"type": "roughdielectric", "alpha": 0.2},
    "mask": {"type": "mask", "opacity": 0.4, "bsdf": {"type": "diffuse", "reflectance": 0.3}},
}


PANEL = {
    "type": "rectangle",
    "to_world": T().translate([0, 2, 0]).rotate([1, 0, 0], 90).scale(0.6),
    "emitter": {"type": "area", "radiance": 5.0},
}
LIGHT = [1.0, 3.0]  # of a lamp, and of the sky


def with_ball(bsdf: dict, lamp: dict, target: list, fov: float, size: tuple[int, int], edge_length: float):
    """The still life and a ball under a lamp and a sky, seen from above."""
    return build(
        edge_length,
        **still_life(),
        sphere={"type": "sphere", "center": [0.2, 0.5, 1.0], "radius": 0.35, "bsdf": bsdf},
        lamp=lamp,
        sky={"type": "constant", "radiance": 0.2},
        camera={
            "type": "perspective",
            "fov": fov,
            "to_world": T().look_at([1.2, 1.9, 3.2], target, [0, 1, 0]),
            "film": {"type": "hdrfilm", "width": size[0], "height": size[1], "rfilter": {"type": "box"}},
        },
    )


def assert_means_are_those_of_path(
    scene, transport, parts: dict[str, tuple], spp: int, seeds: int, light=LIGHT, noisy: float = 0.0025
) -> None:
    """Of parts of the picture, within three standard errors, each below a share, and 1.25%."""
    depth = transport.max_depth
    ours = np.array([prt.render(scene, transport, light, 0, 256, seed) for seed in range(seeds)])
    with transport.emission.scene_lit_by(light, scene) as lit:
        found = np.array([path_image(lit, scene.sensor(0), depth, spp, seed) for seed in range(seeds)])
    for name, part in parts.items():
        means = [x[:, *part].mean(axis=(1, 2, 3), dtype=np.float64) for x in (ours, found)]
        noise = np.hypot(*(np.std(x, ddof=1) for x in means)) / np.sqrt(seeds)
        mean, known = (x.mean() for x in means)
        print(f"{name}: {mean / known - 1:+.2%}, noise {noise / known:.3%}")
        assert mean == pytest.approx(known, abs=3 * noise + 0.0125 * known), name
        assert noise < noisy * known, name


@pytest.mark.usefixtures("no_held_out")
@pytest.mark.parametrize(
    "kind",
    ["mask", *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("mirror", "glass", "rough glass"))],
)
def test_a_picture_with_mirrors_glass_and_masks(kind):
    """Rationale: rays that a camera follows look lamps up; surfaces are lit by way of the ball, and through it.

    Expected: the mean of the picture, and of the ground in front of the ball, is that of `path`, within three standard
    errors and 1.25% (interpolation). Paths are long: light of lamps is not told apart by depth.
    """
    scene = with_ball(BALLS[kind], PANEL, [0, 0.5, 0.3], 45, (48, 36), 0.15)
    transport = prt.precompute(scene, prt.SceneEmitters(scene), max_depth=16, progress=False)
    parts = {"all": np.s_[:, :], "ground": np.s_[32:, :]}
    assert_means_are_those_of_path(scene, transport, parts, spp=256, seeds=8)


@pytest.mark.slow
@pytest.mark.usefixtures("no_held_out")
def test_a_picture_of_what_rough_glass_focuses():
    """Rationale: no ray meets a sun; where light of it leaves rough glass, a shadow ray finds it, as in `path`.

    Expected: the mean of the picture, and of what is in the ball's shadow, is that of `path`, within three standard
    errors and 1.25%.
    Result: of 5 seeds 0.24 +- 0.05% more and 0.15 +- 0.15% less; of this one 0.0 +- 0.1% more and
    1.2 +- 0.3% less; without what the glass focuses, 8 and 32% less. Of edges of 0.1 the shadow has 0.9% less, of 0.15
    2.4%: the matrix is linear between vertices, what glass focuses not.
    """
    sun = {"type": "directional", "direction": [0.3, -1, -0.2], "irradiance": 3.0}
    scene = with_ball(BALLS["rough glass"], sun, [0, 0.5, 0.3], 45, (48, 36), 0.07)
    transport = prt.precompute(scene, prt.SceneEmitters(scene), max_depth=16, progress=False)
    parts = {"all": np.s_[:, :], "shadow": np.s_[22:34, 14:40]}
    assert_means_are_those_of_path(scene, transport, parts, spp=1024, seeds=8, light=[1.0, 0.0], noisy=0.005)


def test_the_command_line_tells_what_a_file_of_lamps_holds(transport, tmp_path):
    transport.save(tmp_path / "a.prt")
    result = CliRunner().invoke(app, ["info", str(tmp_path / "a.prt"), "--json", str(tmp_path / "a.json")])
    assert result.exit_code == 0, result.output
    assert "vertices x 4 lamps" in " ".join(result.output.split())
    report = json.loads((tmp_path / "a.json").read_text())
    assert report["parameters"]["method"] == "gather"
    assert report["parameters"]["max_depth"] == DEPTH
    assert report["elements_total"] == 4 * transport.shape[0]


def test_a_file_keeps_lamps_by_name(scene, transport, tmp_path):
    transport.save(tmp_path / "a.prt")
    loaded = prt.load_transport(tmp_path / "a.prt")
    assert loaded.lights == transport.lights
    assert sorted(loaded.lights) == ["beam", "bulb", "panel", "sky"]
    assert np.array_equal(loaded.relight({"beam": 2.0}), transport.relight({"beam": 2.0}))
    with_scene = prt.load_transport(tmp_path / "a.prt", scene)
    images = [prt.render(scene, t, 1.0, spp=4) for t in (with_scene, transport)]
    assert np.allclose(*images, atol=1e-5)  # threads add samples to pixels in any order


@pytest.mark.parametrize(
    ("light", "words"),
    [
        ({"lamp": 1.0}, "there is no lamp 'lamp'; there are: panel"),
        ([1.0, 2.0], "light has shape"),
        ({"beam": np.nan}, "NaN"),
        (object(), "give names with values, such as {'panel': 0.5}"),
    ],
)
def test_bad_light_is_one_line(transport, light, words):
    with pytest.raises(prt.PrtError, match=words) as error:
        transport.relight(light)
    assert "\n" not in str(error.value)


def test_bad_arguments_are_one_line(scene, lamps, transport):
    with pytest.raises(prt.PrtError, match="names the emitter 'sun'; the scene has: "):
        prt.SceneEmitters(scene, {"day": ["sun"]})
    with pytest.raises(prt.PrtError, match="names no emitter"):
        prt.SceneEmitters(scene, {"night": []})
    dark = prt.Scene.from_mitsuba(room(()), 0.5)
    with pytest.raises(prt.PrtError, match="has no emitters"):
        prt.SceneEmitters(dark)
    with pytest.raises(prt.PrtError, match="'sparse' knows no lamps"):
        prt.precompute(scene, lamps, "sparse", progress=False)
    with pytest.raises(prt.PrtError, match="for light from a cubemap"):
        prt.precompute(scene, lamps, terms=4, progress=False)
    with pytest.raises(prt.PrtError, match="small as it is"):
        prt.compress(transport, progress=False)


def test_points_of_a_measurement_are_in_the_world(scene, transport):
    """Sensor hits lie beside the vertices, which are where the rows hold."""
    points = transport.measurement.points
    assert np.allclose(points.positions, scene.positions, atol=2e-3 / scene.scale)
    assert np.allclose(points.normals, scene.normals)
    hits = sensor_points(scene)
    world = hits.positions / scene.scale + scene.centre
    assert np.abs(world - points.positions).max() < 5e-3 / scene.scale
    assert (np.einsum("nd,nd->n", points.ray_offsets, points.normals) > 0).all()


@pytest.mark.usefixtures("no_held_out")
@pytest.mark.parametrize(
    "lamp",
    [
        pytest.param(PANEL, marks=pytest.mark.slow),
        {"type": "point", "position": [-0.3, 2.2, 1.2], "intensity": 6.0},
    ],
    ids=["panel", "point"],
)
def test_glossy_surfaces_show_lamps(lamp):
    """Rationale: no row tells what a golden ball reflects to the camera: its rays go on, to lamps that they can meet by
    chance, and to points that they cannot.

    Expected: the mean of the ball, and of the picture, is that of `path`, within three standard errors and 1.25%.
    """
    gold = {"type": "roughconductor", "alpha": 0.3, "material": "Au"}
    scene = with_ball(gold, lamp, [0.2, 0.5, 1.0], 20, (32, 32), 0.2)
    transport = prt.precompute(scene, prt.SceneEmitters(scene), max_depth=4, progress=False)
    parts = {"all": np.s_[:, :], "ball": np.s_[10:22, 10:22]}
    assert_means_are_those_of_path(scene, transport, parts, spp=256, seeds=4)
