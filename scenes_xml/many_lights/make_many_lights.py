"""Writes scenes that are lit by many lights, of the kinds in [HPB07]: y is up, units are metres.

A colonnade under sun and sky, most of what is seen lit by interreflection; a room of glossy materials whose lamps are
behind corners; a bush of leaves among lamps; a hall with lamps in recesses, each of which lights a place of its own;
a head of hair among lamps.

``python scenes_xml/many_lights/make_many_lights.py`` from anywhere writes the same files again; a folder as argument
takes them instead.
"""

from __future__ import annotations

import math
import random
import sys
from collections.abc import Sequence
from pathlib import Path

Triple = tuple[float, float, float]

SCENE = """<!-- {comment} Made by make_many_lights.py. -->
<scene version="3.0.0">
    <default name="width" value="400"/>
    <default name="height" value="300"/>
    <default name="spp" value="4"/>
    <default name="max_depth" value="5"/>

    <integrator type="row_column">
        <integer name="max_depth" value="$max_depth"/>
    </integrator>

    <sensor type="perspective" id="camera">
        <float name="fov" value="{fov}"/>
        <transform name="to_world"><lookat origin="{origin}" target="{target}" up="0, 1, 0"/></transform>
        <film type="hdrfilm">
            <integer name="width" value="$width"/>
            <integer name="height" value="$height"/>
            <rfilter type="box"/>
        </film>
        <sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>
    </sensor>

{things}
</scene>
"""


def numbers(values: Sequence[float]) -> str:
    """As XML has them."""
    return ", ".join(f"{value:.6g}" for value in values)


def scene(comment: str, fov: float, view: tuple[Triple, Triple], things: Sequence[str]) -> str:
    """A whole file."""
    body = "\n".join("    " + line for thing in things for line in thing.strip().splitlines())
    origin, target = map(numbers, view)
    return SCENE.format(comment=comment, fov=fov, origin=origin, target=target, things=body)


def diffuse(name: str, colour: Triple) -> str:
    """A diffuse material, both sides."""
    return (
        f'<bsdf type="twosided" id="{name}"><bsdf type="diffuse">'
        f'<rgb name="reflectance" value="{numbers(colour)}"/></bsdf></bsdf>'
    )


def principled(name: str, colour: Triple, roughness: float, metallic: float = 0.0) -> str:
    """A glossy material, both sides."""
    return (
        f'<bsdf type="twosided" id="{name}"><bsdf type="principled">'
        f'<rgb name="base_color" value="{numbers(colour)}"/><float name="roughness" value="{roughness:g}"/>'
        f'<float name="metallic" value="{metallic:g}"/></bsdf></bsdf>'
    )


def box(name: str, low: Triple, high: Triple, material: str) -> str:
    """A cube between two corners."""
    half = [(b - a) / 2 for a, b in zip(low, high, strict=True)]
    middle = [(a + b) / 2 for a, b in zip(low, high, strict=True)]
    return (
        f'<shape type="cube" id="{name}"><transform name="to_world"><scale value="{numbers(half)}"/>'
        f'<translate value="{numbers(middle)}"/></transform><ref id="{material}"/></shape>'
    )


def column(name: str, foot: Triple, radius: float, height: float, material: str) -> list[str]:
    """A shaft with a base and a capital."""
    x, y, z = foot
    top, wide = y + height, 1.45 * radius
    shaft = (
        f'<shape type="cylinder" id="{name}"><point name="p0" value="{numbers(foot)}"/>'
        f'<point name="p1" value="{numbers((x, top, z))}"/><float name="radius" value="{radius:g}"/>'
        f'<ref id="{material}"/></shape>'
    )
    ends = [
        box(f"{name}_{end}", (x - wide, low, z - wide), (x + wide, low + 0.22, z + wide), material)
        for end, low in (("base", y), ("capital", top - 0.22))
    ]
    return [shaft, *ends]


