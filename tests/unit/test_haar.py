"""Haar wavelets of cubemaps and rows truncated in them: against explicit matrices and sorted coefficients."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from conftest import FORMS, altered, made_up
from tqdm.auto import tqdm

import mi_sparse_prt as prt
from mi_sparse_prt.compression.compress import compress
from mi_sparse_prt.compression.haar_truncation import haar_mesh, haar_part, truncate
from mi_sparse_prt.emission.haar import haar, inverse_haar
from mi_sparse_prt.operators.haar_rows import HaarRows
from mi_sparse_prt.operators.mean_cosine import MeanCosine
from mi_sparse_prt.transport import LightTransport, MeshRange

ROUNDED = 1e-3  # of float16 numbers, relative


@dataclass(frozen=True)
class HaarSquares:
    """What each coefficient of a cubemap with n texels along a face's edge belongs to, all (6 n^2,) int64.

    Attributes
    ----------
    face : 0 to 5
    level : 0 to log2(n) - 1
        Its squares are n / 2^level texels wide; 0 for a face's mean as well.
    kind : 0 to 3
        0 is a face's mean; see ``emission.haar`` for 1 to 3.
    row, col : 0 to 2^level - 1
        Of the square among those of its level.
    """

    face: np.ndarray
    level: np.ndarray
    kind: np.ndarray
    row: np.ndarray
    col: np.ndarray


def haar_squares(resolution: int) -> HaarSquares:
    """What all coefficients belong to, of a cubemap of ``resolution`` texels along a face's edge, a power of two."""
    n = resolution
    face, row, col = np.unravel_index(np.arange(6 * n * n), (6, n, n))
    level = np.log2(np.maximum(np.maximum(row, col), 1)).astype(np.int64)
    squares = 1 << level  # along an edge
    down, across = (row >= squares).astype(np.int64), (col >= squares).astype(np.int64)
    return HaarSquares(face, level, 2 * down + across, row - down * squares, col - across * squares)


def explicit(n: int) -> np.ndarray:
    """Wavelets (6 n^2, 6 n^2), one per row, drawn square by square from what their names say."""
    named = haar_squares(n)
    result = np.zeros((6 * n * n, 6, n, n))
    names = (named.face, named.level, named.kind, named.row, named.col)
    for wavelet, (face, level, kind, row, col) in zip(result, zip(*names, strict=True), strict=True):
        side = n >> level
        y, x = np.mgrid[:side, :side] >= side / 2
        sign = {0: 1 + 0 * x, 1: 1 - 2 * x, 2: 1 - 2 * y, 3: (1 - 2 * x) * (1 - 2 * y)}[int(kind)]
        wavelet[face, row * side : (row + 1) * side, col * side : (col + 1) * side] = sign / side
    return result.reshape(6 * n * n, -1)


def smooth(n: int = 8, n_vertices: int = 40, seed: int = 3) -> LightTransport:
    """A matrix of one channel whose rows are half-spaces, so that wavelets make them short."""
    rng = np.random.default_rng(seed)
    base = made_up("fixed point", n, n_vertices)
    seen = np.maximum(rng.normal(size=(n_vertices, 3)) @ base.lighting.directions.T, 0)
    fixed = (65535 * seen / seen.max()).astype(np.uint16)
    return altered(base, direct=MeanCosine(fixed, base.lighting), areas=np.ones(n_vertices, np.float32))


def on_sphere(transport: LightTransport, part: HaarRows | None = None) -> np.ndarray:
    """White rows (n_v, channels, m) in the norm of the sphere."""
    ids = np.arange(len(transport.albedo))
    white = transport.incident.rows(ids) if part is None else part.rows(ids)
    return np.moveaxis(white, 2, 1).astype(np.float64) / np.sqrt(transport.lighting.solid_angles)


def squares(values: np.ndarray) -> np.ndarray:
    return np.square(values).sum(axis=-1)


