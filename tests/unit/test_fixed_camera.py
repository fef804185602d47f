"""Pictures of a camera that stands still, against renders of the same light, which share only the scene with them."""

import mitsuba as mi
import numpy as np
import pytest
from conftest import COLOURS, T, build, diffuse, still_life

import mi_sparse_prt as prt
from mi_sparse_prt.relighting.film import film_images
from mi_sparse_prt.relighting.fixed_camera import _collected

pytestmark = pytest.mark.usefixtures("never_held_out")

LIGHTING = prt.CubemapLighting(4)
ENVIRONMENT = prt.Environment(np.random.default_rng(3).random((8, 16, 3), np.float32) ** 3)
ROUGH = {"type": "roughconductor", "alpha": 0.4, "material": "Cu"}


def sensor(rfilter: str = "box", size: tuple = (24, 18), **film: object) -> mi.Sensor:
    """Looks at the still life, and over the end of its ground."""
    return mi.load_dict(
        {
            "type": "perspective",
            "fov": 50,
            "to_world": T().look_at(origin=[0.5, 1.6, 3], target=[0, 0.4, 0], up=[0, 1, 0]),
            "film": {
                "type": "hdrfilm",
                "width": size[0],
                "height": size[1],
                "rfilter": {"type": rfilter},
                **film,
            },
        }
    )


def matrix(scene: prt.Scene) -> prt.LightTransport:
    return prt.precompute(scene, LIGHTING, method="brute_force", spp=4, max_depth=2, progress=False)


def light_of(transport: prt.LightTransport, light: object = ENVIRONMENT) -> np.ndarray:
    return transport.incident.relight(transport.emission.project(light))


@pytest.fixture(scope="module")
def coloured(coloured_scene) -> tuple[prt.Scene, prt.LightTransport]:
    return coloured_scene, matrix(coloured_scene)


def assert_same_pictures(
    scene: prt.Scene, transport: prt.LightTransport, camera: mi.Sensor, kept: tuple = (), spp: int = 16
) -> None:
    """Means over eight seeds are those of as many renders, within their standard errors, in pixels and altogether."""
    seeds, kept = range(8), kept or (slice(None), slice(None))
    incident = light_of(transport)
    ours = np.stack(
        [prt.FixedCamera(scene, transport, camera, spp, k).image(incident, ENVIRONMENT)[kept] for k in seeds]
    )
    theirs = np.stack([prt.render(scene, transport, ENVIRONMENT, camera, 4 * spp, k)[kept] for k in seeds])
    variance = (ours.var(axis=0, ddof=1) + theirs.var(axis=0, ddof=1)) / len(seeds)
    away = ours.mean(axis=0) - theirs.mean(axis=0)
    # of eight, variances are uncertain: those of neighbours are alike, and 1e-4 is rounding
    sigma = np.sqrt(variance + variance.mean()) + 1e-4 * theirs.mean()
    z = away / sigma
    assert np.sqrt((z**2).mean()) < 1.2
    assert np.abs(z).max() < 6
    error = abs(away.mean()) / theirs.mean()
    expected = np.sqrt(variance.mean() / away.size) / theirs.mean()
    print(f"rms z {np.sqrt((z**2).mean()):.2f}, mean off by {error:.2%}, expected {expected:.2%}")
    assert error < 5 * expected + 1e-4 < 0.01


@pytest.mark.parametrize("rfilter", ["box", "gaussian", "mitchell"])
def test_pictures_are_those_of_render(coloured, rfilter):
    """Mitsuba looks for no samples beyond the edge of a film, where wide filters would have some."""
    kept = () if rfilter == "box" else (slice(2, -2), slice(2, -2))
    assert_same_pictures(*coloured, sensor(rfilter), kept)


def test_a_crop_window_is_seen_alone(coloured):
    film = {"crop_offset_x": 5, "crop_offset_y": 3, "crop_width": 12, "crop_height": 10}
    whole, part = (prt.FixedCamera(*coloured, sensor(**f), spp=64) for f in ({}, film))
    assert part.size == (10, 12)
    incident = light_of(coloured[1])
    a, b = (camera.image(incident, ENVIRONMENT) for camera in (whole, part))
    np.testing.assert_allclose(b.mean(), a[3:13, 5:17].mean(), rtol=0.02)
    assert_same_pictures(*coloured, sensor(**film))


def test_textures_are_seen_at_pixels():
    texture = {"type": "checkerboard", "to_uv": mi.ScalarTransform3f().scale([7, 7])}
    ground = {
        "type": "rectangle",
        "to_world": T().rotate([1, 0, 0], -90).scale(1.5),
        "bsdf": {"type": "diffuse", "reflectance": texture},
    }
    scene = build(ground=ground)
    assert_same_pictures(scene, matrix(scene), sensor())


def test_glossy_terms_are_seen_from_the_camera():
    shapes = still_life(COLOURS)
    shapes["box"]["bsdf"] = ROUGH
    scene = build(**shapes)
    transport = prt.precompute_glossy(scene, LIGHTING, terms=2, progress=False)
    assert transport.terms == 2
    assert_same_pictures(scene, transport, sensor())


def test_a_closed_room_has_no_background():
    scene = build(
        room={"type": "cube", "flip_normals": True, "to_world": T().scale(6), "bsdf": diffuse(0.5, 0.5, 0.5)}
    )
    transport = matrix(scene)
    camera = prt.FixedCamera(scene, transport, sensor(), spp=4)
    lit = np.random.default_rng(0).random((scene.n_vertices, 3), np.float32)
    np.testing.assert_array_equal(camera.image(lit, ENVIRONMENT), camera.image(lit))
    assert camera.image(lit).min() > 0


