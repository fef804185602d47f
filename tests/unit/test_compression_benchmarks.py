"""``benchmark --cpca``, ``--glossy`` and ``--relight`` from end to end on tiny scenes: reports, pictures, tables."""

import io
import json
from itertools import pairwise

import matplotlib.image
import mitsuba as mi
import numpy as np
import pytest
from conftest import build, diffuse
from rich.console import Console

import mi_sparse_prt as prt
from mi_sparse_prt.benchmark import page_errors
from mi_sparse_prt.benchmark.clustered_pca import measure_cpca
from mi_sparse_prt.benchmark.glossy_transport import GlossyEffort, diffuse_copy, measure_glossy
from mi_sparse_prt.benchmark.moving_light import METHODS, MovingEffort, measure_moving_light
from mi_sparse_prt.benchmark.page_errors import measure_pages
from mi_sparse_prt.cli.tables.benchmark import cpca_tables, glossy_tables, pages_tables
from mi_sparse_prt.cli.tables.moving_light import moving_light_tables
from mi_sparse_prt.scene.scene import Scene


def tiny(bsdf: dict) -> Scene:
    """A ball on a plane, with a camera and a sky."""
    flat = mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale(2)
    view = mi.ScalarTransform4f().look_at([1, 1.5, 3], [0, 0.4, 0], [0, 1, 0])
    return build(
        0.4,
        ball={"type": "sphere", "center": [0, 0.5, 0], "radius": 0.5, "bsdf": bsdf},
        ground={"type": "rectangle", "to_world": flat, "bsdf": diffuse(0.5, 0.5, 0.5)},
        sky={"type": "constant", "radiance": 1.0},
        camera={
            "type": "perspective",
            "to_world": view,
            "film": {"type": "hdrfilm", "width": 48, "height": 36},
        },
    )


def printed(tables: list) -> str:
    console = Console(file=io.StringIO(), width=160)
    for table in tables:
        console.print(table)
    return console.file.getvalue()


def test_cpca(tmp_path) -> None:
    """Both ways see the same rows; errors of two passes are those of the compressed matrix."""
    scene = tiny(diffuse(0.7, 0.7, 0.7))
    report = measure_cpca(scene, prt.CubemapLighting(4), False, tmp_path, bases=6, spp=4)
    json.dumps(report)
    assert report["meshes"].keys() == {"ball", "ground"}
    for found in report["meshes"].values():
        assert 0 < found["standard"]["error"] < 0.5
        assert found["error_increase"] == pytest.approx(
            found["two_pass"]["error"] / found["standard"]["error"] - 1
        )
        assert abs(found["error_increase"]) < 0.5
        assert found["faster"] == pytest.approx(found["standard"]["seconds"] / found["two_pass"]["seconds"])
    for name, error in report["compressed"]["error"]["on_sphere"].items():
        if name != "total":
            assert error == pytest.approx(report["meshes"][name]["two_pass"]["error"], rel=1e-3)
    assert 0 < report["image"] < 0.05
    for name in ("clusters", "compressed"):
        assert np.ptp(matplotlib.image.imread(tmp_path / f"{name}.png")) > 0.1
    assert "ball" in printed(cpca_tables(report))


@pytest.mark.slow
def test_moving_light(tmp_path) -> None:
    """What holds for any turn: more wavelets are better, those that go on better than those that start anew."""
    scene, effort = tiny(diffuse(0.7, 0.7, 0.7)), MovingEffort(20, 8, (60,), target_error=0.2)
    report = measure_moving_light(scene, prt.CubemapLighting(8), False, tmp_path, effort)
    json.dumps(report)
    assert report["turning"].keys() == {"sky", "sun"}
    for turns in report["turning"].values():
        methods = turns["60"]["methods"]
        assert methods.keys() == METHODS.keys()
        for key in ("light", "sphere", "image"):
            assert methods["NWA(30)"][key] > methods["NWA(60)"][key] > methods["NWA(150)"][key] >= 0
            assert methods["PBI(30)"][key] < methods["NWA(30)"][key]
        assert methods["PBI(30)"]["frames"][0] == 0 and methods["PBI(30)"]["frames"][-1] < 0.05
        assert (
            turns["60"]["stop"]["PBI(30)"]["NWA(300)"] is None
            or turns["60"]["stop"]["PBI(30)"]["NWA(300)"] < 9
        )
    frames = report["frames"]
    assert frames["product"]["bytes"] == 4 * len(scene.positions) * 384
    assert all(way["per_second"] > 0 for way in frames.values() if "per_second" in way)
    assert report["changing"].keys() == {"one light becomes another", "a round light", "a cut"}
    for case in report["changing"].values():
        assert case["methods"]["PBI(30)"]["frames"][-1] < case["methods"]["NWA(30)"]["frames"][-1] + 1e-6
    assert_pictures(report["pictures"])
    names = {"moving_lights", "pictures_over_time", "pictures_by_budget", "pictures_of_changes", "clusters"}
    assert names <= {path.stem for path in tmp_path.iterdir()}
    tables = printed(moving_light_tables(report))
    assert "a quarter of the weights" in tables and "with background" in tables and "FLIP" in tables


