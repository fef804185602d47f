"""What cannot matter is not computed: rays are counted where Mitsuba is asked to trace them."""

from collections.abc import Callable, Iterator
from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import COLOURS, GREY, T, build, bumpy_ball, diffuse, few_held_out, mesh, problem_at, still_life
from numpy.typing import NDArray

import mi_sparse_prt as prt
from mi_sparse_prt.core.bits import unpack
from mi_sparse_prt.core.run import Run
from mi_sparse_prt.measurement.vertices import vertex_points
from mi_sparse_prt.methods.consensus_visibility import by_consensus
from mi_sparse_prt.methods.settings import METHODS
from mi_sparse_prt.methods.sparse import sparse_parts
from mi_sparse_prt.operators.interpolated import Interpolated
from mi_sparse_prt.operators.low_rank import LowRank
from mi_sparse_prt.operators.upsampled import Upsampled
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.paths import PathSolver
from mi_sparse_prt.solvers.radiosity import RadiositySolver
from mi_sparse_prt.validation.reference_matrix import ReferenceMatrix

LIGHTING = prt.CubemapLighting(8)
N = LIGHTING.n_directions
COARSE = prt.CubemapLighting(4)  # for whole precomputations
HORIZON = 1e-6  # cosines below are zero, as far as float32 can tell


@pytest.fixture(autouse=True)
def few_held_out_paths(monkeypatch: pytest.MonkeyPatch) -> None:
    """The estimate of the error is not what is tested here, and takes longer than all the rest."""
    few_held_out(monkeypatch, spp=4)


def precompute(scene: prt.Scene, **parameters: object) -> prt.LightTransport:
    return prt.precompute(
        scene, COARSE, **({"method": "brute_force", "spp": 2, "progress": False} | parameters)
    )


# ------------------------------------------------------------------------------------ counting


