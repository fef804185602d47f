"""The `sparse_prt` integrator in plain Mitsuba: XML in, `mi.render`, picture out."""

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from matplotlib.figure import Figure

import mi_sparse_prt as prt
from mi_sparse_prt import cache
from mi_sparse_prt.scene.scene import Scene

pytestmark = pytest.mark.usefixtures("no_held_out")
SIZE = 32
BALL = """
    <shape type="sphere" id="ball">
        <point name="center" x="0.2" y="0.6" z="0"/><float name="radius" value="0.5"/>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.7, 0.5, 0.3"/></bsdf>
    </shape>"""
GROUND = """
    <shape type="rectangle" id="ground">
        <transform name="to_world"><rotate x="1" angle="-90"/><scale value="1.5"/></transform>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.5, 0.6, 0.7"/></bsdf>
    </shape>"""
CAMERA = f"""
    <sensor type="perspective">
        <float name="fov" value="40"/>
        <transform name="to_world"><lookat origin="1.5, 2.2, 4" target="0, 0.3, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm">
            <integer name="width" value="{SIZE}"/><integer name="height" value="{SIZE}"/>
            <rfilter type="box"/>
        </film>
    </sensor>"""
EMITTERS = {
    "envmap": '<emitter type="envmap"><string name="filename" value="sky.exr"/></emitter>',
    "cubemap": '<emitter type="cubemap"><string name="filename" value="sky.exr"/>'
    '<integer name="resolution" value="8"/></emitter>',
    "constant": '<emitter type="constant"><rgb name="radiance" value="0.5, 1, 2"/></emitter>',
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """With a small HDR sky in it: a gradient, a warm sun and a dark ground."""
    y, x = np.mgrid[0.5:32, 0.5:64] / 32 * np.pi / [[[1]], [[1]]]
    sky = np.maximum(np.cos(y), 0)[..., None] * [0.5, 0.7, 1.0] + 0.1
    sun = np.exp(-((y - 0.9) ** 2 + (x - 2.0) ** 2) / 0.1)[..., None] * [8.0, 6.0, 4.0]
    mi.Bitmap((sky + sun).astype(np.float32)).write(str(tmp_path / "sky.exr"))
    return tmp_path


def load(
    folder: Path,
    emitter: str = EMITTERS["envmap"],
    parameters: str = "",
    shapes: str = GROUND + BALL,
    edge_length: float = 0.2,
    optimize: bool = True,
) -> mi.Scene:
    """A scene from XML, as a user of Mitsuba loads it; small settings and a cache beside the file.

    Light is gathered, unless another method is named: what plans of "auto" cost is measured for seconds.
    """
    if 'name="method"' not in parameters:
        parameters += '<string name="method" value="gather"/>'
    else:
        parameters += '<integer name="indirect_resolution" value="4"/>'
    path = folder / "scene.xml"
    path.write_text(
        f"""<scene version="3.0.0">
        <integrator type="sparse_prt">
            <integer name="resolution" value="8"/>
            <integer name="max_depth" value="4"/>
            <float name="edge_length" value="{edge_length}"/>
            <string name="cache" value="{folder / "cache"}"/>
            <boolean name="progress" value="false"/>
            {parameters}
        </integrator>
        {CAMERA}{emitter}{shapes}</scene>"""
    )
    return mi.load_file(str(path), optimize=optimize)


def picture(scene: mi.Scene, **parameters: object) -> np.ndarray:
    return np.array(mi.render(scene, **({"spp": 16} | parameters)))[..., :3]


def reference(scene: mi.Scene, light: mi.Emitter, spp: int, seed: int) -> np.ndarray:
    """Mitsuba's `path` of the same shapes under a light."""
    shapes = {f"shape_{k}": shape for k, shape in enumerate(scene.shapes())}
    lit = mi.load_dict({"type": "scene", "light": light, **shapes})
    path = mi.load_dict({"type": "path", "max_depth": 4})
    return picture(lit, sensor=scene.sensors()[0], integrator=path, spp=spp, seed=seed)


def beyond_noise(ours: list[np.ndarray], theirs: list[np.ndarray]) -> tuple[float, float]:
    """Relative L2 without the noise of either side, from two independent renders of each; and the noise of both."""
    (a, b), (x, y) = ours, theirs
    norm = (x * y).sum(dtype=np.float64)
    square = ((a - x) * (b - y)).sum(dtype=np.float64)
    noise = np.hypot(np.linalg.norm(a - b), np.linalg.norm(x - y)) / 2
    return float(np.sqrt(max(square, 0) / norm)), float(noise / np.sqrt(norm))


def reasons(error: BaseException | None) -> str:
    """The messages of an error and of what caused it."""
    return "" if error is None else f"{error}\n" + reasons(error.__cause__)


def draw(*images: tuple[str, np.ndarray]) -> Figure:
    figure = Figure(figsize=(3 * len(images), 3))
    for axes, (title, image) in zip(np.atleast_1d(figure.subplots(1, len(images))), images, strict=True):
        axes.imshow(np.clip(image, 0, 1) ** (1 / 2.2))
        axes.set(title=title, xticks=[], yticks=[])
    return figure


@pytest.mark.parametrize(
    "kind", ["envmap", *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("cubemap", "constant"))]
)
def test_kinds_of_environments(folder, kind, artefact):
    """Rationale: `mi.render` of an XML scene is the same relit picture that `prt.render` makes.

    A ball over a ground under an `envmap`, a `cubemap` and a `constant` environment, 32 x 32 pixels, loaded as users
    do (shapes merged and shuffled by Mitsuba).

    Expected: the picture that `prt.precompute` and `prt.render` give with the same settings, seeds and samples, to
    float32 rounding; the sky behind is the environment itself.

    Result: equal.
    """
    # by name: what "auto" chooses depends on measured times
    scene = load(folder, EMITTERS[kind], '<string name="method" value="brute_force"/>')
    image = picture(scene, seed=5)
    surfaces = Scene.from_mitsuba(scene, 0.2)
    transport = prt.precompute(
        surfaces,
        prt.CubemapLighting(8),
        method="brute_force",
        basis="texel",
        max_depth=4,
        spp=16,
        indirect_resolution=4,
        progress=False,
    )
    by_hand = prt.render(surfaces, transport, scene.environment(), spp=16, seed=5)
    artefact(draw(("mi.render", image), ("prt.render", by_hand)))
    assert image.shape == (SIZE, SIZE, 3)
    assert image.min() >= 0
    assert image.std() > 0.05
    np.testing.assert_allclose(image, by_hand, rtol=1e-4, atol=1e-5)


