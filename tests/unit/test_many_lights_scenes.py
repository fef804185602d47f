"""Scenes lit by many lights: that their files are those of the script, and that Mitsuba has them."""

import sys
from pathlib import Path

import mitsuba as mi
import pytest

FOLDER = Path(__file__).parents[2] / "scenes_xml/many_lights"
sys.path.insert(0, str(FOLDER))

from make_many_lights import main  # noqa: E402

EMITTERS = {"colonnade": 1, "room": 4, "leaves": 6, "hall": 81}


def test_the_files_are_those_of_the_script(tmp_path):
    """Expected: run again into another folder, it writes what is stored, byte by byte, and nothing else."""
    main(tmp_path)
    stored, written = ({p.name: p.read_bytes() for p in root.glob("*.xml")} for root in (FOLDER, tmp_path))
    assert stored == written and set(stored) == {f"{name}.xml" for name in EMITTERS}


@pytest.mark.parametrize("name", EMITTERS)
def test_a_scene_loads_in_mitsuba(name):
    scene = mi.load_file(str(FOLDER / f"{name}.xml"), optimize=False)
    assert len(scene.emitters()) == EMITTERS[name] and len(scene.sensors()) == 1
