"""Rays of glossy vertices."""

import numpy as np
import pytest
from conftest import T, build, diffuse

import mi_sparse_prt as prt
from mi_sparse_prt.methods.plan import Plan


@pytest.mark.filterwarnings("ignore")
def test_rays_that_meet_nothing_that_sends_on_light():
    """
    Rationale: below a roof that is seen from behind, with one side, no ray of a metal floor finds a vertex.
    Expected: a matrix without interreflections; what the floor sees of the sky is left.
    """
    roof = {
        "type": "rectangle",
        "bsdf": diffuse(0.5, 0.5, 0.5),
        "to_world": T().translate([0, 0, 1]).scale(0.5),
    }
    floor = {"type": "rectangle", "bsdf": {"type": "roughconductor", "alpha": 0.4}}
    scene = build(0.5, floor=floor, roof=roof)
    plan = Plan("edges", "gather", 16, 0.1)
    found = prt.precompute(scene, prt.CubemapLighting(4), plan, "texel", terms=4, progress=False)
    rows = found.operators["indirect"].rows(np.arange(found.operators["indirect"].shape[0]))
    assert not rows.any()
    assert found.irradiance(np.ones((96, 3)))[scene.meshes[0].vertices].mean() > 0.5
