"""Writes the zoo: a small scene for each BSDF, shape, texture and emitter of Mitsuba's plugin manual, and their files.

Every scene has the same stage: a grey ground, a red wall, a camera that looks down on both, and a soft sky with a warm
bright side. What the scene is named after stands in the middle; emitters have the sky's place, or are beside it.

``python scenes_xml/zoo/make_zoo.py`` from anywhere. It takes seconds and writes the same files again.
``mi-sparse-prt benchmark --zoo`` renders them all.
"""

from __future__ import annotations

from pathlib import Path

from zoo_files import write_files

FOLDER = Path(__file__).parent

#: Plugins of Mitsuba that have no scene, and why.
LEFT_OUT = {
    "measured": "needs a file of measurements that is larger than the zoo",
    "measured_polarized": "polarisation is not part of RGB variants",
    "polarizer": "polarisation is not part of RGB variants",
    "retarder": "polarisation is not part of RGB variants",
    "circular": "polarisation is not part of RGB variants",
    "timed_sunsky": "cannot be rendered by Mitsuba 3.9's own path in llvm_ad_rgb",
    "blender": "is made from Blender's memory, not from a file",
}

#: BSDFs that light crosses more than once: of these there is a scene of its own with as many bounces as they need.
CROSSED = ("dielectric", "roughdielectric", "principled_glass", "null", "hair")
DEPTH, DEEP = 5, 16

STAGE = """<!-- {title}. Written by make_zoo.py. -->
<scene version="3.0.0">
    <default name="integrator" value="path"/>
    <default name="max_depth" value="{depth}"/>
    <default name="width" value="96"/>
    <default name="height" value="72"/>
    <default name="spp" value="64"/>

    <integrator type="$integrator">
        <integer name="max_depth" value="$max_depth"/>
    </integrator>

    <sensor type="perspective" id="camera">
        <float name="fov" value="38"/>
        <transform name="to_world">
            <lookat origin="2.5, 2.4, 2.7" target="-0.15, 0.35, -0.1" up="0, 1, 0"/>
        </transform>
        <film type="hdrfilm">
            <integer name="width" value="$width"/>
            <integer name="height" value="$height"/>
            <rfilter type="box"/>
        </film>
        <sampler type="independent">
            <integer name="sample_count" value="$spp"/>
        </sampler>
    </sensor>

    <shape type="rectangle" id="ground">
        <transform name="to_world">
            <scale x="1.6" y="2"/>
            <rotate x="1" angle="-90"/>
            <translate x="0.5"/>
        </transform>
        <bsdf type="diffuse">
            <rgb name="reflectance" value="0.6, 0.6, 0.6"/>
        </bsdf>
    </shape>
    <shape type="rectangle" id="wall">
        <transform name="to_world">
            <scale x="2" y="0.75"/>
            <rotate y="1" angle="90"/>
            <translate x="-1.1" y="0.75"/>
        </transform>
        <bsdf type="diffuse">
            <rgb name="reflectance" value="0.7, 0.15, 0.1"/>
        </bsdf>
    </shape>

{content}
</scene>
"""

SKY = """<emitter type="envmap" id="sky">
    <string name="filename" value="sky.exr"/>
</emitter>"""
DIM = """<emitter type="constant" id="dim">
    <rgb name="radiance" value="0.2, 0.25, 0.3"/>
</emitter>"""
GREY = """<bsdf type="diffuse">
    <rgb name="reflectance" value="0.5, 0.5, 0.5"/>
</bsdf>"""
GOLD = """<bsdf type="roughconductor">
    <string name="material" value="Au"/>
    <float name="alpha" value="0.3"/>
</bsdf>"""
PATTERN = """<texture name="reflectance" type="bitmap">
    <string name="filename" value="pattern.png"/>
</texture>"""


def ball(bsdf: str) -> str:
    """A smooth ball of triangles with texture coordinates, of some BSDF."""
    return f"""<shape type="ply" id="ball">
    <string name="filename" value="ball.ply"/>
{indented(bsdf)}
</shape>"""


def pane(bsdf: str, turn: float = 30) -> str:
    """An upright rectangle without thickness, of some BSDF; ``turn`` (degrees) about the vertical axis."""
    return f"""<shape type="rectangle" id="pane">
    <transform name="to_world">
        <scale x="0.6" y="0.5"/>
        <rotate y="1" angle="{turn:g}"/>
        <translate y="0.52"/>
    </transform>
{indented(bsdf)}
</shape>"""