def panel(name: str, centre: Triple, half: tuple[float, float], radiance: Triple, moved: str = "") -> str:
    """An area lamp that faces down, and goes along x with a parameter of the scene."""
    move = f'<translate x="${moved}"/>' if moved else ""
    return (
        f'<shape type="rectangle" id="{name}"><transform name="to_world"><scale x="{half[0]:g}" y="{half[1]:g}"/>'
        f'<rotate x="1" angle="90"/><translate value="{numbers(centre)}"/>{move}</transform>'
        f'<emitter type="area"><rgb name="radiance" value="{numbers(radiance)}"/></emitter></shape>'
    )


def bulb(name: str, place: Triple, intensity: Triple) -> str:
    """A lamp that shines from a point."""
    return (
        f'<emitter type="point" id="{name}"><point name="position" value="{numbers(place)}"/>'
        f'<rgb name="intensity" value="{numbers(intensity)}"/></emitter>'
    )


def colonnade() -> str:
    """Sun and sky outside, and a camera in the shade."""
    things = [
        '<emitter type="sunsky" id="sky"><float name="turbidity" value="3"/>'
        '<vector name="sun_direction" value="0.5, 0.6, 0.7"/>'
        '<transform name="to_world"><rotate x="1" angle="-90"/></transform></emitter>',
        diffuse("stone", (0.62, 0.55, 0.44)),
        diffuse("tiles", (0.48, 0.3, 0.2)),
        diffuse("cloth", (0.5, 0.12, 0.1)),
        box("ground", (-12, -0.2, -12), (12, 0, 12), "tiles"),
        box("back", (-9, 0, -2.2), (9, 4.4, -1.9), "stone"),
        box("roof", (-9, 4, -2.2), (9, 4.4, 1.7), "stone"),
        box("end", (-9, 0, -2.2), (-8.7, 4, 1.7), "stone"),
        box("bench", (-4.5, 0, -1.8), (-2, 0.5, -1.2), "cloth"),
    ]
    for k in range(8):
        things += column(f"column_{k}", (-7.4 + 2.1 * k, 0, 1.1), 0.27, 4, "stone")
    return scene("A colonnade, seen from inside.", 62, ((5.6, 1.7, -0.9), (-3, 1.5, 0.3)), things)


def room() -> str:
    """A closed room with a counter; lamps above it, one of which slides, and behind partitions."""
    things = [
        '<default name="slide" value="0"/>',
        diffuse("plaster", (0.7, 0.68, 0.62)),
        principled("floor", (0.4, 0.28, 0.18), 0.45),
        principled("steel", (0.7, 0.7, 0.72), 0.45, 1),
        principled("lacquer", (0.15, 0.3, 0.42), 0.4),
        principled("copper", (0.85, 0.45, 0.3), 0.45, 1),
        box("ground", (-3, -0.1, -2.5), (3, 0, 2.5), "floor"),
        box("ceiling", (-3, 2.8, -2.5), (3, 2.9, 2.5), "plaster"),
        box("north", (-3, 0, -2.6), (3, 2.8, -2.5), "plaster"),
        box("south", (-3, 0, 2.5), (3, 2.8, 2.6), "plaster"),
        box("west", (-3.1, 0, -2.5), (-3, 2.8, 2.5), "plaster"),
        box("east", (3, 0, -2.5), (3.1, 2.8, 2.5), "plaster"),
        box("partition_west", (-2.2, 0, -1.2), (-2.1, 2.4, 0.6), "plaster"),
        box("partition_east", (2.1, 0, -1.2), (2.2, 2.4, 0.6), "plaster"),
        box("counter", (-1.6, 0, -2.4), (1.6, 0.9, -1.8), "lacquer"),
        box("top", (-1.65, 0.9, -2.45), (1.65, 0.95, -1.75), "steel"),
        box("shelf", (-1.6, 1.75, -2.5), (1.6, 1.8, -2.15), "lacquer"),
        box("table", (-0.7, 0.7, -0.6), (0.7, 0.75, 0.4), "lacquer"),
        *(
            box(f"leg_{k}", (x, 0, z), (x + 0.08, 0.7, z + 0.08), "steel")
            for k, (x, z) in enumerate(((-0.68, -0.58), (0.6, -0.58), (-0.68, 0.3), (0.6, 0.3)))
        ),
        *(
            f'<shape type="sphere" id="pot_{k}"><point name="center" value="{numbers((x, 1.08, -2.1))}"/>'
            f'<float name="radius" value="0.13"/><ref id="copper"/></shape>'
            for k, x in enumerate((-1.2, -0.5, 0.3))
        ),
        panel("lamp_left", (-0.8, 1.74, -2.3), (0.35, 0.04), (30, 27, 22), "slide"),
        panel("lamp_right", (0.8, 1.74, -2.3), (0.35, 0.04), (30, 27, 22)),
        bulb("bulb_west", (-2.6, 1.6, -0.4), (9, 7, 5)),
        bulb("bulb_east", (2.6, 1.6, -0.4), (5, 6, 8)),
    ]
    return scene(
        "A room of glossy materials, lamps behind corners.", 70, ((0.3, 1.5, 2.35), (0, 0.9, -1.2)), things
    )


