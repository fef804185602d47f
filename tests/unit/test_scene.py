"""Loading: vertices, normals, albedo, the unit-box copy, hashes, and what is refused."""

import itertools
import re
import runpy
import warnings
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import mi_sparse_prt  # noqa: F401  chooses the variant
from mi_sparse_prt.core.errors import PrtError, PrtWarning
from mi_sparse_prt.emission.emitters import SceneEmitters
from mi_sparse_prt.measurement.measurement import mesh_vertices
from mi_sparse_prt.scene import surfaces
from mi_sparse_prt.scene.loading import load_scene
from mi_sparse_prt.scene.materials import single_direction
from mi_sparse_prt.scene.mesh_cleaning import check_geometry
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.scene.triangle_mesh import TriangleMesh

T = mi.ScalarTransform4f
INF = float("inf")
SCENES = Path(__file__).parents[2] / "scenes_xml"
SQUARE = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]


def diffuse(*rgb: float) -> dict:
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(rgb)}}


def bitmap(pixels: np.ndarray, **parameters: object) -> dict:
    texture = {
        "type": "bitmap",
        "bitmap": mi.Bitmap(np.asarray(pixels, np.float32)),
        "raw": True,
        **parameters,
    }
    return {"type": "diffuse", "reflectance": texture}


def build(edge_length: float | None = INF, optimize: bool = False, **shapes: object) -> Scene:
    """A scene of these shapes; any warning is an error."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", PrtWarning)
        return Scene.from_mitsuba(mi.load_dict({"type": "scene", **shapes}, optimize=optimize), edge_length)


def write_ply(path: Path, vertices: list, faces: list, normals: list | None = None) -> Path:
    """A binary PLY file (Mitsuba's text reader refuses `nan`)."""
    names = ["x", "y", "z"] + (["nx", "ny", "nz"] if normals else [])
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n"
    header += "".join(f"property float {n}\n" for n in names)
    header += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    body = np.column_stack([vertices, normals] if normals else [vertices]).astype("<f4").tobytes()
    for face in faces:
        body += b"\x03" + np.array(face, "<i4").tobytes()
    path.write_bytes(header.encode() + body)
    return path


def write_xml(path: Path, content: str) -> Path:
    path.write_text(f'<scene version="3.0.0">{content}</scene>')
    return path


def corner_interactions(scene: Scene) -> list[mi.SurfaceInteraction3f]:
    """Mitsuba's view of the vertices: per mesh, at the first corner of each triangle of `scene.mitsuba`."""
    result = []
    for mesh, shape in zip(scene.meshes, scene.mitsuba.shapes(), strict=True):
        n = len(mesh.triangles)
        pi = dr.zeros(mi.PreliminaryIntersection3f, n)
        pi.prim_index = dr.arange(mi.UInt32, n)
        pi.shape = mi.ShapePtr(shape)
        result.append(shape.compute_surface_interaction(dr.zeros(mi.Ray3f, n), pi))
    return result


# ------------------------------------------------------------------------------------ meshes and arrays


@pytest.fixture(scope="module")
def mixed() -> Scene:
    """One of everything."""
    mesh = mi.Mesh("own", 4, 2, has_vertex_normals=False)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = mi.Float(np.array(SQUARE, np.float32).ravel())
    parameters["faces"] = mi.UInt32([0, 1, 2, 0, 2, 3])
    parameters.update()
    return build(
        rectangle={
            "type": "rectangle",
            "to_world": T().translate([0, 0, -3]),
            "bsdf": diffuse(0.1, 0.2, 0.3),
        },
        cube={"type": "cube", "to_world": T().translate([5, 0, 0]).rotate([1, 0, 0], 30)},
        file={
            "type": "ply",
            "filename": str(SCENES / "meshes/dancer.ply"),
            "to_world": T().translate([9, 0, 0]),
        },
        cow={
            "type": "obj",
            "filename": str(SCENES / "meshes/spot.obj"),
            "to_world": T().translate([0, 9, 0]),
        },
        own=mesh,
        ball={"type": "sphere", "center": [-5, 0, 0], "radius": 0.5},
        back={
            "type": "rectangle",
            "flip_normals": True,
            "to_world": T().translate([0, 0, 3]).scale([1, 2, 1]),
        },
        facets={"type": "obj", "filename": str(SCENES / "meshes/teapot.obj"), "face_normals": True},
    )


def test_meshes_keep_order_names_and_slices(mixed: Scene) -> None:
    names = ["rectangle", "cube", "file", "cow", "own", "ball", "back", "facets"]
    assert [m.name for m in mixed.meshes] == names
    assert [s.id() for s in mixed.mitsuba.shapes()] == names
    assert [s.id() for s in mixed.normalised.shapes()] == names
    ends = [m.vertices.stop for m in mixed.meshes]
    assert [m.vertices.start for m in mixed.meshes] == [0, *ends[:-1]]
    assert ends[-1] == mixed.n_vertices == len(mixed.positions) == len(mixed.normals) == len(mixed.albedo)
    sizes = {m.name: m.vertices.stop - m.vertices.start for m in mixed.meshes}
    assert (sizes["rectangle"], sizes["cube"], sizes["own"], sizes["file"]) == (4, 24, 4, 9977)
    for array in (mixed.positions, mixed.normals, mixed.albedo, mixed.normalised_positions):
        assert array.dtype == np.float32
        assert array.shape == (mixed.n_vertices, 3)
        assert array.flags.c_contiguous
    for mesh in mixed.meshes:
        assert mesh.triangles.dtype == np.int32
        assert mesh.triangles.max() == mesh.vertices.stop - mesh.vertices.start - 1


def test_mitsuba_scenes_hold_exactly_these_vertices(mixed: Scene) -> None:
    for scene, positions in (
        (mixed.mitsuba, mixed.positions),
        (mixed.normalised, mixed.normalised_positions),
    ):
        for mesh, shape in zip(mixed.meshes, scene.shapes(), strict=True):
            buffers = shape.vertex_positions_buffer(), shape.vertex_normals_buffer(), shape.faces_buffer()
            p, n, f = (np.array(b).reshape(-1, 3) for b in buffers)
            np.testing.assert_array_equal(p, positions[mesh.vertices])
            np.testing.assert_array_equal(n, mixed.normals[mesh.vertices])
            np.testing.assert_array_equal(f, mesh.triangles)


def test_normals_are_the_ones_that_mitsuba_shades_with(mixed: Scene) -> None:
    # In the new scene, and at the same places of the original shapes, flipped, faceted and bare ones included.
    for mesh, si in zip(mixed.meshes, corner_interactions(mixed), strict=True):
        first = mesh.triangles[:, 0]
        np.testing.assert_allclose(np.array(si.p).T, mixed.positions[mesh.vertices][first], atol=1e-6)
        np.testing.assert_allclose(np.array(si.sh_frame.n).T, mixed.normals[mesh.vertices][first], atol=1e-6)
    by_name = {m.name: mixed.normals[m.vertices] for m in mixed.meshes}
    np.testing.assert_array_equal(by_name["rectangle"], np.tile([0, 0, 1], (4, 1)))
    np.testing.assert_array_equal(by_name["back"], np.tile([0, 0, -1], (4, 1)))
    np.testing.assert_array_equal(by_name["own"], np.tile([0, 0, 1], (4, 1)))
    facets = mixed.meshes[-1]
    p = mixed.positions[facets.vertices].astype(np.float64)[facets.triangles]
    face = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    face /= np.linalg.norm(face, axis=1, keepdims=True)
    corners = mixed.normals[facets.vertices][facets.triangles]
    np.testing.assert_allclose(corners, np.repeat(face[:, None], 3, axis=1), atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(mixed.normals, axis=1), 1, atol=1e-6)


def test_flipped_mesh_looks_the_same_as_the_original() -> None:
    shapes = {
        "cube": {"type": "cube", "flip_normals": True, "bsdf": {"type": "twosided", "b": diffuse(1, 1, 1)}}
    }
    original, rebuilt = mi.load_dict({"type": "scene", **shapes}), build(edge_length=0.7, **shapes).mitsuba
    rng = np.random.default_rng(1)
    d = rng.normal(size=(500, 3))
    ray = mi.Ray3f(
        mi.Point3f(0.1, 0.2, 0.3), mi.Vector3f(*(mi.Float(c) for c in d.T.astype(np.float32).copy()))
    )
    a, b = original.ray_intersect(ray), rebuilt.ray_intersect(ray)
    for x, y in ((a.n, b.n), (a.sh_frame.n, b.sh_frame.n), (a.p, b.p), (a.uv, b.uv)):
        np.testing.assert_allclose(np.array(x), np.array(y), atol=1e-5)


def test_shapes_without_id_get_sensible_unique_names(tmp_path: Path) -> None:
    write_ply(tmp_path / "part.ply", SQUARE, [[0, 1, 2], [0, 2, 3]])
    part = '<shape type="ply"><string name="filename" value="part.ply"/></shape>'
    odd = '<shape type="cube" id="a b.c"/>'
    scene = load_scene(write_xml(tmp_path / "x.xml", part * 2 + '<shape type="sphere"/>' + odd), INF)
    assert [m.name for m in scene.meshes] == ["part", "part_2", "sphere_2", "a_b_c"]


def test_sensors_emitters_and_integrator_are_the_originals(tmp_path: Path) -> None:
    original = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "direct"},
            "sensor": {"type": "perspective"},
            "second": {"type": "orthographic"},
            "sky": {"type": "constant"},
            "lamp": {"type": "point", "position": [0, 0, 5]},
            "square": {"type": "rectangle"},
            "meter": {"type": "rectangle", "sensor": {"type": "irradiancemeter"}},
        }
    )
    scene = Scene.from_mitsuba(original, INF)
    assert scene.mitsuba.integrator() is original.integrator()
    free = [s for s in original.sensors() if "Irradiance" not in s.class_name()]
    assert [s.class_name() for s in scene.mitsuba.sensors()] == [s.class_name() for s in free]
    assert all(any(a is b for b in free) for a in scene.mitsuba.sensors())
    assert len(scene.mitsuba.emitters()) == 2
    assert all(any(a is b for b in original.emitters()) for a in scene.mitsuba.emitters())
    assert scene.normalised.mitsuba.emitters() == []
    assert scene.normalised.mitsuba.sensors() == []
    mi.render(scene.mitsuba, spp=1)


