"""The `cubemap` emitter inside Mitsuba's own integrators."""

from pathlib import Path

import drjit as dr
import mitsuba as mi
import mitsuba.chi2
import numpy as np
import pytest

import mi_sparse_prt as prt

T = mi.ScalarTransform4f
ARTEFACTS = Path(__file__).parents[1] / "artefacts"
ENVMAPS = Path(__file__).parents[2] / "scenes_xml" / "envmaps"


def uneven_texels(n: int = 4) -> np.ndarray:
    """(6, n, n, 3) radiance with a dark face, a strong texel and dark rows: everything a sampler may trip over."""
    texels = np.random.default_rng(1).random((6, n, n, 3), dtype=np.float32)
    texels[0] = 0
    texels[2, 1, 2] = 20
    texels[4, 2:] = 0
    texels[5, 0, 1] = [0, 0, 3]
    return texels


def camera(origin: list, target: list, size: int = 16, scale: float = 1.0) -> dict:
    view = T().look_at(origin=np.multiply(origin, scale), target=np.multiply(target, scale), up=[0, 1, 0])
    film = {
        "type": "hdrfilm",
        "width": size,
        "height": size,
        "rfilter": {"type": "box"},
        "pixel_format": "rgb",
    }
    clip = {"near_clip": 1e-3 * scale, "far_clip": 1e3 * scale}
    return {"type": "perspective", "fov": 40, "to_world": view, "film": film, **clip}


