"""Rows interpolated from dense ones, against the matrix product written out; and their files."""

import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse
from conftest import altered, made_up
from numpy.typing import NDArray

import mi_sparse_prt as prt
from mi_sparse_prt.operators.interpolated import Interpolated
from mi_sparse_prt.operators.upsampled import Upsampled
from mi_sparse_prt.transport import LightTransport

N_V, N_DENSE, N = 50, 12, 4
FORMS = (
    "both",
    "direct",
    "indirect",
)  # which parts are interpolated: huang2010, huang2010 without bounces, sparse


def some_weights(n: int = N_V, n_dense: int = N_DENSE, seed: int = 0) -> scipy.sparse.csr_array:
    """Up to five weights a row, negative ones and empty rows among them; the first rows are the dense ones."""
    rng = np.random.default_rng(seed)
    weights = np.zeros((n, n_dense))
    weights[:n_dense] = np.eye(n_dense)
    for i in range(n_dense, n):
        weights[i, rng.choice(n_dense, i % 6, replace=False)] = rng.normal(size=i % 6)
    return scipy.sparse.csr_array(weights, dtype=np.float32)


def interpolated(form: str, n: int = N, n_dense: int = N_DENSE) -> LightTransport:
    """A made-up matrix of 50 vertices with parts that are interpolated from 12 dense vertices."""
    kind = "bits" if form == "direct" else "bits and coarse indirect"
    few, all_ = (made_up(kind, n, k) for k in (n_dense, N_V))
    return altered(
        all_,
        direct=all_.direct if form == "indirect" else Interpolated(few.direct, some_weights(N_V, n_dense)),
        indirect=few.indirect and Interpolated(few.indirect, some_weights(N_V, n_dense, 1)),
    )


def expanded(part) -> NDArray[np.float64]:
    """All rows (n_v, n_directions, channels) of a part, A D as a dense product in float64."""
    if not isinstance(part, Interpolated):
        return part.rows(np.arange(N_V)).astype(np.float64)
    dense = part.dense.rows(np.arange(part.weights.shape[1])).astype(np.float64)
    return np.einsum("ik,kjc->ijc", part.weights.toarray().astype(np.float64), dense)


@pytest.fixture(scope="module", params=FORMS)
def transport(request: pytest.FixtureRequest) -> LightTransport:
    return interpolated(request.param)


@pytest.fixture(scope="module")
def full(transport: LightTransport) -> NDArray[np.float64]:
    white = expanded(transport.direct)
    if transport.indirect is not None:
        white = white + expanded(transport.indirect)
    return transport.albedo[:, None].astype(np.float64) * white


def close(a: NDArray, b: NDArray) -> bool:
    return bool(np.abs(a - b).max() <= 1e-5 * np.abs(b).max()) and a.shape == b.shape


# ------------------------------------------------------------------------------------ one matrix in three ways


def test_rows_columns_and_relight_are_one_matrix(transport, full):
    rows, columns = transport.rows(np.arange(N_V)), transport.columns(np.arange(6 * N * N))
    assert rows.dtype == columns.dtype == np.float32
    assert transport.shape == rows.shape
    assert close(rows, full)
    assert close(columns, full)
    L = np.random.default_rng(0).random((6 * N * N, 3), dtype=np.float32)
    relit = transport.relight(L)
    assert relit.dtype == np.float32
    assert close(relit, np.einsum("ijc,jc->ic", full, L))


@pytest.mark.parametrize("ids", [[3], [49, 0, 49], [-1, 20], range(30, 35), np.arange(N_V) % 7 == 0], ids=str)
def test_some_rows_and_columns(transport, full, ids):
    chosen = np.flatnonzero(ids) if isinstance(ids, np.ndarray) else np.asarray(ids)
    assert close(transport.rows(ids), full[chosen])
    if not isinstance(ids, np.ndarray):
        assert close(transport.columns(ids), full[:, chosen])


