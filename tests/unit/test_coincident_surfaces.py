"""Surfaces that lie on each other: rows of their vertices cannot be compared with what Mitsuba sees there."""

import numpy as np
import pytest
from conftest import GROUND, PALE, T, build

import mi_sparse_prt as prt
from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.measurement.coincident_surfaces import lie_on_others
from mi_sparse_prt.measurement.vertices import vertex_rays
from mi_sparse_prt.methods.plan import Plan


def wall(height: float) -> dict:
    """A wall that stands so high above the ground."""
    return {
        "type": "cube",
        "to_world": T().translate([0, 0.3 + height, 0]).scale([0.6, 0.3, 0.05]),
        "bsdf": PALE,
    }


@pytest.mark.parametrize("height", [0.0, 0.01])
def test_the_face_that_a_wall_stands_on(height):
    """
    Expected: of a wall on the ground all vertices of its lower face, and no other one of the wall; above it, none.
    """
    scene = build(0.1, ground=GROUND, wall=wall(height))
    found = lie_on_others(scene, vertex_rays(scene.normalised, scene))[scene.meshes[1].vertices]
    below = scene.normals[scene.meshes[1].vertices, 1] < -0.9
    assert below.sum() > 10
    assert np.array_equal(found, below if height == 0 else np.zeros_like(below))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_rows_of_such_vertices_are_left_out():
    """
    Rationale: the lower face of a wall on the ground is lit from below; Mitsuba sees that or the ground, by chance.
    Expected: what is found is what is told within 2%, and the report says what is left out.
    Result: 1.9% told, 1.7% found. Of a wall in a larger scene 1.2 and 1.3%; with these rows, 25%.
    """
    scene = build(0.1, ground=GROUND, wall=wall(0))
    transport = prt.precompute(
        scene, prt.CubemapLighting(8), target_error=0.05, basis="texel", progress=False
    )
    report = prt.validate(scene, transport, n_rows=100, n_columns=64, image=False, progress=False).report
    print(transport.report["estimated_error"]["total"], report["relative_l2"]["total"], report["left_out"])
    assert report["relative_l2"]["total"] < 0.02 + transport.report["estimated_error"]["total"]
    assert any("on these" in sentence for sentence in report["left_out"])


def test_where_all_are_left_out():
    """Expected: of two sheets that lie on each other, an error in one line."""
    sheets = {
        name: {"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90), "bsdf": PALE} for name in "ab"
    }
    scene = build(0.5, **sheets)
    transport = prt.precompute(scene, prt.CubemapLighting(2), Plan("exact"), max_depth=2, progress=False)
    with pytest.raises(PrtError, match="none of the vertices chosen can be seen"):
        prt.validate(scene, transport, n_rows=16, image=False, progress=False)
