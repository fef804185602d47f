"""One contract, all linear factors of T: the same list of checks for every operator."""

import inspect
import pickle
from collections.abc import Callable
from dataclasses import fields

import numpy as np
import pytest
import scipy.sparse
from conftest import made_up

import mi_sparse_prt as prt
from mi_sparse_prt.operators.by_depth import ByDepth
from mi_sparse_prt.operators.column_blocks import ColumnBlocks
from mi_sparse_prt.operators.dense import Dense
from mi_sparse_prt.operators.factored_visibility import FactoredVisibility, RowSelection
from mi_sparse_prt.operators.interpolated import Interpolated
from mi_sparse_prt.operators.operator import Masked, Operator
from mi_sparse_prt.operators.sparse_rows import SparseRows
from mi_sparse_prt.operators.stored import operator_arrays, operator_from_arrays
from mi_sparse_prt.operators.sum import Sum
from mi_sparse_prt.solvers.stacked import Stacked, StackedFormFactors

N, M = 50, 96  # points and directions of made_up


def part(form: str, name: str) -> Operator:
    return made_up(form).operators[name]


def factored(form: str) -> FactoredVisibility:
    """Every third point is glossy, of two BRDFs with three terms and with two."""
    rng, direct = np.random.default_rng(1), part(form, "direct")
    tangents = np.cross(direct.normals, rng.normal(size=(N, 3)))
    tangents = (tangents / np.linalg.norm(tangents, axis=1, keepdims=True)).astype(np.float32)
    material = np.where(np.arange(N) % 3 == 0, np.arange(N) % 2, -1)
    tables = rng.normal(size=(2, 8, 8, 3)).astype(np.float32)
    tables[1, ..., 2] = 0
    return FactoredVisibility(direct, tangents, material, tables)


def interpolated(dense: Operator) -> Interpolated:
    rng = np.random.default_rng(2)
    return Interpolated(
        dense, scipy.sparse.random_array((N, N), density=0.1, format="csr", rng=rng, dtype=np.float32)
    )


def sparse_rows(channels: int) -> SparseRows:
    rng = np.random.default_rng(3)
    return SparseRows(
        tuple(
            scipy.sparse.random_array((N, M), density=0.1, format="csr", rng=rng, dtype=np.float32)
            for _ in range(channels)
        )
    )