def test_dense_vertices_keep_their_rows(transport):
    """Weight 1 at themselves: to the last bit what was sampled."""
    for part in (transport.direct, transport.indirect):
        if isinstance(part, Interpolated):
            ids = np.arange(N_DENSE)
            assert np.array_equal(part.rows(ids), part.dense.rows(ids))


def test_no_columns(transport):
    assert transport.columns([]).shape == (N_V, 0, 3)


@pytest.mark.parametrize("n", [1, 2])
def test_tiny_cubemaps(n):
    """Directions that do not fill a word."""
    part = interpolated("direct", n).direct
    assert close(part.rows(np.arange(N_V)), expanded(part))
    assert close(part.columns(np.arange(6 * n * n)), expanded(part))
    L = np.random.default_rng(0).random((6 * n * n, 3), dtype=np.float32)
    assert close(part.relight(L), expanded(part)[..., 0] @ L)


def test_three_channels_stay_apart():
    part = interpolated("both").indirect
    assert part.rows([0]).shape == (1, 6 * N * N, 3)
    red_only = part.dense.density.copy()
    red_only[..., 1:] = 0
    red = replace(part, dense=replace(part.dense, density=red_only))
    rows = red.rows(np.arange(N_V))
    assert rows[..., 0].any()
    assert not rows[..., 1:].any()
    relit = red.relight(np.ones((6 * N * N, 3), np.float32))
    assert relit[:, 0].any()
    assert not relit[:, 1:].any()


def test_a_single_channel_serves_all_three():
    part = interpolated("both").indirect
    grey = Interpolated(replace(part.dense, density=part.dense.density[..., :1]), part.weights)
    L = np.random.default_rng(0).random((6 * N * N, 3), dtype=np.float32)
    assert grey.rows([0, 30]).shape == (2, 6 * N * N, 1)
    assert close(grey.relight(L), expanded(grey)[..., 0] @ L)


def test_other_orders(transport, full):
    """Rows follow; the dense rows stay where they are."""
    order = np.random.default_rng(2).permutation(N_V)
    for part in (transport.direct, transport.indirect):
        if isinstance(part, Interpolated):
            turned, L = part.take(order), full[0].astype(np.float32)
            assert turned.dense is part.dense
            assert np.array_equal(turned.rows(np.arange(N_V)), part.rows(order))
            assert np.array_equal(turned.columns([5, 7]), part.columns([5, 7])[order])
            assert np.array_equal(turned.relight(L), part.relight(L)[order])


def test_bytes_are_those_of_the_factors():
    both = interpolated("both")
    entries = [part.weights.nnz for part in (both.direct, both.indirect)]
    index = both.direct.weights.indices.itemsize
    sparse = sum(e * (4 + index) + (N_V + 1) * index for e in entries)
    assert both.nbytes == N_DENSE * 96 / 8 + N_DENSE * 24 * 3 * 2 + sparse


# ------------------------------------------------------------------------------------ files


def assert_same(a: LightTransport, b: LightTransport) -> None:
    factors = [t.stored()[1] for t in (a, b)]
    assert factors[0].keys() == factors[1].keys()
    for name, array in factors[0].items():
        assert array.dtype == factors[1][name].dtype, name
        assert np.array_equal(array, factors[1][name]), name
    assert [type(p) for p in (a.direct, a.indirect)] == [type(p) for p in (b.direct, b.indirect)]
    assert (a.basis, a.meshes, a.scene_hash, a.report) == (b.basis, b.meshes, b.scene_hash, b.report)


def test_round_trip(tmp_path, transport):
    transport.save(tmp_path / "a.prt")
    loaded = prt.load_transport(tmp_path / "a.prt")
    assert_same(transport, loaded)
    ids = np.arange(N_V)
    assert np.array_equal(loaded.rows(ids), transport.rows(ids))
    assert np.array_equal(loaded.columns([3, 90]), transport.columns([3, 90]))
    assert np.array_equal(loaded.relight([1, 2, 3]), transport.relight([1, 2, 3]))
    assert loaded.nbytes == transport.nbytes