def test_area_emitters_are_copied_to_the_world_scene_only() -> None:
    lamp = {"type": "rectangle", "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [1, 2, 3]}}}
    original = mi.load_dict({"type": "scene", "lamp": lamp, "floor": {"type": "rectangle"}})
    with pytest.warns(PrtWarning, match="'lamp' is an area emitter: matrices of lamps"):
        scene = Scene.from_mitsuba(original, INF)
    assert len(scene.warnings) == 1
    assert scene.normalised.mitsuba.emitters() == []
    (copy,) = scene.mitsuba.emitters()
    assert copy is not original.emitters()[0]  # an area emitter belongs to one shape
    si = corner_interactions(scene)[0]
    si.wi = mi.Vector3f(0, 0, 1)
    np.testing.assert_allclose(np.ravel(copy.eval(si))[:3], [1, 2, 3], rtol=1e-6)


def test_lamps_that_no_path_finds_are_named() -> None:
    lamp = {"type": "rectangle", "emitter": {"type": "directionalarea"}}
    original = mi.load_dict({"type": "scene", "lamp": lamp, "floor": {"type": "rectangle"}})
    with pytest.warns(PrtWarning, match="'lamp' shines, but not as an area emitter: it is left out"):
        scene = Scene.from_mitsuba(original, INF)
    assert len(scene.warnings) == 1
    assert scene.mitsuba.emitters() == []
    with pytest.raises(PrtError, match="the scene in memory has no emitters"):
        SceneEmitters(scene)


# -------------------------------------------------------------------------------------------- edge length


def test_default_edge_length_is_a_64th_of_the_diagonal() -> None:
    coarse = {"type": "rectangle", "to_world": T().scale(2)}
    scene = build(edge_length=None, floor=coarse, ball={"type": "sphere", "center": [0, 0, 1]})
    low, high = [-2, -2, 0], [2, 2, 2]
    limit = np.linalg.norm(np.subtract(high, low)) / 64
    floor = scene.meshes[0]
    p = scene.positions[floor.vertices][floor.triangles]
    longest = np.linalg.norm(p - np.roll(p, 1, axis=1), axis=2).max()
    assert limit / 2 < longest <= limit * 1.011
    assert len(build(floor=coarse).positions) == 4


@pytest.mark.parametrize("bad", [0.0, -1.0, float("nan")])
def test_edge_length_must_be_positive(bad: float) -> None:
    with pytest.raises(PrtError, match="edge_length must be positive"):
        build(edge_length=bad, floor={"type": "rectangle"})


def test_too_many_vertices_are_refused_before_they_are_made() -> None:
    with pytest.raises(PrtError, match=r"shape 'floor'.*5000000 vertices"):
        build(edge_length=1e-4, floor={"type": "rectangle"})


# ------------------------------------------------------------------------------------------------- albedo


def test_albedo_of_constants_and_two_sided_wrappers() -> None:
    scene = build(
        one={"type": "rectangle", "bsdf": diffuse(0.1, 0.2, 0.3)},
        two={
            "type": "sphere",
            "center": [9, 0, 0],
            "bsdf": {"type": "twosided", "b": diffuse(0.4, 0.5, 0.6)},
        },
        none={"type": "cube"},
    )
    for mesh, expected in zip(scene.meshes, ([0.1, 0.2, 0.3], [0.4, 0.5, 0.6], [0.5] * 3), strict=True):
        albedo = scene.albedo[mesh.vertices]
        np.testing.assert_allclose(albedo, np.tile(expected, (len(albedo), 1)), atol=1e-6)
    assert scene.diffuse
    assert not scene.grey


def test_albedo_of_a_bitmap_is_its_bilinear_value_at_the_vertex() -> None:
    # Bilinear look-up by hand: texel centres at (k + 0.5) / 4, clamped outside; v = 0 is row 0.
    pixels = np.random.default_rng(2).uniform(0, 1, (4, 4, 3))
    scene = build(edge_length=0.3, floor={"type": "rectangle", "bsdf": bitmap(pixels, wrap_mode="clamp")})
    uv = (scene.positions[:, :2] + 1) / 2
    xy = uv * 4 - 0.5
    low = np.floor(xy).astype(int)
    f = xy - low
    pick = lambda dx, dy: pixels[np.clip(low[:, 1] + dy, 0, 3), np.clip(low[:, 0] + dx, 0, 3)]  # noqa: E731
    top = pick(0, 0) * (1 - f[:, :1]) + pick(1, 0) * f[:, :1]
    bottom = pick(0, 1) * (1 - f[:, :1]) + pick(1, 1) * f[:, :1]
    expected = top * (1 - f[:, 1:]) + bottom * f[:, 1:]
    np.testing.assert_allclose(scene.albedo, expected, atol=2e-3)  # bitmaps may be held in half precision
    assert np.ptp(scene.albedo, axis=0).min() > 0.3


def test_albedo_of_vertex_and_face_attributes_survives_subdivision() -> None:
    def colours(kind: str, values: list) -> mi.Mesh:
        properties = mi.Properties()
        bsdf = {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": f"{kind}_color"}}
        properties["bsdf"] = mi.load_dict(bsdf)
        mesh = mi.Mesh(kind, 4, 2, props=properties, has_vertex_normals=True)
        parameters = mi.traverse(mesh)
        parameters["vertex_positions"] = mi.Float(np.array(SQUARE, np.float32).ravel())
        parameters["faces"] = mi.UInt32([0, 1, 2, 0, 2, 3])
        parameters.update()
        mesh.add_attribute(f"{kind}_color", 3, np.array(values, np.float32).ravel())
        return mesh

    ramp = np.array(SQUARE) * 0.5 + 0.25
    scene = build(
        edge_length=0.2, v=colours("vertex", ramp.tolist()), f=colours("face", [[0.2] * 3, [0.8] * 3])
    )
    v, f = scene.meshes
    assert v.vertices.stop > 30
    np.testing.assert_allclose(scene.albedo[v.vertices], scene.positions[v.vertices] * 0.5 + 0.25, atol=1e-6)
    x, y = scene.positions[f.vertices, 0], scene.positions[f.vertices, 1]
    np.testing.assert_allclose(scene.albedo[f.vertices][y < x - 0.01], 0.2, atol=1e-6)
    np.testing.assert_allclose(scene.albedo[f.vertices][y > x + 0.01], 0.8, atol=1e-6)
    assert not scene.grey
    grey = build(edge_length=0.2, f=colours("face", [[0.2] * 3, [0.8] * 3]))
    assert grey.grey


def test_bsdf_that_is_not_diffuse_gets_its_directional_albedo() -> None:
    gold = {"type": "roughconductor", "material": "Au", "alpha": 0.3}
    shapes = {"type": "scene", "gold": {"type": "rectangle", "bsdf": gold}}
    with pytest.warns(PrtWarning, match="'gold': BSDF RoughConductor is not diffuse"):
        scene = Scene.from_mitsuba(mi.load_dict(shapes), INF)
    assert not scene.diffuse
    # reference: plain Monte Carlo with a thousand times the samples
    n = 65536
    si = dr.zeros(mi.SurfaceInteraction3f, n)
    si.wi = mi.Vector3f(0, 0, 1)
    rng = np.random.default_rng(3)
    u = [mi.Float(rng.uniform(size=n).astype(np.float32)) for _ in range(3)]
    _, weight = mi.load_dict(gold).sample(mi.BSDFContext(), si, u[0], mi.Point2f(u[1], u[2]))
    weight = np.array(weight).T
    error = 4 * weight.std(axis=0) / np.sqrt(n)
    np.testing.assert_allclose(scene.albedo, np.tile(weight.mean(axis=0), (4, 1)), atol=0.005 + error.max())
    assert scene.albedo.max() <= 1


def test_bump_maps_and_masks_are_not_called_diffuse() -> None:
    bump = {"type": "bumpmap", "b": diffuse(0.2, 0.2, 0.2), "t": {"type": "checkerboard"}}
    mask = {"type": "mask", "opacity": 0.5, "b": diffuse(0.2, 0.2, 0.2)}
    for bsdf, message in ((bump, "bends the shading normals"), (mask, "is not diffuse")):
        original = mi.load_dict({"type": "scene", "s": {"type": "rectangle", "bsdf": bsdf}})
        with pytest.warns(PrtWarning, match=message):
            assert not Scene.from_mitsuba(original, INF).diffuse


@pytest.mark.parametrize(
    "bsdf",
    [
        {"type": "plastic"},
        {"type": "blendbsdf", "weight": 0.56, "a": {"type": "diffuse"}, "b": {"type": "plastic"}},
        {"type": "dielectric"},
    ],
)
def test_random_numbers_that_are_one_send_no_infinite_light(bsdf: dict) -> None:
    """Mitsuba's samplers return 1 now and then, and blends round: the lobe is then one that was not asked for."""
    made = mi.load_dict({"type": "sphere", "bsdf": bsdf})
    numbers = np.float32([1, np.nextafter(np.float32(0.56), 0), 0.3, 0.001])
    scene = mi.load_dict({"type": "scene", "sphere": made})
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(0.5, 0.2, dr.full(mi.Float, 3, 4)), mi.Vector3f(0, 0, -1)))
    delta = int(mi.BSDFFlags.Delta)
    sample, weight = single_direction(si, mi.Float(numbers), mi.Point2f(0.3, 0.6), mi.Mask(True), delta)
    weight, single = np.array(weight), (np.array(sample.sampled_type) & delta) != 0
    assert np.isfinite(weight).all()
    assert (weight[:, single] > 0).all() and single[3]
    assert (weight[:, ~single] == 0).all()


