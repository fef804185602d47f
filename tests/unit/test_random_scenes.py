"""docs/random_scenes.py: scenes drawn at random are the same whenever they are made, and Mitsuba takes them."""

import subprocess
import sys
from pathlib import Path

import mitsuba as mi
import numpy as np

SCRIPT = Path(__file__).parents[2] / "docs" / "random_scenes.py"


def written(folder: Path, first: int, count: int) -> dict[str, str]:
    options = ["--first", str(first), "--count", str(count)]
    subprocess.run([sys.executable, SCRIPT, folder, *options], check=True, capture_output=True)
    return {path.name: path.read_text() for path in folder.glob("*.xml")}


def test_a_scene_does_not_depend_on_those_before_it(tmp_path):
    """Expected: four kinds in turn; number 5 is the same file, made alone or after others, and is no other's."""
    every, one = written(tmp_path / "every", 2, 5), written(tmp_path / "one", 5, 1)
    names = ["002_landscape.xml", "003_courtyard.xml", "004_room.xml", "005_product.xml", "006_landscape.xml"]
    assert sorted(every) == names
    assert one == {"005_product.xml": every["005_product.xml"]}
    assert len(set(every.values())) == 5
    for name in names:
        scene = mi.load_file(str(tmp_path / "every" / name))
        assert scene.environment() is not None and len(scene.sensors()) == 1
        image = np.array(mi.render(scene, spp=1))
        assert np.isfinite(image).all() and image.mean() > 0.01
