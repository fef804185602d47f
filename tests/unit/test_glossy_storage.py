"""View-dependent transport in files and in other vertex orders, and with a BSDF that is chosen later."""

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from conftest import build, diffuse

import mi_sparse_prt as prt
from mi_sparse_prt.cache import cached_precompute
from mi_sparse_prt.relighting.image import render
from mi_sparse_prt.solvers.direct_rays import DirectSolver

LIGHTING = prt.CubemapLighting(2)
LIGHT = np.random.default_rng(0).random((LIGHTING.n_directions, 3)).astype(np.float32)
PHONG = {"type": "phong", "exponent": 12.0, "diffuse_reflectance": {"type": "rgb", "value": [0.1, 0.3, 0.2]}}
PLASTIC = {
    "type": "roughplastic",
    "alpha": 0.3,
    "diffuse_reflectance": {"type": "rgb", "value": [0.5, 0.1, 0.1]},
}


def shapes(bsdf: dict) -> dict[str, dict]:
    turned = mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale(2)
    ball = {"type": "sphere", "center": [0, 0.5, 0], "radius": 0.5, "bsdf": bsdf}
    ground = {"type": "rectangle", "to_world": turned, "bsdf": diffuse(0.5, 0.4, 0.3)}
    return {"ball": ball, "ground": ground}


def scene_of(bsdf: dict, backwards: bool = False) -> prt.Scene:
    parts = shapes(bsdf)
    with pytest.warns(prt.PrtWarning, match="not diffuse"):
        return build(0.5, **dict(reversed(parts.items())) if backwards else parts)


@pytest.fixture(scope="module")
def scene() -> prt.Scene:
    return scene_of(PHONG)


@pytest.fixture(scope="module")
def glossy(scene) -> prt.LightTransport:
    return prt.precompute_glossy(scene, LIGHTING, terms=2, progress=False)


@pytest.fixture(scope="module")
def forms(glossy) -> dict[str, prt.LightTransport]:
    return {"bits": glossy, "clusters": prt.compress(glossy, clusters=2, bases=4, progress=False)}


def radiance(transport: prt.LightTransport) -> np.ndarray:
    return transport.relight(LIGHT, [0.3, 1.0, 0.5])


@pytest.mark.parametrize("form", ["bits", "clusters"])
def test_round_trip(tmp_path, scene, forms, form):
    forms[form].save(tmp_path / "a.prt")
    loaded = prt.load_transport(tmp_path / "a.prt", scene)
    assert isinstance(loaded, prt.LightTransport) and loaded.terms == 2
    assert np.array_equal(radiance(loaded), radiance(forms[form]))
    assert loaded.report == forms[form].report
    assert [p.name for p in tmp_path.iterdir()] == ["a.prt"]
    again = tmp_path / "b.prt"
    loaded.save(again)
    assert np.array_equal(radiance(prt.load_transport(again)), radiance(loaded))


@pytest.mark.parametrize("form", ["bits", "clusters"])
def test_another_order_of_shapes(scene, forms, form):
    """Each vertex keeps its light; without the new order it would be another's."""
    other = scene_of(PHONG, backwards=True)
    assert not np.allclose(other.positions, scene.positions)
    moved = forms[form].for_scene(other)
    place = [int(np.flatnonzero(moved.measurement.keys == key)[0]) for key in forms[form].measurement.keys]
    np.testing.assert_allclose(other.positions[place], scene.positions, atol=1e-6)
    np.testing.assert_allclose(radiance(moved)[place], radiance(forms[form]), rtol=2e-6, atol=1e-6)
    assert moved.for_scene(scene).meshes == forms[form].meshes
    assert np.array_equal(radiance(moved.for_scene(scene)), radiance(forms[form]))


