"""Visible areas of texels from traced edges: tables, areas of squares, analytic occluders, and supersampling."""

from collections import Counter
from dataclasses import replace
from itertools import combinations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import altered, build, bumpy_ball, diffuse, mesh, problem_at

import mi_sparse_prt as prt
from mi_sparse_prt.core.bits import above_horizon, pack, unpack
from mi_sparse_prt.emission.cube_faces import FACE_FRAMES
from mi_sparse_prt.estimation.held_out import held_out_error
from mi_sparse_prt.measurement.measurement import mesh_vertices
from mi_sparse_prt.measurement.vertices import Points, vertex_points
from mi_sparse_prt.operators.fractional_visibility import FractionalVisibility
from mi_sparse_prt.operators.mean_cosine import MeanCosine
from mi_sparse_prt.operators.visibility import Visibility
from mi_sparse_prt.reflection.reflection import Diffuse
from mi_sparse_prt.solvers import texel_edges
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.problem import Problem
from mi_sparse_prt.solvers.texel_edges import STEPS, _cut_off, _quadrant, fractional_visibility

# ------------------------------------------------------------------------------------ which texels meet


def corners(n: int) -> list[list[tuple]]:
    """The four corners of every texel, as points of an integer grid on the cube [-n, n]^3."""
    result = []
    for s_axis, t_axis, centre in FACE_FRAMES.astype(int):
        for row in range(n):
            for column in range(n):
                steps = (
                    (2 * (column + a) - n, 2 * (row + b) - n) for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))
                )
                result.append([tuple(n * centre + s * s_axis + t * t_axis) for s, t in steps])
    return result


@pytest.mark.parametrize("n", [1, 2, 4, 8])
def test_pairs_are_the_texels_with_a_common_side(n):
    """Sides as pairs of corners on the cube: 12 n^2 of them, each of two texels, with the side's middle between."""
    sides, at = prt.CubemapLighting(n).sides, corners(n)
    owners: dict[frozenset, list[int]] = {}
    for texel, c in enumerate(at):
        for k in range(4):
            owners.setdefault(frozenset((c[k], c[(k + 1) % 4])), []).append(texel)
    tables = sides.tables
    pairs = np.flatnonzero(tables.first != tables.second)
    ours = {(tables.first[p], tables.second[p]) for p in pairs}
    assert len(pairs) == len(owners) == 12 * n * n
    assert {tuple(sorted(pair)) for pair in ours} == {tuple(sorted(o)) for o in owners.values()}
    for p in pairs:
        a, b = tables.first[p], tables.second[p]
        common = sorted(set(at[a]) & set(at[b]))
        assert np.allclose(sides.paths[p, 1], np.mean(common, axis=0) / n, atol=1e-6)
        for end, texel in ((0, a), (2, b)):
            assert np.allclose(sides.paths[p, end], np.mean(at[texel], axis=0) / n, atol=1e-6)
        around = set(tables.around[p])
        assert around >= {a, b}
        assert len(around) == 6 - sum(min(map(abs, corner)) == n for corner in common)  # three meet there
        # each is one of the pair, or touches both at an end of their side
        assert all(set(common) & set(at[t]) for t in around)


@pytest.mark.parametrize("n", [1, 2, 4, 8])
def test_quadrants_go_around_a_corner(n):
    """The texels A, B, C, D that a quadrant names have one point in common, or three of them at the cube's corners."""
    sides, at = prt.CubemapLighting(n).sides, corners(n)
    t = sides.tables
    missing = 0
    for a in range(6 * n * n):
        for k in range(4):
            b, c, d = t.beside[a, k], t.beside[a, (k + 1) % 4], t.across[a, k]
            point = set(at[a]) & set(at[b]) & set(at[c])
            assert len(point) == 1
            if d < 0:
                missing += 1
                assert np.abs(list(point)[0]).min() == n
                d = b
            else:
                assert point <= set(at[d])
                assert len({a, b, c, d}) == 4
            for (start, end), way in zip(((a, b), (a, c), (b, d), (c, d)), t.quadrants[a, k], strict=True):
                if start == end:
                    assert way == -1
                    continue
                pair, backwards = divmod(way, 2)
                ends = t.first[pair], t.second[pair]
                assert ends[::-1] == (start, end) if backwards else ends == (start, end)
    assert missing == 24