def indented(text: str, depth: int = 1) -> str:
    """Lines shifted to the right by ``depth`` steps."""
    return "\n".join("    " * depth + line if line else line for line in text.splitlines())


def shape(kind: str, content: str = "", bsdf: str = GREY) -> str:
    """A shape in the middle, with what it is made of."""
    inside = "\n".join(part for part in (content, bsdf) if part)
    return f'<shape type="{kind}" id="{kind}">\n{indented(inside)}\n</shape>'


def named(bsdf: str, name: str = "nested") -> str:
    """The same BSDF under a name, as a part of another one."""
    return bsdf.replace("<bsdf ", f'<bsdf name="{name}" ', 1)


TWO_SIDED = f'<bsdf type="twosided">\n{indented(GREY)}\n</bsdf>'
LEAF = """<texture name="opacity" type="bitmap">
    <string name="filename" value="opacity.png"/>
    <boolean name="raw" value="true"/>
</texture>"""

BSDFS = {
    "diffuse": ball('<bsdf type="diffuse">\n    <rgb name="reflectance" value="0.2, 0.45, 0.7"/>\n</bsdf>'),
    "dielectric": ball('<bsdf type="dielectric"/>'),
    "thindielectric": pane('<bsdf type="thindielectric"/>'),
    "roughdielectric": ball('<bsdf type="roughdielectric">\n    <float name="alpha" value="0.2"/>\n</bsdf>'),
    "conductor": ball('<bsdf type="conductor">\n    <string name="material" value="Cu"/>\n</bsdf>'),
    "roughconductor": ball(GOLD),
    "roughconductor_sharp": ball(GOLD.replace("0.3", "0.05")),
    "roughconductor_anisotropic": ball(
        GOLD.replace(
            '<float name="alpha" value="0.3"/>',
            '<float name="alpha_u" value="0.1"/>\n    <float name="alpha_v" value="0.4"/>',
        )
    ),
    "roughconductor_textured": ball(
        """<bsdf type="roughconductor">
    <string name="material" value="Au"/>
    <texture name="alpha" type="bitmap">
        <string name="filename" value="roughness.png"/>
        <boolean name="raw" value="true"/>
    </texture>
</bsdf>"""
    ),
    "plastic": ball(
        '<bsdf type="plastic">\n    <rgb name="diffuse_reflectance" value="0.1, 0.3, 0.6"/>\n</bsdf>'
    ),
    "roughplastic": ball(
        """<bsdf type="roughplastic">
    <rgb name="diffuse_reflectance" value="0.1, 0.3, 0.6"/>
    <float name="alpha" value="0.2"/>
</bsdf>"""
    ),
    "pplastic": ball(
        """<bsdf type="pplastic">
    <rgb name="diffuse_reflectance" value="0.1, 0.3, 0.6"/>
    <float name="alpha" value="0.2"/>
</bsdf>"""
    ),
    "principled": ball(
        """<bsdf type="principled">
    <rgb name="base_color" value="0.1, 0.5, 0.3"/>
    <float name="roughness" value="0.4"/>
    <float name="metallic" value="0.3"/>
    <float name="specular" value="0.5"/>
    <float name="clearcoat" value="0.5"/>
</bsdf>"""
    ),
    "principled_lacquer": ball(
        """<bsdf type="principled">
    <rgb name="base_color" value="0.4, 0.05, 0.05"/>
    <float name="roughness" value="0.02"/>
    <float name="specular" value="0.6"/>
</bsdf>"""
    ),
    "principled_textured": ball(
        """<bsdf type="principled">
    <texture name="base_color" type="bitmap">
        <string name="filename" value="pattern.png"/>
    </texture>
    <texture name="roughness" type="bitmap">
        <string name="filename" value="roughness.png"/>
        <boolean name="raw" value="true"/>
    </texture>
    <float name="metallic" value="0.6"/>
</bsdf>"""
    ),
    "principled_glass": ball(
        """<bsdf type="principled">
    <rgb name="base_color" value="0.7, 0.9, 0.8"/>
    <float name="roughness" value="0.2"/>
    <float name="spec_trans" value="0.8"/>
    <float name="eta" value="1.5"/>
</bsdf>"""
    ),
    "principledthin": pane(
        """<bsdf type="principledthin">
    <rgb name="base_color" value="0.2, 0.6, 0.15"/>
    <float name="roughness" value="0.5"/>
    <float name="diff_trans" value="0.8"/>
</bsdf>"""
    ),
    "hair": shape("bsplinecurve", '<string name="filename" value="curls.txt"/>', '<bsdf type="hair"/>'),
    "blendbsdf": ball(
        f"""<bsdf type="blendbsdf">
    <texture name="weight" type="bitmap">
        <string name="filename" value="opacity.png"/>
        <boolean name="raw" value="true"/>
    </texture>
{indented(named(GREY, "first"))}
{indented(named(GOLD, "second"))}
</bsdf>"""
    ),
    "bumpmap": ball(
        f"""<bsdf type="bumpmap">
    <texture name="arbitrary" type="bitmap">
        <string name="filename" value="bumps.png"/>
        <boolean name="raw" value="true"/>
    </texture>
    <float name="scale" value="0.15"/>
{indented(GREY)}
</bsdf>"""
    ),
    "normalmap": ball(
        f"""<bsdf type="normalmap">
    <texture name="normalmap" type="bitmap">
        <string name="filename" value="normals.png"/>
        <boolean name="raw" value="true"/>
    </texture>
{indented(GREY)}
</bsdf>"""
    ),
    "mask": pane(f'<bsdf type="mask">\n{indented(LEAF)}\n{indented(TWO_SIDED)}\n</bsdf>'),
    "mask_half": ball(
        f'<bsdf type="mask">\n    <float name="opacity" value="0.5"/>\n{indented(TWO_SIDED)}\n</bsdf>'
    ),
    "mask_gold": ball(f'<bsdf type="mask">\n{indented(LEAF)}\n{indented(GOLD)}\n</bsdf>'),
    "null": ball('<bsdf type="null"/>'),
    "twosided": pane(TWO_SIDED, turn=-130),
    "twosided_pair": pane(
        f"""<bsdf type="twosided">
{indented(named(GREY, "front"))}
    <bsdf name="back" type="diffuse">
        <rgb name="reflectance" value="0.1, 0.6, 0.2"/>
    </bsdf>
</bsdf>""",
        turn=-130,
    ),
    "twosided_gold": pane(f'<bsdf type="twosided">\n{indented(GOLD)}\n</bsdf>', turn=-130),
    "onesided": pane(GREY, turn=-130),
}