def test_close_to_path(folder, artefact):
    """Rationale: what remains between a relit picture and `path` under the same light is interpolation, which goes
    away with shorter edges.

    The `cubemap` environment (the very texels that the matrix is multiplied with); edges of 0.4 and of 0.1; two
    independent renders of `path` (512 samples) and of the relit picture (128, for its edges), whose product of
    differences takes out the noise of both.

    Expected: relative L2 beyond the noise under 1.5% at the shorter edges and larger at the longer ones (the ball's
    shadow is blurred by what the vertices cannot resolve); the mean brightness of both agrees within 1%.

    Result: 0.2% at edges of 0.1 and 0.7% at 0.4 (noise 1.9%); brightness -0.2%.
    """
    scenes = {h: load(folder, EMITTERS["cubemap"], edge_length=h) for h in (0.4, 0.1)}
    light = scenes[0.1].environment()
    theirs = [reference(scenes[0.1], light, 512, seed=k) for k in (1, 2)]
    ours = {h: [picture(scene, spp=128, seed=k) for k in (3, 4)] for h, scene in scenes.items()}
    errors = {h: beyond_noise(ours[h], theirs)[0] for h in scenes}
    noise = beyond_noise(ours[0.1], theirs)[1]
    brightness = np.mean(ours[0.1]) / np.mean(theirs) - 1
    print(f"relative L2 {errors}, noise {noise:.3%}, brightness {brightness:+.3%}")
    artefact(draw(("path", theirs[0]), *((f"edges {h}: {errors[h]:.2%}", ours[h][0]) for h in scenes)))
    assert noise < 0.03
    assert errors[0.1] < 0.015
    assert errors[0.1] < 0.8 * errors[0.4]
    assert abs(brightness) < 0.01


def test_the_reference_is_the_nested_integrator(folder, artefact):
    """Rationale: one boolean in the XML switches between the matrix and the integrator it stands for.

    `reference` true, with a nested `path` of max_depth 2, and without one (then `path` of the same max_depth, 4).

    Expected: bit by bit what that integrator gives by itself, which differs with the depth; nothing is precomputed.

    Result: equal.
    """
    switch = '<boolean name="reference" value="true"/>'
    nested = '<integrator type="path"><integer name="max_depth" value="2"/></integrator>'
    shallow, deep = load(folder, parameters=switch + nested), load(folder, parameters=switch)
    images = [picture(scene, seed=1) for scene in (shallow, deep)]
    artefact(draw(("nested, max_depth 2", images[0]), ("default, max_depth 4", images[1])))
    for image, scene, depth in zip(images, (shallow, deep), (2, 4), strict=True):
        own = picture(scene, seed=1, integrator=mi.load_dict({"type": "path", "max_depth": depth}))
        assert np.array_equal(image, own)
    assert not np.array_equal(*images)
    assert not (folder / "cache").exists()


