"""Pictures of scenes: what there is, and that it is not empty."""

import json
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from test_cli import SCENE, assert_one_line_error, call
from test_cli_glossy import GLOSSY

OPTIONS = ("--resolution", 4, "--edge-length", 1, "-q")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("gallery")
    (folder / "dull.xml").write_text(SCENE)
    (folder / "glossy.xml").write_text(GLOSSY)
    result = call(
        "pictures",
        folder / "dull.xml",
        folder / "glossy.xml",
        "-o",
        folder / "all/of/them",
        *OPTIONS,
        "--json",
        folder / "done.json",
    )
    assert result.exit_code == 0, result.stderr
    written = json.loads((folder / "done.json").read_text())["files"]
    assert {Path(name) for name in written} == set((folder / "all/of/them").iterdir())
    return folder / "all/of/them"


def test_every_scene_has_its_pictures(folder):
    names = {"dull_relit", "dull_clusters", "glossy_relit", "glossy_clusters", "glossy_factors_0"}
    assert {p.stem for p in folder.iterdir()} == names
    for path in folder.iterdir():
        assert np.std(matplotlib.image.imread(path)[..., :3]) > 0.02


def test_the_matrix_is_beside_the_reference(folder):
    """The first two of four panels are nearly alike: differences are noise and the direction basis."""
    picture = matplotlib.image.imread(folder / "dull_relit.png")[..., :3]
    height, width = picture.shape[:2]
    rows = slice(int(0.3 * height), int(0.95 * height))  # without titles
    panels = [picture[rows, int(width * k / 4) : int(width * (k + 1) / 4)] for k in range(4)]
    size = min(p.shape[1] for p in panels)
    path, ours, _, difference = (p[:, :size] for p in panels)
    assert abs(path.mean() - ours.mean()) < 0.05
    assert difference.mean() < path.mean()


def test_without_a_light_there_is_nothing_to_draw(tmp_path):
    (tmp_path / "dark.xml").write_text(SCENE.replace('<emitter type="constant"/>', ""))
    result = call("pictures", tmp_path / "dark.xml", "-o", tmp_path / "p", *OPTIONS)
    assert_one_line_error(result, "no environment")
    assert not (tmp_path / "p").exists()
