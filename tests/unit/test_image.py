"""The relit scene as a camera sees it: interpolated irradiance times the albedo at the pixel."""

import mitsuba as mi
import numpy as np
import pytest
from conftest import GREY, T, build, diffuse, still_life

import mi_sparse_prt as prt
from mi_sparse_prt.relighting.followed_rays import surfaces_to_follow
from mi_sparse_prt.relighting.image import RelitIntegrator, RelitScene, background_emitter, render
from mi_sparse_prt.scene.mitsuba_meshes import lit_scene
from mi_sparse_prt.scene.scene import Scene

LIGHTING = prt.CubemapLighting(2)


def camera(
    size: int = 32, origin: tuple = (0, 1, 0), target: tuple = (0, 0, 0), up: tuple = (0, 0, -1)
) -> dict:
    """Looks down on the square [-1, 1]^2 of the ground, +x to the right, -z upwards, one pixel of slack."""
    film = {
        "type": "hdrfilm",
        "width": size,
        "height": size,
        "rfilter": {"type": "box"},
        "pixel_format": "rgb",
    }
    view = T().look_at(origin=list(origin), target=list(target), up=list(up))
    if origin != (0, 1, 0):
        return {"type": "perspective", "fov": 45, "to_world": view, "film": film}
    return {
        "type": "orthographic",
        "to_world": view @ T().scale([-1, 1, 1]) @ T().scale([-1, 1, 1]),
        "film": film,
    }