def leaves() -> str:
    """Leaves among lamps: neither rows nor columns are smooth."""
    things = [
        diffuse("leaf", (0.29, 0.38, 0.16)),
        diffuse("bark", (0.3, 0.25, 0.19)),
        diffuse("sand", (0.46, 0.42, 0.34)),
        *(
            f'<shape type="ply" id="{name}"><string name="filename" value="../meshes/{name}.ply"/>'
            f'<ref id="{material}"/></shape>'
            for name, material in (("leaves", "leaf"), ("twigs", "bark"), ("meadow", "sand"))
        ),
        '<emitter type="constant" id="sky"><rgb name="radiance" value="0.04, 0.06, 0.1"/></emitter>',
        panel("lantern", (0, 2.4, 0.4), (0.25, 0.25), (14, 12, 9)),
        bulb("inside", (0.05, 0.75, 0.1), (0.5, 0.35, 0.2)),
        bulb("left", (-1.1, 0.5, 0.7), (0.6, 0.5, 0.35)),
        bulb("right", (1.2, 0.35, 0.5), (0.35, 0.45, 0.6)),
        bulb("behind", (0.2, 0.9, -1.2), (1.1, 0.9, 0.7)),
    ]
    return scene("A bush among lamps.", 38, ((1.6, 1.5, 3.9), (0, 0.6, 0)), things)


def hall() -> str:
    """Each lamp lights the mouth of its recess, and little else: columns that are alike where rows look."""
    depth, half = 0.5, 0.28
    things = [
        diffuse("stone", (0.6, 0.56, 0.5)),
        diffuse("slab", (0.45, 0.4, 0.36)),
        box("ground", (-5, -0.2, -7), (5, 0, 5), "slab"),
        box("vault", (-5, 5, -7), (5, 5.2, 5), "stone"),
        box("front", (-5, 0, 5), (5, 5, 5.2), "stone"),
        box("rear", (-5, 0, -7.2), (5, 5, -7), "stone"),
        panel("window", (0, 4.95, -1), (1.2, 1.6), (1.6, 1.7, 2)),
        box("altar", (-1, 0, -4.5), (1, 1.1, -3.6), "stone"),
    ]
    for side in (-1, 1):
        inner, outer = 4.0 * side, (4.0 + depth) * side
        low, high = sorted((inner, outer))
        wall = "west" if side < 0 else "east"
        things.append(
            box(
                f"{wall}_back",
                (min(outer, outer + 0.2 * side), 0, -7),
                (max(outer, outer + 0.2 * side), 5, 5),
                "stone",
            )
        )
        heights = [0.9, 2.1, 3.3, 4.5]
        edges = [0.0, *(h + s * half for h in heights for s in (-1, 1)), 5.0]
        for k in range(0, len(edges), 2):
            things.append(box(f"{wall}_band_{k}", (low, edges[k], -7), (high, edges[k + 1], 5), "stone"))
        places = [-6.2 + 1.1 * k for k in range(10)]
        cuts = [-7.0, *(z + s * half for z in places for s in (-1, 1)), 5.0]
        for j, h in enumerate(heights):
            for k in range(0, len(cuts), 2):
                corner = (low, h - half, cuts[k]), (high, h + half, cuts[k + 1])
                things.append(box(f"{wall}_pier_{j}_{k}", *corner, "stone"))
            for k, z in enumerate(places):
                place = (inner + 0.36 * depth * side, h, z)
                things.append(bulb(f"{wall}_lamp_{j}_{k}", place, (0.12, 0.09, 0.05)))
    return scene(
        "A hall with a lamp in each of eighty recesses.", 65, ((0.6, 1.8, 4.5), (-0.4, 2, -2)), things
    )


