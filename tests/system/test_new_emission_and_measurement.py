"""A basis of light and a set of outputs that the package does not have, each made here and nowhere else.

They stand for what users write themselves: as much as ``emission.space`` and ``measurement.Measurement`` ask for.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import scipy.sparse
from conftest import COLOURS, build, still_life
from numpy.typing import NDArray

import mi_sparse_prt as prt
from mi_sparse_prt.scene.mitsuba_meshes import lit_scene

DEPTH = 4


class PointLights:
    """Points that shine alike in all directions, intensity 1: columns are their places."""

    kind: ClassVar[str] = "points"
    neighbours = coarser = staticmethod(lambda _: None)
    sides = None

    def __init__(self, positions: NDArray[np.float32]) -> None:
        self.positions, self.size = positions, len(positions)
        self.unmet = np.arange(self.size)
        self.weights = np.ones(self.size, np.float32)
        self.coordinates = dict(zip("xyz", positions.T, strict=True))
        self._positions = mi.Point3f(np.ascontiguousarray(positions.T))

    def project(self, light: Any) -> NDArray[np.float32]:
        return np.broadcast_to(np.asarray(light, np.float32), (self.size, 3))

    def upsampling(self, coarse: Any) -> scipy.sparse.csr_array:
        return scipy.sparse.eye_array(self.size, format="csr", dtype=np.float32)

    def attributes(self) -> dict[str, Any]:
        return {"positions": self.positions.tolist()}

    def sample(
        self, element: mi.UInt32, position: mi.Point3f, uv: mi.Point2f
    ) -> tuple[mi.Vector3f, mi.Color3f, mi.Float, mi.Float]:
        way = dr.gather(mi.Point3f, self._positions, element) - position
        distance = dr.norm(way)
        return way / distance, mi.Color3f(1 / (distance * distance)), distance, mi.Float(0)

    def element_of(
        self, si: mi.SurfaceInteraction3f, ray: mi.Ray3f, active: mi.Mask
    ) -> tuple[mi.Int32, mi.Color3f]:
        return mi.Int32(-1), mi.Color3f(0)  # nobody sees a point

    def density(self, si: mi.SurfaceInteraction3f, ray: mi.Ray3f, active: mi.Mask) -> mi.Float:
        return mi.Float(0)

    @contextmanager
    def scene_lit_by(self, light: Any, scene: prt.Scene) -> Iterator[mi.Scene]:
        lamps = {
            f"lamp_{k}": {
                "type": "point",
                "position": place,
                "intensity": {"type": "rgb", "value": colour.tolist()},
            }
            for k, (place, colour) in enumerate(
                zip(self.positions.tolist(), self.project(light), strict=True)
            )
            if colour.any()
        }
        yield lit_scene(scene.unlit_shapes(), lamps.pop(next(iter(lamps))), **lamps)


@pytest.fixture(scope="module")
def scene() -> prt.Scene:
    view = mi.ScalarTransform4f().look_at(origin=[1.5, 2.2, 4], target=[0, 0.4, 0], up=[0, 1, 0])
    film = {"type": "hdrfilm", "width": 30, "height": 20, "rfilter": {"type": "box"}}
    camera = {"type": "perspective", "fov": 40, "to_world": view, "film": film}
    return build(edge_length=0.2, **still_life(COLOURS), camera=camera)


@pytest.fixture(scope="module")
def lights() -> PointLights:
    """Five places above the still life."""
    places = np.random.default_rng(4).uniform([-1.2, 1.5, -1.2], [1.2, 2.5, 1.2], (5, 3))
    return PointLights(places.astype(np.float32))


@pytest.fixture(scope="module")
def transport(scene, lights) -> prt.LightTransport:
    return prt.precompute(scene, lights, max_depth=DEPTH, progress=False)


def test_a_new_emission_space_is_validated(scene, transport):
    """Rationale: an emission space is one class; solvers, error estimate and validation take it as it is.

    Expected: an error of finite elements (a few per cent, as the matrix says of itself); 5% too much light shows.
    """
    assert transport.shape == (scene.n_vertices, 5, 3)
    asked = {"n_rows": 300, "spp": 128, "image_width": 30, "image_spp": 128, "progress": False}
    good = prt.validate(scene, transport, **asked).report
    total = good["relative_l2"]["total"]
    assert total < 1.5 * transport.report["estimated_error"]["total"] + 0.01
    assert good["image"]["relative_l2"] < 0.06
    albedo = np.float32(1.05) * transport.albedo
    brighter = replace(transport, reflection=replace(transport.reflection, albedo=albedo))
    found = prt.validate(scene, brighter, **asked, image=False).report["relative_l2"]["total"]
    assert found == pytest.approx(np.hypot(total, 0.05), rel=0.2)


def test_a_new_emission_space_is_relit_and_told_apart_in_files(scene, transport, tmp_path):
    light = np.random.default_rng(1).random((5, 3), np.float32)
    relit = transport.relight(light)
    assert np.allclose(relit, np.einsum("nmc,mc->nc", transport.columns(range(5)), light), atol=1e-6)
    assert (prt.render(scene, transport, light, spp=4) > 0).mean() > 0.3
    transport.save(tmp_path / "points.prt")
    with pytest.raises(prt.PrtError, match="the emission space 'points', which is unknown here"):
        prt.load_transport(tmp_path / "points.prt")


@pytest.mark.parametrize("lighting", [32, None, "sky.exr"])
def test_what_is_no_emission_space_is_refused(scene, lighting):
    with pytest.raises(prt.PrtError, match="give a CubemapLighting, SceneEmitters") as error:
        prt.precompute(scene, lighting, progress=False)
    assert "\n" not in str(error.value)


def test_bad_numbers_are_refused_for_lamps_too(scene, lights):
    for arguments, words in (({"max_depth": 1}, "max_depth is 1"), ({"seed": -1}, "seed is -1")):
        with pytest.raises(prt.PrtError, match=words):
            prt.precompute(scene, lights, **arguments, progress=False)


def test_a_new_measurement_is_the_mean_of_its_points(scene):
    """Rationale: outputs are weighted sums of points, whatever the points are: here mean radiosity of each mesh.

    Expected: the same weights applied to the matrix of vertices, but for the noise of the indirect light (the last
    bounce of points that are no vertices is gathered by rays of its own).
    """
    lighting, vertices = prt.CubemapLighting(4), prt.mesh_vertices(scene)
    rows = np.zeros((len(scene.meshes), scene.n_vertices), np.float32)
    for k, mesh in enumerate(scene.meshes):
        own = scene.vertex_areas[mesh.vertices]
        rows[k, mesh.vertices] = own / own.sum()
    means = replace(vertices, kind="means", weights=scipy.sparse.csr_array(rows))
    asked = {"method": "gather", "max_depth": DEPTH, "progress": False}
    transport = prt.precompute(scene, lighting, measurement=means, **asked)
    whole = prt.precompute(scene, lighting, **asked)
    assert transport.shape == (len(scene.meshes), 96, 3)
    light = np.linspace(0.5, 2, 96, dtype=np.float32)[:, None] * np.ones(3, np.float32)
    np.testing.assert_allclose(transport.relight(light), rows @ whole.relight(light), rtol=0.01)
    np.testing.assert_array_equal(transport.direct.rows(np.arange(5)), whole.direct.rows(np.arange(5)))
    with pytest.raises(prt.PrtError, match="validate renders vertices and pixels, not 'means'"):
        prt.validate(scene, transport, progress=False)
