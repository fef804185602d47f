"""Surfaces that rays find, against what Mitsuba's own meshes tell of them."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import BALL, GROUND, PALE, T, build, diffuse, mesh
from test_instances import rays_at

import mi_sparse_prt as prt
from mi_sparse_prt.scene.traced_scene import TracedScene

CHECKS = {"type": "checkerboard", "to_uv": T().scale([5, 7, 1])}
RELIEF = mi.Bitmap(np.random.default_rng(0).random((8, 8, 1)).astype(np.float32))
BUMPY = {
    "type": "bumpmap",
    "arbitrary": {"type": "bitmap", "bitmap": RELIEF, "raw": True},
    "bsdf": {"type": "roughconductor", "alpha_u": 0.4, "alpha_v": 0.1},
}
CUBE = {"type": "cube", "to_world": T().translate([0.9, 0.4, -0.4]).scale(0.3)}
LEANING = {"type": "rectangle", "to_world": T().translate([-1, 0.5, 0]).rotate([1, 1, 0], 55)}
SCENES = {
    "one": {"ball": BALL},
    "textured": {
        "ground": {**GROUND, "bsdf": {"type": "diffuse", "reflectance": CHECKS}},
        "leaning": LEANING,
    },
    "all": {"ground": GROUND, "ball": {**BALL, "bsdf": BUMPY}, "cube": CUBE, "leaning": LEANING},
}
FIELDS = ("t", "p", "n", "uv", "dp_du", "dp_dv", "wi", "prim_index", "time")


def without_texture_coordinates(scene: prt.Scene) -> mi.Scene:
    """Its shapes, and one more, above them, that has none: a triangle of which one corner's normal leans."""
    corners = np.array([[-0.5, 0.6, -0.5], [-0.3, 0.6, 0.5], [0.5, 0.7, -0.5]])
    bare = mesh("bare", corners, np.array([[0, 1, 2]]), PALE)
    values = mi.traverse(bare)
    values["vertex_normals"] = [0, 1, 0, 0.6, 0.8, 0, 0, 1, 0]
    values.update()
    shapes = {f"s{k}": shape for k, shape in enumerate([*scene.normalised.shapes(), bare])}
    return mi.load_dict({"type": "scene", **shapes}, optimize=False)


def differences(ours: mi.SurfaceInteraction3f, theirs: mi.SurfaceInteraction3f) -> dict[str, float]:
    """The largest difference of each field, frames of hits alone; what is not finite must be equal."""
    hits, found = theirs.is_valid().numpy(), {}
    for name in FIELDS:
        a, b = (np.asarray(getattr(si, name).numpy(), np.float64) for si in (ours, theirs))
        finite = np.isfinite(a) & np.isfinite(b)
        np.testing.assert_array_equal(a[~finite], b[~finite])
        found[name] = float(np.abs(a[finite] - b[finite]).max())
    for name in "nst":
        a, b = (getattr(si.sh_frame, name).numpy()[:, hits] for si in (ours, theirs))
        found[f"sh_frame.{name}"] = float(np.abs(a - b).max())
    return found


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("bare", [False, True], ids=["as loaded", "one without texture coordinates"])
def test_surfaces_are_mitsubas(name: str, bare: bool) -> None:
    """
    Expected: all fields within 1e-5 (tangents 1e-4 of their lengths), hits, misses and masked lanes alike, and the same
        shapes; BSDFs that look at tangents reflect the same within 1e-4.
    """
    scene = build(0.3, **SCENES[name])
    mitsuba = without_texture_coordinates(scene) if bare else scene.normalised.mitsuba
    traced, ray = TracedScene(mitsuba), rays_at(mitsuba.bbox())
    hit, active = mitsuba.ray_intersect_preliminary(ray), dr.arange(mi.UInt32, 50_000) % 7 != 0
    ours, theirs = traced.interaction(hit, ray, active), hit.compute_surface_interaction(ray, active=active)
    assert 0.05 < theirs.is_valid().numpy().mean() < 0.99
    assert dr.all(ours.is_valid() == theirs.is_valid())
    assert dr.all(ours.shape == theirs.shape)
    seen = theirs.is_valid()
    for field, off in differences(ours, theirs).items():
        size = dr.max(dr.norm(theirs.dp_du))[0] if field.startswith("dp_") else 1.0
        assert off < 1e-5 * max(size, 1.0), (field, off)
    wo = mi.warp.square_to_uniform_sphere(mi.Point2f(0.3, 0.1))
    a, b = (si.bsdf().eval(mi.BSDFContext(), si, si.to_local(wo), seen).numpy() for si in (ours, theirs))
    np.testing.assert_allclose(a, b, atol=1e-4)
    assert b.any()


def test_triangles_are_counted_over_all_shapes() -> None:
    """Expected: of each ray, the triangle of all shapes that it starts over."""
    scene = build(
        float("inf"),
        ground=GROUND,
        cube=CUBE,
        more={**CUBE, "to_world": T().translate([-0.5, 0.7, 0]).scale(0.2)},
    )
    corners = np.concatenate(
        [
            shape.vertex_positions_buffer()
            .numpy()
            .reshape(-1, 3)[shape.faces_buffer().numpy().reshape(-1, 3)]
            for shape in scene.normalised.shapes()
        ]
    )
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    middles = corners.mean(axis=1)
    ray = mi.Ray3f(mi.Point3f((middles + 1e-3 * normals).T), mi.Vector3f(-normals.T))
    hit = scene.normalised.ray_intersect_preliminary(ray)
    found = scene.normalised.triangle(hit, hit.is_valid()).numpy()
    assert found.tolist() == list(range(len(corners)))
    missed = scene.normalised.ray_intersect_preliminary(ray, active=False)
    assert not scene.normalised.interaction(missed, ray).is_valid().numpy().any()


HOLES = {"type": "checkerboard", "color0": 0.0, "color1": 1.0}


@pytest.mark.parametrize(
    ("bsdf", "expected"),
    [
        ({"type": "thindielectric"}, True),
        ({"type": "thindielectric", "int_ior": 1.0, "ext_ior": 1.0}, False),
        ({"type": "thindielectric", "specular_transmittance": HOLES}, False),
        ({"type": "mask", "opacity": 0.5, "bsdf": diffuse(0.5, 0.5, 0.5)}, True),
        ({"type": "mask", "opacity": 0.0, "bsdf": diffuse(0.5, 0.5, 0.5)}, False),
        ({"type": "mask", "opacity": HOLES, "bsdf": diffuse(0.5, 0.5, 0.5)}, False),
        ({"type": "mask", "opacity": 0.5, "bsdf": {"type": "diffuse", "reflectance": HOLES}}, True),
        ({"type": "null"}, False),
        (diffuse(0.5, 0.5, 0.5), False),
    ],
)
def test_panes_that_dim_light_wherever_it_passes(bsdf, expected):
    """Expected: what takes some of the light everywhere and at all angles is told; what has holes is not."""
    scene = build(0.9, card={"type": "rectangle", "bsdf": bsdf})
    (material,) = scene.materials[: len(scene.fronts)]
    assert material.dims is expected
    shapes = 0 if scene.dimming_surfaces is None else len(scene.dimming_surfaces.shapes())
    assert shapes == int(expected or not material.passes_straight)