@pytest.mark.parametrize("value", [1.5, -0.1, float("nan")])
def test_impossible_albedo_names_the_shape(value: float) -> None:
    pixels = np.full((2, 2, 3), 0.5)
    pixels[0, 0, 1] = value
    with pytest.raises(PrtError, match=r"shape 'hot': vertex \d+ has the albedo .*0\.\.1"):
        build(edge_length=0.5, hot={"type": "rectangle", "bsdf": bitmap(pixels, filter_type="nearest")})


@pytest.mark.parametrize(
    ("bsdf", "grey"),
    [
        (diffuse(0.3, 0.3, 0.3), True),
        (diffuse(0.3, 0.3, 0.31), False),
        ({"type": "twosided", "b": diffuse(0.3, 0.3, 0.3)}, True),
        (bitmap(np.full((2, 2, 3), 0.4)), True),
        (bitmap(np.full((2, 2, 3), [0.4, 0.4, 0.5])), False),
        # one coloured texel that no vertex sees
        (bitmap(np.where(np.arange(64 * 64 * 3).reshape(64, 64, 3) == 6240, 0.9, 0.4)), False),
        (bitmap(np.full((2, 2, 1), 0.4)), True),
        ({"type": "plastic"}, True),
        ({"type": "roughconductor", "material": "Au"}, False),
        ({"type": "principled"}, False),  # grey in truth, but not among the BSDFs that we can read
    ],
)
def test_grey_is_said_only_where_it_is_certain(bsdf: dict, grey: bool) -> None:
    original = mi.load_dict({"type": "scene", "s": {"type": "rectangle", "bsdf": bsdf}})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PrtWarning)
        assert Scene.from_mitsuba(original, INF).grey is grey


