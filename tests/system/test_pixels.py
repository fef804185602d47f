"""Rows at the pixels of a camera: textures at full resolution, no interpolation between vertices."""

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest

import mi_sparse_prt as prt
from mi_sparse_prt.core.metrics import relative_l2_without_noise

DEPTH = 4
SIZE = 40, 32  # width, height
T = mi.ScalarTransform4f


def ball_on_ground(chequered: bool = True) -> prt.Scene:
    """A ball on a ground, whose squares are about as small as its triangles."""
    squares = {
        "type": "checkerboard",
        "color0": {"type": "rgb", "value": [0.8, 0.2, 0.1]},
        "color1": {"type": "rgb", "value": [0.2, 0.3, 0.8]},
        "to_uv": T().scale([12, 12, 1]),
    }
    return prt.Scene.from_mitsuba(
        mi.load_dict(
            {
                "type": "scene",
                "ground": {
                    "type": "rectangle",
                    "to_world": T().rotate([1, 0, 0], -90).scale(1.5),
                    "bsdf": {"type": "diffuse", "reflectance": squares if chequered else 0.5},
                },
                "ball": {
                    "type": "sphere",
                    "center": [0, 0.5, 0],
                    "radius": 0.5,
                    "bsdf": {"type": "diffuse", "reflectance": 0.6},
                },
                "camera": {
                    "type": "perspective",
                    "fov": 45,
                    "to_world": T().look_at([0, 1.6, 2.6], [0, 0.3, 0], [0, 1, 0]),
                    "film": {
                        "type": "hdrfilm",
                        "width": SIZE[0],
                        "height": SIZE[1],
                        "rfilter": {"type": "gaussian"},
                    },
                },
            },
            optimize=False,
        ),
        0.1,
    )


@pytest.fixture(scope="module")
def scene() -> prt.Scene:
    return ball_on_ground()


@pytest.fixture(scope="module")
def pixels(scene):
    return prt.camera_pixels(scene, spp=16)


@pytest.fixture(scope="module")
def lighting() -> prt.CubemapLighting:
    return prt.CubemapLighting(8)


@pytest.fixture(scope="module")
def light(lighting) -> np.ndarray:
    """Smooth, brighter above, coloured."""
    up = lighting.directions[:, 1:2]
    return (0.6 + 0.5 * up + 0.1 * lighting.directions * [1, 0, -1]).clip(0).astype(np.float32)


@pytest.fixture(scope="module")
def transport(scene, pixels, lighting) -> prt.LightTransport:
    return prt.precompute(scene, lighting, measurement=pixels, basis="texel", max_depth=DEPTH, progress=False)


def test_an_image_is_mitsubas(scene, transport, light, artefact):
    """Rationale: pixels x cubemap, against ``path`` under the same texels, with the camera's own filter.

    Expected: no bias (mean within 1%), and a few per cent of error: texel edges, finite elements, 16 points a pixel.
    Results: both images, as an artefact.
    """
    import matplotlib.pyplot as plt

    image = prt.render(scene, transport, light, spp=16)
    assert image.shape == (SIZE[1], SIZE[0], 3)
    path = mi.load_dict({"type": "path", "max_depth": DEPTH})
    with transport.emission.scene_lit_by(light, scene) as lit:
        x, y = (
            np.array(mi.render(lit, sensor=scene.sensor(0), integrator=path, spp=256, seed=seed))[..., :3]
            for seed in (1, 2)
        )
    figure, axes = plt.subplots(1, 2)
    for axis, shown in zip(axes, (image, (x + y) / 2), strict=True):
        axis.imshow(np.clip(shown, 0, 1) ** (1 / 2.2))
    artefact(figure)
    assert image.mean() == pytest.approx((x.mean() + y.mean()) / 2, rel=0.01)
    assert relative_l2_without_noise(image, x, y)[0] < 0.05


def test_validation_renders_whole_columns(scene, transport):
    """Expected: the error is about what the matrix says of its points, and what 16 points a pixel cost; 5% show."""

    def report(matrix: prt.LightTransport) -> dict:
        return prt.validate(scene, matrix, n_columns=12, spp=1024, progress=False, image=False).report

    good = report(transport)
    total = good["relative_l2"]["total"]
    assert transport.report["estimated_error"]["total"] / 2 < total < 0.06
    assert good["parameters"]["rows"] == SIZE[0] * SIZE[1]
    assert "hit_against_vertex" not in good
    albedo = np.float32(1.05) * transport.albedo
    brighter = report(replace(transport, reflection=replace(transport.reflection, albedo=albedo)))
    assert brighter["relative_l2"]["total"] == pytest.approx(np.hypot(total, 0.05), rel=0.2)
    away = mi.load_dict({"type": "perspective", "film": {"type": "hdrfilm"}})
    with pytest.raises(prt.PrtError, match="pixels of another camera"):
        prt.validate(scene, transport, sensor=away, progress=False)