def ground(bsdf: dict, **parameters: object) -> dict:
    return {"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90), "bsdf": bsdf, **parameters}


def looked_at(
    scene: prt.Scene, irradiance: np.ndarray, x: np.ndarray, z: np.ndarray, up: bool = True
) -> np.ndarray:
    """Radiance (m, 3) at ground points, seen straight from above (or from below)."""
    relit = RelitScene(scene, irradiance[None].astype(np.float32), None)
    y, d = (1.0, -1.0) if up else (-1.0, 1.0)
    ray = mi.Ray3f(
        mi.Point3f(mi.Float(x.astype(np.float32)), y, mi.Float(z.astype(np.float32))), mi.Vector3f(0, d, 0)
    )
    return relit.radiance(ray, mi.load_dict({"type": "independent"}), mi.Mask(True))[0].numpy().T


def test_irradiance_is_interpolated_and_albedo_applied():
    scene = build(0.5, ground=ground(diffuse(0.2, 0.4, 0.8)))
    rng = np.random.default_rng(0)
    x, z = rng.uniform(-0.95, 0.95, (2, 500))
    # linear over the plane: interpolation over triangles reproduces it
    irradiance = scene.positions @ np.array([[1.0, 0, 2], [5, 5, 5], [0, 3, -1]]) + 4
    expected = np.stack([x + 4, 3 * z + 4, 2 * x - z + 4], axis=-1) * [0.2, 0.4, 0.8]
    np.testing.assert_allclose(looked_at(scene, irradiance, x, z), expected, rtol=1e-5)


def test_each_triangle_has_the_values_of_its_own_corners(grey_scene):
    """All meshes of a scene at once: a hit's value lies between those of the corners of the triangle it hits."""
    values = np.random.default_rng(1).random((grey_scene.n_vertices, 3)) + 1
    rng = np.random.default_rng(2)
    origins, targets = rng.normal(size=(2, 4000, 3))
    origins *= 5 / np.linalg.norm(origins, axis=1, keepdims=True)
    origins[:, 1] = np.abs(origins[:, 1])
    targets = 0.3 * targets + [0, 0.5, 0]
    ray = mi.Ray3f(mi.Point3f(origins.T), mi.Vector3f((targets - origins).T))
    relit = RelitScene(grey_scene, values[None].astype(np.float32), None)
    seen, valid = (
        a.numpy() for a in relit.radiance(ray, mi.load_dict({"type": "independent"}), mi.Mask(True))
    )
    si = grey_scene.mitsuba.ray_intersect(ray)
    front = valid & (mi.Frame3f.cos_theta(si.wi).numpy() > 0)
    checked = 0
    for mesh, shape, albedo in zip(
        grey_scene.meshes, grey_scene.mitsuba.shapes(), (0.5, 0.6, 0.7), strict=True
    ):
        hit = front & (si.shape == mi.ShapePtr(shape)).numpy()
        corners = values[mesh.triangles[si.prim_index.numpy()[hit]] + mesh.vertices.start]
        inner = seen.T[hit] / albedo
        assert (inner > corners.min(axis=1) - 1e-5).all()
        assert (inner < corners.max(axis=1) + 1e-5).all()
        checked += hit.sum()
        assert hit.sum() > 50
    assert (seen.T[~front] == 0).all()


def test_textures_show_at_pixel_resolution():
    """A checkerboard of 64 squares on a plane of two triangles: no vertex knows it, every pixel does."""
    checker = {"type": "checkerboard", "color0": 0.1, "color1": 0.9, "to_uv": T().scale([16, 16, 1])}
    scene = build(float("inf"), ground=ground({"type": "diffuse", "reflectance": checker}))
    assert scene.n_vertices == 4
    centres = (np.arange(32) + 0.5) / 16 - 1
    x, z = (a.ravel() for a in np.meshgrid(centres, centres))
    seen = looked_at(scene, np.full((4, 3), 2.0), x, z)[:, 0].reshape(32, 32)
    np.testing.assert_allclose(np.unique(np.round(seen, 5)), [0.2, 1.8])
    assert (seen[:, 1:] != seen[:, :-1]).all()
    assert (seen[1:] != seen[:-1]).all()


def test_the_back_of_a_surface_is_black():
    x = z = np.zeros(1)
    scene = build(0.5, ground=ground(diffuse(0.5, 0.5, 0.5)))
    irradiance = np.ones((scene.n_vertices, 3))
    assert looked_at(scene, irradiance, x, z).tolist() == [[0.5, 0.5, 0.5]]
    assert looked_at(scene, irradiance, x, z, up=False).tolist() == [[0, 0, 0]]


@pytest.fixture(scope="module")
def scene() -> prt.Scene:
    shapes = still_life(GREY)
    shapes["camera"] = camera(24, (2, 2.5, 4), (0, 0.4, 0), (0, 1, 0))
    shapes["narrow"] = camera(8, (2, 2.5, 4), (0, 0.4, 0), (0, 1, 0))
    return build(**shapes)


@pytest.fixture(scope="module")
def transport(scene: prt.Scene) -> prt.LightTransport:
    return prt.precompute(scene, LIGHTING, method="brute_force", max_depth=2, progress=False)


def test_an_image_is_the_relit_vertices(scene, transport):
    """Constant light of three colours: every surface pixel is irradiance times albedo, so channels keep their ratio."""
    image = render(scene, transport, [1, 2, 4], spp=4)
    assert image.shape == (24, 24, 3)
    assert image.dtype == np.float32
    np.testing.assert_allclose(image, image[..., :1] * [1, 2, 4], rtol=1e-5)
    assert image.max() <= 4.001
    assert (image[..., 0] < 0.95).mean() > 0.2  # surfaces
    assert (image[0, 0] == [1, 2, 4]).all()  # background


def test_relighting_images_is_linear(scene, transport):
    L1, L2 = np.random.default_rng(0).random((2, 24, 3), dtype=np.float32)
    a, b, both = (render(scene, transport, L, spp=4, seed=3) for L in (L1, L2, L1 + 2 * L2))
    np.testing.assert_allclose(both, a + 2 * b, rtol=1e-4, atol=1e-5)


@pytest.mark.filterwarnings("error::mi_sparse_prt.core.errors.PrtWarning")
def test_kinds_of_lighting(scene, transport):
    """Texels, an Environment and an emitter that say the same give the same picture."""
    n = LIGHTING.resolution
    texels = np.full((6 * n * n, 3), 2, np.float32)
    by_texels = render(scene, transport, texels, spp=4)
    environment = prt.Environment(np.full((16, 32, 3), 2, np.float32))
    for light in (environment, environment.rotated(77), mi.load_dict({"type": "constant", "radiance": 2.0})):
        np.testing.assert_allclose(render(scene, transport, light, spp=4), by_texels, rtol=1e-4)


def test_the_background_turns_with_the_environment(scene, transport):
    """The sky at the top of the image: bright where the environment is, also when rotated."""
    pixels = np.full((16, 32, 3), 0.1, np.float32)
    pixels[:, 16:] = 3  # the half of x < 0 (u = atan2(x, -z) / 2 pi)
    environment = prt.Environment(pixels)
    backdrop = [render(scene, transport, environment.rotated(angle), spp=4)[0, :, 0] for angle in (0, 180)]
    assert backdrop[0].max() - backdrop[0].min() > 1 or abs(backdrop[0].mean() - backdrop[1].mean()) > 1
    np.testing.assert_allclose(backdrop[0] + backdrop[1], 3.1, atol=0.3)


def test_sensors(scene, transport):
    assert render(scene, transport, 1.0, sensor=1, spp=1).shape == (8, 8, 3)
    assert render(scene, transport, 1.0, sensor=-2, spp=1).shape == (24, 24, 3)
    own = mi.load_dict(camera(5, (2, 2.5, 4), (0, 0.4, 0), (0, 1, 0)))
    assert render(scene, transport, 1.0, sensor=own, spp=1).shape == (5, 5, 3)
    for wrong in (2, -3):
        with pytest.raises(prt.PrtError, match="2 sensors"):
            render(scene, transport, 1.0, sensor=wrong)


def test_a_matrix_of_another_scene_is_refused(transport, coloured_scene):
    with pytest.raises(prt.PrtError, match="another scene"):
        render(coloured_scene, transport, 1.0, sensor=mi.load_dict(camera()))


def test_rows_are_put_into_the_scenes_order(scene, transport):
    """The same scene with its shapes the other way round shows the same picture."""
    shapes = dict(reversed(list(still_life(GREY).items())))
    shapes["camera"] = camera(24, (2, 2.5, 4), (0, 0.4, 0), (0, 1, 0))
    other = build(**shapes)
    assert [m.name for m in other.meshes] == ["box", "ball", "ground"]
    L = np.random.default_rng(0).random((24, 3), dtype=np.float32)
    np.testing.assert_allclose(
        render(other, transport, L, spp=4), render(scene, transport, L, spp=4), rtol=1e-4, atol=1e-6
    )


@pytest.mark.filterwarnings("ignore::mi_sparse_prt.core.errors.PrtWarning")
def images_of_sky(scene: Scene, depth: int, of_path: bool, seeds: int = 8) -> np.ndarray:
    """Images (seeds, height, width, 3) of a scene of black and followed surfaces under a coloured sky."""
    texels = np.random.default_rng(3).uniform(0.2, 1, (24, 3)).astype(np.float32)
    sky = background_emitter(texels, prt.CubemapLighting(2))
    if of_path:
        integrator, where = (
            mi.load_dict({"type": "path", "max_depth": depth}),
            lit_scene(scene.unlit_shapes(), sky),
        )
    else:
        dark, followed = np.zeros((1, scene.n_vertices, 3), np.float32), surfaces_to_follow(scene)
        integrator, where = (
            RelitIntegrator(RelitScene(scene, dark, sky, None, depth, followed)),
            scene.mitsuba,
        )
    runs = [
        mi.render(where, sensor=scene.sensor(0), integrator=integrator, spp=256, seed=k) for k in range(seeds)
    ]
    return np.array([np.array(run)[..., :3] for run in runs], np.float64)


def check_against_path(scene: Scene, depth: int) -> None:
    """Each pixel within noise (Student's t of 8 runs each), and the mean within noise and 1%."""

    def z(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        error = np.sqrt((a.var(axis=0, ddof=1) + b.var(axis=0, ddof=1)) / len(a))
        return (a.mean(axis=0) - b.mean(axis=0)) / np.maximum(error, 1e-4 * b.mean())

    ours, theirs = images_of_sky(scene, depth, False), images_of_sky(scene, depth, True)
    every, total = z(ours, theirs), z(ours.mean(axis=(1, 2)), theirs.mean(axis=(1, 2)))
    print(depth, np.abs(every).max(), total, ours.mean() / theirs.mean())
    assert np.abs(every).max() < 8
    assert np.abs(total).max() < 4.5
    assert ours.mean() / theirs.mean() == pytest.approx(1, abs=0.01)


def test_rays_go_on_through_mirrors_and_glass():
    """Rationale: nothing here is diffuse, so that a camera sees the sky alone, mirrored, refracted and let through.

    Expected: the images of `path` at the same depth, pixel by pixel within their standard errors, and in the mean,
    where a bias of 2% would be 5 of them; one surface less on the way is another image.
    """
    black = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}
    film = {"type": "hdrfilm", "width": 16, "height": 12, "rfilter": {"type": "box"}}
    view = T().look_at([0, 0.5, 6], [0, 0.3, 0], [0, 1, 0])
    mask = {"type": "mask", "opacity": 0.4, "bsdf": {"type": "twosided", "bsdf": black}}
    scene = build(
        0.5,
        glass={"type": "sphere", "center": [0, 0, 0], "radius": 0.8, "bsdf": {"type": "dielectric"}},
        gold={"type": "sphere", "center": [2, 0, 0], "bsdf": {"type": "conductor", "material": "Au"}},
        plastic={"type": "sphere", "center": [-2, 0, 0], "bsdf": {"type": "plastic", "diffuse_reflectance": 0.0}},
        sheet={"type": "rectangle", "to_world": T().translate([0, 0, 1.2]), "bsdf": mask},
        pane={"type": "rectangle", "to_world": T().translate([0.5, 0, 1.5]), "bsdf": {"type": "thindielectric"}},
        air={"type": "cube", "to_world": T().translate([-1.5, 0, 2]).scale(0.4), "bsdf": {"type": "null"}},
        camera={"type": "perspective", "fov": 50, "to_world": view, "film": film},
    )  # fmt: skip
    for depth in (1, 4):
        check_against_path(scene, depth)
    assert images_of_sky(scene, 2, False).mean() < 0.98 * images_of_sky(scene, 4, False).mean()


def test_glossy_surfaces_without_factors_are_followed():
    """Expected: BSDFs that no factors stand for look as ``path`` shows them, and as it lights them by shadow rays.

    Mirror-like and rough metal, rough glass, a blend and bent normals on four surfaces that see each other.
    """
    waves = mi.Bitmap((0.5 + 0.5 * np.sin(np.arange(32) / 3) * np.ones((32, 1))).astype(np.float32))
    rough = {"type": "roughconductor", "material": "Au", "alpha": 0.3}
    blend = {"type": "blendbsdf", "weight": 0.4, "first": rough, "second": {**rough, "alpha": 0.02}}
    bent = {"type": "bumpmap", "arbitrary": {"type": "bitmap", "bitmap": waves, "raw": True}, "bsdf": rough}
    film = {"type": "hdrfilm", "width": 16, "height": 12, "rfilter": {"type": "box"}}
    view = T().look_at([0, 0.5, 6], [0, 0.3, 0], [0, 1, 0])
    scene = build(
        0.5,
        glass={"type": "sphere", "radius": 0.8, "bsdf": {"type": "roughdielectric", "alpha": 0.2}},
        gold={"type": "sphere", "center": [2, 0, 0], "bsdf": blend},
        sharp={"type": "sphere", "center": [-2, 0, 0], "bsdf": {**rough, "alpha": 0.05}},
        floor={
            "type": "rectangle",
            "to_world": T().translate([0, -1, 0]).rotate([1, 0, 0], -90).scale(3),
            "bsdf": bent,
        },
        camera={"type": "perspective", "fov": 50, "to_world": view, "film": film},
    )
    assert len(surfaces_to_follow(scene)) == 4
    check_against_path(scene, 3)