# --------------------------------------------------------------------------------------------- unit box


def placed(to_world: mi.ScalarTransform4f) -> Scene:
    return build(
        edge_length=None,
        cow={"type": "obj", "filename": str(SCENES / "meshes/spot.obj"), "to_world": to_world},
        floor={"type": "rectangle", "to_world": to_world.rotate([1, 0, 0], -90).scale(1.3)},
        ball={"type": "sphere", "to_world": to_world.translate([0, 1, 0]).scale(0.4)},
    )


def test_normalised_copy_is_the_unit_box() -> None:
    scene = placed(T().translate([3, 4, 5]).scale(7))
    low, high = scene.normalised_positions.min(axis=0), scene.normalised_positions.max(axis=0)
    np.testing.assert_allclose(low + high, 0, atol=1e-6)
    assert np.max(high - low) == pytest.approx(1, abs=1e-6)
    box = scene.normalised.mitsuba.bbox()
    np.testing.assert_allclose(np.array([box.min, box.max]).reshape(2, 3), [low, high], atol=1e-7)
    assert scene.centre.dtype == np.float64
    world = scene.positions.astype(np.float64)
    np.testing.assert_allclose((world - scene.centre) * scene.scale, scene.normalised_positions, atol=1e-7)
    for a, b in zip(scene.mitsuba.shapes(), scene.normalised.shapes(), strict=True):
        assert a.bsdf() is b.bsdf()


