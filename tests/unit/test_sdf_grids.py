"""Distance grids as triangles, against the rays that Mitsuba sends into them."""

from __future__ import annotations

from collections.abc import Sequence

import mitsuba as mi
import numpy as np
import pytest
from conftest import T
from numpy.typing import NDArray

from mi_sparse_prt import PrtError
from mi_sparse_prt.scene.mitsuba_meshes import build_mitsuba_mesh
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.scene.sdf_grids import sdf_mesh
from mi_sparse_prt.scene.triangle_mesh import TriangleMesh

STRETCHED = T().translate([1, 2, 3]).scale([2, 1, 1.5])


def grid_of(
    centre: Sequence[float], radius: float, shape: Sequence[int] = (24, 24, 24), **others: object
) -> mi.Shape:
    """An `sdfgrid` of a ball in the unit cube; `shape` along z, y, x."""
    z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in shape), indexing="ij")
    away = np.linalg.norm(np.stack([x, y, z], -1) - centre, axis=-1) - radius
    return mi.load_dict(
        {"type": "sdfgrid", "grid": mi.TensorXf(away[..., None].astype(np.float32)), **others}
    )


def triangles_of(shape: mi.Shape, edge_length: float, limit: int = 10**6) -> TriangleMesh:
    """Its triangles, at least 32 cells along its longest side."""
    to_world = np.array(mi.traverse(shape)["to_world"].matrix, np.float64).reshape(4, 4)
    return sdf_mesh(shape, to_world, edge_length, "blob", limit=limit, fewest=32)


