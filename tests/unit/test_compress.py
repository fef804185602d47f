"""``prt.compress``: against the rows that were compressed; any kind of matrix; reports that say what is so."""

import json
from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse
from conftest import altered, made_up

import mi_sparse_prt as prt
from mi_sparse_prt.compression import clustered_pca
from mi_sparse_prt.compression.clustered_pca import finalise, mesh_rows
from mi_sparse_prt.compression.compress import matrix_errors
from mi_sparse_prt.compression.cpca import Clusters, lloyd_refine, standard_cpca
from mi_sparse_prt.operators.clustered import Clustered
from mi_sparse_prt.operators.interpolated import Interpolated
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.transport import LightTransport

FORMS = ("bits", "bits and factored light", "shares and factored light", "fixed point and full indirect")


def relative(ours: np.ndarray, truth: np.ndarray) -> float:
    return float(np.linalg.norm(ours.astype(np.float64) - truth) / np.linalg.norm(truth))


def every_row(transport: LightTransport) -> np.ndarray:
    return transport.rows(np.arange(len(transport.albedo)))


@pytest.fixture(scope="module")
def computed(grey_scene: Scene) -> LightTransport:
    """A real matrix, of smooth rows."""
    return prt.precompute(grey_scene, prt.CubemapLighting(8), method="gather", progress=False)


@pytest.mark.parametrize(("form", "bases"), [*((form, 4) for form in FORMS), ("bits", 0)])
def test_errors_are_those_of_the_rows(form: str, bases: int) -> None:
    """``error`` is what an expanded matrix has, 16-bit numbers included; so is that on the sphere."""
    transport = made_up(form)
    compressed = prt.compress(transport, clusters=3, bases=bases, progress=False)
    report = compressed.report["compression"]
    truth, ours = every_row(transport), every_row(compressed)
    assert report["error"]["total"] == pytest.approx(relative(ours, truth), rel=2e-3)
    for mesh in transport.meshes:
        assert report["error"][mesh.name] == pytest.approx(
            relative(ours[mesh.vertices], truth[mesh.vertices]), rel=2e-3
        )
    scale = np.sqrt(
        transport.measurement.areas[:, None, None] / transport.lighting.solid_angles[None, :, None]
    )
    every = np.arange(len(transport.albedo))
    on_sphere = relative(compressed.incident.rows(every) * scale, transport.incident.rows(every) * scale)
    assert report["error"]["on_sphere"]["total"] == pytest.approx(on_sphere, rel=2e-3)
    assert 0.05 < report["error"]["total"] < 1
    assert report["nbytes"] == compressed.nbytes
    json.dumps(compressed.report)


@pytest.mark.parametrize("form", FORMS)
def test_enough_basis_vectors_leave_nothing_out(form: str) -> None:
    transport = made_up(form)
    compressed = prt.compress(transport, clusters=1, bases=150, progress=False)
    assert relative(every_row(compressed), every_row(transport)) < 2e-3  # 16 bits


def test_factors_give_the_clusters_of_the_expanded_matrix() -> None:
    """T = A D + S, interpolated light and bits: from the same clusters, errors within 1e-4 of explicit ones."""
    rng = np.random.default_rng(2)
    base = made_up("bits and full indirect", n=4, n_vertices=60)
    dense = made_up("bits and full indirect", n=4, n_vertices=12).indirect
    weights = scipy.sparse.random_array((60, 12), density=0.3, rng=rng, format="csr", dtype=np.float32)
    transport = altered(base, indirect=Interpolated(dense, weights))
    rows = mesh_rows(transport, replace(base.meshes[0], vertices=slice(0, 60)))
    explicit = rows.rows(np.arange(60))
    span = np.linalg.qr(explicit[:, 0].T)[0].T.astype(np.float32)
    coordinates = rows.coordinates(span)
    np.testing.assert_allclose(coordinates @ span, explicit, atol=1e-4)
    start = standard_cpca(explicit, rows.weights, 4, 5)
    lifted = Clusters(start.labels, start.means @ span.T, start.bases @ span.T)
    one = lloyd_refine(explicit, rows.weights, start, 5, True)
    other = lloyd_refine(coordinates, rows.weights, lifted, 5, True)
    np.testing.assert_array_equal(one.labels, other.labels)
    errors = [
        finalise(rows, found, values).left[-1] for found, values in ((other, coordinates), (one, explicit))
    ]
    energy = (rows.weights * np.square(explicit).sum(axis=(1, 2))).sum()
    assert abs(np.sqrt(errors[0] / energy) - np.sqrt(errors[1] / energy)) < 1e-4


