"""Triangles from shapes: grids of parametric surfaces, cleaning, subdivision."""

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import mi_sparse_prt as prt
from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.scene.mesh_cleaning import (
    angle_weighted_normals,
    check_geometry,
    drop_degenerate,
    drop_unreferenced,
    face_inwards,
    flip_sides,
    make_unit_normals,
    split_by_face,
    stabilise_normals,
)
from mi_sparse_prt.scene.parametric_shapes import parametric_mesh
from mi_sparse_prt.scene.subdivision import TIE, subdivide
from mi_sparse_prt.scene.triangle_mesh import TriangleMesh, triangle_normals

T = mi.ScalarTransform4f
LIMIT = 100_000


def tetrahedron(flip: bool = False) -> TriangleMesh:
    """A closed mesh with outward faces and outward vertex normals."""
    p = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], np.float32)
    t = np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]], np.int32)
    mesh = TriangleMesh("tetrahedron", p, p / np.float32(np.sqrt(3)), t)
    return flip_sides(mesh) if flip else mesh


def square() -> TriangleMesh:
    """The unit square in z = 0 with texture coordinates and attributes."""
    p = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
    return TriangleMesh(
        "square",
        p,
        np.tile(np.float32([0, 0, 1]), (4, 1)),
        np.array([[0, 1, 2], [0, 2, 3]], np.int32),
        p[:, :2] * np.float32([2, 3]),
        {"vertex_color": p * np.float32(0.5)},
        {"face_id": np.array([[1.0], [2.0]], np.float32)},
    )


def area(mesh: TriangleMesh) -> float:
    return float(np.linalg.norm(triangle_normals(mesh), axis=1).sum() / 2)


def volume(mesh: TriangleMesh) -> float:
    p = mesh.positions.astype(np.float64)[mesh.triangles]
    return float(np.einsum("ij,ij->", p[:, 0], np.cross(p[:, 1], p[:, 2])) / 6)


def welded_edge_counts(mesh: TriangleMesh) -> np.ndarray:
    """How many triangles share each edge, vertices welded by position."""
    _, weld = np.unique(mesh.positions, axis=0, return_inverse=True)
    t = weld.reshape(-1)[mesh.triangles]
    edges = np.sort(np.concatenate([t[:, [0, 1]], t[:, [1, 2]], t[:, [2, 0]]]), axis=1)
    return np.unique(edges, axis=0, return_counts=True)[1]


def longest_edge(mesh: TriangleMesh) -> float:
    p = mesh.positions.astype(np.float64)[mesh.triangles]
    return float(np.linalg.norm(p - np.roll(p, 1, axis=1), axis=2).max())


# --------------------------------------------------------------------------------- parametric surfaces

PLACED = T().translate([1, -2, 3]).rotate([0, 0.6, 0.8], 40)


@pytest.mark.parametrize("flip", [False, True])
@pytest.mark.parametrize(
    ("shape", "scale"),
    [
        ("sphere", [0.7, 0.7, 0.7]),
        ("sphere", [0.7, 0.7, -0.7]),
        ("disk", [0.5, 0.5, 0.5]),
        ("disk", [0.5, 0.8, 0.5]),
        ("disk", [0.5, 0.5, -0.5]),
        ("disk", [-0.5, 0.5, 0.5]),
        ("cylinder", [0.5, 0.5, 2.0]),
        ("cylinder", [0.5, 0.5, -2.0]),
        ("cylinder", [-0.5, 0.5, 2.0]),
    ],
)
def test_grid_lies_on_mitsubas_own_surface(shape: str, scale: list[float], flip: bool) -> None:
    # Positions, normals and (u, v) agree with what a ray to the same point finds, mirrored or flipped.
    from mi_sparse_prt.scene.scene import Scene

    checker = {"type": "diffuse", "reflectance": {"type": "checkerboard"}}  # textured: (u, v) are kept
    placed = {"type": shape, "to_world": PLACED.scale(scale), "flip_normals": flip, "bsdf": checker}
    original = mi.load_dict({"type": "scene", "shape": placed})
    mesh = Scene._build(original, 0.2)._surfaces[0]
    inside = np.all((mesh.texcoords > 0.02) & (mesh.texcoords < 0.98), axis=1)  # rays may miss the very rims
    assert inside.sum() > 50
    p, n, uv = mesh.positions[inside], mesh.normals[inside], mesh.texcoords[inside]
    origin, direction = (p + 0.05 * n).T.copy(), (-n).T.copy()
    si = original.ray_intersect(mi.Ray3f(mi.Point3f(origin), mi.Vector3f(direction)))
    np.testing.assert_allclose(np.array(si.p).T, p, atol=3e-6)
    np.testing.assert_allclose(np.array(si.sh_frame.n).T, n, atol=3e-6)
    np.testing.assert_allclose(np.array(si.uv).T, uv, atol=3e-5)
    # and triangles face the way that their normals point
    facing = np.einsum("ij,ikj->ik", triangle_normals(mesh), mesh.normals[mesh.triangles])
    assert facing.min() > 0


