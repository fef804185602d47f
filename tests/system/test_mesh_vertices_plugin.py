"""The `mesh_vertices` sensor inside Mitsuba's own integrators."""

import mitsuba as mi
import numpy as np
import pytest
from conftest import T, build, diffuse, mesh
from matplotlib.figure import Figure

import mi_sparse_prt as prt
from mi_sparse_prt.measurement.vertices import vertex_rays

BOX = {"type": "cube", "to_world": T().rotate([0, 1, 0], 40), "bsdf": diffuse(0.2, 0.5, 0.8)}
GROUND = {
    "type": "rectangle",
    "to_world": T().rotate([1, 0, 0], -90).scale(2),
    "bsdf": diffuse(0.5, 0.5, 0.5),
}


def with_sensor(scene: prt.Scene, sensor: dict | None = None, **more: object) -> mi.Scene:
    """The scene's meshes, world space, seen by a sensor that looks at all vertices; not bound."""
    shapes = {f"shape_{k}": shape for k, shape in enumerate(scene.mitsuba.shapes())}
    sensor = {"type": "mesh_vertices", "vertices": scene.n_vertices, **(sensor or {})}
    return mi.load_dict({"type": "scene", "sensor": sensor, **shapes, **more})


def film(width: int, height: int, rfilter: str = "box") -> dict:
    return {
        "type": "hdrfilm",
        "width": width,
        "height": height,
        "rfilter": {"type": rfilter},
        "pixel_format": "rgb",
    }


def refused(sensor: dict, message: str) -> None:
    """Mitsuba wraps the reason in its own message."""
    with pytest.raises((RuntimeError, ValueError), match=message):
        mi.load_dict({"type": "mesh_vertices", **sensor})


@pytest.mark.parametrize("integrator", ["direct", "path", "volpath"])
def test_a_box_under_constant_light(integrator, artefact):
    """Rationale: with any integrator, pixel i is the radiance that leaves vertex i.

    A box of albedo (0.2, 0.5, 0.8) alone under a constant environment of radiance 1, whose light every vertex sees
    whole: the radiance is the albedo. 64 samples per vertex of a `direct`, `path` and `volpath`. (A ball would be
    0.45% darker: a hit lies in a facet, which hides what is above the shading normal's horizon and below its own.)

    Expected: the mean over all vertices within 3 standard errors of the albedo and those under 0.5% (2% would show);
    no vertex without light; pixels beyond the last vertex are black.

    Result: within one standard error, which is 0.1%.
    """
    scene = build(0.5, box=BOX)
    lit = with_sensor(scene, light={"type": "constant"})
    sensor = lit.sensors()[0]
    rays = sensor.bind(lit)
    assert rays.missed.sum() == 0
    image = mi.render(lit, integrator=mi.load_dict({"type": integrator}), spp=64, seed=1)
    radiance = sensor.radiance(image)
    assert radiance.shape == (scene.n_vertices, 3)
    ratio = radiance / np.array([0.2, 0.5, 0.8])
    error = ratio.mean(axis=1).std(ddof=1) / np.sqrt(len(ratio))
    assert 3 * error < 0.015
    assert abs(ratio.mean() - 1) < 3 * error + 1e-5
    assert (ratio > 0.5).all()
    pixels = np.array(image).reshape(-1, 3)
    assert (pixels[scene.n_vertices :] == 0).all()

    figure = Figure(figsize=(6, 3))
    axes = figure.subplots()
    axes.plot(ratio.mean(axis=1), ".", ms=2)
    axes.set(
        xlabel="vertex", ylabel="radiance / albedo", title=f"{integrator}: {ratio.mean():.4f} +- {error:.4f}"
    )
    artefact(figure)


