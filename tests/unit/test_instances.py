"""Instances, ellipsoids and curves as triangles, against Mitsuba's own intersections with the original shapes."""

import gc
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import mi_sparse_prt as prt
from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.scene.instances import copied
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.scene.traced_scene import TracedScene
from mi_sparse_prt.scene.triangle_mesh import TriangleMesh

T = mi.ScalarTransform4f
ZOO = Path(__file__).parents[2] / "scenes_xml/zoo"


def diffuse(*rgb: float) -> dict:
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(rgb)}}


def instance(group: str, to_world: mi.ScalarTransform4f) -> dict:
    return {"type": "instance", "group": {"type": "ref", "id": group}, "to_world": to_world}


def rays_at(box: mi.ScalarBoundingBox3f, count: int = 50_000) -> mi.Ray3f:
    """Rays from a sphere around a box to points in it."""
    rng = np.random.default_rng(0)
    low, high = np.array(box.min), np.array(box.max)
    start = rng.normal(size=(3, count))
    start *= 2 * np.linalg.norm(high - low) / np.linalg.norm(start, axis=0)
    start += (low + high)[:, None] / 2
    way = rng.uniform(low, high, (count, 3)).T - start
    way /= np.linalg.norm(way, axis=0)
    return mi.Ray3f(mi.Point3f(start.astype(np.float32)), mi.Vector3f(way.astype(np.float32)))


def check_hits(original: mi.Scene, scene: Scene, missed: float, off: float, textured: bool = True) -> None:
    """The same rays hit, in the same places, with the same normals and texture coordinates.

    At most a share `missed` hit one of them alone; of the others, 95% are at most `off` away from each other.
    """
    ray = rays_at(original.bbox())
    a, b = original.ray_intersect(ray), scene.mitsuba.ray_intersect(ray)
    dr.eval(a)  # on a GPU a kernel traces rays in one scene only
    dr.eval(b)
    hit, same = a.is_valid().numpy(), b.is_valid().numpy()
    assert hit.mean() > 0.02
    assert (hit != same).mean() < missed * hit.mean()
    both = hit & same
    assert np.quantile(np.abs(a.t.numpy()[both] - b.t.numpy()[both]), 0.95) < off
    cosines = dr.dot(a.sh_frame.n, b.sh_frame.n).numpy()[both]
    assert np.quantile(cosines, 0.05) > 0.999
    uv = (a.uv.numpy() - b.uv.numpy())[:, both]
    assert not textured or np.quantile(np.abs(uv - np.round(uv)), 0.95) < 0.01


def bricks(count: int) -> dict:
    """Toy bricks of two kinds as instances; kinds share a BSDF between their bodies and studs."""
    rng = np.random.default_rng(1)
    content: dict = {"type": "scene", "ground": {"type": "rectangle", "to_world": T().scale(6)}}
    for kind, rgb in enumerate([(0.6, 0.2, 0.1), (0.2, 0.3, 0.6)]):
        content[f"paint{kind}"] = diffuse(*rgb)
        paint = {"type": "ref", "id": f"paint{kind}"}
        content[f"kind{kind}"] = {
            "type": "shapegroup",
            "body": {"type": "cube", "to_world": T().translate([0, 0, 0.5]).scale(0.5), "bsdf": paint},
            "stud": {"type": "cylinder", "p0": [0, 0, 1], "p1": [0, 0, 1.2], "radius": 0.3, "bsdf": paint},
            "lid": {"type": "disk", "to_world": T().translate([0, 0, 1.2]).scale(0.3), "bsdf": paint},
        }
    for k in range(count):
        x, y, turn, size = (float(v) for v in rng.uniform([-5, -5, 0, 0.5], [5, 5, 360, 1]))
        # every third one is a mirror image, sheared
        odd = T().scale([1, -1, 0.5]) @ T().rotate([1, 0, 0], 10) if k % 3 == 0 else T()
        place = T().translate([x, y, 0.2]).rotate([0, 0, 1], turn) @ odd @ T().scale(size)
        content[f"brick{k}"] = instance(f"kind{k % 2}", place)
    return content