def ball_on_ground(emitter: dict, size: int = 16) -> mi.Scene:
    return mi.load_dict(
        {
            "type": "scene",
            "light": emitter,
            "ball": {"type": "sphere", "center": [0, 0.5, 0], "radius": 0.5},
            "ground": {"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90).scale(3)},
            "sensor": camera([0, 1.5, 3], [0, 0.3, 0], size),
        }
    )


def mean_and_error(
    scene: mi.Scene, integrator: str, spp: int, **parameters: object
) -> tuple[np.ndarray, np.ndarray]:
    """Image mean (rgb) and its standard error, from 16 independent renders."""
    integrator = mi.load_dict({"type": integrator, **parameters})
    runs = [
        np.array(mi.render(scene, integrator=integrator, spp=spp, seed=k)).mean(axis=(0, 1))
        for k in range(16)
    ]
    return np.mean(runs, axis=0), np.std(runs, axis=0, ddof=1) / 4


def assert_same(a: tuple, b: tuple) -> None:
    """Two estimates agree within three standard errors, and a bias of 2% would have been seen."""
    error = np.hypot(a[1], b[1])
    assert (3 * error < 0.01 * b[0]).all()
    assert (np.abs(a[0] - b[0]) < 3 * error + 1e-6 * b[0]).all()


@pytest.mark.parametrize(
    ("parameters", "samples"),
    [
        ({"data": mi.TensorXf(uneven_texels())}, 1_000_000),
        ({"radiance": 2.0, "resolution": 8}, 1_000_000),
        ({"texel": 21, "resolution": 4}, 100_000),
        ({"texel": 0, "resolution": 4}, 100_000),
    ],
    ids=["uneven", "constant", "texel inside a face", "texel at a cube corner"],
)
def test_chi_square(parameters, samples):
    """Rationale: `sample_direction` and `pdf_direction` describe the same density.

    Pearson's chi-square test of `mitsuba.chi2` on a sphere of directions. The density jumps at texel borders, so
    each cell's integral takes 32 x 32 points (the usual 4 reject a correct sampler); they leave about 0.2% on a
    single texel, which bounds the number of samples there.

    Expected: not rejected at the 1% level (fixed seed). A density without the conversion from face area to solid
    angle is off by up to a factor of 5.2 and is rejected.
    """
    emitter = mi.load_dict({"type": "cubemap", **parameters})
    it = dr.zeros(mi.Interaction3f)

    def density(direction: mi.Vector3f) -> mi.Float:
        ds = dr.zeros(mi.DirectionSample3f)
        ds.d = direction
        return emitter.pdf_direction(it, ds)

    test = mitsuba.chi2.ChiSquareTest(
        domain=mitsuba.chi2.SphericalDomain(),
        sample_func=lambda u: emitter.sample_direction(it, u)[0].d,
        pdf_func=density,
        sample_dim=2,
        sample_count=samples,
        res=101,
        ires=32,
    )
    assert test.run(), test.messages


def test_samples_agree_with_the_other_methods():
    """Rationale: integrators combine samples with `pdf_direction`, `eval_direction` and `eval` (MIS).

    Expected: all of them agree at sampled directions but for the few that rounding moves over a texel's border
    (under 1e-5), and the sample weights average to the exact integral of the radiance.
    """
    emitter = mi.load_dict({"type": "cubemap", "data": mi.TensorXf(uneven_texels()), "scale": 2.0})
    count = 1_000_000
    rng = mi.PCG32(count)
    it = dr.zeros(mi.Interaction3f)
    it.p = mi.Point3f(3, -50, 7)
    ds, weight = emitter.sample_direction(it, mi.Point2f(rng.next_float32(), rng.next_float32()))
    value = weight.numpy() * ds.pdf.numpy()
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wi = -ds.d
    assert np.mean(~np.isclose(emitter.pdf_direction(it, ds).numpy(), ds.pdf.numpy(), rtol=1e-4)) < 1e-5
    assert np.mean(~np.isclose(emitter.eval_direction(it, ds).numpy(), value, rtol=1e-4).all(axis=0)) < 1e-5
    assert np.mean(~np.isclose(emitter.eval(si).numpy(), value, rtol=1e-4).all(axis=0)) < 1e-5
    assert dr.all(ds.pdf > 0)
    assert dr.all(dr.abs(dr.norm(ds.d) - 1) < 1e-6)

    exact = 2 * np.einsum("jc,j->c", uneven_texels().reshape(-1, 3), prt.CubemapLighting(4).solid_angles)
    error = weight.numpy().std(axis=1) / np.sqrt(count)
    assert (np.abs(weight.numpy().mean(axis=1) - exact) < 4 * error).all()
    assert (4 * error < 0.01 * exact).all()


@pytest.mark.parametrize(
    ("integrator", "parameters"),
    [
        ("path", {"max_depth": 3}),
        ("direct", {}),
        ("direct", {"bsdf_samples": 0}),
        ("volpath", {"max_depth": 3}),
    ],
)
def test_furnace(integrator, parameters):
    """Rationale: a convex white body in uniform light of radiance 1 is invisible.

    Expected: the image, body and background alike, is 1; the mean over pixels within three standard errors, and
    within 0.5%.
    """
    scene = mi.load_dict(
        {
            "type": "scene",
            "light": {"type": "cubemap", "radiance": 1.0, "resolution": 8},
            "ball": {
                "type": "sphere",
                "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 1.0}},
            },
            "sensor": camera([0, 0, 4], [0, 0, 0]),
        }
    )
    mean, error = mean_and_error(scene, integrator, 64, **parameters)
    assert (np.abs(mean - 1) < 3 * error + 1e-6).all()
    assert (3 * error < 0.005).all()


@pytest.mark.parametrize("integrator", ["path", "direct", "volpath"])
def test_equals_constant(integrator):
    """Rationale: uniform texels are Mitsuba's own `constant` emitter, reflections and shadows included.

    Expected: equal image means within three standard errors, which are below a third of a percent.
    """
    colour = {"type": "rgb", "value": [1, 0.5, 0.25]}
    ours = ball_on_ground({"type": "cubemap", "radiance": colour, "resolution": 8})
    theirs = ball_on_ground({"type": "constant", "radiance": colour})
    assert_same(mean_and_error(ours, integrator, 64), mean_and_error(theirs, integrator, 64))


def test_equals_envmap_of_the_same_texels():
    """Rationale: face order, orientation and projection at once, against Mitsuba's `envmap` in `path`.

    `studio.exr` (lamps 3730 times brighter than the walls), turned by 40 degrees, projected to 6 x 16 x 16. The
    reference shows the very same texels as an equirectangular image of 2048 x 1024 pixels, on which the bilinear
    interpolation of `envmap` hardly matters.

    Expected: image means equal within three standard errors plus what the resampling changes in the light's energy;
    each pixel within five of its own standard errors. Left behind: `cubemap_emitter_envmap.png`, both renders.
    """
    lighting = prt.CubemapLighting(16)
    texels = lighting.project(prt.load_environment(ENVMAPS / "studio.exr").rotated(40))
    theta, phi = (
        np.pi * (np.arange(1024) / 1023),
        2 * np.pi * (np.arange(2048) + 0.5) / 2048,
    )  # rows as in envmap
    sine, cosine = np.sin(theta)[:, None], np.cos(theta)[:, None] + 0 * phi
    directions = np.stack([sine * np.sin(phi), cosine, -sine * np.cos(phi)], axis=-1).reshape(-1, 3)
    image = texels[lighting.texel_of(directions)].reshape(1024, 2048, 3)

    ours = ball_on_ground({"type": "cubemap", "data": mi.TensorXf(texels)}, size=24)
    theirs = ball_on_ground({"type": "envmap", "bitmap": mi.Bitmap(image)}, size=24)
    path = mi.load_dict({"type": "path", "max_depth": 4, "hide_emitters": True})
    runs = [
        [np.array(mi.render(s, integrator=path, spp=64, seed=k)) for k in range(16)] for s in (ours, theirs)
    ]
    images = np.mean(runs, axis=1)  # [which, row, col, rgb]
    errors = np.std(runs, axis=1, ddof=1) / 4

    ARTEFACTS.mkdir(exist_ok=True)
    side_by_side = np.concatenate(list(images), axis=1).astype(np.float32)
    mi.util.write_bitmap(str(ARTEFACTS / "cubemap_emitter_envmap.png"), side_by_side)

    mean, mean_error = images.mean(axis=(1, 2)), np.std(np.mean(runs, axis=(2, 3)), axis=1, ddof=1) / 4
    assert (np.abs(mean[0] - mean[1]) < 3 * np.hypot(*mean_error) + 0.002 * mean[1]).all()
    assert (3 * np.hypot(*mean_error) < 0.01 * mean[1]).all()
    deviation = np.abs(images[0] - images[1]) / (np.hypot(*errors) + 0.002 * images[1] + 1e-6)
    assert np.mean(deviation < 5) > 0.995
    assert np.sqrt(np.mean(deviation**2)) < 1.5  # a face in the wrong place gives tens


def test_single_texel_on_an_open_plane():
    """Rationale: `texel` makes a basis light of radiance 1 whose irradiance has a quadrature.

    An infinite-looking ground of albedo 0.5 under one texel at a time, `direct`.

    Expected: radiance 0.5 / pi times the integral of the cosine over the texel, within three standard errors and
    these below a third of a percent; texels under the horizon give exactly 0.
    """
    lighting = prt.CubemapLighting(4)
    directions, weights = lighting.subdirections(32)
    irradiance = (np.maximum(directions[..., 1], 0) * weights).sum(axis=1)
    scene = mi.load_dict(
        {
            "type": "scene",
            "light": {"type": "cubemap", "texel": 0, "resolution": 4},
            "ground": {"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90).scale(100)},
            "sensor": camera([0, 3, 0.1], [0, 0, 0]),
        }
    )
    parameters = mi.traverse(scene)
    for texel in (1, 21, 32, 37, 47, 62, 69):
        parameters["light.texel"] = texel
        parameters.update()
        mean, error = mean_and_error(scene, "direct", 32)
        expected = 0.5 / np.pi * irradiance[texel]
        assert (np.abs(mean - expected) <= 3 * error + 1e-4 * expected).all(), texel
        assert (3 * error <= 0.01 * expected).all(), texel
    assert irradiance[62] == 0


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_no_light_leaks_through_a_ceiling(scale):
    """Rationale: an emitter that guesses the scene's extent ends its shadow rays below distant ceilings.

    A hall 200 units wide and 60 high, closed, seen from near its floor's middle; then the same without its ceiling.

    Expected: less than 1e-4 when closed, more than 0.1 when open, at any scale. On a GPU, OptiX lets a few rays slip
        between the floor and the walls of a hall of 200,000 units: there this holds for the mean of the picture.
    """
    walls = T().scale(scale).translate([0, 30, 0]).scale([100, 30, 100])
    hall = {
        "type": "scene",
        "light": {"type": "cubemap", "radiance": 1.0, "resolution": 4},
        "sensor": camera([0, 1, 2], [0, 0, 0], scale=scale),
        "floor": {"type": "rectangle", "to_world": walls @ T().translate([0, -1, 0]).rotate([1, 0, 0], -90)},
    }
    path = mi.load_dict({"type": "path", "max_depth": 4})
    lit = np.array(mi.render(mi.load_dict(hall), integrator=path, spp=64))
    dark = np.array(
        mi.render(mi.load_dict(hall | {"hall": {"type": "cube", "to_world": walls}}), integrator=path, spp=64)
    )
    assert lit.min() > 0.1
    assert (dark.max() if mi.variant().startswith("llvm") else dark.mean()) < 1e-4


def test_texels_and_data_change_without_compilation():
    """Rationale: a matrix has thousands of columns; its reference renders may not compile a kernel for each.

    Expected: after the first render, kernels are those already seen; the light follows `texel` and `data`.
    """
    scene = ball_on_ground({"type": "cubemap", "data": mi.TensorXf(uneven_texels(8)), "texel": 150})
    parameters = mi.traverse(scene)
    path = mi.load_dict({"type": "path", "max_depth": 3})

    def kernels_and_mean() -> tuple[set, float]:
        dr.kernel_history_clear()
        mean = float(np.array(mi.render(scene, integrator=path, spp=16)).mean())
        history = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
        return {k["hash"] for k in history}, mean

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        first, _ = kernels_and_mean()
        assert first
        means = []
        for texel in (149, 130, -1, 200):
            parameters["light.texel"] = texel
            parameters.update()
            kernels, mean = kernels_and_mean()
            assert kernels <= first
            means.append(mean)
        assert means[2] > 10 * means[0] > 0
        assert means[3] == 0  # below the ground
        parameters["light.texel"] = -1
        parameters["light.data"] = mi.TensorXf(np.full((6, 8, 8, 3), 1, np.float32))
        parameters.update()
        kernels, mean = kernels_and_mean()
        assert kernels <= first
        assert mean == pytest.approx(0.6, abs=0.05)


def test_xml_with_an_image(tmp_path):
    """Rationale: the XML of the manual page, found beside the scene, turned by `to_world`.

    Expected: the texels of the Python projection of the same file, exactly.
    """
    mi.Bitmap(np.random.default_rng(0).random((16, 32, 3), dtype=np.float32)).write(str(tmp_path / "sky.exr"))
    (tmp_path / "scene.xml").write_text(
        """<scene version="3.0.0"><emitter type="cubemap">
            <string name="filename" value="sky.exr"/>
            <integer name="resolution" value="8"/>
            <float name="scale" value="3"/>
            <transform name="to_world"><rotate y="1" angle="30"/></transform>
        </emitter></scene>"""
    )
    scene = mi.load_file(str(tmp_path / "scene.xml"))
    lighting = prt.CubemapLighting(8)
    expected = 3 * lighting.project(prt.load_environment(tmp_path / "sky.exr").rotated(30))
    np.testing.assert_allclose(lighting.project(scene.environment()), expected, rtol=1e-5)
    assert scene.environment() is scene.emitters()[0]


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({}, "give exactly one of filename, data and radiance .* not none"),
        ({"radiance": 1.0, "filename": "x.exr"}, "exactly one of .* not filename and radiance"),
        ({"radiance": 1.0, "brightness": 2.0}, "unreferenced property"),
        ({"radiance": 1.0, "resolution": 12}, "12 is not a power of two"),
        ({"radiance": 1.0, "texel": 6144}, r"texel 6144 is not one of 0 ... 6143"),
        ({"radiance": 1.0, "to_world": T().rotate([0, 1, 0], 30)}, "to_world turns the image"),
        ({"radiance": float("nan")}, "NaN"),
        ({"filename": "nowhere.exr"}, "nowhere.exr: no such file"),
        ({"data": mi.TensorXf(np.ones((6, 4, 4)))}, r"shape \(6, 4, 4\)"),
        ({"data": mi.TensorXf(np.ones((6, 4, 4, 3))), "resolution": 8}, r"shape \(6, 4, 4, 3\)"),
    ],
)
def test_bad_parameters(parameters, message):
    """Rationale: a typing error in a scene file must not render something else.

    Expected: Mitsuba's loading error with one line of ours, or its own for unknown parameters.
    """
    with pytest.raises(RuntimeError, match=message):
        mi.load_dict({"type": "scene", "light": {"type": "cubemap", **parameters}})


def test_bad_changes():
    """Rationale: the exposed parameters are checked like the loaded ones. Expected: `PrtError`."""
    emitter = mi.load_dict({"type": "cubemap", "radiance": 1.0, "resolution": 4})
    for key, value, message in (
        ("texel", 96, "texel 96 is not one of 0 ... 95"),
        ("data", mi.TensorXf(np.ones((6, 8, 8, 3))), "changed its shape"),
        ("data", mi.TensorXf(np.full((6, 4, 4, 3), np.inf)), "NaN or infinite"),
    ):
        parameters = mi.traverse(emitter)
        before = parameters[key]
        keep = type(before)(before)
        parameters[key] = value
        with pytest.raises(prt.PrtError, match=message):
            parameters.update()
        parameters[key] = keep
        parameters.update()
