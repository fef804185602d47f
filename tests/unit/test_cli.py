"""The commands on a scene of a few vertices: what they write, say and refuse."""

import json
import os
import resource
import sys
from functools import partial
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from typer.testing import CliRunner

import mi_sparse_prt as prt
from mi_sparse_prt.cli import app
from mi_sparse_prt.cli.running import running
from mi_sparse_prt.solvers.paths import PathSolver

SCENE = """<scene version="3.0.0">
    <default name="floor" value="0.5"/>
    <sensor type="perspective">
        <transform name="to_world"><lookat origin="0, 3, 4" target="0, 0, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm"><integer name="width" value="12"/><integer name="height" value="8"/></film>
    </sensor>
    <emitter type="constant"/>
    <shape type="rectangle" id="floor[1]">
        <transform name="to_world"><rotate x="1" angle="-90"/><scale value="2"/></transform>
        <bsdf type="twosided"><bsdf type="diffuse"><rgb name="reflectance" value="$floor"/></bsdf></bsdf>
    </shape>
    <shape type="cube" id="box">
        <transform name="to_world"><scale value="0.5"/><translate y="0.6"/></transform>
        <bsdf type="diffuse"/>
    </shape>
</scene>
"""
VERTICES = 4 + 24 + 4  # the floor has two sides
PRECOMPUTE = ["--method", "brute_force", "--resolution", "4", "--spp", "2", "--edge-length", "inf"]


