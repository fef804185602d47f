"""The cubemap's geometry against independent formulas, and the exactness of projections onto it."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import mi_sparse_prt as prt
from mi_sparse_prt.emission.equirectangular import pixel_solid_angles

RESOLUTIONS = [1, 2, 8, 32, 64]
TURNS = {"none": np.eye(3), "about up": Rotation.from_euler("y", 33, degrees=True).as_matrix()}
TURNS |= {
    "eighth": Rotation.from_euler("y", 45, degrees=True).as_matrix()
}  # texel edges on pixel edges again
TURNS |= {"pole on a texel edge": Rotation.from_euler("x", 45, degrees=True).as_matrix()}
TURNS |= {"random": Rotation.random(random_state=3).as_matrix()}


def documented_direction(face: int, s: float, t: float) -> np.ndarray:
    """OpenGL's table of cube-map faces, written out."""
    table = [(1, -t, -s), (-1, -t, s), (s, 1, t), (s, -1, -t), (s, -t, 1), (-s, -t, -1)]
    return np.array(table[face]) / np.sqrt(1 + s * s + t * t)


def pixel_of(directions: np.ndarray, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Row and column of an equirectangular image, from Mitsuba's documentation of `envmap`."""
    x, y, z = np.moveaxis(directions, -1, 0)
    u, v = np.arctan2(x, -z) / (2 * np.pi) % 1, np.arccos(np.clip(y, -1, 1)) / np.pi
    return np.minimum((v * height).astype(int), height - 1), np.minimum((u * width).astype(int), width - 1)


def sampled_projection(environment: prt.Environment, lighting: prt.CubemapLighting, s: int) -> np.ndarray:
    """The slow, obvious projection: the mean of the pixels that s x s sub-texels see."""
    directions, weights = lighting.subdirections(s)
    row, col = pixel_of(directions @ environment.rotation, *environment.pixels.shape[:2])
    return np.einsum("jkc,jk->jc", environment.pixels[row, col], weights) / weights.sum(1, keepdims=True)


def random_image(height: int, sun: float = 0.0, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    image = rng.random((height, 2 * height, 3), dtype=np.float32)
    if sun:
        image[rng.integers(height), rng.integers(2 * height)] = sun
    return image


@pytest.mark.parametrize("n", RESOLUTIONS)
def test_solid_angles_sum_to_the_sphere(n):
    assert prt.CubemapLighting(n).solid_angles.sum(dtype=np.float64) == pytest.approx(4 * np.pi, rel=1e-6)


@pytest.mark.parametrize("n", [1, 4, 16])
def test_solid_angles_equal_quadrature(n):
    nodes, weights = np.polynomial.legendre.leggauss(12)
    edges = 2 * np.arange(n + 1) / n - 1
    points = edges[:-1, None] + (nodes + 1) / n  # [texel, node]
    density = (1 + points[:, None, :, None] ** 2 + points[None, :, None, :] ** 2) ** -1.5
    one_face = np.einsum("abij,i,j->ab", density, weights, weights) / n**2
    solid_angles = prt.CubemapLighting(n).solid_angles.reshape(6, n, n)
    np.testing.assert_allclose(solid_angles, np.broadcast_to(one_face, (6, n, n)), rtol=1e-5)


@pytest.mark.parametrize("n", [1, 4, 32])
def test_directions_are_the_documented_texel_centres(n):
    centres = 2 * (np.arange(n) + 0.5) / n - 1
    expected = [documented_direction(f, s, t) for f in range(6) for t in centres for s in centres]
    lighting = prt.CubemapLighting(n)
    assert lighting.directions.dtype == np.float32
    np.testing.assert_allclose(lighting.directions, expected, atol=1e-7)


@pytest.mark.parametrize("n", RESOLUTIONS)
def test_texel_of_inverts_directions(n):
    lighting = prt.CubemapLighting(n)
    texels = lighting.texel_of(7.5 * lighting.directions)  # of any length
    assert texels.dtype == np.int32
    np.testing.assert_array_equal(texels, np.arange(6 * n * n))


def test_subdirections_lie_in_their_texels_and_fill_them():
    lighting = prt.CubemapLighting(8)
    directions, solid_angles = lighting.subdirections(5)
    np.testing.assert_array_equal(
        lighting.texel_of(directions.reshape(-1, 3)), np.repeat(np.arange(lighting.n_directions), 25)
    )
    np.testing.assert_allclose(solid_angles.sum(axis=1), lighting.solid_angles, rtol=1e-6)
    # rows first: along the second half of the index the column's coordinate s grows, on +Z this is x
    on_z = directions.reshape(6, 8, 8, 5, 5, 3)[4, 3, 3]
    assert (np.diff(on_z[..., 0], axis=1) > 0).all()
    assert (np.diff(on_z[..., 1], axis=0) < 0).all()


def test_faces_join_without_gaps():
    """A step across any face edge lands in the neighbouring face's border texel, and back again."""
    n = 8
    lighting = prt.CubemapLighting(n)
    across, home = [], []
    for face in range(6):
        for position in 2 * (np.arange(n) + 0.5) / n - 1:
            for s, t in ((1.01, position), (-1.01, position), (position, 1.01), (position, -1.01)):
                across.append(documented_direction(face, s, t))
                home.append(documented_direction(face, np.clip(s, -0.99, 0.99), np.clip(t, -0.99, 0.99)))
    outside, inside = lighting.texel_of(across), lighting.texel_of(home)
    assert (outside // n**2 != inside // n**2).all()
    cosines = np.einsum("ij,ij->i", lighting.directions[outside], lighting.directions[inside])
    assert np.degrees(np.arccos(cosines.min())) < 90 / n
    pairs = set(zip(inside, outside, strict=True))
    assert pairs == {(b, a) for a, b in pairs}


@pytest.mark.parametrize("resolution", [0, -4, 3, 12, 2.5])
def test_only_powers_of_two(resolution):
    with pytest.raises(prt.PrtError, match="not a power of two"):
        prt.CubemapLighting(resolution)


@pytest.mark.parametrize("turn", TURNS)
@pytest.mark.parametrize(("height", "n"), [(32, 4), (32, 64), (25, 32), (128, 8), (256, 32)])
def test_constant_image_gives_the_constant(height, n, turn):
    environment = prt.Environment(np.full((height, 2 * height, 3), [0.7, 1e-3, 40]), TURNS[turn])
    texels = prt.CubemapLighting(n).project(environment)
    assert texels.dtype == np.float32
    np.testing.assert_allclose(texels, np.broadcast_to([0.7, 1e-3, 40], texels.shape), rtol=1e-6)


@pytest.mark.parametrize("turn", TURNS)
@pytest.mark.parametrize(("height", "n"), [(32, 4), (32, 64), (25, 32), (128, 8), (256, 32)])
def test_energy_is_kept_under_a_sun(height, n, turn):
    check_energy(prt.Environment(random_image(height, sun=1e5, seed=height + n), TURNS[turn]), n)


def test_energy_of_a_large_image():
    check_energy(prt.Environment(random_image(1024, sun=1e5), TURNS["random"]), 64)


def check_energy(environment: prt.Environment, n: int) -> None:
    lighting = prt.CubemapLighting(n)
    energy = np.einsum("jc,j->c", lighting.project(environment).astype(float), lighting.solid_angles)
    expected = np.einsum("hwc,hw->c", environment.pixels, environment.solid_angles)
    np.testing.assert_allclose(energy, expected, rtol=1e-6)  # the specification asks for 1e-4


@pytest.mark.parametrize("turn", TURNS)
@pytest.mark.parametrize(("height", "n"), [(8, 1), (8, 8), (40, 4), (7, 16)])
def test_projection_equals_dense_sampling(height, n, turn):
    environment = prt.Environment(random_image(height), TURNS[turn])
    lighting = prt.CubemapLighting(n)
    s = 256 // n
    difference = lighting.project(environment) - sampled_projection(environment, lighting, s)
    # A pixel edge through a texel misplaces at most the samples that it cuts; errors of different edges add at random
    assert np.abs(difference).max() < 4 / s
    assert np.sqrt(np.mean(difference**2)) < 0.6 / s


@pytest.mark.parametrize("row", [0, 5, 16, 31])
@pytest.mark.parametrize("turn", TURNS)
def test_a_lone_pixel_lights_only_what_it_overlaps(row, turn):
    """Shares of one pixel, counted with 400 x 400 points of equal area inside it."""
    height, width, col = 32, 64, 63
    pixels = np.zeros((height, width, 3), np.float32)
    pixels[row, col] = 1
    environment = prt.Environment(pixels, TURNS[turn])
    lighting = prt.CubemapLighting(16)
    energy = lighting.project(environment)[:, 0].astype(float) * lighting.solid_angles

    part = (np.arange(400) + 0.5) / 400
    top, bottom = np.cos(np.pi * np.array([row, row + 1]) / height)
    y, phi = np.meshgrid(top + (bottom - top) * part, 2 * np.pi * (col + part) / width, indexing="ij")
    sine = np.sqrt(1 - y * y)
    points = np.stack([sine * np.sin(phi), y, -sine * np.cos(phi)], axis=-1).reshape(-1, 3)
    counts = np.bincount(lighting.texel_of(points @ environment.rotation.T), minlength=lighting.n_directions)
    shares = energy / pixel_solid_angles(height, width)[row, col]
    np.testing.assert_allclose(shares, counts / len(points), atol=2.5e-3)
    # Texels further up or down share the column's potential; none of it may stay with them
    far = lighting.directions @ environment.rotation @ points.mean(axis=0) < np.cos(np.radians(25))
    assert shares[far].max() < 1e-9


def test_projection_is_linear():
    lighting = prt.CubemapLighting(8)
    a, b = (random_image(32, seed=seed) for seed in (1, 2))
    mixed = lighting.project(prt.Environment(2 * a + 0.5 * b))
    separate = 2 * lighting.project(prt.Environment(a)) + 0.5 * lighting.project(prt.Environment(b))
    np.testing.assert_allclose(mixed, separate, rtol=1e-5)


@pytest.mark.parametrize("quarters", [1, 2, 3, -1])
def test_quarter_turn_permutes_faces(quarters):
    lighting = prt.CubemapLighting(8)
    environment = prt.Environment(random_image(37))
    turned = environment.rotated(90 * quarters)
    before = lighting.texel_of(
        lighting.directions @ turned.rotation.astype(np.float32)
    )  # where light came from
    np.testing.assert_allclose(lighting.project(turned), lighting.project(environment)[before], rtol=1e-5)
    faces = (before // 64).reshape(6, 64)
    assert (faces == faces[:, :1]).all()  # whole faces move
    assert faces[2, 0] == 2
    assert faces[3, 0] == 3
    # +z light comes from +x after a quarter turn about y
    assert (
        faces[:, 0].tolist()
        == {1: [4, 5, 2, 3, 1, 0], 2: [1, 0, 2, 3, 5, 4], 3: [5, 4, 2, 3, 0, 1]}[quarters % 4]
    )


@pytest.mark.parametrize("degrees", [0, 30])
def test_agrees_with_envmap_up_to_its_interpolation(degrees):
    """`envmap` blurs by a pixel and stretches by half a one: on k-fold enlarged images this fades as 1 / k."""
    lighting = prt.CubemapLighting(8)
    turn = mi.ScalarTransform4f().rotate([0, 1, 0], degrees)
    errors = []
    for k in (1, 4, 16):
        image = random_image(16).repeat(k, axis=0).repeat(k, axis=1)
        ours = lighting.project(prt.Environment(image).rotated(degrees))
        envmap = mi.load_dict({"type": "envmap", "bitmap": mi.Bitmap(image), "scale": 3.0, "to_world": turn})
        errors.append(np.linalg.norm(3 * ours - lighting.project(envmap)) / np.linalg.norm(3 * ours))
    assert errors[0] < 0.25
    assert errors[1] < errors[0] / 3
    assert errors[2] < errors[1] / 3
    assert errors[2] < 0.01


def test_constant_emitter_and_plain_values():
    lighting = prt.CubemapLighting(4)
    emitter = mi.load_dict({"type": "constant", "radiance": {"type": "rgb", "value": [1, 2, 3]}})
    for same in (emitter, (1, 2, 3), np.array([1, 2, 3]), mi.ScalarColor3f(1, 2, 3)):
        np.testing.assert_allclose(lighting.project(same), np.broadcast_to([1, 2, 3], (96, 3)), rtol=1e-6)
    np.testing.assert_array_equal(lighting.project(2), np.full((96, 3), 2, np.float32))


#: Suns inside of a texel, and, the second to the last, with less than a sample's width in the next one.
SUNS = [(0.3, 0.5, 0.8), (-0.866, -0.43, 0.254), (-0.901, 0.276, 0.335), (-0.871, -0.082, 0.485)]


@pytest.mark.parametrize(
    "direction", [*SUNS[:2], *(pytest.param(direction, marks=pytest.mark.slow) for direction in SUNS[2:])]
)
@pytest.mark.parametrize("kind", ["sunsky", pytest.param("sun", marks=pytest.mark.slow)])
def test_a_sun_smaller_than_samples_keeps_its_energy(kind, direction):
    """Its sun is half a degree wide and most of its light. Truth: Mitsuba's own samples of it."""
    only_sun = {"sky_scale": 0.0} if kind == "sun" else {}
    sky = mi.load_dict({"type": "sunsky", "sun_direction": direction, **only_sun})
    uv = np.random.default_rng(0).random((2, 1 << 17)).astype(np.float32)
    si = dr.zeros(mi.SurfaceInteraction3f, uv.shape[1])
    samples = sky.sample_direction(si, mi.Point2f(uv))[1].numpy()
    mean, error = samples.mean(axis=1), samples.std(axis=1) / np.sqrt(uv.shape[1])
    assert (error < 0.005 * mean).all()
    for n in (8, 16, 32, 64):
        lighting = prt.CubemapLighting(n)
        found = (lighting.project(sky) * lighting.solid_angles[:, None]).sum(axis=0)
        assert (np.abs(found - mean) < 0.01 * mean).all(), f"n = {n}: {found / mean - 1}"


@pytest.mark.parametrize("n", [4, 8, 2, 16])
def test_cubemap_emitter_passes_exactly(n):
    """At its own resolution and finer ones texels are copied, at coarser ones averaged by solid angle."""
    data = np.random.default_rng(0).random((6, 8, 8, 3), dtype=np.float32)
    scene = mi.load_dict(
        {"type": "scene", "light": {"type": "cubemap", "data": mi.TensorXf(data), "scale": 2.0}}
    )
    lighting, own = prt.CubemapLighting(n), prt.CubemapLighting(8)
    texels = lighting.project(scene.environment())
    if n >= 8:
        np.testing.assert_array_equal(texels, 2 * data.reshape(-1, 3)[own.texel_of(lighting.directions)])
    else:
        parent = lighting.texel_of(own.directions)
        weighted = [np.bincount(parent, own.solid_angles * c) for c in 2.0 * data.reshape(-1, 3).T]
        np.testing.assert_allclose(texels, np.transpose(weighted) / lighting.solid_angles[:, None], rtol=1e-5)


def test_texel_values_pass_unchanged():
    lighting = prt.CubemapLighting(4)
    values = np.random.default_rng(0).normal(size=(96, 3)).astype(np.float32)
    np.testing.assert_array_equal(lighting.project(values), values)
    np.testing.assert_array_equal(lighting.project(values.reshape(6, 4, 4, 3)), values)
    np.testing.assert_array_equal(lighting.project(mi.TensorXf(values)), values)
    lighting.project(values)[:] = 0
    assert values.any()


@pytest.mark.parametrize(
    ("environment", "message"),
    [
        (np.zeros((95, 3)), r"lighting has shape \(95, 3\); CubemapLighting\(4\) takes \(96, 3\)"),
        (np.zeros((6, 8, 8, 3)), r"lighting has shape \(6, 8, 8, 3\)"),
        (np.full((96, 3), np.nan), "288 values that are NaN or infinite"),
        (object(), "cannot light the scene with object"),
        ("nothing.exr", "nothing.exr: no such file"),
    ],
)
def test_unfit_lighting_is_refused(environment, message):
    with pytest.raises(prt.PrtError, match=message):
        prt.CubemapLighting(4).project(environment)


def test_emitters_of_the_scene_are_no_environments():
    with pytest.raises(prt.PrtError, match="is not an environment"):
        prt.CubemapLighting(4).project(mi.load_dict({"type": "point", "intensity": 1.0}))