def some_open() -> np.ndarray:
    return np.random.default_rng(4).integers(0, 1 << 32, (3, M // 32), dtype=np.uint32)


OPERATORS: dict[str, Callable[[], Operator]] = {
    "visibility": lambda: part("bits", "direct"),
    "fractional visibility": lambda: part("shares", "direct"),
    "mean cosine": lambda: part("fixed point", "direct"),
    "upsampled": lambda: part("bits and coarse indirect", "indirect"),
    "grey, full resolution": lambda: part("fixed point and full indirect", "indirect"),
    "interpolated bits": lambda: interpolated(part("bits", "direct")),
    "interpolated light": lambda: interpolated(part("bits and coarse indirect", "indirect")),
    "low rank": lambda: part("bits and factored light", "indirect"),
    "grey low rank": lambda: part("fixed point and factored grey light", "indirect"),
    "factored visibility": lambda: factored("bits"),
    "factored shares": lambda: factored("shares"),
    "clustered": lambda: part("clusters", "compressed"),
    "grey clustered": lambda: part("grey clusters", "compressed"),
    "Haar rows": lambda: part("wavelets", "compressed"),
    "grey Haar rows": lambda: part("grey wavelets", "compressed"),
    "dense": lambda: Dense(np.random.default_rng(5).normal(size=(N, M, 3)).astype(np.float32)),
    "grey dense": lambda: Dense(np.random.default_rng(5).normal(size=(N, M, 1)).astype(np.float32)),
    "sparse rows": lambda: sparse_rows(3),
    "grey sparse rows": lambda: sparse_rows(1),
    "sum": lambda: Sum((part("bits", "direct"), part("bits and factored light", "indirect"))),
    "by depth": lambda: ByDepth((sparse_rows(3), part("bits and factored light", "indirect"))),
    "grey sum": lambda: Sum((part("bits", "direct"), sparse_rows(1))),
    "masked": lambda: Masked(part("shares", "direct"), np.array([1, 7, 30]), some_open()),
    "row selection": lambda: RowSelection(part("bits", "direct"), np.array([3, 3, 0, 49])),
    "selected terms": lambda: factored("bits").take(np.array([N + 4, 7, N + 1, 7, 3])),
}


@pytest.fixture(params=OPERATORS)
def operator(request: pytest.FixtureRequest) -> Operator:
    return OPERATORS[request.param]()


@pytest.fixture
def dense(operator: Operator) -> np.ndarray:
    """Rows, in float64."""
    return operator.rows(np.arange(operator.shape[0])).astype(np.float64)


def close(found: np.ndarray, wanted: np.ndarray) -> bool:
    return found.shape == wanted.shape and bool(np.abs(found - wanted).max() <= 2e-6 * np.abs(wanted).max())


def test_every_operator_is_here():
    def below(kind: type[Operator]) -> set[type[Operator]]:
        return {kind, *(k for sub in kind.__subclasses__() for k in below(sub))}

    concrete = {
        k
        for k in below(Operator)
        if not inspect.isabstract(k) and k.__module__.startswith("mi_sparse_prt.op")
    }
    assert {type(make()) for make in OPERATORS.values()} == concrete


def test_rows_columns_elements_are_one_matrix(operator, dense):
    n, m, channels = operator.shape
    assert dense.shape == (n, m, channels) and channels in (1, 3)
    rng = np.random.default_rng(0)
    texels, rows = rng.integers(m, size=40), rng.integers(n, size=40)
    assert operator.rows(rows).dtype == operator.columns(texels).dtype == np.float32
    assert close(operator.columns(texels), dense[:, texels])
    assert close(operator.elements(rows, texels), dense[rows, texels])
    assert operator.elements(rows, texels).dtype == np.float32
    assert operator.elements(rows[:0], texels[:0]).shape == (0, channels)
    assert operator.rows(rows[:0]).shape == (0, m, channels)
    assert operator.columns(texels[:0]).shape == (n, 0, channels)


def test_products_with_the_identity_are_the_matrix(operator, dense):
    """As well as those of each channel's own, and of the transpose."""
    n, m, channels = operator.shape
    found, back = operator.apply(np.eye(m)), operator.adjoint(np.eye(n))
    assert found.dtype == back.dtype == np.float32
    assert close(found, np.moveaxis(dense, 1, 2))
    assert close(back, np.moveaxis(dense, 0, 2))
    each, each_back = (np.repeat(np.eye(size)[:, None], 3, axis=1) for size in (m, n))
    wanted = np.broadcast_to(dense, (n, m, 3))
    found, back = operator.apply(each), operator.adjoint(each_back)
    assert found.dtype == back.dtype == np.float32
    assert close(found, np.moveaxis(wanted, 1, 2))
    assert close(back, np.moveaxis(wanted, 0, 2))


def test_products_and_their_transpose(operator, dense):
    n, m, channels = operator.shape
    rng = np.random.default_rng(1)
    same, each = rng.normal(size=(m, 4)).astype(np.float32), rng.normal(size=(m, 3, 4)).astype(np.float32)
    coloured = np.broadcast_to(dense, (n, m, 3))
    assert close(operator.apply(same), np.einsum("nmc,mk->nck", dense, same))
    assert close(operator.apply(each), np.einsum("nmc,mck->nck", coloured, each))
    assert close(operator.relight(each[..., 0]), np.einsum("nmc,mc->nc", coloured, each[..., 0]))
    for x, y in (
        (same, rng.normal(size=(n, 4)).astype(np.float32)),
        (each, rng.normal(size=(n, 3, 4)).astype(np.float32)),
    ):
        forth, back = operator.apply(x).astype(np.float64), operator.adjoint(y).astype(np.float64)
        if x.ndim == 2:  # of each channel
            gap = np.abs(np.einsum("nk,nck->c", y, forth) - np.einsum("mk,mck->c", x, back)).max()
        else:
            gap = abs((forth * y).sum() - (back * x).sum())
        assert gap <= 1e-5 * np.linalg.norm(y) * np.linalg.norm(forth)


def test_some_rows(operator, dense):
    ids = np.array([2, 0, 3, 2])
    taken = operator.take(ids)
    assert close(taken.rows(np.arange(4)), dense[ids])
    assert taken.shape == (4, *operator.shape[1:])
    assert close(taken.columns(np.array([5, 1])), dense[ids][:, [5, 1]])
    each = np.random.default_rng(9).normal(size=(M, 3, 2)).astype(np.float32)
    lit = np.einsum("nmc,mck->nck", np.broadcast_to(dense[ids], (4, M, 3)), each)
    assert close(taken.apply(each), lit)
    assert close(taken.relight(each[..., 1]), lit[..., 1])
    assert operator.take(ids[:0]).shape == (0, *operator.shape[1:])


def test_whole_points_stay_what_they_are():
    operator = factored("bits")
    points = np.array([6, 1, 0, 4])
    rows = np.concatenate([points, *(N + 3 * (p // 3) + np.arange(3) for p in points if p % 3 == 0)])
    taken = operator.take(rows)
    assert isinstance(taken, FactoredVisibility)
    assert close(taken.rows(np.arange(len(rows))), operator.rows(rows).astype(np.float64))


def test_masked_elements_are_gone(operator, dense):
    points, open_texels = np.array([0, 2, 3]), some_open()
    kept = np.unpackbits(open_texels.view(np.uint8), axis=1, bitorder="little").astype(bool)[:, :M]
    wanted = dense.copy()
    wanted[points] *= kept[:, :, None]
    if isinstance(operator, FactoredVisibility):  # terms see what their points see
        for place, point in enumerate(points):
            if point % 3 == 0:
                first = N + 3 * (point // 3)
                wanted[first : first + 3] *= kept[place][None, :, None]
    masked = operator.masked(points, open_texels)
    assert close(masked.rows(np.arange(operator.shape[0])), wanted)
    light = np.random.default_rng(10).normal(size=(M, 3)).astype(np.float32)
    assert close(masked.columns(np.array([5, 1])), wanted[:, [5, 1]])
    assert close(
        masked.relight(light), np.einsum("nmc,mc->nc", np.broadcast_to(wanted, (*wanted.shape[:2], 3)), light)
    )
    assert close(operator.rows(np.arange(operator.shape[0])), dense)


def test_columns_in_blocks_and_combined(operator, dense):
    if operator.shape[2] != 1:
        return  # direct light has one channel
    blocks = ColumnBlocks(operator, block=7 * operator.shape[0])
    found = np.concatenate([columns.copy() for _, columns in blocks], axis=1)
    assert close(found, dense[..., 0])
    texels = np.array([90, 3, 3, 17])
    room = np.full((operator.shape[0], 4), np.nan, np.float32)
    assert close(operator.dense_columns(texels, room), dense[:, texels, 0])
    rng = np.random.default_rng(6)
    words, signs = np.array([2, 0]), rng.choice(np.array([-1, 1], np.float32), (2, 32))
    wanted = sum(dense[:, 32 * w : 32 * w + 32, 0] * s for w, s in zip(words, signs, strict=True))
    assert close(operator.combined(words, signs), wanted)


def test_arrays_and_back(operator, dense):
    kinds, arrays = operator_arrays(operator, "part")
    back = operator_from_arrays("part", kinds, arrays, prt.CubemapLighting(4))
    assert type(back) is type(operator)
    assert np.array_equal(back.rows(np.arange(operator.shape[0])), dense.astype(np.float32))
    assert operator.nbytes > 0


def test_pickled_and_twice(operator, dense):
    again = pickle.loads(pickle.dumps(operator))
    x = np.random.default_rng(7).random((M, 3), np.float32)
    y = np.random.default_rng(8).random((operator.shape[0], 3), np.float32)
    assert np.array_equal(again.adjoint(y), operator.adjoint(y))
    assert np.array_equal(operator.adjoint(y), operator.adjoint(y))
    assert np.array_equal(operator.apply(x), operator.apply(x))
    assert np.array_equal(again.relight(x), operator.relight(x))
    assert np.array_equal(operator.relight(x), operator.relight(x))


def ask_all(operator: Operator, light: np.ndarray, weights: np.ndarray, ids: np.ndarray) -> None:
    """Call whatever there is."""
    operator.relight(light)
    operator.apply(light)
    operator.adjoint(weights)
    operator.rows(ids)
    operator.columns(ids)
    operator.elements(ids, ids)
    operator.take(ids)
    operator.masked(ids, some_open())
    if operator.shape[2] == 1:
        operator.dense_columns(ids, np.empty((operator.shape[0], 3), np.float32))
        operator.combined(ids[:2], np.ones((2, 32), np.float32))


def asked(operator: Operator) -> list[np.ndarray]:
    return [np.ones((M, 3), np.float32), np.ones((operator.shape[0], 3, 2), np.float32), np.array([0, 2, 3])]


def test_arrays_are_left_as_they_are(operator, dense):
    given, same = asked(operator), asked(operator)
    ask_all(operator, *given)
    assert all(np.array_equal(a, b) for a, b in zip(given, same, strict=True))
    assert np.array_equal(operator.rows(np.arange(operator.shape[0])), dense)


def test_arrays_are_read_only(operator):
    """Rationale: a kernel is compiled for arrays that can be written to, and again for those that cannot: 2 to 20 s.

    Computed, taken, read or unpickled, an operator shows the same kind.
    """
    for some in (operator, operator.take(np.arange(3)), pickle.loads(pickle.dumps(operator))):
        kept = arrays_of(some)
        assert not any(array.flags.writeable for array in kept)


def arrays_of(value: object) -> list[np.ndarray]:
    """All arrays among the fields of an operator and of the operators in it; not what is in tuples."""
    if isinstance(value, np.ndarray):
        return [value]
    if isinstance(value, Operator):
        return [array for field in fields(value) for array in arrays_of(getattr(value, field.name))]
    return []


@pytest.mark.parametrize("form", ["mean cosine", "low rank", "grey Haar rows"])
def test_read_only_questions_will_do(form):
    operator = OPERATORS[form]()
    given = asked(operator)
    for array in given:
        array.flags.writeable = False
    ask_all(operator, *given)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_values_that_are_no_numbers_are_refused(value):
    values = np.ones((4, 6, 1), np.float32)
    values[1, 2] = value
    with pytest.raises(prt.PrtError, match="NaN or infinite") as error:
        Dense(values)
    assert "\n" not in str(error.value)
    with pytest.raises(prt.PrtError, match="NaN or infinite") as error:
        SparseRows((scipy.sparse.csr_array(values[..., 0]),))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("form", ["bits and coarse indirect", "shares and factored light", "clusters"])
def test_transposed_and_for_scipy(form):
    transport = made_up(form)
    full = transport.rows(np.arange(N)).astype(np.float64)
    rng = np.random.default_rng(8)
    y = rng.normal(size=(N, 3, 2)).astype(np.float32)
    assert transport.T.shape == (M, N, 3) and transport.T.T is transport
    assert close(transport.T.apply(y), np.einsum("nmc,nck->mck", full, y))
    light = rng.normal(size=(M, 3, 2)).astype(np.float32)
    forth, back = (f.astype(np.float64) for f in (transport.apply(light), transport.T.apply(y)))
    assert close(transport.T.adjoint(light), forth)
    assert abs((y * forth).sum() - (back * light).sum()) <= 1e-5 * np.linalg.norm(y) * np.linalg.norm(forth)
    for channel in range(3):
        linear = transport.as_linear_operator(channel)
        x = rng.normal(size=M)
        assert linear.shape == (N, M)
        assert close(linear @ x, full[..., channel] @ x)
        assert close(linear.H @ y[:, channel, 0], full[..., channel].T @ y[:, channel, 0])
    block, x = transport.as_linear_operator(), rng.normal(size=3 * M)
    assert block.shape == (3 * N, 3 * M)
    blocks, z = scipy.sparse.block_diag([full[..., c] for c in range(3)]), rng.normal(size=(3 * N, 2))
    assert close(block @ x, blocks @ x)
    assert close(block.H @ z, blocks.T @ z)
    turned = transport.T.as_linear_operator()
    assert turned.shape == (3 * M, 3 * N)
    assert close(turned @ z, blocks.T @ z)
    with pytest.raises(prt.PrtError, match="channel 3"):
        transport.as_linear_operator(3)


def test_rows_below_each_other():
    """Of operators with the same columns: what each has, as one matrix."""
    parts = part("shares", "direct"), sparse_rows(1), part("bits", "direct")
    both, known = Stacked(parts), np.concatenate([p.rows(np.arange(N)) for p in parts])
    ids, some = np.array([140, 3, 77, 0]), np.array([1, 4, 49, 50, 120])
    assert both.shape == (3 * N, M, 1) and both.nbytes == sum(p.nbytes for p in parts)
    assert np.array_equal(both.rows(ids), known[ids])
    assert close(both.columns(np.arange(9)), known[:, :9])
    assert close(both.take(some).columns(np.arange(M)), known[some])
    words, signs = np.array([2, 0]), np.random.default_rng(0).choice([-1, 1], (2, 32)).astype(np.float32)
    wanted = sum(known[:, 32 * w : 32 * w + 32, 0] * sign for w, sign in zip(words, signs, strict=True))
    assert close(both.combined(words, signs), wanted)


def test_form_factors_of_several_depths():
    """
    Expected: rows of depth s gather G_(s-t) of light of depth t, as in one matrix of all blocks; any rows of it.
    """
    rng = np.random.default_rng(0)
    matrices = [scipy.sparse.random_array((5, 7), density=0.4, format="csr", rng=k) for k in (1, 2, 3)]
    matrices = [m.astype(np.float32) for m in (*matrices, scipy.sparse.csr_array((5, 7)))]
    depths, count = (0, 2), 4
    whole = np.block([
        [matrices[s - t].toarray() if t <= s else np.zeros((5, 7)) for t in depths] for s in range(count)
    ])  # fmt: skip
    albedo = rng.random((2, 14), np.float32)
    stacked = StackedFormFactors(matrices, depths, count)
    assert stacked.shape == whole.shape
    for columns in (3, 20):
        light = rng.random((14, columns), np.float32)
        found = stacked.reflect(albedo, light)
        assert close(found, np.stack([whole @ (rho[:, None] * light) for rho in albedo]))
    some = np.array([0, 3, 5, 11, 12, 19])
    assert close(stacked.rows(some).toarray(), whole[some])
