"""Layers of lamps: weighted sums of them, files, and the page that mixes them. How that looks: test_mixer_page.py."""

import re

import mitsuba as mi
import numpy as np
import pytest
import scipy.stats
from numpy.testing import assert_allclose, assert_array_equal
from test_cli import assert_one_line_error, call, entries
from test_many_lights import LAMP, room
from test_page import in_page

import mi_sparse_prt as prt
from mi_sparse_prt.core.metrics import relative_l2
from mi_sparse_prt.io.exr_layers import layers_bytes, read_layers
from mi_sparse_prt.relighting.viewer import make_mixer
from mi_sparse_prt.relighting.viewer import mixer as mixer_module
from mi_sparse_prt.relighting.viewer.server import PageServer

T = mi.ScalarTransform4f


def some_layers(count: int = 3, height: int = 6, width: int = 9) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(count)
    names = ["lamp", "über.dem <Tisch>", "sky"] + [f"bulb_{k}" for k in range(count)]
    return {name: rng.exponential(size=(height, width, 3)).astype(np.float32) for name in names[:count]}


def found_of(layers: dict[str, np.ndarray]) -> prt.ManyLightsImage:
    image = np.asarray(sum(layers.values()), np.float32)
    return prt.ManyLightsImage(image, np.ones(image.shape[:2], np.float32), layers, {})


def test_a_mixture_is_the_weighted_sum() -> None:
    layers = some_layers()
    found = found_of(layers)
    assert_allclose(found.mixed({}), found.image, rtol=1e-6)
    first, second, third = layers.values()
    mixture = found.mixed({"lamp": 2.5, "sky": (0.5, 0.0, 3.0)})
    assert_allclose(mixture, 2.5 * first + second + third * np.float32([0.5, 0, 3]), rtol=1e-6)
    assert_allclose(found.mixed(dict.fromkeys(layers, 0)), 0)


@pytest.mark.parametrize("weight", [-1, np.nan, np.inf, (1, 2), "bright", (1, 2, -3), None])
def test_weights_are_numbers_of_0_or_more(weight: object) -> None:
    with pytest.raises(prt.PrtError, match=r"the weight of 'lamp' is .*give a number of 0 or more"):
        found_of(some_layers()).mixed({"lamp": weight})


def test_unknown_lamps_are_told_in_a_line() -> None:
    with pytest.raises(prt.PrtError, match="no emitter is named 'lump': choose from lamp, .*sky"):
        found_of(some_layers()).mixed({"lump": 1})
    with pytest.raises(prt.PrtError, match="groups=True"):
        prt.ManyLightsImage(np.zeros((2, 2, 3)), np.ones((2, 2)), {}, {}).mixed({"lamp": 1})


@pytest.mark.slow
def test_a_mixture_is_the_picture_of_a_scene_with_other_lamps() -> None:
    """A room whose lamp, which the camera sees, and point are dimmed and coloured; in the picture, and in the scene.

    Rationale: all light is linear in what emitters send out, and no cluster has lights of two of them.
    Expected: of 8 seeds, means of the picture's colours agree within what is as likely as 3 standard errors, by
    Student's t, as these are estimated from so few, and 0.2%; pictures differ (RMS) by less than 1.5%, and with all
    columns (of three) by less than 0.5%, as particles and points on the lamp are others; the lamp's face is as bright.
    Result: of 928 seeds, means differ by 0.01 +- 0.02%; the 8 may spread so little that 0.3% is 5 standard errors.
    """
    weights = {"lamp": (0.2, 0.5, 1.5), "point": 4.0}
    emitter = {"type": "area", "radiance": {"type": "rgb", "value": [6 * 0.2, 5 * 0.5, 4 * 1.5]}}
    place = T().translate([0, 1.8, -0.5]).rotate([1, 0, 0], 30).scale(0.4)  # before the camera
    point = {"type": "point", "position": [1, 2, 1]}
    before = room(lamp=LAMP | {"to_world": place}, point=point | {"intensity": 3.0})
    after = room(lamp=LAMP | {"to_world": place, "emitter": emitter}, point=point | {"intensity": 12.0})
    asked = {"rows": 30, "columns": 60, "lights": 2000, "max_depth": 3}
    mixed, changed, exact = [], [], []
    every = asked | {"columns": 10**6}
    for seed in range(8):
        mixed.append(prt.render_many_lights(before, groups=True, seed=seed, **asked).mixed(weights))
        changed.append(prt.render_many_lights(after, seed=seed, **asked).image)
        if seed < 3:  # with all columns there is next to no spread
            exact.append(
                [
                    prt.render_many_lights(before, groups=True, seed=seed, **every).mixed(weights),
                    prt.render_many_lights(after, seed=seed, **every).image,
                ]
            )
    difference = np.array(mixed) - changed  # [seed, y, x, rgb]
    apart = relative_l2(np.array(mixed), np.array(changed))
    lights = relative_l2(*np.array(exact).swapaxes(0, 1))
    means = difference.mean(axis=(1, 2))
    off, error = means.mean(axis=0), means.std(axis=0, ddof=1) / np.sqrt(8)
    mean = np.mean(changed, axis=(0, 1, 2))
    print(f"off {off / mean} +- {error / mean}, differences {apart:.2%}, with all columns {lights:.2%}")
    assert (np.abs(off) < scipy.stats.t(7).isf(scipy.stats.norm.sf(3)) * error + 0.002 * mean).all()
    assert apart < 0.015 and lights < 0.005
    face = np.argmin(np.abs(changed[0] - [1.2, 2.5, 6]).sum(axis=-1))
    assert_allclose(mixed[0].reshape(-1, 3)[face], [1.2, 2.5, 6], rtol=1e-5)