def call(*arguments: object):
    """Run a command; a failure inside the package is a failure of the test."""
    result = CliRunner().invoke(app, [str(a) for a in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


def assert_one_line_error(result, *parts: str):
    """Exit code 1, nothing on standard output, and one line on standard error that has all `parts`."""
    assert result.exit_code == 1
    assert result.stdout == ""
    lines = result.stderr.strip().splitlines()
    assert len(lines) == 1, result.stderr
    assert lines[0].startswith("mi-sparse-prt: ")
    for part in parts:
        assert part in lines[0]


def entries(folder: Path) -> set[str]:
    return {p.name for p in folder.iterdir()}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("cli")


@pytest.fixture(scope="module")
def scene(folder):
    (folder / "scene.xml").write_text(SCENE)
    return folder / "scene.xml"


@pytest.fixture(scope="module")
def matrix(folder, scene):
    result = call(
        "precompute", scene, "-o", folder / "scene.prt", "--json", folder / "done.json", *PRECOMPUTE
    )
    assert result.exit_code == 0, result.stderr
    (folder / "done.txt").write_text(result.stdout)
    return folder / "scene.prt"


@pytest.fixture(scope="module")
def environment(folder):
    """Brighter from +x than from -x, so that a rotation shows."""
    pixels = np.ones((8, 16, 3), dtype=np.float32)
    pixels[:, :8] = 3.0
    mi.Bitmap(pixels).write(str(folder / "light.exr"))
    return folder / "light.exr"


# ------------------------------------------------------------------------------------------------ precompute


def test_precompute_writes_matrix_and_report(folder, matrix):
    """The file is that of the Python function with the same arguments, the JSON is its report."""
    transport = prt.load_transport(matrix)
    report = json.loads((folder / "done.json").read_text())
    expected = prt.precompute(
        prt.load_scene(folder / "scene.xml", float("inf")),
        prt.CubemapLighting(4),
        "brute_force",
        spp=2,
        indirect_resolution=4,
        progress=False,
    )
    assert np.array_equal(transport.rows(range(VERTICES)), expected.rows(range(VERTICES)))
    assert report["elements_total"] == VERTICES * 96
    assert report["estimated_error"]["meshes"].keys() == {"floor[1]", "box", "floor[1]_back"}
    assert report["file"] == {"path": str(matrix), "bytes": matrix.stat().st_size}
    assert report["scene"]["path"] == str(folder / "scene.xml")
    assert report == transport.report | {"file": report["file"]}


def test_precompute_prints_what_was_done_and_skipped(folder, matrix):
    text = (folder / "done.txt").read_text()
    for part in (
        "pilot",
        "indirect",
        "total",
        "forecast",
        "peak memory",
        "3,072",
        "floor[1]",
        "Skipped",
        "below the horizon",
    ):
        assert part in text


@pytest.mark.parametrize("method", ["sparse", "huang2010"])
def test_methods_are_precomputed_with_a_forecast(folder, scene, method):
    result = call(
        "precompute", scene, "-o", folder / f"{method}.prt", "--method", method, "--resolution", 4, "--spp", 2
    )
    assert result.exit_code == 0, result.stderr
    report = prt.load_transport(folder / f"{method}.prt").report
    assert report["parameters"]["method"] == method
    assert report["forecast"]["seconds"] > 0


def test_quiet_says_nothing(folder, scene):
    result = call("precompute", scene, "-o", folder / "quiet.prt", "--quiet", "--max-depth", 2, *PRECOMPUTE)
    assert (result.exit_code, result.stdout, result.stderr) == (0, "", "")


def test_json_on_stdout_is_alone_there(folder, scene):
    result = call(
        "precompute", scene, "-o", folder / "piped.prt", "--json", "-", "--max-depth", 2, *PRECOMPUTE
    )
    assert json.loads(result.stdout)["parameters"]["max_depth"] == 2
    assert "Estimated error" in result.stderr


def test_target_error_is_passed_on(folder, scene):
    """Expected: the pilot's plans are in the report, and the parameters are those of the one that was carried out.

    The first is aimed just below the target: where it turns out above, another one follows.
    """
    result = call(
        "precompute",
        scene,
        "-o",
        folder / "t.prt",
        "--target-error",
        0.2,
        "--json",
        folder / "t.json",
        *PRECOMPUTE,
    )
    assert result.exit_code == 0
    report = json.loads((folder / "t.json").read_text())
    assert report["parameters"]["target_error"] == 0.2
    chosen = [plan["parameters"] for plan in report["plans"] if plan["chosen"]]
    assert report["plan"]["parameters"] in chosen
    assert report["parameters"]["spp"] == report["plan"]["parameters"]["spp"]
    assert report["parameters"]["indirect_resolution"] == report["plan"]["parameters"]["resolution"]
    assert "target" in result.stdout


def test_a_plan_is_chosen_and_explained(folder, scene, monkeypatch):
    """Without a method: all plans that were compared are in the table and in the report."""
    monkeypatch.setattr("mi_sparse_prt.planner.pilot.consensus_may_pay", lambda *_: True)
    report = folder / "auto.json"
    arguments = ("--resolution", 4, "--edge-length", "inf", "--explain", "--json", report)
    result = call("precompute", scene, "-o", folder / "auto.prt", *arguments)
    assert result.exit_code == 0, result.stderr
    plans = json.loads(report.read_text())["plans"]
    assert sum(plan["chosen"] for plan in plans) == 1
    table = result.stdout[result.stdout.index("Plans") : result.stdout.index("result")]
    assert table.count("chosen") == 1
    for kind in ("exact", "consensus", "gather rays 64 tolerance 0.06", "paths resolution 4"):
        assert kind in table
    silent = call("precompute", scene, "-o", folder / "auto.prt", *PRECOMPUTE, "--max-depth", 2)
    assert "Plans" not in silent.stdout


def test_definitions_reach_the_scene(folder, scene):
    result = call(
        "precompute", scene, "-o", folder / "white.prt", "-D", "floor=0.9", "--max-depth", 2, *PRECOMPUTE
    )
    assert result.exit_code == 0
    assert np.allclose(prt.load_transport(folder / "white.prt").albedo[:4], 0.9)


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--resolution", "3"], "power of two"),
        (["--resolution", "4", "--indirect-resolution", "8"], "finer"),
        (["--max-depth", "1"], "max_depth is 1"),
        (["--spp", "0"], "spp is 0"),
        (["--edge-length", "-1"], "edge_length must be positive"),
        (["-D", "unknown=1"], "unknown"),
    ],
)
def test_precompute_refuses_bad_values(folder, scene, arguments, message):
    before = entries(folder)
    assert_one_line_error(call("precompute", scene, "-o", folder / "bad.prt", "-q", *arguments), message)
    assert entries(folder) == before