def close(a: np.ndarray, b: np.ndarray) -> bool:
    return a.shape == b.shape and bool(np.abs(a - b).max() <= 1e-5 * max(np.abs(b).max(), 1e-30))


@pytest.mark.parametrize("n", [1, 2, 4])
def test_the_transform_is_an_explicit_orthonormal_matrix(n: int) -> None:
    matrix = explicit(n)
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(6 * n * n), atol=1e-12)
    values = np.random.default_rng(0).normal(size=(2, 3, 6 * n * n))
    np.testing.assert_allclose(haar(values), values @ matrix.T, atol=1e-5)


def test_squares_tell_where_wavelets_of_a_large_cubemap_are() -> None:
    """Coefficients of a single texel are those whose squares contain it: 3 per level and a face's mean."""
    n, texel = 32, (4, 21, 10)
    values = np.zeros((6, n, n), np.float32)
    values[texel] = 1
    found = np.flatnonzero(np.abs(haar(values.ravel())) > 1e-6)
    named = haar_squares(n)
    assert len(found) == 3 * 5 + 1
    assert (named.face[found] == 4).all()
    side = n >> named.level[found]
    np.testing.assert_array_equal(named.row[found], texel[1] // side)
    np.testing.assert_array_equal(named.col[found], texel[2] // side)


@pytest.mark.parametrize("n", [1, 2, 8, 16])
def test_the_inverse_and_the_norm(n: int) -> None:
    values = np.random.default_rng(1).normal(size=(3, 6 * n * n)).astype(np.float32)
    before = values.copy()
    coefficients = haar(values)
    assert coefficients.dtype == np.float32
    np.testing.assert_allclose(inverse_haar(coefficients), values, atol=1e-5)
    np.testing.assert_allclose(squares(coefficients), squares(values), rtol=1e-5)
    np.testing.assert_array_equal(values, before)  # nothing is done in place


def test_a_constant_face_has_one_coefficient() -> None:
    values = np.repeat(np.arange(1.0, 7), 64)
    coefficients = haar(values).reshape(6, 64)
    np.testing.assert_allclose(coefficients[:, 0], 8 * np.arange(1, 7), rtol=1e-12)
    assert np.abs(coefficients[:, 1:]).max() < 1e-12


@pytest.mark.parametrize("share", [0.0, 1e-4, 0.01, 0.3])
def test_as_few_are_kept_as_possible(share: float) -> None:
    """Against a sort of all squares; some coefficients are equal, and one row has a single one."""
    rng = np.random.default_rng(2)
    rows = (rng.normal(size=(20, 2, 100)) ** 5).astype(np.float32)
    rows[3] = np.round(rows[3])
    rows[4] = 1
    rows[5, 0], rows[5, 1] = 0, np.eye(100)[7]
    found = rows.copy()
    energies = truncate(found, share)
    for before, after, (energy, lost) in zip(
        rows.reshape(40, 100), found.reshape(40, 100), energies.reshape(40, 2), strict=True
    ):
        kept = after != 0
        np.testing.assert_array_equal(after[kept], before[kept])
        ascending = np.cumsum(np.sort(np.square(before, dtype=np.float64)))
        assert kept.sum() == (ascending > share * ascending[-1] * (1 + 1e-12)).sum()
        assert energy == pytest.approx(ascending[-1])
        assert lost == pytest.approx(np.square(before[~kept], dtype=np.float64).sum())


@pytest.mark.parametrize("target", [0.001, 0.02, 0.2])
@pytest.mark.parametrize("form", ["fixed point", "bits and factored light"])
def test_rows_keep_what_they_promise(form: str, target: float) -> None:
    transport = made_up(form)
    part, _ = haar_part(transport, target, progress=False)
    exact = on_sphere(transport)
    errors = np.sqrt(squares(on_sphere(transport, part) - exact) / squares(exact))
    assert errors.max() <= target * (1 + 1e-4)
    assert errors.max() > 0.5 * target


def test_the_error_is_the_energy_left_out() -> None:
    """On the sphere by its numbers; of T against both matrices, made explicit."""
    transport = altered(smooth(), areas=np.random.default_rng(5).random(40).astype(np.float32))
    part, report = haar_part(transport, 0.05, progress=False)
    other = altered(transport, direct=part, indirect=None)
    for mesh in transport.meshes:
        left_out = 1 - report["kept_energy"][mesh.name]
        assert report["error"]["on_sphere"][mesh.name] ** 2 == pytest.approx(left_out, rel=ROUNDED)
        ids = np.arange(40)[mesh.vertices]
        away, exact = other.rows(ids) - transport.rows(ids), transport.rows(ids)
        error = np.linalg.norm(away) / np.linalg.norm(exact)
        assert report["error"][mesh.name] == pytest.approx(error, rel=ROUNDED)
    away, exact = squares(on_sphere(transport, part) - on_sphere(transport)), squares(on_sphere(transport))
    total = np.sqrt(transport.measurement.areas @ away[:, 0] / (transport.measurement.areas @ exact[:, 0]))
    assert report["error"]["on_sphere"]["total"] == pytest.approx(total, rel=ROUNDED)
    assert report["error"]["on_sphere"]["total"] <= 0.05


def test_the_report_counts() -> None:
    """Against a sort of the coefficients, of which none is near the limit."""
    transport, target = smooth(), 0.05
    part, report = haar_part(transport, target, progress=False)
    ascending = np.cumsum(
        np.sort(np.square(haar(on_sphere(transport)[:, 0]), dtype=np.float64), axis=1), axis=1
    )
    lengths = (ascending > target**2 * ascending[:, -1:]).sum(axis=1)
    for mesh in transport.meshes:
        some = lengths[mesh.vertices]
        assert report["coefficients"][mesh.name] == {"mean": some.mean(), "largest": some.max()}
    assert report["nbytes"] == part.nbytes == 8 * 41 + 4 * lengths.sum() + 4 * 40
    assert report["ratio"] == pytest.approx(4 * 40 * 384 / part.nbytes)


@pytest.mark.parametrize("form", FORMS)
def test_all_ways_to_use_the_part_are_one_matrix(form: str) -> None:
    transport = made_up(form)
    part, _ = haar_part(transport, 0.1, progress=False)
    rng = np.random.default_rng(6)
    m = transport.lighting.n_directions
    rows = part.rows(np.arange(50))
    assert rows.dtype == np.float32
    assert rows.shape == transport.incident.rows(np.arange(50)).shape
    columns = rng.integers(0, m, 7)
    assert close(part.columns(columns), rows[:, columns])
    light = rng.normal(size=(m, 3)).astype(np.float32)
    channels = np.broadcast_to(rows, (50, m, 3)).astype(np.float64)
    assert close(part.relight(light), np.einsum("vmc,mc->vc", channels, light))
    for k in (1, 3, 5):
        vectors = rng.normal(size=(m, k)).astype(np.float32)
        assert close(part.apply(vectors), np.einsum("vmc,mk->vck", rows.astype(np.float64), vectors))
    source = rng.permutation(50)[:20]
    assert close(part.take(source).rows(np.arange(20)), rows[source])
    assert close(part.rows(source), rows[source])


def test_a_matrix_with_the_part_relights() -> None:
    """Within the bound that the error of the rows sets."""
    transport = made_up("bits and factored light")
    part, report = haar_part(transport, 0.02, progress=False)
    small = altered(transport, direct=part, indirect=None)
    light = np.random.default_rng(7).random((96, 3), dtype=np.float32)
    bound = 0.02 * np.sqrt(squares(on_sphere(transport)) * ((light**2).T @ transport.lighting.solid_angles))
    assert (np.abs(small.irradiance(light) - transport.irradiance(light)) <= 1.001 * bound).all()


def test_rows_of_one_mesh_do_not_depend_on_others() -> None:
    transport = made_up("bits and factored light")
    part, _ = haar_part(transport, 0.1, progress=False)
    with tqdm(disable=True) as bar:
        mesh = haar_mesh(transport, MeshRange("b", slice(20, 50)), 0.1, bar)
    assert close(mesh.part.rows(np.arange(30)), part.rows(np.arange(20, 50)))


def test_black_rows_have_no_coefficients() -> None:
    transport = smooth()
    fixed = transport.direct.fixed.copy()
    fixed[:25] = 0  # all of the first mesh
    transport = altered(transport, direct=MeanCosine(fixed, transport.lighting))
    part, report = haar_part(transport, 0.05, progress=False)
    assert part.starts[25] == 0
    assert not part.rows(np.arange(25)).any()
    assert not part.relight(np.ones((384, 3), np.float32))[:25].any()
    assert report["error"]["a"] == 0 and report["kept_energy"]["a"] == 1
    assert 0 < report["error"]["b"] < 0.1


def test_equal_rows_stay_equal() -> None:
    transport = smooth()
    fixed = np.repeat(transport.direct.fixed[:1], 40, axis=0)
    part, _ = haar_part(altered(transport, direct=MeanCosine(fixed, transport.lighting)), 0.05, False)
    rows = part.rows(np.arange(40))
    np.testing.assert_array_equal(rows, np.repeat(rows[:1], 40, axis=0))


@pytest.mark.parametrize("n", [1, 2])
def test_tiny_cubemaps(n: int) -> None:
    transport = made_up("fixed point and factored grey light", n)
    part, report = haar_part(transport, 0.001, progress=False)
    assert close_to(part.rows(np.arange(50)), transport.incident.rows(np.arange(50)), 0.005)
    assert report["error"]["total"] <= 0.002


def close_to(a: np.ndarray, b: np.ndarray, error: float) -> bool:
    return a.shape == b.shape and bool(np.linalg.norm(a - b) <= error * np.linalg.norm(b))


def test_dark_scenes_lose_no_digits() -> None:
    """Numbers of 1e-12 would be 0 in float16."""
    base = made_up("fixed point and factored grey light")
    factors = base.indirect
    dark = replace(factors, left=(factors.left[0] * np.float32(1e-12),))
    dim = altered(base, direct=MeanCosine(np.zeros_like(base.direct.fixed), base.lighting), indirect=dark)
    _, report = haar_part(dim, 0.001, progress=False)
    assert 0 < report["error"]["on_sphere"]["total"] <= 0.001


def test_large_cubemaps_have_wide_places() -> None:
    """6 x 128 x 128 is more than 16 bits tell."""
    lighting = prt.CubemapLighting(128)
    fixed = np.zeros((2, lighting.n_directions), np.uint16)
    fixed[:, -5:] = 60000
    base = made_up("fixed point", 1, 2)
    transport = altered(
        base, lighting=lighting, direct=MeanCosine(fixed, lighting), meshes=(MeshRange("a", slice(0, 2)),)
    )
    part, report = haar_part(transport, 0.01, progress=False)
    assert part.places.dtype == np.uint32
    assert part.places.max() > 65535
    assert report["error"]["total"] <= 0.01


def test_the_entry(tmp_path) -> None:
    transport = made_up("bits and factored light")
    small = compress(transport, method="haar", target_error=0.1, progress=False)
    part, report = haar_part(transport, 0.1, progress=False)
    np.testing.assert_array_equal(small.operators["compressed"].values, part.values)
    assert small.indirect is None
    assert small.report["compression"]["error"] == report["error"]
    assert small.report["compression"]["method"] == "haar"
    assert "compression" not in transport.report
    small.save(tmp_path / "a.prt")
    np.testing.assert_array_equal(prt.load_transport(tmp_path / "a.prt").rows([3]), small.rows([3]))
    with pytest.raises(prt.PrtError, match="already"):
        compress(small, method="haar")
    with pytest.raises(prt.PrtError, match="clusters are of method"):
        compress(transport, method="haar", clusters=3)
