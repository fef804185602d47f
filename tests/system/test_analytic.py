"""Scenes whose light transport has a closed form."""

import mitsuba as mi
import numpy as np
import pytest
from conftest import build, diffuse

import mi_sparse_prt as prt

T = mi.ScalarTransform4f
WHITE = diffuse(0.8, 0.8, 0.8)


def radiance_under_white_sky(scene, lighting, **settings):
    transport = prt.precompute(scene, lighting, progress=False, **settings)
    return transport, transport.relight(1.0)


def test_convex_object_alone_sends_out_its_albedo():
    """Rationale: every point of a convex body sees its whole hemisphere, so B = albedo under radiance 1.

    Expected: 1e-3 in the texel basis; there is no indirect light, and that is found out.
    """
    ball = {"type": "sphere", "radius": 1.0, "bsdf": diffuse(0.9, 0.5, 0.2)}
    scene = build(0.4, ball=ball)
    transport, radiance = radiance_under_white_sky(
        scene, prt.CubemapLighting(8), basis="texel", strata=4, seed=1
    )
    assert transport.indirect is None
    assert np.abs(radiance - scene.albedo).max() < 1e-3 * 0.9 * 3  # every vertex, 3 sigma of the strata
    assert np.abs((radiance / scene.albedo).mean() - 1) < 1e-3 / 10


def test_closed_box_is_exactly_dark():
    """Rationale: no light enters a closed box, not even at its edges, where vertices lie in two walls."""
    box = {"type": "cube", "flip_normals": True, "bsdf": WHITE}
    with pytest.warns(prt.PrtWarning, match="inwards"):
        scene = build(0.4, box=box)
    for basis in ("direction", "texel"):
        _, radiance = radiance_under_white_sky(scene, prt.CubemapLighting(8), basis=basis, spp=4)
        assert not radiance.any()


