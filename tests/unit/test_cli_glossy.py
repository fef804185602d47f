"""The commands on a scene with a glossy surface."""

import json

import numpy as np
import pytest
from test_cli import SCENE, assert_one_line_error, call, environment, folder

import mi_sparse_prt as prt

__all__ = ["environment", "folder"]  # fixtures
GLOSSY = SCENE.replace(
    '<bsdf type="diffuse"/>', '<bsdf type="phong"><float name="exponent" value="12"/></bsdf>'
)


@pytest.fixture(scope="module")
def scene(folder):
    (folder / "scene.xml").write_text(GLOSSY)
    return folder / "scene.xml"


@pytest.fixture(scope="module")
def matrix(folder, scene):
    output, options = folder / "glossy.prt", ("--resolution", 4, "--edge-length", "inf", "--max-depth", 2)
    result = call("precompute", scene, "-o", output, "--terms", 2, *options, "--json", folder / "done.json")
    assert result.exit_code == 0, result.stderr
    for part in ("glossy vertices", "2 terms each", "direct"):
        assert part in result.stdout
    return output


def test_precompute_writes_what_python_does(folder, scene, matrix):
    with pytest.warns(prt.PrtWarning, match="not diffuse"):
        loaded = prt.load_scene(scene, float("inf"))
    expected = prt.precompute_glossy(loaded, prt.CubemapLighting(4), 2, max_depth=2, progress=False)
    light = np.random.default_rng(0).random((96, 3))
    found = prt.load_transport(matrix, loaded)
    np.testing.assert_array_equal(found.relight(light, [0, 1, 1]), expected.relight(light, [0, 1, 1]))
    report = json.loads((folder / "done.json").read_text())
    assert report["file"]["bytes"] == matrix.stat().st_size
    assert report == found.report | {"file": report["file"]}
    assert "glossy vertices" in call("info", matrix).stdout


def test_an_image_is_relit(folder, scene, matrix, environment):
    result = call("relight", matrix, "-e", environment, "-o", folder / "a.exr", "--spp", 4)
    assert result.exit_code == 0, result.stderr
    import mitsuba as mi

    image = np.array(mi.Bitmap(str(folder / "a.exr")))
    with pytest.warns(prt.PrtWarning, match="not diffuse"):
        loaded = prt.load_scene(scene, float("inf"))
    expected = prt.render(loaded, prt.load_transport(matrix), prt.load_environment(environment), spp=4)
    np.testing.assert_allclose(image[..., :3], expected, rtol=1e-5, atol=1e-6)


def test_vertices_have_no_radiance_of_their_own(folder, matrix, environment):
    result = call("relight", matrix, "-e", environment, "--vertices", folder / "a.npy", "-q")
    errors = [line for line in result.stderr.splitlines() if not line.startswith("warning")]
    assert result.exit_code == 1
    assert len(errors) == 1
    assert "depends on the view" in errors[0]
    assert not (folder / "a.npy").exists()


@pytest.mark.slow  # a minute of compilation; the same images from Python are in tests/system/test_glossy_images.py
def test_validate_splits_the_error(folder, scene, matrix):
    result = call("validate", scene, matrix, "--image-spp", 4, "-o", folder / "validation")
    assert result.exit_code == 0, result.stderr
    assert "factorization" in result.stdout
    report = json.loads((folder / "validation" / "report.json").read_text())
    assert len(report["images"]) == 3
    assert (folder / "validation" / "scene_0.png").is_file()


@pytest.mark.parametrize(
    ("option", "parameters"),
    [
        (("--spp", 4, "--method", "brute_force"), {"spp": 4, "method": "brute_force"}),
        (("--target-error", 0.5), {"target_error": 0.5}),
        (("--explain",), {}),
        (("--basis", "texel"), {"basis": "texel"}),
    ],
    ids=lambda value: value[0] if isinstance(value, tuple) else "",
)
def test_options_of_diffuse_matrices_work(scene, tmp_path, option, parameters):
    output, small = tmp_path / "b.prt", ("--resolution", 4, "--edge-length", "inf", "--max-depth", 3)
    result = call("precompute", scene, "-o", output, "--terms", 2, *small, *option, "-q")
    assert result.exit_code == 0, result.stderr
    found = prt.load_transport(output)
    assert found.terms == 2 and len(found.reflection.glossy)
    assert parameters.items() <= found.report["parameters"].items()
    assert found.basis == parameters.get("basis", "direction")


def test_terms_of_a_diffuse_scene(folder, tmp_path):
    (tmp_path / "diffuse.xml").write_text(SCENE)
    result = call("precompute", tmp_path / "diffuse.xml", "-o", tmp_path / "c.prt", "--terms", 2, "-q")
    assert_one_line_error(result, "no surface of the scene is glossy")