@pytest.mark.parametrize(
    "text, message",
    [
        (None, "does not exist"),
        ("<scene version='3.0.0'><shape type='cube'>", "bad.xml"),
        ("<scene version='3.0.0'></scene>", "no mesh"),
        ("<scene version='3.0.0'><shape type='cube'><float name='sise' value='1'/></shape></scene>", "sise"),
    ],
    ids=["missing", "unclosed", "empty", "unknown parameter"],
)
def test_bad_scenes_are_refused(tmp_path, text, message):
    if text is not None:
        (tmp_path / "bad.xml").write_text(text)
    before = entries(tmp_path)
    for command in (["precompute", "-o", tmp_path / "bad.prt", "-q"], ["info"]):
        assert_one_line_error(call(command[0], tmp_path / "bad.xml", *command[1:]), message)
    assert entries(tmp_path) == before


def test_output_is_checked_before_the_work(monkeypatch, scene, tmp_path):
    """Expected: where the result cannot be written, nothing is computed."""
    monkeypatch.setattr(prt, "load_scene", lambda *_: pytest.fail("it went to work"))
    for path, reason in (
        (tmp_path / "no_such_folder" / "x.prt", "No such file or directory"),
        (tmp_path, "folder"),
        (Path("/proc/x.prt"), "/proc"),
        (Path("/dev/null"), "device"),
    ):
        assert_one_line_error(call("precompute", scene, "-o", path, *PRECOMPUTE), str(path), reason)
        assert_one_line_error(
            call("precompute", scene, "-o", tmp_path / "x", "--json", path), str(path), reason
        )
    assert entries(tmp_path) == set()


def test_a_full_disk_leaves_nothing(monkeypatch, folder, scene):
    """A limit on file sizes stands for the disk: writing fails half-way with an OSError of the system's own."""
    save = prt.LightTransport.save

    def save_with_little_room(transport, path):
        soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (1500, hard))
        try:
            save(transport, path)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))

    monkeypatch.setattr(prt.LightTransport, "save", save_with_little_room)
    before = entries(folder)
    result = call("precompute", scene, "-o", folder / "full.prt", "-q", *PRECOMPUTE)
    assert_one_line_error(result, "full.prt", "File too large")
    assert entries(folder) == before


# --------------------------------------------------------------------------------------------------- relight


def test_relight_writes_linear_and_tonemapped_images(folder, scene, matrix, environment):
    exr, png, report = folder / "a.exr", folder / "a.png", folder / "a.json"
    assert call("relight", matrix, "-e", environment, "-o", exr, "--json", report).exit_code == 0
    assert call("relight", matrix, "-e", environment, "-o", png, "--exposure", -1).exit_code == 0
    image = np.array(mi.Bitmap(str(exr)))
    expected = prt.render(
        prt.load_scene(scene, float("inf")), prt.load_transport(matrix), prt.load_environment(environment)
    )
    assert image.shape == (8, 12, 3)
    assert np.allclose(image, expected, rtol=1e-3, atol=1e-4)
    halved = np.clip(image / 2, 0, 1)
    srgb = np.where(halved <= 0.0031308, 12.92 * halved, 1.055 * halved ** (1 / 2.4) - 0.055)
    assert np.abs(np.array(mi.Bitmap(str(png))) / 255.0 - srgb).max() < 1.05 / 255  # Mitsuba dithers
    written = json.loads(report.read_text())
    assert written["image"]["mean"] == pytest.approx(image.mean(axis=(0, 1)), rel=1e-3)
    assert written["rotation_degrees"] == 0
    assert {"load", "relight", "render", "total"} <= written["seconds"].keys()


