"""The gather matrix against geometry known in closed form, and the factored solution against plain linear algebra."""

from dataclasses import dataclass

import drjit as dr
import numba
import numpy as np
import pytest
import scipy.sparse
from conftest import COLOURS, T, build, diffuse, problem_at, still_life

import mi_sparse_prt as prt
from mi_sparse_prt.core.errors import PrtError
from mi_sparse_prt.core.sparse_product import add_scaled, multiply_scaled, multiply_sparse
from mi_sparse_prt.measurement.vertices import vertex_points
from mi_sparse_prt.operators.by_depth import ByDepth
from mi_sparse_prt.operators.column_blocks import ColumnBlocks
from mi_sparse_prt.operators.interpolated import Interpolated
from mi_sparse_prt.operators.mean_cosine import MeanCosine
from mi_sparse_prt.operators.operator import Operator
from mi_sparse_prt.operators.sparse_rows import SparseRows
from mi_sparse_prt.operators.visibility import Visibility
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.solvers import first_bounce as bounce_module
from mi_sparse_prt.solvers import form_factors as matrix_module
from mi_sparse_prt.solvers import radiosity as gather_module
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.solvers.first_bounce import RandomBasis
from mi_sparse_prt.solvers.form_factors import gather_matrix
from mi_sparse_prt.solvers.radiosity import FiniteElements, LowRankOptions, RadiositySolver
from mi_sparse_prt.solvers.surface_nodes import Nodes

WHITE = diffuse(1, 1, 1)
ROOM = {"type": "cube", "flip_normals": True}


def solver(
    scene: Scene, n: int = 2, rays: int = 64, max_depth: int = 5, **parameters: object
) -> RadiositySolver:
    return RadiositySolver(problem_at(scene, prt.CubemapLighting(n), max_depth=max_depth), rays, **parameters)


def visibility(scene: Scene, n: int = 4) -> Visibility:
    lighting, points = prt.CubemapLighting(n), vertex_points(scene)
    bits = DirectSolver(problem_at(scene, lighting, points)).rows(np.arange(len(points)))
    return Visibility(bits, scene.normals, lighting)


def neumann(gather: RadiositySolver, direct: np.ndarray, albedo: np.ndarray, bounces: int) -> np.ndarray:
    """Dense float64 sums of G rho D + (G rho)^2 D + ..., (n_v, n, 3)."""
    operator, found = gather.matrix.toarray().astype(np.float64), []
    for rho in albedo.T.astype(np.float64):
        light, total = direct.astype(np.float64), 0
        for _ in range(bounces):
            light = operator @ (rho[:, None] * light)
            total = total + light
        found.append(total)
    return np.stack(found, axis=-1)


def relative(value: np.ndarray, known: np.ndarray) -> float:
    return float(np.linalg.norm(value - known) / np.linalg.norm(known))


# ------------------------------------------------------------------------------------------ the matrix


