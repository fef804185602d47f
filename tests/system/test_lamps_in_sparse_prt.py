"""The lamps of a scene in `sparse_prt`: what `path` shows, for as long as the lamps stay where they are."""

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from matplotlib.figure import Figure

import mi_sparse_prt as prt
from mi_sparse_prt import cache

pytestmark = pytest.mark.usefixtures("no_held_out")
SIZE = 32
RUNS = 4  # independent renders, whose spread is the standard error
WALLS = """
    <bsdf type="diffuse" id="white"><rgb name="reflectance" value="0.7, 0.7, 0.7"/></bsdf>
    <bsdf type="diffuse" id="red"><rgb name="reflectance" value="0.7, 0.1, 0.1"/></bsdf>
    <shape type="rectangle"><ref id="white"/>
        <transform name="to_world"><rotate x="1" angle="-90"/><translate y="-1"/></transform></shape>
    <shape type="rectangle"><ref id="white"/>
        <transform name="to_world"><translate z="-1"/></transform></shape>
    <shape type="rectangle"><ref id="red"/>
        <transform name="to_world"><rotate y="1" angle="90"/><translate x="-1"/></transform></shape>
    <shape type="cube">
        <bsdf type="diffuse"><rgb name="reflectance" value="0.3, 0.5, 0.6"/></bsdf>
        <transform name="to_world">
            <scale value="0.3"/><rotate y="1" angle="25"/><translate x="0.2" y="-0.68"/></transform>
    </shape>"""
PANEL = """
    <shape type="rectangle" id="panel">
        <bsdf type="diffuse"><rgb name="reflectance" value="0.5, 0.5, 0.5"/></bsdf>
        <emitter type="area">RADIANCE</emitter>
        <transform name="to_world">
            <scale value="0.3"/><rotate x="1" angle="70"/><translate y="0.6" z="-0.3"/></transform>
    </shape>"""
PLAIN = PANEL.replace("RADIANCE", '<rgb name="radiance" value="6, 5, 4"/>')
SCREEN = PANEL.replace(
    "RADIANCE",
    '<texture type="bitmap" name="radiance"><string name="filename" value="screen.exr"/>'
    '<boolean name="raw" value="true"/><string name="filter_type" value="nearest"/></texture>',
)
BULB = """
    <emitter type="point" id="bulb"><point name="position" x="-0.5" y="0.1" z="0.3"/>
        <rgb name="intensity" value="0.3, 0.5, 1.0"/></emitter>"""
BEAM = """
    <emitter type="spot" id="beam"><rgb name="intensity" value="2, 1, 0.5"/><float name="cutoff_angle" value="25"/>
        <transform name="to_world"><lookat origin="0.8, 0.8, 1" target="0.2, -0.6, 0" up="0, 1, 0"/></transform>
    </emitter>"""
FAR = """
    <emitter type="directional" id="far"><vector name="direction" x="-0.3" y="-1" z="-0.6"/>
        <rgb name="irradiance" value="0.3, 0.3, 0.5"/></emitter>"""
SLIDE = """
    <emitter type="projector" id="slide"><float name="fov" value="30"/><float name="scale" value="8"/>
        <texture type="bitmap" name="irradiance"><string name="filename" value="screen.exr"/></texture>
        <transform name="to_world"><lookat origin="0.5, 0, 2" target="0, 0, -1" up="0, 1, 0"/></transform>
    </emitter>"""
SKY = '<emitter type="constant" id="sky"><rgb name="radiance" value="0.3, 0.4, 0.5"/></emitter>'
SHINY = """
    <shape type="sphere" id="shiny"><bsdf type="roughconductor"><float name="alpha" value="0.2"/></bsdf>
        <point name="center" x="-0.4" y="-0.7" z="0.3"/><float name="radius" value="0.3"/></shape>"""

MIRROR_AND_GLASS = """
    <shape type="sphere" id="mirror"><bsdf type="conductor"/>
        <point name="center" x="-0.4" y="-0.6" z="0.3"/><float name="radius" value="0.35"/></shape>
    <shape type="sphere" id="glass"><bsdf type="dielectric"/>
        <point name="center" x="0.6" y="-0.7" z="0.6"/><float name="radius" value="0.25"/></shape>"""