class RayCount:
    """Rays that are traced, counted on the device: the active lanes of every question that Mitsuba's scenes are asked.

    Attributes
    ----------
    shadow, full : int
        Rays that ask whether there is a surface, and those that ask which one.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self._counts = {"shadow": dr.zeros(mi.UInt32, 1), "full": dr.zeros(mi.UInt32, 1)}
        dr.make_opaque(self._counts)
        for name, kind in (
            ("ray_test", "shadow"),
            ("ray_intersect", "full"),
            ("ray_intersect_preliminary", "full"),
        ):
            monkeypatch.setattr(mi.Scene, name, self._counted(getattr(mi.Scene, name), kind))

    def _counted(self, trace: Callable, kind: str) -> Callable:
        def counted(scene: mi.Scene, ray: mi.Ray3f, *others: object, **named: object) -> object:
            masks = [value for value in (*others, *named.values()) if isinstance(value, mi.Mask)]
            active = masks[-1] if masks else mi.Mask(True)
            # an index as wide as the ray, also while a loop is recorded
            place = dr.select(dr.sum(ray.o) + dr.sum(ray.d) < dr.inf, mi.UInt32(0), mi.UInt32(1))
            dr.scatter_add(self._counts[kind], mi.UInt32(1), place, active)
            return trace(scene, ray, *others, **named)

        return counted

    @property
    def shadow(self) -> int:
        return int(self._counts["shadow"].numpy()[0])

    @property
    def full(self) -> int:
        return int(self._counts["full"].numpy()[0])

    def clear(self) -> None:
        for kind in self._counts:
            self._counts[kind] = dr.zeros(mi.UInt32, 1)
        dr.make_opaque(self._counts)


@pytest.fixture
def rays(monkeypatch: pytest.MonkeyPatch) -> RayCount:
    return RayCount(monkeypatch)


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> Iterator[NDArray[np.int64]]:
    """How often a shadow ray was asked for in sparse methods, by vertex (of 8192 at most) and texel."""
    times = np.zeros((8192, N), np.int64)
    visible = DirectSolver.visible

    def recorded(self: DirectSolver, points: NDArray, texels: NDArray) -> NDArray:
        np.add.at(times, (points, texels), 1)
        return visible(self, points, texels)

    monkeypatch.setattr(DirectSolver, "visible", recorded)
    yield times


def above_horizon(scene: prt.Scene) -> NDArray[np.bool_]:
    """(n_v, n_directions), in double precision."""
    return scene.normals.astype(np.float64) @ LIGHTING.directions.astype(np.float64).T > 0


def undecided(scene: prt.Scene) -> int:
    """How many elements lie on the horizon itself."""
    cosine = scene.normals.astype(np.float64) @ LIGHTING.directions.astype(np.float64).T
    return int((abs(cosine) < HORIZON).sum())


def test_the_count_itself(rays):
    """Masked lanes do not count, nor does the same scene count twice; loops count in every iteration."""
    scene = build(0.5, **still_life())
    ray = mi.Ray3f(mi.Point3f(dr.linspace(mi.Float, -1, 1, 100), 3, 0), mi.Vector3f(0, -1, 0))
    scene.normalised.ray_test(ray)
    scene.normalised.ray_test(ray, active=dr.arange(mi.UInt32, 100) < 30)
    assert (rays.shadow, rays.full) == (130, 0)
    scene.normalised.ray_intersect(ray, dr.arange(mi.UInt32, 100) < 7)
    scene.normalised.ray_intersect_preliminary(ray)
    assert (rays.shadow, rays.full) == (130, 107)
    rays.clear()
    # between two parallel mirrors, so to say: every path has all its bounces
    solver = PathSolver(problem_at(closed_room(), LIGHTING), 4)
    solver.elements(np.arange(8), np.zeros(8, int))
    assert rays.full == 8 * 4 * 3


def closed_room() -> prt.Scene:
    """A white box seen from inside: each path meets a wall, and no shadow ray leaves."""
    return build(2.1, room={"type": "cube", "flip_normals": True, "bsdf": diffuse(1, 1, 1)})


# ------------------------------------------------------------------------------------ indirect light


@pytest.mark.parametrize("method", METHODS)
def test_a_black_scene_needs_no_indirect_ray(rays, method):
    """Indirect light is found by rays that ask which surface they meet.

    Expected: not one of them in a black scene. Methods that choose nothing by the clock trace the same rays as for
    direct light alone.
    """
    black = build(0.5, **still_life(((0, 0, 0),) * 3))
    vertex_points(black)  # which asks what vertices touch
    rays.clear()
    transport = precompute(black, method=method)
    assert rays.full == 0
    assert transport.indirect is None
    assert transport.relight(np.ones((COARSE.n_directions, 3), np.float32)).max() == 0
    if method != "auto":
        whole = rays.shadow
        rays.clear()
        precompute(black, method=method, max_depth=2)
        assert rays.shadow == whole


@pytest.mark.parametrize("method", METHODS)
def test_a_convex_object_alone_needs_no_indirect_ray(rays, method):
    """Shadow rays are enough to tell that no surface sees another one."""
    transport = precompute(build(0.2, ball=BALL), method=method)
    assert rays.full == 0
    assert transport.indirect is None


@pytest.mark.parametrize("method", METHODS)
def test_a_grey_scene_is_computed_and_stored_in_one_channel(monkeypatch, rays, method):
    """Rationale: what is equal is computed once.

    Expected: solvers work in one channel where all albedos are grey, in three where they are not; so much is stored.
    (And their rays are seen by the count.)
    """
    worked: list[int] = []
    elements, gathering = PathSolver.elements, RadiositySolver.indirect

    def traced(self: PathSolver, *rest: object, **named: object) -> object:
        found = elements(self, *rest, **named)
        worked.append(found.mean.shape[-1])
        return found

    def gathered(self: RadiositySolver, *rest: object, **named: object) -> object:
        worked.append(self.channels)
        return gathering(self, *rest, **named)

    monkeypatch.setattr(PathSolver, "elements", traced)
    monkeypatch.setattr(RadiositySolver, "indirect", gathered)
    for albedos, channels in ((GREY, 1), (COLOURS, 3)):
        worked.clear()
        part = precompute(build(0.5, **still_life(albedos)), method=method).indirect
        assert set(worked) == {channels}
        assert stored_channels(part) == channels
    assert rays.full > 1000


def stored_channels(part: Upsampled | Interpolated | LowRank | None) -> int:
    if isinstance(part, LowRank):
        return len(part.left)
    if isinstance(part, Interpolated):
        part = part.dense
    assert isinstance(part, Upsampled)
    return part.density.shape[-1]


def test_three_channels_of_a_grey_scene_are_equal():
    scene = build(0.5, **still_life())
    three, one = (PathSolver(problem_at(scene, LIGHTING), 16) for _ in range(2))
    three.channels = 3
    some = np.arange(0, scene.n_vertices, 7)
    in_three, in_one = three.rows(some).mean, one.rows(some).mean
    assert in_one.max() > 0.01
    assert np.array_equal(in_three, np.repeat(in_one, 3, axis=2))


@pytest.mark.parametrize(("albedo", "most"), [(0.01, 2), (0.2, 6)])
def test_bounces_below_the_bound_are_not_done(albedo, most):
    """Rationale: each bounce is at most an albedo times the one before it, also under all lights together.

    With an albedo of 0.01, bounces after the second are at most 0.01% of the first, and 0.1% may be left out: two
    bounces, not ten. With 0.2, those after bounce b are less than 0.2^b / 0.8 of it: below 0.1% for b = 5; one
    more for what is not an even light.

    Expected: no more bounces than that; and all ten, summed by hand, differ by less than 0.1% of the light where
    it is brightest.
    """
    scene = build(0.25, **still_life(((albedo,) * 3,) * 3))
    solver = RadiositySolver(problem_at(scene, LIGHTING, max_depth=12), 64)
    light = DirectSolver(problem_at(scene, LIGHTING))
    even = np.stack(
        [light.elements(np.arange(scene.n_vertices), np.full(scene.n_vertices, j)) for j in (130, 150)]
    )
    direct = even.T  # [vertex, light]
    count = solver.bounces(direct.sum(axis=1))
    assert 1 <= count <= most

    found = solver.apply(direct)[..., 0]
    exact, bounce = np.zeros_like(direct, np.float64), direct.astype(np.float64)
    for _ in range(10):
        bounce = albedo * (solver.matrix @ bounce)
        exact += bounce
    assert abs(found - exact).max() < 1e-3 * exact.sum(axis=1).max()
    assert abs(found - exact).max() > 0 or count == 10
    white = build(0.25, **still_life(((1.0,) * 3,) * 3))
    every = RadiositySolver(problem_at(white, LIGHTING), 64)
    assert every.bounces(direct.sum(axis=1)) == 3


# ------------------------------------------------------------------------------------ direct light


BALL = {"type": "sphere", "bsdf": diffuse(0.5, 0.5, 0.5)}
BOX = {
    "type": "cube",
    "to_world": T().rotate([1, 0, 0], 20).rotate([0, 1, 0], 40),
    "bsdf": diffuse(0.5, 0.5, 0.5),
}


def by_sparse(direct: DirectSolver) -> NDArray[np.uint32]:
    return sparse_parts(direct, None, Run()).direct.bits


def consensual(direct: DirectSolver) -> NDArray[np.uint32]:
    return by_consensus(direct, Run()).visible


SPARSE = {
    "sparse": (by_sparse, 0.24),
    "consensus": (consensual, 0.1),
}  # and the share of vertices sampled first


def evaluated(scene: prt.Scene, method: str) -> NDArray[np.bool_]:
    """Visibility (n_v, n_directions) by a sparse method."""
    direct = DirectSolver(problem_at(scene, LIGHTING))
    return unpack(SPARSE[method][0](direct), N)


@pytest.mark.parametrize("shape", [BALL, BOX], ids=["ball", "box"])
@pytest.mark.parametrize("method", SPARSE)
def test_a_convex_object_alone_needs_no_sparse_ray(asked, method, shape):
    """Rationale: all is lit down to the horizon, which is known without rays.

    Expected: the vertices that are sampled first get a quarter of their directions, no feature is found, no neighbours
    differ, and other vertices get no ray. On the ball alone one in 10^4 of the elements may: grazing ones, which are
    below the horizon of all neighbours, whose normals differ by an edge's length or more. The result is exact.
    """
    edge = 0.15
    scene = build(edge, convex=shape)
    lit = evaluated(scene, method)
    assert (lit != above_horizon(scene)).sum() <= undecided(scene)
    times = asked[: scene.n_vertices]
    first = sampled_first(scene, times)
    assert 0.4 * SPARSE[method][1] < first.mean() < SPARSE[method][1]
    vertex, texel = np.nonzero(times * ~first[:, None])
    if shape is BOX:
        assert len(vertex) == 0
    assert len(vertex) <= 1e-4 * times.size
    assert ((scene.normals[vertex] * LIGHTING.directions[texel]).sum(axis=1) < edge).all()


def sampled_first(scene: prt.Scene, times: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which vertices (n_v,) got all directions of the quarter grid above their horizon, and no others."""
    cosine = scene.normals.astype(np.float64) @ LIGHTING.directions.astype(np.float64).T
    index = np.arange(N)
    quarter = (index // 8 % 2 == 0) & (index % 2 == 0)
    return ((times == (quarter & (cosine > 0))) | (abs(cosine) < HORIZON)).all(axis=1)


@pytest.mark.parametrize("method", SPARSE)
def test_what_lies_inside_a_solid_is_found_dark_at_once(asked, method):
    """A box is sunk into the ground, and a ball is hidden in it.

    Expected: all is dark there. Of the ball, and of the ground under the middle of the box, only vertices that are
    sampled first get rays, and these a quarter of their directions; of the ball also 0.5% of the other elements, those
    below the horizon of all neighbours. At the sides of the box, where light begins, rays are needed, so that the
    count can fail.
    """
    scene = sunken_box()
    lit = evaluated(scene, method)
    ground, _, ball = (mesh.vertices for mesh in scene.meshes)
    distance = abs(scene.positions[:, [0, 2]]).max(axis=1)
    under = np.arange(scene.n_vertices) < ground.stop
    hidden = np.arange(scene.n_vertices) >= ball.start
    assert not lit[hidden | under & (distance < 1.6)].any()

    times = asked[: scene.n_vertices]
    assert times.max() == 1
    first = sampled_first(scene, times)
    for inside, most in ((under & (distance < 0.8), 0.0), (hidden, 0.005)):
        assert first[inside].mean() < SPARSE[method][1]
        assert times[inside & ~first].mean() <= most
    assert times[under & (abs(distance - 1.61) < 0.1)].mean() > 0.2


def flat(half: float, cells: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices and triangles of a square on the ground."""
    x, z = np.meshgrid(*[np.linspace(-half, half, cells + 1)] * 2)
    index = np.arange(x.size).reshape(x.shape)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    triangles = np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, c, b), (a, d, c))])
    return np.stack([x, 0 * x, z], axis=-1).reshape(-1, 3), triangles


def sunken_box() -> prt.Scene:
    """A ground of 65 x 65 vertices through the middle of a box, and a bumpy ball in the box above it."""
    ball, sides = bumpy_ball(16, 32)
    grey = diffuse(0.5, 0.5, 0.5)
    return build(
        np.inf,
        ground=mesh("ground", *flat(2, 64), grey),
        box={"type": "cube", "to_world": T().scale([1.61, 0.8, 1.61]), "bsdf": grey},
        ball=mesh("ball", 0.5 * ball + [0, 0.4, 0], sides, grey),
    )


@pytest.mark.parametrize("basis", ["direction", "texel"])
def test_no_direct_ray_below_the_horizon(rays, basis):
    """Rationale: a light below the horizon gives nothing, whatever stands in between.

    Expected: rows, and elements asked for one by one, cost one ray per direction above the horizon, and in the texel
    basis one per sample above it: none where a texel's corners are all below, all where they are all above.
    """
    scene = build(0.5, **still_life())
    points, strata = vertex_points(scene), 3
    solver = DirectSolver(problem_at(scene, LIGHTING, points, basis=basis), strata)
    ids = np.arange(scene.n_vertices)
    solver.rows(ids)
    in_rows = rays.shadow
    if basis == "direction":
        assert abs(in_rows - above_horizon(scene).sum()) <= undecided(scene)
    else:
        lowest, highest = corner_cosines(scene)
        least, most = strata**2 * (lowest > HORIZON).sum(), strata**2 * (highest > -HORIZON).sum()
        assert least < in_rows < most < 0.7 * lowest.size * strata**2
        assert in_rows == pytest.approx((least + most) / 2, rel=0.02)
    rays.clear()
    solver.elements(np.repeat(ids, N), np.tile(np.arange(N), len(ids)))
    assert rays.shadow == in_rows
    assert rays.full == 0


def corner_cosines(scene: prt.Scene) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lowest and highest cosine (n_v, n_directions) of a vertex's normal with the corners of a texel."""
    fine = prt.CubemapLighting(16 * LIGHTING.resolution).directions.astype(np.float64)
    blocks = fine.reshape(6, 8, 16, 8, 16, 3)[:, :, [0, -1]][:, :, :, :, [0, -1]]
    corners = blocks.transpose(0, 1, 3, 2, 4, 5).reshape(N, 4, 3)
    cosine = np.einsum("vd,tkd->vtk", scene.normals.astype(np.float64), corners)
    return cosine.min(axis=2), cosine.max(axis=2)


# ------------------------------------------------------------------------------------ and what is not skipped


@pytest.mark.parametrize("method", METHODS)
def test_indirect_light_from_below_the_horizon_is_evaluated(method):
    """A small floor under a tilted, bright roof: light from below passes beside the floor and comes back from the roof.

    Expected: T of the floor below its horizon is not 0. Summed over its vertices and half of these directions it is
    what Mitsuba's ``path`` finds, within 4 standard errors and what a method leaves out: little if it asks for all
    directions, much if for a quarter of only 16 per face.
    """
    scene, floor = under_a_roof()
    texels, expected, spread = from_below()
    transport = precompute(scene, method=method, spp=64, max_depth=3)
    found = transport.rows(floor)[:, texels, 0].astype(np.float64).sum()
    print(f"{method}: {found:.5f} against {expected:.5f} +- {spread:.5f}")
    left_out = {"brute_force": 0.01, "gather": 0.02}.get(method, 0.3)
    assert spread < 0.005 * expected
    assert found == pytest.approx(expected, abs=4 * spread + left_out * expected)


@cache
def under_a_roof() -> tuple[prt.Scene, NDArray[np.int64]]:
    """A scene, and the vertices of its floor."""
    over = T().translate([0.6, 0.9, 0]).rotate([0, 0, 1], 30).rotate([1, 0, 0], 90)
    scene = build(
        0.3,
        floor=mesh("floor", *flat(0.3, 8), diffuse(0.5, 0.5, 0.5)),
        roof={"type": "rectangle", "to_world": over, "bsdf": diffuse(0.9, 0.9, 0.9)},
    )
    return scene, np.arange(scene.meshes[0].vertices.stop)


@cache
def from_below() -> tuple[NDArray[np.int64], float, float]:
    """Texels below the floor's horizon, the sum of T over these and the floor by Mitsuba, and its standard error."""
    scene, floor = under_a_roof()
    texels = np.flatnonzero(COARSE.directions[:, 1] < -1e-3)[::2]
    reference = ReferenceMatrix(scene, COARSE, "direction", 3, floor)
    sums = [reference.columns(texels, spp=64, seed=s)[..., 0].astype(np.float64).sum() for s in range(6)]
    return texels, float(np.mean(sums)), float(np.std(sums, ddof=1) / np.sqrt(len(sums)))
