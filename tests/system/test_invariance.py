"""What must not change a matrix: scale, place, orientation, order, block size, threads."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import COLOURS, T, build, bumpy_ball, diffuse, mesh, problem_at, still_life
from matplotlib.figure import Figure
from scipy import stats

import mi_sparse_prt as prt
from mi_sparse_prt.measurement.vertices import vertex_points
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.paths import Estimate, PathSolver

LIGHTING = prt.CubemapLighting(8)
COARSE = prt.CubemapLighting(2)


def direct(scene: prt.Scene) -> np.ndarray:
    """All elements of the direct part, (vertices, 384)."""
    n = scene.n_vertices
    solver = DirectSolver(problem_at(scene, LIGHTING))
    white = solver.elements(np.repeat(np.arange(n), 384), np.tile(np.arange(384), n)).reshape(n, 384)
    return scene.albedo[:, :1] * white


def indirect(scene: prt.Scene, seed: int, spp: int = 256) -> Estimate:
    """All elements of the indirect part at n = 2."""
    points = vertex_points(scene)
    return PathSolver(problem_at(scene, COARSE, points), spp, seed=seed).rows(np.arange(len(points)))


def relative(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.linalg.norm(a.astype(np.float64) - b) / np.linalg.norm(b.astype(np.float64)))


def assert_same_in_distribution(a: Estimate, b: Estimate, columns: np.ndarray | None = None) -> np.ndarray:
    """Two independent estimates agree: in total within 3 standard errors, which a 2% bias exceeds; row sums by KS."""
    theirs = b.mean if columns is None else b.mean[:, columns]
    difference = (a.mean - theirs).sum(axis=(1, 2), dtype=np.float64)
    error = np.sqrt((a.variance + b.variance).sum(axis=(1, 2), dtype=np.float64))
    total, together = b.mean.sum(dtype=np.float64), np.sqrt((error**2).sum())
    print(f"indirect: {difference.sum() / total:+.3%} +- {together / total:.3%}")
    assert 3 * together < 0.015 * total
    assert abs(difference.sum()) < 3 * together
    lit = error > 0
    z = difference[lit] / error[lit]
    assert stats.kstest(z, "norm").pvalue > 1e-3
    return z


def draw(difference: np.ndarray, reference: np.ndarray, z: np.ndarray | None = None) -> Figure:
    """Relative L2 of each row, and the z-scores of the indirect part's rows."""
    figure = Figure(figsize=(9, 3))
    left, right = figure.subplots(1, 2)
    norm = np.maximum(np.linalg.norm(reference, axis=1), 1e-30)
    left.semilogy(np.linalg.norm(difference, axis=1) / norm + 1e-9, ".", ms=3)
    left.set(xlabel="vertex", ylabel="difference of its row, relative L2 (+ 1e-9)", ylim=(5e-10, 1))
    if z is not None:
        right.hist(z, 30, range=(-4, 4), density=True)
        right.set(xlabel="z of the indirect rows")
    return figure


# ------------------------------------------------------------------------------------ where the scene is


@pytest.mark.parametrize("scale", [1e-4, 1e4])
def test_scale(grey_scene, artefact, scale):
    """Rationale: Mitsuba's ray offsets are absolute near the origin; a scene's unit of length must not matter.

    The ball and the box over the ground, 1e-4 and 1e4 times as large. All 384 columns of the direct part; the
    indirect
    part at n = 2 with 256 paths, other random numbers on either side.

    Expected: direct within 1e-4 in relative L2; indirect the same within 3 standard errors (of 0.3%: 2% would show).

    Result: direct 1e-7; indirect +0.2% and 0.0%, +- 0.3%.
    """
    scaled = build(0.5 * scale, **still_life(place=T().scale(scale)))
    a, b = direct(scaled), direct(grey_scene)
    print(f"direct: relative L2 {relative(a, b):.2e}")
    z = assert_same_in_distribution(indirect(scaled, seed=1), indirect(grey_scene, seed=2))
    artefact(draw(a - b, b, z))
    assert relative(a, b) < 1e-4


def moved_meshes(scene: prt.Scene, offset: np.ndarray, rounded_only: bool) -> dict:
    """The scene's meshes at an offset, in float32; or, ``rounded_only``, brought back without further rounding."""
    shapes = {}
    for k, part in enumerate(scene.meshes):
        there = (scene.positions[part.vertices].astype(np.float64) + offset).astype(np.float32)
        vertices = there.astype(np.float64) - offset if rounded_only else there
        shapes[part.name] = mesh(part.name, vertices, part.triangles, diffuse(*(0.5 + 0.1 * k,) * 3))
    return shapes