@pytest.mark.parametrize("method", ["sparse", "huang2010"])
@pytest.mark.parametrize("max_depth", [2, 3])
def test_results_of_the_methods_come_back(tmp_path, grey_scene, method, max_depth):
    transport = prt.precompute(
        grey_scene, prt.CubemapLighting(4), method=method, max_depth=max_depth, spp=2, progress=False
    )
    assert isinstance(transport.direct, Interpolated) == (method == "huang2010")
    assert isinstance(transport.indirect, Interpolated) == (max_depth == 3)
    transport.save(tmp_path / "a.prt")
    loaded = prt.load_transport(tmp_path / "a.prt", grey_scene)
    assert_same(transport, loaded)
    ids = np.arange(grey_scene.n_vertices)
    assert np.array_equal(loaded.rows(ids), transport.rows(ids))


def test_both_parts_have_weights_of_their_own(tmp_path):
    transport = interpolated("both")
    transport.save(tmp_path / "a.prt")
    loaded = prt.load_transport(tmp_path / "a.prt")
    assert (loaded.direct.weights != loaded.indirect.weights).nnz > 0


def spliced(tmp_path: Path, arrays: tuple[str, ...], other: LightTransport) -> Path:
    """A good file in which some arrays, chunks and descriptions, come from another good file."""
    interpolated("both").save(tmp_path / "good.prt")
    other.save(tmp_path / "other.prt")
    with zipfile.ZipFile(tmp_path / "good.prt") as good, zipfile.ZipFile(tmp_path / "other.prt") as bad:
        with zipfile.ZipFile(tmp_path / "a.prt", "w") as result:
            for source, wanted in ((good, False), (bad, True)):
                for name in source.namelist():
                    if (name.split("/")[0] in arrays) == wanted:
                        result.writestr(name, source.read(name))
    return tmp_path / "a.prt"


def test_splicing_alone_does_no_damage(tmp_path):
    path = spliced(
        tmp_path, ("reflection.albedo", "direct.weights_data", "indirect.dense.density"), interpolated("both")
    )
    assert_same(prt.load_transport(path), interpolated("both"))


@pytest.mark.parametrize(
    "array",
    [
        "direct.dense.visibility",
        "direct.dense.normals",
        "direct.weights_data",
        "direct.weights_indices",
        "indirect.weights_data",
        "indirect.weights_indices",
    ],
)
def test_damaged_shapes_are_refused(tmp_path, array):
    """One array of a matrix with other numbers of dense vertices and of weights."""
    good, other = interpolated("both"), interpolated("both", n_dense=30)
    assert array in good.stored()[1]
    assert good.direct.weights.nnz != other.direct.weights.nnz
    assert good.indirect.weights.nnz != other.indirect.weights.nnz
    with pytest.raises(prt.PrtError, match="damaged") as error:
        prt.load_transport(spliced(tmp_path, (array,), other))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("part", ["direct", "indirect"])
def test_weights_with_rows_for_other_vertices_are_refused(tmp_path, part):
    """All three arrays of the weights, consistent in themselves, but for 49 vertices."""
    other = interpolated("both")
    shorter = replace(getattr(other, part), weights=getattr(other, part).weights[:-1])
    arrays = tuple(f"{part}.weights_{name}" for name in ("data", "indices", "indptr"))
    assert set(arrays) <= other.stored()[1].keys()
    with pytest.raises(prt.PrtError, match="damaged"):
        prt.load_transport(spliced(tmp_path, arrays, altered(other, **{part: shorter})))


def test_a_plain_indirect_part_is_not_mistaken(tmp_path):
    """Files of the other methods have no weights, and no interpolation comes back."""
    plain = made_up("bits and coarse indirect")
    plain.save(tmp_path / "a.prt")
    assert isinstance(prt.load_transport(tmp_path / "a.prt").indirect, Upsampled)
