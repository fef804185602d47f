"""``many-lights`` and ``benchmark --many-lights`` on a scene of a few shapes: what they write, say and refuse."""

import json

import mitsuba as mi
import numpy as np
import pytest
from test_cli import SCENE, assert_one_line_error, call, entries

import mi_sparse_prt as prt
from mi_sparse_prt.benchmark import many_lights as benchmark
from mi_sparse_prt.cli.files import image_bytes
from mi_sparse_prt.io.exr_layers import read_layers
from mi_sparse_prt.scene.loading import load_mitsuba

SMALL = ["--lights", 200, "--rows", 8, "--columns", 16, "--max-depth", 3]


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "scene.xml"
    path.write_text(SCENE.replace("</scene>", '<emitter type="point" id="bulb"/></scene>'))
    return path


def test_many_lights_writes_an_image_and_a_report(scene, tmp_path):
    exr, png, report = tmp_path / "a.exr", tmp_path / "a.png", tmp_path / "a.json"
    result = call("many-lights", scene, "-o", exr, *SMALL, "--seed", 3, "--json", report)
    assert (
        result.exit_code == 0
        and "estimated error" in result.stdout
        and "8 rows and 16 columns" in result.stderr
    )
    found = prt.render_many_lights(scene, 8, 16, lights=200, max_depth=3, seed=3)
    assert np.array_equal(np.array(mi.Bitmap(str(exr))), found.image)
    assert json.loads(report.read_text())["estimated_error"] == found.report["estimated_error"]
    assert (
        call("many-lights", scene, "-o", png, *SMALL, "--preview", "-q", "--method", "hasan2007").exit_code
        == 0
    )
    assert np.array(mi.Bitmap(str(png))).shape == (8, 12, 3)


def test_what_is_left_out_is_said_and_added(scene, tmp_path):
    exr, report = tmp_path / "a.exr", tmp_path / "a.json"
    found = [
        prt.render_many_lights(scene, 8, 16, lights=200, max_depth=3, compensate=c) for c in (False, True)
    ]
    for arguments, expected, words in (
        ((), found[0], "left out"),
        (("--compensate",), found[1], "added, left out"),
    ):
        result = call("many-lights", scene, "-o", exr, *SMALL, *arguments, "--json", report)
        assert result.exit_code == 0
        assert f"{words} by the clamp" in result.stdout and f"{words} by mirrors, glass" in result.stdout
        assert json.loads(report.read_text())["left_out"] == expected.report["left_out"]
        assert np.array_equal(np.array(mi.Bitmap(str(exr))), expected.image)


def test_groups_are_layers_of_one_file(scene, tmp_path):
    exr = tmp_path / "a.exr"
    assert call("many-lights", scene, "-o", exr, *SMALL, "--groups", "-q").exit_code == 0
    layers = read_layers(exr)
    image = np.array(mi.Bitmap(str(exr)))[..., :3]
    assert len(layers) == 2 and "bulb" in layers
    assert sum(layers.values()) == pytest.approx(image, abs=1e-5)


def test_a_time_budget_is_kept_about(scene, tmp_path):
    report = tmp_path / "a.json"
    arguments = ["--lights", 200, "--seconds", 1, "--json", report]
    assert call("many-lights", scene, "-o", tmp_path / "a.png", *arguments).exit_code == 0
    assert json.loads(report.read_text())["rows"] >= 16


def test_rows_and_columns_by_an_error(scene, tmp_path):
    report = tmp_path / "a.json"
    arguments = ["--lights", 200, "--max-depth", 3, "--error", 0.05, "--json", report]
    assert call("many-lights", scene, "-o", tmp_path / "a.png", *arguments).exit_code == 0
    found = json.loads(report.read_text())
    assert found["tries"] and found["estimated_error"] <= 0.05