def test_a_texture_finer_than_the_vertices(folder, artefact):
    """Rationale: the albedo texture is looked up at the pixel, only the light is interpolated.

    A ground of two triangles with a checkerboard of 32 x 32 squares under a constant sky: alone, its light is 1
    everywhere, so the picture is the texture itself.

    Expected: `path` sees the same picture: relative L2 beyond the noise of both under 0.5% (two renders of each; the
    noise is that of the pattern inside of a pixel), while the albedo at the four corners alone would give one flat
    colour.

    Result: 0.0%, noise 0.7%.
    """
    ground = GROUND.replace(
        '<rgb name="reflectance" value="0.5, 0.6, 0.7"/>',
        '<texture type="checkerboard" name="reflectance"><float name="color0" value="0.1"/>'
        '<float name="color1" value="0.9"/><transform name="to_uv"><scale value="16"/></transform></texture>',
    )
    scene = load(folder, EMITTERS["constant"], shapes=ground, edge_length=10)
    ours = [picture(scene, spp=2048, seed=k) for k in (1, 2)]
    theirs = [reference(scene, scene.environment(), 2048, seed=k) for k in (3, 4)]
    error, noise = beyond_noise(ours, theirs)
    print(f"relative L2 {error:.3%}, noise {noise:.3%}")
    artefact(draw(("sparse_prt", ours[0]), ("path", theirs[0])))
    assert noise < 0.05
    assert error < 0.005
    on_ground = np.abs(theirs[0] - [0.5, 1, 2]).max(axis=2) > 0.05
    assert ours[0][on_ground][:, 1].std() > 0.02


def test_a_second_render_finds_the_matrix(folder, monkeypatch):
    """Another light, camera and load of the same scene: one precomputation, one file."""
    calls = []
    monkeypatch.setattr(cache, "precompute", lambda *a, **k: calls.append(1) or prt.precompute(*a, **k))
    first = picture(load(folder), seed=1)
    again = picture(load(folder), seed=1)
    other = picture(load(folder, EMITTERS["constant"]), seed=1)
    unmerged = picture(load(folder, optimize=False), seed=1)
    assert len(calls) == 1
    assert len(list((folder / "cache").iterdir())) == 1
    assert np.array_equal(first, again)
    assert not np.allclose(first, other, atol=0.05)
    np.testing.assert_allclose(unmerged, first, rtol=1e-3, atol=1e-3)
    picture(load(folder, parameters='<integer name="seed" value="1"/>'))
    assert len(calls) == 2


def test_two_textured_materials_keep_their_places(folder):
    """Shapes that Mitsuba shuffles when it loads: each pixel has the light of the triangle it sees."""
    images = [picture(load(folder, optimize=o), spp=64, seed=1) for o in (True, False)]
    np.testing.assert_allclose(images[0], images[1], rtol=1e-3, atol=1e-3)


# ------------------------------------------------------------------------------------ bad input


@pytest.mark.parametrize(
    "parameter",
    ['<integer name="resolutoin" value="8"/>', '<boolean name="refrence" value="true"/>'],
)
def test_unknown_parameters_are_mitsubas_error(folder, parameter):
    name = parameter.split('"')[1]
    with pytest.raises(RuntimeError, match=name):
        load(folder, parameters=parameter)


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"resolution": 3}, "power of two"),
        ({"basis": "sphere"}, "basis"),
        ({"method": "magic"}, "method"),
        ({"max_depth": 0}, "max_depth"),
        ({"precompute_spp": 0}, "spp"),
        ({"indirect_resolution": 64}, "finer"),
    ],
    ids=str,
)
def test_bad_values_are_refused_when_loading(parameters, message):
    with pytest.raises((RuntimeError, ValueError), match=message):
        mi.load_dict({"type": "sparse_prt", **parameters})


def test_no_light(folder):
    with pytest.raises(Exception) as error:
        picture(load(folder, ""))
    assert "sparse_prt: the scene has no light; add an emitter" in reasons(error.value)
    assert not (folder / "cache").exists()


def test_no_mesh(folder):
    with pytest.raises(Exception) as error:
        picture(load(folder, shapes=""))
    assert "no mesh" in reasons(error.value)