# --- files


def test_layers_come_back_from_a_file(tmp_path) -> None:
    layers, path = some_layers(), tmp_path / "a.exr"
    path.write_bytes(layers_bytes(found_of(layers).image, layers))
    found = read_layers(path)
    assert list(found) == sorted(layers)
    for name, layer in layers.items():
        assert_array_equal(found[name], layer)


def written(path, channels: dict[str, np.ndarray], half: bool = False):
    pixels = np.stack([*channels.values()], axis=-1).astype(np.float16 if half else np.float32)
    mi.Bitmap(pixels, channel_names=[*channels]).write(str(path))
    return path


def test_files_of_others_are_read(tmp_path) -> None:
    """Half floats, other channels beside, and no picture."""
    rng = np.random.default_rng(0)
    channels = {f"key.{c}": rng.random((4, 5)) for c in "RGB"}
    channels |= {f"depth.{c}": rng.random((4, 5)) for c in "ZV"}
    found = read_layers(written(tmp_path / "a.exr", channels, half=True))
    assert [*found] == ["key"] and found["key"].dtype == np.float32
    assert_allclose(found["key"][..., 1], channels["key.G"], rtol=1e-3)


def test_what_is_no_picture_of_lamps_is_told_in_a_line(tmp_path) -> None:
    with pytest.raises(prt.PrtError, match="no such file"):
        read_layers(tmp_path / "none.exr")
    (tmp_path / "text.exr").write_text("text")
    with pytest.raises(prt.PrtError, match="cannot be read as an image.*--groups"):
        read_layers(tmp_path / "text.exr")
    mi.Bitmap(np.ones((2, 3, 3), np.float32)).write(str(tmp_path / "plain.exr"))
    with pytest.raises(prt.PrtError, match=r"plain.exr has no layers of lamps: .*many-lights.* --groups"):
        read_layers(tmp_path / "plain.exr")
    values = {c: np.ones((2, 3)) for c in "RGB"}
    normals = values | {f"normal.{c}": np.full((2, 3), 0.3) for c in "RGB"}
    with pytest.raises(prt.PrtError, match="not lamps that add up"):
        read_layers(written(tmp_path / "aov.exr", normals))
    with pytest.raises(prt.PrtError, match="not finite"):
        read_layers(
            written(tmp_path / "nan.exr", {f"{k}.{c}": np.full((2, 3), np.nan) for k in "ab" for c in "RGB"})
        )


# --- the page


def test_a_page_has_its_layers() -> None:
    layers = some_layers() | {
        "off": np.zeros((6, 9, 3), np.float32),
        "sun": np.full((6, 9, 3), 3e5, np.float32),
    }
    page = make_mixer(layers, "<room>")
    found = in_page(page)
    assert "<title>&lt;room&gt;</title>" in page.text and found["lamps"] == [*layers]
    assert not re.search(
        r"(src|href)=|https?://", page.text.split('id="data"')[0].replace('href="data:,"', "")
    )
    halves = found["layers"].view(np.float16).astype(np.float32).reshape(len(layers), 6, 9, 3)
    for half, scale, layer in zip(halves, found["scales"], layers.values(), strict=True):
        assert_allclose(half * scale, layer, rtol=1e-3)


def test_layers_that_no_page_can_mix(monkeypatch) -> None:
    for layers in ({}, {"a": np.zeros((2, 3))}, {"a": np.zeros((2, 3, 3)), "b": np.zeros((3, 2, 3))}):
        with pytest.raises(prt.PrtError, match="layers of one size"):
            make_mixer(layers)
    monkeypatch.setattr(mixer_module, "MOST_BYTES", 100)
    with pytest.raises(prt.PrtError, match="3 layers of 9 x 6 pixels are .*smaller picture"):
        make_mixer(some_layers())


def test_view_serves_a_mixer(tmp_path, monkeypatch) -> None:
    served = []

    def asked_once(server: PageServer) -> None:
        served.append(server.page.decode())
        raise KeyboardInterrupt

    monkeypatch.setattr(PageServer, "serve_forever", asked_once)
    layers, picture = some_layers(), tmp_path / "a.exr"
    picture.write_bytes(layers_bytes(found_of(layers).image, layers))
    result = call("view", picture, "--no-browser")
    assert result.exit_code == 130 and "http://127.0.0.1:" in result.stderr
    assert served == [make_mixer(read_layers(picture), "a").text]


def test_view_exports_a_mixer_or_says_why_not(tmp_path) -> None:
    layers, picture, page = some_layers(), tmp_path / "a.exr", tmp_path / "a.html"
    picture.write_bytes(layers_bytes(found_of(layers).image, layers))
    result = call("view", picture, "--export", page, "--json", "-")
    assert result.exit_code == 0 and '"sky"' in result.stdout
    assert page.read_text() == make_mixer(read_layers(picture), "a").text
    before = entries(tmp_path)
    plain = tmp_path / "plain.exr"
    mi.Bitmap(np.ones((2, 3, 3), np.float32)).write(str(plain))
    assert_one_line_error(call("view", plain, "--no-browser"), "no layers of lamps")
    assert_one_line_error(
        call("view", tmp_path / "none.exr", "--export", tmp_path / "b.html"), "no such file"
    )
    assert call("view", picture, "--export", page, "-D", "a=1").exit_code == 2
    plain.unlink()
    assert entries(tmp_path) == before
