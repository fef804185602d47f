"""Whole matrices against Mitsuba's own render of them."""

from pathlib import Path

import numpy as np
import pytest
from conftest import still_life

import mi_sparse_prt as prt
from mi_sparse_prt.validation.validate import matrix_errors

SCENES = Path(__file__).parents[2] / "scenes_xml"


@pytest.fixture(scope="module", params=["direction", "texel"])
def checked(request, coloured_scene, small_lighting):
    """All columns of a small coloured scene: its matrix and the validation."""
    transport = prt.precompute(
        coloured_scene, small_lighting, basis=request.param, spp=64, strata=4, progress=False
    )
    return transport, prt.validate(
        coloured_scene, transport, n_rows=48, n_columns=96, spp=1024, progress=False
    )


def test_error_against_mitsuba_is_what_the_matrix_says(checked):
    """Rationale: two independent figures, held-out elements and a full render, of one error.

    Expected: within 25% of each other plus three standard errors of the estimate: 48 vertices were rendered.
    """
    transport, validation = checked
    estimated = transport.report["estimated_error"]
    measured = validation.report["relative_l2"]["total"]
    assert 0 < measured < 0.2
    assert abs(measured - estimated["total"]) < 0.25 * measured + 3 * estimated["standard_error"]["total"]


def test_direct_part_is_mitsubas(checked):
    """Expected: at most 0.1% of the elements differ by more than 1e-4, and every vertex is reached."""
    _, validation = checked
    assert validation.report["direct_at_hits"] <= 1e-3
    assert validation.report["missed_vertices"] == 0


def test_a_wrong_matrix_is_found(checked, coloured_scene):
    """A matrix that is 10% too bright must be reported so: the error of the good one and 10% add as squares."""
    transport, validation = checked
    bright = type(transport)(**{**vars(transport), "albedo": transport.albedo * np.float32(1.1)})
    wrong = prt.validate(coloured_scene, bright, n_rows=48, n_columns=96, spp=256, progress=False)
    good = validation.report["relative_l2"]["total"]
    assert wrong.report["relative_l2"]["total"] == pytest.approx(np.hypot(1.1 * good, 0.1), rel=0.1)


def test_validation_is_saved(checked, tmp_path):
    _, validation = checked
    validation.save(tmp_path / "out")
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"report.json", "errors.png", "rows.png"}


def test_noise_of_the_reference_is_taken_out():
    """A perfect matrix against two noisy references: the plain difference is the noise, the corrected one is near 0."""
    rng = np.random.default_rng(0)
    exact = rng.random((40, 60, 3)).astype(np.float32)
    first, second = (exact + rng.normal(0, 0.1, exact.shape).astype(np.float32) for _ in range(2))
    meshes = (prt.matrix.MeshRange("a", slice(0, 40)),)
    report = matrix_errors(exact, first, second, np.arange(40), np.arange(60), meshes)
    noise = 0.1 / np.sqrt(2) / np.sqrt(1 / 3)
    assert report["with_noise"] == pytest.approx(noise, rel=0.05)
    assert report["reference_noise"] == pytest.approx(noise, rel=0.05)
    assert report["relative_l2"]["total"] < 0.2 * noise
    scaled = matrix_errors(1.02 * exact, first, second, np.arange(40), np.arange(60), meshes)
    assert scaled["relative_l2"]["total"] == pytest.approx(0.02, rel=0.5)


def test_image_of_a_relit_scene(tmp_path):
    """The whole way from XML: relit image against ``path`` under the same cubemap.

    Expected: vertices 0.5 apart smear the shadow, so 10% is what this resolution allows; noise is taken out.
    """
    import mitsuba as mi

    from mi_sparse_prt.scene import Scene

    shapes = still_life()
    sensor = {
        "type": "perspective",
        "to_world": mi.ScalarTransform4f().look_at([2, 2, 3], [0, 0.3, 0], [0, 1, 0]),
        "film": {"type": "hdrfilm", "width": 64, "height": 48},
    }
    loaded = mi.load_dict(
        {"type": "scene", "sensor": sensor, "sky": {"type": "constant"}, **shapes}, optimize=False
    )
    scene = Scene.from_mitsuba(loaded, 0.2)
    transport = prt.precompute(scene, prt.CubemapLighting(4), basis="texel", progress=False)
    validation = prt.validate(
        scene, transport, n_rows=8, n_columns=8, spp=16, progress=False, image_width=64, image_spp=128
    )
    assert validation.report["image"]["relative_l2"] < 0.1
    assert 0 < validation.report["image"]["interpolation"] < 0.1
    assert "image" in validation.figures


@pytest.mark.slow
@pytest.mark.parametrize("name", ["bunny", "dancer", "spot", "cornell", "terrace"])
def test_scenes(name):
    """Every scene of the collection at 6 x 8 x 8: estimate and reference agree, the direct part is Mitsuba's."""
    scene = prt.load_scene(SCENES / f"{name}.xml")
    transport = prt.precompute(scene, prt.CubemapLighting(8), spp=16, progress=False)
    report = prt.validate(scene, transport, n_rows=256, n_columns=384, progress=False, image=False).report
    assert report["direct_at_hits"] <= 1e-3
    assert report["relative_l2"]["total"] == pytest.approx(
        transport.report["estimated_error"]["total"], rel=0.2
    )