@pytest.mark.parametrize("n", [1, 2, 4, 8, 16, 32])
def test_crossed_pairs_by_words_and_one_by_one(n):
    rng = np.random.default_rng(n)
    m = 6 * n * n
    seen, known = rng.random((5, m)) < 0.5, rng.random((5, m)) < 0.7
    sides = prt.CubemapLighting(n).sides
    a, b = sides.tables.first, sides.tables.second
    slow = (a != b) & known[:, a] & known[:, b] & (seen[:, a] != seen[:, b])
    assert slow.any()
    assert np.array_equal(unpack(sides.find_crossed(pack(seen), pack(known)), len(a)), slow)


# ------------------------------------------------------------------------------------ areas in a square


def grid(k: int = 200) -> tuple[np.ndarray, np.ndarray]:
    """Midpoints of k x k cells of [0, 1/2]^2."""
    x = (np.arange(k) + 0.5) / (2 * k)
    return np.meshgrid(x, x)


def beyond(p: tuple, q: tuple) -> np.ndarray:
    """Where the grid is on the other side of a line than the origin."""
    x, y = grid()
    cross = (q[0] - p[0]) * (y - p[1]) - (q[1] - p[1]) * (x - p[0])
    origin = (q[0] - p[0]) * -p[1] - (q[1] - p[1]) * -p[0]
    return cross * origin < 0


def test_half_planes_against_a_grid():
    """Lines between random points on two sides of the unit square, and those along its axes and diagonals."""
    rng = np.random.default_rng(0)
    on_side = (lambda t: (t, 0.0), lambda t: (0.0, t), lambda t: (t, 1.0), lambda t: (1.0, t))
    places = np.concatenate([rng.random((60, 2)), np.repeat([[0.25], [0.5], [0.75]], 2, axis=1)])
    for i, j in combinations(range(4), 2):
        for t, u in places:
            p, q = on_side[i](t), on_side[j](u)
            exact = 0.25 * (~beyond(p, q)).mean()
            assert abs(_cut_off(*p, *q) - exact) < 2e-3
            assert abs(_cut_off(*q, *p) - exact) < 2e-3


def test_all_ways_to_cut_a_square():
    """The eight colourings of a square whose corner A is of one kind, against lines on a grid."""
    rng = np.random.default_rng(1)
    for b, c, d in np.ndindex(2, 2, 2):
        for ab, ac, bd, cd in rng.random((20, 4)):
            on = {"ab": (ab, 0.0), "ac": (0.0, ac), "bd": (1.0, bd), "cd": (cd, 1.0)}
            cut = [k for k, differ in zip(on, (b, c, b != d, c != d), strict=True) if differ]
            ours = _quadrant(bool(b), bool(c), b != d, ab, ac, bd, cd) if cut else 0.25
            if len(cut) == 4:  # a band from B to C, or from A to D
                other = beyond(on["ab"], on["ac"]) & ~beyond(on["bd"], on["cd"])
                joined = beyond(on["ab"], on["bd"]) | beyond(on["ac"], on["cd"])
                exact = 0.25 * (1 - (other.mean() + joined.mean()) / 2)
            else:
                exact = 0.25 * (1 - beyond(*(on[k] for k in cut)).mean()) if cut else 0.25
            assert abs(ours - exact) < 3e-3, (b, c, d)


# ------------------------------------------------------------------------------------ analytic occluders


class Sky:
    """Stands for ``DirectSolver`` at one point with a sky that is open where ``open_at(direction)`` says so."""

    def __init__(self, n: int, open_at, normal: tuple = (0, 1, 0)) -> None:
        self.lighting, self._open_at, self._normal = prt.CubemapLighting(n), open_at, normal
        normals = np.array([normal], np.float32)
        self.points = Points(np.zeros((1, 3), np.float32), normals, normals, np.zeros(1, np.uint64))
        self.above = above_horizon(self.points.normals, self.lighting.directions)
        self.bits = pack(self._seen(self.lighting.directions)[None]) & self.above

    def _seen(self, directions: np.ndarray) -> np.ndarray:
        return self._open_at(mi.Vector3f(np.ascontiguousarray(directions.T))).numpy()

    def trace(self, point: mi.UInt32, direction: mi.Vector3f, active: mi.Mask) -> tuple[mi.Mask, mi.Float]:
        cosine = dr.dot(mi.Normal3f(*self._normal), direction)
        return active & (cosine > 0) & self._open_at(direction), cosine

    def exact(self, k: int = 16) -> np.ndarray:
        """Cosine-weighted shares of all texels by k x k points; those below the horizon are 0."""
        directions, weights = self.lighting.subdirections(k)
        cosine = np.maximum(directions @ np.array(self._normal, np.float32), 0) * weights
        seen = self._seen(directions.reshape(-1, 3)).reshape(weights.shape)
        return (seen * cosine).sum(axis=1) / np.pi


