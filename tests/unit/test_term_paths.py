"""Terms of glossy BRDFs by paths: shared with white light, right frame and weight, against integrals by quadrature."""

from collections.abc import Callable

import mitsuba as mi
import numpy as np
import pytest
from conftest import T, build, diffuse, problem_at

import mi_sparse_prt as prt
from mi_sparse_prt.measurement.measurement import mesh_vertices
from mi_sparse_prt.measurement.vertices import vertex_points
from mi_sparse_prt.reflection.brdf_factors import BrdfFactors, DirectionGrid
from mi_sparse_prt.reflection.factor_tables import table_directions
from mi_sparse_prt.reflection.frames import frames, orthogonalise
from mi_sparse_prt.reflection.in_out_factors import InOutFactors
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.solvers.paths import PathSolver
from mi_sparse_prt.solvers.problem import Problem
from mi_sparse_prt.solvers.term_paths import TermPaths

pytestmark = pytest.mark.filterwarnings("ignore:.*is not diffuse")

ALBEDO = 0.7
HALF, HEIGHT = 1.0, 0.8  # of the ceiling


def lobes(w: np.ndarray) -> np.ndarray:
    """Two terms at directions (m, 3) of a frame: a lobe, and one of either sign."""
    bright = np.array([0.5, 0.2, 0.84])
    return w[:, 2:] * np.stack(
        [np.exp(6 * (w @ bright - 1)), w[:, 0] ** 2 - 0.3 * w[:, 0] * w[:, 1] - 0.05], axis=1
    )


def waves(w: np.ndarray) -> np.ndarray:
    """Two terms of another material."""
    return w[:, 2:] * np.stack([0.3 + w[:, 1], np.cos(3 * w[:, 0])], axis=1)


def cosines(w: np.ndarray) -> np.ndarray:
    """A term like white light, and twice that with the other sign."""
    return w[:, 2:] / np.pi * [1, -2]


def problem_of(
    scene: Scene,
    glossy: np.ndarray,
    materials: np.ndarray,
    functions: list[Callable],
    lighting: prt.CubemapLighting,
    max_depth: int,
) -> Problem:
    """Some vertices are glossy, in frames turned at random; of their BRDFs only the incident factors matter."""
    grid = DirectionGrid(256, 512)  # as good as the functions themselves
    factors = tuple(
        BrdfFactors(
            grid,
            np.zeros(1),
            f(grid.directions).T.astype(np.float32),
            np.zeros((2, 1, len(grid.directions)), np.float32),
        )
        for f in functions
    )
    material = np.full(scene.n_vertices, -1)
    material[glossy] = materials
    along = np.random.default_rng(3).normal(size=(len(glossy), 3)).astype(np.float32)
    tangents = np.zeros_like(scene.normals)
    tangents[glossy] = orthogonalise(along, scene.normals[glossy])
    reflection = InOutFactors(scene.albedo, tangents, scene.normals, material, factors)
    return Problem(scene, lighting, mesh_vertices(scene), reflection, max_depth=max_depth)


@pytest.mark.parametrize("max_depth", [3, 5])
def test_white_light_is_that_of_path_transport(grey_scene, max_depth):
    lighting, points = prt.CubemapLighting(4), vertex_points(grey_scene)
    glossy = np.arange(0, grey_scene.n_vertices, 2)
    problem = problem_of(grey_scene, glossy, np.zeros_like(glossy), [lobes], lighting, max_depth)
    rng = np.random.default_rng(1)
    ids = rng.integers(0, grey_scene.n_vertices, 500), rng.integers(0, lighting.n_directions, 500)
    found = TermPaths(problem, 8, seed=5).elements(*ids)
    known = PathSolver(problem_at(grey_scene, lighting, points, max_depth=max_depth), 8, seed=5).elements(
        *ids
    )
    assert found.mean.shape == found.variance.shape == (500, 3)
    assert np.count_nonzero(known.mean) > 50
    np.testing.assert_allclose(found.mean[:, :1], known.mean, rtol=1e-6)
    np.testing.assert_allclose(found.variance[:, :1], known.variance, rtol=1e-4, atol=1e-9)
    dull = ids[0] % 2 == 1
    assert not found.mean[dull, 1:].any()
    assert np.count_nonzero(found.mean[~dull, 1]) > 20