@pytest.mark.parametrize("scale", [1e-4, 1e4])
def test_scaled_scene_normalises_to_the_same_positions(scale: float) -> None:
    a, b = placed(T()), placed(T().scale(scale))
    assert [len(m.triangles) for m in a.meshes] == [len(m.triangles) for m in b.meshes]
    np.testing.assert_allclose(a.normalised_positions, b.normalised_positions, atol=1e-6)
    np.testing.assert_allclose(a.normals, b.normals, atol=1e-5)


def test_moved_scene_normalises_as_well_as_its_float32_positions_allow() -> None:
    # Moved by 1000 times its size, a float32 position is rounded by 1000 * 2^-24 of the size: 6e-5, and the box's
    # corners with it. Mitsuba's own transform rounds once more.
    a, b = placed(T()), placed(T().translate([0, 2000, 0]))
    size = 1 / a.scale
    allowed = 4 * 2000 / size * 2.0**-24
    assert [len(m.triangles) for m in a.meshes] == [len(m.triangles) for m in b.meshes]
    error = np.abs(a.normalised_positions - b.normalised_positions).max()
    assert 1e-6 < error < allowed


# ------------------------------------------------------------------------------------------------ hashes


def shelf(**changes: object) -> dict:
    """Shapes of two materials, two of which merge; `changes` replaces one."""
    red, grey = diffuse(0.6, 0.1, 0.1), diffuse(0.5, 0.5, 0.5)
    checks = {
        "type": "rectangle",
        "to_world": T().translate([0, 0, -3]),
        "bsdf": bitmap(np.eye(4)[:, :, None]),
    }
    shapes = {
        "a": {"type": "cube", "bsdf": red},
        "b": {"type": "cube", "to_world": T().translate([3, 0, 0]), "bsdf": red},
        "c": {"type": "cube", "to_world": T().translate([0, 3, 0]), "bsdf": grey},
        "d": {"type": "sphere", "center": [0, 0, 3], "bsdf": grey},
        "e": checks,
    }
    return {**shapes, **changes}


def test_hash_and_keys_do_not_depend_on_order() -> None:
    a = build(edge_length=0.8, **shelf())
    b = build(edge_length=0.8, **dict(reversed(shelf().items())))
    assert [m.name for m in a.meshes] == list(reversed([m.name for m in b.meshes]))
    assert a.hash == b.hash
    a_keys, b_keys = (mesh_vertices(scene).keys for scene in (a, b))
    assert a_keys.dtype == np.uint64
    assert not np.array_equal(a_keys, b_keys)
    np.testing.assert_array_equal(np.sort(a_keys), np.sort(b_keys))


@pytest.mark.parametrize("edge_length", [None, INF])
def test_hash_and_keys_survive_mitsubas_merging(tmp_path: Path, edge_length: float | None) -> None:
    # mi.load_file merges meshes of equal material by default; the teapot's normals are computed by Mitsuba.
    teapot = f'<string name="filename" value="{SCENES}/meshes/teapot.obj"/>'
    bsdf = '<bsdf type="diffuse"><rgb name="reflectance" value="0.2, 0.3, 0.4"/></bsdf>'
    move = '<transform name="to_world"><translate x="{}"/></transform>'
    xml = "".join(f'<shape type="obj">{teapot}{bsdf}{move.format(8 * k)}</shape>' for k in range(2))
    xml += "".join(f'<shape type="cube">{bsdf}{move.format(-5 * k)}</shape>' for k in (1, 2))
    path = write_xml(tmp_path / "x.xml", xml + f'<shape type="sphere">{bsdf}</shape>')
    apart = load_scene(path, edge_length)
    merged = Scene.from_mitsuba(mi.load_file(str(path), optimize=True), edge_length)
    assert len(merged.meshes) < len(apart.meshes) == 5
    assert merged.hash == apart.hash
    merged_keys, apart_keys = (mesh_vertices(scene).keys for scene in (merged, apart))
    np.testing.assert_array_equal(np.sort(merged_keys), np.sort(apart_keys))


def test_keys_find_the_same_vertex_in_another_scene() -> None:
    a = build(edge_length=0.8, **shelf())
    b = build(edge_length=0.8, **dict(reversed(shelf().items())))
    a_keys, b_keys = (mesh_vertices(scene).keys for scene in (a, b))
    order = np.argsort(b_keys)
    found = order[np.searchsorted(b_keys, a_keys, sorter=order)]
    np.testing.assert_array_equal(b.positions[found], a.positions)
    np.testing.assert_array_equal(b.normals[found], a.normals)
    np.testing.assert_array_equal(b.albedo[found], a.albedo)


@pytest.mark.parametrize(
    "change",
    [
        {"c": {"type": "cube", "to_world": T().translate([0, 3.0001, 0]), "bsdf": diffuse(0.5, 0.5, 0.5)}},
        {"c": {"type": "cube", "to_world": T().translate([0, 3, 0]), "bsdf": diffuse(0.5, 0.5, 0.5001)}},
        {"c": {"type": "cube", "flip_normals": True, "to_world": T().translate([0, 3, 0])}},
        {
            "d": {
                "type": "sphere",
                "center": [0, 0, 3],
                "bsdf": {"type": "twosided", "b": diffuse(0.5, 0.5, 0.5)},
            }
        },
        {"d": {"type": "sphere", "center": [0, 0, 3], "bsdf": {"type": "plastic"}}},
        {
            "e": {
                "type": "rectangle",
                "to_world": T().translate([0, 0, -3]),
                "bsdf": bitmap(np.eye(4)[:, ::-1, None].copy()),
            }
        },
        {"f": {"type": "rectangle", "to_world": T().translate([0, 0, 9])}},
        {"a": {"type": "cube", "bsdf": diffuse(0.6, 0.1, 0.1), "to_world": T().rotate([0, 0, 1], 90)}},
    ],
    ids=["vertex", "albedo", "side", "two-sided", "plastic", "texture", "shape", "texture coordinates"],
)
def test_hash_changes_with_anything_that_matters(change: dict) -> None:
    def key(shapes: dict) -> str:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", PrtWarning)
            return Scene.from_mitsuba(mi.load_dict({"type": "scene", **shapes}), INF).hash

    assert key(shelf()) == key(shelf())
    assert key(shelf()) != key(shelf(**change))