def test_pages(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a page keeps more of, it is larger and more exact by; how exact the matrix itself is plays no part."""
    monkeypatch.setattr(page_errors, "TARGET", 0.1)
    scene = tiny(diffuse(0.7, 0.7, 0.7))
    report = measure_pages(scene, prt.CubemapLighting(8), False, tmp_path, rotations=4)
    json.dumps(report)
    pages = report["pages"]
    assert np.all(np.diff([page["bytes"] for page in pages]) > 0)
    means = [page["mean"] for page in pages]
    assert means[0] > means[2] > means[-1] > 0 and means[-1] < 0.01
    assert all(page["worst"] == max(page["errors"].values()) >= page["mean"] for page in pages)
    assert (tmp_path / "pages.png").stat().st_size > 1000
    assert "worst environment" in printed(pages_tables(report))


def assert_pictures(found: dict) -> None:
    """What [OBRG06] says of its Figures 8 and 10 to 12: exact pictures of light that stands, better ones of motion."""

    def error(figure: str, row: str, column: str) -> float:
        return found[figure][row][column]["relative_l2"]

    over_time, changes = "pictures_over_time", "pictures_of_changes"
    assert error(over_time, "PBI(30)", "frame 400") < 1e-4 < 1e-3 < error(over_time, "NWA(30)", "frame 400")
    for column in ("turning", "becoming another"):
        assert error(changes, "PBI(30)", column) < error(changes, "NWA(30)", column)
    assert error(changes, "PBI(30)", "the view alone") < 1e-4 < error(changes, "NWA(100)", "the view alone")
    for row in ("NWA, moving", "PBI, moving"):
        errors = [error("pictures_by_budget", row, f"{k} wavelets") for k in (30, 100, 300)]
        assert all(a > b or a < 1e-6 for a, b in pairwise(errors))  # below that, of rounding
    clusters = [pictures["picture"]["relative_l2"] for pictures in found["pictures_of_clusters"].values()]
    assert clusters == sorted(clusters, reverse=True) and clusters[-1] == 0
    assert found["camera"]["size"] == (36, 48) and found["camera"]["nbytes"] > 0


@pytest.mark.slow
def test_glossy(tmp_path) -> None:
    """Brute force is slower than finite elements, and takes its direct light from the same rays."""
    effort = GlossyEffort(rows=8, spp=4, image_spp=8, image_width=48)
    phong = {"type": "phong", "exponent": 20.0, "diffuse_reflectance": {"type": "rgb", "value": 0.2}}
    with pytest.warns(prt.PrtWarning, match="not diffuse"):
        scene = tiny(phong)
    report = measure_glossy(scene, prt.CubemapLighting(4), False, tmp_path, effort)
    json.dumps(report)
    seconds, ratios = report["seconds"], report["ratios"]
    assert ratios["glossy_over_diffuse"] == pytest.approx(seconds["glossy"] / seconds["diffuse"])
    assert ratios["brute_force_over_glossy"] == pytest.approx(seconds["brute_force"] / seconds["glossy"])
    (factors,) = report["factors"]
    assert factors["mesh"] == "ball"
    assert factors["whole"] == sorted(factors["whole"], reverse=True)
    assert {image["environment"] for image in report["images"]["images"]} == {"own", "studio"}
    assert np.ptp(matplotlib.image.imread(tmp_path / "factors_0.png")) > 0.1
    assert "ball" in printed(glossy_tables(report))


def test_a_diffuse_copy_has_the_same_vertices() -> None:
    with pytest.warns(prt.PrtWarning, match="not diffuse"):
        scene = tiny({"type": "roughplastic", "alpha": 0.3})
    copy = diffuse_copy(scene)
    np.testing.assert_allclose(copy.positions, scene.positions, atol=1e-6)
    np.testing.assert_allclose(copy.normals, scene.normals, atol=1e-5)
    assert copy.diffuse
    ball = scene.meshes[0].vertices
    np.testing.assert_allclose(copy.albedo[ball].mean(axis=0), scene.albedo[ball].mean(axis=0), rtol=1e-3)
