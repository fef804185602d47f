"""Tangents of triangles are Mitsuba's own, and vertices have the mean of those around them."""

import mitsuba as mi
import numpy as np
import pytest

import mi_sparse_prt as prt
from mi_sparse_prt.reflection.frames import triangle_tangents, vertex_tangents

BRUSHED = {"type": "ashikhmin_shirley", "exponent_u": 5.0, "exponent_v": 60.0}
LIGHTING = prt.CubemapLighting(2)


def mesh_scene(positions: np.ndarray, triangles: np.ndarray, uv: np.ndarray | None = None) -> prt.Scene:
    """One brushed mesh with Mitsuba's normals."""
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(BRUSHED)
    shape = mi.Mesh(
        "sheet",
        len(positions),
        len(triangles),
        props=properties,
        has_vertex_normals=True,
        has_vertex_texcoords=uv is not None,
    )
    parameters = mi.traverse(shape)
    parameters["faces"] = mi.UInt32(triangles.astype(np.uint32).ravel())
    parameters["vertex_positions"] = mi.Float(positions.astype(np.float32).ravel())
    if uv is not None:
        parameters["vertex_texcoords"] = mi.Float(uv.astype(np.float32).ravel())
    parameters.update()
    with pytest.warns(prt.PrtWarning, match="AshikhminShirley is not diffuse"):
        return prt.Scene.from_mitsuba(mi.load_dict({"type": "scene", "sheet": shape}), float("inf"))


def sheet(n: int = 9) -> tuple[np.ndarray, np.ndarray]:
    """An uneven sheet (n * n, 3) over the square from -1 to 1, and its triangles."""
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(-1, 1, n), np.linspace(-1, 1, n)))
    z = 0.2 * np.sin(3 * x + y) + 0.05 * np.random.default_rng(0).random(len(x))
    i = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    triangles = np.concatenate([np.stack([i, i + 1, i + n + 1], 1), np.stack([i, i + n + 1, i + n], 1)])
    return np.stack([x, y, z], axis=1), triangles


def mitsubas(scene: prt.Scene) -> tuple[np.ndarray, np.ndarray]:
    """dp/du (n_t, 3) in the middle of each triangle, of length 1, and the tangents of triangles."""
    shape, mesh = scene.mitsuba.shapes()[0], scene.meshes[0]
    corners = scene.positions[mesh.triangles]
    middle, normal = corners.mean(axis=1), np.cross(*(corners[:, k] - corners[:, 0] for k in (1, 2)))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    si = scene.mitsuba.ray_intersect(mi.Ray3f(mi.Point3f((middle + 0.1 * normal).T), mi.Vector3f(-normal.T)))
    along = np.array(si.dp_du).T
    return along / np.linalg.norm(along, axis=1, keepdims=True), triangle_tangents(shape, mesh.triangles)


@pytest.mark.parametrize("mapping", ["none", "turned", "mirrored", "flat"])
def test_triangles_have_mitsubas_tangents(mapping):
    positions, triangles = sheet()
    x, y = positions[:, 0], positions[:, 1]
    uv = {
        "none": None,
        "turned": np.stack([x + 0.5 * y, 2 * y - x], axis=1),
        "mirrored": np.stack([np.abs(x), y], axis=1),
        "flat": np.zeros((len(x), 2)),
    }[mapping]
    theirs, ours = mitsubas(mesh_scene(positions, triangles, uv))
    np.testing.assert_allclose(ours, theirs, atol=2e-4)


def test_vertices_have_the_mean():
    """On a cylinder around Z, u going around it, both halves mirrored: no vertex is off by a facet's angle.

    Expected: the analytic tangent, up to its sign, within rounding: facets to either side make up for each other.
    """
    rounds, rows = 24, 4
    phi, z = (a.ravel() for a in np.meshgrid(np.linspace(0, np.pi, rounds), np.linspace(0, 1, rows)))
    positions = np.stack([np.cos(phi), np.sin(phi), z], axis=1)
    i = (np.arange(rows - 1)[:, None] * rounds + np.arange(rounds - 1)).ravel()
    triangles = np.concatenate(
        [np.stack([i, i + 1, i + rounds + 1], 1), np.stack([i, i + rounds + 1, i + rounds], 1)]
    )
    scene = mesh_scene(positions, triangles, np.stack([np.abs(phi - phi[11]), z], axis=1))
    found = vertex_tangents(scene)
    inside = (phi > 0.01) & (phi < np.pi - 0.01)
    around = np.stack([-np.sin(phi), np.cos(phi), np.zeros_like(phi)], axis=1)
    along = np.abs(np.einsum("nd,nd->n", found, around))[inside]
    assert np.degrees(np.arccos(np.minimum(along, 1))).max() < 0.1
    np.testing.assert_allclose(np.einsum("nd,nd->n", found, scene.normals), 0, atol=1e-6)


def test_brushed_surfaces_without_coordinates_are_named(recwarn):
    positions, triangles = sheet(4)
    bare, mapped = mesh_scene(positions, triangles), mesh_scene(positions, triangles, positions[:, :2])
    with pytest.warns(prt.PrtWarning, match="'sheet': its BSDF is anisotropic and it has no texture coordin"):
        prt.precompute_glossy(bare, LIGHTING, terms=1, max_depth=2, progress=False)
    recwarn.clear()
    prt.precompute_glossy(mapped, LIGHTING, terms=1, max_depth=2, progress=False)
    assert not [w for w in recwarn if "anisotropic" in str(w.message)]
