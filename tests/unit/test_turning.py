"""How pages turn their light, as a matrix. What pages themselves make of it: test_browser.py."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

import mi_sparse_prt as prt
from mi_sparse_prt.relighting.viewer.turning import axis_up, turn_matrix


def test_turns_about_up_are_those_of_environments():
    light = prt.Environment(np.ones((2, 4, 3)))
    for degrees in (0, 33.0, 270, -400):
        assert_allclose(turn_matrix(degrees), light.rotated(degrees).rotation, atol=1e-12)


def test_counter_clockwise_about_each_axis():
    """Quarter turns. Expected: x to y about z, y to z about x, z to x about y."""
    for axis, before, later in (("z", 0, 1), ("x", 1, 2), ("y", 2, 0)):
        assert_allclose(turn_matrix(90, axis) @ np.eye(3)[before], np.eye(3)[later], atol=1e-12)


def test_light_is_tipped_first():
    """An environment whose up is +y stands upright where +z is up, and is turned about +z then."""
    tip = [90, 0, 0]
    assert_allclose(turn_matrix(0, "z", tip) @ [0, 1, 0], [0, 0, 1], atol=1e-12)
    assert_allclose(turn_matrix(77, "z", tip) @ [0, 1, 0], [0, 0, 1], atol=1e-12)
    aslant = np.array([10.0, -20, 30])
    expected = Rotation.from_euler("y", 40, degrees=True) * Rotation.from_rotvec(np.radians(aslant))
    assert_allclose(turn_matrix(40, "y", aslant), expected.as_matrix(), atol=1e-12)


def test_what_makes_no_sense_is_told_in_a_line():
    for arguments in ((0, "w"), (np.nan, "y"), (0, "y", [0, np.inf, 0]), (0, "y", [1, 2])):
        with pytest.raises(prt.PrtError):
            turn_matrix(*arguments)


@pytest.mark.parametrize(
    ("up", "axis"),
    [
        ([0, 1, 0], "y"),
        ([0, 0.8, -0.6], "y"),
        ([0, 0.3, -0.95], "y"),  # steeply from above
        ([0, 0, 1], "z"),
        ([0.3, 0.4, 0.85], "z"),
        ([1, 0, 0], "y"),
    ],
)
def test_up_is_y_unless_a_camera_says_z(up, axis):
    assert axis_up(up) == axis
