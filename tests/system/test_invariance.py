"""What must not change a matrix: units, place, orientation, order, block size and number of threads."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import build, still_life

import mi_sparse_prt as prt
from mi_sparse_prt.transport import direct, path

T = mi.ScalarTransform4f
LIGHTING = prt.CubemapLighting(4)


def matrix(scene, **settings):
    settings = {"progress": False, "spp": 8, "max_depth": 3, **settings}
    return prt.precompute(scene, LIGHTING, **settings)


def full(transport):
    return transport.rows(np.arange(transport.shape[0]))


def difference(a, b):
    return np.linalg.norm(a - b) / np.linalg.norm(b)


def direct_rows(transport):
    return transport.direct.rows(np.arange(transport.shape[0]))


def flipped(a, b, tolerance):
    """Share of elements that differ by more than a share of the largest one."""
    return (np.abs(a - b) > tolerance * b.max()).mean()


@pytest.fixture(scope="module")
def reference(grey_scene):
    return matrix(grey_scene)


@pytest.mark.parametrize("scale", [1e-4, 1e4])
def test_scaled_scene_has_the_same_matrix(grey_scene, reference, scale):
    """Rationale: Mitsuba's ray offsets are absolute; the copy in the unit box makes them mean the same.

    Expected: the direct part within 1e-4 (bits may flip where a ray grazes an edge); the indirect part uses other
    random numbers and agrees within the noise of both: 3 standard errors of its sum, which are under 2%.
    """
    scaled = build(0.5 * scale, **still_life(place=T().scale(scale)))
    other = matrix(scaled, spp=64)
    assert difference(direct_rows(other), direct_rows(reference)) < 1e-4
    rows = np.arange(other.shape[0])
    ours, theirs = (t.indirect.rows(rows).sum(axis=(1, 2)) for t in (other, matrix(grey_scene, spp=64)))
    error = np.std(ours - theirs) / np.sqrt(len(ours))
    assert 3 * error < 0.02 * theirs.mean()
    assert abs((ours - theirs).mean()) < 3 * error


def test_moved_scene_has_nearly_the_same_matrix(grey_scene, reference):
    """Rationale: at 1000 times its size from the origin, a scene's float32 positions are rounded to 6e-5 of its size.

    Expected: normals and visibility know no more than that. A normal of this scene, whose edges are a sixth of its
    size, turns by up to 1e-3; bits flip where rays pass an edge within 6e-5 of the size: under 0.1% of the elements.
    """
    size = 3.0
    moved = build(0.5, **still_life(place=T().translate([1000 * size, 0, 0])))
    assert moved.n_vertices == grey_scene.n_vertices
    assert flipped(direct_rows(matrix(moved, max_depth=2)), direct_rows(reference), 2e-3) < 1e-3


def test_quarter_turn_permutes_columns(reference):
    """A scene turned by 90 degrees about y sees the same through permuted texels.

    Mitsuba's sine and cosine of 90 degrees are off by 4e-8: a ray in 1000 at most may pass the other side of an edge.
    """
    turned = matrix(build(0.5, **still_life(place=T().rotate([0, 1, 0], 90))), max_depth=2)
    rotation = np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    texels = LIGHTING.texel_of(LIGHTING.directions @ rotation.T)
    assert flipped(direct_rows(turned)[:, texels], direct_rows(reference), 1e-5) < 1e-3
    assert flipped(direct_rows(turned), direct_rows(reference), 1e-5) > 0.1  # it did turn


def test_order_of_shapes_does_not_show(grey_scene, reference):
    """Expected: bit-identical rows after permutation, in the direct part and in the noise of the indirect part."""
    shapes = still_life()
    other_scene = build(0.5, **{name: shapes[name] for name in reversed(shapes)})
    other = matrix(other_scene)
    assert [m.name for m in other_scene.meshes] != [m.name for m in grey_scene.meshes]
    assert np.array_equal(full(other.for_scene(grey_scene)), full(reference))


def test_merged_shapes_have_the_same_rows():
    """Two boxes of one material, apart and merged by Mitsuba's scene optimisation: bit-identical rows, one hash."""
    material = mi.load_dict({"type": "diffuse"})
    pair = {
        name: {"type": "cube", "to_world": T().translate([x, 0, 0]).scale(0.3), "bsdf": material}
        for name, x in (("left", -0.5), ("right", 0.5))
    }
    apart, merged = build(0.5, **pair), build(0.5, optimize=True, **pair)
    assert len(merged.meshes) < len(apart.meshes)
    assert merged.hash == apart.hash
    assert np.array_equal(full(matrix(merged).for_scene(apart)), full(matrix(apart)))


@pytest.mark.parametrize("basis", ["direction", "texel"])
def test_blocks_do_not_show(grey_scene, monkeypatch, basis):
    """Bit-identical with wavefronts of any size."""
    whole = full(matrix(grey_scene, basis=basis))
    monkeypatch.setattr(direct, "LANES", 7 * 96)
    monkeypatch.setattr(path, "LANES", 5 * 96 * 8)
    assert np.array_equal(full(matrix(grey_scene, basis=basis)), whole)


def test_threads_do_not_show(grey_scene, reference):
    """Bit-identical with one thread."""
    threads = dr.thread_count()
    dr.set_thread_count(1)
    try:
        alone = full(matrix(grey_scene))
    finally:
        dr.set_thread_count(threads)
    assert np.array_equal(alone, full(reference))