def first_hits(shape: mi.Shape, rays: mi.Ray3f) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Whether rays meet it, how far away, and both normals there."""
    si = mi.load_dict({"type": "scene", "shape": shape}).ray_intersect(rays)
    return si.is_valid().numpy(), si.t.numpy(), si.n.numpy().T, si.sh_frame.n.numpy().T


@pytest.mark.parametrize(("centre", "radius"), [((0.5, 0.45, 0.55), 0.3), ((0.5, 0.5, 0.1), 0.35)])
def test_triangles_are_where_rays_meet_the_grid(centre: Sequence[float], radius: float) -> None:
    """The second ball is cut open by the box: rays look into it, as they do in Mitsuba."""
    shape = grid_of(centre, radius, to_world=STRETCHED)
    mesh = triangles_of(shape, 0.05)
    random = np.random.default_rng(1)
    middle, around = np.array([[2.0], [2.5], [3.75]]), random.normal(size=(3, 20_000))
    origin = middle + 4 * around / np.linalg.norm(around, axis=0)
    towards = middle + random.uniform(-0.7, 0.7, (3, 20_000)) - origin
    towards /= np.linalg.norm(towards, axis=0)
    rays = mi.Ray3f(mi.Point3f(origin.astype(np.float32)), mi.Vector3f(towards.astype(np.float32)))
    met, t, n, sh_n = first_hits(shape, rays)
    own_met, own_t, own_n, own_sh_n = first_hits(build_mitsuba_mesh(mesh, shape.bsdf()), rays)
    both = met & own_met
    assert both.mean() > 0.2
    assert np.mean(met != own_met) < 1e-3
    assert np.quantile(np.abs(t[both] - own_t[both]), 0.999) < 0.02  # 2 is the box's width
    assert np.quantile(np.sum(n * own_n, axis=1)[both], 0.001) > 0.98
    assert np.mean(np.sum(sh_n * own_sh_n, axis=1)[both]) > 0.9998  # a degree


def test_vertices_have_the_distance_zero_and_mitsubas_normals() -> None:
    shape = grid_of((0.5, 0.5, 0.5), 0.3)
    mesh = triangles_of(shape, 0.04)
    assert mesh.normals is not None
    beyond = mesh.positions + 0.01 * mesh.normals
    hit, t, _, sh_n = first_hits(shape, mi.Ray3f(mi.Point3f(beyond.T), mi.Vector3f(-mesh.normals.T)))
    hit &= t < 0.1  # rays slip through between cells, and meet the other side
    assert hit.mean() > 0.9
    assert np.abs(t[hit] - 0.01).max() < 1e-4
    assert np.sum(sh_n * mesh.normals, axis=1)[hit].min() > 0.999
    a, b, c = (mesh.positions[mesh.triangles[:, k]].astype(np.float64) for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
    assert area == pytest.approx(4 * np.pi * 0.3**2, rel=0.01)
    assert max(np.linalg.norm(b - a, axis=1).max(), np.linalg.norm(c - b, axis=1).max()) < 0.04 * np.sqrt(3)


def test_cells_of_a_fine_grid_are_kept() -> None:
    coarse, fine = (triangles_of(grid_of((0.5,) * 3, 0.3, (n, n, n)), np.inf) for n in (33, 65))
    assert len(fine.positions) == pytest.approx(4 * len(coarse.positions), rel=0.05)


def test_surfaces_through_points_of_the_grid_have_no_triangles_without_area() -> None:
    """Rationale: an octahedron goes exactly through points of a grid of 32 cells: marching cubes make triangles of one
    point there.

    Expected: all triangles have an area, its sum is the octahedron's, and each vertex is in one of them.
    """
    x, y, z = np.meshgrid(*(np.linspace(-0.5, 0.5, 33),) * 3)
    away = np.abs(x) + np.abs(y) + np.abs(z) - 0.25
    shape = mi.load_dict({"type": "sdfgrid", "grid": mi.TensorXf(away[..., None].astype(np.float32))})
    mesh = triangles_of(shape, np.inf)
    a, b, c = (mesh.positions[mesh.triangles[:, k]].astype(np.float64) for k in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    assert areas.min() > 0 and areas.sum() == pytest.approx(4 * np.sqrt(3) * 0.25**2, rel=0.01)
    assert set(mesh.triangles.ravel()) == set(range(len(mesh.positions)))


def test_instances_of_a_grid_are_copied() -> None:
    group = {"type": "shapegroup", "blob": grid_of((0.5,) * 3, 0.3)}
    places = {
        f"i{k}": {
            "type": "instance",
            "to_world": T().translate([2 * k, 0, 0]),
            "group": {"type": "ref", "id": "g"},
        }
        for k in range(2)
    }
    scene = Scene.from_mitsuba(mi.load_dict({"type": "scene", "g": group, **places}))
    assert np.ptp(scene.positions, axis=0) == pytest.approx([2.6, 0.6, 0.6], abs=0.005)


def test_the_shape_keeps_its_name() -> None:
    """Rationale: Mitsuba names shapes anew in each scene that they are put into."""
    scene = mi.load_dict({"type": "scene", "blob": grid_of((0.5,) * 3, 0.3)}, optimize=False)
    for _ in range(2):
        assert [mesh.name for mesh in Scene.from_mitsuba(scene).meshes] == ["blob"]
    assert [shape.id() for shape in scene.shapes()] == ["blob"]


def test_too_fine_cells_are_refused() -> None:
    with pytest.raises(PrtError, match="'blob'.*vertices"):
        triangles_of(grid_of((0.5,) * 3, 0.3), 1e-4)


def test_grids_that_mitsubas_rays_miss_are_refused() -> None:
    """Should a later Mitsuba meet them, the first line fails, and the refusal can go."""
    shape = grid_of((0.5,) * 3, 0.3, (12, 14, 16))
    x, y = np.random.default_rng(2).uniform(0.4, 0.6, (2, 1000))
    rays = mi.Ray3f(mi.Point3f(x, y, np.full(1000, 2.0)), mi.Vector3f(0, 0, -1))
    assert first_hits(shape, rays)[0].mean() < 0.5
    with pytest.raises(PrtError, match="shape 'blob': its grid is not as long in all directions"):
        triangles_of(shape, 0.1)
