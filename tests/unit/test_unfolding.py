"""Scenes of many instances as scenes of meshes."""

import mitsuba as mi
import numpy as np
import pytest
from conftest import T, bumpy_ball, diffuse, mesh

import mi_sparse_prt as prt
from mi_sparse_prt.core.metrics import relative_l2
from mi_sparse_prt.scene import unfolding
from mi_sparse_prt.scene.unfolding import unfold_instances


def scene_of_instances(count: int, **more: object) -> mi.Scene:
    """Instances of a smooth ball and a faceted box, turned, stretched and mirrored, on a floor under a lamp."""
    ball = mesh("ball", *bumpy_ball(), diffuse(0.7, 0.3, 0.2))
    groups = {
        "balls": {"type": "shapegroup", "ball": ball},
        "boxes": {"type": "shapegroup", "box": {"type": "cube", "bsdf": diffuse(0.2, 0.4, 0.7)}},
    }
    rng = np.random.default_rng(1)
    placed = {}
    for k in range(count):
        x, z, angle = *rng.uniform(-2, 2, 2), rng.uniform(0, 360)
        size = mi.ScalarVector3f(0.25, 0.25, -0.25 if k % 3 else 0.4)
        place = T().translate([x, 0.3, z]).rotate([0, 1, 0], angle).scale(size)
        group = {"type": "ref", "id": ("balls", "boxes")[k % 2]}
        placed[f"copy_{k}"] = {"type": "instance", "to_world": place, "group": group}
    camera = {
        "type": "perspective",
        "fov": 50,
        "to_world": T().look_at([0, 4, 4], [0, 0, 0], [0, 1, 0]),
        "film": {"type": "hdrfilm", "width": 48, "height": 48, "rfilter": {"type": "box"}},
    }
    return mi.load_dict(
        {
            "type": "scene",
            **groups,
            **placed,
            "floor": {
                "type": "rectangle",
                "to_world": T().rotate([1, 0, 0], -90).scale(3),
                "bsdf": diffuse(0.6, 0.6, 0.6),
            },
            "lamp": {
                "type": "rectangle",
                "to_world": T().translate([0, 3, 0]).rotate([1, 0, 0], 90).scale(0.5),
                "emitter": {"type": "area", "radiance": 8.0},
            },
            "sky": {"type": "constant", "radiance": 0.3},
            "camera": camera,
            **more,
        },
        optimize=False,
    )


def test_pictures_are_the_same() -> None:
    """Expected: `path`'s pictures differ by less than 0.5%, their means by less than 0.05%.

    Rationale: with the same random numbers, paths are the same until they are reflected: tangents differ. A copy that
    is turned the wrong way, or has the other BSDF, would be off by several per cent.
    """
    scene = scene_of_instances(20)
    unfolded = unfold_instances(scene)
    assert {shape.class_name() for shape in unfolded.shapes()}.isdisjoint({"Instance"})
    assert len(unfolded.shapes()) == 4  # floor, lamp, and one for each BSDF of the groups
    assert {emitter.id() for emitter in unfolded.emitters()} == {emitter.id() for emitter in scene.emitters()}
    assert [sensor.id() for sensor in unfolded.sensors()] == ["camera"]
    path = mi.load_dict({"type": "path", "max_depth": 4})
    ours, theirs = (np.array(mi.render(s, integrator=path, spp=256, seed=2)) for s in (unfolded, scene))
    assert ours.mean() == pytest.approx(theirs.mean(), rel=5e-4)
    assert relative_l2(ours, theirs) < 0.005


@pytest.mark.parametrize(
    ("count", "more"),
    [
        (unfolding.FEW, {}),
        (20, {"balls": {"type": "shapegroup", "ball": {"type": "sphere"}}}),
    ],
    ids=["few", "no mesh"],
)
def test_others_stay_as_they_are(count: int, more: dict) -> None:
    scene = scene_of_instances(count, **more)
    assert unfold_instances(scene) is scene


def test_too_many_vertices(monkeypatch) -> None:
    scene = scene_of_instances(20)
    monkeypatch.setattr(unfolding, "MOST", 1000)
    assert unfold_instances(scene) is scene


FILE = """
<scene version="3.0.0">
    <shape type="shapegroup" id="group">
        <shape type="cube"><transform name="to_world"><scale value="0.1"/></transform></shape>
    </shape>
    {copies}
    <emitter type="constant"/>
    <sensor type="perspective">
        <transform name="to_world"><lookat origin="0,0,4" target="0,0,0" up="0,1,0"/></transform>
        <film type="hdrfilm">
            <integer name="width" value="24"/>
            <integer name="height" value="24"/>
            <rfilter type="box"/>
        </film>
    </sensor>
</scene>
"""
COPY = """
<shape type="instance">
    <ref id="group"/>
    <transform name="to_world"><translate x="{x}" y="{y}"/></transform>
</shape>
"""


def test_many_lights_of_a_file_with_many_instances(tmp_path) -> None:
    """Expected: the mean of the picture is that of `path`."""
    file = tmp_path / "boxes.xml"
    copies = (COPY.format(x=k % 10 / 4 - 1, y=k // 10 / 4 - 1) for k in range(40))
    file.write_text(FILE.format(copies="".join(copies)))
    ours = prt.render_many_lights(file, rows=30, columns=200, lights=2000, max_depth=3, spp=16).image
    path = mi.load_dict({"type": "path", "max_depth": 3})
    theirs = np.array(mi.render(mi.load_file(str(file)), integrator=path, spp=256))[..., :3]
    assert ours.mean() == pytest.approx(theirs.mean(), rel=0.01)