@pytest.mark.parametrize("shape", [None, (256, 256), (1024, 64), (50, 1300)], ids=str)
def test_every_pixel_looks_at_its_own_vertex(shape, artefact):
    """Rationale: float rounding on a wide film, or a filter that bleeds, gives a pixel its neighbour's vertex.

    A plane of some 60,000 vertices and the `aov` integrator, which tells each pixel's position in space: the default
    film, a square one, and two long ones; 4 samples per pixel.

    Expected: every position within 2% of an edge of its own vertex (the ray ends 1% inside a triangle), but for at most
    one pixel in 5000: a sample at the very end of its pixel, which rounding gives to the next one. (A film of one row
    loses 7.8% that way.)

    Result: 3 to 8 of 60025 pixels have one such sample among their four.
    """
    n = 245
    x, z = (a.ravel() for a in np.meshgrid(np.linspace(-1, 1, n), np.linspace(-1, 1, n)))
    index = np.arange(n * n).reshape(n, n)
    a, b, c, d = (i.ravel() for i in (index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]))
    triangles = np.concatenate([np.stack([a, c, b], -1), np.stack([b, c, d], -1)])
    plane = mesh("plane", np.stack([x, 0 * x, z], -1), triangles, diffuse(0.5, 0.5, 0.5))
    scene = mi.load_dict(
        {
            "type": "scene",
            "plane": plane,
            "sensor": {"type": "mesh_vertices", "vertices": n * n}
            | ({"film": film(*shape)} if shape else {}),
        }
    )
    sensor = scene.sensors()[0]
    sensor.bind(scene)
    integrator = mi.load_dict({"type": "aov", "aovs": "where:position"})
    seen = sensor.radiance(mi.render(scene, integrator=integrator, spp=4))
    off = np.linalg.norm(seen - np.stack([x, 0 * x, z], -1), axis=1) / (2 / (n - 1))
    figure = Figure(figsize=(5, 3))
    axes = figure.subplots()
    axes.hist(off, 50)
    axes.set(xlabel="distance of what a pixel sees from its vertex, in edges", yscale="log")
    artefact(figure)
    assert (off > 0.02).mean() < 2e-4


def test_not_bound():
    scene = build(1.0, ground=GROUND)
    lit = with_sensor(scene, light={"type": "constant"})
    with pytest.raises(Exception) as error:  # Mitsuba chains the reason to an error of its own
        mi.render(lit, integrator=mi.load_dict({"type": "path"}), spp=1)
    assert isinstance(error.value.__cause__, prt.PrtError)
    assert "not bound" in str(error.value.__cause__)
    lit.sensors()[0].bind(lit)
    image = mi.render(lit, integrator=mi.load_dict({"type": "path"}), spp=1)
    assert np.isfinite(np.array(image)).all()


def test_bound_to_other_vertices():
    one, other = build(1.0, ground=GROUND), build(1.0, ground=GROUND, box=BOX)
    sensor = with_sensor(one).sensors()[0]
    with pytest.raises(prt.PrtError, match=f"made for {one.n_vertices} vertices"):
        sensor.bind(other.mitsuba)
    some = np.arange(5)
    few = mi.load_dict({"type": "mesh_vertices", "vertices": 5})
    assert few.bind(other.mitsuba, vertex_rays(other.mitsuba).take(some)).origins.shape == (5, 3)


def test_bad_parameters():
    refused({}, "say how many")
    refused({"vertices": 0}, "say how many")
    refused({"vertices": -3}, "say how many")
    refused({"vertices": 17, "film": film(4, 4)}, "4 x 4 pixels is too small for 17 vertices")
    refused({"vertices": 16, "film": film(4, 4, "gaussian")}, "box")
    refused({"vertices": 16, "film": film(4, 4, "tent")}, "box")
    mi.load_dict({"type": "mesh_vertices", "vertices": 16, "film": film(4, 4)})


def test_unknown_parameters_are_mitsubas_error(tmp_path):
    """In XML, Mitsuba itself complains about a parameter that no plugin asked for."""

    def load(parameter: str) -> mi.Object:
        path = tmp_path / "scene.xml"
        path.write_text(
            '<scene version="3.0.0"><sensor type="mesh_vertices"><integer name="vertices" value="4"/>'
            f"{parameter}<film type='hdrfilm'><integer name='width' value='2'/><integer name='height' value='2'/>"
            "<rfilter type='box'/></film></sensor><shape type='rectangle'/></scene>"
        )
        return mi.load_file(str(path))

    assert load("").sensors()[0].film().size()[0] == 2
    with pytest.raises(RuntimeError, match="vertizes"):
        load('<integer name="vertizes" value="4"/>')


def test_a_sampler_of_its_own():
    """The XML's sampler decides on the samples."""
    scene = build(1.0, ground=GROUND)
    lit = with_sensor(
        scene, {"sampler": {"type": "independent", "sample_count": 7}}, light={"type": "constant"}
    )
    lit.sensors()[0].bind(lit)
    assert lit.sensors()[0].sampler().sample_count() == 7
    assert "MeshVertices" in str(lit)