def errors(sky: Sky) -> tuple[np.ndarray, np.ndarray]:
    """Errors of all texels in units of their own solid angle / pi: of areas, and of centres."""
    exact, scale = sky.exact(), np.pi / sky.lighting.solid_angles
    ours = fractional_visibility(sky, sky.bits)[0].rows(np.arange(1))[0, :, 0]
    centres = Visibility(sky.bits, sky.points.normals, sky.lighting).rows(np.arange(1))[0, :, 0]
    return (ours - exact) * scale, (centres - exact) * scale


def cap(axis: np.ndarray, least: float):
    """Open where the cosine to an axis is above some value; one kernel for all of them."""
    x, y, z, w = (dr.opaque(mi.Float, float(value)) for value in (*axis, least))
    return lambda d: dr.dot(d, mi.Vector3f(x, y, z)) > w


def half_spaces(count: int, seed: int) -> np.ndarray:
    axes = np.random.default_rng(seed).normal(size=(count, 3))
    return axes / np.linalg.norm(axes, axis=1, keepdims=True)


def test_an_edge_that_is_a_great_circle():
    """A half-plane over the point: its edge is straight on every face, at random angles.

    Expected: a crossing is known within 1/32 of the way, and so are shares, plus half a 255th and what the cosine
    changes within a texel (1/16 at n = 16) times a share's distance from its middle: together 0.05. The mean error of
    all texels on the edge is next to nothing. Centres are wrong by up to a half.
    """
    ours, centres = [], []
    for axis in half_spaces(12, 3):
        found = errors(Sky(16, cap(axis, 0)))
        ours.append(found[0])
        centres.append(found[1])
    ours, centres = np.concatenate(ours), np.concatenate(centres)
    cut = np.abs(centres) > 1e-3
    assert np.abs(centres).max() > 0.4
    assert np.abs(ours).max() < 0.05
    assert np.sqrt((ours**2).sum() / (centres**2).sum()) < 0.08
    assert abs(ours[cut].mean()) < 0.002


@pytest.mark.parametrize("radius", [0.3, 0.6])
def test_a_disk_before_the_sky(radius):
    """A round occluder, off the faces' centres and across edges of the cube.

    Expected: chords leave it smaller by the length of a chord, at most 1.4 texels of 1/8, squared over 12 radii, so
    that the sum of all errors is positive, and within 15% of that of the centres' absolute ones (a quarter of a texel
    on the average).
    """
    ours, centres = [], []
    for axis in half_spaces(8, 4):
        axis[1] = abs(axis[1])
        found = errors(Sky(16, cap(-axis, -np.cos(radius))))
        ours.append(found[0])
        centres.append(found[1])
    ratio = np.sqrt(np.sum(np.square(centres)) / np.sum(np.square(ours)))
    assert ratio > 8
    assert 0 < np.sum(ours) / np.sum(np.abs(centres)) < 0.15


def gravel(share: float, seed: int, fine: float = 90.0):
    """A sky cut into pieces by a grid of cubes, so many to a unit; at random a share of them is open."""

    def open_at(d: mi.Vector3f) -> mi.Mask:
        at = mi.Vector3i(dr.floor(d * fine))
        mixed = mi.UInt32(at.x) * 73856093 ^ mi.UInt32(at.y) * 19349663 ^ mi.UInt32(at.z) * 83492791
        return mi.sample_tea_float32(mixed, mi.UInt32(seed)) < share

    return open_at


