"""Numbers of shapes from pointers on the device, against where the shapes stand."""

import mitsuba as mi
import numpy as np

from mi_sparse_prt.scene.shape_table import ShapeTable

T = mi.ScalarTransform4f


def scene_in_a_row() -> mi.Scene:
    """A cube, a rectangle and another cube over x = 0, 4 and 8: 12, 2 and 12 triangles."""
    kinds = {"a": "cube", "b": "rectangle", "c": "cube"}
    shapes = {
        name: {"type": kind, "to_world": T().translate([4.0 * i, 0, 0]), "bsdf": {"type": "diffuse"}}
        for i, (name, kind) in enumerate(kinds.items())
    }
    return mi.load_dict({"type": "scene", **shapes}, optimize=False)


def test_rays_find_the_numbers_of_shapes():
    _others, scene = scene_in_a_row(), scene_in_a_row()  # Dr.Jit knows the shapes of both
    origins = np.array([[4.0, 0, 9], [0, 0, 9], [8, 0, 9], [99, 0, 9]], np.float32)
    hit = scene.ray_intersect_preliminary(mi.Ray3f(mi.Point3f(origins.T), mi.Vector3f(0, 0, -1)))
    order = [shape.id() for shape in scene.shapes()]
    expected = [order.index(name) for name in ("b", "a", "c")]
    table = ShapeTable([scene], [10, 20, 30])
    assert table.gather(hit.shape, hit.is_valid()).numpy().tolist() == [10 * (i + 1) for i in expected] + [0]