LIFTED = (
    '<transform name="to_world">\n    <scale value="{scale}"/>\n    <translate y="{height}"/>\n</transform>'
)
CURVES = '<string name="filename" value="curls.txt"/>'
BALL_FILE = '<string name="filename" value="ball.{suffix}"/>'

SHAPES = {
    "obj": shape("obj", BALL_FILE.format(suffix="obj")),
    "ply": shape("ply", BALL_FILE.format(suffix="ply")),
    "ply_faceted": shape(
        "ply", BALL_FILE.format(suffix="ply") + '\n<boolean name="face_normals" value="true"/>'
    ),
    "ply_inside_out": shape(
        "ply", BALL_FILE.format(suffix="ply") + '\n<boolean name="flip_normals" value="true"/>', TWO_SIDED
    ),
    "serialized": shape("serialized", BALL_FILE.format(suffix="serialized")),
    "sphere": shape("sphere", LIFTED.format(scale=0.5, height=0.52)),
    "cylinder": shape(
        "cylinder",
        '<point name="p0" x="0" y="0.02" z="0"/>\n<point name="p1" x="0" y="0.9" z="0"/>\n'
        '<float name="radius" value="0.45"/>',
        TWO_SIDED,
    ),
    "disk": pane(GREY, turn=40).replace("rectangle", "disk").replace("pane", "disk"),
    "rectangle": pane(GREY, turn=40),
    "cube": shape(
        "cube",
        '<transform name="to_world">\n    <scale value="0.4"/>\n    <rotate y="1" angle="25"/>\n'
        '    <translate y="0.42"/>\n</transform>',
    ),
    "sdfgrid": shape(
        "sdfgrid",
        '<string name="filename" value="blob.vol"/>\n<transform name="to_world">\n'
        '    <scale value="1.1"/>\n    <translate x="-0.55" z="-0.55"/>\n</transform>',
    ),
    "bsplinecurve": shape("bsplinecurve", CURVES),
    "linearcurve": shape("linearcurve", CURVES),
    "ellipsoids": shape("ellipsoids", '<string name="filename" value="ellipsoids.ply"/>'),
    "ellipsoidsmesh": shape("ellipsoidsmesh", '<string name="filename" value="ellipsoids.ply"/>'),
    "merge": """<shape type="merge" id="merge">
    <bsdf type="diffuse" id="shared">
        <rgb name="reflectance" value="0.5, 0.5, 0.5"/>
    </bsdf>
    <shape type="cube">
        <transform name="to_world">
            <scale value="0.25"/>
            <translate x="-0.35" y="0.27"/>
        </transform>
        <ref id="shared"/>
    </shape>
    <shape type="cube">
        <transform name="to_world">
            <scale value="0.3"/>
            <rotate y="1" angle="20"/>
            <translate x="0.4" y="0.32"/>
        </transform>
        <ref id="shared"/>
    </shape>
</shape>""",
    "instance": f"""<shape type="shapegroup" id="group">
    <shape type="ply">
        <string name="filename" value="ball.ply"/>
{indented(GREY, 2)}
    </shape>
    <shape type="cube">
        <transform name="to_world">
            <scale value="0.2"/>
            <translate y="1.25"/>
        </transform>
{indented(GREY.replace("0.5, 0.5, 0.5", "0.2, 0.4, 0.7"), 2)}
    </shape>
</shape>
"""
    + "\n".join(
        f"""<shape type="instance">
    <ref id="group"/>
    <transform name="to_world">
        <scale value="{size}"/>
        <rotate y="1" angle="{angle}"/>
        <translate x="{x}" y="0.01" z="{z}"/>
    </transform>
</shape>"""
        for x, z, size, angle in ((-0.5, -0.4, 0.7, 0), (0.3, -0.5, 0.5, 30), (0.1, 0.5, 0.45, 70))
    ),
}