def test_relight_rotates_and_writes_vertices(folder, scene, matrix, environment):
    npy, ply = folder / "v.npy", folder / "v.ply"
    assert call("relight", matrix, "-e", environment, "--rotate", 90, "--vertices", npy).exit_code == 0
    assert call("relight", matrix, "-e", environment, "--vertices", ply, "--scene", scene).exit_code == 0
    transport, light = prt.load_transport(matrix), prt.load_environment(environment)
    assert np.allclose(np.load(npy), transport.relight(light.rotated(90)))
    assert not np.allclose(np.load(npy), transport.relight(light))
    mesh = mi.traverse(mi.load_dict({"type": "ply", "filename": str(ply)}))
    loaded = prt.load_scene(scene, float("inf"))
    assert np.allclose(np.array(mesh["vertex_color"]).reshape(-1, 3), transport.relight(light))
    assert np.array_equal(np.array(mesh["vertex_positions"]).reshape(-1, 3), loaded.positions)
    assert len(mesh["faces"]) == 3 * (2 + 12 + 2)


def test_relight_loads_the_scene_as_precompute_did(folder, environment):
    """Expected: -D and the edge length come from the matrix; a moved scene is asked for by name."""
    scene = folder / "moving.xml"
    scene.write_text(SCENE)
    call("precompute", scene, "-o", folder / "m.prt", "-q", "-D", "floor=0.2", "--max-depth", 2, *PRECOMPUTE)
    assert call("relight", folder / "m.prt", "-e", environment, "-o", folder / "m.png").exit_code == 0
    scene.rename(folder / "moved.xml")
    gone = call("relight", folder / "m.prt", "-e", environment, "-o", folder / "n.png")
    assert_one_line_error(gone, "moving.xml", "--scene")
    found = call(
        "relight",
        folder / "m.prt",
        "-e",
        environment,
        "-o",
        folder / "n.png",
        "--scene",
        folder / "moved.xml",
    )
    assert found.exit_code == 0


def test_warnings_are_one_line(folder, matrix):
    pixels = np.ones((4, 8, 3), dtype=np.float32)
    pixels[1, 2] = -1
    mi.Bitmap(pixels).write(str(folder / "negative.exr"))
    result = call("relight", matrix, "-e", folder / "negative.exr", "--vertices", folder / "w.npy", "-q")
    assert result.exit_code == 0
    lines = result.stderr.strip().splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("warning: ") and "negative" in lines[0]


def test_matrix_of_another_scene_is_refused(folder, scene, matrix, environment):
    other = folder / "other.xml"
    other.write_text(SCENE.replace('scale value="0.5"', 'scale value="0.6"'))
    before = entries(folder)
    assert_one_line_error(
        call("relight", matrix, "-e", environment, "-o", folder / "x.png", "--scene", other),
        "another scene",
        "other.xml",
    )
    assert_one_line_error(call("validate", other, matrix), "another scene")
    assert_one_line_error(
        call("relight", matrix, "-e", environment, "-o", folder / "x.png", "-D", "floor=0.3"), "another scene"
    )
    assert entries(folder) == before


