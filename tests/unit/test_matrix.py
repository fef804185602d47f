"""The factored matrix against slow, obvious formulas on made-up factors: no ray is traced here."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse
from conftest import FORMS, altered, build, diffuse, made_up, still_life
from numpy.typing import NDArray

import mi_sparse_prt as prt
from mi_sparse_prt.emission.haar import inverse_haar
from mi_sparse_prt.measurement.vertices import vertex_points
from mi_sparse_prt.operators.clustered import Clustered
from mi_sparse_prt.operators.fractional_visibility import FractionalVisibility, _means
from mi_sparse_prt.operators.haar_rows import HaarRows
from mi_sparse_prt.operators.low_rank import LowRank
from mi_sparse_prt.transport import LightTransport, MeshRange

N_V, N = 50, 4


def slow(transport: LightTransport) -> NDArray[np.float64]:
    """T, element by element, in float64 from the definitions of DESIGN 2."""
    lighting = transport.lighting
    direct, indirect = next(iter(transport.operators.values())), transport.indirect
    result = np.zeros(transport.shape)
    for i in range(transport.shape[0]):
        for j in range(transport.shape[1]):
            solid_angle = float(lighting.solid_angles[j])
            if transport.basis == "direction":
                visible = (int(direct.bits[i, j // 32]) >> (j % 32)) & 1
                cosine = float(direct.normals[i].astype(float) @ lighting.directions[j].astype(float))
                white = np.full(3, visible * max(0.0, cosine) * solid_angle / np.pi)
            elif isinstance(direct, FractionalVisibility):
                white = np.full(3, share(direct, i, j) * solid_angle / np.pi)
            elif isinstance(direct, Clustered):
                white = clustered(direct, i)[:, j] * np.sqrt(solid_angle)
            elif isinstance(direct, HaarRows):
                white = wavelets(direct, i)[:, j] * np.sqrt(solid_angle)
            else:
                white = np.full(3, direct.fixed[i, j] / 65535 * solid_angle / np.pi)
            if isinstance(indirect, LowRank):
                pairs = zip(indirect.left, indirect.right, strict=True)
                white += [a[i].astype(float) @ b[:, j].astype(float) for a, b in pairs]
            elif indirect is not None:
                weights = indirect.upsampling.toarray()[j]
                white += solid_angle * (weights @ indirect.density[i].astype(float))
            result[i, j] = transport.albedo[i] * white
    return result


def share(direct: FractionalVisibility, i: int, j: int) -> float:
    """What vertex i sees of texel j, times the mean over it of max(0, n . w), for an even spread of n . w."""
    a, b = direct.starts[i : i + 2]
    listed = dict(zip(direct.texels[a:b].tolist(), direct.shares[a:b].tolist(), strict=True))
    seen = listed.get(j, 255 * ((int(direct.bits[i, j // 32]) >> (j % 32)) & 1)) / 255
    directions, ramps = _means(direct.lighting.resolution)
    low, high = (float(direct.normals[i] @ directions[:, j]) + k * float(ramps[j]) for k in (-1, 1))
    if low >= 0:
        return seen * (low + high) / 2
    return seen * max(high, 0) ** 2 / (2 * (high - low))


def clustered(direct: Clustered, i: int) -> NDArray[np.float64]:
    """Row i (3, n_directions) as a function on the sphere."""
    c = direct.labels[i]
    along = direct.coefficients[i].astype(np.float64) @ direct.bases[c].astype(np.float64)
    return np.broadcast_to(along + direct.means[c], (3, direct.lighting.n_directions))


def wavelets(direct: HaarRows, i: int) -> NDArray[np.float64]:
    """Row i (3, n_directions) as a function on the sphere."""
    channels = direct.scales.shape[1]
    coefficients = np.zeros((3, direct.lighting.n_directions))
    for colour in range(3):
        k = i * channels + colour % channels
        for e in range(direct.starts[k], direct.starts[k + 1]):
            value = float(direct.values[e]) * float(direct.scales[i, colour % channels])
            coefficients[colour, direct.places[e]] = value
    return inverse_haar(coefficients).astype(np.float64)


@pytest.fixture(scope="module", params=FORMS)
def transport(request: pytest.FixtureRequest) -> LightTransport:
    return made_up(request.param)


@pytest.fixture(scope="module")
def full(transport: LightTransport) -> NDArray[np.float64]:
    return slow(transport)


def close(a: NDArray, b: NDArray) -> bool:
    """Within 1e-6, relative to the size of the whole."""
    return bool(np.abs(a - b).max() <= 1e-6 * np.abs(b).max()) and a.shape == b.shape


def test_what_a_matrix_says_of_itself_is_a_line(transport):
    words = repr(transport)
    assert len(words) < 250 and "\n" not in words
    assert f"{transport.shape[0]} vertices" in words and f"{transport.nbytes / 1e6:.1f} MB" in words
    assert all(name in words for name in transport.operators)
    known = replace(transport, report={"estimated_error": {"total": 0.0123}})
    assert "estimated error 1.23%" in repr(known)


def test_rows_columns_and_relight_are_one_matrix(transport, full):
    rows = transport.rows(np.arange(N_V))
    columns = transport.columns(np.arange(6 * N * N))
    assert rows.dtype == columns.dtype == np.float32
    assert rows.shape == columns.shape == transport.shape == (N_V, 6 * N * N, 3)
    assert close(rows, full)
    assert close(columns, full)
    L = np.random.default_rng(0).random((6 * N * N, 3), dtype=np.float32)
    relit = transport.relight(L)
    assert relit.dtype == np.float32
    assert relit.shape == (N_V, 3)
    assert close(relit, np.einsum("ijc,jc->ic", full, L))
    assert np.array_equal(relit, transport.albedo * transport.irradiance(L))


def test_a_single_texel_lights_its_column(transport):
    for j in (0, 31, 32, 95):
        L = np.zeros((6 * N * N, 3), np.float32)
        L[j] = [1, 2, 3]
        assert close(transport.relight(L), transport.columns([j])[:, 0] * [1, 2, 3])


def test_relight_is_linear(transport):
    rng = np.random.default_rng(1)
    L1, L2 = rng.random((2, 6 * N * N, 3), dtype=np.float32)
    both = transport.relight(np.float32(0.25) * L1 + np.float32(3) * L2)
    assert close(both, 0.25 * transport.relight(L1) + 3 * transport.relight(L2))


def test_many_lights_are_those_one_by_one(transport):
    lights = np.random.default_rng(2).random((6 * N * N, 3, 7), dtype=np.float32)
    expected = np.stack([transport.relight(lights[:, :, k]) for k in range(7)], axis=2)
    for together in (1, 3, 100):
        assert close(transport.relight_many(lights, together=together), expected)
    one_by_one = (lights[:, :, k] for k in range(7))
    stored, firsts = np.zeros(expected.shape, np.float16), []
    assert transport.relight_many(one_by_one, stored, 3) is None
    assert np.allclose(stored, expected, atol=2e-3 * expected.max())
    transport.relight_many(lights, lambda first, colours: firsts.append((first, colours.shape[2])), 3)
    assert firsts == [(0, 3), (3, 3), (6, 1)]
    assert transport.relight_many([]).shape == (N_V, 3, 0)


def test_nights_and_dark_ground_change_nothing(transport):
    """Texels at which all lights are black are left out. Expected: as one by one; black lights give black."""
    lights = np.random.default_rng(3).random((6 * N * N, 3, 70), dtype=np.float32)
    lights[: 2 * N * N] = 0
    lights[:, :, [4, 5, 40]] = 0
    expected = np.stack([transport.relight(lights[:, :, k]) for k in range(70)], axis=2)
    for together in (2, 70):
        found = transport.relight_many(lights, together=together)
        assert close(found, expected)
        assert not found[:, :, [4, 5, 40]].any()


def test_many_lights_that_are_none(transport):
    lights = np.ones((6 * N * N, 3, 2), np.float32)
    with pytest.raises(prt.PrtError, match="1 or more"):
        transport.relight_many(lights, together=0)
    with pytest.raises(prt.PrtError, match="one after the other"):
        transport.relight_many(lights[:-1])
    lights[3, 1, 1] = np.nan
    with pytest.raises(prt.PrtError, match="NaN"):
        transport.relight_many(lights)


@pytest.mark.parametrize(
    "ids",
    [[3, 1, 2], [3, 3, 3], [-1, 0, -2], 7, np.int64(7), np.arange(5, dtype=np.uint8), range(4), (1, 2)],
    ids=str,
)
def test_ways_to_say_which(transport, full, ids):
    chosen = np.atleast_1d(np.asarray(ids)).astype(int)
    assert close(transport.rows(ids), full[chosen])
    assert close(transport.columns(ids), full[:, chosen])


def test_nothing_asked_nothing_given(transport):
    for nothing in ([], np.zeros(0, int), np.zeros(N_V, bool)):
        assert transport.rows(nothing).shape == (0, 6 * N * N, 3)
    for nothing in ([], np.zeros(0, int), np.zeros(6 * N * N, bool)):
        assert transport.columns(nothing).shape == (N_V, 0, 3)


def test_masks(transport, full):
    rows, columns = np.arange(N_V) % 3 == 0, np.arange(6 * N * N) % 5 == 0
    assert close(transport.rows(rows), full[rows])
    assert close(transport.columns(columns), full[:, columns])


@pytest.mark.parametrize("wrong", [N_V, -N_V - 1, [0, 10**9], [0.5], [[0, 1]], "a", [np.nan], None])
def test_bad_vertices_are_refused(transport, wrong):
    with pytest.raises(prt.PrtError, match="vertex id"):
        transport.rows(wrong)


@pytest.mark.parametrize("wrong", [6 * N * N, -6 * N * N - 1, [1.0]])
def test_bad_directions_are_refused(transport, wrong):
    with pytest.raises(prt.PrtError, match="direction id"):
        transport.columns(wrong)


@pytest.mark.parametrize("length", [2, N_V + 1])
def test_a_mask_of_another_length_is_refused(transport, length):
    """As NumPy does: such a mask was made for something else."""
    with pytest.raises(prt.PrtError, match="vertex"):
        transport.rows(np.ones(length, bool))


def test_the_message_names_the_id_that_is_out_of_range(transport):
    with pytest.raises(prt.PrtError, match="-1000"):
        transport.rows([5, -1000])
    with pytest.raises(prt.PrtError, match=f"1000 is out of range: there are {N_V}"):
        transport.rows([-1, 1000])


def test_ways_to_say_the_lighting(transport, full):
    constant = np.einsum("ijc->ic", full)
    n = transport.lighting.resolution
    assert close(transport.relight(1.0), constant)
    assert close(transport.relight([1, 2, 3]), constant * [1, 2, 3])
    assert close(transport.relight(np.ones((6, n, n, 3))), constant)
    assert close(transport.relight(prt.Environment(np.ones((8, 16, 3), np.float32))), constant)
    for wrong in (np.ones(7), np.full((6 * n * n, 3), np.nan), np.ones((6 * n * n, 4))):
        with pytest.raises(prt.PrtError):
            transport.relight(wrong)


@pytest.mark.parametrize("form", ["bits", "shares"])
@pytest.mark.parametrize("n", [1, 2])
def test_padding_bits_are_never_read(form, n):
    """6 and 24 directions leave 26 and 8 bits of the last word unused."""
    transport = made_up(form, n)
    dirty = transport.direct.bits.copy()
    dirty[:, -1] |= np.uint32(0xFFFFFFFF << (6 * n * n % 32) & 0xFFFFFFFF)
    dirty = altered(transport, direct=replace(transport.direct, bits=dirty))
    assert (dirty.direct.bits != transport.direct.bits).any()
    assert np.array_equal(dirty.rows([0, 1]), transport.rows([0, 1]))
    assert np.array_equal(dirty.relight(1.0), transport.relight(1.0))
    assert close(transport.rows(np.arange(N_V)), slow(transport))


def test_many_blocks_of_rows():
    """More vertices than a block of the product: the seams do not show."""
    transport = made_up("fixed point and full indirect", 1, 9001)
    rows = transport.rows(np.arange(9001))
    assert close(transport.relight([1, 2, 3]), (rows.astype(np.float64) * [1, 2, 3]).sum(axis=1))


@pytest.mark.parametrize("n", [4, 8, 32])
def test_mean_cosines_against_quadrature(n):
    """All texels are seen: max(0, n . w) over each by 12 x 12 to 96 x 96 points, for 40 random normals.

    Expected: exact away from the horizon; where that cuts a texel, within a tenth of half its diagonal (n . w is
    spread over a trapezoid or a triangle there, and not evenly). All texels together are 1, to 1.2% / n.
    """
    rng = np.random.default_rng(2)
    transport = made_up("shares", n, 40)
    lit = np.full_like(transport.direct.bits, 0xFFFFFFFF)
    none = {
        "starts": np.zeros(41, np.int64),
        "texels": np.zeros(0, np.uint16),
        "shares": np.zeros(0, np.uint8),
    }
    direct = replace(transport.direct, bits=lit, **none)
    lighting, normals = direct.lighting, direct.normals
    some = rng.choice(lighting.n_directions, min(96, lighting.n_directions), replace=False)
    directions, weights = (x[some] for x in lighting.subdirections(384 // n))
    cosine = np.maximum(np.einsum("vd,jkd->vjk", normals, directions), 0)
    exact = np.einsum("vjk,jk->vj", cosine, weights) / np.pi
    error = np.abs(direct.columns(some)[..., 0] - exact) * np.pi / lighting.solid_angles[some]
    near = np.abs(normals @ lighting.directions[some].T) < 2 / n
    assert near.any()
    assert error[~near].max() < 1e-5
    assert error.max() < 0.1 * np.sqrt(2) / n
    assert np.abs(direct.relight(np.ones((lighting.n_directions, 3), np.float32)) - 1).max() < 0.012 / n


def test_bytes_are_those_of_the_factors():
    sizes = {form: made_up(form).nbytes for form in FORMS}
    assert sizes["bits"] == N_V * 96 / 8
    assert sizes["fixed point"] == N_V * 96 * 2
    assert sizes["bits and coarse indirect"] == sizes["bits"] + N_V * 24 * 3 * 2
    assert sizes["fixed point and full indirect"] == sizes["fixed point"] + N_V * 96 * 2
    n_shares = len(made_up("shares").direct.shares)
    assert n_shares > 300
    assert sizes["shares"] == sizes["bits"] + (N_V + 1) * 8 + n_shares * 3
    assert sizes["bits and factored light"] == sizes["bits"] + (N_V + 96) * (2 + 3 + 5) * 4
    assert sizes["fixed point and factored grey light"] == sizes["fixed point"] + (N_V + 96) * 3 * 4


# ------------------------------------------------------------------------------------ other vertex orders


def test_rows_follow_the_order_of_a_scenes_vertices():
    """The same three shapes in another order, and merged by Mitsuba: rows come in the asking scene's order."""
    shapes = still_life(((0.5,) * 3,) * 3)
    scene = build(**shapes)
    keys = vertex_points(scene).keys
    transport = altered(
        made_up("bits and coarse indirect", n_vertices=scene.n_vertices),
        albedo=scene.albedo,
        vertex_keys=keys,
        scene_hash=scene.hash,
        meshes=tuple(MeshRange(m.name, m.vertices) for m in scene.meshes),
    )
    transport = altered(transport, direct=replace(transport.direct, normals=scene.normals))
    assert np.array_equal(transport.for_scene(scene).rows([0, 9]), transport.rows([0, 9]))

    other = build(**dict(reversed(list(shapes.items()))))
    merged = build(optimize=True, **shapes)
    assert [m.name for m in other.meshes] == ["box", "ball", "ground"]
    for target in (other, merged):
        turned = transport.for_scene(target)
        assert [m.name for m in turned.meshes] == [m.name for m in target.meshes]
        assert [m.vertices for m in turned.meshes] == [m.vertices for m in target.meshes]
        row_of = {tuple(p): i for i, p in enumerate(np.c_[scene.positions, scene.normals].tolist())}
        source = [row_of[tuple(p)] for p in np.c_[target.positions, target.normals].tolist()]
        assert not np.array_equal(source, np.arange(len(source))) or target is merged
        assert np.array_equal(turned.rows(np.arange(len(source))), transport.rows(source))
        assert np.array_equal(turned.relight([1, 2, 3]), transport.relight([1, 2, 3])[source])