def hair() -> str:
    """Curves with a BSDF of their own: neither rows nor columns are smooth, and nothing is a triangle."""
    things = [
        diffuse("skin", (0.55, 0.4, 0.32)),
        diffuse("sand", (0.46, 0.42, 0.34)),
        '<bsdf type="hair" id="fibre"><float name="eumelanin" value="0.6"/>'
        '<float name="pheomelanin" value="0.4"/></bsdf>',
        '<shape type="sphere" id="head"><point name="center" value="0, 0.8, 0"/><float name="radius" value="0.5"/>'
        '<ref id="skin"/></shape>',
        '<shape type="bsplinecurve" id="strands"><string name="filename" value="strands.txt"/>'
        '<ref id="fibre"/></shape>',
        box("ground", (-4, -0.2, -4), (4, 0, 4), "sand"),
        '<emitter type="constant" id="sky"><rgb name="radiance" value="0.05, 0.06, 0.08"/></emitter>',
        panel("lantern", (0.6, 2.6, 0.8), (0.3, 0.3), (12, 11, 9)),
        bulb("left", (-1.3, 0.9, 0.9), (0.8, 0.6, 0.4)),
        bulb("behind", (0.4, 1.4, -1.4), (1.2, 1.1, 1)),
    ]
    return scene("A head of hair among lamps.", 34, ((0.9, 1.3, 3.4), (0, 0.75, 0)), things)


def strands(count: int = 1500) -> str:
    """Control points and radii of hair that falls from a head: a line each, strands apart."""
    rng, found = random.Random(1), []
    for _ in range(count):
        height, azimuth = rng.uniform(-0.1, 1), rng.uniform(0, 2 * math.pi)
        ring = math.sqrt(max(1 - height * height, 0))
        out = (ring * math.cos(azimuth), height, ring * math.sin(azimuth))
        bend, length = rng.uniform(0.7, 1.1), rng.uniform(0.45, 0.6)
        lines = []
        for k in range(7):
            t = k / 6
            reach = 0.47 + length * t * (1 - 0.45 * t)
            fall = bend * length * t * t
            sway = 0.03 * t * rng.uniform(-1, 1)
            point = (out[0] * reach + sway, 0.8 + out[1] * reach - fall, out[2] * reach + sway)
            lines.append(" ".join(f"{x:.3f}" for x in point) + f" {0.006 * (1 - 0.6 * t):.4f}")
        found.append("\n".join(lines))
    # Mitsuba 3.9 reads beyond its arrays at the very end of the last one: that is where no ray comes
    found.append("\n".join(f"0 {0.7 + 0.03 * k:.2f} 0 0.001" for k in range(7)))
    return "\n\n".join(found) + "\n"


SCENES = {"colonnade": colonnade, "room": room, "leaves": leaves, "hall": hall, "hair": hair}


def main(folder: Path = Path(__file__).parent) -> None:
    """Write all of them."""
    for name, make in SCENES.items():
        (folder / f"{name}.xml").write_text(make())
    (folder / "strands.txt").write_text(strands())


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