@pytest.mark.parametrize("damage", ["truncated", "altered", "text", "missing"])
def test_damaged_matrix_is_refused(tmp_path, scene, matrix, environment, damage):
    content, path = bytearray(matrix.read_bytes()), tmp_path / "damaged.prt"
    if damage == "truncated":
        path.write_bytes(content[: len(content) // 2])
    elif damage == "altered":
        content[len(content) // 3] ^= 0xFF
        path.write_bytes(content)
    elif damage == "text":
        path.write_text("no matrix")
    for arguments in (["info", path], ["relight", path, "-e", environment, "-o", tmp_path / "x.png"]):
        assert_one_line_error(call(*arguments), "damaged.prt", "precompute")
    assert entries(tmp_path) <= {"damaged.prt"}


@pytest.mark.parametrize(
    "name, message",
    [("light.jpg", "not an HDR image"), ("none.exr", "no such file")],
    ids=["suffix", "missing"],
)
def test_bad_environment_is_refused(folder, matrix, name, message):
    before = entries(folder)
    assert_one_line_error(call("relight", matrix, "-e", folder / name, "-o", folder / "x.png"), name, message)
    assert entries(folder) == before


# ------------------------------------------------------------------------------------ validate, info, benchmark


def test_validate_writes_pictures_and_report(monkeypatch, folder, scene, matrix):
    monkeypatch.setattr(prt, "validate", partial(prt.validate, image_width=16, image_spp=16))
    out, report = folder / "validation", folder / "validation.json"
    result = call(
        "validate", scene, matrix, "--rows", 8, "--columns", 6, "--spp", 64, "-o", out, "--json", report
    )
    assert result.exit_code == 0, result.stderr
    for part in ("floor[1]", "box", "total", "noise", "worst column", "FLIP"):
        assert part in result.stdout
    written = json.loads(report.read_text())
    assert json.loads((out / "report.json").read_text()) == written
    assert {"relative_l2", "reference_noise", "column_worst", "image"} <= written.keys()
    assert written["parameters"]["columns"] == 6
    assert {"report.json", "image.png", "errors.png", "rows.png"} <= entries(out)


def test_info_of_a_matrix(folder, matrix):
    result = call("info", matrix, "--json", folder / "info.json")
    forecast, tables = (folder / "done.txt").read_text().split("\n", 1)
    assert "about" in forecast
    assert result.stdout == tables
    assert json.loads((folder / "info.json").read_text()) == json.loads((folder / "done.json").read_text())


def test_info_of_a_scene(folder, scene):
    result = call("info", scene, "--edge-length", "inf", "--json", folder / "scene.json")
    report = json.loads((folder / "scene.json").read_text())
    assert report["vertices"] == VERTICES
    assert report["meshes"]["box"] == {"vertices": 24, "triangles": 12}
    assert report["grey"] and report["diffuse"]
    assert "floor[1]" in result.stdout


def test_benchmark_needs_repeats(scene):
    assert_one_line_error(call("benchmark", scene, "--repeats", 2, "-q"), "at least 3")


def test_benchmark_choices(scene, tmp_path):
    """Figures 5 and 6 of every mesh that is large enough, as tables, JSON and PNG; the others are named."""
    report = tmp_path / "choices.json"
    arguments = ("--choices", "--resolution", 4, "--figures", tmp_path / "plots", "--json", report)
    result = call("benchmark", scene, *arguments)
    assert result.exit_code == 0, result.stderr
    found = json.loads(report.read_text())
    assert len(found["meshes"]) + len(found["skipped"]) == len(prt.load_scene(scene).meshes)
    assert found["meshes"]
    for mesh, parts in found["meshes"].items():
        assert mesh in result.stdout
        assert all(np.isfinite(error) for error in parts["choices"]["error"].values())
        for name in ("choices", "radius"):
            assert (tmp_path / "plots" / f"{name}_{mesh}.png").stat().st_size > 1000


# ------------------------------------------------------------------------------------------- usage and Ctrl-C


@pytest.mark.parametrize(
    "arguments",
    [
        ["precompute", "x.xml"],
        ["precompute", "x.xml", "-o", "x.prt", "-D", "novalue"],
        ["precompute", "x.xml", "-o", "x.prt", "-D", "path=1"],
        ["precompute", "x.xml", "-o", "x.prt", "--basis", "pixel"],
        ["precompute", "x.xml", "-o", "x.prt", "--variant", "scalar_rgb"],
        ["relight", "x.prt", "-e", "x.exr"],
        ["relight", "x.prt", "-e", "x.exr", "-o", "x.jpg"],
        ["relight", "x.prt", "-e", "x.exr", "--vertices", "x.obj"],
        ["look", "x.prt"],
        ["view", "x.prt", "--export", "x.txt"],
        ["benchmark", "x.xml", "--figures", "folder"],
        ["benchmark", "x.xml", "--choices", "--method", "sparse"],
    ],
)
def test_usage_errors(arguments):
    result = call(*arguments)
    assert result.exit_code == 2
    assert "Usage" in result.stderr


@pytest.mark.parametrize(
    "command", ["precompute", "relight", "view", "validate", "info", "benchmark", "pictures", "many-lights"]
)
def test_help_teaches(command):
    text = call(command, "--help").stdout
    assert f"Example: mi-sparse-prt {command}" in " ".join(text.split())
    assert "--json" in text and "default" in text


def test_another_variant_starts_again(monkeypatch, scene):
    """Expected: the same command line in a new process, with the variant in the environment."""
    other = next(v for v in ("cuda_ad_rgb", "llvm_ad_rgb") if v != prt.variant())
    started = []

    def execv(path, arguments):
        started.append((path, arguments, os.environ["MI_SPARSE_PRT_VARIANT"]))
        raise SystemExit(0)

    monkeypatch.setattr(os, "execv", execv)
    monkeypatch.setenv("MI_SPARSE_PRT_VARIANT", prt.variant())
    call("precompute", scene, "-o", "x.prt", "--variant", other)
    assert started == [(sys.executable, [sys.executable, *sys.orig_argv[1:]], other)]


def test_ctrl_c_while_computing(monkeypatch, folder, scene):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(prt, "precompute", interrupted)
    before = entries(folder)
    result = call("precompute", scene, "-o", folder / "c.prt", *PRECOMPUTE)
    assert result.exit_code == 130
    assert result.stderr.strip() == "mi-sparse-prt: interrupted; nothing was written"
    assert entries(folder) == before


def test_a_checkpoint_is_gone_on_with(monkeypatch, folder, scene, matrix):
    """Expected: after Ctrl-C the line says where the rows are; the same command then gives the same matrix."""
    rows = PathSolver.rows
    calls = []

    def interrupted_later(solver, ids):
        calls.append(ids)
        if len(calls) == 6:  # the forecast takes two
            raise KeyboardInterrupt
        return rows(solver, ids)

    monkeypatch.setattr(PathSolver, "block_size", 4)
    monkeypatch.setattr(PathSolver, "rows", interrupted_later)
    command = [
        "precompute",
        scene,
        "-o",
        folder / "k.prt",
        "-q",
        "--checkpoint",
        folder / "kept",
        *PRECOMPUTE,
    ]
    stopped = call(*command)
    assert stopped.exit_code == 130
    assert f"nothing was written; finished rows are in {folder / 'kept'}" in stopped.stderr
    assert not (folder / "k.prt").exists()
    assert len(entries(folder / "kept")) == 1

    assert call(*command).exit_code == 0
    assert calls[6:][2][0] == 12  # three blocks of four had been finished
    assert entries(folder / "kept") == set()
    whole = range(VERTICES)
    assert np.array_equal(
        prt.load_transport(folder / "k.prt").rows(whole), prt.load_transport(matrix).rows(whole)
    )


def test_ctrl_c_after_writing_says_so(capsys, tmp_path):
    with pytest.raises(BaseException) as stopped, running(None, quiet=False) as command:
        command.write(tmp_path / "done.txt", b"all of it")
        raise KeyboardInterrupt
    assert stopped.value.exit_code == 130
    assert f"interrupted; {tmp_path / 'done.txt'} was written" in capsys.readouterr().err
    assert entries(tmp_path) == {"done.txt"}
