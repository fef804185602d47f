"""Reading HDR images: formats, orientation, what is repaired, what is refused, and rotation."""

import struct
import warnings
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import scipy.ndimage
from scipy.spatial.transform import Rotation

import mi_sparse_prt as prt
from mi_sparse_prt.emission.environment import environment_of
from mi_sparse_prt.emission.equirectangular import pixel_solid_angles

ENVMAPS = Path(__file__).parents[2] / "scenes_xml" / "envmaps"


@pytest.fixture
def image() -> np.ndarray:
    return np.random.default_rng(0).random((8, 16, 3), dtype=np.float32)


def write_pfm(path: Path, image: np.ndarray) -> None:
    """Portable float map, little-endian, rows from the bottom up."""
    height, width, channels = image.shape
    header = f"{'PF' if channels == 3 else 'Pf'}\n{width} {height}\n-1.0\n".encode()
    values = image[::-1].ravel()
    path.write_bytes(header + struct.pack(f"<{values.size}f", *values))


def write_bitmap(path: Path, image: np.ndarray) -> Path:
    mi.Bitmap(image).write(str(path))
    return path


def test_pfm(tmp_path, image):
    write_pfm(tmp_path / "colour.pfm", image)
    np.testing.assert_array_equal(prt.load_environment(tmp_path / "colour.pfm").pixels, image)
    write_pfm(tmp_path / "grey.pfm", image[..., :1])
    grey = prt.load_environment(str(tmp_path / "grey.pfm")).pixels
    np.testing.assert_array_equal(grey, np.repeat(image[..., :1], 3, axis=2))


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_exr(tmp_path, image, channels, dtype):
    stored = np.concatenate([image, image[..., :1]], axis=2)[..., :channels].astype(dtype)
    pixels = prt.load_environment(write_bitmap(tmp_path / "image.EXR", stored)).pixels
    assert pixels.dtype == np.float32
    expected = stored[..., :3] if channels > 1 else np.repeat(stored, 3, axis=2)
    np.testing.assert_array_equal(pixels, expected.astype(np.float32))


def test_hdr(tmp_path, image):
    pixels = prt.load_environment(write_bitmap(tmp_path / "image.hdr", image)).pixels
    np.testing.assert_allclose(pixels, image, atol=1 / 128)  # 8 bits and a shared exponent


def test_orientation_is_that_of_envmap(tmp_path, image):
    """Directions through pixel centres, written out here, meet the same pixels in Mitsuba's `envmap`.

    The file is enlarged 32-fold so that the interpolation of `envmap` stays away from the centres.
    """
    path = write_bitmap(tmp_path / "image.exr", image.repeat(32, axis=0).repeat(32, axis=1))
    environment = prt.load_environment(path)
    row, col = np.indices((8, 16))
    theta, phi = np.pi * (row + 0.5) / 8, 2 * np.pi * (col + 0.5) / 16
    directions = [np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)]
    si = dr.zeros(mi.SurfaceInteraction3f, 128)
    si.wi = -mi.Vector3f(np.reshape(directions, (3, 128)).astype(np.float32))
    seen = np.array(mi.load_dict({"type": "envmap", "filename": str(path)}).eval(si)).T.reshape(8, 16, 3)
    np.testing.assert_allclose(environment.pixels[16::32, 16::32], seen, atol=1e-5)

    # and the projection puts each of these pixels at its direction
    lighting = prt.CubemapLighting(64)
    texels = lighting.texel_of(np.reshape(directions, (3, 128)).T).reshape(8, 16)
    np.testing.assert_allclose(lighting.project(environment)[texels], image, atol=1e-5)


def test_solid_angles_of_pixels():
    assert pixel_solid_angles(64, 128).sum() == pytest.approx(4 * np.pi, rel=1e-12)
    edges = np.cos(np.pi * np.arange(5) / 4)
    np.testing.assert_allclose(pixel_solid_angles(4, 8)[:, 0], -np.diff(edges) * 2 * np.pi / 8, rtol=1e-12)


def test_real_file_with_negative_pixels():
    """Shipped with compression ringing: 2.8% of its pixels have a negative channel, and 1.9% of the energy."""
    with pytest.warns(
        prt.PrtWarning, match=r"workshop_negative.exr: 3684 pixels \(2.81%\) were negative"
    ) as caught:
        environment = prt.load_environment(ENVMAPS / "workshop_negative.exr")
    assert caught[0].filename == __file__
    raw = np.array(mi.Bitmap(str(ENVMAPS / "workshop_negative.exr")), dtype=np.float64)
    np.testing.assert_array_equal(environment.pixels, np.maximum(raw, 0).astype(np.float32))
    weights = np.broadcast_to(pixel_solid_angles(256, 512)[..., None], raw.shape)
    share = -(raw * weights)[raw < 0].sum() / np.abs(raw * weights).sum()
    assert environment.report["negative_energy_share"] == pytest.approx(share, rel=1e-5)
    assert f"{share:.2%} of the image's energy" in str(caught[0].message)
    assert environment.report["negative_pixels"] == 3684


