"""`validate_glossy`: relit images of glossy surfaces against ``path``, and whether the right cause is blamed."""

import json
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from conftest import T, build, diffuse, without_held_out

import mi_sparse_prt as prt
from mi_sparse_prt.precompute import precompute_glossy
from mi_sparse_prt.transport import LightTransport
from mi_sparse_prt.validation.glossy_images import (
    CAUSES,
    DirectionLights,
    GlossyValidation,
    _References,
    thin_shadows,
    validate_glossy,
)
from mi_sparse_prt.validation.mitsuba_reference import posed

LIGHTING = prt.CubemapLighting(8)
VIEW = T().look_at(origin=[1, 1.5, 3], target=[0, 0.4, 0], up=[0, 1, 0])
BRUSHED = {
    "type": "ashikhmin_shirley",
    "exponent_u": 2.0,
    "exponent_v": 30.0,
    "diffuse_reflectance": {"type": "rgb", "value": 0.2},
    "specular_reflectance": {"type": "rgb", "value": 0.4},
}


def sky() -> np.ndarray:
    """A dim sky with a bright window of 2 x 2 texels on each of three faces (6 n^2, 3)."""
    texels = np.full((6, 8, 8, 3), 0.2, np.float32)
    for face, row, column in ((0, 2, 3), (2, 3, 5), (4, 1, 4)):
        texels[face, row : row + 2, column : column + 2] = (9, 8, 6)
    return texels.reshape(-1, 3)


