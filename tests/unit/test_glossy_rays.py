"""Rays of glossy vertices."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import T, build, diffuse, problem_at
from numpy.testing import assert_allclose

import mi_sparse_prt as prt
from mi_sparse_prt.methods.plan import Plan
from mi_sparse_prt.operators.factored_visibility import FactoredVisibility
from mi_sparse_prt.reflection.factor_tables import incident_tables, outgoing_tables
from mi_sparse_prt.reflection.surfaces import vertex_reflection
from mi_sparse_prt.solvers.glossy_rays import gather_matrices, gather_rays

METAL = {"type": "roughconductor", "material": "Cu", "alpha": 0.2}


def corner():
    """A metal floor before a wall of a rough plastic and a diffuse one."""
    return build(
        0.6,
        floor={"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90), "bsdf": METAL},
        wall={
            "type": "rectangle",
            "to_world": T().translate([0, 1, -1]),
            "bsdf": {"type": "roughplastic", "alpha": 0.4, "diffuse_reflectance": 0.3},
        },
        side={
            "type": "rectangle",
            "to_world": T().translate([-1, 1, 0]).rotate([0, 1, 0], 90),
            "bsdf": diffuse(0.5, 0.4, 0.3),
        },
    )


@pytest.mark.filterwarnings("ignore::mi_sparse_prt.core.errors.PrtWarning")
def test_terms_that_a_brdf_does_not_have_change_nothing():
    """
    Rationale: a wall with two terms beside a floor with six has rows of four terms that are 0.
    Expected: sums of rays as if the wall had six, of which four are next to nothing; fewer numbers are kept.
    """
    scene = corner()
    found = vertex_reflection(scene, 6)
    wall = found.material[scene.meshes[1].vertices.start]
    factors = list(found.factors)
    factors[wall] = factors[wall].first(2)
    short = replace(found, factors=tuple(factors))
    problem = replace(problem_at(scene, prt.CubemapLighting(4), basis="texel"), reflection=short)
    lighting = problem.emission
    visibility = prt.precompute(scene, lighting, "gather", max_depth=2, progress=False).operators["direct"]
    tables = incident_tables(short.factors, texels=lighting.n_directions)
    assert tables.shape[3] == 6 and not tables[wall, ..., 2:].any()
    outgoing = np.ascontiguousarray(np.moveaxis(outgoing_tables(short.factors), 4, 0))
    every = np.arange(scene.n_vertices)
    rays = gather_rays(problem, outgoing, 64, 3, every)
    light = np.random.default_rng(2).random((scene.n_vertices + 6 * len(short.glossy), 5), np.float32)
    sums, sizes = [], []
    for own in (tables, np.where(tables == 0, np.float32(1e-30), tables)):
        direct = FactoredVisibility(visibility, short.tangents, short.material, own)
        matrices = gather_matrices(direct, rays, 3, every)
        sums.append(np.stack([m.tocsr() @ light for m in matrices]))
        sizes.append(sum(m.nnz for m in matrices))
        assert direct.own_terms[wall] == (2 if own is tables else 6)
    of_wall = short.rows_of(every[scene.meshes[1].vertices])
    assert_allclose(sums[0], sums[1], rtol=1e-5, atol=1e-6)
    assert np.abs(sums[0][:, of_wall]).max() > 0.01
    assert sizes[0] < 0.9 * sizes[1]


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