@pytest.mark.parametrize("sizes", [pytest.param(1, marks=pytest.mark.slow), 1000])
def test_place(grey_scene, artefact, sizes):
    """Rationale: a scene far from the origin loses what float32 positions lose there, and nothing more.

    The scene moved along the diagonal by its size, and by 1000 times its size: there the spacing of float32 is 2^-12
    (8e-5 of the scene). For comparison the same rounded vertices brought back to the origin.

    Expected: moved against rounded: direct within 1e-4 in relative L2, indirect the same in distribution. Against
    the original nothing is promised but what rounding costs: it is measured.

    Result: no difference from the rounded scene. From the original 4e-7 at one size, 5e-3 at 1000 sizes.
    """
    offset = sizes * 3.0 * np.array([1, 1, 1])
    moved, rounded = (build(float("inf"), **moved_meshes(grey_scene, offset, only)) for only in (False, True))
    a, b, original = direct(moved), direct(rounded), direct(grey_scene)
    print(
        f"direct: {relative(a, b):.2e} against rounded vertices, {relative(a, original):.2e} against the original"
    )
    z = assert_same_in_distribution(indirect(moved, seed=1), indirect(rounded, seed=2))
    artefact(draw(a - original, original, z))
    assert relative(a, b) < 1e-4
    if sizes == 1:
        assert relative(a, original) < 0.01


def test_quarter_turn(grey_scene, artefact):
    """Rationale: a quarter turn about the vertical maps texels onto texels, so columns change places and
    nothing else.

    The scene turned by exactly 90 degrees (x -> -z). Column j of the original is the column of the turned texel.

    Expected: at most one direct element in 10000 differs (a border vertex whose triangles are equally wide may move
    into another one of these, and light that grazes an edge with it); indirect the same in distribution. Without the
    permutation it is far off.

    Result: 0.003% differ, 0.6% in relative L2 (87% without the permutation); indirect 0.0% +- 0.3%.
    """
    matrix = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    place = np.eye(4)
    place[:3, :3] = matrix
    turned = build(0.5, **still_life(place=mi.ScalarTransform4f(place)))
    np.testing.assert_allclose(turned.positions, grey_scene.positions @ matrix.T, atol=1e-6)
    to = LIGHTING.texel_of(LIGHTING.directions @ matrix.T.astype(np.float32))
    assert len(set(to)) == 384
    a, b = direct(turned), direct(grey_scene)
    differs = (np.abs(a[:, to] - b) > 1e-4 * b.max()).mean()
    print(
        f"direct: {differs:.4%} differ, relative L2 {relative(a[:, to], b):.2e}; unpermuted {relative(a, b):.2f}"
    )
    to_coarse = COARSE.texel_of(COARSE.directions @ matrix.T.astype(np.float32))
    there, here = indirect(turned, seed=1), indirect(grey_scene, seed=2)
    permuted = Estimate(there.mean[:, to_coarse], there.variance[:, to_coarse])
    z = assert_same_in_distribution(permuted, here)
    artefact(draw(a[:, to] - b, b, z))
    assert differs < 1e-4
    assert relative(a[:, to], b) < 0.01
    assert relative(a, b) > 0.3


# ------------------------------------------------------------------------------------ order


def rows_by_key(scene: prt.Scene, basis: str) -> tuple[np.ndarray, np.ndarray]:
    """Rows of a whole precomputation sorted by the keys of their vertices, and the keys."""
    transport = prt.precompute(
        scene, COARSE, method="brute_force", basis=basis, spp=4, seed=7, progress=False
    )
    order = np.argsort(transport.measurement.keys)
    return transport.rows(order), transport.measurement.keys[order]


def shuffled(scene: prt.Scene, seed: int) -> prt.Scene:
    """The same surfaces: shapes, vertices and triangles in another order (0: in the scene's own).

    Normals are given and tilted a little, so that they are the file's own and not computed at loading.
    """
    tilted = scene.normals + 0.05 * np.random.default_rng(99).normal(size=scene.normals.shape)
    tilted = (tilted / np.linalg.norm(tilted, axis=1, keepdims=True)).astype(np.float32)
    rng = np.random.default_rng(seed)
    shapes = {}
    for k in rng.permutation(len(scene.meshes)) if seed else range(len(scene.meshes)):
        part = scene.meshes[k]
        n = part.vertices.stop - part.vertices.start
        order = rng.permutation(n) if seed else np.arange(n)  # new vertex i was vertex order[i]
        triangles = np.argsort(order)[part.triangles]
        triangles = triangles[rng.permutation(len(triangles))] if seed else triangles
        vertices = scene.positions[part.vertices][order]
        shape = mesh(part.name, vertices, triangles, diffuse(*COLOURS[k]))
        parameters = mi.traverse(shape)
        parameters["vertex_normals"] = mi.Float(tilted[part.vertices][order].ravel())
        parameters.update()
        shapes[part.name] = shape
    return build(float("inf"), **shapes)