def test_hash_sees_a_bsdf_parameter_that_no_vertex_shows() -> None:
    def key(alpha: float) -> str:
        bsdf = {"type": "roughplastic", "alpha": alpha}
        with pytest.warns(PrtWarning):
            return Scene.from_mitsuba(
                mi.load_dict({"type": "scene", "s": {"type": "rectangle", "bsdf": bsdf}}), INF
            ).hash

    assert key(0.1) == key(0.1) != key(0.11)


@pytest.mark.parametrize("channels", [1, 3])
def test_hash_sees_how_bitmaps_are_looked_up(channels: int) -> None:
    """Rationale: filter and wrap mode are no parameters, and vertices may fall where they make no difference.

    Expected: six hashes for six ways, of opacity as well; the usual way is Mitsuba's own, so that files of scenes with
        bitmaps are still theirs.
    """
    texels = np.random.default_rng(0).random((5, 7, channels)).astype(np.float32)

    def key(**modes: str) -> str:
        texture = {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(texels), **modes}
        place = mi.ScalarTransform4f().scale([2, 3, 1])
        texture["to_uv"] = place
        bsdf = {"type": "diffuse", "reflectance": texture}
        if channels == 1:
            bsdf = {"type": "mask", "opacity": texture, "nested": diffuse(0.5, 0.5, 0.5)}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", PrtWarning)
            shape = {"type": "rectangle", "bsdf": bsdf}
            return Scene.from_mitsuba(mi.load_dict({"type": "scene", "s": shape}), INF).hash

    ways = itertools.product(("bilinear", "nearest"), ("repeat", "mirror", "clamp"))
    hashes = [key(filter_type=kind, wrap_mode=mode) for kind, mode in ways]
    assert len(set(hashes)) == 6
    assert hashes[0] == key()


# ------------------------------------------------------------------------------------- hygiene and errors


def ply_scene(tmp_path: Path, *arguments: list, extra: str = "") -> Scene:
    write_ply(tmp_path / "part.ply", *arguments)
    shape = f'<shape type="ply" id="part"><string name="filename" value="part.ply"/>{extra}</shape>'
    return load_scene(write_xml(tmp_path / "x.xml", shape), INF)


def test_bare_mesh_gets_normals_and_loses_what_is_useless(tmp_path: Path) -> None:
    # Mitsuba's loader gives NaN normals to vertices of triangles without area and to unused ones.
    vertices = [*SQUARE, [2, 0, 0], [5, 5, 5]]
    faces = [[0, 1, 2], [0, 2, 3], [0, 1, 4], [1, 1, 2]]
    with pytest.warns(PrtWarning) as caught:
        scene = ply_scene(tmp_path, vertices, faces)
    assert [str(w.message) for w in caught] == scene.warnings
    assert scene.warnings == [
        "shape 'part': 2 triangles without area are left out",
        "shape 'part': 2 vertices that no triangle uses are left out",
    ]
    np.testing.assert_array_equal(scene.positions, SQUARE)
    np.testing.assert_array_equal(scene.normals, np.tile([0, 0, 1], (4, 1)))


def test_what_many_shapes_have_in_common_is_said_once() -> None:
    plastic, gold = {"type": "roughplastic"}, {"type": "roughconductor", "material": "Au"}
    medium = {"type": "homogeneous", "albedo": 0.5}
    inside_out = {"type": "sphere", "flip_normals": True, "bsdf": gold}
    shapes: dict = {f"p{k}": {"type": "rectangle", "bsdf": plastic} for k in range(5)}
    shapes |= {f"g{k}": inside_out for k in range(2)}
    shapes |= {f"l{k}": {"type": "disk", "emitter": {"type": "area"}} for k in range(4)}
    shapes |= {f"m{k}": {"type": "cube", "interior": medium} for k in range(2)}
    original = mi.load_dict({"type": "scene", **shapes}, optimize=False)
    with pytest.warns(PrtWarning) as caught:
        scene = Scene.from_mitsuba(original, INF)
    assert [str(w.message) for w in caught] == scene.warnings
    begins = [
        "shapes 'p0', 'p1', 'p2' and 2 more: BSDF RoughPlastic is not diffuse; a matrix treats their vertices",
        "shapes 'g0', 'g1': BSDF RoughConductor is not diffuse; a matrix treats their vertices as diffuse",
        "shapes 'l0', 'l1', 'l2' and 1 more are area emitters: matrices of lamps (SceneEmitters) have their",
        "shapes 'm0', 'm1' bound media: these are left out",
        "shapes 'g0', 'g1': faces point inwards: from outside their vertices will be black",
    ]
    assert len(scene.warnings) == len(begins)
    assert all(said.startswith(begin) for said, begin in zip(scene.warnings, begins, strict=True))


def test_cameras_and_lamps_in_media_are_named() -> None:
    fog = {"type": "homogeneous"}
    lamps = {f"lamp{k}": {"type": "point", "medium": fog} for k in range(2)}
    camera = {"type": "perspective", "medium": fog}
    original = mi.load_dict({"type": "scene", "floor": {"type": "rectangle"}, "eye": camera, **lamps})
    with pytest.warns(PrtWarning) as caught:
        Scene.from_mitsuba(original, INF)
    eye, both = sorted((str(w.message) for w in caught), reverse=True)
    assert eye.startswith("sensor 'eye' is inside a medium: media are left out")
    assert re.match("emitters 'lamp.', 'lamp.' are inside media: media are left out", both)