@pytest.mark.parametrize("weld", [False, True])
@pytest.mark.parametrize(
    ("shape", "exact"), [("sphere", 4 * np.pi), ("disk", np.pi), ("cylinder", 2 * np.pi)]
)
def test_grid_has_the_surfaces_area_and_no_empty_triangle(shape: str, exact: float, weld: bool) -> None:
    mesh = parametric_mesh(shape, np.eye(4), 0.05, shape, limit=LIMIT, weld=weld)
    assert exact * (1 - 2e-3) < area(mesh) < exact  # inscribed
    assert drop_degenerate(mesh)[1] == 0
    assert drop_unreferenced(mesh)[1] == 0
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-6)
    counts = welded_edge_counts(mesh)
    assert set(counts) == ({2} if shape == "sphere" else {1, 2})
    assert (mesh.texcoords is None) == weld
    if weld:
        keys = np.column_stack([mesh.positions, mesh.normals]) + np.float32(0)
        assert len(np.unique(keys, axis=0)) == len(mesh.positions)


def test_grid_lines_are_no_further_apart_than_asked() -> None:
    mesh = parametric_mesh("sphere", np.diag([3.0, 3, 3, 1]), 0.25, "s", limit=LIMIT, weld=True)
    assert longest_edge(mesh) <= 0.25 * np.sqrt(2) * (1 + TIE)  # the cells' diagonals
    coarse = parametric_mesh("sphere", np.eye(4), np.inf, "s", limit=LIMIT)
    assert len(coarse.positions) < 700


def test_poles_have_texture_coordinates_of_their_own_cells() -> None:
    mesh = parametric_mesh("sphere", np.eye(4), 0.5, "s", limit=LIMIT)
    u = mesh.texcoords[mesh.triangles][..., 0]
    assert np.ptp(u, axis=1).max() < 0.05  # no triangle spans the seam or the circle around a pole


def test_grid_refuses_excess() -> None:
    with pytest.raises(PrtError, match=r"'s'.*more than 1000 vertices.*larger edge_length"):
        parametric_mesh("sphere", np.eye(4), 0.01, "s", limit=1000)