def test_instances_become_one_mesh_for_each_bsdf() -> None:
    original = mi.load_dict(bricks(15))
    scene = Scene.from_mitsuba(original, 0.2)
    assert [mesh.name for mesh in scene.fronts] == ["ground", "kind0_body", "kind1_body"]
    assert all(shape.is_mesh() for shape in (*scene.mitsuba.shapes(), *scene.normalised.shapes()))
    np.testing.assert_allclose(np.unique(scene.albedo[scene.meshes[1].vertices]), [0.1, 0.2, 0.6], atol=1e-6)
    check_hits(original, scene, missed=0.01, off=1e-3, textured=False)  # constant BSDFs need no coordinates


@pytest.mark.parametrize("named", ["shapes", "groups", "both together"])
def test_equal_names_are_not_taken_for_each_other(named: str) -> None:
    """Two groups whose shapes have the same id, that have the same id themselves, or that lead to the same name."""
    dark, light = ({"type": "rectangle", "bsdf": diffuse(v, v, v)} for v in (0.1, 0.9))
    names = ("a", "body"), ("a", "body") if named == "groups" else ("b", "body")
    if named == "both together":
        names = ("a", "b_body"), ("a_b", "body")
    groups = [
        mi.load_dict({"type": "shapegroup", of: shape})
        for (_, of), shape in zip(names, (dark, light), strict=True)
    ]
    away = {"type": "instance", "to_world": T().translate([5, 0, 0])}
    content = {"one": {"type": "instance", names[0][0]: groups[0]}, "other": away | {names[1][0]: groups[1]}}
    original = mi.load_dict({"type": "scene", "g": groups[0], "h": groups[1], **content})
    ids = [group.id() for group in groups]
    scene = Scene.from_mitsuba(original, float("inf"))
    assert [group.id() for group in groups] == ids
    assert ids == [name for name, _ in names]
    assert len({mesh.name for mesh in scene.meshes}) == len(scene.meshes) == 2
    there = scene.positions[:, 0] > 2
    np.testing.assert_allclose(scene.albedo[~there], 0.1, atol=1e-6)
    np.testing.assert_allclose(scene.albedo[there], 0.9, atol=1e-6)
    assert np.sum(there) == np.sum(~there) == 4


def test_merged_instances_cost_what_their_triangles_cost() -> None:
    """A matrix of instances is that of the same triangles loaded as one mesh per BSDF."""
    scene = Scene.from_mitsuba(mi.load_dict(bricks(6)), 1.0)
    shapes = {mesh.name: shape for mesh, shape in zip(scene.fronts, scene.mitsuba.shapes(), strict=True)}
    merged = Scene.from_mitsuba(mi.load_dict({"type": "scene", **shapes}), 1.0)
    assert scene.n_vertices == merged.n_vertices
    lighting = prt.CubemapLighting(4)
    one, two = (
        prt.precompute(s, lighting, method="brute_force", max_depth=2, progress=False)
        for s in (scene, merged)
    )
    np.testing.assert_allclose(one.relight(1.0), two.relight(1.0), atol=1e-5)


def test_instances_in_memory_are_no_part_of_kernels() -> None:
    """Mitsuba traces what is asked of the surface at a hit for each shape that is alive; kernels of ours are the same.

    Expected: as many operations with 50 instances in memory as without; of Mitsuba's own more than ten times as many,
        so that those that a file was read into must not stay.
    """

    def operations(traced: mi.Scene | TracedScene) -> int:
        dr.kernel_history_clear()
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            dr.eval(traced.ray_intersect(mi.Ray3f(mi.Point3f(0, 0, 5), mi.Vector3f(0, 0.01, -1))))
        return max(kernel["operation_count"] for kernel in dr.kernel_history() if "operation_count" in kernel)

    original = mi.load_dict(bricks(50))
    scene = Scene.from_mitsuba(original, 1.0)
    with_instances, theirs = operations(scene.normalised), operations(scene.normalised.mitsuba)
    del original
    gc.collect()
    assert operations(scene.normalised) == with_instances
    without = operations(scene.normalised.mitsuba)
    print(f"ours: {with_instances} operations; Mitsuba's: {theirs} with 50 instances, {without} without")
    assert without < theirs / 10