def test_pictures_are_linear_and_constant_light_fills_them(coloured):
    scene, transport = coloured
    camera = prt.FixedCamera(scene, transport, sensor(), spp=9)
    a, b = np.random.default_rng(1).random((2, *light_of(transport).shape), np.float32)
    np.testing.assert_allclose(camera.image(2 * a - b), 2 * camera.image(a) - camera.image(b), atol=2e-6)
    shapes = still_life(((1.0,) * 3,) * 3)
    del shapes["ball"]  # at its silhouette, smooth normals turn away from the camera
    grey = build(**shapes)
    ones = np.ones((grey.n_vertices, 3), np.float32)
    filled = prt.FixedCamera(grey, matrix(grey), sensor(), spp=9).image(
        ones, np.ones((LIGHTING.n_directions, 3))
    )
    np.testing.assert_allclose(filled, 1, atol=1e-5)


def test_the_same_seed_gives_the_same_picture_however_many_lines_are_done_at_a_time(coloured, monkeypatch):
    incident = light_of(coloured[1])
    first = prt.FixedCamera(*coloured, sensor(), spp=4, seed=1).image(incident, ENVIRONMENT)
    monkeypatch.setattr("mi_sparse_prt.relighting.fixed_camera.SAMPLES_PER_BLOCK", 1)
    again = prt.FixedCamera(*coloured, sensor(), spp=4, seed=1).image(incident, ENVIRONMENT)
    np.testing.assert_allclose(again, first, rtol=1e-6)
    other = prt.FixedCamera(*coloured, sensor(), spp=4, seed=2).image(incident, ENVIRONMENT)
    assert np.abs(other - first).max() > 0.01


def test_moving_light_is_seen_by_pixels(coloured):
    scene, transport = coloured
    compressed = prt.compress(transport, progress=False)
    relighter, camera = (
        prt.Relighter(compressed, budget=5),
        prt.FixedCamera(scene, compressed, sensor(), spp=4),
    )
    for degrees in (0, 10):
        relighter.follow(ENVIRONMENT.rotated(degrees))
    for _ in range(40):
        relighter.follow(ENVIRONMENT.rotated(10))
    expected = camera.image(light_of(compressed, ENVIRONMENT.rotated(10)))
    np.testing.assert_allclose(camera.image(relighter.incident), expected, atol=1e-4 * expected.max())


def test_films_trace_each_picture_where_rays_go_on():
    mirror = {"type": "rectangle", "to_world": T().translate([0, 1, -1.4]), "bsdf": {"type": "conductor"}}
    scene = build(**still_life(), mirror=mirror)
    transport, camera = matrix(scene), sensor()
    with pytest.raises(prt.PrtError, match="mirrors.*: use render"):
        prt.FixedCamera(scene, transport, camera)
    lights = [ENVIRONMENT, ENVIRONMENT.rotated(90)]
    for image, light in zip(film_images(scene, transport, lights, camera, 4), lights, strict=True):
        np.testing.assert_array_equal(image, prt.render(scene, transport, light, camera, 4))


def test_refusals(coloured, grey_scene):
    scene, transport = coloured
    with pytest.raises(prt.PrtError, match="0 samples per pixel"):
        prt.FixedCamera(scene, transport, sensor(), spp=0)
    with pytest.raises(prt.PrtError, match="another scene"):
        prt.FixedCamera(build(0.3, **still_life()), transport, sensor())
    camera = prt.FixedCamera(scene, transport, sensor(), spp=1)
    with pytest.raises(prt.PrtError, match=r"light has the shape \(3, 3\)"):
        camera.image(np.ones((3, 3), np.float32))
    with pytest.raises(prt.PrtError, match="sensor"):
        prt.FixedCamera(scene, transport, 0)


@pytest.mark.parametrize("terms", [0, 3])
def test_shares_are_summed_for_each_pixel_and_row(terms):
    """Expected: the sums of a loop over all of them, but for rounding; rows that vertices lack are left out."""
    rng, n_v, n_pixels, spp = np.random.default_rng(terms), 40, 30, 16
    vertices = rng.integers(0, n_v, (3, n_pixels * spp)).astype(np.uint32)
    lit = rng.random(n_pixels * spp) < 0.7
    values = rng.random((3, 1 + terms, 3, n_pixels * spp), np.float32)
    scale = rng.random((n_pixels * spp, 3), np.float32)
    rows = np.arange((1 + terms) * n_v).reshape(1 + terms, n_v)
    rows[1:, ::2] = -1
    known = np.zeros((n_pixels, rows.size, 3))
    for corner, term, i in np.ndindex(3, 1 + terms, n_pixels * spp):
        row = rows[term, vertices[corner, i]]
        if lit[i] and row >= 0:
            known[i // spp, row] += values[corner, term, :, i] * scale[i]
    starts, places, found = _collected(vertices, lit, values, scale, rows, spp)
    ours = np.zeros_like(known)
    ours[np.repeat(np.arange(n_pixels), np.diff(starts)), places] = found
    np.testing.assert_allclose(ours, known, rtol=1e-5)
    assert len(places) == np.count_nonzero(known.any(axis=2))