@pytest.mark.parametrize("shape", ["sphere", "cylinder", "disk"])
def test_uneven_scale_and_shear_give_the_shape_that_rays_meet(shape: str) -> None:
    """Mitsuba's sphere stays one whatever its ``to_world``; its cylinder and disk become elliptic."""
    to_world = T().translate([1, 2, 3]).rotate([0.6, 0.8, 0], 50).scale([1, 1.5, 3])
    to_world = to_world @ mi.ScalarTransform4f([[1, 0.4, 0.2, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    ball = {"type": shape, "to_world": to_world, "bsdf": {"type": "twosided", "b": {"type": "diffuse"}}}
    loaded = mi.load_dict({"type": "scene", "ball": ball})
    scene = prt.Scene.from_mitsuba(loaded, edge_length=0.2)
    positions = mi.Point3f(scene.positions.T.copy())
    normals = mi.Vector3f(scene.normals.T.copy())
    hit = loaded.ray_intersect(mi.Ray3f(positions + normals * 0.1, -normals))
    inside = np.linalg.norm(np.array(hit.p - positions), axis=0) < 1e-3
    assert inside.mean() > 0.9  # some on a disk's or cylinder's edge are missed
    turned = np.abs(np.sum(np.array(hit.n) * scene.normals.T, axis=0))[inside]
    assert turned.min() > 1 - 1e-4


# ------------------------------------------------------------------------------------------ subdivision


def test_subdivision_interpolates_positions_texture_and_attributes() -> None:
    mesh = subdivide(square(), 0.1, LIMIT)
    assert longest_edge(mesh) <= 0.1 * (1 + TIE)
    assert area(mesh) == pytest.approx(1, abs=1e-6)
    np.testing.assert_array_equal(mesh.positions[:4], square().positions)  # the old vertices come first
    np.testing.assert_allclose(mesh.texcoords, mesh.positions[:, :2] * [2, 3], atol=1e-6)
    np.testing.assert_allclose(mesh.vertex_attributes["vertex_color"], mesh.positions * 0.5, atol=1e-6)
    centre = mesh.positions[mesh.triangles].mean(axis=1)
    below = centre[:, 1] < centre[:, 0]  # the square's first triangle
    np.testing.assert_array_equal(mesh.face_attributes["face_id"][:, 0], np.where(below, 1, 2))
    assert np.all(triangle_normals(mesh)[:, 2] > 0)


def test_subdivision_with_infinite_length_changes_nothing() -> None:
    mesh = square()
    assert subdivide(mesh, np.inf, LIMIT) is mesh


def test_subdivision_stops_at_the_limit() -> None:
    with pytest.raises(PrtError, match=r"'square'.*more than 500 vertices.*larger edge_length"):
        subdivide(square(), 0.01, 500)


def test_subdivided_normals_are_unit_and_between_their_neighbours() -> None:
    mesh = subdivide(tetrahedron(), 0.3, LIMIT)
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-6)
    edge_midpoint = np.flatnonzero(np.all(mesh.positions == [1, 0, 0], axis=1))  # between vertices 0 and 1
    np.testing.assert_allclose(mesh.normals[edge_midpoint], [[1, 0, 0]], atol=1e-6)


def test_subdivision_leaves_no_crack_between_faces_that_share_no_vertex() -> None:
    # Faces split apart (facets): both sides of an edge must split at the same points, bit by bit.
    facets = split_by_face(tetrahedron())
    assert len(facets.positions) == 12
    fine = subdivide(facets, 0.37, LIMIT)
    assert set(welded_edge_counts(fine)) == {2}
    assert volume(fine) == pytest.approx(volume(tetrahedron()), rel=1e-6)


@settings(max_examples=40, deadline=None)
@given(
    st.lists(st.tuples(*[st.integers(-20, 20)] * 3), min_size=4, max_size=4, unique=True),
    st.floats(0.05, 1.0),
)
def test_subdivision_of_any_tetrahedron_is_conforming(corners: list, share: float) -> None:
    mesh = tetrahedron()
    mesh.positions = np.array(corners, np.float32) * np.float32(0.37)
    if abs(volume(mesh)) < 1e-3:
        return
    length = share * longest_edge(mesh)
    fine = subdivide(mesh, length, LIMIT)
    assert longest_edge(fine) <= length * (1 + TIE)
    assert set(welded_edge_counts(fine)) == {2}
    assert area(fine) == pytest.approx(area(mesh), rel=1e-5)
    # new vertices are rounded to float32, which moves a flat tetrahedron's faces by a share of its size
    rounding = 1e-7 * area(mesh) * longest_edge(mesh)
    assert volume(fine) == pytest.approx(volume(mesh), rel=1e-4, abs=rounding)


# ---------------------------------------------------------------------------------------------- clean


def test_triangles_without_area_and_unused_vertices_are_dropped() -> None:
    mesh = square()
    mesh.positions = np.concatenate([mesh.positions, np.float32([[9, 9, 9], [2, 0, 0]])])
    mesh.normals = np.tile(np.float32([0, 0, 1]), (6, 1))
    mesh.texcoords, mesh.vertex_attributes = None, {}
    mesh.triangles = np.array([[0, 1, 2], [0, 0, 1], [0, 1, 5], [0, 2, 3]], np.int32)
    mesh.face_attributes = {"face_id": np.arange(4, dtype=np.float32)[:, None]}
    clean, dropped = drop_degenerate(mesh)
    assert dropped == 2
    np.testing.assert_array_equal(clean.face_attributes["face_id"][:, 0], [0, 3])
    clean, unused = drop_unreferenced(clean)
    assert unused == 2
    np.testing.assert_array_equal(clean.positions[clean.triangles], square().positions[square().triangles])


def test_thin_but_real_triangles_are_kept_at_any_scale() -> None:
    thin = np.array([[0, 0, 0], [1, 0, 0], [0.5, 1e-4, 0]])
    for scale in (1e-6, 1.0, 1e6):
        mesh = TriangleMesh("thin", (thin * scale).astype(np.float32), None, np.array([[0, 1, 2]], np.int32))
        assert drop_degenerate(mesh)[1] == 0


def test_bad_geometry_names_shape_and_vertex() -> None:
    mesh = square()
    mesh.positions = mesh.positions.copy()
    mesh.positions[2, 1] = np.nan
    with pytest.raises(PrtError, match=r"shape 'square': vertex 2 has a position that is not finite"):
        check_geometry(mesh)
    mesh = square()
    mesh.triangles = np.array([[0, 1, 2], [0, 2, 4]], np.int32)
    with pytest.raises(PrtError, match=r"shape 'square': triangle 1 refers to a vertex outside 0..3"):
        check_geometry(mesh)


def test_facets_have_one_normal_per_vertex_and_share_what_is_flat() -> None:
    flat = split_by_face(square())
    assert len(flat.positions) == 4
    facets = split_by_face(tetrahedron())
    faces = triangle_normals(facets)
    faces /= np.linalg.norm(faces, axis=1, keepdims=True)
    np.testing.assert_allclose(
        facets.normals[facets.triangles], np.repeat(faces[:, None], 3, axis=1), atol=1e-6
    )
    before, after = tetrahedron(), facets
    np.testing.assert_array_equal(after.positions[after.triangles], before.positions[before.triangles])


def test_angle_weighted_normals_do_not_depend_on_the_triangulation() -> None:
    # A cube's corner gets its diagonal, although its faces are cut into one or two triangles there.
    cube = mi.load_dict({"type": "cube"})
    p = np.array(cube.vertex_positions_buffer()).reshape(-1, 3)
    positions, index = np.unique(p, axis=0, return_inverse=True)
    triangles = index.reshape(-1)[np.array(cube.faces_buffer()).reshape(-1, 3)].astype(np.int32)
    mesh = TriangleMesh("cube", positions.astype(np.float32), None, triangles)
    normals, cancellation = angle_weighted_normals(mesh)
    np.testing.assert_allclose(normals, positions / np.sqrt(3), atol=1e-6)
    np.testing.assert_allclose(cancellation, np.sqrt(3), atol=1e-6)


def test_normals_computed_by_the_loader_are_settled_and_others_kept() -> None:
    mesh = tetrahedron()
    own, _ = angle_weighted_normals(mesh)
    loaded = own + np.float32(2e-7) * np.sign(own)  # what a parallel sum may give
    recomputed = own.copy()
    loaded[1] = recomputed[1] = np.nan  # a corner of a triangle without area
    loaded[2] = [0, 1, 0]  # the file's own
    settled = stabilise_normals(replace(mesh, normals=loaded), recomputed)
    np.testing.assert_array_equal(settled.normals[[0, 1, 3]], own[[0, 1, 3]])
    np.testing.assert_array_equal(settled.normals[2], [0, 1, 0])

    loaded[3] = np.nan
    with pytest.raises(PrtError, match=r"'tetrahedron': vertex 3 has a normal that is zero or not finite"):
        stabilise_normals(replace(mesh, normals=loaded), recomputed)


def test_normals_are_made_unit_and_good_ones_keep_their_bits() -> None:
    mesh = tetrahedron()
    mesh.normals = mesh.normals.copy()
    mesh.normals[1] *= 3
    mesh.normals[2] = 0
    unit, zero = make_unit_normals(mesh)
    assert zero == 1
    np.testing.assert_array_equal(unit.normals[[0, 3]], mesh.normals[[0, 3]])
    np.testing.assert_allclose(unit.normals, tetrahedron().normals, atol=1e-6)


@pytest.mark.parametrize("flip", [False, True])
def test_closed_parts_that_face_inwards_are_found(flip: bool) -> None:
    mesh = tetrahedron(flip)
    assert list(face_inwards([mesh, tetrahedron(), split_by_face(mesh)])) == [
        flip,
        False,
        flip,
    ]  # welded by position
    far = tetrahedron()
    both = TriangleMesh(
        "both",
        np.concatenate([far.positions * 10 + 50, mesh.positions]),  # a large good part hides nothing
        np.concatenate([far.normals, mesh.normals]),
        np.concatenate([far.triangles, mesh.triangles + 4]),
    )
    opened = mesh.take_triangles(np.arange(3))  # may face anywhere
    assert list(face_inwards([both, opened])) == [flip, False]
    assert not len(face_inwards([]))