def test_copies_keep_texture_coordinates_attributes_and_the_side_of_normals() -> None:
    mesh = TriangleMesh(
        "t",
        np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32),
        np.tile(np.array([0, 0, 1], np.float32), (3, 1)),
        np.array([[0, 1, 2]], np.int32),
        np.array([[0, 0], [1, 0], [0, 1]], np.float32),
        {"vertex_a": np.array([[1], [2], [3]], np.float32)},
        {"face_b": np.array([[4, 5]], np.float32)},
    )
    slanted = np.array([[1, 0, 0.5, 7], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    mirrored = np.diag([-2.0, 1, 3, 1])
    both = copied(mesh, np.stack([slanted, mirrored]), 6)
    np.testing.assert_allclose(both.normals, np.tile([0, 0, 1], (6, 1)), atol=1e-6)
    np.testing.assert_allclose(both.positions[[1, 4]], [[8, 0, 0], [-2, 0, 0]])
    assert both.triangles.tolist() == [[0, 1, 2], [3, 5, 4]]
    np.testing.assert_array_equal(both.texcoords, np.tile(mesh.texcoords, (2, 1)))
    np.testing.assert_array_equal(both.vertex_attributes["vertex_a"].ravel(), [1, 2, 3, 1, 2, 3])
    np.testing.assert_array_equal(both.face_attributes["face_b"], [[4, 5], [4, 5]])
    with pytest.raises(PrtError, match=r"'t': its 2 instances have 6 vertices, more than 5"):
        copied(mesh, np.stack([slanted, mirrored]), 5)
    with pytest.raises(PrtError, match=r"'t': the to_world of an instance leaves no size"):
        copied(mesh, np.diag([1.0, 1, 0, 1])[None], 6)


def test_instances_of_the_zoo_look_the_same() -> None:
    """Rendered by Mitsuba's `path` with the original's instances and with our triangles; the same light."""
    original = mi.load_file(str(ZOO / "shape_instance.xml"))
    scene = prt.load_scene(ZOO / "shape_instance.xml")
    first, second, ours = (
        np.array(mi.render(s, spp=128, seed=seed))
        for seed, s in enumerate([original, original, scene.mitsuba])
    )
    noise = np.linalg.norm(first - second)
    assert np.linalg.norm(first - ours) < 1.1 * noise
    assert abs(ours.mean() / ((first + second) / 2).mean() - 1) < 0.002


def test_emitters_in_groups_are_refused_by_mitsuba(tmp_path: Path) -> None:
    lamp = '<shape type="shapegroup" id="g"><shape type="sphere"><emitter type="area"/></shape></shape>'
    path = tmp_path / "lamp.xml"
    path.write_text(f'<scene version="3.0.0">{lamp}<shape type="instance"><ref id="g"/></shape></scene>')
    with pytest.raises(
        PrtError, match=r"lamp.xml cannot be loaded: .*Instancing of emitters is not supported"
    ):
        prt.load_scene(path)


# -------------------------------------------------------------------------------- ellipsoids and curves


def ellipsoids(kind: str) -> mi.Scene:
    """Three of them, far apart, each with a colour of its own."""
    rng = np.random.default_rng(2)
    centres = np.array([[0, 0, 0], [2, 0, 0], [0, 2, 0]])
    data = np.hstack([centres, rng.uniform(0.1, 0.25, (3, 3)), rng.normal(size=(3, 4))])
    data[:, 6:] /= np.linalg.norm(data[:, 6:], axis=1, keepdims=True)
    colours = np.array([[0.8, 0.1, 0.1], [0.1, 0.8, 0.1], [0.1, 0.1, 0.8]])
    return mi.load_dict(
        {
            "type": "scene",
            "all": {
                "type": kind,
                "data": mi.TensorXf(data.astype(np.float32)),
                "vertex_color": mi.TensorXf(colours.astype(np.float32)),
                "bsdf": {
                    "type": "diffuse",
                    "reflectance": {"type": "mesh_attribute", "name": "vertex_color"},
                },
            },
        }
    )


@pytest.mark.parametrize("kind", ["ellipsoids", "ellipsoidsmesh"])
def test_ellipsoids_have_their_places_and_colours(kind: str) -> None:
    original = ellipsoids(kind)
    scene = Scene.from_mitsuba(original, 0.05)
    nearest = np.argmin(
        np.linalg.norm(scene.positions[:, None] - [[0, 0, 0], [2, 0, 0], [0, 2, 0]], axis=2), axis=1
    )
    expected = np.full((3, 3), 0.1) + 0.7 * np.eye(3)
    np.testing.assert_allclose(scene.albedo, expected[nearest], atol=1e-6)
    if kind == "ellipsoids":
        check_hits(original, scene, missed=0.02, off=5e-3)


CURVES = """0 0 0 .1
1 0 0.3 .15
2 0.5 .3 .2
3 .4 -.3 .2
4 1 0 .1

0 2 0 .1
1 2 0 .1
1.5 3 0 .15
1.5 4 .4 .1
"""


@pytest.mark.parametrize(("kind", "missed"), [("linearcurve", 0.01), ("bsplinecurve", 0.12)])
def test_curves_are_tubes(kind: str, missed: float, tmp_path: Path) -> None:
    """Bends, and radii that grow. Splines of Mitsuba are open: rays that enter go on through the wall."""
    (tmp_path / "curves.txt").write_text(CURVES)
    curve = {"type": kind, "filename": str(tmp_path / "curves.txt")}
    original = mi.load_dict({"type": "scene", "curve": curve})
    scene = Scene.from_mitsuba(original, 0.03)
    assert scene.warnings == []
    check_hits(original, scene, missed=missed, off=0.01)
    group = {"group": {"type": "shapegroup", "curve": curve}}
    stretched = mi.load_dict({"type": "scene", **group, "one": instance("group", T().scale([1, 2, 1]))})
    check_hits(stretched, Scene.from_mitsuba(stretched, 0.03), missed=missed, off=0.02)


def test_hair_has_few_vertices_around(tmp_path: Path) -> None:
    """
    Expected: six around a strand whose girth is half an edge at most, ten where edges are shorter or have no limit;
        light of a sky that is brighter above arrives on it as on one of ten, within 2%, and is not even.
    """
    (tmp_path / "hair.txt").write_text("".join(f"{x} 0 0 .01\n" for x in range(5)))
    curve = {"type": "bsplinecurve", "filename": str(tmp_path / "hair.txt")}
    original = mi.load_dict({"type": "scene", "curve": curve})

    def around(edge_length: float) -> tuple[int, float]:
        """Different normals at the middle of the strand, and light there."""
        scene = Scene.from_mitsuba(original, edge_length)
        lighting = prt.CubemapLighting(8)
        sky = np.repeat(1 + lighting.directions[:, 1:2], 3, axis=1)
        light = prt.precompute(scene, lighting, max_depth=2, progress=False).relight(sky)[:, 0]
        ring = (np.abs(scene.positions[:, 0] - 2) < 0.2) & (np.abs(scene.normals[:, 0]) < 0.5)
        normals, which = np.unique(np.round(scene.normals[ring], 3), axis=0, return_index=True)
        assert np.ptp(light[ring]) > 0.3 * light[ring].mean()
        return len(normals), float(light[ring][which].mean())

    (few, light), (many, other), (unlimited, _) = (around(edge) for edge in (0.13, 0.125, np.inf))
    assert (few, many, unlimited) == (6, 10, 10)
    assert light == pytest.approx(other, rel=0.02)