def test_what_cannot_be_used_is_refused_before_any_work(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(surfaces, "clean_mesh", lambda *_: pytest.fail("a mesh was read"))
    monkeypatch.setattr(
        surfaces, "_BECOME_TRIANGLES", {"Disk"}
    )  # as if balls were of a plugin that is not known
    ball, floor = {"type": "sphere"}, {"type": "rectangle"}
    original = mi.load_dict({"type": "scene", "floor": floor, "lid": {"type": "disk"}, "a": ball, "b": ball})
    with pytest.raises(PrtError, match=r"^shapes '.', '.' are of type Sphere.*replace them by a mesh"):
        Scene.from_mitsuba(original, INF)


def test_what_is_left_out_of_many_shapes_is_added_up(tmp_path: Path) -> None:
    write_ply(tmp_path / "part.ply", [*SQUARE, [5, 5, 5]], [[0, 1, 2], [0, 2, 3], [1, 1, 2]])
    shape = '<shape type="ply" id="{}"><string name="filename" value="part.ply"/></shape>'
    content = shape.format("a") + shape.format("b")
    with pytest.warns(PrtWarning):
        scene = load_scene(write_xml(tmp_path / "x.xml", content), INF)
    assert scene.warnings == [
        "shapes 'a', 'b': 2 triangles without area are left out",
        "shapes 'a', 'b': 2 vertices that no triangle uses are left out",
    ]


@pytest.mark.parametrize(("coordinates", "edge_length", "told"), [(0, 0.2, 1), (0, INF, 0), (1, 0.2, 0)])
def test_textures_without_coordinates_are_named_where_triangles_change(
    tmp_path: Path, coordinates: int, edge_length: float, told: int
) -> None:
    bsdf = '<bsdf type="diffuse"><texture name="reflectance" type="checkerboard"/></bsdf>'
    write_ply(tmp_path / "part.ply", SQUARE, [[0, 1, 2], [0, 2, 3]])
    bare = f'<shape type="ply" id="backdrop"><string name="filename" value="part.ply"/>{bsdf}</shape>'
    content = f'<shape type="rectangle" id="backdrop">{bsdf}</shape>' if coordinates else bare
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PrtWarning)
        scene = load_scene(write_xml(tmp_path / "x.xml", content), edge_length)
    named = [note for note in scene.warnings if "no texture coordinates" in note]
    assert len(named) == told and all(note.startswith("shape 'backdrop' has a texture") for note in named)


def test_duplicate_vertices_are_kept(tmp_path: Path) -> None:
    scene = ply_scene(tmp_path, [*SQUARE, SQUARE[0], SQUARE[2]], [[0, 1, 2], [4, 5, 3]])
    assert scene.n_vertices == 6
    assert len(np.unique(scene.vertex_keys)) == 4


def test_unused_far_vertex_does_not_coarsen_the_default_edge(tmp_path: Path) -> None:
    write_ply(tmp_path / "part.ply", [*SQUARE, [1e4, 0, 0]], [[0, 1, 2], [0, 2, 3]])
    shape = '<shape type="ply"><string name="filename" value="part.ply"/></shape>'
    with pytest.warns(PrtWarning, match="1 vertices that no triangle uses"):
        scene = load_scene(write_xml(tmp_path / "x.xml", shape))
    assert scene.n_vertices == 65 * 65


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_positions_that_are_not_finite_are_refused_by_name(tmp_path: Path, bad: float) -> None:
    vertices = [*SQUARE[:2], [1, bad, 0], SQUARE[3]]
    with pytest.raises(PrtError, match=r"part\.ply.*invalid vertex position"):  # by Mitsuba's own loader
        ply_scene(tmp_path, vertices, [[0, 1, 2], [0, 2, 3]])
    mesh = mi.Mesh("part", 4, 2)
    parameters = mi.traverse(mesh)
    parameters["faces"] = mi.UInt32([0, 1, 2, 0, 2, 3])
    parameters["vertex_positions"] = mi.Float(np.array(vertices, np.float32).ravel())
    parameters.update()
    with pytest.raises(PrtError, match=r"shape 'part': vertex 2 has a position that is not finite"):
        build(part=mesh)


@pytest.mark.parametrize("bad", [[float("nan"), 0, 1], [0, 0, 0]])
def test_normals_that_are_not_finite_name_shape_and_vertex(tmp_path: Path, bad: list) -> None:
    normals = [[0, 0, 1], bad, [0, 0, 1], [0, 0, 1]]
    with pytest.raises(PrtError, match=r"shape 'part': vertex 1 has a normal that is zero or not finite"):
        ply_scene(tmp_path, SQUARE, [[0, 1, 2], [0, 2, 3]], normals)


def test_normals_of_the_file_are_kept(tmp_path: Path) -> None:
    normals = np.array([[0.6, 0, 0.8], [0, 0.6, 0.8], [0, 0, 1], [0, -0.6, 0.8]])
    scene = ply_scene(tmp_path, SQUARE, [[0, 1, 2], [0, 2, 3]], normals.tolist())
    np.testing.assert_allclose(scene.normals, normals, atol=1e-7)


def test_indices_out_of_range_are_refused(tmp_path: Path) -> None:
    # Loading such a file may already crash Mitsuba's BVH: the check itself is tested, not the loader.
    positions = np.array(SQUARE, np.float32)
    mesh = TriangleMesh("part", positions, None, np.array([[0, 1, 9]], np.int32))
    with pytest.raises(PrtError, match="shape 'part': triangle 0 refers to a vertex outside 0..3"):
        check_geometry(mesh)