def textured(texture: str) -> str:
    """A diffuse ball with a texture."""
    return ball(f'<bsdf type="diffuse">\n{indented(texture)}\n</bsdf>')


TEXTURES = {
    "bitmap": textured(PATTERN),
    "bitmap_nearest": textured(
        PATTERN.replace("</texture>", '    <string name="filter_type" value="nearest"/>\n</texture>')
    ),
    "bitmap_clamped": textured(
        PATTERN.replace(
            "</texture>",
            '    <string name="wrap_mode" value="clamp"/>\n    <transform name="to_uv">\n'
            '        <scale x="3" y="2"/>\n    </transform>\n</texture>',
        )
    ),
    "checkerboard": textured(
        """<texture name="reflectance" type="checkerboard">
    <rgb name="color0" value="0.1, 0.2, 0.5"/>
    <rgb name="color1" value="0.8, 0.7, 0.4"/>
    <transform name="to_uv">
        <scale x="6" y="4"/>
    </transform>
</texture>"""
    ),
    "vertex_attribute": textured(
        '<texture name="reflectance" type="mesh_attribute">\n'
        '    <string name="name" value="vertex_color"/>\n</texture>'
    ),
    "face_attribute": textured(
        '<texture name="reflectance" type="mesh_attribute">\n'
        '    <string name="name" value="face_color"/>\n</texture>'
    ),
    "volume": textured(
        """<texture name="reflectance" type="volume">
    <volume name="volume" type="gridvolume">
        <string name="filename" value="colours.vol"/>
        <transform name="to_world">
            <scale value="1.2"/>
            <translate x="-0.6" z="-0.6"/>
        </transform>
    </volume>
</texture>"""
    ),
    "spectrum": textured('<spectrum name="reflectance" value="400:0.1, 500:0.2, 600:0.7, 700:0.8"/>'),
}

BALL = ball(GREY)
PANEL = """<shape type="rectangle" id="panel">
    <transform name="to_world">
        <scale value="{size}"/>
        <lookat origin="{origin}" target="0, 0.3, 0" up="0, 0, 1"/>
    </transform>
{emitter}
</shape>"""
OUT_OF_SIGHT, IN_SIGHT = "0.9, 2.6, 0.4", "-0.85, 0.9, -0.3"


def panel(kind: str, content: str, size: float = 0.4, origin: str = OUT_OF_SIGHT) -> str:
    """A square lamp (half its width is ``size``) that shines on what stands in the middle."""
    emitter = f'<emitter type="{kind}">\n{indented(content)}\n</emitter>'
    return PANEL.format(size=size, origin=origin, emitter=indented(emitter))


def lamp(kind: str, content: str) -> str:
    """An emitter that is no surface."""
    return f'<emitter type="{kind}" id="{kind}">\n{indented(content)}\n</emitter>'


def rgb(name: str, *values: float) -> str:
    """A colour."""
    return f'<rgb name="{name}" value="{", ".join(f"{v:g}" for v in values)}"/>'


