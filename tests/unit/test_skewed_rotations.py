"""Rotations about axes whose length is not 1: Mitsuba keeps an inverse of them that is none."""

import mitsuba as mi
import pytest
from conftest import PALE, T, build

from mi_sparse_prt.core.errors import PrtError


@pytest.mark.parametrize("kind", ["sphere", "cylinder", "disk"])
def test_they_are_refused_by_name(kind):
    """
    Rationale: Mitsuba's rays use the inverse; they meet such a shape elsewhere than its box, and our triangles, lie.
    Expected: an error in one line that names the shape; none for the same axis of length 1, or of three digits.
    """
    with pytest.raises(
        PrtError, match="shape 'thing': its to_world rotates about an axis whose length is not 1"
    ):
        build(0.2, thing={"type": kind, "bsdf": PALE, "to_world": T().rotate([2, 1, 0], 70)})
    for axis in ([0.6, 0.8, 0], [0.577, 0.577, 0.577]):
        turned = T().translate([100, 0, 3]).rotate(axis, 70).scale(0.02)
        assert build(0.2, thing={"type": kind, "bsdf": PALE, "to_world": turned}).n_vertices > 8


def test_meshes_have_none():
    """Expected: a cube, whose vertices are where rays meet it, is taken as it is."""
    cube = mi.load_dict({"type": "cube", "to_world": T().rotate([2, 1, 0], 70)})
    assert cube.is_mesh()
    assert (
        build(0.5, thing={"type": "cube", "bsdf": PALE, "to_world": T().rotate([2, 1, 0], 70)}).n_vertices > 8
    )
