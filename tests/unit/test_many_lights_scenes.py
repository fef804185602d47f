"""Scenes lit by many lights: that their files are those of the script, and that Mitsuba has them."""

import sys
from pathlib import Path

import mitsuba as mi
import pytest

import mi_sparse_prt as prt

FOLDER = Path(__file__).parents[2] / "scenes_xml/many_lights"
sys.path.insert(0, str(FOLDER))

from make_many_lights import main  # noqa: E402

EMITTERS = {"colonnade": 1, "room": 4, "leaves": 6, "hall": 81, "hair": 4}


def test_the_files_are_those_of_the_script(tmp_path):
    """Expected: run again into another folder, it writes what is stored, byte by byte, and nothing else."""
    main(tmp_path)
    stored, written = (
        {p.name: p.read_bytes() for p in root.iterdir() if p.suffix in (".xml", ".txt")}
        for root in (FOLDER, tmp_path)
    )
    assert stored == written and set(stored) == {*(f"{name}.xml" for name in EMITTERS), "strands.txt"}


@pytest.mark.parametrize("name", EMITTERS)
def test_a_scene_loads_in_mitsuba(name):
    scene = mi.load_file(str(FOLDER / f"{name}.xml"), optimize=False)
    assert len(scene.emitters()) == EMITTERS[name] and len(scene.sensors()) == 1


def test_curves_beside_area_lamps_have_a_picture():
    """Shapes that cannot sample points on themselves stand in no lamp's way. Expected: light of all four emitters."""
    found = prt.render_many_lights(
        mi.load_file(str(FOLDER / "hair.xml"), width="24", height="18"), 8, 16, lights=800, groups=True
    )
    assert all(layer.mean() > 0.001 * found.image.mean() for layer in found.layers.values())
    assert set(found.layers) == {"lantern", "left", "behind", "sky"}