def test_a_cosine_gives_white_light(grey_scene):
    """Path by path: with 2 of them per element the terms could not agree if they were others.

    Up to the tables, which are coarse at the horizon: a path in a thousand may be far off, all together by 0.02%.
    """
    lighting, every = prt.CubemapLighting(4), np.arange(grey_scene.n_vertices)
    problem = problem_of(grey_scene, every, np.zeros_like(every), [cosines], lighting, 4)
    found = TermPaths(problem, 2).rows(every).mean
    white, same, other = np.moveaxis(found.astype(np.float64), -1, 0)
    assert np.count_nonzero(white) > 1000
    assert np.linalg.norm(same - white) < 0.01 * np.linalg.norm(white)
    assert np.allclose(other, -2 * same, rtol=1e-4, atol=1e-6)
    assert abs(same.sum() / white.sum() - 1) < 1e-3


def test_negative_bsdfs_change_the_sign_of_each_bounce():
    """Between two surfaces of BRDF -r instead of r, light of odd numbers of bounces is negative, path by path.

    Bounces of the positive one are differences of ``max_depth``; from the fifth on roulette has its say.
    """
    lighting, every, bounces = prt.CubemapLighting(2), np.arange(8), np.arange(1, 8)

    def between(sign: float) -> Scene:
        wall = factored_wall(0.9, sign)
        turn = T().translate([0, 0.5, 0]).rotate([1, 0, 0], 90)
        return build(
            float("inf"),
            floor={"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90), "bsdf": wall},
            ceiling={"type": "rectangle", "to_world": turn, "bsdf": wall},
        )

    positive, negative = between(1), between(-1)
    points = vertex_points(positive)  # for both: random numbers are those of points

    def found(scene: Scene, max_depth: int) -> np.ndarray:
        paths = PathSolver(problem_at(scene, lighting, points, max_depth=max_depth), 512)
        return paths.rows(every).mean[..., 0].astype(np.float64)

    totals = np.array([np.zeros((8, 24)), *(found(positive, 2 + count) for count in bounces)])
    each = np.diff(totals, axis=0)  # [bounce, vertex, texel]
    assert (each.sum(axis=(1, 2)) > 0).all()
    known = np.einsum("bvj,b->vj", each, (-1.0) ** bounces)
    assert known.sum() < -0.1 * totals[-1].sum()
    np.testing.assert_allclose(found(negative, 2 + bounces[-1]), known, atol=1e-5 * totals.max())


def factored_wall(albedo: float, sign: float) -> dict:
    """A BSDF like a diffuse one, or its negative."""
    f = table_directions(64)[:, 2].reshape(64, 64, 1) * (albedo / np.pi)
    g = np.full((64, 64, 1, 3), sign)
    tables = (mi.TensorXf(np.ascontiguousarray(x, np.float32)) for x in (f, g))
    return {"type": "in_out_factors"} | dict(zip(("incident", "outgoing"), tables, strict=True))


def test_under_a_bright_ceiling():
    """A small floor under a diffuse ceiling that is lit from below and beside, the floor's shadow missing it.

    The ceiling's radiance is ALBEDO / pi times a cosine everywhere: a term is that times the integral of f_k over what
    the ceiling covers, here by quadrature on it. Two materials, a vertex that is not glossy, all in a slanted place.

    Expected: each of the terms 2% too large, over all its elements, would be 5 standard errors away; it is within 3.
    Deviations of single elements have the size that the variances say.
    """
    place = T().rotate([0, 1, 0], 25).rotate([1, 0, 0], 37)
    scene = build(
        float("inf"),
        floor={
            "type": "rectangle",
            "to_world": place @ T().rotate([1, 0, 0], -90).scale(0.1),
            "bsdf": diffuse(0.5, 0.5, 0.5),
        },
        ceiling={
            "type": "rectangle",
            "to_world": place @ T().translate([0, HEIGHT, 0]).rotate([1, 0, 0], 90).scale(HALF),
            "bsdf": diffuse(ALBEDO, ALBEDO, ALBEDO),
        },
    )
    lighting, points = prt.CubemapLighting(4), vertex_points(scene)
    turn = np.array(place.matrix)[:3, :3]
    texels, radiance = texels_beside(lighting.directions @ turn)
    glossy, materials, functions = np.array([0, 2, 3]), np.array([0, 1, 0]), [lobes, waves]
    problem = problem_of(scene, glossy, materials, functions, lighting, max_depth=3)
    paths = TermPaths(problem, spp=1 << 15)
    found = paths.elements(np.repeat(np.arange(4), len(texels)), np.tile(texels, 4))
    mean, variance = (x.reshape(4, -1, 3).astype(np.float64) for x in (found.mean, found.variance))
    assert not mean[1, :, 1:].any()
    covered, weight = quadrature(scene, points.positions)
    turned = frames(problem.reflection.tangents[glossy], scene.normals[glossy])
    for i, material, frame in zip(glossy, materials, turned, strict=True):
        local = covered[i] @ frame.T.astype(np.float64)
        known = radiance[:, None] * (weight[i] @ functions[material](local))  # [texel, term]
        sums, error = known.sum(axis=0), np.sqrt(variance[i, :, 1:].sum(axis=0))
        off = mean[i, :, 1:].sum(axis=0) - sums
        print(f"vertex {i}: {off / sums}, standard errors {error / np.abs(sums)}")
        assert (error < 0.02 / 5 * np.abs(sums)).all()
        assert (np.abs(off) < 3 * error).all()
        white = radiance * (weight[i] @ local[:, 2]) / np.pi
        assert abs(mean[i, :, 0].sum() / white.sum() - 1) < 0.01
        ratio = ((mean[i, :, 1:] - known) ** 2 / variance[i, :, 1:]).mean()
        assert abs(ratio - 1) < 5 * np.sqrt(2 / known.size)


def texels_beside(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lights from below that are so slanted that the floor's shadow is not on the ceiling, and its radiance."""
    shift = np.abs(directions[:, [0, 2]]).max(axis=1) * HEIGHT / np.maximum(-directions[:, 1], 1e-6)
    texels = np.flatnonzero((directions[:, 1] < 0) & (shift > HALF + 0.1))
    assert len(texels) >= 10
    return texels, ALBEDO / np.pi * -directions[texels, 1].astype(np.float64)


def quadrature(scene: Scene, origins: np.ndarray, steps: int = 200) -> tuple[np.ndarray, np.ndarray]:
    """Directions to the ceiling from some points, (n, steps^2, 3), and solid angles around them; normalised frame."""
    own = scene.meshes[1].vertices
    corners = scene.normalised_positions[own].astype(np.float64)
    normal = scene.normals[own.start].astype(np.float64)
    first = corners[0]
    order = np.argsort(np.linalg.norm(corners - first, axis=1))  # itself, two neighbours, the opposite corner
    u, v = corners[order[1]] - first, corners[order[2]] - first
    axis = (np.arange(steps) + 0.5) / steps
    s, t = (x.ravel()[:, None] for x in np.meshgrid(axis, axis))
    away = first + s * u + t * v - origins[:, None]
    area = np.linalg.norm(np.cross(u, v)) / steps**2
    distance = np.linalg.norm(away, axis=2, keepdims=True)
    directions = away / distance
    return directions, area * np.maximum(-(directions @ normal), 0) / distance[..., 0] ** 2