def test_a_film_of_a_lamp_that_moves(scene, tmp_path):
    """Expected: its frames are those of Python; a film's name makes a film, another one a folder."""
    moving = scene.read_text().replace(
        '<emitter type="point" id="bulb"/>',
        '<default name="x" value="0"/><emitter type="point" id="bulb"><point name="position" value="$x, 0.2, 2"/>'
        "</emitter>",
    )
    scene.write_text(moving)
    film, folder, report = tmp_path / "a.mp4", tmp_path / "a", tmp_path / "a.json"
    arguments = [*SMALL, "--frames", 3, "--animate", "x=-1:1", "--json", report]
    result = call("many-lights", scene, "-o", folder, *arguments)
    assert result.exit_code == 0 and "-1 to 1" in result.stdout
    assert sorted(path.name for path in folder.iterdir()) == ["0000.png", "0001.png", "0002.png"]
    told = json.loads(report.read_text())
    found = prt.render_many_lights_frames(
        lambda k: load_mitsuba(scene, x=k - 1.0), [0] * 3, 8, 16, lights=200, max_depth=3
    )
    for k, frame in enumerate(found):
        assert told["frames"][k]["estimated_error"] == frame.report["estimated_error"]
        expected = np.frombuffer(image_bytes(frame.image, ".png", 0.0), np.uint8)
        assert np.array_equal(np.fromfile(folder / f"000{k}.png", np.uint8), expected)
    assert call("many-lights", scene, "-o", film, *arguments, "-q").exit_code == 0
    assert film.stat().st_size == json.loads(report.read_text())["film"]["bytes"] > 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--frames", 3], "nothing moves"),
        (["--animate", "x=0:1"], "how many frames"),
        (["--frames", 0, "--animate", "x=0:1"], "0 frames: give 1 or more"),
        (["--frames", 3, "--animate", "x=0"], "'x=0' is not NAME=FROM:TO"),
        (["--frames", 3, "--animate", "0:1"], "'0:1' is not NAME=FROM:TO"),
        (["--frames", 3, "--animate", "x=0:1", "--seconds", 3], "has --rows and --columns"),
        (["--frames", 3, "--animate", "x=0:1", "--fps", 1e-9], "give 0.1 to 1000"),
        (["--frames", 3, "--animate", "x=0:1", "-o", "a.png"], "ends in .mp4"),
    ],
)
def test_what_films_cannot_have(scene, tmp_path, arguments, message):
    result = call("many-lights", scene, "-o", tmp_path / "a.mp4", *arguments)
    assert result.exit_code == 2 and message in " ".join(result.stderr.replace("│", " ").split())


def test_parameters_that_a_scene_does_not_have(scene, tmp_path):
    arguments = ["--frames", 3, "--animate", "y=0:1"]
    assert_one_line_error(call("many-lights", scene, "-o", tmp_path / "a.mp4", *arguments), "y")


def test_many_lights_refuses_in_one_line(scene, tmp_path):
    before = entries(tmp_path)
    image = tmp_path / "x.exr"
    assert_one_line_error(call("many-lights", tmp_path / "none.xml", "-o", image), "none.xml")
    assert_one_line_error(call("many-lights", scene, "-o", image, "--rows", 0, "-q"), "rows is 0")
    assert_one_line_error(call("many-lights", scene, "-o", image, "--camera", 2, "-q"), "no sensor 2")
    assert_one_line_error(call("many-lights", scene, "-o", tmp_path / "no" / "x.exr"), "no")
    assert call("many-lights", scene, "-o", tmp_path / "x.jpg").exit_code == 2
    assert call("many-lights", scene, "-o", tmp_path / "x.png", "--groups").exit_code == 2
    assert entries(tmp_path) == before


def test_ctrl_c_writes_nothing(monkeypatch, scene, tmp_path):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(prt, "render_many_lights", interrupted)
    before = entries(tmp_path)
    result = call("many-lights", scene, "-o", tmp_path / "x.exr", *SMALL, "-q")
    assert result.exit_code == 130 and "nothing was written" in result.stderr
    assert entries(tmp_path) == before


@pytest.mark.slow
def test_the_benchmark_measures_all_methods_and_draws(monkeypatch, scene, tmp_path):
    """Expected: every curve has points whose errors fall or are small, and JSON and figures are written.

    Rationale: sizes are small ones; all that is different from a full run.
    """
    for name, value in {
        "SIZES": (20, 60),
        "SETTINGS": ((8, 16),),
        "HALF": (4, 8),
        "LIGHTS": (10, 40),
        "CUTS": (0.3, 0.1),
        "PATH_SPP": (1, 64),
        "SINGULAR": (20, 20),
        "COUNT": 300,
        "SEEDS": 2,
        "EQUAL_TIME": (8, 16),
    }.items():
        monkeypatch.setattr(benchmark, name, value)
    report, figures = tmp_path / "b.json", tmp_path / "plots"
    result = call("benchmark", scene, "--many-lights", "--figures", figures, "--json", report)
    assert result.exit_code == 0 and "instant radiosity" in result.stdout
    found = json.loads(report.read_text())
    assert len(found["curves"]) == 11 and len(found["table"]) == 3
    for points in found["curves"].values():
        assert points[-1]["error"] < 0.5 and points[-1]["seconds"] > 0
    assert found["singular_values"][0] == 1 and found["path"][0]["error"] > found["path"][-1]["error"]
    assert found["reference"]["picture"] == "all lights" and found["reference"]["picture_error"] == 0
    assert [point["flip"] is None for point in found["equal_time"]] == [False] * 4 + [True]
    names = {path.name for path in figures.iterdir()}
    assert {"many_lights.png", "singular_values.png", "pictures.png", "equal_time.png"} <= names