@pytest.mark.parametrize(
    ("shape", "warns"),
    [
        ({"type": "cube", "flip_normals": True}, True),
        ({"type": "cube"}, False),
        ({"type": "sphere", "flip_normals": True}, True),
        ({"type": "sphere"}, False),
        (
            {"type": "cube", "flip_normals": True, "bsdf": {"type": "twosided", "b": {"type": "diffuse"}}},
            False,
        ),
        ({"type": "rectangle", "flip_normals": True}, False),  # open
        ({"type": "cylinder", "flip_normals": True}, False),
    ],
)
def test_inward_faces_are_warned_about(shape: dict, warns: bool) -> None:
    original = mi.load_dict({"type": "scene", "room": shape})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PrtWarning)
        scene = Scene.from_mitsuba(original, INF)
    assert (
        any("shape 'room': faces point inwards" in w and "flip_normals" in w for w in scene.warnings) is warns
    )


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "has no mesh"),
        ("<shape", "cannot be loaded"),
        ('<shape type="teacup"/>', "teacup"),
        ('<shape type="cube"><float name="colour" value="1"/></shape>', "colour"),
        ('<shape type="ply"><string name="filename" value="gone.ply"/></shape>', "gone.ply"),
        (
            '<shape type="disk" id="dot"><transform name="to_world"><scale value="0"/></transform></shape>',
            "x.xml",
        ),
    ],
)
def test_bad_scene_files_are_one_line_errors_that_name_the_file(
    tmp_path: Path, content: str, message: str
) -> None:
    path = write_xml(tmp_path / "x.xml", content)
    with pytest.raises(PrtError) as caught:
        load_scene(path)
    text = str(caught.value)
    assert message in text
    assert str(path) in text
    assert "\n" not in text


def test_missing_file_and_wrong_root(tmp_path: Path) -> None:
    with pytest.raises(PrtError, match=r"gone\.xml does not exist"):
        load_scene(tmp_path / "gone.xml")
    (tmp_path / "shape.xml").write_text('<shape type="cube" version="3.0.0"/>')
    with pytest.raises(PrtError, match="root element must be <scene>"):
        load_scene(tmp_path / "shape.xml")


def test_parameters_reach_the_xml_and_unknown_ones_are_refused(tmp_path: Path) -> None:
    content = (
        '<default name="size" value="1"/><shape type="sphere"><float name="radius" value="$size"/></shape>'
    )
    path = write_xml(tmp_path / "x.xml", content)
    assert load_scene(path).scale == pytest.approx(0.5)
    scene = load_scene(path, size=4)
    assert scene.scale == pytest.approx(0.125)
    assert scene.path == str(path)
    with pytest.raises(PrtError, match="sise"):
        load_scene(path, sise=4)


# ---------------------------------------------------------------------------------------- shipped scenes


@pytest.mark.parametrize(
    ("name", "vertices", "grey"),
    [
        ("bunny", (64075, 64075), True),
        ("dancer", (39218, 39218), True),
        ("spot", (29241 + 3225, 35000), False),
        ("cornell", (10000, 40000), False),
        ("terrace", (10000, 40000), False),
        ("foliage", (20000, 60000), False),
        ("pergola", (20000, 60000), False),
    ],
)
def test_shipped_scenes(name: str, vertices: tuple[int, int], grey: bool) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error", PrtWarning)
        scene = load_scene(SCENES / f"{name}.xml", width=40, height=30, spp=1, max_depth=2)
    assert vertices[0] <= scene.n_vertices <= vertices[1]
    assert scene.diffuse
    assert scene.grey is grey
    assert scene.mitsuba.environment() is not None
    assert len(scene.mitsuba.sensors()) == 1
    # everything stands on the ground, or reaches 0.02 into it; nothing hovers below
    assert -0.021 < scene.positions[:, 1].min() <= 0
    image = np.array(mi.render(scene.mitsuba, spp=1))
    assert image.shape == (30, 40, 3)
    assert np.isfinite(image).all()
    assert image.mean() > 0.05


@pytest.mark.parametrize("maker", ["foliage", "pergola"])
def test_shipped_meshes_are_what_their_scripts_make(
    maker: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same triangles, and vertices within rounding: libraries differ in the last bit."""
    folder = SCENES / "meshes"
    monkeypatch.syspath_prepend(folder)
    runpy.run_path(str(folder / f"{maker}.py"))["main"](tmp_path)
    made = sorted(tmp_path.iterdir())
    assert len(made) >= 3
    for path in made:
        again, shipped = (
            mi.load_dict({"type": "ply", "filename": str(f / path.name)}) for f in (tmp_path, folder)
        )
        assert (again.faces_buffer() == shipped.faces_buffer()).numpy().all()
        np.testing.assert_allclose(
            again.vertex_positions_buffer().numpy(), shipped.vertex_positions_buffer().numpy(), atol=1e-5
        )


def test_shipped_scenes_hash_alike_at_every_load() -> None:
    hashes = {load_scene(SCENES / "dancer.xml").hash for _ in range(3)}
    assert len(hashes) == 1


@pytest.mark.filterwarnings("ignore::mi_sparse_prt.core.errors.PrtWarning")
def test_textures_that_are_not_given_have_no_hash() -> None:
    """Of a hair BSDF with pigments there is no absorption to be read; other pigments are another scene."""
    hashes = []
    for pigment in (0.3, 0.3, 0.6):
        hair = {"type": "hair", "eumelanin": pigment, "pheomelanin": 0.1}
        original = mi.load_dict({"type": "scene", "s": {"type": "rectangle", "bsdf": hair}})
        hashes.append(Scene.from_mitsuba(original, INF).hash)
    assert hashes[0] == hashes[1] != hashes[2]
