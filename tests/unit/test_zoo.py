"""The zoo: that it is complete, what its verdicts mean, and that a scene which fails takes nothing else with it."""

import re
import sys
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from rich.console import Console

from mi_sparse_prt.benchmark.zoo import (
    LIMIT,
    ZOO,
    Rendering,
    image_error,
    judge,
    scene_files,
    told_by,
    verdict,
)
from mi_sparse_prt.benchmark.zoo_figures import GAP, LABEL, SceneImages, draw_contact_sheet
from mi_sparse_prt.cli.tables.zoo import zoo_tables
from mi_sparse_prt.core.errors import PrtError

sys.path.insert(0, str(ZOO))

from make_zoo import LEFT_OUT, scenes  # noqa: E402

KINDS = {"BSDF", "Shape", "Texture", "Emitter"}
SPECTRA = {
    "d65",
    "blackbody",
    "rawconstant",
    "uniform",
    "regular",
    "irregular",
    "srgb",
}  # textures to Mitsuba


def test_every_plugin_has_a_scene_or_a_reason():
    """Expected: each BSDF, shape, texture and emitter that Mitsuba has; a new version's new plugin fails here."""
    folder = Path(mi.__file__).parent / "plugins"
    known = {
        name
        for name in (path.stem for path in folder.glob("*.so"))
        if mi.PluginManager.instance().plugin_type(name).name in KINDS
    }
    used = set(re.findall(r'type="(\w+)"', "".join(scenes().values())))
    assert known - used - SPECTRA == set(LEFT_OUT)


def test_the_files_are_those_of_the_script():
    stored = {path.stem: path.read_text() for path in ZOO.glob("*.xml")}
    assert stored == scenes()


@pytest.mark.parametrize(
    "error, uncertainty, estimate, warned, teller, expected",
    [
        (0.019, 0.01, 0.001, False, [], "agrees"),
        (0.019, 0.03, 0.001, False, [], "unclear"),
        (0.019, 0.01, 0.05, True, ["estimate", "warning"], "agrees"),
        (0.021, 0.01, 0.011, False, ["estimate"], "told to be off"),
        (0.021, 0.01, 0.010, False, [], "off"),
        (0.9, 0.01, 0.05, True, ["warning"], "told to be off"),
        (0.9, 0.01, None, False, [], "off"),
    ],
)
def test_verdicts(error, uncertainty, estimate, warned, teller, expected):
    assert told_by(error, estimate, warned) == teller
    assert verdict(error, uncertainty, bool(teller)) == expected


def test_errors_are_found_beneath_noise():
    """
    Rationale: a pixel of the reference has more noise than the 2% that are allowed.
    Expected: of images with 10% of noise on both sides, one that is right has no error, and one that is 4% off has
        4%, within what is said that noise may show; what a warning says of an estimate or a cache excuses nothing.
    """
    rng = np.random.default_rng(1)
    truth = 1 + rng.random((72, 96, 3))

    def noisy(scale: float) -> tuple:
        pair = (scale * truth * (1 + 0.1 * rng.normal(size=truth.shape)) for _ in range(2))
        return tuple(image.astype(np.float32) for image in pair)

    for scale in (1.0, 1.04):
        error, uncertainty = image_error(noisy(scale), noisy(1.0))
        assert uncertainty < LIMIT
        assert abs(error**2 - (scale - 1) ** 2) <= 2 * uncertainty**2
    said = ["the target error 0.05 was not met: the estimate is 0.01", "cache: no space"]
    silent = Rendering(noisy(1.04), 1.0, 0.01, said)
    assert judge("it", silent, noisy(1.0))["verdict"] == "off"
    outspoken = Rendering(noisy(1.04), 1.0, 0.01, [*said, "shape 'it': drawn as diffuse"])
    found = judge("it", outspoken, noisy(1.0))
    assert (found["verdict"], found["told_by"]) == ("told to be off", ["warning"])


def test_pictures_with_nan_do_not_agree():
    """As those of curves that Mitsuba read beyond their end: they were no different from anything."""
    right = tuple(np.random.default_rng(2).random((2, 8, 9, 3)).astype(np.float32))
    wrong = tuple(np.where(np.arange(9)[:, None] == 4, np.nan, image) for image in right)
    for ours, truth, whose in ((right, wrong, "path"), (wrong, right, "sparse_prt")):
        found = judge("it", Rendering(ours, 1.0, 0.01, []), truth)
        assert found["verdict"] == "error" and found["sentences"] == [f"{whose}: pixels are NaN or infinite"]


def test_a_folder_without_scenes_is_refused(tmp_path):
    with pytest.raises(PrtError, match="no scene file"):
        scene_files(tmp_path)


def test_the_contact_sheet_has_the_pixels_of_the_images():
    """Expected: ours, the reference and their difference side by side, untouched; grey where there is no picture."""
    rng = np.random.default_rng(2)
    truth = rng.random((9, 12, 3)).astype(np.float32)
    images = {"a": SceneImages(truth, truth), "b": SceneImages(truth), "c": SceneImages()}
    figure = draw_contact_sheet(images, {"a": "agrees", "b": "refused", "c": "error"})
    (axes,) = figure.axes
    sheet = np.array(axes.images[0].get_array())
    rows = slice(LABEL, LABEL + 9)
    a, b, c = (sheet[rows, k * (36 + GAP) : k * (36 + GAP) + 36] for k in range(3))
    assert np.array_equal(a[:, :12], a[:, 12:24]) and not a[:, 24:].any()
    assert np.array_equal(b[:, 12:24], a[:, 12:24])
    assert np.ptp(b[:, :12]) == np.ptp(b[:, 24:]) == np.ptp(c) == 0
    assert [text.get_text() for text in axes.texts] == ["a: agrees", "b: refused", "c: error"]


def test_tables_name_who_was_told_what():
    """Expected: sentences of scenes that agree are left out, those of several scenes are said once."""

    def scene(name: str, verdict: str, *sentences: str) -> dict:
        numbers = dict.fromkeys(("error", "uncertainty", "estimated_error", "seconds"), 0.5)
        by = ["warning"] if verdict == "told to be off" else []
        return {"name": name, "verdict": verdict, **numbers, "told_by": by, "sentences": list(sentences)}

    found = [scene("bsdf_a", "agrees", "hush"), scene("bsdf_b", "off", "loud")]
    found.append(scene("shape_c", "told to be off", "loud"))
    console = Console(width=150, record=True)
    machine = {"load_average": 0.5, "cores": 2}
    for table in zoo_tables({"scenes": found, "counts": {"off": 1, "agrees": 1}, "machine": machine}):
        console.print(table)
    text = console.export_text()
    assert "3 scenes: 1 off, 1 agrees" in text and "told to be off (warning)" in text
    assert "hush" not in text and text.count("loud") == 1 and "bsdf_b, shape_c" in text
