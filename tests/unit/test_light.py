"""Light of a frame: an environment that turns, a disc, and sequences of them."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

import mi_sparse_prt as prt
from mi_sparse_prt.benchmark.moving_light_figures import coverage, spatio_temporal_energy
from mi_sparse_prt.emission.environment import Environment
from mi_sparse_prt.relighting.light import TurningLight, disc
from mi_sparse_prt.relighting.sequences import cut, interpolation, moving_disc, turning

LIGHTING = prt.CubemapLighting(16)
AREAS = LIGHTING.solid_angles[:, None].astype(float)
ROTATIONS = {
    "about up": 37.3,
    "about any axis": Rotation.random(random_state=1).as_matrix(),
    "none": 0.0,
}


def smooth_sky() -> Environment:
    """Bright on one side, with a horizon; no two channels alike."""
    rows, columns = np.mgrid[:64, :128]
    height, azimuth = np.cos(np.pi * (rows + 0.5) / 64), 2 * np.pi * (columns + 0.5) / 128
    bright = 1 + 0.8 * np.sin(azimuth)
    return Environment(np.stack([bright, 1 + height, np.where(height > 0, 2 * bright, 0.2)], axis=2))


def sun() -> Environment:
    pixels = np.full((64, 128, 3), 0.5)
    pixels[20, 30] = 2000
    return Environment(pixels)


@pytest.mark.parametrize("rotation", ROTATIONS.values(), ids=ROTATIONS)
@pytest.mark.parametrize(("environment", "most"), [(smooth_sky, 0.01), (sun, 0.05)])
def test_turned_light_is_near_the_exact_one(environment, most, rotation):
    light = TurningLight(environment(), LIGHTING)
    ours, exact = light.turned(rotation), light.exact(rotation)
    assert (AREAS * np.abs(ours - exact)).sum() < most * (AREAS * exact).sum()
    assert_allclose((AREAS * ours).sum(axis=0), (AREAS * exact).sum(axis=0), rtol=1e-4)


def test_own_rotation_of_the_environment_counts():
    sky = smooth_sky().rotated(Rotation.random(random_state=2).as_matrix())
    light = TurningLight(sky, LIGHTING)
    exact = LIGHTING.project(sky.rotated(20))
    assert (AREAS * np.abs(light.turned(20) - exact)).sum() < 0.01 * (AREAS * exact).sum()
    assert_array_equal(light.exact(20), exact)


def test_a_turn_that_is_none_is_refused():
    light = TurningLight(smooth_sky(), LIGHTING)
    for wrong in (np.nan, np.inf, np.diag([1.0, -1.0, 1.0])):
        with pytest.raises(prt.PrtError, match="rotation"):
            light.turned(wrong)


def test_turns_about_up_move_the_image_smoothly():
    """An image of columns, where texels get intervals of it; looked up at four places each, it is 6% off."""
    columns = np.random.default_rng(0).random((1, 90, 3)) ** 4
    environment = Environment(np.repeat(columns, 45, axis=0))
    light = TurningLight(environment, LIGHTING)
    for degrees in (0, 13.7, 90, 200.1, -75):
        ours, exact = light.turned(degrees), light.exact(degrees)
        assert (AREAS * np.abs(ours - exact)).sum() < 0.02 * (AREAS * exact).sum()


def test_black_light_stays_black():
    assert not TurningLight(Environment(np.zeros((8, 16, 3))), LIGHTING).turned(10).any()


def test_disc_has_its_solid_angle():
    for towards in ((0, 1, 0), (1, 1, 1), (0.3, -0.2, 5)):
        for degrees in (0.27, 1, 10, 90, 180):
            light = disc(LIGHTING, towards, degrees, (1, 2, 3))
            whole = 2 * np.pi * (1 - np.cos(np.radians(degrees)))
            assert_allclose((AREAS * light).sum(axis=0), whole * np.array([1, 2, 3]), rtol=1e-4)


@pytest.mark.parametrize(
    ("towards", "degrees", "match"),
    [
        ((0, 0, 0), 5, "direction"),
        ((np.nan, 0, 1), 5, "direction"),
        ((0, 1, 0), 0, "radius"),
        ((0, 1, 0), 181, "radius"),
    ],
)
def test_a_disc_that_is_none_is_refused(towards, degrees, match):
    with pytest.raises(prt.PrtError, match=match):
        disc(LIGHTING, towards, degrees)


def test_sequences_move_and_stand_still():
    light = TurningLight(smooth_sky(), LIGHTING)
    frames = list(turning(light, 90, frames=10, still=3))
    assert len(frames) == 13
    assert_array_equal(frames[0], light.exact(0))
    assert all(np.array_equal(frame, light.exact(90)) for frame in frames[9:])
    speeds = [np.abs(b - a).sum() for a, b in zip(frames[1:8], frames[2:9], strict=True)]
    assert speeds[0] < speeds[3] < speeds[-1]
    first, last = frames[0], frames[-1]
    mixed = list(interpolation(first, last, 5, 2))
    assert len(mixed) == 7
    assert_allclose(mixed[2], (first + last) / 2, rtol=1e-5)
    assert_array_equal(mixed[-1], last)
    assert [frame is first for frame in cut(first, last, 2, 4)] == [True, True, False, False]
    discs = list(moving_disc(LIGHTING, frames=4, still=1))
    assert len(discs) == 5 and (discs[0] != discs[3]).any() and (discs[3] == discs[4]).all()


def test_figures_of_a_turn():
    """Coverage counts the wavelets that lie over a texel; slow bands of space have slow bands of time."""
    light = TurningLight(smooth_sky(), prt.CubemapLighting(8))
    first_of_band_1 = np.array([0, 2])  # a whole face, and its upper left quarter
    picture = coverage(first_of_band_1, 8)
    assert np.nansum(picture) == 64 + 16 and np.nanmax(picture) == 2
    energy = spatio_temporal_energy(light, 64)
    assert energy.shape == (7, 3)
    assert_array_equal(np.argmax(energy, axis=0)[:1], [0])
    slow = energy[:2].sum(axis=0) / energy.sum(axis=0)
    assert slow[0] > 0.9 and slow[0] > slow[-1]