@pytest.mark.parametrize("share", [0.1, pytest.param(0.9, marks=pytest.mark.slow)], ids=["specks", "holes"])
def test_what_is_finer_than_texels_does_not_get_lost(share):
    """Rationale: a speck has a centre in it as often as its area says; if it then counts by its area, most is lost.

    Expected: over 20 skies of open specks, or of dark ones, four fifths of them are there: where two centres beside
    each other are in specks, these are taken for one of their true width.
    Result: 86 and 87%; if all count by their area, 12%.
    """

    skies = [Sky(16, gravel(share, seed)) for seed in range(20)]
    own = [fractional_visibility(sky, sky.bits)[0].rows(np.arange(1))[0, :, 0].sum() for sky in skies]
    exact = [sky.exact().sum() for sky in skies]
    rare = lambda x: np.mean(x) if share < 0.5 else 1 - np.mean(x)  # noqa: E731
    ratio = float(rare(own) / rare(exact))
    print(ratio)
    assert 0.8 < ratio < 1.05


@pytest.mark.parametrize("n", [1, 2, 4, 8, 32])
def test_an_open_and_a_closed_sky(n):
    """No ray, no list. All light together is 1 if there is any: a white point under radiance 1."""
    for bright in (True, False):
        sky = Sky(n, lambda d, b=bright: dr.full(mi.Mask, b, dr.width(d)), normal=(0.6, 0.64, 0.48))
        part, rays = fractional_visibility(sky, sky.bits)
        assert rays == len(part.texels) == len(part.shares) == 0
        assert part.starts.tolist() == [0, 0]
        light = part.relight(np.ones((6 * n * n, 3), np.float32))
        assert np.abs(light - bright).max() < 0.02 / n
    assert not part.bits.any()


def test_single_wrong_bits_are_found_out():
    """One centre in a hundred is wrong, as a method that guesses may leave them.

    Expected: rays towards it from all sides find no edge before its very centre, so that little of it is wrong.
    """
    sky = Sky(16, cap(np.array([0.6, 0.64, -0.48]), 0.2))
    wrong = pack(np.random.default_rng(5).random((1, 1536)) < 0.01) & sky.above
    sky.bits = sky.bits ^ wrong
    part, rays = fractional_visibility(sky, sky.bits)
    ours, centres = errors(sky)
    assert rays > 0
    assert np.abs(centres).max() > 0.7
    assert np.sqrt((centres**2).sum() / (ours**2).sum()) > 10


# ------------------------------------------------------------------------------------ against supersampling


class CountingScene:
    """Counts the rays of a scene that are really traced."""

    def __init__(self, scene: mi.Scene) -> None:
        self.scene, self.traced = scene, 0

    def ray_test(self, ray: mi.Ray3f, active: mi.Mask) -> mi.Mask:
        self.traced += int(np.count_nonzero((active & dr.full(mi.Mask, True, dr.width(ray))).numpy()))
        return self.scene.ray_test(ray, active=active)


def bits_of(direct: DirectSolver) -> np.ndarray:
    return direct.rows(np.arange(len(direct.points)))


def traced(scene: prt.Scene, n: int, every: int = 1) -> DirectSolver:
    points = vertex_points(scene)
    return DirectSolver(
        problem_at(scene, prt.CubemapLighting(n), chosen(points, np.arange(0, len(points), every)))
    )


def chosen(points: Points, ids: np.ndarray) -> Points:
    normals = points.normals[ids]
    offsets = normals if points.offset_normals is points.normals else points.offset_normals[ids]
    return Points(points.positions[ids], normals, offsets, points.keys[ids])


def supersampled(direct: DirectSolver, strata: int) -> MeanCosine:
    fine = DirectSolver(replace(direct.problem, basis="texel"), strata, direct.seed)
    ids = np.arange(len(direct.points))
    rows = [fine.rows(ids[a : a + fine.block_size]) for a in range(0, len(ids), fine.block_size)]
    return MeanCosine(np.concatenate(rows), direct.lighting)


@pytest.mark.parametrize(("n", "every"), [(16, 3), (32, 12)])
def test_five_times_nearer_than_centres(grey_scene, n, every):
    """Some vertices of a still life against 8 x 8 rays in each texel.

    Expected: a fifth of the error of centre sampling; no bias, the sum of all elements within 0.2%.
    """
    direct = traced(grey_scene, n, every)
    truth = supersampled(direct, 8)
    bits = bits_of(direct)
    ids = np.arange(len(bits))
    exact = truth.rows(ids)
    part, rays = fractional_visibility(direct, bits)
    norms = [
        np.linalg.norm(x.rows(ids) - exact)
        for x in (Visibility(bits, direct.points.normals, direct.lighting), part)
    ]
    print("ratio", norms[0] / norms[1], "error", norms[1] / np.linalg.norm(exact))
    assert norms[0] > 5 * norms[1]
    assert abs(part.rows(ids).sum(dtype=np.float64) / exact.sum(dtype=np.float64) - 1) < 0.002
    assert rays < 0.5 * len(bits) * direct.lighting.n_directions / 2


