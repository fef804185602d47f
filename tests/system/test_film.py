"""Films on the command line: frames are pictures of their lights, and an interruption loses none of them."""

import json
import os
import signal
import subprocess
import sys
import urllib.request
from fractions import Fraction
from functools import partial
from pathlib import Path

import av
import mitsuba as mi
import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner, Result

import mi_sparse_prt as prt
from mi_sparse_prt.cli import app
from mi_sparse_prt.cli.files import srgb_pixels
from mi_sparse_prt.relighting.film import film_lights

SCENE = """<scene version="3.0.0">
    <sensor type="perspective">
        <transform name="to_world"><lookat origin="0, 2, 4" target="0, 0.4, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm"><integer name="width" value="35"/><integer name="height" value="21"/></film>
    </sensor>
    <shape type="rectangle" id="floor">
        <transform name="to_world"><rotate x="1" angle="-90"/></transform>
        <bsdf type="diffuse"/>
    </shape>
    <shape type="cube" id="box">
        <transform name="to_world"><scale value="0.4"/><translate y="0.5"/></transform>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.8, 0.4, 0.2"/></bsdf>
    </shape>
</scene>
"""
WIDTH, HEIGHT, FRAMES = 35, 21, 5


def call(*arguments: object) -> Result:
    """Run a command; a failure inside the package is a failure of the test."""
    result = CliRunner().invoke(app, [str(a) for a in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With a matrix, and two environments of different sizes, one with a small sun."""
    folder = tmp_path_factory.mktemp("film")
    (folder / "scene.xml").write_text(SCENE)
    options = ("--method", "brute_force", "--resolution", 8, "--spp", 2, "--max-depth", 2)
    done = call("precompute", folder / "scene.xml", "-o", folder / "m.prt", "--edge-length", "inf", *options)
    assert done.exit_code == 0, done.stderr
    sky = np.full((8, 16, 3), (0.2, 0.3, 0.5), np.float32)
    sky[:, :8] = 0.7
    sun = np.full((24, 48, 3), 0.1, np.float32)
    sun[5, 31] = 60
    for name, pixels in (("sky", sky), ("sun", sun)):
        mi.Bitmap(pixels).write(str(folder / f"{name}.exr"))
    return folder


@pytest.fixture
def film(folder: Path) -> partial[Result]:
    """The command, but for its output and the number of frames."""
    return partial(call, "relight", folder / "m.prt", "-e", folder / "sky.exr", "--spp", 2)


def expected(folder: Path, light: object) -> NDArray[np.uint8]:
    """What a picture of this light shows, half a stop darker."""
    scene = prt.load_scene(folder / "scene.xml", float("inf"))
    transport = prt.load_transport(folder / "m.prt")
    camera = prt.FixedCamera(scene, transport, spp=2)  # checked against renders in its own tests
    return srgb_pixels(camera.image(transport.irradiance(light), light), -0.5)


def decoded(path: Path) -> tuple[list[NDArray[np.uint8]], Fraction]:
    """Frames of a film, and how many of them a second has."""
    with av.open(path) as container:
        video = container.streams.video[0]
        assert (video.codec_context.name, video.codec_context.pix_fmt) == ("h264", "yuv420p")
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video)]
        return frames, video.average_rate


def read(path: Path) -> NDArray[np.uint8]:
    return np.array(mi.Bitmap(str(path)))


def test_frames_are_pictures_of_a_turning_light(folder, film, tmp_path):
    """Expected: frame k is at k / 4 of the angle, bit by bit, and that of `relight --rotate` but for its samples."""
    out, report = tmp_path / "new" / "frames", tmp_path / "report.json"
    result = film("-o", out, "--frames", FRAMES, "--rotate", 120, "--exposure", -0.5, "--json", report)
    assert result.exit_code == 0, result.stderr
    assert sorted(p.name for p in out.iterdir()) == [f"{k:04}.png" for k in range(FRAMES)]
    sky = prt.load_environment(folder / "sky.exr")
    for k in range(FRAMES):
        assert np.array_equal(read(out / f"{k:04}.png"), expected(folder, sky.rotated(30.0 * k))), k
    assert film("-o", tmp_path / "still.png", "--rotate", 30, "--exposure", -0.5, "--spp", 64).exit_code == 0
    moved, still = (read(path).astype(float) for path in (out / "0001.png", tmp_path / "still.png"))
    assert np.abs((moved - still).mean(axis=(0, 1))).max() < 1.5  # of 255
    assert np.median(np.abs(moved - still)) <= 1  # edges apart
    size = sum(p.stat().st_size for p in out.iterdir())
    assert json.loads(report.read_text())["film"] == {"path": str(out), "frames": FRAMES, "bytes": size}


def test_one_light_becomes_another(folder, film, tmp_path):
    """Expected: light in texels goes from one to the other in equal steps, and turns; pictures are of that light."""
    ends = ["--to", folder / "sun.exr", "--rotate", 90, "--exposure", -0.5]
    assert film("-o", tmp_path / "f", "--frames", 3, *ends).exit_code == 0
    sky, sun = (prt.load_environment(folder / f"{name}.exr") for name in ("sky", "sun"))
    lighting = prt.CubemapLighting(8)
    for k, light in enumerate(film_lights(sky, sun, 90, 3)):
        first, last = (lighting.project(end.rotated(45 * k)) for end in (sky, sun))
        assert np.allclose(lighting.project(light), (1 - k / 2) * first + k / 2 * last, rtol=1e-4)
        assert np.array_equal(read(tmp_path / "f" / f"{k:04}.png"), expected(folder, light))
    assert np.array_equal(read(tmp_path / "f" / "0002.png"), expected(folder, sun.rotated(90)))


def test_a_sun_keeps_its_power_at_any_size():
    """Sizes that are no multiples of each other: a resampled image has the same integral over the sphere."""
    first, last = np.zeros((10, 20, 3), np.float32), np.zeros((7, 15, 3), np.float32)
    last[3, 6] = 100
    sun = prt.Environment(last)
    *_, light = film_lights(prt.Environment(first), sun, 0, 2)
    assert light.pixels.shape == (10, 20, 3)
    power = [np.einsum("hwc,hw->c", e.pixels, e.solid_angles) for e in (light, sun)]
    np.testing.assert_allclose(power[0], power[1], rtol=1e-5)
    assert light.pixels.max() <= 100 * (1 + 1e-5)


def test_a_film_has_all_frames(folder, film, tmp_path):
    """Odd sizes get another row and column. Expected: colours as they were, but for what compression takes."""
    path = tmp_path / "film.mp4"
    frames = ("--frames", FRAMES, "--fps", 24, "--rotate", 120, "--exposure", -0.5)
    assert film("-o", path, *frames).exit_code == 0
    assert [p.name for p in tmp_path.iterdir()] == ["film.mp4"]
    images, rate = decoded(path)
    assert (len(images), rate) == (FRAMES, 24)
    sky = prt.load_environment(folder / "sky.exr")
    for k, image in enumerate(images):
        assert image.shape == (HEIGHT + 1, WIDTH + 1, 3)
        shown = expected(folder, sky.rotated(30.0 * k))
        assert np.abs(image[:HEIGHT, :WIDTH].mean(axis=(0, 1)) - shown.mean(axis=(0, 1))).max() < 2
        assert np.abs(image[:HEIGHT, :WIDTH] - shown.astype(float)).mean() < 5


def test_a_single_frame_is_not_turned(folder, film, tmp_path):
    assert film("-o", tmp_path / "f", "--frames", 1, "--rotate", 90, "--exposure", -0.5).exit_code == 0
    sky = prt.load_environment(folder / "sky.exr")
    assert np.array_equal(read(tmp_path / "f" / "0000.png"), expected(folder, sky))


@pytest.mark.parametrize("name", ["frames", "film.mp4"])
def test_an_interruption_keeps_the_frames(film, tmp_path, monkeypatch, name):
    """Ctrl-C while the third frame of five is made. Expected: it and those before it are there, in one line."""
    usual = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell may have had it ignored
    image, lights = prt.FixedCamera.image, []

    def interrupted(camera: prt.FixedCamera, incident: object, light: object):
        lights.append(light)
        if len(lights) == 3:
            os.kill(os.getpid(), signal.SIGINT)
        return image(camera, incident, light)

    monkeypatch.setattr(prt.FixedCamera, "image", interrupted)
    out = tmp_path / name
    try:
        result = film("-o", out, "--frames", FRAMES, "-q", "--json", tmp_path / "report.json")
    finally:
        signal.signal(signal.SIGINT, usual)
    assert result.exit_code == 130
    assert result.stderr == f"mi-sparse-prt: interrupted; {out} was written: 3 of 5 frames\n"
    assert [p.name for p in tmp_path.iterdir()] == [name]
    assert len(decoded(out)[0] if out.is_file() else [*out.iterdir()]) == 3


def test_an_interruption_before_the_first_frame_leaves_no_film(film, tmp_path, monkeypatch):
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(prt.FixedCamera, "image", interrupted)
    result = film("-o", tmp_path / "film.mp4", "--frames", FRAMES, "-q")
    assert result.exit_code == 130
    assert result.stderr == "mi-sparse-prt: interrupted; nothing was written\n"
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["-o", "film.mp4"], "needs --frames"),
        (["-o", "a.png", "--to", "sky.exr"], "give --frames, too"),
        (["--frames", "2"], "-o FOLDER"),
        (["-o", "film.avi", "--frames", "2"], "ends in .mp4"),
        (["-o", "film.mp4", "--frames", "0"], "give 1 or more"),
        (["-o", "film.mp4", "--frames", "2", "--fps", "0"], "give 0.1 to 1000"),
        (["-o", "film.mp4", "--frames", "2", "--vertices", "a.npy"], "leave out --frames"),
    ],
    ids=["no frames", "to without frames", "no output", "suffix", "none", "no rate", "vertices"],
)
def test_what_makes_no_film_is_refused(film, tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    result = film(*arguments)
    assert result.exit_code == 2
    assert message in result.stderr
    assert not [*tmp_path.iterdir()]


def test_frames_of_a_longer_film_are_not_mixed_with(film, tmp_path):
    (tmp_path / "0007.png").write_bytes(b"")
    result = film("-o", tmp_path, "--frames", FRAMES, "-q")
    assert result.exit_code == 1
    assert "0007.png: remove them or choose another folder" in result.stderr
    assert [p.name for p in tmp_path.iterdir()] == ["0007.png"]


def test_a_folder_that_cannot_be_made_is_refused(film, tmp_path):
    (tmp_path / "file").write_bytes(b"")
    for out in (tmp_path / "file" / "frames", tmp_path / "none" / "film.mp4"):
        result = film("-o", out, "--frames", FRAMES, "-q")
        assert result.exit_code == 1
        assert len(result.stderr.splitlines()) == 1
        assert "choose another folder" in result.stderr


def test_one_light_at_a_time(folder: Path, tmp_path: Path) -> None:
    """A picture for each light: its own column sums, and all of them together those of light from everywhere."""
    report, into = tmp_path / "r.json", tmp_path / "lights"
    arguments = ("--each", 11, "-o", into, "--spp", 2, "--json", report)
    assert call("relight", folder / "m.prt", *arguments).exit_code == 0
    names = [f"{k:04}.exr" for k in range(11)]
    assert sorted(path.name for path in into.iterdir()) == [*names, "lights.json"]
    pictures = np.stack([np.array(mi.Bitmap(str(into / name)))[..., :3] for name in names])
    transport = prt.load_transport(folder / "m.prt")
    camera = prt.FixedCamera(prt.load_scene(folder / "scene.xml", float("inf")), transport, spp=2)
    np.testing.assert_allclose(
        pictures.sum(axis=0), camera.image(transport.irradiance(1.0)), rtol=2e-3, atol=1e-4
    )  # half floats
    about = json.loads((into / "lights.json").read_text())
    directions = np.array([light["direction"] for light in about["lights"]])
    nearest = np.argmax(transport.lighting.directions @ directions.T, axis=1)
    light = np.repeat((nearest == 7)[:, None], 3, axis=1).astype(np.float32)
    np.testing.assert_allclose(pictures[7], camera.image(transport.irradiance(light)), rtol=1e-3, atol=1e-6)
    angles = sum(light["solid_angle"] for light in about["lights"])
    assert abs(angles - 4 * np.pi) < 1e-4
    found = json.loads(report.read_text())["each"]
    assert found["pictures"] == 11 and found["bytes"] == sum(p.stat().st_size for p in into.iterdir())


def test_a_page_is_exported(folder: Path, tmp_path: Path) -> None:
    """With the lights that were given, of a matrix that is compressed on the way."""
    page, report = tmp_path / "page.html", tmp_path / "r.json"
    lights = ("-e", folder / "sky.exr", "-e", folder / "sun.exr")
    done = call("view", folder / "m.prt", *lights, "--export", page, "--json", report, "--kept", 0.5)
    assert done.exit_code == 0, done.stderr
    found = json.loads(report.read_text())
    assert found["environments"] == ["sky", "sun"] and found["bytes"] == page.stat().st_size
    assert page.read_text().startswith("<!doctype html>") and "<title>m</title>" in page.read_text()
    done = call("view", folder / "m.prt", "--export", tmp_path / "none.html", "--kept", 2)
    assert done.exit_code == 1 and "above 0 and up to 1" in done.stderr
    assert not (tmp_path / "none.html").exists()


def test_a_page_is_shown_until_ctrl_c(folder: Path) -> None:
    program = [sys.executable, "-m", "mi_sparse_prt", "view", folder / "m.prt", "--no-browser", "--quiet"]
    listening = partial(
        signal.signal, signal.SIGINT, signal.SIG_DFL
    )  # jobs in the background of a script do not
    with subprocess.Popen(
        map(str, program), stderr=subprocess.PIPE, text=True, preexec_fn=listening
    ) as process:
        try:
            assert process.stderr is not None
            address = next(line.split()[0] for line in process.stderr if "127.0.0.1" in line)
            with urllib.request.urlopen(address, timeout=20) as answer:
                assert answer.status == 200 and b"<canvas" in answer.read()
            process.send_signal(signal.SIGINT)
            assert process.wait(20) == 130
            assert "interrupted" in process.stderr.read()
        finally:
            process.kill()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--each", 5), "folder"),
        (("--each", 5, "-o", "x.png"), "folder"),
        (("--each", 5, "-o", "x", "--frames", 3), "of its own"),
        (("--each", 0, "-o", "x"), "0 lights"),
        (("--each", 999, "-o", "x"), "999 lights"),
        (("-o", "x.png"), "no light"),
    ],
)
def test_lights_that_make_no_sense(folder: Path, tmp_path: Path, monkeypatch, arguments, words) -> None:
    monkeypatch.chdir(tmp_path)
    done = call("relight", folder / "m.prt", *arguments)
    assert done.exit_code != 0 and words in " ".join(done.stderr.split())
