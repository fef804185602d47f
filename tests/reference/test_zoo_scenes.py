"""Scenes of the zoo that come out right, against stored references; `mi-sparse-prt benchmark --zoo` has all."""

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from conftest import PIPELINE
from typer.testing import CliRunner
from zoo_references import EFFORT, SCENES, SIZE, stored

from mi_sparse_prt.benchmark.zoo import AGREES, LIMIT, OFF, ZOO, image_error, judge
from mi_sparse_prt.benchmark.zoo_figures import SceneImages, draw_contact_sheet
from mi_sparse_prt.benchmark.zoo_rendering import Pair, render_matrix
from mi_sparse_prt.cli import app
from mi_sparse_prt.methods.settings import Settings
from mi_sparse_prt.planner.choice import Costs
from mi_sparse_prt.planner.pilot import measure
from mi_sparse_prt.solvers.direct_rays import DirectSolver
from mi_sparse_prt.validation.mitsuba_reference import path_image

BRIGHTER = 1.05  # of wrong images


@pytest.fixture(scope="module", autouse=True)
def costs_measured_once() -> Iterator[None]:
    """What plans cost, two thirds of the time of a matrix, is found in the first scene: the stage is that of all."""
    known: dict[tuple, Costs] = {}

    def found_once(direct: DirectSolver, settings: Settings, indirect: bool) -> Costs:
        asked = settings, indirect, direct.problem.specular_apart
        if asked not in known:
            known[asked] = measure(direct, settings, indirect)
        return known[asked]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(PIPELINE, "measure", found_once)
        yield


def mean(pair: Pair) -> np.ndarray:
    return np.mean(pair, axis=0)


# others compare such shapes, textures and lights with `path` as well
USUAL = (
    "shape_obj",
    "shape_rectangle",
    "shape_cube",
    "texture_bitmap_nearest",
    "texture_checkerboard",
    "emitter_constant",
)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name in USUAL else name for name in SCENES]
)
def test_scenes_agree(name, artefact):
    """Rationale: what a user of Mitsuba gets is one number per pixel; here it is compared for whole scenes.

    A scene of the zoo, 48 x 36 pixels, by `sparse_prt` (n = 16, 5%) against two stored halves of `path`.

    Expected: within 2% beyond the noise of both, with noise that could hide no more than 1%; the same image 5% brighter
        does not agree, and would be told to be off by nobody.
    Result: 0.1% to 1.2%; noise could hide 0.4% to 0.6%.
    """
    truth = stored(name)
    ours = render_matrix(ZOO / f"{name}.xml", EFFORT, **SIZE)
    report = judge(name, ours, truth)
    artefact(
        draw_contact_sheet({name: SceneImages(mean(truth), mean(ours.images))}, {name: report["verdict"]})
    )
    assert report["verdict"] == AGREES, report
    assert report["uncertainty"] < LIMIT / 2
    first, second = ours.images
    wrong = replace(ours, images=(BRIGHTER * first, BRIGHTER * second), estimated_error=0.0, warnings=[])
    assert judge(name, wrong, truth)["verdict"] == OFF


def test_an_image_without_interreflections_is_off():
    """Expected: direct light alone, by `path` itself, is far from the reference: the stage is one where it matters."""
    scene = mi.load_file(str(ZOO / "bsdf_diffuse.xml"), **SIZE)
    direct = tuple(path_image(scene, scene.sensors()[0], max_depth=2, spp=256, seed=k) for k in range(2))
    error, uncertainty = image_error(direct, stored("bsdf_diffuse"))
    assert error - uncertainty > 2 * LIMIT


def test_the_command_reports_every_scene(tmp_path):
    """
    Rationale: other runs are compared with this JSON; a scene that fails must not hide the others.
    Expected: a scene that cannot be loaded is an error and keeps its place; the others have numbers; the table, the
        sentences and the contact sheet have all.
    """
    folder, report_file = tmp_path / "zoo", tmp_path / "zoo.json"
    folder.mkdir()
    for name in ("sky.exr", "ball.ply"):
        shutil.copy(ZOO / name, folder)
    text = (ZOO / "bsdf_diffuse.xml").read_text().replace('value="96"', 'value="12"').replace('"72"', '"9"')
    text = text.replace('name="max_depth" value="5"', 'name="max_depth" value="2"')  # no plans are measured
    (folder / "bsdf_fine.xml").write_text(text)
    (folder / "bsdf_broken.xml").write_text(text.replace('"ply"', '"no_such_shape"'))
    arguments = ["benchmark", folder, "--zoo", "--json", report_file, "--figures", tmp_path / "drawn"]
    result = CliRunner().invoke(app, [str(a) for a in arguments])
    assert result.exit_code == 0, result.output
    report = json.loads(report_file.read_text())
    broken, fine = report["scenes"]
    assert (broken["name"], broken["verdict"], broken["error"]) == ("bsdf_broken", "error", None)
    assert "no_such_shape" in broken["sentences"][0]
    assert fine["name"] == "bsdf_fine"
    assert fine["seconds"] > 0 and 0 < fine["estimated_error"] < 0.1
    assert sum(report["counts"].values()) == 2
    assert "bsdf_broken" in result.stdout and "no_such_shape" in result.stdout
    assert (tmp_path / "drawn" / "zoo.png").is_file()