def same(a: FractionalVisibility, b: FractionalVisibility) -> bool:
    names = ("bits", "starts", "texels", "shares", "normals")
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in names)


def test_the_order_of_vertices_and_blocks_does_not_matter(grey_scene, monkeypatch):
    direct = traced(grey_scene, 4)
    bits = bits_of(direct)
    whole, rays = fractional_visibility(direct, bits)
    monkeypatch.setattr(texel_edges, "BLOCK", 150)
    again, rays_again = fractional_visibility(direct, bits)
    assert same(whole, again) and rays == rays_again > 0
    order = np.random.default_rng(0).permutation(len(bits))
    other = DirectSolver(direct.problem.at(chosen(direct.points, order)))
    assert same(fractional_visibility(other, bits_of(other))[0], whole.take(order))


def test_rays_are_those_that_were_traced(grey_scene):
    direct = traced(grey_scene, 8)
    bits = bits_of(direct)
    direct.scene = CountingScene(direct.scene)
    part, rays = fractional_visibility(direct, bits)
    sides = direct.lighting.sides
    above = above_horizon(grey_scene.normals, direct.lighting.directions)
    crossed = np.bitwise_count(sides.find_crossed(bits, above)).sum()
    assert rays == STEPS * crossed
    assert abs(direct.scene.traced - rays) <= STEPS  # and one lane more
    listed = Counter(np.repeat(np.arange(len(bits)), np.diff(part.starts)).tolist())
    assert max(listed.values()) < 6 * 64


def test_smaller_than_a_word(grey_scene):
    """n = 1 and 2: 6 and 24 texels, where every one is at an edge of the cube."""
    for n in (1, 2):
        direct = traced(grey_scene, n)
        bits = bits_of(direct)
        exact = supersampled(direct, 16).rows(np.arange(len(bits)))
        part, _ = fractional_visibility(direct, bits)
        ours = part.rows(np.arange(len(bits)))
        centres = Visibility(bits, grey_scene.normals, direct.lighting).rows(np.arange(len(bits)))
        assert np.linalg.norm(ours - exact) < 0.5 * np.linalg.norm(centres - exact)


def test_a_convex_object_alone_has_no_edge():
    scene = build(1.0, ball=mesh("ball", *bumpy_ball(), diffuse(1, 1, 1)))
    flat = build(1.0, plane={"type": "rectangle", "bsdf": diffuse(1, 1, 1)})
    assert fractional_visibility(traced(flat, 8), bits_of(traced(flat, 8)))[1] == 0
    assert fractional_visibility(traced(scene, 8), bits_of(traced(scene, 8)))[1] > 0


def test_held_out_elements_tell_the_error(grey_scene):
    """The estimate of the error from a few elements, mean of three seeds, against all elements by 8 x 8 rays."""
    direct = traced(grey_scene, 8)
    part, _ = fractional_visibility(direct, bits_of(direct))
    transport = prt.precompute(
        grey_scene, direct.lighting, method="brute_force", basis="texel", max_depth=2, progress=False
    )
    transport = altered(transport, direct=part)
    exact = altered(transport, direct=supersampled(direct, 8)).rows(np.arange(len(direct.points)))
    ours = transport.rows(np.arange(len(direct.points)))
    truth = np.linalg.norm(ours - exact) / np.linalg.norm(exact)
    problem = Problem(
        grey_scene, direct.lighting, mesh_vertices(grey_scene), Diffuse(grey_scene.albedo), "texel", 2
    )
    runs = [held_out_error(problem, transport, seed).report() for seed in (10, 11, 12)]
    found = np.mean([run["total"] for run in runs])
    width = np.sqrt(sum(run["standard_error"]["total"] ** 2 for run in runs)) / 3
    assert width < 0.15 * truth
    assert abs(found - truth) < 3 * width
