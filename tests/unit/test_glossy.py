"""Glossy transport: its rows, products and views agree with each other and with the factors."""

import mitsuba as mi
import numpy as np
import pytest
from conftest import build, diffuse

import mi_sparse_prt as prt
from mi_sparse_prt.operators.column_blocks import ColumnBlocks
from mi_sparse_prt.reflection.frames import frames, orthogonalise
from mi_sparse_prt.relighting.image import render
from mi_sparse_prt.scene.scene import Scene
from mi_sparse_prt.transport import LightTransport

BRUSHED = {
    "type": "ashikhmin_shirley",
    "diffuse_reflectance": {"type": "rgb", "value": 0.3},
    "specular_reflectance": {"type": "rgb", "value": 0.3},
    "exponent_u": 5.0,
    "exponent_v": 60.0,
}


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A brushed ball on a diffuse plane."""
    flat = mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale(2)
    ball = {"type": "sphere", "center": [0, 0.5, 0], "radius": 0.5, "bsdf": BRUSHED}
    with pytest.warns(prt.PrtWarning, match="not diffuse"):
        return build(
            0.4, ball=ball, ground={"type": "rectangle", "to_world": flat, "bsdf": diffuse(0.5, 0.5, 0.5)}
        )


@pytest.fixture(scope="module")
def glossy(scene: Scene) -> LightTransport:
    return prt.precompute_glossy(scene, prt.CubemapLighting(8), terms=3, progress=False)


@pytest.fixture(scope="module")
def coarse(scene: Scene) -> LightTransport:
    """Of so few directions that a basis of all is small."""
    return prt.precompute_glossy(scene, prt.CubemapLighting(2), terms=3, progress=False)


def every_row(glossy: LightTransport) -> np.ndarray:
    return glossy.incident.rows(np.arange(glossy.direct.shape[0]))


def test_direct_terms_are_factors_times_visibility(scene: Scene, glossy: LightTransport) -> None:
    """In the frame of each vertex; the table costs next to nothing."""
    direct, lighting, reflection = glossy.direct, glossy.lighting, glossy.reflection
    rows = direct.rows(np.arange(direct.shape[0]))[..., 0]
    turn = frames(reflection.tangents, reflection.normals)
    for i in range(0, len(direct.glossy), 37):
        v = direct.glossy[i]
        local = lighting.directions @ turn[v].T
        seen = rows[v] > 0  # above the horizon and not blocked
        factors = reflection.factors[0]
        f = factors.grid.interpolate(factors.incident, local)
        expected = f * seen * lighting.solid_angles
        found = rows[scene.n_vertices + 3 * i : scene.n_vertices + 3 * (i + 1)]
        high = local[:, 2] > 0.1
        scale = np.abs(expected).max(axis=1, keepdims=True)
        assert (np.abs(found - expected)[:, high] < 0.02 * scale).all()
        gain = (found * expected).sum(axis=1) / np.square(expected).sum(axis=1)
        np.testing.assert_allclose(gain, 1, atol=4e-3)


def test_all_ways_to_ask_agree(glossy: LightTransport) -> None:
    direct, lighting = glossy.direct, glossy.lighting
    rng = np.random.default_rng(0)
    every = direct.rows(np.arange(direct.shape[0]))
    ids, texels = rng.permutation(direct.shape[0])[:40], rng.permutation(lighting.n_directions)[:10]
    light = rng.random((lighting.n_directions, 3)).astype(np.float32)
    np.testing.assert_array_equal(direct.rows(ids), every[ids])
    np.testing.assert_allclose(direct.columns(texels), every[:, texels], atol=1e-7)
    np.testing.assert_allclose(direct.relight(light), every[..., 0] @ light, atol=1e-5)
    np.testing.assert_allclose(direct.apply(light)[:, 0], every[..., 0] @ light, atol=1e-5)
    few = direct.take(ids)
    np.testing.assert_array_equal(few.rows(np.arange(len(ids))), every[ids])
    np.testing.assert_allclose(np.array(ColumnBlocks(few).at(texels)), every[ids][:, texels, 0], atol=1e-7)
    words, signs = np.array([1, 5]), rng.choice(np.array([-1, 1], np.float32), (2, 32))
    sums = sum(every[:, 32 * w : 32 * w + 32, 0] * s for w, s in zip(words, signs, strict=True))
    np.testing.assert_allclose(direct.combined(words, signs), sums, atol=1e-6)


def test_relighting_is_a_sum_over_terms(scene: Scene, glossy: LightTransport) -> None:
    light = np.random.default_rng(1).random((glossy.lighting.n_directions, 3)).astype(np.float32)
    rows = every_row(glossy)
    found = glossy.coefficients(light)
    b = np.einsum("ijc,jd->id", rows, light)  # grey: one channel
    np.testing.assert_allclose(found.unit_albedo, b[: scene.n_vertices], rtol=1e-3, atol=1e-5)
    terms = b[scene.n_vertices :].reshape(-1, 3, 3)
    np.testing.assert_allclose(found.terms[glossy.reflection.glossy], terms, rtol=1e-3, atol=1e-5)
    up = np.array([0.0, 1.0, 0.0])
    radiance = glossy.relight(light, up)
    reflection = glossy.reflection
    v = reflection.glossy[np.argmax(scene.normals[reflection.glossy, 1])]  # the top of the ball
    local = (frames(reflection.tangents, reflection.normals)[v] @ up).astype(np.float32)
    factors = reflection.factors[0]
    g = factors.grid.interpolate(factors.outgoing, local[None])[:, 0, 0]
    expected = glossy.albedo[v] * found.unit_albedo[v] + g @ found.terms[v]
    np.testing.assert_allclose(radiance[v], expected, rtol=1e-4)
    assert not radiance[scene.normals[:, 1] < -0.01].any()


def test_terms_take_either_sign(glossy: LightTransport) -> None:
    rows = every_row(glossy)[len(glossy.albedo) :]
    assert (rows < -0.01 * rows.max()).any()


def test_without_indirect_light(scene: Scene) -> None:
    direct = prt.precompute_glossy(scene, prt.CubemapLighting(4), terms=2, max_depth=2, progress=False)
    assert direct.indirect is None
    assert "gather" not in direct.report["rays"]


def test_rows_of_a_vertex_share_its_cluster(scene: Scene, glossy: LightTransport) -> None:
    small = prt.compress(glossy, clusters=3, bases=16, progress=False)
    labels = small.operators["compressed"].labels
    per_vertex = labels[scene.n_vertices :].reshape(-1, 3)
    np.testing.assert_array_equal(per_vertex, labels[glossy.reflection.glossy][:, None].repeat(3, axis=1))
    light = np.random.default_rng(1).random((glossy.lighting.n_directions, 3)).astype(np.float32)
    toward = np.array([0.3, 1.0, 0.4])
    ours, truth = (t.relight(light, toward) for t in (small, glossy))
    assert np.linalg.norm(ours - truth) < 0.02 * np.linalg.norm(truth)
    assert small.report["compression"]["error"]["total"] < 0.2


def test_a_compressed_transport_is_rendered(scene: Scene, coarse: LightTransport) -> None:
    """With all basis vectors there are it is the same picture, but for 16 bits."""
    sensor = mi.load_dict(
        {
            "type": "perspective",
            "to_world": mi.ScalarTransform4f().look_at([1, 1.5, 3], [0, 0.4, 0], [0, 1, 0]),
            "film": {"type": "hdrfilm", "width": 32, "height": 24},
        }
    )
    light = np.random.default_rng(2).random((coarse.lighting.n_directions, 3)).astype(np.float32)
    exact = prt.compress(coarse, clusters=1, bases=24, progress=False)
    images = [render(scene, t, light, sensor, spp=4) for t in (coarse, exact)]
    assert np.linalg.norm(images[0] - images[1]) < 2e-3 * np.linalg.norm(images[0])


@pytest.mark.parametrize(
    ("arguments", "said"), [({"terms": 0}, "at least 1"), ({"direct": "some"}, "neither")]
)
def test_arguments_that_make_no_sense(scene: Scene, arguments: dict, said: str) -> None:
    with pytest.raises(prt.PrtError, match=said):
        prt.precompute_glossy(scene, prt.CubemapLighting(4), **arguments)


def test_what_it_is_not_for(grey_scene: Scene, glossy: LightTransport) -> None:
    with pytest.raises(prt.PrtError, match="no surface"):
        prt.precompute_glossy(grey_scene, prt.CubemapLighting(4), progress=False)
    with pytest.raises(prt.PrtError, match="haar"):
        prt.compress(glossy, method="haar")
    with pytest.raises(prt.PrtError, match="another scene"):
        render(
            grey_scene,
            glossy,
            np.ones((glossy.lighting.n_directions, 3), np.float32),
            mi.load_dict({"type": "perspective"}),
        )


def test_tangents_are_orthogonal_to_normals() -> None:
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(50, 3)).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    along = np.concatenate([rng.normal(size=(30, 3)), normals[30:]]).astype(
        np.float32
    )  # the last ones have none
    turn = frames(orthogonalise(along, normals), normals)
    np.testing.assert_allclose(
        turn @ np.moveaxis(turn, 1, 2), np.broadcast_to(np.eye(3), turn.shape), atol=1e-5
    )
    np.testing.assert_allclose(np.linalg.det(turn), 1, atol=1e-5)