@pytest.fixture(scope="module")
def scene() -> prt.Scene:
    """A brushed ball over a diffuse ground."""
    film = {"type": "hdrfilm", "width": 40, "height": 30, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    ball = {"type": "sphere", "center": [0, 0.6, 0], "radius": 0.5, "bsdf": BRUSHED}
    ground = {
        "type": "rectangle",
        "to_world": T().rotate([1, 0, 0], -90).scale(2),
        "bsdf": diffuse(0.5, 0.5, 0.5),
    }
    with pytest.warns(prt.PrtWarning):
        return build(
            0.1,
            ball=ball,
            ground=ground,
            sky={"type": "cubemap", "data": mi.TensorXf(sky())},
            camera={"type": "perspective", "fov": 32, "to_world": VIEW, "film": film},
        )


@pytest.fixture(scope="module")
def transport(scene) -> LightTransport:
    with without_held_out():
        return precompute_glossy(scene, LIGHTING, progress=False)


def validated(scene: prt.Scene, transport: LightTransport, **parameters: object) -> GlossyValidation:
    """Of the scene's own camera alone, unless told otherwise."""
    defaults = {"sensors": scene.mitsuba.sensors(), "spp": 256, "width": 40}
    return validate_glossy(scene, transport, **(defaults | parameters))


@pytest.fixture(scope="module")
def good(scene, transport) -> GlossyValidation:
    return validated(scene, transport)


def errors(validation: GlossyValidation, region: str = "image") -> dict[str, float]:
    """Relative L2 of each cause in the one image."""
    (image,) = validation.report["images"]
    return {cause: image[region][cause]["relative_l2"] for cause in CAUSES}


def test_what_is_blamed(good, artefact):
    """
    Rationale: four factors of a brushed lobe are far from it; visibility is exact, vertices are 0.1 apart on a
        ball of radius 0.5, and indirect light is a small share of all, so that transport itself has little to
        get wrong: vertices see shadows of a window half a vertex too early or too late at most.
    Expected: most of the error is the factorization's; transport within 4% (8% on glossy pixels), and noise is not
        what lets it pass.
    """
    artefact(good.figures["scene_0"])
    found = errors(good)
    assert found["transport"] < 0.04
    assert errors(good, "glossy")["transport"] < 0.08
    (image,) = good.report["images"]
    assert image["image"]["transport"]["uncertainty"] < 0.04
    assert image["glossy"]["transport"]["uncertainty"] < 0.08
    assert found["factorization"] > 2 * found["transport"]
    # causes are about independent of each other: squares add up, roughly
    parts = np.linalg.norm([found[cause] for cause in CAUSES if cause != "total"])
    assert 0.5 * parts < found["total"] < 1.5 * parts


def test_light_is_right_in_sum(scene, transport):
    """What an error of some percent in single pixels could hide: that all of them are too bright or too dark.

    Light that leaves the glossy pixels towards the camera, all together, against ``path`` with the same factors and
    lights. Expected: within 0.5% and three standard errors, of independent halves; a gain of 2% would be noticed.
    """
    references = _References(scene, transport, transport.lighting.project(scene.mitsuba.environment()))
    (sensor,) = scene.mitsuba.sensors()
    with posed(sensor, 40, 0, scene.centre):
        glossy = references.regions(sensor, 16, 1)["glossy"]
        ratios = []
        for seed in range(4):
            images = references.rendered(sensor, 512, (7, seed), ["directions"])
            ours, theirs = (
                np.sum([half[glossy].sum() for half in images[k]]) for k in ("ours", "directions")
            )
            ratios.append(ours / theirs)
    error = np.std(ratios, ddof=1) / 2
    print(f"ours / path {np.mean(ratios):.4f} +- {error:.4f}")
    assert error < 0.002
    assert abs(np.mean(ratios) - 1) < 0.005 + 3 * error


def test_another_order_of_shapes(scene, transport, good):
    """The transport of a scene whose shapes came in another order is as good: its rows are moved first."""
    n = len(transport.albedo)
    back = np.roll(np.arange(n), n // 3)
    reflection, measurement = transport.reflection, transport.measurement
    glossy = np.flatnonzero(reflection.material[back] >= 0)
    old = np.searchsorted(reflection.glossy, back[glossy])
    rows = np.concatenate([back, (n + old[:, None] * transport.terms + np.arange(transport.terms)).ravel()])
    moved = replace(
        transport,
        measurement=replace(measurement, keys=measurement.keys[back], areas=measurement.areas[back]),
        reflection=reflection.take(back),
        operators={name: operator.take(rows) for name, operator in transport.operators.items()},
    )
    assert errors(validated(scene, moved)) == pytest.approx(errors(good), rel=1e-3, abs=1e-5)


def test_turned_tangents_are_blamed_on_transport(scene, transport, good):
    """A frame turned by 90 degrees about the normal makes the brushed ball reflect across; the references stay."""
    reflection = transport.reflection
    across = replace(reflection, tangents=np.cross(reflection.normals, reflection.tangents))
    turned = replace(transport, reflection=across)
    found, known = errors(validated(scene, turned), "glossy"), errors(good, "glossy")
    assert found["factorization"] == pytest.approx(known["factorization"], rel=1e-4)
    assert found["lighting"] == pytest.approx(known["lighting"], rel=1e-4, abs=1e-6)
    assert found["transport"] > 3 * known["transport"]
    assert found["transport"] > 0.16  # twice the bound above


@pytest.mark.usefixtures("no_held_out")
def test_wrong_factors_are_blamed_on_factorization(scene, good):
    """One factor instead of four (and direct light only): the references with factors follow, transport is right."""
    found = errors(
        validated(scene, precompute_glossy(scene, LIGHTING, terms=1, max_depth=2, progress=False)), "glossy"
    )
    known = errors(good, "glossy")
    assert found["factorization"] > 1.2 * known["factorization"]
    assert found["transport"] < 0.08


def test_missing_light_is_blamed_on_transport(scene, transport, good):
    """Without indirect light: an image that is a tenth darker at most is noticed."""
    found = errors(validated(scene, replace(transport, operators={"direct": transport.direct})))
    assert errors(good)["transport"] < 0.04  # as above
    assert found["transport"] > 0.06


def test_report_figures_and_files(good, tmp_path):
    report = good.report
    assert json.loads(json.dumps(report)) == report
    (image,) = report["images"]
    assert image["environment"] == "scene"
    assert 0.05 < image["pixels"]["glossy"] < 0.6
    assert 0 < image["pixels"]["thin_shadows"] <= 0.1
    assert 0 < image["noise"]["relative_l2"] < 0.2
    assert report["worst"]["glossy"]["total"] == image["glossy"]["total"]["relative_l2"]
    assert all(0 <= image[region][cause]["flip"] <= 1 for region in report["worst"] for cause in CAUSES)
    good.save(tmp_path / "deep")
    assert {f.name for f in (tmp_path / "deep").iterdir()} == {"report.json", "scene_0.png"}


def test_default_cameras(scene, transport):
    """The scene's own and two turned ones, which see other pictures; the sensor is as it was afterwards."""
    sensor = scene.mitsuba.sensors()[0]
    before = np.array(mi.traverse(sensor)["to_world"].matrix)
    report = validate_glossy(scene, transport, {"even": np.ones(3)}, spp=32, width=40).report
    np.testing.assert_array_equal(np.array(mi.traverse(sensor)["to_world"].matrix), before)
    assert tuple(sensor.film().crop_size()) == (40, 30)
    places = [(image["environment"], image["camera"]["turned"]) for image in report["images"]]
    assert places == [("even", turn) for turn in (0, 60, -60)]
    # a ball in the middle of a square: as large from everywhere, what is behind it is not the same
    sizes = [image["pixels"]["glossy"] for image in report["images"]]
    assert np.ptp(sizes) < 0.2 * max(sizes)


def test_what_cannot_be_validated(scene, transport):
    with pytest.warns(prt.PrtWarning):
        bare = build(0.5, ball={"type": "sphere", "bsdf": {"type": "phong"}})
    with pytest.raises(prt.PrtError, match="another scene"):
        validate_glossy(bare, transport)
    own = precompute_glossy(bare, LIGHTING, 1, max_depth=2, progress=False)
    with pytest.raises(prt.PrtError, match="sensor"):
        validate_glossy(bare, own)
    with pytest.raises(prt.PrtError, match="environment"):
        validate_glossy(bare, own, sensors=scene.mitsuba.sensors())
    with pytest.raises(prt.PrtError, match="spp"):
        validate_glossy(scene, transport, spp=1)


# ------------------------------------------------------------------------------------ its parts


def test_direction_lights():
    """
    Scenario: a diffuse plane alone, under one directional light at each texel's centre.
    Expected: sum_j L_j omega_j max(n . d_j, 0) rho / pi. (Texels, in contrast, have all of their directions.)
    """
    lighting = prt.CubemapLighting(2)
    radiance = np.random.default_rng(0).random((24, 3), np.float32) ** 4
    parameters = mi.Properties("cubemap")
    parameters["data"] = mi.TensorXf(radiance)
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
    view = T().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0])
    scene = mi.load_dict(
        {
            "type": "scene",
            "lights": DirectionLights(parameters),
            "plane": {"type": "rectangle", "bsdf": diffuse(0.5, 0.5, 0.5)},
            "camera": {"type": "perspective", "fov": 1, "to_world": view, "film": film},
        }
    )
    image = np.array(mi.render(scene, integrator=mi.load_dict({"type": "path"}), spp=4096))[..., :3]
    cosine = np.maximum(lighting.directions[:, 2], 0) * lighting.solid_angles
    known = 0.5 / np.pi * cosine @ radiance
    error = image.std(axis=(0, 1)) / 8
    assert (error < 0.005 * known).all()
    assert (np.abs(image.mean(axis=(0, 1)) - known) < 4 * error).all()


def test_thin_shadows():
    """A dark line on a plane is found; an edge between shapes and a bend are not."""
    shape = np.zeros((60, 80), int)
    shape[:, 40:] = 1
    normal = np.zeros((60, 80, 3))
    normal[..., 1] = 1
    normal[:30, 20:40] = (1, 0, 0)
    lit = np.ones((60, 80))
    lit[45, :40] = 0.5  # the line
    lit[:, 40:] = 0.7
    lit[:30, 20:40] = 0.2
    found = thin_shadows(lit, shape, normal)
    assert found[44, 5:15].all() and found[46, 5:15].all()
    assert not found[:, 38:42].any() and not found[:, 18:22][:28].any() and not found[28:32, 22:38].any()
    assert not thin_shadows(np.ones((60, 80)), shape, normal).any()
    assert not thin_shadows(lit, np.full((60, 80), -1), normal).any()