@pytest.mark.parametrize(
    "change",
    [
        lambda r, d: ({"material": r.material + 1}, {}),
        lambda r, d: ({"material": np.full_like(r.material, -2)}, {}),
        lambda r, d: ({"tangents": r.tangents[1:]}, {}),
        lambda r, d: ({}, {"material": d.material + 1}),
        lambda r, d: ({}, {"tables": d.tables[..., :1]}),
        lambda r, d: ({}, {"visibility": replace(d.visibility, bits=d.visibility.bits[1:])}),
        lambda r, d: ({"factors": (replace(r.factors[0], incident=r.factors[0].incident[:, 1:]),)}, {}),
        lambda r, d: ({"factors": (r.factors[0].first(1),)}, {}),
        lambda r, d: ({"factors": ()}, {}),
    ],
    ids=[
        "no such BRDF",
        "below -1",
        "tangents",
        "no such table",
        "fewer terms",
        "bits",
        "grid",
        "terms",
        "none",
    ],
)
def test_parts_that_do_not_fit_are_refused(tmp_path, glossy, change):
    """A file that was spliced would read beyond its arrays."""
    of_reflection, of_direct = change(glossy.reflection, glossy.direct)
    replace(
        glossy,
        reflection=replace(glossy.reflection, **of_reflection),
        operators={**glossy.operators, "direct": replace(glossy.direct, **of_direct)},
    ).save(tmp_path / "a.prt")
    with pytest.raises(prt.PrtError, match="damaged") as error:
        prt.load_transport(tmp_path / "a.prt")
    assert "\n" not in str(error.value)


def test_the_cache_finds_it_again(tmp_path, scene, monkeypatch):
    made = cached_precompute(scene, LIGHTING, tmp_path, False, terms=2, max_depth=2)
    monkeypatch.setattr("mi_sparse_prt.cache.precompute", None)
    found = cached_precompute(scene, LIGHTING, tmp_path, False, terms=2, max_depth=2)
    assert np.array_equal(radiance(found), radiance(made))
    with pytest.raises(TypeError):  # other settings, another matrix
        cached_precompute(scene, LIGHTING, tmp_path, False, terms=3, max_depth=2)


# ------------------------------------------------------------------------------------ a BSDF chosen later


@pytest.fixture(scope="module")
def general(scene) -> prt.LightTransport:
    return prt.precompute_glossy(scene, LIGHTING, harmonics=1, max_depth=2, progress=False)


def test_a_bsdf_chosen_later(scene, general, monkeypatch):
    """What a transport of the new BSDF would be, to the last bit, without a ray: terms do not depend on it.

    Expected: coefficients are untouched; radiance is that of a precomputation with the new BSDF. An image differs from
        the old BSDF's.
    """
    with monkeypatch.context() as context:
        context.setattr(DirectSolver, "__init__", None)
        swapped = general.with_bsdf("ball", mi.load_dict(PLASTIC))
    direct = prt.precompute_glossy(scene_of(PLASTIC), LIGHTING, harmonics=1, max_depth=2, progress=False)
    np.testing.assert_allclose(radiance(swapped), radiance(direct), rtol=1e-5, atol=1e-6)
    assert np.linalg.norm(radiance(swapped) - radiance(general)) > 0.1 * np.linalg.norm(radiance(general))
    camera = mi.load_dict(
        {
            "type": "perspective",
            "to_world": mi.ScalarTransform4f().look_at([1, 1.5, 3], [0, 0.4, 0], [0, 1, 0]),
            "film": {"type": "hdrfilm", "width": 32, "height": 24},
        }
    )
    images = [
        render(where, transport, LIGHT, camera, spp=4)
        for where, transport in ((scene, swapped), (scene_of(PLASTIC), direct), (scene, general))
    ]
    np.testing.assert_allclose(images[0], images[1], rtol=1e-4, atol=1e-5)
    assert np.linalg.norm(images[0] - images[2]) > 0.02 * np.linalg.norm(images[2])


def test_general_terms_are_those_of_many_own_ones(scene):
    """25 harmonics and 15 factors of the BRDF itself, under even light from many directions."""
    lighting = prt.CubemapLighting(16)
    even = np.ones((lighting.n_directions, 3), np.float32)
    ours, theirs = (
        prt.precompute_glossy(scene, lighting, max_depth=2, progress=False, **kind).relight(
            even, [0.3, 1.0, 0.5]
        )
        for kind in ({"harmonics": 4}, {"terms": 15})
    )
    assert np.linalg.norm(ours - theirs) < 0.01 * np.linalg.norm(theirs)


def test_what_cannot_be_chosen_later(glossy, general):
    bsdf = mi.load_dict(PLASTIC)
    with pytest.raises(prt.PrtError, match="harmonics=3"):
        glossy.with_bsdf("ball", bsdf)
    with pytest.raises(prt.PrtError, match="no glossy mesh .* it has: ball"):
        general.with_bsdf("ground", bsdf)
    with pytest.raises(prt.PrtError, match="mirrors"):
        general.with_bsdf("ball", mi.load_dict({"type": "conductor"}))