def test_open_plane_sees_the_whole_sky():
    """Expected: radiance = albedo at every vertex, corners included, within 1e-3 (texel basis)."""
    scene = build(0.5, plane={"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90), "bsdf": WHITE})
    transport, radiance = radiance_under_white_sky(scene, prt.CubemapLighting(8), basis="texel", strata=4)
    assert np.abs(radiance / 0.8 - 1).max() < 1e-3
    assert transport.indirect is None


def disk_over_patch(half_angle):
    """A black disk of the given half angle over the centre of a small patch that faces it."""
    patch = {"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90).scale(0.05), "bsdf": WHITE}
    to_world = T().translate([0, 1, 0]).rotate([1, 0, 0], 90).scale(float(np.tan(half_angle)))
    disk = {"type": "disk", "to_world": to_world, "bsdf": diffuse(0, 0, 0)}
    return build(0.2, patch=patch, disk=disk)


@pytest.mark.parametrize("degrees", [20, 45, 70])
def test_irradiance_under_a_disk(degrees):
    """Rationale: a disk of half angle a, overhead, hides the form factor sin(a)^2 of the sky.

    Expected: the patch under a black disk sends out albedo (1 - sin(a)^2). The disk is a polygon of segments no longer
    than 0.2, which hides a little less: the regular polygon's area is sin(x) / x of the circle's, x the segment's
    angle. Strata add noise: 1% of the hidden part is allowed for both on top of the polygon's share.
    """
    angle = np.radians(degrees)
    scene = disk_over_patch(angle)
    _, radiance = radiance_under_white_sky(scene, prt.CubemapLighting(16), basis="texel", strata=4)
    patch = next(m for m in scene.meshes if m.name == "patch").vertices
    sky = radiance[patch, 0].mean() / 0.8
    hidden = np.sin(angle) ** 2
    segment = 0.2 / np.tan(angle)
    missing = hidden * min(1.0, segment**2 / 6)
    assert 1 - hidden - 0.01 * hidden < sky < 1 - hidden + missing + 0.01 * hidden


def test_interreflection_between_facing_plates():
    """Rationale: between two wide plates of albedo r that face each other at a small distance, light of one bounce is
    r times the direct light of the other plate.

    The lower plate's centre sees only the upper one (form factor 1 within the plates' aspect), whose back is lit by
    nothing; light enters through the narrow gap alone. Scale-free check instead of a constant: with black plates
    B = albedo * direct, so the ratio of the indirect light at albedos 0.8 and 0.4 must be 2 for a single bounce.
    """
    ratios = []
    for albedo in (0.4, 0.8):
        bsdf = diffuse(albedo, albedo, albedo)
        lower = {"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90), "bsdf": bsdf}
        upper = {
            "type": "rectangle",
            "to_world": T().translate([0, 0.5, 0]).rotate([1, 0, 0], 90),
            "bsdf": bsdf,
        }
        scene = build(1.0, lower=lower, upper=upper)
        transport = prt.precompute(scene, prt.CubemapLighting(4), progress=False, max_depth=3, spp=256)
        light = np.ones((transport.lighting.n_directions, 3), np.float32)
        ratios.append(transport.indirect.relight(light).mean())
    # 54 vertices x 96 texels x 256 paths: a standard error of about 0.2% was seen
    assert ratios[1] / ratios[0] == pytest.approx(2, rel=1e-2)


def test_linearity():
    """B(a L1 + b L2) = a B(L1) + b B(L2), to float32 rounding."""
    scene = build(
        0.7,
        ball={"type": "sphere", "center": [0, 0.6, 0], "radius": 0.5, "bsdf": WHITE},
        plane={"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90).scale(2), "bsdf": WHITE},
    )
    lighting = prt.CubemapLighting(4)
    transport = prt.precompute(scene, lighting, progress=False, spp=4)
    first, second = np.random.default_rng(0).random((2, lighting.n_directions, 3)).astype(np.float32)
    together = transport.relight(2 * first + 0.5 * second)
    apart = 2 * transport.relight(first) + 0.5 * transport.relight(second)
    assert np.abs(together - apart).max() < 1e-5 * np.abs(together).max()


def test_exchange_between_two_patches_is_reciprocal():
    """Rationale: A_1 F_12 = A_2 F_21. One bounce from patch 2 to patch 1 under light that only patch 2 sees, against
    the same with the roles exchanged, gives the two form factors from two different sets of paths.

    Expected: equal within three standard errors, which are under 1% (so 5% would be caught; the estimates themselves
    are checked against Mitsuba elsewhere).
    """
    patches = {
        "low": {"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90).scale(0.3), "bsdf": WHITE},
        "side": {
            "type": "rectangle",
            "to_world": T().translate([-0.8, 0.6, 0]).rotate([0, 1, 0], 90).scale([0.5, 0.2, 1]),
            "bsdf": WHITE,
        },
    }
    scene = build(0.1, **patches)
    lighting = prt.CubemapLighting(4)
    transport = prt.precompute(scene, lighting, progress=False, max_depth=3, spp=256)
    low, side = (next(m for m in scene.meshes if m.name == name) for name in ("low", "side"))
    weight = {name: vertex_areas(scene, mesh) for name, mesh in (("low", low), ("side", side))}
    light = np.ones((lighting.n_directions, 3), np.float32)
    indirect = transport.indirect.relight(light)[:, 0]
    direct = transport.direct.relight(light)[:, 0]
    # white exchange A_i F_ij = integral over i of what arrives from j, over the (nearly even) light of j
    flow = {
        "low": (weight["low"] * indirect[low.vertices]).sum() / (0.8 * direct[side.vertices].mean()),
        "side": (weight["side"] * indirect[side.vertices]).sum() / (0.8 * direct[low.vertices].mean()),
    }
    assert flow["low"] == pytest.approx(flow["side"], rel=0.05)


def vertex_areas(scene, mesh):
    corners = scene.positions[mesh.vertices][mesh.triangles].astype(np.float64)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    result = np.zeros(mesh.vertices.stop - mesh.vertices.start)
    for corner in range(3):
        np.add.at(result, mesh.triangles[:, corner], area / 3)
    return result