@pytest.mark.parametrize("name", ["city", "dawn", "forest", "studio", "sunset", "venice"])
def test_real_files_load_in_silence(name):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        environment = prt.load_environment(ENVMAPS / f"{name}.exr")
    assert environment.pixels.shape == (256, 512, 3)
    assert environment.report["negative_energy_share"] == 0
    assert environment.pixels.max() > 1


def test_nan_and_infinite_pixels_are_refused(tmp_path, image):
    image[5, 3, 1] = np.nan
    image[6, 2] = np.inf
    path = write_bitmap(tmp_path / "broken.exr", image)
    with pytest.raises(
        prt.PrtError, match=r"broken.exr: 2 of 128 pixels .* the first at row 5, column 3"
    ) as error:
        prt.load_environment(path)
    assert "\n" not in str(error.value)


def test_files_that_are_no_environments(tmp_path, image):
    (tmp_path / "text.exr").write_text("no image")
    (tmp_path / "folder.hdr").mkdir()
    (tmp_path / "short.pfm").write_bytes(b"PF\n16 8\n-1.0\nabc")
    write_bitmap(tmp_path / "cross.exr", image[:, :12])
    channels = mi.Bitmap(image[..., :2].repeat(3, axis=2), channel_names=list("LMNOPQ"))
    channels.write(str(tmp_path / "layers.exr"))
    for name, message in {
        "missing.exr": "no such file",
        "folder.hdr": "no such file",
        "photo.png": r"not an HDR image by its name; give a file that ends in .exr, .hdr, .pfm",
        "text.exr": "cannot be read as an image",
        "short.pfm": "cannot be read as an image",
        "cross.exr": "12 x 8 pixels; an equirectangular image is twice as wide as high",
        "layers.exr": "has the channels L, M, N, O, P, Q",
    }.items():
        with pytest.raises(prt.PrtError, match=message) as error:
            prt.load_environment(tmp_path / name)
        assert "\n" not in str(error.value)
        assert name in str(error.value)


def test_arrays_are_checked_as_files_are():
    with pytest.raises(prt.PrtError, match=r"pixels have shape \(8, 16\)"):
        prt.Environment(np.ones((8, 16)))
    with pytest.raises(prt.PrtError, match="sky: 128 of 128 pixels are NaN"):
        prt.Environment(np.full((8, 16, 3), np.nan), source="sky")
    with pytest.warns(prt.PrtWarning, match="100.00% of the image's energy"):
        prt.Environment(np.full((8, 16, 3), -1.0))


def test_the_caller_keeps_his_array():
    pixels = np.full((8, 16, 3), -1.0, np.float32)
    with pytest.warns(prt.PrtWarning):
        prt.Environment(pixels)
    assert (pixels == -1).all()


def test_rotations_compose(image):
    environment = prt.Environment(image)
    turned = environment.rotated(30).rotated(-75)
    np.testing.assert_allclose(turned.rotation, environment.rotated(-45).rotation, atol=1e-12)
    assert turned.pixels is environment.pixels
    np.testing.assert_array_equal(environment.rotation, np.eye(3))
    # first about up, then over: the later rotation acts in the world
    over = Rotation.from_euler("x", 90, degrees=True).as_matrix()
    up = environment.rotated(90).rotated(over).rotation
    np.testing.assert_allclose(up @ [0, 1, 0], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(up @ [0, 0, 1], [1, 0, 0], atol=1e-12)


def test_degrees_mean_what_mitsuba_means(image):
    expected = np.array(mi.ScalarTransform4f().rotate([0, 1, 0], 37).matrix)[:3, :3]
    np.testing.assert_allclose(prt.Environment(image).rotated(37).rotation, expected, atol=1e-6)
    np.testing.assert_allclose(prt.Environment(image).rotated(expected).rotation, expected, atol=1e-6)


@pytest.mark.parametrize(
    ("rotation", "message"),
    [
        (np.eye(4), "has shape"),
        (2 * np.eye(3), "not orthonormal"),
        (np.diag([1, 1, -1]), "determinant -1"),
        (np.full((3, 3), np.nan), "not orthonormal"),
        (np.inf, "finite angle"),
    ],
)
def test_other_matrices_are_refused(image, rotation, message):
    with pytest.raises(prt.PrtError, match=message):
        prt.Environment(image).rotated(rotation)


def test_an_emitter_becomes_an_image():
    """Of the light of a scene: projected, it is what the emitter itself is projected to."""
    rng = np.random.default_rng(5)
    smooth = scipy.ndimage.gaussian_filter(rng.random((32, 64, 3)), (3, 3, 0), mode="wrap").astype(np.float32)
    turned = mi.ScalarTransform4f().rotate([0.2, 1, 0.1], 50)
    emitter = mi.load_dict({"type": "envmap", "bitmap": mi.Bitmap(smooth), "to_world": turned})
    lighting = prt.CubemapLighting(8)
    expected = lighting.project(emitter)
    found = lighting.project(environment_of(emitter))
    assert np.abs(found - expected).max() < 2e-3 * expected.max()
    constant = environment_of(mi.load_dict({"type": "constant", "radiance": 0.5}), 8)
    assert constant.pixels.shape == (8, 16, 3) and np.allclose(constant.pixels, 0.5)