def test_a_target_error_is_met_with_no_more_than_it_needs(computed: LightTransport) -> None:
    for target in (0.1, 0.03):
        compressed = prt.compress(computed, clusters=2, bases=16, target_error=target, progress=False)
        found = matrix_errors(computed, compressed)
        assert found["total"] <= target
        assert compressed.report["compression"]["error"]["total"] == pytest.approx(found["total"], rel=1e-3)
        part = compressed.operators["compressed"]
        assert isinstance(part, Clustered)
        fewer = replace(part, coefficients=part.coefficients[:, :, :-1], bases=part.bases[:, :-1])
        assert matrix_errors(computed, replace(compressed, operators={"compressed": fewer}))["total"] > target


def test_relighting_and_files(computed: LightTransport, tmp_path) -> None:
    compressed = prt.compress(computed, bases=12, progress=False)
    light = np.random.default_rng(1).random((computed.lighting.n_directions, 3)).astype(np.float32)
    np.testing.assert_allclose(
        compressed.relight(light), np.einsum("ijc,jc->ic", every_row(compressed), light), rtol=1e-3, atol=1e-5
    )
    assert relative(compressed.relight(light), computed.relight(light)) < 0.02
    compressed.save(tmp_path / "a.prt")
    again = prt.load_transport(tmp_path / "a.prt")
    np.testing.assert_array_equal(again.relight(light), compressed.relight(light))
    assert again.report["compression"] == compressed.report["compression"]


def test_a_coloured_scene_shares_clusters_among_channels() -> None:
    transport = made_up("bits and factored light")
    part = prt.compress(transport, clusters=2, bases=5, progress=False).operators["compressed"]
    assert part.coefficients.shape == (50, 3, 5)
    assert len(part.labels) == 50


def test_clusters_that_are_fitted_to_some_of_their_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    """All rows have coefficients then, and errors are those of all."""
    monkeypatch.setattr(clustered_pca, "FITTED", 8)
    transport = made_up("bits and factored light")
    compressed = prt.compress(transport, clusters=1, bases=4, progress=False)
    found = relative(every_row(compressed), every_row(transport))
    assert compressed.report["compression"]["error"]["total"] == pytest.approx(found, rel=2e-3)
    again = prt.compress(transport, clusters=1, bases=4, progress=False)
    assert again.report["compression"]["error"] == compressed.report["compression"]["error"]


def test_black_and_equal_rows() -> None:
    transport = made_up("bits")
    bits = transport.direct.bits.copy()
    bits[:20] = 0  # the first mesh is black
    bits[20:] = bits[20]
    normals = np.repeat(transport.direct.normals[:1], 50, axis=0)
    transport = altered(transport, direct=replace(transport.direct, bits=bits, normals=normals))
    compressed = prt.compress(transport, clusters=5, bases=4, progress=False)
    assert relative(every_row(compressed), every_row(transport)) < 1e-3
    assert not compressed.rows(np.arange(20)).any()
    assert compressed.report["compression"]["clusters"] == {"a": 1, "b": 1}
    assert compressed.report["compression"]["error"]["a"] == 0


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"method": "zip"}, "cpca"),
        ({"clusters": 0}, "at least 1"),
        ({"clusters": {"c": 3}}, "'c'"),
        ({"clusters": {"a": -1}}, "at least 1"),
        ({"bases": -1}, "negative"),
        ({"target_error": 0.0}, "between"),
    ],
)
def test_arguments_that_make_no_sense(arguments: dict, said: str) -> None:
    with pytest.raises(prt.PrtError, match=said):
        prt.compress(made_up("bits"), **arguments)


def test_a_compressed_matrix_is_not_compressed_again() -> None:
    with pytest.raises(prt.PrtError, match="already"):
        prt.compress(made_up("clusters"))