ABOVE = '<transform name="to_world">\n    <lookat origin="1, 2.4, 1.2" target="0, 0.3, 0" up="0, 1, 0"/>\n</transform>'
BULB = lamp("point", '<point name="position" x="0.8" y="2" z="0.6"/>\n' + rgb("intensity", 5, 4.5, 4))
SPOT = lamp("spot", ABOVE + "\n" + rgb("intensity", 14, 12, 10) + '\n<float name="cutoff_angle" value="25"/>')
LIT_PATTERN = PATTERN.replace("reflectance", "{name}")
UPRIGHT = '<transform name="to_world">\n    <rotate x="1" angle="-90"/>\n</transform>'
SUNNY = UPRIGHT + '\n<vector name="sun_direction" x="0.5" y="0.8" z="0.45"/>'

EMITTERS = {
    "area": panel("area", rgb("radiance", 14, 13, 11)),
    "area_textured": panel("area", LIT_PATTERN.format(name="radiance"), size=1.2),
    "area_in_sight": panel("area", rgb("radiance", 4, 3.5, 3), size=0.3, origin=IN_SIGHT) + "\n" + DIM,
    "area_mesh": ball('<emitter type="area">\n    <rgb name="radiance" value="2, 1.8, 1.5"/>\n</emitter>'),
    "area_sphere": """<shape type="sphere" id="globe">
    <point name="center" x="0.9" y="2.5" z="0.6"/>
    <float name="radius" value="0.2"/>
    <emitter type="area">
        <rgb name="radiance" value="40, 37, 32"/>
    </emitter>
</shape>""",
    # path sees none of its light, only particles would
    "directionalarea": panel("directionalarea", rgb("radiance", 3, 2.8, 2.4)) + "\n" + DIM,
    "point": BULB,
    "spot": SPOT,
    "spot_textured": SPOT.replace(
        "</emitter>", indented(LIT_PATTERN.format(name="texture")) + "\n</emitter>"
    ),
    "directional": lamp(
        "directional",
        '<vector name="direction" x="-0.5" y="-0.9" z="-0.4"/>\n' + rgb("irradiance", 3, 2.8, 2.4),
    ),
    "projector": lamp(
        "projector",
        ABOVE
        + '\n<float name="fov" value="40"/>\n<float name="scale" value="6"/>\n'
        + LIT_PATTERN.format(name="irradiance"),
    ),
    "constant": lamp("constant", rgb("radiance", 0.8, 0.9, 1)),
    "envmap": SKY.replace(
        "\n</emitter>",
        '\n    <float name="scale" value="0.7"/>\n    <transform name="to_world">\n'
        '        <rotate y="1" angle="60"/>\n    </transform>\n</emitter>',
    ),
    "envmap_sharp": SKY.replace("sky.exr", "../envmaps/studio.exr"),
    "sky": lamp("sunsky", SUNNY + '\n<float name="sun_scale" value="0"/>'),
    "sun": lamp("sunsky", SUNNY + '\n<float name="sky_scale" value="0"/>'),
    "sunsky": lamp("sunsky", SUNNY),
    "two_lamps": BULB + "\n" + panel("area", rgb("radiance", 5, 8, 14), origin="-0.6, 2.4, 1.4"),
    "lamp_and_sky": SPOT + "\n" + SKY,
    "lamp_and_constant": panel("area", rgb("radiance", 14, 13, 11)) + "\n" + DIM,
}


def scenes() -> dict[str, str]:
    """XML of every scene by its name, which is that of its kind and plugin."""
    found: dict[str, str] = {}
    for kind, every in (("bsdf", BSDFS), ("shape", SHAPES), ("texture", TEXTURES)):
        found |= {f"{kind}_{name}": whole(kind, name, f"{SKY}\n{content}") for name, content in every.items()}
    for name in CROSSED:
        found[f"bsdf_{name}_deep"] = whole("bsdf", f"{name}_deep", f"{SKY}\n{BSDFS[name]}", DEEP)
    for name, content in EMITTERS.items():
        stands = "" if name == "area_mesh" else "\n" + BALL
        found[f"emitter_{name}"] = whole("emitter", name, content + stands)
    return found


def whole(kind: str, name: str, content: str, depth: int = DEPTH) -> str:
    """The stage with what it is for, and the ``max_depth`` of its integrator."""
    title = f"{kind}: {name.replace('_', ', ', 1)}"
    return STAGE.format(title=title, content=indented(content), depth=depth)


def main() -> None:
    """Write all files of the zoo."""
    write_files(FOLDER)
    for name, text in scenes().items():
        (FOLDER / f"{name}.xml").write_text(text)
    print(f"{len(scenes())} scenes in {FOLDER}")


if __name__ == "__main__":
    main()