def test_a_matrix_of_another_scene_is_refused(grey_scene):
    with pytest.raises(prt.PrtError, match="belongs to another scene"):
        made_up("bits").for_scene(grey_scene)
    same_shapes = build(**still_life(((0.5,) * 3, (0.6,) * 3, (0.71,) * 3)))
    transport = replace(made_up("bits"), scene_hash=grey_scene.hash)
    with pytest.raises(prt.PrtError, match="belongs to another scene"):
        transport.for_scene(same_shapes)


def test_a_matrix_of_other_vertices_of_the_scene_is_refused():
    """Right hash, but the keys are not the scene's (an altered file)."""
    scene = build(ball={"type": "cube", "bsdf": diffuse(1, 1, 1)})
    transport = replace(made_up("bits", n_vertices=scene.n_vertices), scene_hash=scene.hash)
    with pytest.raises(prt.PrtError):
        transport.for_scene(scene)


def test_upsampling_may_have_any_sparsity():
    """Columns and relight read the interpolation matrix in two ways: by rows and transposed."""
    transport = made_up("bits and coarse indirect")
    random = scipy.sparse.random_array(
        (96, 24), density=0.3, rng=np.random.default_rng(3), dtype=np.float32
    ).tocsr()
    transport = altered(transport, indirect=replace(transport.indirect, upsampling=random))
    full = slow(transport)
    assert close(transport.columns(np.arange(96)), full)
    assert close(transport.columns([5]), full[:, [5]])
    assert close(transport.relight(1.0), full.sum(axis=1))