def test_rows_columns_products_and_files_are_one_matrix(transport, light, tmp_path):
    some = [0, 5, 700, SIZE[0] * SIZE[1] - 1]
    assert transport.shape == (SIZE[0] * SIZE[1], 384, 3)
    relit = transport.relight(light)
    assert np.allclose(np.einsum("ijc,jc->ic", transport.rows(some), light), relit[some], atol=1e-5)
    columns = transport.columns([3, 100])
    assert np.allclose(columns[some], transport.rows(some)[:, [3, 100]], atol=1e-6)
    rng = np.random.default_rng(0)
    x, y = (rng.normal(size=(n, 3, 2)).astype(np.float32) for n in transport.shape[1::-1])
    forth, back = transport.apply(x), transport.T.apply(y)
    gap = abs(float((forth * y).sum(dtype=np.float64) - (back * x).sum(dtype=np.float64)))
    assert gap <= 1e-5 * np.linalg.norm(y) * np.linalg.norm(forth)
    transport.save(tmp_path / "a.prt")
    loaded = prt.load_transport(tmp_path / "a.prt")
    assert np.array_equal(loaded.relight(light), relit)
    assert loaded.measurement.image == (SIZE[1], SIZE[0])
    with pytest.raises(prt.PrtError, match="load_transport"):
        _ = loaded.measurement.points


def test_finite_elements_and_paths_agree(lighting, light):
    """The indirect part of pixels by two solvers that share nothing but the points.

    Without squares: finite elements know reflectances at vertices, and squares as small as triangles alias there.
    """
    scene = ball_on_ground(chequered=False)
    pixels = prt.camera_pixels(scene, spp=4)  # the same points for both
    asked = {"max_depth": DEPTH, "measurement": pixels, "progress": False}
    ours = prt.precompute(scene, lighting, "auto", **asked).operators["indirect"].relight(light)
    paths = prt.precompute(scene, lighting, "brute_force", spp=2, **asked)
    assert ours.mean() == pytest.approx(paths.operators["indirect"].relight(light).mean(), rel=0.02)


def test_the_estimate_is_of_the_points(transport):
    error = transport.report["estimated_error"]
    assert 0.005 < error["total"] < 0.06
    assert list(error["meshes"]) == ["pixels"]


def test_weights_are_the_films(scene, pixels):
    """A white furnace: each pixel that sees nothing but surfaces has weights that sum to 1."""
    sums = np.asarray(pixels.weights.sum(axis=1)).reshape(SIZE[1], SIZE[0])
    assert sums.max() <= 1 + 1e-5
    assert np.isclose(sums[-6:, 15:25], 1, atol=1e-5).all()
    world = pixels.points.positions
    on_ball = np.abs(np.linalg.norm(world - [0, 0.5, 0], axis=1) - 0.5) < 5e-3
    on_ground = np.abs(world[:, 1]) < 1e-3
    assert (on_ball | on_ground).all()


def test_bad_measurements_are_one_line(scene, pixels, lighting, transport):
    other = prt.Scene.from_mitsuba(
        mi.load_dict({"type": "scene", "a": {"type": "rectangle", "bsdf": {"type": "diffuse"}}}), 0.5
    )
    with pytest.raises(prt.PrtError, match="of another scene"):
        prt.precompute(other, lighting, measurement=pixels, progress=False)
    with pytest.raises(prt.PrtError, match="'sparse'.*vertices of meshes"):
        prt.precompute(scene, lighting, "sparse", measurement=pixels, progress=False)
    with pytest.raises(prt.PrtError, match="there is no number 3"):
        prt.camera_pixels(scene, 3)
    with pytest.raises(prt.PrtError, match="spp is 0"):
        prt.camera_pixels(scene, spp=0)
    away = mi.load_dict(
        {
            "type": "perspective",
            "to_world": T().look_at([0, 5, 0], [0, 9, 0], [1, 0, 0]),
            "film": {"type": "hdrfilm"},
        }
    )
    with pytest.raises(prt.PrtError, match="sees no surface that reflects"):
        prt.camera_pixels(scene, away, spp=1)
    with pytest.raises(prt.PrtError, match="pixels of another camera"):
        prt.render(scene, transport, 1.0, away)
