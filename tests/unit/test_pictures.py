"""Pictures of numbers at vertices: colours where they belong, dots where they can be seen."""

import matplotlib
import mitsuba as mi
import numpy as np
import pytest

import mi_sparse_prt as prt
from mi_sparse_prt.benchmark.vertex_pictures import vertex_picture
from mi_sparse_prt.core.errors import PrtError


@pytest.fixture(scope="module")
def scene() -> prt.Scene:
    """A wall from -1 to 1 in x and y, seen head on, and a small wall far behind it."""
    T = mi.ScalarTransform4f
    return prt.Scene.from_mitsuba(
        mi.load_dict(
            {
                "type": "scene",
                "wall": {"type": "rectangle"},
                "hidden": {"type": "rectangle", "to_world": T().translate([0, 0, -1]).scale(0.2)},
                "sensor": {
                    "type": "perspective",
                    "fov": 2 * np.degrees(np.arctan(2 / 10)),  # from -2 to 2 at the wall
                    "to_world": T().look_at(origin=[0, 0, 10], target=[0, 0, 0], up=[0, 1, 0]),
                    "film": {"type": "hdrfilm", "width": 80, "height": 40},
                },
            },
            optimize=False,
        ),
        edge_length=0.3,
    )


def test_values_are_interpolated_colours(scene: prt.Scene) -> None:
    """Values linear in x give viridis linear in x, up to the shading (1 at the centre); nothing is white."""
    picture = vertex_picture(scene, scene.positions[:, 0], width=160)
    assert picture.shape == (80, 160, 3) and picture.dtype == np.float32
    assert (picture[:, :38] == 1).all() and (picture[:, 122:] == 1).all()
    x = (np.arange(160) + 0.5) / 160 * 4 - 2
    inside = np.abs(x) < 0.95
    colours = matplotlib.colormaps["viridis"]((x[inside] + 1) / 2)[:, :3]
    np.testing.assert_allclose(picture[40, inside], colours, atol=0.02)


def test_range_of_colours(scene: prt.Scene) -> None:
    viridis = matplotlib.colormaps["viridis"]
    ones = np.ones(len(scene.positions))
    for bounds, place in (((0, 1), 0.999), ((1, 2), 0.0), ((0, 2), 0.5)):
        picture = vertex_picture(scene, ones, width=80, vmin=bounds[0], vmax=bounds[1])
        np.testing.assert_allclose(picture[20, 40], viridis(place)[:3], atol=0.02)
    assert np.isfinite(vertex_picture(scene, ones, width=80)).all()  # all values equal: no range
    grey = vertex_picture(scene, np.full(len(scene.positions), np.nan), width=80)[20, 40]
    np.testing.assert_allclose(grey, 0.7, atol=0.01)


def test_dots_are_where_vertices_are_seen(scene: prt.Scene) -> None:
    values = np.zeros(len(scene.positions))
    plain = vertex_picture(scene, values, width=160)
    distance = np.linalg.norm(scene.positions - [0.5, -0.25, 0], axis=1)
    vertex = int(np.argmin(distance))
    changed = np.argwhere((vertex_picture(scene, values, width=160, dots=[vertex]) != plain).any(axis=2))
    x, y, _ = scene.positions[vertex]
    centre = changed.mean(axis=0) + 0.5
    np.testing.assert_allclose(centre, [40 - 40 * y, 80 + 40 * x], atol=0.6)
    assert 4 <= len(changed) <= 16


def test_hidden_dots_are_not_drawn(scene: prt.Scene) -> None:
    values = np.zeros(len(scene.positions))
    hidden = next(mesh for mesh in scene.meshes if mesh.name == "hidden").vertices
    dots = np.arange(hidden.start, hidden.stop)
    np.testing.assert_array_equal(
        vertex_picture(scene, values, width=160, dots=dots), vertex_picture(scene, values, width=160)
    )


def test_senseless_arguments_are_refused(scene: prt.Scene) -> None:
    values = np.zeros(len(scene.positions))
    for arguments, message in (
        ({"values": values[1:]}, "values"),
        ({"values": values, "sensor": 3}, "sensor"),
        ({"values": values, "dots": [-1]}, "dots"),
        ({"values": values, "dots": [len(values)]}, "dots"),
        ({"values": values, "width": 0}, "width"),
    ):
        with pytest.raises(PrtError, match=message):
            vertex_picture(scene, **arguments)