def under_a_ceiling() -> tuple[Scene, np.ndarray]:
    """A floor and a smaller ceiling off its middle; the ceiling's corners (4, 3), in order around it."""
    floor = {"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90), "bsdf": WHITE}
    turn = T().translate([0.3, 0.8, 0.1]).rotate([1, 0, 0], 90).scale(0.6)
    scene = build(0.3, floor=floor, ceiling={"type": "rectangle", "to_world": turn, "bsdf": WHITE})
    corners = np.array([[x, 0.8, z] for x, z in ((-0.3, -0.5), (0.9, -0.5), (0.9, 0.7), (-0.3, 0.7))])
    return scene, corners


def test_what_a_floor_gathers_from_a_ceiling():
    """Shares and first moments of a rectangle's view, against its kernel cos cos' / (pi r^2) integrated on a fine grid.

    The sum of a row is the form factor; the row times x, which is linear on the triangles, is that of x. Mean over 32
    seeds, each vertex within 4.5 standard errors (49 vertices, 3 integrals).
    """
    scene, corners = under_a_ceiling()
    floor, points = scene.meshes[0].vertices, vertex_points(scene)
    ceiling = scene.meshes[1].vertices
    weights = np.concatenate([np.ones((scene.n_vertices, 1)), scene.positions[:, [0, 2]]], axis=1)
    weights[floor] = 0
    runs = np.array([(gather_matrix(scene, points, 1024, seed) @ weights)[floor] for seed in range(32)])

    m = 300
    x, z = (corners[0, k] + 1.2 * (np.arange(m) + 0.5) / m for k in (0, 2))
    centre = points.positions[floor] / scene.scale + scene.centre  # where the rays start
    dx, dz = x - centre[:, :1], z - centre[:, 2:]  # [vertex, place]
    height = 0.8 - centre[:, 1, None, None]
    kernel = height**2 / (np.pi * (dx[:, :, None] ** 2 + dz[:, None] ** 2 + height**2) ** 2) * (1.2 / m) ** 2
    known = np.stack([(kernel * w).sum(axis=(1, 2)) for w in (1, x[:, None], z)], axis=1)
    error = runs.std(axis=0, ddof=1) / np.sqrt(len(runs))
    assert error.max() < 0.003
    assert len(known) == floor.stop > 40
    assert ceiling.start == floor.stop
    assert (np.abs(runs.mean(axis=0) - known) < 4.5 * error + 1e-4).all()


@pytest.mark.filterwarnings("ignore:.*faces point inwards")
def test_sums_of_rows(coloured_scene):
    """At most 1, and 1 in a closed room, where every ray meets a front."""
    matrix = solver(coloured_scene).matrix
    assert matrix.data.min() > 0
    assert 0 < matrix.sum(axis=1).max() <= 1
    assert matrix.dtype == np.float32
    assert matrix.has_canonical_format
    assert (matrix.data * 64 % 1 == 0).all()
    room = solver(build(0.7, room={**ROOM, "bsdf": WHITE})).matrix
    assert np.array_equal(room.sum(axis=1), np.ones(room.shape[0]))


def test_one_sided_surfaces_are_black_from_behind():
    """A floor under the back of a one-sided ceiling gathers nothing."""
    floor = {"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90), "bsdf": WHITE}
    over = {"type": "rectangle", "to_world": T().translate([0, 1, 0]).rotate([1, 0, 0], -90), "bsdf": WHITE}
    assert solver(build(0.5, floor=floor, over=over)).matrix.nnz == 0


def test_more_rays_are_better_than_by_chance():
    """The spread over seeds falls faster than 1 / sqrt(rays): 64 times the rays, at least 16 times less, and not 8."""
    scene, _ = under_a_ceiling()
    points, floor = vertex_points(scene), scene.meshes[0].vertices
    few, many = (
        np.array([gather_matrix(scene, points, rays, seed).sum(axis=1)[floor] for seed in range(16)])
        for rays in (16, 1024)
    )
    assert many.std(axis=0).mean() < few.std(axis=0).mean() / 16


def test_same_seed_same_matrix_whatever_the_order(coloured_scene):
    def by_key(scene: Scene, seed: int = 3) -> np.ndarray:
        order = np.argsort(vertex_points(scene).keys)
        return solver(scene, seed=seed).matrix[order][:, order].toarray()

    known = by_key(coloured_scene)
    backwards = build(**dict(reversed(still_life(COLOURS).items())))
    assert not np.array_equal(backwards.positions, coloured_scene.positions)
    assert np.array_equal(by_key(backwards), known)
    other = by_key(coloured_scene, seed=4)
    assert (other != known)[(known > 0) | (other > 0)].mean() > 0.3


def test_blocks_change_nothing_and_share_a_kernel(grey_scene, monkeypatch):
    arguments = grey_scene, vertex_points(grey_scene), 64
    known = gather_matrix(*arguments)
    monkeypatch.setattr(matrix_module, "LANES", 64 * 50)
    gather_matrix(*arguments)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        some = gather_matrix(*arguments)
        kernels = [k for k in dr.kernel_history((dr.KernelType.JIT,)) if k["size"] >= 64]
    assert len(known.indptr) > 5 * 50
    assert not any(k["cache_miss"] for k in kernels if "cache_miss" in k)
    assert len({k["hash"] for k in kernels}) < 6
    for name in ("indptr", "indices", "data"):
        assert np.array_equal(getattr(some, name), getattr(known, name))


def test_what_cannot_be_gathered_is_refused():
    with pytest.raises(PrtError, match="100 is not a power of two"):
        solver(build(shape={"type": "cube"}), rays=100)


# ------------------------------------------------------------------------------------------ products


@pytest.mark.parametrize("width", [1, 3, 64, 101])
def test_product(width):
    rng = np.random.default_rng(0)
    matrix = scipy.sparse.random_array((300, 200), density=0.05, rng=rng, dtype=np.float32).tocsr()
    matrix.data[matrix.indptr[10] : matrix.indptr[60]] = 0
    matrix.eliminate_zeros()
    assert (np.diff(matrix.indptr) == 0).sum() >= 50
    dense = rng.normal(size=(200, width)).astype(np.float32)
    threads = numba.get_num_threads()
    found = multiply_sparse(matrix, dense)
    assert np.abs(found - matrix.toarray() @ dense).max() < 1e-5
    numba.set_num_threads(1)
    try:
        assert np.array_equal(multiply_sparse(matrix, dense), found)
    finally:
        numba.set_num_threads(threads)
    assert multiply_sparse(matrix, dense[:, :0]).shape == (300, 0)


def test_several_albedos_share_a_light(monkeypatch):
    """Against dense products, in slabs of columns too; into some rows of a result, and added to what these had."""
    monkeypatch.setattr("mi_sparse_prt.core.sparse_product.SLAB", 16)
    rng = np.random.default_rng(0)
    matrix = scipy.sparse.random_array((90, 70), density=0.2, rng=rng, dtype=np.float32).tocsr()
    albedo = rng.random((3, 70), dtype=np.float32)
    for width in (3, 16, 45):
        light = rng.normal(size=(70, width)).astype(np.float32)
        known = np.stack([matrix.toarray() @ (rho[:, None] * light) for rho in albedo])
        assert np.abs(multiply_scaled(matrix, albedo, light) - known).max() < 1e-5
        sums = np.ones((3, 100, width + 5), np.float32)  # more columns than the light has
        add_scaled(matrix, albedo, light, sums, 7)
        assert np.abs(sums[:, 7:97, :width] - 1 - known).max() < 1e-5
        assert (sums[:, :7] == 1).all()
        assert (sums[:, 97:] == 1).all()
        assert (sums[..., width:] == 1).all()


def test_apply_is_the_neumann_series(coloured_scene, monkeypatch):
    direct = visibility(coloured_scene)
    columns = direct.columns(np.arange(96))[..., 0]
    for depth, bounces in ((3, 1), (5, 3)):
        gather = solver(coloured_scene, max_depth=depth)
        known = neumann(gather, columns, coloured_scene.albedo, bounces)
        assert relative(gather.apply(columns), known) < 1e-6
        monkeypatch.setattr(gather_module, "COLUMNS", 21)
        assert relative(gather.apply(columns), known) < 1e-6
        monkeypatch.undo()


def test_no_limit_of_depth(coloured_scene):
    """Against the linear system itself; a bounce that counts for less than 1e-3 of the light may be missing."""
    gather = solver(coloured_scene, max_depth=-1)
    columns = visibility(coloured_scene).columns(np.arange(96))[..., 0].astype(np.float64)
    operator = gather.matrix.toarray().astype(np.float64)
    unit = np.eye(len(operator))
    known = np.stack(
        [np.linalg.solve(unit - operator * rho, columns) - columns for rho in coloured_scene.albedo.T],
        axis=-1,
    )
    found = gather.apply(columns.astype(np.float32))
    assert relative(found, known) < 1e-3
    assert 4 < gather.bounces(columns.sum(axis=1).astype(np.float32)) < 20
    deep = solver(coloured_scene, max_depth=1000)
    assert np.array_equal(deep.apply(columns.astype(np.float32)), found)  # what adds nothing is not done


@pytest.mark.filterwarnings("ignore:.*faces point inwards")
def test_light_that_never_ends(monkeypatch):
    """Light of 1 arrives everywhere, where surfaces are in each other's way as well: gaps must not be asked."""
    monkeypatch.setattr(matrix_module, "NARROW", 0)
    room = solver(build(1, room={**ROOM, "bsdf": WHITE}), max_depth=-1)
    assert room.bounces(np.zeros(room.matrix.shape[0], np.float32)) == 0
    with pytest.raises(PrtError, match="does not end"):
        room.bounces(np.ones(room.matrix.shape[0], np.float32))
    grey = solver(build(1, room={**ROOM, "bsdf": diffuse(0.5, 0.5, 0.5)}), max_depth=-1)
    one = np.ones((grey.matrix.shape[0], 1), np.float32)
    assert np.abs(grey.apply(one) - 1).max() < 2e-3  # 1/2 + 1/4 + ...


# ------------------------------------------------------------------------------------------ low rank


def direct_parts(scene: Scene) -> dict:
    bits = visibility(scene)
    lighting, points = bits.lighting, vertex_points(scene)
    texel = DirectSolver(problem_at(scene, lighting, points, basis="texel"))
    n, rng = scene.n_vertices, np.random.default_rng(0)
    weights = scipy.sparse.random_array((n, 60), density=0.1, rng=rng, dtype=np.float32).tocsr()
    dense = bits.take(np.sort(rng.choice(n, 60, replace=False)))
    return {
        "bits": bits,
        "fixed point": MeanCosine(texel.rows(np.arange(n)), lighting),
        "interpolated": Interpolated(dense, weights),
    }


@pytest.mark.parametrize("kind", ["bits", "fixed point", "interpolated"])
def test_low_rank_and_rows_against_the_series(coloured_scene, kind, monkeypatch):
    """Full rank: equal. Tolerance 5%: the first bounce lacks the energy that is said.

    96 random combinations know a norm within about 1 / sqrt(2 x 96) = 7%.
    """
    monkeypatch.setattr(ColumnBlocks.__init__, "__defaults__", (250 * 30,))
    direct = direct_parts(coloured_scene)[kind]
    gather = solver(coloured_scene, 4)
    white = direct.columns(np.arange(96))[..., 0]
    known = neumann(gather, white, coloured_scene.albedo, 3)
    some = np.array([7, 200, 7, 250])
    assert relative(gather.rows(direct, some), known[some]) < 1e-5
    exact = gather.indirect(direct, tolerance=1e-6)
    assert relative(exact.columns(np.arange(96)), known) < 3e-4

    first = solver(coloured_scene, 4, max_depth=3)
    few = first.indirect(direct, tolerance=0.05)
    missing = relative(few.columns(np.arange(96)), neumann(first, white, coloured_scene.albedo, 1))
    assert max(few.ranks) < min(exact.ranks)
    assert 0.04 < few.left_out <= 0.05
    assert missing == pytest.approx(few.left_out, rel=0.25)
    few = gather.indirect(direct, tolerance=0.05)
    assert few.bounces == 3
    assert relative(few.columns(np.arange(96)), known) < 0.06


def test_parts_of_the_result_agree(coloured_scene):
    rng = np.random.default_rng(0)
    result = solver(coloured_scene, 4).indirect(visibility(coloured_scene), tolerance=0.1)
    n = coloured_scene.n_vertices
    rows, columns = result.rows(np.arange(n)), result.columns(np.arange(96))
    assert rows.dtype == columns.dtype == np.float32
    assert np.abs(rows - columns).max() < 1e-6 * rows.max()
    lights = rng.random((96, 3), dtype=np.float32)
    assert relative(result.relight(lights), np.einsum("ijc,jc->ic", rows, lights)) < 1e-5
    turned = result.take(np.arange(n)[::-1])
    assert np.array_equal(turned.rows(np.array([0])), result.rows(np.array([n - 1])))
    again = solver(coloured_scene, 4).indirect(visibility(coloured_scene), tolerance=0.1)
    assert np.array_equal(again.relight(lights), result.relight(lights))
    assert result.nbytes == 4 * sum(rank * (n + 96) for rank in result.ranks)


def drawn_by(**basis: float) -> LowRankOptions:
    return LowRankOptions(RandomBasis(**basis))


def test_a_basis_from_some_of_the_directions(coloured_scene):
    """A quarter of the texels, others for each block: the estimate is that of all of them."""
    gather = solver(coloured_scene, 8, max_depth=3, options=drawn_by(mixed=4))
    direct = visibility(coloured_scene, 8)
    found = gather.indirect(direct, tolerance=0.1)
    known = gather.apply(direct.columns(np.arange(384))[..., 0])
    missing = relative(found.columns(np.arange(384)), known)
    assert max(found.ranks) < 70
    assert missing == pytest.approx(found.left_out, rel=0.25)


def test_a_basis_has_an_end(coloured_scene):
    """More vectors than the most are not looked for: it is said how much is missing, and that much is."""
    gather = solver(coloured_scene, 8, max_depth=3, options=drawn_by(most=16))
    direct = visibility(coloured_scene, 8)
    found = gather.indirect(direct, tolerance=0.001)
    known = gather.apply(direct.columns(np.arange(384))[..., 0])
    assert max(found.ranks) <= 16 + 96  # combinations join by blocks
    assert found.left_out > 0.01
    missing = relative(found.columns(np.arange(384)), known)
    assert missing == pytest.approx(found.left_out, rel=0.25)


@dataclass(frozen=True)
class SomePart(Operator):
    """A direct part with no more than every one must have."""

    part: Visibility

    @property
    def shape(self) -> tuple[int, int, int]:
        return self.part.shape

    @property
    def nbytes(self) -> int:
        return self.part.nbytes

    def rows(self, ids: np.ndarray) -> np.ndarray:
        return self.part.rows(ids)

    def take(self, ids: np.ndarray) -> Operator:
        return SomePart(self.part.take(ids))

    def arrays(self) -> dict:
        return {"part": self.part}

    @classmethod
    def from_arrays(cls, arrays: dict, lighting: prt.CubemapLighting) -> Operator:
        return cls(arrays["part"])


def test_any_part_will_do(coloured_scene):
    gather, direct = solver(coloured_scene, 4), visibility(coloured_scene)
    known, found = (gather.indirect(part, tolerance=0.05) for part in (direct, SomePart(direct)))
    assert found.ranks == known.ranks
    assert relative(found.rows(np.arange(50)), known.rows(np.arange(50))) < 1e-3
    some = np.array([3, 77])
    assert relative(gather.rows(SomePart(direct), some), gather.rows(direct, some)) < 1e-5


def test_least_squares_from_some_rows():
    """A basis made from sums of rows, and coefficients from a fifth of the rows, do not need them all.

    Expected: the error that is said, within a third (it is measured on 96 combinations of a few columns each).
    """
    scene = build(0.15, **still_life(COLOURS))
    basis = RandomBasis(few_rows=16, sums=512)
    gather, direct = solver(scene, 4, max_depth=3, options=LowRankOptions(basis)), visibility(scene)
    found = gather.indirect(direct, tolerance=0.1)
    known = gather.apply(direct.columns(np.arange(96))[..., 0])
    assert scene.n_vertices > 1500
    assert basis.rows * sum(found.ranks) < scene.n_vertices / 2
    assert relative(found.columns(np.arange(96)), known) == pytest.approx(found.left_out, rel=0.33)


# ------------------------------------------------------------------------------------------ skipping


def test_one_channel_for_grey_scenes(grey_scene):
    gather = solver(grey_scene, 4)
    direct = visibility(grey_scene)
    columns = direct.columns(np.arange(96))[..., 0]
    assert gather.apply(columns).shape == (grey_scene.n_vertices, 96, 1)
    result = gather.indirect(direct, tolerance=0.01)
    assert len(result.left) == len(result.right) == 1
    assert result.relight(np.ones((96, 3), np.float32)).shape == (grey_scene.n_vertices, 3)
    known = neumann(gather, columns, grey_scene.albedo, 3)[..., :1]
    assert (
        relative(result.columns(np.arange(96)), known) < 0.013
    )  # what is left out is estimated within a quarter


@pytest.mark.parametrize("why", ["black", "alone", "direct only"])
def test_nothing_to_gather(why, monkeypatch):
    black = diffuse(0, 0, 0)
    shapes = still_life(((0,) * 3,) * 3) if why == "black" else {"cube": {"type": "cube", "bsdf": WHITE}}
    shapes |= {"ground": {"type": "rectangle", "bsdf": black}} if why == "direct only" else {}
    scene = build(**shapes)
    gather, direct = solver(scene, 4, max_depth=2 if why == "direct only" else 5), visibility(scene)
    monkeypatch.setattr(bounce_module, "combine_randomly", None)  # D is not touched
    result = gather.indirect(direct)
    assert result.ranks == (0,)
    assert result.bounces == 0
    assert not result.rows(np.array([0, 5])).any()
    assert not result.columns(np.array([0, 5])).any()
    assert not result.relight(np.ones((96, 3), np.float32)).any()
    assert not gather.apply(np.ones((scene.n_vertices, 2), np.float32)).any()


@pytest.mark.parametrize("alike", [True, False])
def test_coloured_light_is_told_apart_by_depth(alike: bool):
    """
    Rationale: all channels of light that came by way of coloured glass share a random basis, also where each has form
        factors of its own, as between glossy surfaces.

    Expected: each channel and each depth is X_s = sum over k < s of G_k rho (E_(s-1-k) + X_(s-1-k)), as dense products
        have it.
    """
    n, m, count, rng = 120, 96, 3, np.random.default_rng(5)

    def sparse(columns: int, density: float) -> scipy.sparse.csr_array:
        return scipy.sparse.random_array((n, columns), density=density, rng=rng, dtype=np.float32).tocsr()

    matrices = [sparse(n, 0.1) * np.float32(0.1 / (1 + k)) for k in range(count)]
    albedo = rng.random((3, n), dtype=np.float32)
    direct = SparseRows((sparse(m, 0.5),))
    specular = ByDepth(tuple(SparseRows(tuple(sparse(m, 0.1) for _ in range(3))) for _ in range(count)))
    keys = rng.integers(1 << 63, size=n).astype(np.uint64)
    of_channels = [matrices] if alike else [[m * np.float32(x) for m in matrices] for x in (1, 0.3, 1.4)]
    elements = FiniteElements(of_channels, albedo, keys, Nodes(np.arange(n), None), 2 + count, 1)
    found = elements.indirect(direct, 1e-3, specular)
    assert len(found.terms) == count
    for c in range(3):
        matrices = of_channels[min(c, len(of_channels) - 1)]
        light = [direct.matrices[0].toarray(), *(term.matrices[c].toarray() for term in specular.terms)]
        known = [np.zeros((n, m))]
        for s in range(1, count + 1):
            sent = [albedo[c][:, None] * (light[t] + known[t]) for t in range(s)]
            known.append(sum(matrices[k] @ sent[s - 1 - k] for k in range(s)))
        for term, wanted in zip(found.terms, known[1:], strict=True):
            off = term.left[c] @ term.right[c] - wanted
            assert np.linalg.norm(off) < 3e-3 * np.linalg.norm(wanted)


@pytest.mark.parametrize("alike", [True, False])
def test_coloured_light_that_is_not_told_apart(alike: bool):
    """
    Expected: G rho (D + E) + G rho G rho (D + E) of each channel, as dense products have it; the tolerance is one of
        all channels together.
    """
    n, m, rng = 120, 96, np.random.default_rng(6)

    def sparse(columns: int, density: float) -> scipy.sparse.csr_array:
        return scipy.sparse.random_array((n, columns), density=density, rng=rng, dtype=np.float32).tocsr()

    matrix, albedo = sparse(n, 0.1) * np.float32(0.1), rng.random((3, n), dtype=np.float32)
    direct, specular = SparseRows((sparse(m, 0.5),)), SparseRows(tuple(sparse(m, 0.1) for _ in range(3)))
    keys = rng.integers(1 << 63, size=n).astype(np.uint64)
    of_channels = [matrix] if alike else [matrix * np.float32(x) for x in (1, 0.3, 1.4)]
    elements = FiniteElements([[g] for g in of_channels], albedo, keys, Nodes(np.arange(n), None), 4, 1)
    found = elements.indirect(direct, 1e-3, specular)
    squares = np.zeros(2)
    for c in range(3):
        step = of_channels[min(c, len(of_channels) - 1)].toarray() * albedo[c]
        light = (direct.matrices[0] + specular.matrices[c]).toarray()
        wanted = step @ light + step @ (step @ light)
        off = found.left[c] @ found.right[c] - wanted
        squares += np.square([np.linalg.norm(off), np.linalg.norm(wanted)])
        assert np.linalg.norm(off) < 1e-2 * np.linalg.norm(wanted)
    assert squares[0] < 2e-3**2 * squares[1]