@pytest.mark.parametrize("basis", ["direction", "texel"])
def test_order_of_shapes_vertices_and_triangles(coloured_scene, basis, artefact):
    """Rationale: random numbers belong to a vertex, not to its number.

    The coloured scene with shapes, vertices and triangles shuffled; a whole precomputation, same seed.

    Expected: the same keys and, vertex by vertex, bit-identical rows.

    Result: they are.
    """
    first, second = (shuffled(coloured_scene, seed) for seed in (0, 1))
    assert not np.array_equal(first.positions, second.positions)
    assert first.hash == second.hash
    (a, a_keys), (b, b_keys) = rows_by_key(first, basis), rows_by_key(second, basis)
    artefact(draw((a - b).reshape(len(a), -1), a.reshape(len(a), -1)))
    assert len(np.unique(a_keys)) == len(a_keys)
    assert np.array_equal(a_keys, b_keys)
    assert np.array_equal(a, b)


def test_order_of_triangles_whose_normals_are_computed(artefact):
    """Rationale: a scene's hash is said not to depend on the order of triangles, nor may computed normals.

    The bumpy ball without normals in its file; 20 orders of its triangles.

    Expected: the same hash, the same normals to the last bit.

    Result: normals within 1e-7; components that cancel to zero are where the order would show.
    """
    vertices, triangles = bumpy_ball()
    orders = [np.random.default_rng(k).permutation(len(triangles)) for k in range(20)]
    scenes = [
        build(float("inf"), ball=mesh("ball", vertices, triangles[order], diffuse(0.5, 0.5, 0.5)))
        for order in orders
    ]
    difference = np.array([scene.normals - scenes[0].normals for scene in scenes])
    artefact(draw(difference.transpose(1, 0, 2).reshape(len(vertices), -1), np.ones((len(vertices), 1))))
    assert np.abs(difference).max() < 1e-7
    assert len({scene.hash for scene in scenes}) == 1


def test_merged_shapes(artefact):
    """Rationale: a user's own `mi.load_file` merges meshes of one material and shuffles shapes.

    Ground, ball and box of one material, and a second ground that touches the first along an edge, with and without
    Mitsuba's optimisation.

    Expected: fewer meshes, the same hash and keys, bit-identical rows.

    Result: they are.
    """
    shapes = still_life(((0.5,) * 3,) * 3)
    second = {**shapes["ground"], "to_world": T().translate([3, 0, 0]) @ shapes["ground"]["to_world"]}
    apart, merged = (build(0.5, optimize=o, **shapes, second=second) for o in (False, True))
    assert len(merged.meshes) < len(apart.meshes)
    assert apart.hash == merged.hash
    (a, a_keys), (b, b_keys) = rows_by_key(apart, "direction"), rows_by_key(merged, "direction")
    artefact(draw((a - b).reshape(len(a), -1), a.reshape(len(a), -1)))
    assert np.array_equal(a_keys, b_keys)
    assert np.array_equal(a, b)


# ------------------------------------------------------------------------------------ machinery


@pytest.mark.parametrize("basis", ["direction", "texel"])
def test_block_size(coloured_scene, basis, monkeypatch, artefact):
    """Rationale: how many rows share a wavefront is a matter of memory.

    A whole precomputation with wavefronts of 2^22 and more lanes, and of 2^14: two to five blocks of rows,
    with a rest.

    Expected: bit-identical rows, and the same estimate of the error.

    Result: they are.
    """
    whole = prt.precompute(coloured_scene, COARSE, method="brute_force", basis=basis, spp=4, progress=False)
    monkeypatch.setattr("mi_sparse_prt.solvers.direct_rays.LANES", 1 << 12)
    monkeypatch.setattr("mi_sparse_prt.solvers.paths.LANES", 1 << 14)
    parts = prt.precompute(coloured_scene, COARSE, method="brute_force", basis=basis, spp=4, progress=False)
    ids = np.arange(coloured_scene.n_vertices)
    a, b = whole.rows(ids), parts.rows(ids)
    artefact(draw((a - b).reshape(len(a), -1), a.reshape(len(a), -1)))
    assert np.array_equal(a, b)
    assert whole.report["estimated_error"] == parts.report["estimated_error"]


def test_number_of_threads(coloured_scene, artefact):
    """Rationale: no sum is left to the order in which threads arrive.

    A whole precomputation with all threads of Dr.Jit, and with one.

    Expected: bit-identical rows.

    Result: they are.
    """
    many = prt.precompute(coloured_scene, COARSE, method="brute_force", basis="texel", spp=4, progress=False)
    threads = dr.thread_count()
    dr.set_thread_count(1)
    try:
        one = prt.precompute(
            coloured_scene, COARSE, method="brute_force", basis="texel", spp=4, progress=False
        )
    finally:
        dr.set_thread_count(threads)
    ids = np.arange(coloured_scene.n_vertices)
    a, b = many.rows(ids), one.rows(ids)
    artefact(draw((a - b).reshape(len(a), -1), a.reshape(len(a), -1)))
    assert np.array_equal(a, b)