COPIES = """
    <shape type="shapegroup" id="pair">
        <shape type="cube"><ref id="red"/><transform name="to_world"><scale value="0.12"/></transform></shape>
        <shape type="sphere"><ref id="white"/>
            <point name="center" x="0" y="0.22" z="0"/><float name="radius" value="0.1"/></shape>
    </shape>""" + "".join(
    f"""
    <shape type="instance"><ref id="pair"/>
        <transform name="to_world"><rotate y="1" angle="{30 * x}"/>
            <translate x="{x}" y="-0.87" z="{z}"/></transform></shape>"""
    for x, z in ((-0.6, 0.1), (-0.4, 0.6), (0.6, 0.5))
)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """With a picture to show or to project: its left half red, its right half green, unevenly."""
    rng, screen = np.random.default_rng(0), np.zeros((8, 8, 3), np.float32)
    screen[:, :4, 0], screen[:, 4:, 1] = rng.uniform(2, 12, (2, 8, 4))
    mi.Bitmap(screen).write(str(tmp_path / "screen.exr"))
    return tmp_path


@pytest.fixture
def computed(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What kinds of matrices were computed, one after another."""
    kinds: list[str] = []

    def counted(scene: prt.Scene, lighting: object, **settings: object) -> prt.LightTransport:
        kinds.append(lighting.kind)
        return prt.precompute(scene, lighting, **settings)

    monkeypatch.setattr(cache, "precompute", counted)
    return kinds


def load(
    folder: Path,
    content: str,
    max_depth: int = 4,
    parameters: str = "",
    edge_length: float = 0.12,
    optimize: bool = True,
) -> mi.Scene:
    """A room from XML, as a user of Mitsuba loads it, with these lamps."""
    path = folder / "scene.xml"
    path.write_text(
        f"""<scene version="3.0.0">
        <integrator type="sparse_prt">
            <integer name="resolution" value="8"/><string name="method" value="gather"/>
            <integer name="max_depth" value="{max_depth}"/><float name="edge_length" value="{edge_length}"/>
            <string name="cache" value="{folder / "cache"}"/><boolean name="progress" value="false"/>
            {parameters}
        </integrator>
        <sensor type="perspective">
            <float name="fov" value="40"/>
            <transform name="to_world"><lookat origin="0.8, 0.3, 3.2" target="0, -0.2, 0" up="0, 1, 0"/></transform>
            <film type="hdrfilm"><integer name="width" value="{SIZE}"/><integer name="height" value="{SIZE}"/>
                <rfilter type="box"/></film>
        </sensor>{WALLS}{content}</scene>"""
    )
    return mi.load_file(str(path), optimize=optimize)


def picture(scene: mi.Scene, **parameters: object) -> np.ndarray:
    return np.array(mi.render(scene, **({"spp": 16, "seed": 1} | parameters)))[..., :3].astype(np.float64)


def beside_path(scene: mi.Scene, max_depth: int, save: object, spp: int = 256) -> tuple[float, float, float]:
    """Relative bias of the mean, its standard error, and relative L2 beyond noise; the pictures are kept."""
    path = mi.load_dict({"type": "path", "max_depth": max_depth})
    ours = np.array([picture(scene, spp=spp, seed=k) for k in range(RUNS)])
    theirs = np.array([picture(scene, spp=spp, seed=90 + k, integrator=path) for k in range(RUNS)])
    mean = theirs.mean()
    bias = ours.mean() / mean - 1
    spread = np.hypot(*(x.mean(axis=(1, 2, 3)).std(ddof=1) for x in (ours, theirs)))
    a, b = ((ours[half] - theirs[half]).mean(axis=0) for half in (slice(0, 2), slice(2, 4)))
    distance = np.sqrt(max((a * b).sum(), 0) / (theirs.mean(axis=0) ** 2).sum())
    first, second = ours.mean(axis=0), theirs.mean(axis=0)
    figure = Figure(figsize=(9, 3))
    shown = (
        ("sparse_prt", first),
        ("path", second),
        ("5 x difference + 0.5", 0.5 + 5 * (first - second) / mean / 4),
    )
    for axes, (title, image) in zip(figure.subplots(1, 3), shown, strict=True):
        image = image if "x" in title else (image / mean / 4) ** (1 / 2.2)
        axes.imshow(np.clip(image, 0, 1))
        axes.set(title=title, xticks=[], yticks=[])
    save(figure)
    error = float(spread / np.sqrt(RUNS) / mean)
    print(f"bias {bias:+.3%} +- {error:.3%}, relative L2 beyond noise {distance:.3%}")
    return float(bias), error, float(distance)


def test_a_room_with_all_kinds_of_light(folder, artefact):
    """Rationale: all light of the XML is shown, each part once.

    A room under a panel, a bulb and a sky, loaded as users do; three interreflections.

    Expected: the mean of `path` within 1%, and an error of few per cent, that of interpolation of the sky's light
    between vertices 0.12 apart.
    """
    bias, error, distance = beside_path(load(folder, PLAIN + BULB + SKY), 4, artefact, 128)
    assert error < 0.003
    assert abs(bias) < 0.01
    assert distance < 0.03


@pytest.mark.parametrize("sky", [pytest.param(SKY, marks=pytest.mark.slow), ""], ids=["sky", "none"])
def test_instances_under_lamps(folder, artefact, sky):
    """Rationale: scenes made of a scene's shapes, for its lamps alone, cannot have instances without their groups.

    Expected: copies of a group under a panel, with and without a sky, as `path` shows them, in the bounds of a room
        without copies.
    """
    bias, error, distance = beside_path(load(folder, COPIES + PLAIN + sky), 4, artefact)
    assert error < 0.003
    assert abs(bias) < 0.01
    assert distance < 0.03


def test_direct_light_is_that_of_path(folder, artefact):
    """Rationale: shadows of small lamps are sharp, glossy surfaces reflect lamps, lamps are seen: all at the pixel.

    Every kind of lamp, no environment, and a ball of rough metal; `max_depth` 2.

    Expected: nothing but noise between `path` and ours.
    """
    scene = load(folder, PLAIN + BULB + BEAM + FAR + SLIDE + SHINY + MIRROR_AND_GLASS, 2)
    bias, error, distance = beside_path(scene, 2, artefact, 768)
    assert error < 0.003
    assert abs(bias) < 4 * error
    assert distance < 0.01
    assert not (folder / "cache").exists()  # nothing to know of vertices


def test_lamps_alone(folder, artefact):
    """Every kind of lamp, no environment, three interreflections: light of lamps that is reflected more than once."""
    bias, error, distance = beside_path(load(folder, PLAIN + BULB + BEAM + FAR + SLIDE), 4, artefact)
    assert error < 0.003
    assert abs(bias) < 0.01
    assert distance < 0.02


def test_lamps_and_what_they_light_in_mirrors_and_glass(folder, artefact):
    """Rationale: direct light at what a camera sees by way of mirrors and glass is found there, not at these.

    Lamps without a surface: `path` finds no light of theirs by way of mirrors either.
    """
    scene = load(folder, BULB + BEAM + MIRROR_AND_GLASS, -1)
    bias, error, distance = beside_path(scene, -1, artefact)
    assert error < 0.003
    assert abs(bias) < 0.01
    assert distance < 0.03


@pytest.mark.slow  # by mirror and glass, seen too: above
def test_light_of_a_lamp_that_a_mirror_throws_on_a_wall(folder, artefact):
    """Rationale: rays of the BSDF meet area lamps by way of mirrors, and no other rays do.

    A sheet of metal below the panel; at `max_depth` 3 it throws light on what the camera sees, and no farther.

    Expected: the mean of `path` within four standard errors and 0.5%.
    Result: 0.2 +- 0.3% more; without what it throws, 3.2% less.
    """
    sheet = """<shape type="rectangle"><bsdf type="conductor"/>
        <transform name="to_world"><rotate x="1" angle="-90"/><translate y="-0.99"/></transform></shape>"""
    bias, error, distance = beside_path(load(folder, PLAIN + sheet, 3), 3, artefact)
    assert error < 0.004
    assert abs(bias) < 4 * error + 0.005
    assert distance < 0.03


def test_surfaces_that_a_cameras_ray_met_count(folder, artefact):
    """Rationale: `max_depth` counts a mirror that a camera looks into, so that in it light met one surface less.

    A mirror before the back wall of a room whose front is open.

    Expected: the mean of `path` within four standard errors, these below 0.5%.
    Result: -0.1 +- 0.2%; with all light in the mirror, 1.4% more.
    """
    walls = "".join(
        f"""<shape type="rectangle"><ref id="white"/><transform name="to_world">{turn}</transform></shape>"""
        for turn in (
            '<rotate x="1" angle="90"/><translate y="1"/>',
            '<rotate y="1" angle="-90"/><translate x="1"/>',
        )
    )
    mirror = """<shape type="rectangle"><bsdf type="conductor"/>
        <transform name="to_world"><translate z="-0.99"/></transform></shape>"""
    bias, error, distance = beside_path(load(folder, PLAIN + walls + mirror, 3), 3, artefact)
    assert error < 0.005
    assert abs(bias) < 4 * error
    assert distance < 0.02


@pytest.mark.parametrize("lamp", [pytest.param(PLAIN, marks=pytest.mark.slow), FAR], ids=["panel", "sun"])
def test_what_rough_glass_focuses(folder, artefact, lamp):
    """Rationale: rays that rough glass scatters meet area lamps, and points and suns are asked where it does.

    Expected: the mean of `path` within four standard errors and 0.2%, and 3% beyond noise at single pixels.
    Result: 0.1% more; 0.1% less and 2.6% (sun). Without it, 4.0% less (panel); 0.8% less and 4.0% (sun).
    """
    ball = """<shape type="sphere"><bsdf type="roughdielectric"><float name="alpha" value="0.2"/></bsdf>
        <point name="center" x="-0.4" y="-0.5" z="0.2"/><float name="radius" value="0.4"/></shape>"""
    bias, error, distance = beside_path(load(folder, lamp + ball, 12), 12, artefact, 1024)
    assert error < 0.002
    assert abs(bias) < 4 * error + 0.002
    assert distance < 0.03


def test_a_screen_that_is_seen(folder, artefact):
    """Rationale: textured lamps shine as they look, in the picture and on the walls."""
    bias, error, distance = beside_path(load(folder, SCREEN), 4, artefact, 512)
    assert error < 0.004
    assert abs(bias) < 0.01
    assert distance < 0.02


def test_brightness_is_no_part_of_the_matrices(folder, computed):
    """Rationale: `mi.traverse` and `update` on what shines relight, whatever it was when the matrix was computed."""
    scene = load(folder, PLAIN + BULB)
    first = picture(scene)
    assert computed == ["emitters"]
    parameters = mi.traverse(scene)
    panel, bulb = "panel.emitter.radiance.value", "bulb.intensity.value"
    before = {key: mi.Color3f(parameters[key]) for key in (panel, bulb)}
    parameters.update({key: 0.25 * value for key, value in before.items()})
    np.testing.assert_allclose(picture(scene), 0.25 * first, rtol=1e-3, atol=1e-4)
    off = {panel: mi.Color3f(0), bulb: mi.Color3f(0)}
    parameters.update(off)
    assert picture(scene).max() == 0
    # each lamp alone, one of them in red: the sum is the whole
    parameters.update(off | {panel: before[panel]})
    alone = picture(scene, spp=256)
    parameters.update(off | {bulb: before[bulb] * mi.Color3f(1, 0, 0)})
    red = picture(scene, spp=256)
    assert red[..., 0].mean() > 0
    assert red[..., 1:].max() == 0
    parameters.update(before)
    both = picture(scene, spp=256)
    assert both[..., 0].mean() == pytest.approx(alone[..., 0].mean() + red[..., 0].mean(), rel=0.01)
    np.testing.assert_allclose(picture(scene), first, rtol=1e-4, atol=1e-5)
    assert computed == ["emitters"]


def test_what_is_computed_again(folder, computed):
    """A lamp that moved: the matrix of lamps. Another sky: nothing. Other walls: both."""
    scene = load(folder, BULB + SKY, edge_length=0.5)
    parameters = mi.traverse(scene)
    first = picture(scene)
    assert sorted(computed) == ["cubemap", "emitters"]
    assert list(mi.traverse(scene).keys()) == list(parameters.keys())
    parameters["sky.radiance.value"] *= 3
    parameters.update()
    brighter = picture(scene)
    assert len(computed) == 2
    assert brighter.mean() > 1.2 * first.mean()
    parameters["bulb.position"] = mi.Point3f(0.5, 0.4, 0.3)
    parameters.update()
    moved = picture(scene)
    assert computed[2:] == ["emitters"]
    assert np.abs(moved - brighter).max() > 0.1
    bsdf = next(key for key in parameters.keys() if key.endswith("reflectance.value"))
    parameters[bsdf] = mi.Color3f(0.1, 0.2, 0.3)
    parameters.update()
    picture(scene)
    assert sorted(computed[3:]) == ["cubemap", "emitters"]
    picture(load(folder, BULB + SKY, edge_length=0.5, optimize=False))
    assert len(computed) == 5


def test_glossy_surfaces_under_lamps(folder):
    """With `terms`, each lamp adds to the picture under the sky what it shows alone."""
    glossy = '<integer name="terms" value="2"/>'
    whole, sky, lamp = (load(folder, lights + SHINY, 3, glossy, 0.3) for lights in (SKY + BULB, SKY, BULB))
    parts = picture(sky, spp=64) + picture(lamp, spp=64)
    assert picture(whole, spp=64).mean() == pytest.approx(parts.mean(), rel=0.005)
