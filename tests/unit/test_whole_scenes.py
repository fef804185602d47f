"""The whole scenes: that their files are those of the script, and that Mitsuba has them as they are meant."""

import sys
from pathlib import Path

import mitsuba as mi
import pytest

WHOLE = Path(__file__).parents[2] / "scenes_xml/whole"
sys.path.insert(0, str(WHOLE))

from make_whole import COUNT, main, scenes  # noqa: E402

WRITTEN = (".xml", ".ply", ".png")
SHAPES = {
    "cornell_glass": 8,
    "kitchen": 126,
    "tree": 3,
    "tree_plain": 3,
    "bricks": COUNT + 1,
    "window": 37,
}  # groups of shapes are not counted


def test_the_files_are_those_of_the_script(tmp_path):
    """Expected: run again into another folder, it writes what is stored, byte by byte, and nothing else."""
    main(tmp_path)
    stored, written = (
        {str(p.relative_to(root)): p.read_bytes() for p in root.rglob("*") if p.suffix in WRITTEN}
        for root in (WHOLE, tmp_path)
    )
    assert stored.keys() == written.keys()
    assert [name for name in stored if stored[name] != written[name]] == []
    assert sum(map(len, stored.values())) < 4e6


@pytest.mark.parametrize("name", scenes())
def test_a_scene_loads_in_mitsuba(name):
    """Expected: all its shapes, one camera, and an environment."""
    scene = mi.load_file(str(WHOLE / f"{name}.xml"), optimize=False)
    assert len(scene.shapes()) == SHAPES[name]
    assert len(scene.sensors()) == 1
    assert scene.environment() is not None
