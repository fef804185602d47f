"""What every emission space has to know of itself, whatever its elements are."""

import json

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import build, still_life

import mi_sparse_prt as prt


@pytest.fixture(scope="module")
def lit_scene() -> prt.Scene:
    """The still life between two panels, a metre above and behind it."""
    panel = {
        "type": "rectangle",
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [1, 2, 3]}},
    }
    down = mi.ScalarTransform4f().translate([0, 3, 0]).rotate([1, 0, 0], 90)
    behind = mi.ScalarTransform4f().translate([0, 1, -4])
    with pytest.warns(prt.PrtWarning, match="area emitter"):
        return build(
            0.5, above={**panel, "to_world": down}, behind={**panel, "to_world": behind}, **still_life()
        )


@pytest.fixture(params=["cubemap", "emitters"])
def space(request, lit_scene):
    return prt.CubemapLighting(4) if request.param == "cubemap" else prt.SceneEmitters(lit_scene)


def test_its_size_and_weights(space):
    assert space.weights.shape == (space.size,)
    assert space.weights.dtype == np.float32
    assert (space.weights > 0).all()
    json.dumps(space.attributes())
    assert all(len(values) == space.size for values in space.coordinates.values())


def test_light_is_projected_or_refused(space):
    light = np.random.default_rng(0).random((space.size, 3), np.float32)
    assert np.array_equal(space.project(light), light)
    with pytest.raises(prt.PrtError):
        space.project(light[1:])
    light[0, 1] = np.nan
    with pytest.raises(prt.PrtError):
        space.project(light)


def path(lit: mi.Scene, camera: mi.Sensor, seed: int) -> np.ndarray:
    """A small image of direct and once reflected light."""
    integrator = mi.load_dict({"type": "path", "max_depth": 3})
    return np.array(mi.render(lit, sensor=camera, integrator=integrator, spp=512, seed=seed))[..., :3]


def test_scenes_are_lit_by_all_that_is_in_the_light(space, lit_scene):
    """Mitsuba's images are linear in the light of a space: two halves of it, dimmed and coloured, add up.

    Expected: equal within the noise, which the standard error over pixels tells; a colour or a factor that got lost
    would be 10% and more.
    """
    camera = mi.load_dict(
        {
            "type": "perspective",
            "to_world": mi.ScalarTransform4f().look_at([0, 2, 5], [0, 0.5, 0], [0, 1, 0]),
            "film": {"type": "hdrfilm", "width": 24, "height": 16, "rfilter": {"type": "box"}},
        }
    )
    whole = path(lit_scene.mitsuba, camera, 9)
    light = np.random.default_rng(3).random((space.size, 3)).astype(np.float32) + np.float32(0.2)
    first = np.arange(space.size)[:, None] < space.size // 2
    images = []
    for seed, part in enumerate((light, light * first, light * ~first)):
        with space.scene_lit_by(part, lit_scene) as lit:
            images.append(path(lit, camera, seed))
    both, difference = images[1] + images[2], images[0] - images[1] - images[2]
    error = difference.std(axis=(0, 1)) / np.sqrt(difference[..., 0].size)
    assert (error < 0.004 * both.mean(axis=(0, 1))).all()  # so that 2% would show
    assert (np.abs(difference.mean(axis=(0, 1))) < 4 * error).all()
    assert np.allclose(path(lit_scene.mitsuba, camera, 9), whole, atol=1e-4)  # the scene itself is as it was


def test_a_coarser_version_and_the_way_back(space):
    coarse = space.coarser(2)
    if coarse is None:
        assert (space.upsampling(space) != np.eye(space.size)).sum() == 0
        assert space.sides is None
        return
    weights = space.upsampling(coarse)
    assert weights.shape == (space.size, coarse.size) == (96, 24)
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-6)
    assert coarse.weights.sum() == pytest.approx(space.weights.sum())
    with pytest.raises(prt.PrtError, match="not a power of two"):
        space.coarser(8)


def test_neighbours_begin_with_the_element_itself():
    lighting = prt.CubemapLighting(4)
    near = lighting.neighbours(9)
    assert near.shape == (96, 9)
    assert np.array_equal(near[:, 0], np.arange(96))
    cosines = (lighting.directions[near] * lighting.directions[:, None]).sum(axis=2)
    assert (np.diff(cosines, axis=1) < 1e-6).all()
    others = np.sort(lighting.directions @ lighting.directions.T, axis=1)[:, ::-1][:, :9]
    np.testing.assert_allclose(cosines, others, atol=1e-6)
    assert prt.CubemapLighting(1).neighbours(25).shape == (6, 6)


def test_lamps_have_no_neighbours(lit_scene):
    assert prt.SceneEmitters(lit_scene).neighbours(5) is None


def test_the_texel_that_rays_leave_towards():
    """Rays from the middle of a ball above ground: into its texel, or -1 where they meet the ball."""
    lighting = prt.CubemapLighting(4)
    scene = mi.load_dict({"type": "scene", "wall": {"type": "sphere", "center": [3, 0, 0]}})
    rays = mi.Ray3f(mi.Point3f(0), mi.Vector3f(lighting.directions.T))
    si = scene.ray_intersect(rays)
    element, radiance = lighting.element_of(si, rays, mi.Mask(True))
    hit = si.is_valid().numpy()
    assert 0 < hit.sum() < 20
    assert np.array_equal(element.numpy(), np.where(hit, -1, np.arange(96)))
    assert np.array_equal(radiance.numpy(), np.where(hit, 0, np.ones((3, 1))))
    assert (lighting.element_of(si, rays, dr.zeros(mi.Mask, 96))[0].numpy() == -1).all()


def test_the_lamp_that_rays_meet(lit_scene):
    """Up, back, down and forwards from the middle: the lamp above, the one behind, the ground, and nothing."""
    lamps = prt.SceneEmitters(lit_scene)
    directions = np.array([[0, 1, 0], [0, 0, -1], [0, -1, 0], [0, 0, 1]], np.float32)
    rays = mi.Ray3f(mi.Point3f(0, 2, 0), mi.Vector3f(directions.T))
    rays.o = mi.Point3f(np.array([[0, 2, 0], [0, 1.5, -3], [0, 2, 0], [0, 2, 0]], np.float32).T)
    si = lit_scene.mitsuba.ray_intersect(rays)
    element, radiance = lamps.element_of(si, rays, mi.Mask(True))
    names = [lamps.names[k] if k >= 0 else None for k in element.numpy()]
    assert names == ["above", "behind", None, None]
    assert np.array_equal(radiance.numpy()[:, 0], [1, 2, 3])
    assert not radiance.numpy()[:, 2:].any()
